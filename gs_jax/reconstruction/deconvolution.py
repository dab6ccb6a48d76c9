"""Deconvolution of a capture with a measured PSF, of a diffuser or any other mask in front of a camera."""

import numpy as np
from jaxtyping import Array, Float32, Num

from ..base.arrays import check_finite
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..solvers.convolution import Convolution, ConvolutionADMM
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from ..typing import Image
from .inverse_problem import subtract_offset
from .pipeline import run_solver

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
    """Reconstruct a plane from its image through a shift-invariant system.

    *Host.*

    Points beside the sensor whose light reaches it are reconstructed, too, and then cropped (Antipa et al., Optica 5,
    1, 2018). The camera's offset, the first percentile, is subtracted from image and PSF.

    Parameters
    ----------
    image
        Linear, in any unit.
    psf
        Image of a point on the axis, which is at the middle; any unit.
    solver
        Solver that inverts the convolution.
    progress
        Shows progress.

    Returns
    -------
    ndarray
        The scene, `image.shape`, in the image's unit: its sum is about that of the light that reaches the sensor.

    Raises
    ------
    InputError
        If `solver` is no such solver, a pixel is not finite, or the PSF is dark.

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
        raise InputError(f"solver must be an object such as ConvolutionADMM() or FISTA(), got {short_repr(solver)}.")
    check_finite("image", image)
    check_finite("psf", psf)
    light, spot = (subtract_offset(np.asarray(part, np.float32)) for part in (image, psf))
    if not spot.sum() > 0:
        raise InputError("psf must be the image of a point, got no light above the darkest percent.")
    system = Convolution.of(spot[None] / spot.sum(), light.shape)
    # Weights of priors suit images of the order of 1.
    unit = float(np.abs(light).max()) or 1.0
    scene = run_solver(solver, light / np.float32(unit), system, progress or Progress())
    return np.float32(unit) * scene[0][system.window]
