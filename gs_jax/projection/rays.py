"""Chief rays of a grid of voxels through every lens, as short tables: one row per axis, lens and depth.

The map of `geometry.chief_ray` acts on x and y separately, so the pixel that a lens gives to a voxel needs only a row
number and a column number: per lens `2 x depths x patch` of them instead of `depths x patch^2`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..base.typing import Scalar
from ..microscope.geometry import FALLOFF, Imager, chief_ray, envelope, field_limit
from ..microscope.grid import Grid
from ..optics.psf_core import ring_light

# Squared distance, mm^2, added for rays off the sensor: outside the field of every lens, where the envelope and all
# its derivatives vanish.
OUTSIDE = 1e8
# Neighbouring lenses read neighbouring pixels: an order in bands of this height, in field radii, suits the cache best.
_BAND = 0.5


class Axis(NamedTuple):
    """One axis (rows or columns) of the rays, over the patch of voxels that a lens can see."""

    start: Int[Array, "lens patch"]  # first voxel of the patch: of all depths, or of each if the array is tilted
    pixel: Int[Array, "lens depth voxel"]  # the pixel at or below the ray
    fraction: Float[Array, "lens depth voxel"]  # of the way to the next pixel
    distance2: Float[Array, "lens depth voxel"]  # squared distance from the lens's axis, mm^2; huge off the sensor
    origin: Float[Array, "lens depth"]  # voxel b has the pixel floor(origin - b spacing), up to rounding


class Envelope(NamedTuple):
    """The lens weight of Eq. (2), the envelope C. Its parameter is the reduced depth."""

    field_radius: Scalar | float

    @property
    def limit(self) -> Scalar | float:
        """Lateral distance from a lens's axis, mm, beyond which the weight is zero."""
        return field_limit(self.field_radius)

    def __call__(self, distance2, parameters):
        return envelope(distance2, parameters[..., 0], self.field_radius)


class RingLight(NamedTuple):
    """The share of a point's light in the core of a spot, in a ring of the field; see `gs_jax.optics.psf_core`."""

    inner: Scalar | float
    outer: Scalar | float

    @property
    def limit(self) -> Scalar | float:
        return field_limit(self.outer)

    def __call__(self, distance2, parameters):
        return ring_light(distance2, parameters, self.inner, self.outer)


def weight_numbers(weight):
    """Encode a weight for a kernel: kind, cutoff, falloff slope, the same for its hole (0 if none), scale."""

    def falloff(radius):
        exists = radius > 0
        slope = jnp.where(exists, 1 / (2 * FALLOFF * jnp.where(exists, radius, 1) ** 2), 0)
        return field_limit(radius) ** 2, slope

    if isinstance(weight, Envelope):
        numbers = (0, *falloff(weight.field_radius), 0, 0, 0)
    else:
        numbers = (1, *falloff(weight.outer), *falloff(weight.inner), 1 / weight.outer**2)
    return jnp.stack([jnp.asarray(number, jnp.float32) for number in numbers])


class Rays(NamedTuple):
    """All chief rays between a sensor and a grid, sparse by lens."""

    y: Axis
    x: Axis
    spacing: Float[Array, "lens depth"]  # of neighbouring voxels on the sensor, pixels
    weight: Envelope | RingLight  # of a lens, by the squared distance from its axis
    parameters: Float[Array, "depth parameter"]  # of the weight at each depth


class Shapes(NamedTuple):
    """What must be known before tracing."""

    image: tuple[int, int]
    volume: tuple[int, int, int]


def trace(
    imager: Imager,
    grid: Grid,
    *,
    nearest: bool,
    dtype,
    distortion: Float[Array, " depth"] | None = None,
    weight: Envelope | RingLight | None = None,
    parameters: Float[Array, "depth parameter"] | None = None,
    limit: float | None = None,
) -> Rays:
    """The rays of every voxel through every lens that sees it, in a cache-friendly order of lenses.

    With `nearest` they are moved to the nearest pixel centre, as in the paper. `dtype` is the type of the tables; the
    coordinates are computed in that of the geometry. `distortion` is that of `Imager.views`, at each depth. By default
    the lens's `weight` and its `parameters` are those of the envelope. `limit` is the largest radius of a lens's field
    that the rays are to cover, mm; by default the weight's.
    """
    distortion = jnp.ones_like(grid.depths) if distortion is None else distortion.astype(grid.depths.dtype)
    weight = Envelope(imager.field_radius) if weight is None else weight
    if parameters is None:
        parameters = jnp.asarray(imager.reduced_depth(grid.depths))[:, None]
    order = _snake(imager.centers, _BAND * imager.field_radius)
    magnification = imager.magnifications(grid.depths, distortion)
    magnification = magnification if len(magnification) == 1 else magnification[order]
    reach = weight.limit if limit is None else limit
    (x, y), (x_offset, y_offset) = imager.centers[order].T, imager.axis_offset(grid.depths).T
    # Where a tilted array has the spots of points that are moved by `lean`, about a sensor that is moved back.
    (x_lean, y_lean), (x_moved, y_moved) = imager.lean(grid.depths, distortion).T, imager.spot_displacement
    sensor_x, sensor_y = imager.sensor.origin

    def axis(center, origin, voxels, pixels, middle, axis_offset, lean):
        size = min(voxels, int(2 * reach / grid.pitch) + 1)
        # The axes of a tilted array are tilted, and a lens's field moves with the depth.
        axis = center[:, None] if imager.tilt is None else center[:, None] + axis_offset[None, :]
        first = jnp.ceil((axis - origin - reach) / grid.pitch + (voxels - 1) / 2).astype(jnp.int32)
        start = jnp.clip(first, 0, voxels - size)
        voxel = start[..., None] + jnp.arange(size, dtype=jnp.int32)[None, None]
        index = voxel.astype(center.dtype) - (voxels - 1) / 2
        from_grid, center = center - origin, center - middle
        pixel, fraction, offset = _project(
            center, from_grid, index, lean, magnification, grid.pitch, imager.sensor.pixel_pitch, pixels, nearest
        )
        coordinate = pixel.astype(fraction.dtype) + fraction
        on_sensor = (coordinate >= 0) & (coordinate <= pixels - 1)
        distance2 = jnp.where(on_sensor, (offset + axis_offset[None, :, None]) ** 2, OUTSIDE)
        first_coordinate = jax.lax.stop_gradient(coordinate[..., 0])
        return Axis(start, pixel, fraction.astype(dtype), distance2.astype(dtype), first_coordinate)

    return Rays(
        y=axis(y, grid.origin[1], grid.shape[0], imager.sensor.shape[0], sensor_y - y_moved, y_offset, y_lean),
        x=axis(x, grid.origin[0], grid.shape[1], imager.sensor.shape[1], sensor_x - x_moved, x_offset, x_lean),
        spacing=jax.lax.stop_gradient(
            jnp.broadcast_to(magnification * (grid.pitch / imager.sensor.pixel_pitch), (len(order), len(grid.depths)))
        ),
        weight=jax.tree.map(lambda number: jnp.asarray(number, dtype), weight),
        parameters=parameters.astype(dtype),
    )


def _project(center, from_origin, index, lean, magnification, voxel_pitch, pixel_pitch, pixels, nearest):
    """Pixel and fraction `(lens, depth, voxel)` of one coordinate, and the offset `(lens, patch, voxel)` to the vertex.

    `index` is `(lens, patch, voxel)`: one patch for all depths, or one for each. The lens is at `center` from the
    middle of the sensor's pixels, and at `from_origin` from the grid's origin. `lean` `(depth,)` displaces voxels.
    `magnification` is `(lens, depth)`.
    """
    # Relative to the pixel nearest to the lens's centre, where numbers are small: a float32 coordinate over 5,000
    # pixels would be 2e-4 of a pixel off. The map is the same for any origin.
    whole = jax.lax.stop_gradient(jnp.round(center / pixel_pitch))
    center_here = _minus_multiple(center, whole, pixel_pitch)[:, None, None]
    offset = _minus_multiple(from_origin[:, None, None], index, voxel_pitch)
    ray = chief_ray(center_here, center_here - offset + lean[None, :, None], magnification[:, :, None])
    middle = (pixels - 1) / 2
    coordinate = ray / pixel_pitch + middle % 1
    below = jax.lax.stop_gradient(jnp.floor(coordinate + 0.5 if nearest else coordinate))
    pixel = (below + whole[:, None, None]).astype(jnp.int32) + int(middle)
    fraction = jnp.zeros_like(coordinate) if nearest else coordinate - below
    return pixel, fraction, offset


def _minus_multiple(x: Float[Array, "..."], count: Float[Array, "..."], step: float) -> Float[Array, "..."]:
    """`x - count * step` without rounding the product, for multiples of 1/2 below 2^13."""
    mantissa, exponent = np.frexp(step)
    high = float(np.ldexp(np.round(mantissa * 2**10), exponent - 10))  # so few digits that count * high is exact
    return (x - count * high) - count * (step - high)


def _snake(centers: Float[Array, "lens 2"], height: float) -> Int[Array, " lens"]:
    """An order of the lenses band by band of a height, mm, to and fro."""
    x, y = jax.lax.stop_gradient(centers).T
    band = jnp.floor(y / height)
    return jnp.lexsort((jnp.where(band % 2 == 0, x, -x), band))


class Pair(NamedTuple):
    """The two pixels between which a ray is interpolated; always on the sensor, even if the ray is not."""

    low: Int[Array, "... depth voxel"]
    fraction: Float[Array, "... depth voxel"]


def pairs(shapes: Shapes, rays: Rays) -> tuple[Pair, Pair]:
    def pair(axis, pixels):
        low = jnp.clip(axis.pixel, 0, pixels - 2)
        return Pair(low, axis.fraction + (axis.pixel - low).astype(axis.fraction.dtype))

    return pair(rays.y, shapes.image[0]), pair(rays.x, shapes.image[1])


def interpolate(corners, down, right):
    """The pixels between four corners, and their derivatives by row and column, at fractions that broadcast."""
    upper_left, upper_right, lower_left, lower_right = corners
    upper = upper_left + right * (upper_right - upper_left)
    lower = lower_left + right * (lower_right - lower_left)
    along_x = (1 - down) * (upper_right - upper_left) + down * (lower_right - lower_left)
    return upper + down * (lower - upper), lower - upper, along_x
