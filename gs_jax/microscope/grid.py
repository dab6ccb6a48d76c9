"""The pixels of the sensor, and the voxels of the object space.

Volumes are `[depth, row, column]`; lengths are in millimetres.
"""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from ..base.arrays import FINITE, POSITIVE, as_float, as_pair, as_shape, check_fields, native, one_program


class Sensor(eqx.Module):
    """A camera sensor of square pixels, in the plane `z = -v` behind the lenses.

    *Differentiable.*

    Parameters
    ----------
    shape
        `(rows, columns)`, at least two each: interpolation needs neighbours.
    pixel_pitch
        Distance of pixel centres, mm: a plain number, as a camera is not optimised.
    origin
        `(x, y)` of the middle of these pixels, mm, for a region of a sensor whose centre is the frame's origin.

    Raises
    ------
    ValueError
        If there are fewer than 2 x 2 pixels, the pitch is not positive, or the origin is not finite.

    Examples
    --------
    >>> sensor = gs.Sensor((3000, 4096), pixel_pitch=0.00345)
    >>> print(sensor.to_pixels(np.array([0.0, 0.0])))  # the middle, (row, column)
    [1499.5 2047.5]
    """

    shape: tuple[int, int] = eqx.field(static=True, converter=as_shape)
    pixel_pitch: float = eqx.field(static=True, converter=float)
    origin: tuple[float, float] = eqx.field(static=True, converter=as_pair, default=(0.0, 0.0))

    def __check_init__(self):
        if min(self.shape) < 2:
            raise ValueError(f"`shape` must be two numbers of pixels, each 2 or more, got {self.shape}.")
        if not self.pixel_pitch > 0:
            raise ValueError(f"`pixel_pitch` must be positive, got {self.pixel_pitch}.")
        if not all(map(math.isfinite, self.origin)):
            raise ValueError(f"`origin` must be two finite numbers, got {self.origin}.")

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges of an image of this sensor for `imshow`, `(left, right, bottom, top)`, mm; row 0 is at the top."""
        (x, y), (rows, columns) = self.origin, self.shape
        across, along = columns * self.pixel_pitch / 2, rows * self.pixel_pitch / 2
        return x - across, x + across, y + along, y - along

    def to_pixels(self, points: Float[Array | np.ndarray, "*batch 2"]) -> Float[Array | np.ndarray, "*batch 2"]:
        """Fractional `(row, column)` of points `(x, y)`, NumPy's if these are; pixel centres have whole numbers."""
        middle_row, middle_column = ((n - 1) / 2 for n in self.shape)
        row = (points[..., 1] - self.origin[1]) / self.pixel_pitch + middle_row
        column = (points[..., 0] - self.origin[0]) / self.pixel_pitch + middle_column
        return (np if isinstance(points, np.ndarray) else jnp).stack([row, column], axis=-1)

    def to_mm(self, pixels: Num[Array | np.ndarray, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Points `(x, y)` of fractional `(row, column)`; the inverse of `to_pixels`."""
        middle = tuple((n - 1) / 2 for n in self.shape)
        if not isinstance(pixels, Array):  # float64 of NumPy loses no digits before the middle is subtracted
            pixels, middle = native(pixels) - np.array(middle), (0.0, 0.0)
        return self._scaled(as_float(pixels), *middle)

    @one_program
    def _scaled(self, pixels, middle_row, middle_column):
        x = (pixels[..., 1] - middle_column) * self.pixel_pitch + self.origin[0]
        y = (pixels[..., 0] - middle_row) * self.pixel_pitch + self.origin[1]
        return jnp.stack([x, y], axis=-1)


class Grid(eqx.Module):
    """Voxels of the object space; centred on the axis, unless it has another origin.

    *Differentiable.*

    Parameters
    ----------
    depths
        `(depth,)` of the planes, mm, evenly spaced or not. Back-projection and the forward model take any order;
        what interpolates between planes or writes them to disk says if they must ascend.
    shape
        `(rows, columns)` of each plane.
    pitch
        Lateral distance of voxel centres, mm. Like the field radius it decides shapes: a plain number.
    origin
        `(x, y)` of the middle of each plane, mm: of a region of interest beside the axis.

    Raises
    ------
    ValueError
        If there is no depth, no voxel, the pitch or a depth is not positive, or a number is not finite (values that JAX
        traces are not looked at).

    Examples
    --------
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> grid.volume_shape
    (3, 41, 41)
    >>> grid.at([19.0, 21.0]).volume_shape
    (2, 41, 41)
    """

    depths: Float[Array, " depth"] = eqx.field(converter=as_float)
    shape: tuple[int, int] = eqx.field(static=True, converter=as_shape)
    pitch: float = eqx.field(static=True, converter=float)
    origin: Float[Array, "2"] = eqx.field(converter=as_float, default=(0.0, 0.0))

    def __check_init__(self):
        if self.depths.ndim != 1 or self.depths.size < 1:
            raise ValueError(f"`depths` must be (depth,) with a depth at least, got {self.depths.shape}.")
        if min(self.shape) < 1:
            raise ValueError(f"`shape` must be two positive numbers of voxels, got {self.shape}.")
        if not self.pitch > 0:
            raise ValueError(f"`pitch` must be positive, got {self.pitch}.")
        check_fields(self, depths=POSITIVE, origin=FINITE)

    @classmethod
    def over(cls, sensor: Sensor, *, depths, pitch: float) -> "Grid":
        """The grid that covers as much of the object as the sensor is large (the paper's field of view).

        Its numbers of rows and columns are odd: there is a voxel at the sensor's origin, by default on the axis.
        `depths` and `pitch` are mm.
        """
        if not pitch > 0:
            raise ValueError(f"`pitch` must be positive, got {pitch}.")
        rows, columns = (2 * round((n * sensor.pixel_pitch / pitch - 1) / 2) + 1 for n in sensor.shape)
        rows, columns = max(rows, 1), max(columns, 1)
        return cls(depths, (rows, columns), pitch, sensor.origin)

    def at(self, depths) -> "Grid":
        """The same voxels at other depths `(depth,)`, or at a single one, mm; `ValueError` as for a new grid."""
        return dataclasses.replace(self, depths=jnp.atleast_1d(jnp.asarray(depths, self.depths.dtype)))

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """`(depths, rows, columns)` of a volume on this grid."""
        return self.depths.size, *self.shape

    @property
    @one_program
    def y(self) -> Float[Array, " row"]:
        """Voxel centres along the rows' axis, mm."""
        return self.origin[1] + self._offsets(self.shape[0])

    @property
    @one_program
    def x(self) -> Float[Array, " column"]:
        """Voxel centres along the columns' axis, mm."""
        return self.origin[0] + self._offsets(self.shape[1])

    def _offsets(self, count):
        return (jnp.arange(count, dtype=self.depths.dtype) - (count - 1) / 2) * self.pitch

    def to_mm(self, voxels: Int[Array | np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points `(x, y, z)` of the voxels `(depth, row, column)`, mm, on the host in float64."""
        depth, row, column = np.moveaxis(np.asarray(voxels), -1, 0)
        axes = ((self.x, column), (self.y, row), (self.depths, depth))
        return np.stack([np.asarray(axis, np.float64)[index] for axis, index in axes], axis=-1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges of a plane for `imshow`, `(left, right, bottom, top)`, mm; row 0 is at the top."""
        (x, y), (rows, columns) = map(float, self.origin), self.shape
        across, along = columns * self.pitch / 2, rows * self.pitch / 2
        return x - across, x + across, y + along, y - along
