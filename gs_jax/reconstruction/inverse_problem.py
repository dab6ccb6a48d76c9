"""The inverse problem of iterative methods: pixels binned to the size of voxels, the data to explain, the operator."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import array_namespace, check_finite, is_traced, native
from ..base.progress import Progress
from ..detection.background import background_tiles, interpolate_tiles, level_of_tiles
from ..geometry import Imager
from ..grid import Grid
from ..io.camera import Readout
from ..optics.field_varying import FieldVaryingPsf
from ..optics.lens_types import height_bands, split_groups, type_weights
from ..optics.psf_core import core_distortion
from ..projection.forward_model import Optics, PsfModel, check_optics, psf_model
from ..projection.operators import BackprojectionOperator, ImagingOperator, as_matrix, no_structure, transpose
from ..solvers.base import Operator, UnmatchedAdjointOperator
from ..typing import Image

# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARK_PERCENTILE = 1
# Minimum half wavelength of a background mode, in pixels of the stray light's grid: the width of a spot's stray light.
_HALF_WAVE = 6.5
_ROUNDING = 0.02
# Largest distance of voxels on the sensor, in binned pixels. Voxels are points: farther apart, their images leave gaps.
_FARTHEST = 1.5


def prepare_data(image: Image, problem: "InverseProblem") -> tuple[Any, Any]:
    """Bin an image to the problem's pixels, above the camera's offset; return it and the background in it.

    On the host, unless JAX traces the image. Raises `InputError` if a pixel is not finite.
    """
    check_finite("image", image)
    xp = jnp if is_traced(image) else np
    light = sum_pixels(subtract_offset(xp.asarray(image, problem.imager.sensor_distance.dtype)), problem.binning)
    if not problem.is_partial:
        return light, 0.0
    if xp is jnp:
        return light, jnp.maximum(level_of_tiles(light), 0)
    return light, np.maximum(interpolate_tiles(background_tiles(light)[0], light.shape), 0)


def sum_pixels(image: Any, side: int) -> Any:
    """Sum the pixels of each square of `side` x `side`; those that fill no square are left out."""
    rows, columns = (n // side for n in image.shape)
    return image[: rows * side, : columns * side].reshape(rows, side, columns, side).sum((1, 3))


def subtract_offset(image: Any) -> Any:
    """Subtract the first percentile of an image, unless it is negative because the offset was subtracted before."""
    xp = array_namespace(image)
    return image - xp.asarray(xp.maximum(xp.percentile(image, _DARK_PERCENTILE), 0), image.dtype)


class LensTypeGeometry(NamedTuple):
    """Geometry that back-projects the lenses of one type.

    `distortion` of each depth is that of their spots' cores, or None for the chief rays. `weight` is the weight of this
    type at each depth, `(depth, 1, 1)`, or None if there is only one.
    """

    imager: Imager
    distortion: Float[Array | np.ndarray, " depth"] | None = None
    weight: Float[Array | np.ndarray, "depth 1 1"] | None = None


def lens_type_geometries(imager: Imager, grid: Grid) -> tuple[LensTypeGeometry, ...]:
    """Geometry of each type of lens, weighted by how bright and sharp its spots are at each depth."""
    depths = np.asarray(grid.depths, np.float64)
    imagers, groups = split_groups(imager)
    if len(imagers) == 1:
        return (LensTypeGeometry(imager, core_distortion(imager, depths)),)
    bands = height_bands(imager)[[lenses[0] for lenses in groups]]
    side = max(float(imager.magnification(depths).mean()) * grid.pitch, imager.sensor.pixel_pitch)
    weights = type_weights(imagers, depths, side, bands)[..., None, None].astype(np.float32)
    pairs = zip(imagers, weights, strict=True)
    return tuple(LensTypeGeometry(one, core_distortion(one, depths), weight) for one, weight in pairs)


class InverseProblem(eqx.Module):
    """What a solver inverts: a microscope, a grid, and how back-projection and background are treated.

    Parameters
    ----------
    imager, grid, optics
        As for `forward`.
    back_projections
        If given, back-projection with these geometries replaces the adjoint.
    detrend_modes
        Number of low cosine modes per axis that least squares leave out of the image.
    kept
        1 for pixels that are explained, and 0 for those that are left out; None keeps all.
    binning
        Number of the camera's pixels along a side of one of the imager's.
    is_partial
        Whether the optics lack some of the light, which is then background.
    """

    imager: Imager
    grid: Grid
    optics: Optics
    back_projections: tuple[LensTypeGeometry, ...] | None = None
    detrend_modes: int = eqx.field(static=True, default=0)
    kept: Float[Array | np.ndarray, "row column"] | None = None
    binning: int = eqx.field(static=True, default=1)
    is_partial: bool = eqx.field(static=True, default=False)

    @property
    def operator(self) -> Operator:
        A = ImagingOperator(self.imager, self.grid, self.optics)
        kept = None if self.kept is None else jnp.asarray(self.kept)
        # Not functions, which lineax would trace here: tables are traced once.
        least_squares = _Images(A, self) if self.detrend_modes or self.kept is not None else A
        if self.back_projections is not None:
            shown = A if self.kept is None else _Images(A, dataclasses.replace(self, detrend_modes=0))
            return UnmatchedAdjointOperator(shown, _BackProjections(A, self), least_squares, kept)
        return least_squares if kept is None else UnmatchedAdjointOperator(least_squares, least_squares.T, None, kept)

    def detrend(self, image: Any) -> Any:
        """Project the low cosine modes out of the image, so that least squares fit a smooth background, too."""
        if not self.detrend_modes:
            return image
        rows, columns = (_cosine_modes(n, self.detrend_modes, image.dtype) for n in image.shape)
        return image - rows @ (rows.T @ image @ columns) @ columns.T


class _Images(lx.AbstractLinearOperator):
    """Images of the kept pixels, without the low modes that least squares leave out."""

    operator: ImagingOperator
    problem: InverseProblem
    transpose, as_matrix = transpose, as_matrix

    def mv(self, vector) -> Any:
        image = self.problem.detrend(self.operator.mv(vector))
        return image if self.problem.kept is None else jnp.asarray(self.problem.kept, image.dtype) * image

    def in_structure(self):
        return self.operator.in_structure()

    def out_structure(self):
        return self.operator.out_structure()


class _BackProjections(_Images):
    """Back-projections of the kept pixels by each type of lens, weighted."""

    def mv(self, vector) -> Any:
        kept, imager, grid = self.problem.kept, self.problem.imager, self.problem.grid
        image = vector if kept is None else jnp.asarray(kept, vector.dtype) * vector
        volume = 0
        for view in self.problem.back_projections or ():
            # With the pixels of this problem, which may be binned.
            binned = eqx.tree_at(lambda i: i.sensor, view.imager, imager.sensor)
            part = BackprojectionOperator(binned, grid, distortion=view.distortion).mv(image)
            volume = part if view.weight is None else volume + jnp.asarray(view.weight, part.dtype) * part
        return volume

    def in_structure(self):
        return self.operator.out_structure()

    def out_structure(self):
        return self.operator.in_structure()


for _class in (_Images, _BackProjections):
    no_structure(_class)


def _cosine_modes(size, count, dtype):
    """Lowest modes of the discrete cosine transform, orthonormal: `(size, count)`."""
    modes = np.cos(np.pi * (np.arange(size)[:, None] + 0.5) * np.arange(min(count, size)) / size)
    return np.asarray(modes / np.linalg.norm(modes, axis=0), dtype)


def num_detrend_modes(imager: Imager, optics: Optics) -> int:
    """Number of cosine modes per axis that are smoother than a spot's stray light; 0 for optics without."""
    if isinstance(optics, PsfModel):
        optics = optics.parts[0]
    if not isinstance(optics, FieldVaryingPsf):
        return 0
    return round(max(imager.sensor.shape) * imager.sensor.pixel_pitch / (_HALF_WAVE * optics.stray_light.grid.pixel))


def prepare_model(imager: Imager, grid: Grid, optics: Optics | str, progress: Progress) -> InverseProblem:
    """Make the inverse problem of a microscope and a grid; `optics` as for `reconstruct`.

    With optics by name, pixels are binned to the width of voxels, and modes that are as smooth as stray light left out.
    """
    if not isinstance(optics, str):
        check_optics(optics, imager, grid)
        return InverseProblem(imager, grid, jnp.asarray(native(optics)) if isinstance(optics, np.ndarray) else optics)
    # At least two binned pixels must remain along each side; what fills no square is left out.
    voxel = float(imager.magnification(grid.depths).mean()) * grid.pitch / imager.sensor.pixel_pitch
    binning = max(int(voxel + _ROUNDING), 1)
    binning = max(1, min(binning + int(voxel > _FARTHEST * binning), min(imager.sensor.shape) // 2))
    imager = eqx.tree_at(lambda i: i.sensor, imager, Readout(binning=binning).sensor(imager.sensor))
    model = psf_model(imager, grid, optics, progress=progress)
    options = {"binning": binning, "is_partial": optics != "full"}
    return InverseProblem(imager, grid, model, detrend_modes=num_detrend_modes(imager, model), **options)
