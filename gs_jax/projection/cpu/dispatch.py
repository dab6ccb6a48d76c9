"""Calls of numba kernels through XLA's FFI, which replace functions of this folder's parent on a CPU."""

import ctypes
import os
import sys
import warnings
from contextlib import suppress
from functools import cache
from inspect import unwrap
from pathlib import Path
from typing import Any
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jax import ShapeDtypeStruct
from numba import cfunc, types
from numba.core.caching import FunctionCache

from ...geometry import FALLOFF, field_limit
from ..convolution import spectrum
from ..rays import Envelope, Rays
from . import ffi, fftconv, kernels, windows
from .simd import FAST, WIDTH

# The handler's name for XLA, and the version of the structures that it reads. XLA refuses one that it does not support.
TARGET = "gs_jax_cpu"
VERSION = 0, 3
# Parts of a kernel's work for threads to share: more parts are more even, but their edges are computed twice.
_PARTS = min(max(8 * (os.cpu_count() or 1), 16), 64)
KERNELS = {
    "gather": kernels.gather,
    "scatter": kernels.scatter,
    "rays_vjp": kernels.rays_vjp,
    "convolve": fftconv.overlap_save,
    "correlate": fftconv.overlap_save,
    "read_windows": windows.read_windows,
    "add_windows": windows.add_windows,
    "times_rows": windows.times_rows,
    "times_columns": windows.times_rows,
}
_table = np.zeros(ffi.FIRST_KERNEL + len(KERNELS), np.int64)


def load(name: str):
    """The function of this name, with its kernel compiled.

    Raises
    ------
    RuntimeError
        If XLA does not support the handler's version.
    """
    _register()
    _table[ffi.FIRST_KERNEL + _number(name)] = _compile(KERNELS[name], types.void, 2).address
    return globals()[name]


def _number(name):
    return list(KERNELS).index(name)


@cache
def _register():
    idle = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    functions = (ctypes.pythonapi.PyMem_RawMalloc, ctypes.pythonapi.PyMem_RawFree, idle)
    for place, function in zip((ffi.ALLOCATE, ffi.FREE, ffi.YIELD), functions, strict=True):
        _table[place] = ctypes.cast(function, ctypes.c_void_p).value or 0
    if sys.platform == "linux":
        _table[ffi.ADVISE] = ctypes.cast(ctypes.CDLL(None).madvise, ctypes.c_void_p).value or 0
    (_table[ffi.MAJOR], _table[ffi.MINOR]), _table[ffi.TASK] = VERSION, _compile(ffi.task, types.int64, 1).address
    handler = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(_compile(ffi.handle, types.int64, 1).address)
    extension, frame = np.array([32, ffi.TABLE, 0, _table.ctypes.data], np.int64), np.zeros(21, np.int64)
    frame[ffi.EXTENSION] = extension.ctypes.data
    handler(frame.ctypes.data)
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler), platform="cpu")


@cache
def _compile(function, result, arguments) -> Any:
    """A C function, compiled or read from numba's cache."""
    # Numba checks only the function's own file for changes; the hash of all files is part of the signature instead.
    signature = result(*[types.int64] * arguments, types.literal(_sources_hash()))
    compile_it = lambda cache: cfunc(signature, cache=cache, **FAST)(unwrap(function))
    try:
        return compile_it(True)
    except Exception as error:
        # Of any type, where files in the cache are damaged.
        folder = _cache_folder(function)
        if folder is None or not folder.is_dir():
            raise
        compiled = compile_it(False)
        reason = f"{type(error).__name__}: {error}"
        text = f"numba's cache is damaged, and kernels are compiled anew each time; delete {folder} ({reason:.100})"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
        return compiled


def _cache_folder(function) -> Path | None:
    """Where numba keeps the machine code of a function; None if it finds no folder."""
    with suppress(RuntimeError):
        return Path(FunctionCache(unwrap(function)).cache_path)
    return None


@cache
def _sources_hash() -> int:
    return crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))


def _call(kernel: str, results, *buffers):
    """A kernel's results. Buffers and results have at most three axes."""
    attributes = {"kernel": np.int64(_number(kernel)), "parts": np.int64(_PARTS)}
    return jax.ffi.ffi_call(TARGET, results)(*buffers, **attributes)


def gather(shapes, rays: Rays, image):
    return _call("gather", ShapeDtypeStruct(shapes.volume, jnp.float32), *_tables(shapes, rays), _pixels(image))


def scatter(shapes, rays: Rays, volume):
    return _call("scatter", ShapeDtypeStruct(shapes.image, jnp.float32), *_tables(shapes, rays), volume)


def rays_vjp(shapes, constants, volume):
    rays, image = constants
    like = lambda *shape: ShapeDtypeStruct(shape, jnp.float32)
    y, x, of_lens = rays.y.pixel.shape, rays.x.pixel.shape, (len(rays.y.start), *rays.parameters.shape)
    results = [like(*y), like(*y), like(*x), like(*x), like(*of_lens)]
    *by_axes, by_parameters = _call("rays_vjp", results, *_tables(shapes, rays), _pixels(image), volume)
    return *by_axes, by_parameters.sum(0)


def _tables(shapes, rays: Rays):
    axes = [part for axis in (rays.y, rays.x) for part in (axis.start, axis.pixel, axis.fraction, axis.distance2)]
    return weight_numbers(shapes.weight), rays.parameters, *axes


def _pixels(image):
    """Pixels of a type that the kernels read; a single bool is an image of ones."""
    if image is None:
        return jnp.ones((), bool)
    return image if image.dtype in (jnp.uint8, jnp.uint16) else image.astype(jnp.float32)


def weight_numbers(weight):
    """The kind of a weight, its limit and the slope of its falloff, those of its hole (or zero), and its scale."""
    falloff = lambda radius: (field_limit(radius) ** 2, 1 / (2 * FALLOFF * radius**2)) if radius else (0, 0)
    if isinstance(weight, Envelope):
        numbers = (0, *falloff(weight.field_radius), 0, 0, 0)
    else:
        numbers = (1, *falloff(weight.outer), *falloff(weight.inner), 1 / weight.outer**2)
    return jnp.asarray(numbers, jnp.float32)


def convolve(sizes, kernels, sharp):
    size = kernels.shape[-1]
    shift = 1 - size if sizes.whole else 1
    return _overlap_save("convolve", kernels[:, ::-1, ::-1], sharp, [sizes.image], shift)[0]


def correlate(sizes, kernels, image):
    shift = 0 if sizes.whole else -kernels.shape[-1]
    return tuple(_overlap_save("correlate", kernels, (image,), [sizes.sharp] * len(kernels), shift))


def _overlap_save(name, kernels, images, shapes, shift):
    """Sums of such shapes, of the images from `shift` on, correlated with the kernels."""
    size = kernels.shape[-1]
    side = 256  # of the tiles: larger ones waste less at their edges, and outgrow the cache
    while side < 3 * size:
        side *= 2
    turns = -_frequencies(side)[:, None] * np.arange(size) / side
    real, imaginary = jax.vmap(lambda kernel: spectrum(kernel, turns, turns))(kernels)
    strips = lambda part: part.reshape(len(kernels), -1, WIDTH, side).swapaxes(2, 3)
    spectra = jnp.stack([strips(real), strips(imaginary)], 2).reshape(len(kernels), 2 * side, side) / side**2
    angles = 2 * np.pi * np.arange(side) / side
    plan = np.array([len(images), len(shapes), shift, (side - size + 1) // WIDTH * WIDTH], np.int32)
    results = [ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    table = np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)
    return _call(name, results, plan, table, spectra, *images)


def read_windows(windows, places, image):
    shape = windows.side, windows.side, len(places[0])
    return _call("read_windows", ShapeDtypeStruct(shape, jnp.float32), *places, image)


def add_windows(windows, places, values):
    return _call("add_windows", ShapeDtypeStruct(windows.shape, jnp.float32), *places, values)


def times_rows(matrix, _, x):
    return _times("times_rows", matrix.rows, x)


def times_columns(matrix, _, x):
    return _times("times_columns", matrix.columns, x)


def _times(kernel, entries, x):
    result = ShapeDtypeStruct((len(entries.start) - 1, x.shape[1]), jnp.float32)
    return _call(kernel, result, entries.start, entries.place, entries.share.astype(np.float32), x)


@cache
def _frequencies(side: int) -> np.ndarray:
    """The order of frequencies after radix-4 transforms."""
    if side <= 2:
        return np.arange(side)
    return (4 * _frequencies(side // 4)[None] + np.arange(4)[:, None]).ravel()
