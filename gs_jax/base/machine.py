"""What this installation is and runs on."""

import math
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import psutil

from .._version import __version__


def describe() -> dict[str, str]:
    """Versions, devices and memory, name to value."""
    import jax

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


def status_mib(key: str) -> float:
    """A line of Linux's `/proc/self/status`, MiB: `VmRSS` is resident now, `VmHWM` at most. NaN where it is missing."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(key)), math.nan)


def most_memory() -> float:
    """Bytes of memory that were resident at most so far."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    # First, as `ru_maxrss` of a child starts with its parent's.
    most = 2**20 * status_mib("VmHWM")
    if not math.isnan(most):
        return most
    import resource  # Windows has none

    # In bytes on macOS, in KiB elsewhere.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# More would wait for memory, and each holds what it works on.
_MOST = 8


def in_threads(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """What `work` makes of each of the items, in their order, as it becomes ready; a thread for each core does so."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MOST)) as threads:
        yield from threads.map(work, items)
