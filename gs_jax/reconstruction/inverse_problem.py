"""The inverse problem of iterative methods: light to explain, in pixels as wide as voxels, its noise, the operator."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Float32, Float64, Shaped

from ..base.arrays import array_namespace, check_finite, is_traced, native
from ..base.progress import Progress
from ..base.typing import Image
from ..detection.background import background_tiles, interpolate_tiles
from ..io.camera import Readout
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..optics.apertures import height_bands, split_groups
from ..optics.field_varying import FieldVaryingPsf
from ..optics.psf_core import core_distortion, type_weights
from ..projection.forward_model import Optics, PsfModel, check_optics, psf_model
from ..projection.operators import BackprojectionOperator, ImagingOperator
from ..solvers.base import Refinement

# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARK_PERCENTILE = 1
# Side of the squares in which noise is estimated, pixels.
_SQUARE = 32
# Side of the squares that are held out, pixels, and their distance, in sides. Single pixels are told by their
# neighbours, also where the PSF is wrong: they choose weights that are too weak. In small images squares are smaller.
_SIDE, _DISTANCE, _LEAST_SQUARES = 8, 4, 16
# Median absolute value of a standard normal variable.
_NORMAL_MEDIAN = 0.6745
# Minimum half wavelength of a background mode, in pixels of the stray light's grid: the width of a spot's stray light.
_HALF_WAVE = 6.5
_ROUNDING = 0.02
# Largest distance of voxels on the sensor, in binned pixels. Voxels are points: farther apart, their images leave gaps.
_FARTHEST = 1.5
# Factors by which voxels are wider in the first steps, and voxels along a side that must be left.
_FACTORS, _LEAST_VOXELS = (4, 2), 48


def prepare_data(image: Image, problem: "InverseProblem", side: int = 1) -> tuple[Any, Any]:
    """Bin an image to the problem's pixels, above the camera's offset; return it and the background in it.

    The background is found in pixels of which one of the problem's has `side` along each side.

    On the host, unless JAX traces the image. Raises `InputError` if a pixel is not finite.
    """
    check_finite("image", image)
    xp = jnp if is_traced(image) else np
    image = subtract_offset(xp.asarray(image, problem.imager.sensor_distance.dtype))
    light = sum_pixels(image, problem.binning // side)
    if not problem.is_partial:
        return sum_pixels(light, side), 0.0
    background = xp.maximum(interpolate_tiles(background_tiles(light)[0], light.shape), 0)
    return sum_pixels(light, side), sum_pixels(background, side)


def sum_pixels(image: Any, side: int) -> Any:
    """Sum the pixels of each square of `side` x `side`; those that fill no square are left out."""
    rows, columns = (n // side for n in image.shape)
    return image[: rows * side, : columns * side].reshape(rows, side, columns, side).sum((1, 3))


def subtract_offset(image: Any) -> Any:
    """Subtract the first percentile of an image, unless it is negative because the offset was subtracted before."""
    xp = array_namespace(image)
    return image - xp.asarray(xp.maximum(xp.percentile(image, _DARK_PERCENTILE), 0), image.dtype)


def noise_variance(image: Shaped[np.ndarray, "row column"]) -> Float64[np.ndarray, "square_row square_column"]:
    """Variance of a capture's noise in each square of 32 pixels (the last may be smaller); 0 below 3 pixels a side.

    From second differences along rows and columns, in which smooth light cancels (Immerkaer, Comput. Vis. Image
    Underst. 64, 300, 1996), and their median, which sharp spots hardly change.
    """
    image = np.asarray(image, np.float64)
    if min(image.shape) < 3:
        return np.zeros((1, 1))
    # Each second difference multiplies the variance of independent noise by 6.
    difference = np.abs(np.diff(np.diff(image, 2, axis=0), 2, axis=1)) / 6
    starts = [range(0, n, _SQUARE) for n in difference.shape]
    median = [[np.median(difference[r : r + _SQUARE, c : c + _SQUARE]) for c in starts[1]] for r in starts[0]]
    return (np.array(median) / _NORMAL_MEDIAN) ** 2


def binned_variance(
    image: Shaped[np.ndarray, "row column"], shape: tuple[int, ...]
) -> Float64[np.ndarray, "binned_row binned_column"]:
    """Variance of the noise in each pixel of the capture that is binned to this shape."""
    side, variance = image.shape[0] // shape[0], noise_variance(image)
    squares = (np.arange(n) * side // _SQUARE for n in shape)
    return side**2 * variance[np.ix_(*(np.minimum(s, n - 1) for s, n in zip(squares, variance.shape, strict=True)))]


def discrepancy_target(
    image: Shaped[np.ndarray, "row column"], light: Float[np.ndarray, "binned_row binned_column"], *, counts: bool
) -> float:
    """Cost that noise alone leaves a solver, by the discrepancy principle (Morozov, 1966).

    Parameters
    ----------
    image
        The capture.
    light
        Data to explain: the capture in binned pixels, above the offset.
    counts
        Whether the cost is the Kullback-Leibler divergence, `sum(variance / (2 mean))`, or half the squares.
    """
    from scipy.ndimage import uniform_filter  # imported here: back-projection does without SciPy

    side, variance = image.shape[0] // light.shape[0], binned_variance(image, light.shape)
    if counts:
        # In the dark, where negative pixels count as 0, the divergence is of the order of the noise.
        mean = np.maximum(uniform_filter(np.asarray(light, np.float64), max(_SQUARE // side, 1)), np.sqrt(variance))
        variance = np.divide(variance, mean, out=np.zeros_like(variance), where=mean > 0)
    return float(variance.sum() / 2)


def held_out_squares(shape: tuple[int, ...]) -> Float32[np.ndarray, "row column"]:
    """0 in squares that are held out, a square in each cell at a pseudo-random place, and 1 elsewhere."""
    cell, rng, kept = cell_side(shape), np.random.default_rng(0), np.ones(shape, np.float32)
    side = cell // _DISTANCE
    for corner in np.ndindex(*(-(-n // cell) for n in shape)):
        row, column = cell * np.array(corner) + rng.integers(0, cell - side, 2, endpoint=True)
        kept[row : row + side, column : column + side] = 0
    return kept


def cell_side(shape: tuple[int, ...]) -> int:
    """Side of the cells that have one such square each."""
    return _DISTANCE * max(min(_SIDE, min(shape) // _LEAST_SQUARES), 1)


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
    return tuple(LensTypeGeometry(lenses, core_distortion(lenses, depths), weight) for lenses, weight in pairs)


class InverseProblem(eqx.Module):
    """Operator that a solver inverts: a microscope and a grid, with the treatment of back-projection and background.

    Parameters
    ----------
    imager, grid, optics
        As for `forward`.
    back_projections
        If given, back-projection with these geometries is the `T`, in place of the adjoint. Richardson-Lucy converges
        in fewer steps with a back-projection that is sharper than the adjoint (Zeng and Gullberg, IEEE Trans. Med.
        Imaging 19, 548, 2000).
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
    def imaging(self) -> ImagingOperator:
        """The forward model of all pixels."""
        return ImagingOperator(self.imager, self.grid, self.optics)

    @property
    def T(self) -> "BackOperator":
        return BackOperator(self)

    def mv(self, vector: Float[Array | np.ndarray, "depth y x"]) -> Float[Array, "row column"]:
        """The image of a volume, without the low modes where `T` is the adjoint."""
        return self.project(vector, not self.back_projections)

    def project(self, volume: Float[Array | np.ndarray, "depth y x"], exact: Any) -> Float[Array, "row column"]:
        """The image of a volume; if `exact`, which may be traced, without the modes that least squares leave out."""
        exact = exact if self.back_projections else True
        image = self.imaging.mv(volume)
        return self.keep(jnp.where(exact, self.detrend(image), image))

    def project_back(self, image: Float[Array | np.ndarray, "row column"], exact: Any) -> Float[Array, "depth y x"]:
        """The volume of an image by back-projection; if `exact`, or without back-projections, by the adjoint."""
        exact = exact if self.back_projections else True
        image = self.keep(image)

        def adjoint() -> Any:
            return self.imaging.T.mv(self.detrend(image))

        def back_project() -> Any:
            volume: Any = 0
            for view in self.back_projections or ():
                # With the pixels of this problem, which may be binned.
                binned = eqx.tree_at(lambda i: i.sensor, view.imager, self.imager.sensor)
                part = BackprojectionOperator(binned, self.grid, distortion=view.distortion).mv(image)
                volume = part if view.weight is None else volume + jnp.asarray(view.weight, part.dtype) * part
            return volume

        if isinstance(exact, bool):
            return adjoint() if exact else back_project()
        return lax.cond(exact, adjoint, back_project)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self.imaging.in_structure()

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self.imaging.out_structure()

    def keep(self, image: Any) -> Any:
        """The image without the pixels that are left out."""
        return image if self.kept is None else jnp.asarray(self.kept, image.dtype) * image

    def detrend(self, image: Any) -> Any:
        """Project the low cosine modes out of the image, so that least squares fit a smooth background, too."""
        if not self.detrend_modes:
            return image
        rows, columns = (_cosine_modes(n, self.detrend_modes, image.dtype) for n in image.shape)
        return image - rows @ (rows.T @ image @ columns) @ columns.T


class BackOperator(eqx.Module):
    """Back-projection of an inverse problem, or its adjoint."""

    T: InverseProblem

    def mv(self, vector: Float[Array | np.ndarray, "row column"]) -> Float[Array, "depth y x"]:
        """The volume of an image."""
        return self.T.project_back(vector, not self.T.back_projections)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self.T.out_structure()

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self.T.in_structure()


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


def wider_problems(problem: InverseProblem, imager: Imager, optics: str, progress: Progress) -> list[InverseProblem]:
    """The same problem with voxels and pixels four times, and twice, as wide, where enough are left to gain from.

    `imager` has the camera's pixels.
    """
    return [
        _wider_problem(problem, imager, optics, factor, progress)
        for factor in _FACTORS
        if min(problem.grid.shape) >= _LEAST_VOXELS * factor
    ]


def _wider_problem(problem, imager, optics, factor, progress) -> InverseProblem:
    grid, binning = problem.grid, factor * problem.binning
    shape = [2 * round((n / factor - 1) / 2) + 1 for n in grid.shape]
    grid = Grid(grid.depths, shape, factor * grid.pitch, grid.origin)
    imager = eqx.tree_at(lambda i: i.sensor, imager, Readout(binning=binning).sensor(imager.sensor))
    model = psf_model(imager, grid, optics, coarser=factor, progress=progress)
    return dataclasses.replace(problem, imager=imager, grid=grid, optics=model, binning=binning)


def refinement(wide: InverseProblem, narrow: InverseProblem) -> Refinement:
    """From the voxels of one problem to those of another, which are narrower."""
    factor = wide.binning // narrow.binning
    return Refinement.of(narrow.grid.shape, wide.grid.shape, factor, np.dtype(narrow.imager.sensor_distance.dtype))
