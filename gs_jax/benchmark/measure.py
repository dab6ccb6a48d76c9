"""Time and memory of a call."""

import ctypes
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that a call took, and what it returned."""
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def peak_mib(call: Callable[[], Any]) -> tuple[float, Any]:
    """What a call adds at most to the resident memory of this process, MiB, and what it returned.

    Meant for a fresh process. Only Linux tells (`/proc`); elsewhere it is NaN.
    """
    if sys.platform != "linux":
        return float("nan"), call()
    gc.collect()
    # What was freed before, and is kept for the next, would hide what the call takes.
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = status_mib("VmRSS")
    result = call()
    return status_mib("VmHWM") - before, result


def status_mib(key: str) -> float:
    """A line of `/proc/self/status`, MiB: `VmRSS` is resident now, `VmHWM` at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))
