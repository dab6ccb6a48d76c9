"""The forward model, Eq. (2): the image of a volume, with PSF models of three fidelities."""

import operator
from collections.abc import Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from ..base.arrays import host_code, jit
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..optics.field_varying import FieldVaryingPsf, field_varying_psf
from ..optics.lens_types import PerTypePsf, relative_areas, split_by_type, split_groups
from ..optics.polar_grid import make_polar_grid
from ..optics.psf import psf_of_depth
from .backprojection import as_volume, backproject_adjoint
from .convolution import scan_in_groups, sum_of_convolutions, with_margin
from .field_varying_model import full_image

FIDELITIES = ("full", "near", "pinhole")
# Depths that share an inverse FFT, which takes the memory of as many sharp images.
_DEPTHS = 2

PsfModel = Float[Array | np.ndarray, "plane tall wide"] | FieldVaryingPsf | PerTypePsf | None


@host_code("`gs_jax.optics.psf` has PSFs that can be")
def make_psf_model(
    imager: Imager,
    depths: Sequence[float] | Float[Array | np.ndarray, " depth"],
    fidelity: str = "full",
    *,
    progress: Progress | None = None,
) -> PsfModel:
    """The PSF model of a microscope at some depths, for `forward` and the solvers.

    *Host.*

    Parameters
    ----------
    imager, depths
        The microscope, and the depths of the object, mm.
    fidelity
        `"pinhole"`: chief rays within the field radius, no PSF. `"near"`: Eq. (2), field-constant: within the field
        radius all lenses have the PSF of a point on the axis. `"full"`: field-varying: all the light of every lens, by
        exact rays.
    progress
        Shows how many depths are done.

    Returns
    -------
    None, Array, FieldVaryingPsf or PerTypePsf
        Tables for these depths in this order; per type if there are several types of lenses, or the array is tilted so
        far that the blur differs from lens to lens.

    Raises
    ------
    InputError
        If `fidelity` is none of the three, or the PSF of a depth is wider than 128 pixels ("near").

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> psf = gs.make_psf_model(scope, grid.depths, "near")
    >>> print(psf.shape[0], gs.make_psf_model(scope, grid.depths, "pinhole"))
    3 None
    """
    if fidelity not in FIDELITIES:
        raise InputError(f"fidelity must be one of {', '.join(FIDELITIES)}, got {short_repr(fidelity)}.")
    if fidelity == "pinhole":
        return None
    depths = np.asarray(depths)

    def field_constant_psf(imager):
        kernel = psf_of_depth(imager, depths, "geometric")
        return jnp.stack([kernel(z) for z in (progress or Progress()).track(depths, "Point spread functions")])

    types, lenses = split_groups(imager)
    if len(types) == 1:
        full = fidelity == "full"
        return field_varying_psf(imager, depths, progress=progress) if full else field_constant_psf(imager)
    if fidelity == "full":
        nodes = make_polar_grid(imager, depths)
        psfs = [field_varying_psf(one, depths, polar_grid=nodes, progress=progress) for one in types]
    else:
        psfs = [area * field_constant_psf(one) for one, area in zip(types, relative_areas(types).tolist(), strict=True)]
    return PerTypePsf(lenses, tuple(psfs))


@jit
def forward(
    volume: Num[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    optics: PsfModel = None,
) -> Float[Array, "row column"]:
    """The image of a volume, summed lens by lens: Eq. (2), or with all of the light.

    *Differentiable.*

    Each voxel is a point at its centre. With a PSF this is Eq. (2) without its zones: every lens images a voxel at the
    chief ray's pixel (scale `s_z`, magnification `M_z`), weighted by the envelope C, and spread by PSF_o of its depth.
    The paper takes C at the centre of the voxel's zone instead of at the voxel, which is the only difference. As in
    Eq. (2) a voxel counts the same at every depth. Chief rays that miss the sensor by less than half a PSF count with
    the light that the PSF spreads onto it.

    With a `FieldVaryingPsf` exact rays place the spot of each lens at every distance from its axis, and a voxel is the
    light that it emits in all directions; Eq. (2)'s C and PSF_o are the leading term near the axis.

    The image is linear in the volume and in the PSF, and differentiable with respect to these, to the grid's depths and
    origin, and to the imager. The surface and the aperture of a lens act by the PSF: gradients with respect to radius,
    conic constant and aperture are zero without one, and with one that was computed before. Compute the PSF within the
    function that is differentiated, as in the last example.

    Parameters
    ----------
    volume
        `grid.volume_shape`; integers are converted to the imager's type.
    imager, grid
        As for `backproject`.
    optics
        From `gs_jax.make_psf_model`. None: points, the adjoint of `backproject`. An array: PSF_o at each depth on the
        sensor's pixels, from `gs_jax.optics.psf`, `(len(depths), size, size)` of odd size. `FieldVaryingPsf`: tables of
        all light at these depths. `PerTypePsf`: either of these for each type of lens.

    Returns
    -------
    Array
        `sensor.shape`, of the volume's type. With a PSF it is as exact as an FFT of that type: in float32, dark pixels
        may be about -1e-7 of the brightest. With a `FieldVaryingPsf` they may be negative by a few percent of the mean.

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
    >>> sharp = gs.forward(scene, scope, grid, gs.make_psf_model(scope, grid.depths, "near"))  # Eq. (2)
    >>> image.shape, sharp.shape
    ((200, 200), (200, 200))
    >>> import jax
    >>> from gs_jax.optics.psf import gaussian_psf
    >>> stack = lambda lens: jax.vmap(lambda z: gaussian_psf(lens, z, size=31))(grid.depths)
    >>> slope = jax.grad(lambda lens: (gs.forward(scene, lens, grid, stack(lens)) ** 2).sum())(scope)
    >>> print(bool(slope.array.radius_of_curvature != 0))
    True
    """
    volume = as_volume(volume, imager)
    if optics is None:
        return backproject_adjoint(volume, imager, grid)
    if isinstance(optics, PerTypePsf):
        types = zip(split_by_type(imager, optics.lenses), optics.optics, strict=True)
        return reduce(operator.add, [forward(volume, one, grid, psf) for one, psf in types])
    if isinstance(optics, FieldVaryingPsf):
        if len(optics.kernels) != grid.depths.size:
            raise ValueError(
                f"`optics` must be of {grid.depths.size} depths, as the grid is, got {len(optics.kernels)}."
            )
        return full_image(volume, imager, grid, optics)
    size = optics.shape[-1]
    if optics.shape != (grid.depths.size, size, size) or size % 2 == 0:
        raise ValueError(f"`optics` must be ({grid.depths.size}, size, size) with an odd size, got {optics.shape}.")
    wide = with_margin(imager, size)

    # Not kept for the gradient: the sharp images of all depths are larger than the volume.
    @jax.checkpoint
    def add_depths(image, planes):
        depths, volume, kernels = planes
        slices = [slice(n, n + 1) for n in range(depths.size)]
        sharp = [backproject_adjoint(volume[one], wide, grid.at(depths[one])) for one in slices]
        return image + sum_of_convolutions(sharp, kernels)

    planes = grid.depths, volume, jnp.asarray(optics, volume.dtype)
    return scan_in_groups(add_depths, jnp.zeros(imager.sensor.shape, volume.dtype), planes, _DEPTHS)
