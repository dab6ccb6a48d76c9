"""Linear maps with hand-written transposes and derivatives: a JAX primitive with a form for each platform.

CPUs run compiled kernels where there are any, GPUs and TPUs a form without loops over lenses. NVIDIA's GPUs may have a
form of their own.
"""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import tree
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from ..base.arrays import native

# Kernels read sixteen pixels of a row at once.
_LEAST_COLUMNS = 16


@dataclass(frozen=True)
class LinearMap:
    """A function that is linear in its last argument, with a given transpose and given derivatives.

    It works under `jit`, `vmap`, `jvp`, `grad` and `jax.linear_transpose`, hence in `lineax` operators and solvers.
    JAX derives second derivatives from the given functions. This is a primitive because `jax.custom_vjp` has neither
    `jvp` nor a transpose, and `jax.custom_derivatives.linear_call` neither `vmap` nor derivatives by the constants.

    Parameters
    ----------
    function
        `function(static, constants, x)`: `static` is hashable (shapes), `constants` and `x` are pytrees of arrays.
    transpose
        `transpose(static, constants, y)`, with `y` like the function's result, returns a pytree like `x`.
    constants_vjp
        `constants_vjp(static, constants, x, y)`: the gradient of `<y, function(static, constants, x)>` with respect to
        the constants. Its leaves at integer constants are ignored. None: JAX derives it.
    kernels
        Replace `function` and `transpose` on a CPU in float32: functions without arguments, called when a program is
        compiled, that return these, or None where there is no kernel.
    accelerated
        Functions that replace `function` and `transpose` on GPUs and TPUs, but not in second derivatives. None: the
        same as on CPUs.
    cuda
        Functions that replace those of `accelerated` on NVIDIA's GPUs. None: the same.
    """

    function: Callable
    transpose: Callable
    constants_vjp: Callable | None = None
    kernels: tuple[Callable | None, ...] = (None, None)
    accelerated: tuple[Callable | None, ...] = (None, None)
    cuda: tuple[Callable | None, ...] = (None, None)

    def __call__(self, static: Hashable, constants: PyTree, x: PyTree) -> PyTree:
        flat_constants, constants_tree = tree.flatten(constants)
        flat_x, x_tree = tree.flatten(x)
        y_tree = tree.structure(jax.eval_shape(lambda c, x: self.function(static, c, x), constants, x))
        call = _Call(self, static, constants_tree, x_tree, y_tree)
        return y_tree.unflatten(_linear.bind(*flat_constants, *flat_x, call=call))

    @property
    def T(self) -> "LinearMap":
        """The transpose."""
        vjp = self.constants_vjp
        # A transpose of a transpose equals the map, whose compiled programs serve it.
        vjp = vjp.constants_vjp if isinstance(vjp, _Swapped) else vjp and _Swapped(vjp)
        swapped = (forms[::-1] for forms in (self.kernels, self.accelerated, self.cuda))
        return LinearMap(self.transpose, self.function, vjp, *swapped)


@dataclass(frozen=True)
class _Swapped:
    """`constants_vjp` of the transpose: `<y, A x>` is `<A' y, x>`."""

    constants_vjp: Callable

    def __call__(self, static, constants, y, x):
        return self.constants_vjp(static, constants, x, y)


@dataclass(frozen=True)
class _Call:
    """A map and all its arguments but the arrays, which are the flat `(*constants, *x)`."""

    map: LinearMap
    static: Hashable
    constants_tree: Any
    x_tree: Any
    y_tree: Any

    def __call__(self, *arrays, function=None):
        constants, x = self.split(arrays)
        arguments = self.constants_tree.unflatten(constants), self.x_tree.unflatten(x)
        return tree.leaves((function or self.map.function)(self.static, *arguments))

    def split(self, arrays):
        count = self.constants_tree.num_leaves
        return arrays[:count], arrays[count:]


_linear = Primitive("gs_jax_linear")
_linear.multiple_results = True
_run = jax.jit(lambda call, *arrays: _linear.bind(*arrays, call=call), static_argnums=0)


@_linear.def_impl
def _run_eagerly(*arrays, call):
    # As JAX's own primitives, also with `JAX_DISABLE_JIT`: not compiled, it would call itself.
    with jax.disable_jit(False):
        return _run(call, *native(arrays))


@_linear.def_abstract_eval
def _shapes(*arrays, call):
    double: Any = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    return _shapes_of(double, call, *(ShapedArray(a.shape, a.dtype) for a in arrays))


# Lowering asks for them again. Their types depend on `double`.
@lru_cache(maxsize=256)
def _shapes_of(double, call, *arrays):
    return [ShapedArray(s.shape, s.dtype) for s in jax.eval_shape(call, *arrays)]


def _jvp(primals, tangents, *, call):
    constants, _ = call.split(primals)
    constants_dot, x_dot = call.split(tangents)
    y = _linear.bind(*primals, call=call)
    terms = []
    if any(type(t) is not ad.Zero for t in x_dot):
        terms.append(_linear.bind(*constants, *map(ad.instantiate_zeros, x_dot), call=call))
    moving = tuple(i for i, t in enumerate(constants_dot) if type(t) is not ad.Zero)
    if moving:
        dots = [constants_dot[i] for i in moving]
        derivative = _derivative if call.map.constants_vjp else _by_constants
        terms.append(derivative((call, moving), primals, dots))
    return y, [sum(term[1:], term[0]) for term in zip(*terms, strict=True)]


def _by_constants(static, primals, dots, function=None):
    call, moving = static

    def move(values):
        arrays = list(primals)
        for i, value in zip(moving, values, strict=True):
            arrays[i] = value
        return call(*arrays, function=function)

    return jax.jvp(move, ([primals[i] for i in moving],), (list(dots),))[1]


def _by_constants_accelerated(static, primals, dots):
    return _by_constants(static, primals, dots, static[0].map.accelerated[0])


def _by_constants_transpose(static, primals, y):
    call, moving = static
    constants, x = call.split(primals)
    gradient = call.map.constants_vjp(
        call.static, call.constants_tree.unflatten(constants), call.x_tree.unflatten(x), call.y_tree.unflatten(y)
    )
    return [tree.leaves(gradient)[i] for i in moving]


_derivative = LinearMap(_by_constants, _by_constants_transpose, accelerated=(_by_constants_accelerated, None))


def _transpose(y, *arrays, call):
    constants, _ = call.split(arrays)
    transposed = replace(call, map=call.map.T, x_tree=call.y_tree, y_tree=call.x_tree)
    return [None] * len(constants) + _linear.bind(*constants, *map(ad.instantiate_zeros, y), call=transposed)


def _batch(arrays, axes, *, call):
    mapped = [jnp.moveaxis(a, axis, 0) for a, axis in zip(arrays, axes, strict=True) if axis is not None]

    def one(mapped):
        rest = iter(mapped)
        return _linear.bind(*(a if x is None else next(rest) for a, x in zip(arrays, axes, strict=True)), call=call)

    # One after the other: each call uses the whole machine, and a batch of calls would need a batch of buffers.
    y = jax.lax.map(one, mapped)
    return y, [0] * len(y)


def _run_on(platform, *arrays, call):
    """On a CPU uses a compiled kernel in float32; float64 is for comparisons."""
    platform = _form.get() or platform if platform == "cpu" else platform
    if platform in ("cuda", "accelerated"):
        function = call.map.cuda[0] if platform == "cuda" else None
        return call(*arrays, function=function or call.map.accelerated[0])
    load = None if platform == "xla" or jax.default_backend() != "cpu" else call.map.kernels[0]
    if load is None:
        return call(*arrays)
    _, x = call.split(arrays)
    single = {y.dtype for y in _shapes(*arrays, call=call)} == {jnp.dtype(jnp.float32)}
    # Of images; the rows of other arrays are long enough.
    columns = getattr(call.static, "image", (0, _LEAST_COLUMNS))[1]
    suitable = single and all(a.dtype != jnp.float64 for a in x) and columns >= _LEAST_COLUMNS
    return call(*arrays, function=load() if suitable else None)


def _lowering(platform):
    return mlir.lower_fun(partial(_run_on, platform), multiple_results=True)


mlir.register_lowering(_linear, _lowering("accelerated"))
mlir.register_lowering(_linear, _lowering("cpu"), platform="cpu")
mlir.register_lowering(_linear, _lowering("cuda"), platform="cuda")
ad.primitive_jvps[_linear] = _jvp
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batch

_form: ContextVar[str | None] = ContextVar("form", default=None)


@contextmanager
def compiled_for_cpu(form: Literal["xla", "accelerated", "cuda"]) -> Iterator[None]:
    """How CPUs run what is compiled within this context.

    `"xla"`: without kernels; for a single call that is faster than to import numba. `"accelerated"` and `"cuda"`: as
    TPUs and NVIDIA's GPUs do, for tests: that is far slower.
    """
    token = _form.set(form)
    try:
        yield
    finally:
        _form.reset(token)
