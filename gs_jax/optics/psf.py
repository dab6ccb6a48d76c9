"""The point spread function of one lens unit on the sensor: PSF_o of Eq. (2).

`diffraction_psf` is scalar diffraction with the exact wavefront of `gs_jax.optics.unit`; `geometric_psf` counts rays
and `gaussian_psf` is a Gaussian, for a fraction of the time. They return `(size, size)` pixels `[row, column]` with
the sum 1, however little of the light falls into the window (`window_fraction` says how much). In the middle is the
chief ray of `gs_jax.geometry`, not the true one: what the map gets wrong (distortion, coma) is in the PSF.

The field of `gs_jax.optics.exit_pupil` goes to the sensor by a Fourier transform, done by two small matrix products
(Soummer et al., Opt. Express 15, 15935, 2007).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..geometry import Imager, chief_ray
from .exit_pupil import ExitPupil, inside, phasor, trace_exit_pupil
from .theory import airy_deviation
from .unit import Point, pupil_disc, pupil_radius, unit_rays

_RAYS = 2**15
# Turn of Vogel's spiral, which spreads any number of points evenly over a disc.
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)

Scalar = Float[ArrayLike, ""]


@partial(jax.jit, static_argnames=("size", "samples"))
def diffraction_psf(
    imager: Imager,
    depth: Scalar,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: Scalar | None = None,
    edges: Float[Array | np.ndarray, "edge 2"] | None = None,
    samples: int = 4,
) -> Float[Array, "row column"]:
    """Diffraction PSF of one unit, integrated over the sensor's pixels, with the sum 1.

    Differentiable in everything but `size` and `samples`; maps over depths with `jax.vmap`. The pupil is lit evenly.
    Phases are good to 2e-3 waves for the paper's lens up to a radius of 0.65 mm and a field of 3 mm, or 1 mm on the
    axis; to 0.1 waves at the rim for 0.8 mm and 3.6 mm. Beyond, near total reflection, light of the rim is lost.

    Parameters
    ----------
    imager
        The lens, the light, the sensor's pixels and its distance. Where the lenses are does not matter.
    depth
        `z` of the object point, mm.
    size
        Pixels along a side of the window, odd.
    field
        `(x, y)` of the object point from the lens's axis, mm.
    offset
        `(row, column)` of the chief ray from the middle of the central pixel, in pixels.
    radius
        Of the clear aperture, mm. Half the aperture's diameter by default.
    edges
        Where neighbours cut the aperture: vectors `(x, y)` from the vertex to the nearest point of each straight edge,
        which is half-way to the neighbour, mm. None by default.
    samples
        In a pixel each way, and as many along the pupil as along the window. At least
        `s = 2 radius pixel_pitch / (wavelength v)`, which is 2.8 for a radius of 0.65 mm at 4 mm; what falls outside
        `samples / s` windows is folded back.

    Raises
    ------
    ValueError
        If `size` is not odd and positive, or `samples` is not positive.
    """
    pixels = _pixels(imager, depth, size, field, offset, radius, edges, samples)
    return pixels / jnp.sum(pixels)


@partial(jax.jit, static_argnames=("size", "samples"))
def window_fraction(
    imager: Imager,
    depth: Scalar,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: Scalar | None = None,
    edges: Float[Array | np.ndarray, "edge 2"] | None = None,
    samples: int = 4,
) -> Float[Array, ""]:
    """Share of the light through the pupil that falls into the window of `diffraction_psf`; same arguments."""
    return jnp.sum(_pixels(imager, depth, size, field, offset, radius, edges, samples))


@partial(jax.jit, static_argnames=("size",))
def geometric_psf(
    imager: Imager,
    depth: Scalar,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: Scalar | None = None,
    edges: Float[Array | np.ndarray, "edge 2"] | None = None,
) -> Float[Array, "row column"]:
    """Density of rays, each shared by the four pixels around it, with the sum 1 unless no ray is in the window.

    32768 rays, even over the pupil. Parameters are `diffraction_psf`'s.

    Raises
    ------
    ValueError
        If `size` is not odd and positive.
    """
    _check(size)
    order = np.arange(_RAYS) + 0.5
    spiral = np.sqrt(order / _RAYS) * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)])
    radius = pupil_radius(imager, radius)
    points = radius * jnp.asarray(spiral.T, radius.dtype)
    rays = unit_rays(imager, depth, points, field)
    weights = jnp.where(rays.valid, inside(points, radius, edges, radius * (np.pi / _RAYS) ** 0.5), 0)
    dtype = rays.landing.dtype
    from_chief = rays.landing - _map(imager, depth, field, dtype)[None]
    position = from_chief[:, ::-1] / imager.sensor.pixel_pitch + jnp.asarray(offset, dtype)[None] + size // 2
    corner = jnp.floor(position)
    fraction, corner = position - corner, corner.astype(int)
    image = jnp.zeros((size, size), dtype)
    # A scatter-add: on a processor a product of the rows' and the columns' shares takes 1.6 times as long for 15 pixels
    # and 8 times for 65, to sort the rays so that pixels gather them 4 to 9 times.
    for down, right in np.ndindex(2, 2):
        share = weights * jnp.abs(1 - down - fraction[:, 0]) * jnp.abs(1 - right - fraction[:, 1])
        row, column = corner[:, 0] + down, corner[:, 1] + right
        # A negative index would count from the end.
        row = jnp.where((row >= 0) & (column >= 0), row, size)
        image = image.at[row, column].add(share, mode="drop")
    total = jnp.sum(image)
    return image / jnp.where(total > 0, total, 1)


@partial(jax.jit, static_argnames=("size",))
def gaussian_psf(
    imager: Imager,
    depth: Scalar,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: Scalar | None = None,
) -> Float[Array, "row column"]:
    """Round Gaussian about the rays' centroid, integrated over the pixels, with the sum 1.

    Parameters are `diffraction_psf`'s; the aperture is round: it has no `edges`. The variance along an axis is the
    rays' (half the mean squared distance from their centroid) plus that of the Gaussian as wide at half its height as
    the Airy disc of the pupil: full width `1.029 wavelength v / diameter`.

    Raises
    ------
    ValueError
        If `size` is not odd and positive.
    """
    _check(size)
    radius = pupil_radius(imager, radius)
    points, weights = pupil_disc(radius)
    rays = unit_rays(imager, depth, points, field)
    weights = jnp.where(rays.valid, weights, 0)
    weights = (weights / jnp.sum(weights))[:, None]
    centroid = jnp.sum(weights * rays.landing, 0)
    spread = jnp.sum(weights * (rays.landing - centroid[None]) ** 2) / 2
    airy = airy_deviation(imager.wavelength, imager.reduced_sensor_distance, 2 * radius)
    sigma = jnp.sqrt(spread + airy**2)
    pitch = imager.sensor.pixel_pitch
    shift = centroid - _map(imager, depth, field, radius.dtype) + pitch * jnp.asarray(offset, radius.dtype)[::-1]
    borders = pitch * (jnp.arange(size + 1, dtype=radius.dtype) - size / 2)
    columns, rows = (jnp.diff(jax.scipy.stats.norm.cdf(borders, at, sigma)) for at in shift)
    image = rows[:, None] * columns[None]
    return image / jnp.sum(image)


@partial(jax.jit, static_argnames=("samples",))
def strehl(
    imager: Imager,
    depth: Scalar,
    *,
    field: Point = (0.0, 0.0),
    radius: Scalar | None = None,
    edges: Float[Array | np.ndarray, "edge 2"] | None = None,
    samples: int = 256,
) -> Float[Array, ""]:
    """Strehl ratio on the sensor: the highest irradiance over that of the same pupil without aberrations.

    Defocus counts; where the peak is does not. Unlike Eq. (9) it holds for any wavefront error.

    Parameters
    ----------
    imager, depth, field, radius, edges
        As for `diffraction_psf`.
    samples
        Along a side of the pupil: enough for a blur of `samples / 2` times `wavelength v / (2 radius)`.
    """
    pupil = trace_exit_pupil(imager, depth, field, radius, edges, samples)
    scale = imager.wavelength * pupil.distance
    turn = 2 * np.pi / scale

    def irradiance(point):
        return _squared(_transform(pupil, point[:1], point[1:], turn))[0, 0] / jnp.sum(pupil.amplitude) ** 2

    # The peak's place needs no derivative: there, the irradiance's derivative by it is zero.
    spacing = scale / (2 * (pupil.coordinate[-1] - pupil.coordinate[0]))
    places = spacing * (jnp.arange(samples, dtype=spacing.dtype) - samples // 2)
    table = _squared(_transform(pupil, places, places, turn))
    row, column = jnp.unravel_index(jnp.argmax(table), table.shape)
    start = jnp.stack([places[column], places[row]])

    def newton(point, _):
        gradient, hessian = jax.grad(irradiance)(point), jax.hessian(irradiance)(point)
        step = jnp.linalg.solve(hessian, gradient[:, None])[:, 0]
        return point - jnp.clip(step, -spacing / 2, spacing / 2), None

    peak, _ = jax.lax.scan(newton, start, length=3)
    return irradiance(jax.lax.stop_gradient(peak))


def _pixels(imager, depth, size, field, offset, radius, edges, samples) -> Float[Array, "row column"]:
    """Energy on the pixels, as shares of what comes through the pupil."""
    _check(size)
    if samples < 1:
        raise ValueError(f"`samples` must be positive, got {samples}.")
    count = size * samples
    pupil = trace_exit_pupil(imager, depth, field, radius, edges, count)
    dtype = pupil.distance.dtype
    pitch = imager.sensor.pixel_pitch / samples
    shift = pupil.chief - _map(imager, depth, field, dtype)
    shift = shift + imager.sensor.pixel_pitch * jnp.asarray(offset, dtype)[::-1]
    place = pitch * (jnp.arange(count, dtype=dtype) - (count - 1) / 2)
    scale = imager.wavelength * pupil.distance
    light = _squared(_transform(pupil, place - shift[0], place - shift[1], 2 * np.pi / scale))
    pixels = light.reshape(size, samples, size, samples).sum((1, 3))
    # Parseval: the step of the pupil's grid over wavelength and distance, times the step on the sensor.
    step = (pupil.coordinate[1] - pupil.coordinate[0]) * pitch / scale
    return pixels * step**2 / jnp.sum(pupil.amplitude**2)


def _transform(pupil: ExitPupil, x: Array, y: Array, turn: Array) -> Array:
    """The field at sensor points `(x, y)` from the chief ray's end."""
    rows = phasor(1, -turn * y[:, None] * pupil.coordinate[None])
    columns = phasor(1, -turn * pupil.coordinate[:, None] * x[None])
    return rows @ pupil.field @ columns


def _squared(field: Array) -> Array:
    return field.real**2 + field.imag**2


def _map(imager: Imager, depth, field, dtype) -> Array:
    """Where the geometry says that the chief ray lands, from the lens's axis."""
    magnification = imager.magnification(jnp.asarray(depth, dtype))
    return chief_ray(jnp.zeros(2, dtype), jnp.asarray(field, dtype), magnification)


def _check(size: int) -> None:
    if size < 1 or size % 2 == 0:
        raise ValueError(f"`size` must be odd and positive, got {size}.")
