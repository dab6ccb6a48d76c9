"""Linear functions whose derivatives are written by hand."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import tree
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree


def linear_call(
    function: Callable,
    transpose: Callable,
    constants_bar: Callable | None,
    static: Hashable,
    constants: PyTree,
    x: PyTree,
) -> PyTree:
    """`function(static, constants, x)`, linear in `x`, with derivatives that are given instead of derived.

    It works under `jit`, `vmap`, `jvp`, `grad` and `jax.linear_transpose`, hence as a `lineax` operator and through its
    solvers. First derivatives are the given functions; of second ones by the constants, the part that these do not give
    is what JAX derives of them. `jax.custom_vjp` has neither `jvp` nor a transpose,
    `jax.custom_derivatives.linear_call` neither `vmap` nor derivatives by the constants; so this is a primitive.

    Parameters
    ----------
    function
        Linear in its last argument.
    transpose
        `transpose(static, constants, y)`, with `y` like what `function` returns, returns what is like `x`.
    constants_bar
        `constants_bar(static, constants, x, y)`: the derivative of `<y, function(static, constants, x)>` by the
        constants, like them; what stands at integers is ignored. If None, JAX derives it.
    static
        Hashable; shapes and the like.
    constants, x
        Pytrees of arrays.
    """
    flat_constants, constants_tree = tree.flatten(constants)
    flat_x, x_tree = tree.flatten(x)
    y_tree = tree.structure(jax.eval_shape(lambda c, x: function(static, c, x), constants, x))
    call = _Call(function, transpose, constants_bar, static, constants_tree, x_tree, y_tree)
    return y_tree.unflatten(_linear.bind(*flat_constants, *flat_x, call=call))


@dataclass(frozen=True)
class _Call:
    """All of a call but its arrays, which are `(*constants, *x)`, flat."""

    function: Callable
    transpose: Callable
    constants_bar: Callable | None
    static: Hashable
    constants_tree: Any
    x_tree: Any
    y_tree: Any

    def __call__(self, *arrays):
        constants, x = self.split(arrays)
        return tree.leaves(
            self.function(self.static, self.constants_tree.unflatten(constants), self.x_tree.unflatten(x))
        )

    def split(self, arrays):
        count = self.constants_tree.num_leaves
        return arrays[:count], arrays[count:]

    def transposed(self):
        bar = self.constants_bar and _Swapped(self.constants_bar)
        return replace(
            self,
            function=self.transpose,
            transpose=self.function,
            constants_bar=bar,
            x_tree=self.y_tree,
            y_tree=self.x_tree,
        )


@dataclass(frozen=True)
class _Swapped:
    """`constants_bar` of the transpose: `<y, A x>` is `<A' y, x>`."""

    constants_bar: Callable

    def __call__(self, static, constants, y, x):
        return self.constants_bar(static, constants, x, y)


_linear = Primitive("gs_jax_linear")
_linear.multiple_results = True


@_linear.def_impl
def _run(*arrays, call):
    return jax.jit(call)(*arrays)


@_linear.def_abstract_eval
def _shapes(*arrays, call):
    shapes = jax.eval_shape(call, *(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in arrays))
    return [ShapedArray(s.shape, s.dtype) for s in shapes]


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
        if call.constants_bar is None:
            terms.append(_by_constants((call, moving), primals, dots))
        else:
            terms.append(linear_call(_by_constants, _by_constants_transpose, None, (call, moving), primals, dots))
    return y, [sum(term[1:], term[0]) for term in zip(*terms, strict=True)]


def _by_constants(static, primals, dots):
    call, moving = static

    def move(values):
        arrays = list(primals)
        for i, value in zip(moving, values, strict=True):
            arrays[i] = value
        return call(*arrays)

    return jax.jvp(move, ([primals[i] for i in moving],), (list(dots),))[1]


def _by_constants_transpose(static, primals, y):
    call, moving = static
    constants, x = call.split(primals)
    bar = call.constants_bar(
        call.static, call.constants_tree.unflatten(constants), call.x_tree.unflatten(x), call.y_tree.unflatten(y)
    )
    return [tree.leaves(bar)[i] for i in moving]


def _transpose(y, *arrays, call):
    constants, _ = call.split(arrays)
    x = _linear.bind(*constants, *map(ad.instantiate_zeros, y), call=call.transposed())
    return [None] * len(constants) + x


def _batch(arrays, axes, *, call):
    mapped = [jnp.moveaxis(a, axis, 0) for a, axis in zip(arrays, axes, strict=True) if axis is not None]

    def one(mapped):
        rest = iter(mapped)
        return _linear.bind(*(a if x is None else next(rest) for a, x in zip(arrays, axes, strict=True)), call=call)

    # One after the other: each call fills the machine, and a batch of them would need a batch of buffers.
    y = jax.lax.map(one, mapped)
    return y, [0] * len(y)


mlir.register_lowering(_linear, mlir.lower_fun(lambda *arrays, call: call(*arrays), multiple_results=True))
ad.primitive_jvps[_linear] = _jvp
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batch
