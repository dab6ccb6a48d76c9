"""Memory that this process has taken; without JAX, as the command line's first line asks for it."""

import sys
from pathlib import Path

import psutil


def status_mib(key: str) -> float:
    """A line of Linux's `/proc/self/status`, MiB: `VmRSS` is resident now, `VmHWM` at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))


def most_memory() -> float:
    """Bytes of memory that were resident at most so far."""
    if sys.platform == "linux":
        return 2**20 * status_mib("VmHWM")
    now = psutil.Process().memory_info()
    if sys.platform == "win32":
        return now.peak_wset
    import resource  # Windows has none

    return max(now.rss, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
