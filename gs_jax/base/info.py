"""What this installation is and runs on."""

import os
import platform
from importlib.metadata import version

import jax
import psutil

from .. import __version__


def describe() -> dict[str, str]:
    """Versions, devices and memory, name to value."""
    return {
        "gs-jax": __version__,
        "python": platform.python_version(),
        "jax": f"{jax.__version__}, jaxlib {version('jaxlib')}",
        "system": f"{platform.system()} {platform.machine()}",
        "devices": ", ".join(f"{d.device_kind} ({d.platform} {d.id})" for d in jax.devices()),
        "cores": str(os.cpu_count()),
        "memory": f"{memory_bytes() / 2**30:.1f} GiB",
    }


def memory_bytes() -> int:
    """Physical memory of the machine."""
    return psutil.virtual_memory().total
