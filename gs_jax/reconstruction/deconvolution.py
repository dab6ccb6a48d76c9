"""Deconvolution of a capture by a measured point spread function, of a diffuser or any other mask before a camera."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float32, Num

from ..base.arrays import check_finite
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..solvers.convolution import Convolution, ConvolutionADMM
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from ..typing import Image
from .inverse_problem import above_offset
from .pipeline import iterated

# Default weight of ADMM's total variation.
TV = 1e-3

Deconvolver = ConvolutionADMM | FISTA | RichardsonLucy


def deconvolve(
    image: Image,
    psf: Num[Array | np.ndarray, "high wide"],
    solver: Deconvolver = ConvolutionADMM(steps=100, tv=TV),
    *,
    progress: Progress | None = None,
) -> Float32[np.ndarray, "row column"]:
    """The scene that an image shows, seen through a system that is everywhere alike.

    *Host.*

    Points beside the sensor whose light falls on it are reconstructed, too, and then cut off (Antipa et al., Optica 5,
    1, 2018). Both the image and the PSF are taken above their darkest percent, the camera's offset.

    Parameters
    ----------
    image
        Linear, in any unit.
    psf
        The image of a point on the axis, its place in the middle; any unit.
    solver
        What inverts the convolution.
    progress
        Shows how far it is.

    Returns
    -------
    ndarray
        `image.shape`, in the image's unit: its sum is about that of the light that reaches the sensor.

    Raises
    ------
    InputError
        If `solver` is none of these, a pixel is not finite, or the PSF is dark.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> psf = np.zeros((33, 33))
    >>> psf[16, [8, 16, 26]] = 1.0  # three spots for each point
    >>> image = np.zeros((64, 64))
    >>> image[30, [22, 30, 40]] = 1.0  # of a point at row 30, column 30
    >>> scene = gs.deconvolve(image, psf, gs.FISTA(steps=50))
    >>> print(*divmod(int(scene.argmax()), 64))
    30 30
    """
    if not isinstance(solver, Deconvolver):
        allowed = "an object such as ConvolutionADMM() or FISTA()"
        raise InputError(f"solver: found {short_repr(solver)}, allowed: {allowed}.")
    progress = progress or Progress()
    check_finite("image", image)
    check_finite("psf", psf)
    light, spot = (above_offset(np.asarray(part, np.float32)) for part in (image, psf))
    if not spot.sum() > 0:
        raise InputError("psf: found no light above the darkest percent, allowed: the image of a point.")
    system = Convolution.of(spot[None] / spot.sum(), light.shape)
    # Solvers weigh their priors against an image of the order of 1.
    unit = float(np.abs(light).max()) or 1.0
    inverted = _Itself(system) if isinstance(solver, ConvolutionADMM) else system
    scene = iterated(solver, progress, light / np.float32(unit), inverted)
    return np.float32(unit) * scene[0][system.place]


class _Itself(eqx.Module):
    """A convolution for the solver that needs more of it than its operator."""

    operator: Convolution
