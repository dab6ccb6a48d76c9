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

from ...linear.fourier import kernel_spectrum
from ..rays import Rays, weight_numbers
from . import ffi, fftconv, kernels, spectra, windows
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
    "to_spectra": spectra.to_spectra,
    "from_spectra": spectra.from_spectra,
    "add_products": spectra.add_products,
    "products_back": spectra.products_back,
}
_table = np.zeros(ffi.FIRST_KERNEL + len(KERNELS), np.int64)
_NO_MEMORY = ctypes.create_string_buffer(b"gs_jax: no memory for a kernel of back-projection or the forward model")
# XLA's arguments of an error: their size, no extension, the message and its kind.
_no_memory = np.array([32, 0, ctypes.addressof(_NO_MEMORY), ffi.RESOURCE_EXHAUSTED], np.int64)
# What kernels read, besides float32.
_TYPES = (jnp.bool_, jnp.uint8, jnp.uint16, jnp.int32)
_MOST_AXES = 3


def load(name: str):
    """The function of this name, with its kernel compiled.

    Raises
    ------
    RuntimeError
        If XLA does not support the handler's version.
    """
    _register()
    _table[ffi.FIRST_KERNEL + _number(name)] = _compile(KERNELS[name], types.int64, 2).address
    return globals()[name]


def _number(name):
    return list(KERNELS).index(name)


@cache
def _register():
    idle = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    functions = (ctypes.pythonapi.PyMem_RawCalloc, ctypes.pythonapi.PyMem_RawFree, idle)
    for place, function in zip((ffi.ALLOCATE, ffi.FREE, ffi.YIELD), functions, strict=True):
        _table[place] = ctypes.cast(function, ctypes.c_void_p).value or 0
    if sys.platform == "linux":
        _table[ffi.ADVISE] = ctypes.cast(ctypes.CDLL(None).madvise, ctypes.c_void_p).value or 0
    _table[ffi.NO_MEMORY] = _no_memory.ctypes.data
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
    """A kernel's results, float32, of buffers as it reads them."""
    buffers = [_as_buffer(kernel, buffer) for buffer in buffers]
    attributes = {"kernel": np.int64(_number(kernel)), "parts": np.int64(_PARTS)}
    return jax.ffi.ffi_call(TARGET, results)(*buffers, **attributes)


def _as_buffer(kernel, array):
    array = jnp.asarray(array)
    array = array.astype(jnp.float32) if jnp.issubdtype(array.dtype, jnp.floating) else array
    _require(kernel, array.ndim <= _MOST_AXES and array.dtype in (jnp.float32, *_TYPES), array)
    return array


def _require(kernel, condition, *arrays):
    """Raise `ValueError` unless arrays fit each other: a kernel does not check sizes, and would write beyond them."""
    if not condition:
        given = ", ".join(f"{array.dtype.name}{list(array.shape)}" for array in arrays)
        raise ValueError(f"kernel {kernel}: arrays must fit each other, got {given}.")


def gather(shapes, rays: Rays, image):
    return _call("gather", ShapeDtypeStruct(shapes.volume, jnp.float32), *_tables(shapes, rays), _pixels(shapes, image))


def scatter(shapes, rays: Rays, volume):
    _require("scatter", volume.shape == shapes.volume, volume)
    return _call("scatter", ShapeDtypeStruct(shapes.image, jnp.float32), *_tables(shapes, rays), volume)


def rays_vjp(shapes, constants, volume):
    rays, image = constants
    _require("rays_vjp", volume.shape == shapes.volume, volume)
    like = lambda *shape: ShapeDtypeStruct(shape, jnp.float32)
    y, x, of_lens = rays.y.pixel.shape, rays.x.pixel.shape, (len(rays.y.start), *rays.parameters.shape)
    results = [like(*y), like(*y), like(*x), like(*x), like(*of_lens)]
    *by_axes, by_parameters = _call("rays_vjp", results, *_tables(shapes, rays), _pixels(shapes, image), volume)
    return *by_axes, by_parameters.sum(0)


def _tables(shapes, rays: Rays):
    axes = [part for axis in (rays.y, rays.x) for part in (axis.start, axis.pixel, axis.fraction, axis.distance2)]
    lenses, depths, _ = rays.y.pixel.shape
    for axis, voxels in zip((rays.y, rays.x), shapes.volume[1:], strict=True):
        of_rays = {axis.pixel.shape, axis.fraction.shape, axis.distance2.shape, (lenses, depths, axis.pixel.shape[2])}
        fit = len(of_rays) == 1 and 0 < axis.pixel.shape[2] <= voxels
        _require("of rays", fit and axis.start.shape in ((lenses, 1), (lenses, depths)), *axes)
    complete = len(rays.parameters) == depths == shapes.volume[0] and rays.parameters.shape[1] > 0
    _require("of rays", complete and min(shapes.image) >= 2 and shapes.image[1] >= WIDTH, rays.parameters)
    return weight_numbers(rays.weight), rays.parameters, *axes


def _pixels(shapes, image):
    """Pixels of a type that the kernels read; a single bool is an image of ones."""
    if image is None:
        return jnp.ones((), bool)
    _require("of rays", image.shape == shapes.image, image)
    return image if image.dtype in (jnp.uint8, jnp.uint16) else image.astype(jnp.float32)


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
    real, imaginary = jax.vmap(lambda kernel: kernel_spectrum(kernel, turns, turns))(kernels)
    strips = lambda part: part.reshape(len(kernels), -1, WIDTH, side).swapaxes(2, 3)
    spectra = jnp.stack([strips(real), strips(imaginary)], 2).reshape(len(kernels), 2 * side, side) / side**2
    plan = np.array([len(images), len(shapes), shift, (side - size + 1) // WIDTH * WIDTH], np.int32)
    results = [ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    return _call(name, results, plan, _turns(side), spectra, *images)


def _turns(side: int) -> np.ndarray:
    angles = 2 * np.pi * np.arange(side) / side
    return np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)


def read_windows(windows, places, image):
    start, fraction = _whole_places(places)
    _require("read_windows", image.shape == windows.shape, image)
    shape = windows.side, windows.side, len(start)
    return _call("read_windows", ShapeDtypeStruct(shape, jnp.float32), start, fraction, image)[..., : len(places[0])]


def add_windows(windows, places, values):
    _require("add_windows", values.shape == (windows.side, windows.side, len(places[0])), values)
    return _call(
        "add_windows", ShapeDtypeStruct(windows.shape, jnp.float32), *_whole_places(places), _whole_last_axis(values)
    )


def _whole_places(places):
    """Places of windows, of sixteen lenses, or several times as many: the last ones are beyond every image."""
    start, fraction = places
    _require("of windows", start.ndim == 2 and start.shape == fraction.shape == (len(start), 2), start, fraction)
    missing = [(0, -len(start) % WIDTH), (0, 0)]
    return jnp.pad(start, missing, constant_values=-1), jnp.pad(fraction, missing)


def _whole_last_axis(array):
    """An array with zeros at its end, so that its last axis is a multiple of sixteen."""
    return jnp.pad(array, [*[(0, 0)] * (array.ndim - 1), (0, -array.shape[-1] % WIDTH)])


def to_spectra(angles, table, x):
    lenses, whole = x.shape[1], _whole_last_axis(x)
    shape = 2 * (angles // 2 + 1), (len(table.rows.start) - 1) // angles, whole.shape[1]
    return _of_angles("to_spectra", angles, table.rows, len(x) == table.rows.columns, shape, whole)[..., :lenses]


def from_spectra(angles, table, y):
    lenses, whole, nodes = y.shape[2], _whole_last_axis(y), len(table.columns.start) - 1
    fit = y.shape[:2] == (2 * (angles // 2 + 1), table.columns.columns // angles)
    return _of_angles("from_spectra", angles, table.columns, fit, (nodes, whole.shape[2]), whole)[:, :lenses]


def _of_angles(kernel, angles, entries, fit, shape, x):
    # Places of entries are checked where tables are made.
    start, place, share = entries.start, entries.place, entries.share
    power = angles // 3 if angles % 3 == 0 else angles
    fit = fit and place.shape == share.shape and power >= 4 and power & (power - 1) == 0
    _require(kernel, fit, start, place, share, x)
    order = np.argsort(_frequencies(angles)).astype(np.int32)
    return _call(kernel, ShapeDtypeStruct(shape, jnp.float32), start, place, share, _turns(angles), order, x)


def add_products(_, constants, parts):
    (table, depth, excess), (total, x) = constants, map(_whole_last_axis, parts)
    tables = _product_tables("add_products", table, depth, excess, total, x)
    return _call("add_products", ShapeDtypeStruct(total.shape, jnp.float32), *tables, total, x)[..., : len(excess)]


def products_back(_, constants, y):
    (table, depth, excess), whole = constants, _whole_last_axis(y)
    result = ShapeDtypeStruct((len(y), table.shape[3] // 2, whole.shape[2]), jnp.float32)
    tables = _product_tables("products_back", table, depth, excess, whole, result)
    return y, _call("products_back", result, *tables, whole)[..., : len(excess)]


def _product_tables(kernel, table, depth, excess, image, x):
    (_, harmonics, blocks, columns, radii), excess = table.shape, _whole_last_axis(excess)
    fit = image.shape == (2 * harmonics, blocks * radii, len(excess)) and radii == spectra.ROWS
    fit = fit and x.shape == (2 * harmonics, columns // 2, len(excess)) and depth.dtype == jnp.int32
    _require(kernel, fit and depth.ndim == 0, table, excess, image, x)
    # The depth chooses rows of the table, which must exist.
    return table.reshape(-1, columns, radii), jnp.clip(depth, 0, len(table) - 1), excess


@cache
def _frequencies(side: int) -> np.ndarray:
    """The order of frequencies after transforms."""
    if side <= 2:
        return np.arange(side)
    radix = 3 if side % 3 == 0 else 4
    return (radix * _frequencies(side // radix)[None] + np.arange(radix)[:, None]).ravel()
