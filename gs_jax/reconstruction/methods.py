"""Every way from an image to a volume, by name and with one signature."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Num

from ..geometry import Grid, Imager
from ..projection.backprojection import backproject
from ..projection.forward_model import forward
from ..solvers.admm import admm
from ..solvers.fista import fista
from ..solvers.iteration import Callback, Solution, as_image
from ..solvers.richardson_lucy import list_richardson_lucy, richardson_lucy

# Weight of the sum of voxels, in parts of the least weight that would leave nothing but darkness.
_SPARSITY = 0.01

Solver = Callable[..., Solution]


def forward_operator(
    imager: Imager, grid: Grid, psf: Float[Array | np.ndarray, "plane tall wide"]
) -> lx.AbstractLinearOperator:
    """`forward` with its PSF as a `lineax` operator, volume to image; build it inside the jitted function."""
    volume = jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, psf), volume)


def _sparse(solver, A, image, **options):
    image = as_image(A, image)
    weight = _SPARSITY * jnp.max(A.T.mv(image))
    return solver(A, image, l1=jnp.maximum(weight, 0), **options)


SOLVERS: dict[str, Solver] = {
    "richardson-lucy": richardson_lucy,
    "admm": partial(_sparse, admm),
    "fista": partial(_sparse, fista),
}
METHODS = ("backproject", "list-rl", *SOLVERS)


@partial(jax.jit, static_argnames=("method", "steps", "tolerance", "callback"))
def reconstruct(
    image: Num[Array | np.ndarray, "row column"],
    imager: Imager,
    grid: Grid,
    psf: Float[Array | np.ndarray, "plane tall wide"],
    *,
    method: str,
    steps: int = 50,
    tolerance: float = 0.0,
    callback: Callback | None = None,
) -> Float[Array, "depth y x"]:
    """A volume by one of `METHODS`.

    Parameters
    ----------
    image, imager, grid, psf
        As for `forward`; `backproject` and `list-rl` make no use of the PSF.
    method
        One of `METHODS`.
    steps, tolerance, callback
        As for `iterate`; `backproject` takes none.

    Raises
    ------
    ValueError
        If there is no such method, or a shape is wrong.
    """
    options: dict[str, Any] = dict(steps=steps, tolerance=tolerance, callback=callback)
    image = jnp.asarray(image)
    if method == "backproject":
        return backproject(image, imager, grid)
    if method == "list-rl":
        return list_richardson_lucy(image, imager, grid, **options).x
    if method not in SOLVERS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}.")
    return SOLVERS[method](forward_operator(imager, grid, psf), image, **options).x
