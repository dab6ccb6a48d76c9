"""Richardson-Lucy deconvolution, for any operator without negative entries.

Richardson, J. Opt. Soc. Am. 62, 55 (1972); Lucy, Astron. J. 79, 745 (1974). Each step multiplies the estimate by the
back-projected ratio of the image to what the estimate would give, and so climbs the likelihood of Poisson counts.
"""

import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.safe import divide
from ..geometry import Grid, Imager
from ..layouts.cells import Real
from ..projection.operators import ray_operator
from .iteration import Callback, Solution, as_image, iterate, norm
from .total_variation import differences, differences_adjoint, magnitude

# The most that total variation may hold back a voxel in one step: Dey's denominator must stay positive.
_LEAST_DENOMINATOR = 0.1
# In units of the type's precision, relative to the largest sensitivity.
_ROUNDING = 100


def richardson_lucy(
    A: lx.AbstractLinearOperator,
    image: Num[Array | np.ndarray, "..."],
    *,
    steps: int,
    tolerance: float = 0.0,
    background: Real | Float[Array, "..."] = 0.0,
    accelerate: bool = False,
    tv: Real = 0.0,
    callback: Callback | None = None,
) -> Solution:
    """Richardson-Lucy: `x <- x A'(image / (A x + background)) / A'1`, from a uniform start.

    The cost is the Kullback-Leibler divergence of the image from `A x + background`. Without total variation,
    `tolerance=0` is differentiable with respect to the image and whatever `A` holds.

    Parameters
    ----------
    A
        From a volume to an image; its entries must not be negative, and need no normalisation.
    image
        Negative pixels (read noise) count as 0.
    steps, tolerance, callback
        As for `iterate`; the residual is the relative change of `x`.
    background
        Light that comes from no voxel: a number or an image.
    accelerate
        Extrapolate along the last change before each step, by the ratio of the last two steps' products (Biggs and
        Andrews, Appl. Opt. 36, 1766, 1997): many times fewer steps, not monotone.
    tv
        Weight of total variation, about 1e-3 to 1e-2 (Dey et al., Microsc. Res. Tech. 69, 260, 2006): the step is
        divided by `1 - tv div(grad x / |grad x|)`.

    Returns
    -------
    Solution
        `x` is 0 in voxels that no pixel sees. A dark image gives zeros.

    Raises
    ------
    ValueError
        If the image is not of the operator's output shape, or a number is out of range.
    """
    image = jnp.maximum(as_image(A, image), 0)
    sensitivity = _without_rounding(A.T.mv(jnp.ones_like(image)))
    background = jnp.asarray(background, image.dtype)
    # The scale of the start does not matter without a background; this one has the image's light.
    level = divide(jnp.sum(image), jnp.sum(sensitivity))
    start = jnp.where(sensitivity > 0, level, 0)

    def step(state):
        x, last, product, gain = state
        point = jnp.maximum(x + gain * (x - last), 0) if accelerate else x
        expected = A.mv(point) + background
        # An FFT's rounding must not turn a dark pixel into a huge ratio.
        ratio = divide(image, expected, jnp.finfo(image.dtype).eps * lax.stop_gradient(expected.max()))
        scale = sensitivity * _hold(point, tv) if tv else sensitivity
        new = divide(point * jnp.maximum(A.T.mv(ratio), 0), scale)
        next_product = new - point
        if accelerate:
            gain = jnp.clip(divide(jnp.vdot(next_product, product), jnp.vdot(product, product)), 0, 1)
        residual = divide(norm(new - x), norm(new))
        return (new, x, next_product, gain), divergence(image, expected), residual

    first = start, start, jnp.zeros_like(start), jnp.zeros((), start.dtype)
    (x, *_), *history = iterate(step, first, steps=steps, tolerance=tolerance, callback=callback)
    return Solution(x, *history)


def list_richardson_lucy(
    image: Num[Array | np.ndarray, "row column"], imager: Imager, grid: Grid, *, steps: int, **options
) -> Solution:
    """Richardson-Lucy on the pixel-voxel lists of back-projection: no PSF, so as local as `backproject`.

    Each voxel is multiplied by the mean ratio, weighted by the envelope, over the pixels that back-projection would
    read: it is `richardson_lucy` with the ray operator, whose `A'(ratio) / A'1` is
    `backproject(ratio, ..., normalize=True)`.

    Parameters
    ----------
    image, imager, grid
        As for `backproject`.
    steps, **options
        As for `richardson_lucy`.
    """
    return richardson_lucy(ray_operator(imager, grid), image, steps=steps, **options)


def divergence(image: Float[Array, "*shape"], expected: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Kullback-Leibler divergence of counts `b` from what was expected, `sum(e - b + b log(b / e))`."""
    both = (image > 0) & (expected > 0)
    log = jnp.log(jnp.where(both, image, 1) / jnp.where(both, expected, 1))
    return jnp.sum(expected - image + jnp.where(both, image * log, 0))


def _without_rounding(sensitivity):
    """What an FFT leaves in voxels that no pixel sees is taken for 0: rounding over rounding would grow without end."""
    least = _ROUNDING * jnp.finfo(sensitivity.dtype).eps * lax.stop_gradient(sensitivity.max())
    return jnp.where(sensitivity > least, sensitivity, 0)


def _hold(x, tv):
    u = differences(x, wrap=False)
    curvature = differences_adjoint(divide(u, jnp.broadcast_to(magnitude(u)[None], u.shape)), wrap=False)
    return jnp.maximum(1 + tv * curvature, _LEAST_DENOMINATOR)
