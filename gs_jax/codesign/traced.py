"""A function of one's own as a pytree: traced once, with its numbers as leaves.

`jax.jit` finds a compiled program again by the function and by the structure of its arguments. A loss that is written
as a lambda is another function in each run of its cell, and the arrays and numbers that it mentions are constants of
its program. `Traced` finds the program again by its operations, and takes the numbers as arguments.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.dtypes import float0
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, gensym, jaxpr_as_fun
from jaxtyping import Array, PyTree

_CUSTOM = ("custom_jvp_call", "custom_vjp_call")
_UNKNOWN = DebugInfo("one equation", "unknown", (), None)


class _Program:
    """Operations of a function, and the structure of what it returns; equal to those of any function alike."""

    def __init__(self, jaxpr: Jaxpr, out: Any):
        self.jaxpr, self.out, self.key = jaxpr, out, (_key(jaxpr), out)
        self.hash = hash(self.key)

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Program) and self.key == other.key


class Traced(eqx.Module):
    """A function that was traced, `Traced.of(function, *examples)`, for arguments of these shapes.

    `numbers`: the arrays that the function mentions, and its floating-point constants.
    """

    numbers: list[Array]
    program: _Program = eqx.field(static=True)

    @classmethod
    def of(cls, function: Callable[..., PyTree[Array]], *examples: PyTree) -> "Traced":
        """Trace a function once; its arguments and what it returns are arrays, or pytrees of them."""
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
        jaxpr, numbers = _with_numbers_as_arguments(closed)
        return cls(numbers, _Program(jaxpr, jax.tree.structure(shapes)))

    @property
    def dtypes(self) -> list[np.dtype]:
        """Types of the arrays that the function returns."""
        return [_aval(x).dtype for x in self.program.jaxpr.outvars]

    def __call__(self, *args: PyTree) -> PyTree[Array]:
        closed = ClosedJaxpr(self.program.jaxpr, self.numbers)
        return jax.tree.unflatten(self.program.out, jaxpr_as_fun(closed)(*jax.tree.leaves(args)))


def _aval(x) -> Any:
    """Shape and type of a variable, which JAX annotates more widely."""
    return x.aval


def _with_numbers_as_arguments(closed: ClosedJaxpr) -> tuple[Jaxpr, list[Array]]:
    variable, variables, numbers = gensym(), list(closed.jaxpr.constvars), list(map(jnp.asarray, closed.consts))

    def atom(x):
        if not (isinstance(x, Literal) and jnp.issubdtype(_aval(x).dtype, jnp.floating)):
            return x
        variables.append(variable(x.aval))
        numbers.append(jnp.asarray(np.asarray(x.val, _aval(x).dtype)))
        return variables[-1]

    equations = [equation.replace(invars=list(map(atom, equation.invars))) for equation in closed.jaxpr.eqns]
    return closed.jaxpr.replace(constvars=variables, eqns=equations), numbers


def _key(jaxpr: Jaxpr, derivatives: bool = True) -> tuple:
    """All of a jaxpr but the names of its variables; with the derivatives that functions define for themselves."""
    number = {}

    def atom(x):
        return x.aval, np.asarray(x.val).tobytes() if isinstance(x, Literal) else number.setdefault(x, len(number))

    def parameters(equation):
        if equation.primitive.name in _CUSTOM:
            own = equation.params["call_jaxpr"], _derivative(equation) if derivatives else ()
            return tuple(_parameter(value, False) for value in own)
        return tuple((name, _parameter(value, derivatives)) for name, value in sorted(equation.params.items()))

    inputs = tuple(map(atom, (*jaxpr.constvars, *jaxpr.invars)))
    equations = tuple((e.primitive, *map(atom, (*e.invars, *e.outvars)), parameters(e)) for e in jaxpr.eqns)
    return inputs, equations, tuple(map(atom, jaxpr.outvars))


def _derivative(equation: JaxprEqn) -> ClosedJaxpr:
    """Operations of an equation's derivative: JAX keeps its function, which is another object in each trace."""
    variables = list(dict.fromkeys(x for x in equation.invars if not isinstance(x, Literal)))
    function = jaxpr_as_fun(ClosedJaxpr(Jaxpr([], variables, equation.outvars, [equation], debug_info=_UNKNOWN), ()))

    def derivative(*values):
        out, transpose = jax.vjp(function, *values)
        slopes = transpose([jnp.ones_like(x) if eqx.is_inexact_array(x) else np.zeros(x.shape, float0) for x in out])
        return out, [slope for slope in slopes if slope.dtype != float0]

    return jax.make_jaxpr(derivative)(*(jax.ShapeDtypeStruct(_aval(x).shape, _aval(x).dtype) for x in variables))


class _Unhashable:
    """A parameter that is equal to nothing but itself; kept, as its identity is another object's after its end."""

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Unhashable) and self.value is other.value


def _parameter(value: Any, derivatives: bool) -> Any:
    if isinstance(value, ClosedJaxpr):
        consts = ((x.dtype.str, x.shape, x.tobytes()) for x in map(np.asarray, value.consts))
        return _key(value.jaxpr, derivatives), tuple(consts)
    if isinstance(value, Jaxpr):
        return _key(value, derivatives)
    if isinstance(value, tuple | list):
        return tuple(_parameter(part, derivatives) for part in value)
    try:
        hash(value)
    except TypeError:
        return _Unhashable(value)
    return value
