"""On a processor by compiled kernels, where these are at hand; by XLA everywhere else."""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial, wraps
from importlib.util import find_spec
from threading import Lock

import jax
import jax.numpy as jnp
import numpy as np
from jax import ShapeDtypeStruct, lax

from ...geometry import FALLOFF, field_limit
from ..rays import Envelope, Rays

# Parts of a kernel's work, for threads to share: the more, the more evenly, and the more is done twice at their edges.
_PARTS = min(max(8 * (os.cpu_count() or 1), 16), 64)
# Numbers that kernels handle at once.
WIDTH = 16
# As which XLA knows the handler.
TARGET = "gs_jax_native"
_lock = Lock()
_once = ContextVar("once", default=False)


@contextmanager
def once() -> Iterator[None]:
    """Around a program that back-projects a single time: XLA is done with it before Numba is loaded."""
    token = _once.set(True)
    try:
        yield
    finally:
        _once.reset(token)


def native_on_cpu(kernel: str, native: Callable) -> Callable[[Callable], Callable]:
    """Let `native`, which calls a kernel, do on processors what the decorated function does, if it can.

    Both take static shapes and pytrees of arrays. Derivatives are those of the decorated function, `__wrapped__`.
    """

    def decorate(function):
        @partial(jax.custom_jvp, nondiff_argnums=(0,))
        def fast(shapes, *arrays):
            return lax.platform_dependent(*arrays, cpu=partial(native, shapes), default=partial(function, shapes))

        @fast.defjvp
        def _(shapes, arrays, tangents):
            return jax.jvp(partial(function, shapes), arrays, tangents)

        @wraps(function)
        def either(shapes, *arrays):
            use = _suits(shapes, arrays) and kernel_number(kernel) is not None
            return (fast if use else function)(shapes, *arrays)

        return either

    return decorate


def gather(shapes, rays: Rays, image):
    """`bilinear._gather`."""
    volume = ShapeDtypeStruct(shapes.volume, jnp.float32)
    return _call("gather", volume, shapes, rays, _pixels(image))


def scatter(shapes, rays: Rays, volume):
    """`bilinear._scatter`."""
    return _call("scatter", ShapeDtypeStruct(shapes.image, jnp.float32), shapes, rays, volume)


def rays_bar(shapes, rays: Rays, image, volume) -> Rays:
    """`bilinear._rays_bar`."""
    like = lambda array: ShapeDtypeStruct(array.shape, jnp.float32)
    of_lens = ShapeDtypeStruct((len(rays.y.start), *rays.parameters.shape), jnp.float32)
    results = [like(rays.y.pixel), like(rays.y.pixel), like(rays.x.pixel), like(rays.x.pixel), of_lens]
    *bars, parameters_bar = _call("rays_bar", results, shapes, rays, _pixels(image), volume)
    zero = jax.tree.map(jnp.zeros_like, rays)
    return zero._replace(
        y=zero.y._replace(fraction=bars[0], distance2=bars[1]),
        x=zero.x._replace(fraction=bars[2], distance2=bars[3]),
        parameters=parameters_bar.sum(0),
    )


def _suits(shapes, arrays) -> bool:
    # Float64 is for those who compare.
    first = arrays[0].parameters if isinstance(arrays[0], Rays) else arrays[0]
    single = first.dtype == jnp.float32 and all(a.dtype != jnp.float64 for a in jax.tree.leaves(arrays[1:]))
    return jax.default_backend() == "cpu" and single and shapes.image[1] >= WIDTH and not _once.get()


def kernel_number(name: str) -> int | None:
    """By which the handler knows a kernel; None where there is no numba, or where it does not work, with a warning."""
    with _lock:
        return _load(name)


@cache
def _load(name):
    if find_spec("numba") is None:  # as for a Python that is too new for it
        return None
    try:
        from . import ffi as bridge

        return bridge.number(name)
    # Of numba, llvmlite or XLA, which may be too new, or nowhere to keep what is compiled: XLA does without all that.
    except Exception as error:
        _warn(f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}")
        return None


@cache
def _warn(reason):
    text = f"numba's kernels do not work, XLA is used instead, which is slower: {reason}"
    warnings.warn(text, RuntimeWarning, stacklevel=2)


def call(kernel: str, results, *buffers):
    """A kernel's results, each of at most three axes as the buffers are."""
    number = np.array(kernel_number(kernel), np.int64)[()]
    return jax.ffi.ffi_call(TARGET, results)(*buffers, kernel=number, parts=np.int64(_PARTS))


def _call(kernel, results, shapes, rays: Rays, *arrays):
    axes = [part for axis in (rays.y, rays.x) for part in (axis.start, axis.pixel, axis.fraction, axis.distance2)]
    return call(kernel, results, _numbers(shapes.weight), rays.parameters, *axes, *arrays)


def _pixels(image):
    """Pixels of a type that the kernels read; a single bool is an image of ones."""
    if image is None:
        return jnp.ones((), bool)
    return image if image.dtype in (jnp.uint8, jnp.uint16) else image.astype(jnp.float32)


def _numbers(weight):
    """The kind of a weight, its limit and the slope of its falloff, those of its hole (or zero), and its scale."""
    falloff = lambda radius: (field_limit(radius) ** 2, 1 / (2 * FALLOFF * radius**2)) if radius else (0, 0)
    if isinstance(weight, Envelope):
        numbers = (0, *falloff(weight.field_radius), 0, 0, 0)
    else:
        numbers = (1, *falloff(weight.outer), *falloff(weight.inner), 1 / weight.outer**2)
    return jnp.asarray(numbers, jnp.float32)
