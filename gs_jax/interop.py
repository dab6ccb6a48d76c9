"""Operators of this package for other frameworks: SciPy (and PyLops, pyproximal), SCICO and deepinv.

None of these is installed with the package; each function imports its own when it is called.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np


def as_scipy(A: lx.AbstractLinearOperator) -> Any:
    """An operator for `scipy.sparse.linalg`, between flat arrays; *host*.

    Its solvers (`lsmr`, `cg`, `svds`, ...) take it, and so do PyLops and pyproximal (`pylops.aslinearoperator`).

    Parameters
    ----------
    A
        `gs_jax.ImagingOperator`, or another from one array to one array.

    Examples
    --------
    >>> import gs_jax as gs
    >>> from gs_jax.interop import as_scipy
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> A = as_scipy(gs.ImagingOperator(scope, gs.Grid.over(scope.sensor, depths=[20.0], pitch=0.1)))
    >>> A.shape
    (40000, 1681)
    """
    from scipy.sparse.linalg import LinearOperator

    there, back, into, out = _both_ways(A)
    to_numpy = lambda function, shape: lambda flat: np.asarray(function(flat.reshape(shape).astype(into.dtype))).ravel()
    matvec, rmatvec = to_numpy(there, into.shape), to_numpy(back, out.shape)
    # SciPy's stubs know the class that is subclassed, not the call that makes one of functions.
    of_functions: Any = LinearOperator
    return of_functions((_size(out), _size(into)), matvec=matvec, rmatvec=rmatvec, dtype=np.dtype(into.dtype))


def as_scico(A: lx.AbstractLinearOperator) -> Any:
    """An operator for SCICO, whose arrays are JAX's; *differentiable*. Parameters as of `as_scipy`."""
    from scico.linop import LinearOperator  # pyright: ignore[reportMissingImports]

    there, back, into, out = _both_ways(A)
    types = {"input_dtype": into.dtype, "output_dtype": out.dtype}
    return LinearOperator(into.shape, out.shape, eval_fn=there, adj_fn=back, jit=False, **types)


def as_deepinv(A: lx.AbstractLinearOperator) -> Any:
    """A `LinearPhysics` of deepinv, between batches `(batch, channel, ...)` of PyTorch's tensors.

    Tensors and arrays share their memory (DLPack). PyTorch's gradients by `x` and `y` are those by the adjoint and the
    operator; there are none by the geometry. Parameters as of `as_scipy`.
    """
    import torch  # pyright: ignore[reportMissingImports]
    from deepinv.physics import LinearPhysics  # pyright: ignore[reportMissingImports]

    there, back, into, out = _both_ways(A)

    def batched(function, shape):
        over = jax.jit(jax.vmap(function))

        def call(tensor):
            flat = tensor.detach().contiguous().reshape(-1, *shape)
            found = torch.from_dlpack(over(jnp.from_dlpack(flat).astype(into.dtype)))
            return found.reshape(*tensor.shape[: tensor.ndim - len(shape)], *found.shape[1:]).to(tensor.dtype)

        return call

    forward, adjoint = batched(there, into.shape), batched(back, out.shape)

    def differentiable(function, transposed):
        class Linear(torch.autograd.Function):
            @staticmethod
            def forward(ctx, x):  # pyright: ignore[reportIncompatibleMethodOverride]
                return function(x)

            @staticmethod
            def backward(ctx, y):  # pyright: ignore[reportIncompatibleMethodOverride]
                return transposed(y)

        return lambda x, **_: Linear.apply(x)

    return LinearPhysics(A=differentiable(forward, adjoint), A_adjoint=differentiable(adjoint, forward))


def _both_ways(A):
    """Compiled functions there and back, and what they take; the operator's numbers are no constants in them."""
    there, back = eqx.filter_jit(lambda A, x: A.mv(x)), eqx.filter_jit(lambda A, y: A.T.mv(y))
    return (lambda x: there(A, x)), (lambda y: back(A, y)), A.in_structure(), A.out_structure()


def _size(structure: jax.ShapeDtypeStruct) -> int:
    return math.prod(structure.shape)
