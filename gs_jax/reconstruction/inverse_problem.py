"""What iterative methods invert: the microscope in pixels that suit the voxels, and the light that it is to explain."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import check_finite
from ..base.progress import Progress
from ..detection.background import between, square_levels
from ..geometry import Imager
from ..grid import Grid
from ..io.camera import Readout
from ..lenses import lenses_by_type
from ..optics.field_varying import FieldVaryingPsf
from ..optics.lens_types import PerTypePsf, split_by_type, type_weights
from ..optics.psf_core import apparent_depths
from ..projection.forward_model import Optics
from ..projection.levels import optics_of
from ..projection.operators import BackprojectionOperator, ImagingOperator
from ..solvers.base import Unmatched
from ..typing import Image

# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARKEST = 1
# Half a wave of background is this many of the halo's pixels at least: as wide as the halo of a spot.
_SLOW = 6.5
_ROUNDING = 0.02


class Model(NamedTuple):
    """What iterative methods explain an image by.

    Parameters
    ----------
    imager, optics
        With optics by name, pixels are as wide as voxels.
    side
        So many of the camera's pixels each way are one of these.
    hazy
        The optics does not hold all of the light; what it does not is background.
    """

    imager: Imager
    optics: Optics
    side: int = 1
    hazy: bool = False


def model_of(imager: Imager, grid: Grid, optics: Optics | str, progress: Progress) -> Model:
    """The model of a microscope for voxels; optics as for `reconstruct`."""
    if not isinstance(optics, str):
        return Model(imager, jnp.asarray(optics) if isinstance(optics, np.ndarray) else optics)
    imager, side = _coarser(imager, grid)
    return Model(imager, optics_of(imager, grid.depths, optics, progress=progress), side, optics != "full")


def explainable(image: Image, model: Model) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"] | float]:
    """What iterative methods are to explain: light above the offset, in the model's pixels, and background in it.

    It raises `InputError` if a pixel is not finite.
    """
    check_finite("image", image)
    rows, columns = model.imager.sensor.shape
    light = above_offset(np.asarray(image, model.imager.sensor_distance.dtype))
    light = light[: rows * model.side, : columns * model.side]
    light = light.reshape(rows, model.side, columns, model.side).sum((1, 3))
    return light, np.maximum(between(square_levels(light)[0], light.shape), 0) if model.hazy else 0.0


def above_offset(image: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """An image less its darkest percent, or as it is if that is negative."""
    return image - np.asarray(max(float(np.percentile(image, _DARKEST)), 0.0), image.dtype)


class Sight(NamedTuple):
    """How lenses of one type are read: the voxels of which chief rays land where their cores do.

    `weight`: how much they count at each depth, `(depth, 1, 1)`; None if there is one type.
    """

    imager: Imager
    grid: Grid
    weight: Float[Array | np.ndarray, "depth 1 1"] | None = None


def sights_of(imager: Imager, grid: Grid) -> tuple[Sight, ...]:
    """Where the cores of each type of lens lie, and how much a type counts by how bright and sharp it is there."""
    depths = np.asarray(grid.depths, np.float64)
    if imager.array.alike:
        return (Sight(imager, grid.at(apparent_depths(imager, depths))),)
    each = split_by_type(imager, lenses_by_type(imager.array))
    side = max(float(imager.magnification(depths).mean()) * grid.pitch, imager.sensor.pixel_pitch)
    weights = type_weights(each, depths, side)[..., None, None].astype(np.float32)
    pairs = zip(each, weights, strict=True)
    return tuple(Sight(one, grid.at(apparent_depths(one, depths)), weight) for one, weight in pairs)


class System(eqx.Module):
    """What a solver inverts: the microscope, and how.

    Parameters
    ----------
    imager, grid, optics
        As for `forward`.
    seen
        If given, back-projection of these stands for the adjoint.
    slow
        So many of the image's longest cosine waves each way are left out of account, with `seen` by least squares
        alone.
    """

    imager: Imager
    grid: Grid
    optics: Optics
    seen: tuple[Sight, ...] | None = None
    slow: int = eqx.field(static=True, default=0)

    @property
    def operator(self) -> lx.AbstractLinearOperator | Unmatched:
        A = ImagingOperator(self.imager, self.grid, self.optics)
        squares = lx.FunctionLinearOperator(lambda x: self.fast(A.mv(x)), A.in_structure()) if self.slow else A
        if self.seen is not None:
            return Unmatched(A, self._back(A, self.seen), squares)
        return squares

    def _back(self, A: ImagingOperator, seen: tuple[Sight, ...]) -> lx.AbstractLinearOperator:
        # In the pixels of this system.
        sensor = lambda one: eqx.tree_at(lambda i: i.sensor, one.imager, self.imager.sensor)
        each = [(BackprojectionOperator(sensor(one), one.grid), one.weight) for one in seen]
        if len(each) == 1:
            return each[0][0]
        total = lambda image: sum(jnp.asarray(weight, image.dtype) * B.mv(image) for B, weight in each)
        return lx.FunctionLinearOperator(total, A.out_structure())

    def fast(self, image: Float[Array | np.ndarray, "row column"]) -> Float[Array, "row column"]:
        """The image without its slow waves, an orthogonal projection: least squares then fit these waves, too."""
        image = jnp.asarray(image)
        if not self.slow:
            return image
        rows, columns = (_waves(n, self.slow, image.dtype) for n in image.shape)
        return image - rows @ (rows.T @ image @ columns) @ columns.T


def _waves(size, count, dtype):
    """The longest waves of the discrete cosine transform, orthonormal: `(size, count)`."""
    waves = np.cos(np.pi * (np.arange(size)[:, None] + 0.5) * np.arange(min(count, size)) / size)
    return jnp.asarray(waves / np.linalg.norm(waves, axis=0), dtype)


def _coarser(imager, grid):
    """Sum squares of pixels that are at most as wide as a voxel's image; returns how many each way, too.

    The last rows and columns, which fill no square, are left out.
    """
    sensor = imager.sensor
    wanted = float(imager.magnification(grid.depths).mean()) * grid.pitch / sensor.pixel_pitch
    # Two pixels each way must be left.
    side = max(1, min(int(wanted + _ROUNDING), min(sensor.shape) // 2))
    return eqx.tree_at(lambda i: i.sensor, imager, Readout(binning=side).sensor(sensor)), side


def slow_waves(imager: Imager, optics: Optics) -> int:
    """Of the image's longest cosine waves each way, those that a background makes which `optics` holds all of."""
    if isinstance(optics, PerTypePsf):
        optics = optics.optics[0]
    if not isinstance(optics, FieldVaryingPsf):
        return 0
    return round(max(imager.sensor.shape) * imager.sensor.pixel_pitch / (_SLOW * optics.stray_light.grid.pixel))
