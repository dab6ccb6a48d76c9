"""The forward model, Eq. (2): what the sensor sees of a volume or of points."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from ..geometry import Imager
from ..grid import Grid
from ..optics.field_varying import FieldVaryingPsf
from ..optics.lens_types import PerTypePsf, split_by_type
from .backprojection import as_volume, backproject_adjoint
from .convolution import convolved, image_in_groups, with_margin
from .field_varying_model import full_image

# Depths that share a transform back, for the memory of as many sharp images.
_TOGETHER = 2

Optics = Float[Array | np.ndarray, "plane tall wide"] | FieldVaryingPsf | PerTypePsf | None


@jax.jit
def forward(
    volume: Num[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    optics: Optics = None,
) -> Float[Array, "row column"]:
    """The image of a volume, summed lens by lens: Eq. (2), or with all of the light.

    *Differentiable.*

    Each voxel is a point at its centre. With a PSF this is Eq. (2) without its zones: every lens images a voxel at the
    chief ray's pixel (scale `s_z`, magnification `M_z`), weighted by the envelope C, and spread by PSF_o of its depth.
    The paper takes C from the centre of the voxel's zone instead of from the voxel, which is the only difference. As in
    Eq. (2) a voxel counts the same at every depth. Chief rays that miss the sensor by less than half a PSF count with
    what spreads onto it.

    With `FieldVaryingPsf` each lens's spot is where exact rays put it, at every distance from the lens's axis, and a
    voxel is the light that it sends out in all directions; Eq. (2)'s C and PSF_o are the leading term near the axis.

    Linear in the volume and in the PSF; differentiable with respect to everything that is continuous.

    Parameters
    ----------
    volume
        `grid.volume_shape`; integers count as the imager's type.
    imager, grid
        As for `backproject`.
    optics
        `gs_jax.optics_of` makes it by name. None: points, which makes this the adjoint of `backproject`. An array:
        PSF_o at each depth on the sensor's pixels, from `gs_jax.optics.psf`, `(len(depths), size, size)` of odd size.
        `FieldVaryingPsf`: all light, by tables for these depths. `PerTypePsf`: either of these for each type of lens.

    Returns
    -------
    Array
        `sensor.shape`, of the volume's type. With a PSF it is as exact as an FFT of that type, so dark pixels may
        be about 1e-7 of the brightest below zero in float32; with `FieldVaryingPsf`, a few percent of the light's mean,
        as the halo ripples.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape, or there is not one PSF of odd size, or table, for each depth.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 20, 20] = 1.0
    >>> image = gs.forward(scene, scope, grid)  # by pinholes
    >>> sharp = gs.forward(scene, scope, grid, gs.optics_of(scope, grid.depths, "near"))  # Eq. (2)
    >>> image.shape, sharp.shape
    ((200, 200), (200, 200))
    """
    volume = as_volume(volume, imager)
    if optics is None:
        return backproject_adjoint(volume, imager, grid)
    if isinstance(optics, PerTypePsf):
        each = zip(split_by_type(imager, optics.lenses), optics.optics, strict=True)
        images = [forward(volume, one, grid, its) for one, its in each]
        return sum(images[1:], images[0])
    if isinstance(optics, FieldVaryingPsf):
        if len(optics.kernel) != grid.depths.size:
            raise ValueError(
                f"`optics` must be of {grid.depths.size} depths, as the grid is, got {len(optics.kernel)}."
            )
        return full_image(volume, imager, grid, optics)
    psf = optics
    size = psf.shape[-1]
    if psf.shape != (grid.depths.size, size, size) or size % 2 == 0:
        raise ValueError(f"`psf` must be ({grid.depths.size}, size, size) with an odd size, got {psf.shape}.")
    wide = with_margin(imager, size)

    # Not kept for the gradient: sharp images of all depths are more than the volume.
    @jax.checkpoint
    def add_depths(image, planes):
        depths, volume, kernels = planes
        sharp = [
            backproject_adjoint(volume[one], wide, grid.at(depths[one]))
            for one in (slice(n, n + 1) for n in range(depths.size))
        ]
        return image + convolved(sharp, kernels)

    planes = grid.depths, volume, jnp.asarray(psf, volume.dtype)
    return image_in_groups(add_depths, jnp.zeros(imager.sensor.shape, volume.dtype), planes, _TOGETHER)
