"""Memory that this process has taken; without JAX, as the command line's first line asks for it."""

import math
import sys
from pathlib import Path

import psutil


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
