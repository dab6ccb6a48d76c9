"""The machine: versions, devices, memory and threads. Importing this module does not import JAX."""

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

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# Each thread holds the arrays that it works on, and memory bandwidth limits how many are of use.
_MAX_THREADS = 8


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
    """Bytes that this process can take without swapping."""
    return psutil.virtual_memory().available


def status_mib(key: str) -> float:
    """Memory of this process as Linux counts it, in MiB: `VmRSS` now, `VmHWM` its peak; NaN elsewhere."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(key)), math.nan)


def peak_memory() -> float:
    """Peak resident memory of this process so far, in bytes."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    # Preferred to `ru_maxrss`, which in a child process starts at its parent's.
    peak = 2**20 * status_mib("VmHWM")
    if not math.isnan(peak):
        return peak
    import resource  # absent on Windows

    # In bytes on macOS, in KiB elsewhere.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def map_in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """`map` with a thread per core, for NumPy code, which releases Python's lock; results are in the items' order."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as threads:
        yield from threads.map(function, items)
