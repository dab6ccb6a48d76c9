"""How true an image is to be: three levels, each of which `forward` and the solvers take."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..geometry import Imager
from ..optics.full import full_optics
from ..optics.window import psf_of_depth
from .forward_model import Optics

LEVELS = ("full", "near", "pinhole")


def optics_of(
    imager: Imager,
    depths: Sequence[float] | Float[Array | np.ndarray, " depth"],
    level: str = "full",
    *,
    progress: Progress | None = None,
) -> Optics:
    """What `forward` takes to image planes at some depths, as true as is wanted.

    Parameters
    ----------
    imager, depths
        The microscope, and where its object is, mm.
    level
        `"pinhole"`: chief rays within the field radius, without a PSF. `"near"`: Eq. (2), one PSF for all lenses within
        the field radius, that of rays on the axis. `"full"`: all the light of every lens, where it lands.
    progress
        Shows how many depths are done.

    Returns
    -------
    None, Array or FullOptics
        Tables for these depths, in their order.

    Raises
    ------
    InputError
        If there is no such level, or a depth is blurred over more than 128 pixels (near).

    Examples
    --------
    >>> image = forward(volume, imager, grid, optics_of(imager, grid.depths, "full"))
    """
    if level not in LEVELS:
        raise InputError(f"optics: found {short_repr(level)}, allowed: {', '.join(LEVELS)}.")
    if level == "pinhole":
        return None
    depths = np.asarray(depths)
    if level == "full":
        return full_optics(imager, depths, progress=progress)
    kernel = psf_of_depth(imager, depths, "geometric")
    return jnp.stack([kernel(z) for z in (progress or Progress()).track(depths, "Point spread functions")])
