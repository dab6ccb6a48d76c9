"""The chief rays of a grid of voxels through every lens, as short tables: one row per axis, lens and depth.

The map of `geometry.chief_ray` acts on x and y apart, so the pixel that a lens gives to a voxel needs a row
number and a column number only: per lens `2 x depths x patch` of them instead of `depths x patch^2`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..geometry import Imager, chief_ray, envelope, field_limit
from ..grid import Grid
from ..optics.psf_core import ring_light

# Added to the squared distance of what falls off the sensor, mm^2: it lands outside the field of every lens,
# where the envelope and all its derivatives vanish.
_OUTSIDE = 1e8
# Neighbouring lenses read neighbouring pixels: in bands of this height (in field radii) the cache is used best.
_BAND = 0.5


class Axis(NamedTuple):
    """One axis (rows or columns) of the rays, over the patch of voxels that a lens can see."""

    start: Int[Array, "lens patch"]  # first voxel of the patch: of all depths, or of each if the array is tilted
    pixel: Int[Array, "lens depth voxel"]  # the pixel at or below the ray
    fraction: Float[Array, "lens depth voxel"]  # of the way to the next pixel
    distance2: Float[Array, "lens depth voxel"]  # squared distance from the lens's axis, mm^2; huge off the sensor
    origin: Float[Array, "lens depth"]  # voxel b has the pixel floor(origin - b spacing), up to rounding


class Rays(NamedTuple):
    """All chief rays between a sensor and a grid, sparse by lens."""

    y: Axis
    x: Axis
    spacing: Float[Array, "lens depth"]  # of neighbouring voxels on the sensor, pixels
    parameters: Float[Array, "depth parameter"]  # of the lenses' weight at each depth


class Envelope(NamedTuple):
    """What a lens gives to a point's image: the envelope C. Its parameter is the reduced depth."""

    field_radius: float

    @property
    def limit(self) -> float:
        """Lateral distance from a lens's axis from which on the weight is zero, mm."""
        return field_limit(self.field_radius)

    def __call__(self, distance2, parameters):
        return envelope(distance2, parameters[..., 0], self.field_radius)


class RingLight(NamedTuple):
    """What the core of a spot holds of a point's light, in a ring of the field; see `gs_jax.optics.psf_core`."""

    inner: float
    outer: float

    @property
    def limit(self) -> float:
        return field_limit(self.outer)

    def __call__(self, distance2, parameters):
        return ring_light(distance2, parameters, self.inner, self.outer)


def trace(
    imager: Imager,
    grid: Grid,
    *,
    nearest: bool,
    dtype,
    limit: float | None = None,
    parameters: Float[Array, "depth parameter"] | None = None,
) -> Rays:
    """The rays of every voxel through every lens that sees it, in a cache-friendly order of lenses.

    With `nearest` they are moved to the nearest pixel centre, as in the paper. `dtype` is the type of the
    tables; the coordinates are computed in the geometry's own. A lens sees what is nearer to its axis than `limit`, mm;
    that and the `parameters` of its weight are by default those of the envelope.
    """
    if parameters is None:
        parameters = jnp.asarray(imager.reduced_depth(grid.depths))[:, None]
    order = _snake(imager.centers, _BAND * imager.field_radius)
    magnification = imager.magnifications(grid.depths)
    magnification = magnification if len(magnification) == 1 else magnification[order]
    reach = field_limit(imager.field_radius) if limit is None else limit
    (x, y), (x_lean, y_lean) = imager.centers[order].T, imager.axis_offset(grid.depths).T

    def axis(center, origin, voxels, pixels, middle, lean):
        size = min(voxels, int(2 * reach / grid.pitch) + 1)
        # The axes of a tilted array lean, and what a lens sees moves with the depth.
        axis = center[:, None] if imager.tilt is None else center[:, None] + lean[None, :]
        first = jnp.ceil((axis - origin - reach) / grid.pitch + (voxels - 1) / 2).astype(jnp.int32)
        start = jnp.clip(first, 0, voxels - size)
        voxel = start[..., None] + jnp.arange(size, dtype=jnp.int32)[None, None]
        index = voxel.astype(center.dtype) - (voxels - 1) / 2
        from_grid, center = center - origin, center - middle
        pixel, fraction, offset = _project(
            center, from_grid, index, magnification, grid.pitch, imager.sensor.pixel_pitch, pixels, nearest
        )
        coordinate = pixel.astype(fraction.dtype) + fraction
        on_sensor = (coordinate >= 0) & (coordinate <= pixels - 1)
        distance2 = jnp.where(on_sensor, (offset + lean[None, :, None]) ** 2, _OUTSIDE)
        first_coordinate = jax.lax.stop_gradient(coordinate[..., 0])
        return Axis(start, pixel, fraction.astype(dtype), distance2.astype(dtype), first_coordinate)

    return Rays(
        y=axis(y, grid.origin[1], grid.shape[0], imager.sensor.shape[0], imager.sensor.origin[1], y_lean),
        x=axis(x, grid.origin[0], grid.shape[1], imager.sensor.shape[1], imager.sensor.origin[0], x_lean),
        spacing=jax.lax.stop_gradient(
            jnp.broadcast_to(magnification * (grid.pitch / imager.sensor.pixel_pitch), (len(order), len(grid.depths)))
        ),
        parameters=parameters.astype(dtype),
    )


def _project(center, from_origin, index, magnification, voxel_pitch, pixel_pitch, pixels, nearest):
    """Pixel and fraction `(lens, depth, voxel)` of one coordinate, and the offset `(lens, patch, voxel)` to the vertex.

    `index` is `(lens, patch, voxel)`: one patch for all depths, or one for each. `center` is the lens's as seen from
    the middle of the sensor's pixels, `from_origin` as seen from the grid's origin, where voxels are counted from.
    `magnification` is `(lens, depth)`.
    """
    # Counted from the pixel nearest to the lens's centre, where numbers are small: a float32 coordinate over
    # 5,000 pixels would be 2e-4 of a pixel off. The map does not mind where the origin is.
    whole = jax.lax.stop_gradient(jnp.round(center / pixel_pitch))
    center_here = _minus_multiple(center, whole, pixel_pitch)[:, None, None]
    offset = _minus_multiple(from_origin[:, None, None], index, voxel_pitch)
    ray = chief_ray(center_here, center_here - offset, magnification[:, :, None])
    middle = (pixels - 1) / 2
    coordinate = ray / pixel_pitch + middle % 1
    below = jax.lax.stop_gradient(jnp.floor(coordinate + 0.5 if nearest else coordinate))
    pixel = (below + whole[:, None, None]).astype(jnp.int32) + int(middle)
    fraction = jnp.zeros_like(coordinate) if nearest else coordinate - below
    return pixel, fraction, offset


def _minus_multiple(x: Float[Array, "..."], count: Float[Array, "..."], step: float) -> Float[Array, "..."]:
    """`x - count * step` without the rounding of the product, for whole or half counts below 2^13."""
    mantissa, exponent = np.frexp(step)
    high = float(np.ldexp(np.round(mantissa * 2**10), exponent - 10))  # so few digits that count * high is exact
    return (x - count * high) - count * (step - high)


def _snake(centers: Float[Array, "lens 2"], height: float) -> Int[Array, " lens"]:
    """Order that runs through the lenses band by band of a height, mm, to and fro."""
    x, y = jax.lax.stop_gradient(centers).T
    band = jnp.floor(y / height)
    return jnp.lexsort((jnp.where(band % 2 == 0, x, -x), band))
