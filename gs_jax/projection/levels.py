"""How true an image is to be: three levels, each of which `forward` and the solvers take."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..geometry import Imager
from ..lenses import lenses_by_type
from ..optics.field_varying import field_varying_psf, make_polar_grid
from ..optics.lens_types import PerTypePsf, relative_areas, split_by_type
from ..optics.psf import psf_of_depth
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

    *Host.*

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
    None, Array, FieldVaryingPsf or PerTypePsf
        Tables for these depths, in their order; of lenses that differ, for each type.

    Raises
    ------
    InputError
        If there is no such level, or a depth is blurred over more than 128 pixels (near).

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> spots = gs.optics_of(scope, grid.depths, "near")
    >>> print(spots.shape[0], gs.optics_of(scope, grid.depths, "pinhole"))
    3 None
    """
    if level not in LEVELS:
        raise InputError(f"optics: found {short_repr(level)}, allowed: {', '.join(LEVELS)}.")
    if level == "pinhole":
        return None
    depths = np.asarray(depths)
    if not imager.array.alike:
        each = split_by_type(imager, lenses := lenses_by_type(imager.array))
        if level == "full":
            nodes = make_polar_grid(imager, depths)
            return PerTypePsf(
                lenses, tuple(field_varying_psf(one, depths, polar_grid=nodes, progress=progress) for one in each)
            )
        light = zip(each, relative_areas(each).tolist(), strict=True)
        return PerTypePsf(lenses, tuple(share * _near(one, depths, progress) for one, share in light))
    return field_varying_psf(imager, depths, progress=progress) if level == "full" else _near(imager, depths, progress)


def _near(imager, depths, progress):
    kernel = psf_of_depth(imager, depths, "geometric")
    return jnp.stack([kernel(z) for z in (progress or Progress()).track(depths, "Point spread functions")])
