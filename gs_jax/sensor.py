"""A camera sensor: its pixels in the frame of the microscope. Lengths are in millimetres."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .base.arrays import as_pair, as_shape


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
    >>> import gs_jax as gs, numpy as np
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

    def to_mm(self, pixels: Float[Array | np.ndarray, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Points `(x, y)` of fractional `(row, column)`; the inverse of `to_pixels`."""
        middle_row, middle_column = ((n - 1) / 2 for n in self.shape)
        x = (pixels[..., 1] - middle_column) * self.pixel_pitch + self.origin[0]
        y = (pixels[..., 0] - middle_row) * self.pixel_pitch + self.origin[1]
        return jnp.stack([x, y], axis=-1)
