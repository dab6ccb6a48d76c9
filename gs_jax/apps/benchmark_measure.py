"""Time and memory of a call."""

import ctypes
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..base.machine import status_mib


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that a call took, and what it returned."""
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def peak_mib(call: Callable[[], Any]) -> tuple[float, Any]:
    """What a call adds at most to the resident memory of this process, MiB, and what it returned.

    Meant for a fresh process. Only Linux tells (`/proc`), and not all of it; elsewhere it is NaN.
    """
    if sys.platform != "linux":
        return float("nan"), call()
    gc.collect()
    # What was freed before, and is kept for the next, would hide what the call takes.
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    except OSError:
        return float("nan"), call()
    before = status_mib("VmRSS")
    result = call()
    return status_mib("VmHWM") - before, result
