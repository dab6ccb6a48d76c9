"""Operators for other frameworks: SciPy (and PyLops, pyproximal), SCICO and deepinv.

The package does not install these; each function imports its framework when it is called.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np


def as_scipy(A: lx.AbstractLinearOperator) -> Any:
    """A `scipy.sparse.linalg.LinearOperator` between flat arrays; *host*.

    For SciPy's solvers (`lsmr`, `cg`, `svds`, ...), PyLops and pyproximal (`pylops.aslinearoperator`).

    Parameters
    ----------
    A
        `gs_jax.ImagingOperator`, or another operator from one array to one array.

    Examples
    --------
    >>> from gs_jax.interop import as_scipy
    >>> A = as_scipy(gs.ImagingOperator(scope, gs.Grid.over(scope.sensor, depths=[20.0], pitch=0.1)))
    >>> A.shape
    (40000, 1681)
    """
    from scipy.sparse.linalg import LinearOperator

    forward, adjoint, domain, image = _compile(A)
    to_numpy = lambda function, shape: lambda x: np.asarray(function(x.reshape(shape).astype(domain.dtype))).ravel()
    functions = {"matvec": to_numpy(forward, domain.shape), "rmatvec": to_numpy(adjoint, image.shape)}
    shape = math.prod(image.shape), math.prod(domain.shape)
    make: Any = LinearOperator  # SciPy's stubs only know its subclasses
    return make(shape, **functions, dtype=np.dtype(domain.dtype))


def as_scico(A: lx.AbstractLinearOperator) -> Any:
    """A `scico.linop.LinearOperator`, on JAX arrays; *differentiable*. Parameters as for `as_scipy`."""
    from scico.linop import LinearOperator  # pyright: ignore[reportMissingImports]

    forward, adjoint, domain, image = _compile(A)
    types = {"input_dtype": domain.dtype, "output_dtype": image.dtype}
    return LinearOperator(domain.shape, image.shape, eval_fn=forward, adj_fn=adjoint, jit=False, **types)


def as_deepinv(A: lx.AbstractLinearOperator) -> Any:
    """A `deepinv.physics.LinearPhysics` between batches `(batch, channel, ...)` of PyTorch tensors.

    Tensors and arrays share their memory (DLPack). PyTorch's gradients by `x` and `y` use the adjoint and the operator;
    there are none by the geometry. Parameters as for `as_scipy`.
    """
    import torch  # pyright: ignore[reportMissingImports]
    from deepinv.physics import LinearPhysics  # pyright: ignore[reportMissingImports]

    apply, apply_adjoint, domain, image = _compile(A)

    def batched(function, shape):
        over = jax.jit(jax.vmap(function))

        def call(tensor):
            flat = tensor.detach().contiguous().reshape(-1, *shape)
            result = torch.from_dlpack(over(jnp.from_dlpack(flat).astype(domain.dtype)))
            return result.reshape(*tensor.shape[: tensor.ndim - len(shape)], *result.shape[1:]).to(tensor.dtype)

        return call

    forward, adjoint = batched(apply, domain.shape), batched(apply_adjoint, image.shape)

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


def _compile(A):
    """Compiled functions `mv` and `T.mv`, with the operator as an argument, not a constant; input and output."""
    forward, adjoint = eqx.filter_jit(lambda A, x: A.mv(x)), eqx.filter_jit(lambda A, y: A.T.mv(y))
    return (lambda x: forward(A, x)), (lambda y: adjoint(A, y)), A.in_structure(), A.out_structure()
