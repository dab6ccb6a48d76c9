"""What this installation is and runs on."""

import os
import platform
from importlib.metadata import version

import jax
import psutil

from .._version import __version__


def describe() -> dict[str, str]:
    """Versions, devices and memory, name to value."""
    memory = psutil.virtual_memory()
    return {
        "gs-jax": __version__,
        "python": platform.python_version(),
        "jax": f"{jax.__version__}, jaxlib {version('jaxlib')}",
        "system": f"{platform.system()} {platform.machine()}",
        "devices": ", ".join(f"{d.device_kind} ({d.platform} {d.id})" for d in jax.devices()),
        "cores": str(os.cpu_count()),
        "memory": f"{memory.total / 2**30:.1f} GiB, {memory.available / 2**30:.1f} free",
    }


def available_memory() -> int:
    """Bytes that may be taken now without swapping; other programs have the rest of the machine's."""
    return psutil.virtual_memory().available
