"""Versions, devices and memory of this machine. Importing this module does not import JAX."""

import contextlib
import ctypes
import math
import os
import platform
import sys
import time
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from .._version import __version__
from .errors import input_error

# Number of an option of glibc.
_M_ARENA_MAX = -8
# Seconds for which compiled programs are kept.
_KEPT_FOR = 30 * 24 * 3600


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


def check_platforms() -> None:
    """Raise `InputError` unless JAX has the platforms of the variable `JAX_PLATFORMS`, for which it has no words."""
    names = os.environ.get("JAX_PLATFORMS", "")
    if names in ("", "cpu"):
        return
    import jax

    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:
        allowed = "platforms that JAX has on this machine, such as cpu, or not be set"
        raise input_error("JAX_PLATFORMS", allowed, names) from error


def cpu_device() -> Any:
    """The processor as a device of JAX; the default device where `JAX_PLATFORMS` leaves the processor out."""
    import jax

    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        return jax.devices()[0]


def accelerator() -> Any:
    """The GPU or TPU as a device of JAX, if there is one; None on a processor, and with several, which share work."""
    import jax

    devices = jax.local_devices()
    return devices[0] if len(devices) == 1 and devices[0].platform != "cpu" else None


def copy_to(device: Any, array: Any) -> Any:
    """Start to copy an array to a device: from page-locked memory if it has such, while it computes."""
    from jax import device_put
    from jax.sharding import SingleDeviceSharding

    locked = [memory.kind for memory in device.addressable_memories() if memory.kind == "pinned_host"]
    for kind in (*locked, device.default_memory().kind):
        array = device_put(array, SingleDeviceSharding(device, memory_kind=kind))
    return array


def cache_folder() -> Path:
    """The folder of this package in the user's cache: `$XDG_CACHE_HOME/gs_jax`, or the platform's.

    Raises `RuntimeError` if the user has no home folder.
    """
    if folder := os.environ.get("XDG_CACHE_HOME"):
        return Path(folder) / "gs_jax"
    if sys.platform == "win32" and (folder := os.environ.get("LOCALAPPDATA")):
        return Path(folder) / "gs_jax" / "Cache"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "gs_jax"


def keep_programs() -> None:
    """Let JAX keep what it compiles in the user's cache folder, for the next process; call it before JAX is imported.

    Not if the user's variables say where, or the folder cannot be written. Another processor has a folder of its own.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    with contextlib.suppress(OSError, RuntimeError):
        folder = cache_folder() / f"programs-{zlib.crc32(_processor().encode()):08x}"
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
        # JAX has folders in it, too; and another process may remove a file first.
        for file in folder.rglob("*"):
            with contextlib.suppress(OSError):
                if file.is_file() and time.time() - file.stat().st_mtime > _KEPT_FOR:
                    file.unlink()


def _processor() -> str:
    """The processor's instructions, for which programs are compiled, as far as the system tells."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.machine()} {platform.processor()}"


def available_memory() -> int:
    """Bytes that this process can take without swapping."""
    return psutil.virtual_memory().available


def share_heaps() -> None:
    """Let the threads that start from now on share two heaps: in one for each, more free memory is out of reach."""
    _call_glibc("mallopt", _M_ARENA_MAX, 2)


def release_memory() -> None:
    """Give memory that is free within this process back to the system: compilers leave much of it, in small pieces."""
    _call_glibc("malloc_trim", 0)


def _call_glibc(name: str, *arguments: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            getattr(ctypes.CDLL(None), name)(*arguments)


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
