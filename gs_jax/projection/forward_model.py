"""The forward model, Eq. (2): the image of a volume, with PSF models of three fidelities."""

import dataclasses
import math
import operator
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Num

from ..base.arrays import as_float, host_code, jit
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..optics.apertures import relative_areas, split_by_type, split_groups
from ..optics.field_varying import FieldVaryingPsf, field_varying_psf, make_polar_grid
from ..optics.psf import PSFS, psf_of_depth
from .backprojection import as_volume, backproject_adjoint
from .convolution import sum_of_convolutions, with_margin
from .field_varying_model import full_image, window_sides

FIDELITIES = ("full", "near", "pinhole")
# Depths that share an inverse FFT, which takes the memory of as many sharp images.
_DEPTHS = 2

# Relative difference of depths, and of lengths, up to which they are the same: a search moves them.
_SAME = 1e-3


class PsfModel(eqx.Module):
    """The point spread functions of a microscope for the voxels of a grid and the pixels of its sensor.

    *Differentiable.*

    `gs_jax.psf_model` makes it, for `forward`, `ImagingOperator` and the solvers. It is a pytree whose leaves are the
    tables: compiled functions that take it as an argument serve other tables of the same shapes.

    Parameters
    ----------
    parts
        Of each group of lenses that image alike: None for pinholes, `(depth, size, size)` for the same PSF at all
        fields, or `FieldVaryingPsf`. Those that are not field-varying have the group's light over that of the mean
        lens.
    lenses
        Indices of the lenses of each group; None if all lenses are one.
    depths
        Of the grid's planes, mm.
    pixel_pitch
        Of the sensor, mm.
    extent
        Side of the square about the frame's origin from which the tables follow light, mm; infinite where that does
        not matter.
    """

    parts: tuple[Float[Array, "plane _ _"] | FieldVaryingPsf | None, ...]
    lenses: tuple[tuple[int, ...], ...] | None = eqx.field(static=True)
    depths: Float[Array, " depth"] = eqx.field(converter=as_float)
    pixel_pitch: Float[Array, ""] = eqx.field(converter=as_float)
    extent: Float[Array, ""] = eqx.field(converter=as_float)


# What `forward` takes: a model, or tables that a function of one's own computes.
Optics = PsfModel | Float[Array | np.ndarray, "plane tall wide"] | FieldVaryingPsf | None


@host_code("`gs_jax.optics.psf` has PSFs that can be")
def psf_model(
    imager: Imager,
    grid: Grid,
    fidelity: str = "full",
    *,
    psf: str = "geometric",
    coarser: int = 1,
    progress: Progress | None = None,
) -> PsfModel:
    """The PSF model of a microscope for a grid, for `forward` and the solvers.

    *Host.*

    Parameters
    ----------
    imager, grid
        The microscope, and the voxels that are imaged.
    fidelity
        `"pinhole"`: chief rays within the field radius, no PSF. `"near"`: Eq. (2), field-constant: within the field
        radius all lenses have the PSF of a point on the axis. `"full"`: field-varying: all the light of every lens, by
        exact rays.
    psf
        Of a lens, for `"near"`: `"diffraction"`, `"geometric"` (rays alone) or `"gaussian"`.
    coarser
        Factor by which the nodes of the stray light are farther apart, for wide voxels.
    progress
        Shows how many depths are done.

    Returns
    -------
    PsfModel
        Tables for the grid's depths in their order; of each group of lenses if there are several types, or the array is
        tilted so far that the blur differs from lens to lens.

    Raises
    ------
    InputError
        If `fidelity` or `psf` is none of the three, or the PSF of a depth is wider than 128 pixels ("near").

    Examples
    --------
    >>> model = gs.psf_model(scope, grid, "near")
    >>> model.parts[0].shape[0], model.depths.tolist()
    (3, [18.0, 20.0, 22.0])
    """
    if fidelity not in FIDELITIES:
        raise InputError(f"fidelity must be one of {', '.join(FIDELITIES)}, got {short_repr(fidelity)}.")
    if psf not in PSFS:
        raise InputError(f"psf must be one of {', '.join(PSFS)}, got {short_repr(psf)}.")
    depths, extent = np.asarray(grid.depths), np.inf

    def field_constant_psf(imager):
        kernel = psf_of_depth(imager, depths, psf)
        return jnp.stack([kernel(z) for z in (progress or Progress()).track(depths, "Point spread functions")])

    imagers, lenses = split_groups(imager) if fidelity != "pinhole" else ([imager], ())
    if fidelity == "pinhole":
        parts = [None]
    elif fidelity == "full":
        # The sensor is as wide as most objects, whose tables then have the same nodes.
        extent = max(2 * max(map(abs, imager.sensor.extent)), extent_of(grid))
        nodes = make_polar_grid(imager, depths, extent=extent, coarser=coarser)
        tables = [field_varying_psf(one, depths, polar_grid=nodes, progress=progress) for one in imagers]
        parts = [_windowed(table, one, grid) for one, table in zip(imagers, tables, strict=True)]
    else:
        areas = relative_areas(imagers).tolist() if len(imagers) > 1 else [1.0]
        parts = [area * field_constant_psf(one) for one, area in zip(imagers, areas, strict=True)]
    groups = lenses if len(imagers) > 1 else None
    return PsfModel(tuple(parts), groups, grid.depths, imager.sensor.pixel_pitch, extent)


def extent_of(grid: Grid) -> float:
    """Side of the square about the frame's origin that holds the centres of all voxels, mm."""
    beside, count = np.abs(np.asarray(grid.origin, float)), np.array(grid.shape[::-1])
    return float(np.max(2 * beside + (count - 1) * grid.pitch))


def _windowed(table: FieldVaryingPsf, imager: Imager, grid: Grid) -> FieldVaryingPsf:
    """Tables with windows for a grid that is small beside the sensor."""
    windows = window_sides(imager, grid, table)
    widest = jnp.asarray(_width(grid), table.distortion.dtype) if any(windows) else None
    return dataclasses.replace(table, windows=windows, widest=widest)


def _width(grid):
    return max(grid.shape) * grid.pitch


def check_optics(optics: Optics | str, imager: Imager, grid: Grid) -> None:
    """Raise `InputError` if a PSF model is of other depths, pixels or a smaller object than the grid and the sensor.

    Numbers that JAX traces are not compared: a check within a compiled program is a call of the host, for which JAX
    does not keep the program on disk.
    """
    if isinstance(optics, str | type):
        raise InputError(f"optics must be a PSF model such as that of psf_model(), got {short_repr(optics)}.")
    if not isinstance(optics, PsfModel) or any(isinstance(x, Tracer) for x in jax.tree.leaves((optics, grid))):
        return
    own, needed = np.asarray(optics.depths, float), np.asarray(grid.depths, float)
    allowed = "optics must be of the grid's"
    if own.shape != needed.shape or not np.allclose(own, needed, rtol=_SAME, atol=0):
        raise InputError(f"{allowed} depths, {short_repr(needed.tolist())} mm, got {short_repr(own.tolist())} mm.")
    pitch, pixel = float(optics.pixel_pitch), imager.sensor.pixel_pitch
    if not math.isclose(pitch, pixel, rel_tol=_SAME):
        raise InputError(f"optics must be of the sensor's pixels of {1000 * pixel:g} um, got {1000 * pitch:g} um.")
    if (extent := extent_of(grid)) > float(optics.extent) * (1 + _SAME):
        raise InputError(f"{allowed} extent, {extent:.6g} mm, got tables of {float(optics.extent):.6g} mm.")
    widths = [float(widest) for part in optics.parts if (widest := getattr(part, "widest", None)) is not None]
    if widths and (width := float(_width(grid))) > min(widths) * (1 + _SAME):
        raise InputError(f"{allowed} width, {width:.6g} mm, got tables for {min(widths):.6g} mm.")


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
        From `gs_jax.psf_model`. None: points, the adjoint of `backproject`. An array: PSF_o at each depth on the
        sensor's pixels, from `gs_jax.optics.psf`, `(len(depths), size, size)` of odd size. `FieldVaryingPsf`: tables of
        all light at these depths.

    Returns
    -------
    Array
        `sensor.shape`, of the volume's type. With a PSF it is as exact as an FFT of that type: in float32, dark pixels
        may be about -1e-7 of the brightest. With a `FieldVaryingPsf` they may be negative by a few percent of the mean.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape, or there is not one PSF of odd size, or table, for each depth.
    InputError
        If a `PsfModel` is of other depths, of other pixels, or of a smaller object.

    Examples
    --------
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 20, 20] = 1.0
    >>> image = gs.forward(scene, scope, grid)  # by pinholes
    >>> sharp = gs.forward(scene, scope, grid, gs.psf_model(scope, grid, "near"))  # Eq. (2)
    >>> image.shape, sharp.shape
    ((200, 200), (200, 200))
    >>> import jax
    >>> from gs_jax.optics.psf import gaussian_psf
    >>> stack = lambda lens: jax.vmap(lambda z: gaussian_psf(lens, z, size=31))(grid.depths)
    >>> slope = jax.grad(lambda lens: (gs.forward(scene, lens, grid, stack(lens)) ** 2).sum())(scope)
    >>> print(bool(slope.array.radius_of_curvature != 0))
    True
    """
    check_optics(optics, imager, grid)
    return _forward(volume, imager, grid, optics)


@jit
def _forward(volume, imager: Imager, grid: Grid, optics: Optics) -> Float[Array, "row column"]:
    volume = as_volume(volume, imager)
    if optics is None:
        return backproject_adjoint(volume, imager, grid)
    if isinstance(optics, PsfModel):
        imagers = [imager] if optics.lenses is None else split_by_type(imager, optics.lenses)
        parts = zip(imagers, optics.parts, strict=True)
        return reduce(operator.add, [_forward(volume, one, grid, part) for one, part in parts])
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
    return _scan_in_groups(add_depths, jnp.zeros(imager.sensor.shape, volume.dtype), planes)


def _scan_in_groups(add, image, planes):
    """Apply `add(image, group)` to consecutive groups of `_DEPTHS` planes; the last may be smaller."""
    count = len(jax.tree.leaves(planes)[0])
    whole = count // _DEPTHS * _DEPTHS
    grouped = jax.tree.map(lambda a: a[:whole].reshape(-1, _DEPTHS, *a.shape[1:]), planes)
    image = lax.scan(lambda image, group: (add(image, group), None), image, grouped)[0] if whole else image
    return add(image, jax.tree.map(lambda a: a[whole:], planes)) if whole < count else image
