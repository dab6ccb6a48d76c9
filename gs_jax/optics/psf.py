"""The point spread function of one lenslet on the sensor: PSF_o of Eq. (2).

`diffraction_psf` is scalar diffraction with the exact wavefront, `geometric_psf` counts rays, `gaussian_psf` is a
Gaussian with the moments of the rays. Each returns `(size, size)` pixels `[row, column]` with the sum 1, centred on the
chief ray of `gs_jax.microscope.geometry`: what that map leaves out (distortion, coma) is in the PSF. `spot_image` takes
diffraction or rays, whichever the width of the spot asks for.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import jit
from ..base.errors import InputError
from ..base.typing import Scalar, ScalarLike
from ..microscope.geometry import Imager, chief_ray
from .apertures import clear_diameter
from .diffraction import Edges, abs2, fourier_transform, soft_aperture, trace_exit_pupil
from .pupil import emission_lines, pupil_quadrature, pupil_radius, vogel_spiral
from .raytrace import Point, trace_lenslet
from .theory import airy_sigma, cutoff_frequency

# Rays of `geometric_psf` and `spot_image`; the quantile of their distances that is a spot's width; the smoothing of ray
# counts, of which a pixel has few, in pixels.
_RAYS, _QUANTILE, _SMOOTH = 2**15, 0.98, 1.0
# Window of `psf_of_depth`: margin for diffraction, largest reach of the rays in pixels, and rays along the radius.
_WINDOW_MARGIN, _FARTHEST, _FAN = 16, 128, 65


@partial(jit, static_argnames=("size", "samples"))
def diffraction_psf(
    imager: Imager,
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
    edges: Edges = None,
    samples: int = 4,
) -> Float[Array, "row column"]:
    """Diffraction PSF of one lenslet, integrated over the sensor's pixels.

    Differentiable in all but `size` and `samples`; maps over depths with `jax.vmap`. The pupil is lit evenly. For the
    paper's lens, phases are right to 2e-3 waves up to a radius of 0.65 mm and a field of 3 mm, or 1 mm on the axis; to
    0.1 waves at the rim for 0.8 mm and 3.6 mm. Beyond, near total reflection, light of the rim is lost.

    Parameters
    ----------
    imager
        The lens, the light, the sensor's pixels and its distance. The lens positions do not matter.
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
        Per pixel along an axis; the pupil gets as many samples as the window. At least
        `s = 2 radius pixel_pitch / (wavelength v)`, which is 2.8 for a radius of 0.65 mm at 4 mm; light outside
        `samples / s` windows is folded back.

    Raises
    ------
    ValueError
        If `size` is not odd and positive, or `samples` is not positive.
    """
    pixels = _pixel_energy(imager, depth, size, field, offset, radius, edges, samples)
    return pixels / jnp.sum(pixels)


@partial(jit, static_argnames=("size",))
def geometric_psf(
    imager: Imager,
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
    edges: Edges = None,
) -> Float[Array, "row column"]:
    """Density of 32768 rays, evenly over the pupil, each shared by the four nearest pixels; zero without any ray.

    Parameters and errors are those of `diffraction_psf`.
    """
    _check_size(size)
    radius = pupil_radius(imager, radius)
    points, from_chief, valid = _even_rays(imager, depth, field, radius)
    dtype = from_chief.dtype
    weights = jnp.where(valid, soft_aperture(points, radius, edges, radius * (np.pi / _RAYS) ** 0.5), 0)
    position = from_chief[:, ::-1] / imager.sensor.pixel_pitch + jnp.asarray(offset, dtype)[None] + size // 2
    corner = jnp.floor(position)
    fraction, corner = position - corner, corner.astype(int)
    image = jnp.zeros((size, size), dtype)
    # On a processor a scatter-add is faster than matrix products of shares (1.6 to 8 times) or a gather of sorted rays.
    for down, right in np.ndindex(2, 2):
        share = weights * jnp.abs(1 - down - fraction[:, 0]) * jnp.abs(1 - right - fraction[:, 1])
        row, column = corner[:, 0] + down, corner[:, 1] + right
        # A negative index would count from the end.
        row = jnp.where((row >= 0) & (column >= 0), row, size)
        image = image.at[row, column].add(share, mode="drop")
    total = jnp.sum(image)
    return image / jnp.where(total > 0, total, 1)


@partial(jit, static_argnames=("size",))
def gaussian_psf(
    imager: Imager,
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
) -> Float[Array, "row column"]:
    """Round Gaussian about the rays' centroid, integrated over the pixels.

    Its variance along an axis is that of the rays plus `airy_sigma` squared. Parameters and errors are those of
    `diffraction_psf`; the aperture is round, without `edges`.
    """
    _check_size(size)
    radius = pupil_radius(imager, radius)
    points, weights = pupil_quadrature(radius)
    rays = trace_lenslet(imager, depth, points, field)
    weights = jnp.where(rays.valid, weights, 0)
    weights = (weights / jnp.sum(weights))[:, None]
    centroid = jnp.sum(weights * rays.landing, 0)
    spread = jnp.sum(weights * (rays.landing - centroid[None]) ** 2) / 2
    airy = airy_sigma(imager.wavelength, imager.reduced_sensor_distance, 2 * radius)
    sigma = jnp.sqrt(spread + airy**2)
    pitch = imager.sensor.pixel_pitch
    shift = centroid - _chief_landing(imager, depth, field, radius.dtype)
    shift = shift + pitch * jnp.asarray(offset, radius.dtype)[::-1]
    borders = pitch * (jnp.arange(size + 1, dtype=radius.dtype) - size / 2)
    columns, rows = (jnp.diff(jax.scipy.stats.norm.cdf(borders, at, sigma)) for at in shift)
    image = rows[:, None] * columns[None]
    return image / jnp.sum(image)


def spot_image(
    imager: Imager, depth: ScalarLike, height: ScalarLike, *, size: int, radius: ScalarLike, samples: int
) -> Float[np.ndarray, "row column"]:
    """Light of a point on pixels about the chief ray, as fractions of that through the aperture.

    By diffraction; by rays where the spot is wider than the windows that `samples` resolve.

    Parameters
    ----------
    imager
        As of `diffraction_psf`.
    depth, height
        Of the object point, and its distance from the lens's axis, mm.
    size, radius, samples
        As of `diffraction_psf`.
    """
    from scipy.ndimage import gaussian_filter  # imported here: reconstruction does not need SciPy

    depth, height, radius = (jnp.asarray(x, imager.sensor_distance.dtype) for x in (depth, height, radius))
    pixel = imager.sensor.pixel_pitch
    field = height, jnp.zeros_like(height)
    _, offset, valid = (np.asarray(x) for x in _even_rays(imager, depth, field, radius))
    resolved = size * samples / least_samples(imager, 2 * float(radius)) / 2
    if valid.any() and np.quantile(np.abs(offset[valid]).max(1), _QUANTILE) < pixel * resolved:
        return np.asarray(_pixel_energy(imager, depth, size, field, (0.0, 0.0), radius, None, samples), float)
    edges = pixel * (np.arange(size + 1) - size / 2)
    counts = np.histogram2d(offset[valid, 1], offset[valid, 0], [edges, edges])[0] / max(valid.sum(), 1)
    return gaussian_filter(counts, _SMOOTH)


def least_samples(imager: Imager, diameter: Scalar) -> float:
    """`s` of `diffraction_psf`: samples per pixel below which light of the window itself is folded back."""
    cutoff = cutoff_frequency(imager.wavelength, imager.reduced_sensor_distance, diameter)
    return imager.sensor.pixel_pitch * float(cutoff)


PSFS = {"diffraction": diffraction_psf, "geometric": geometric_psf, "gaussian": gaussian_psf}


def psf_of_depth(
    imager: Imager, depths: Sequence[float] | np.ndarray, kind: str, steps: int = 1
) -> Callable[..., Float[Array, "row column"]]:
    """Function from a depth to its PSF on the axis, in one window that holds the rays of all depths.

    Parameters
    ----------
    imager
        The PSF is that of its mean clear aperture and height, and the mean over its emission band.
    depths
        Their range, mm.
    kind
        Of the PSF: a key of `PSFS`.
    steps
        Number of these pixels in a pixel of the real sensor: the margins of the window grow with it.

    Raises
    ------
    InputError
        If the rays reach farther than 128 pixels. Rays that are reflected totally do not count.
    """
    imager, height = imager.level()
    radius = clear_diameter(imager.array) / 2
    ends = [float(depth) - float(height) for depth in (min(depths), max(depths))]
    reaches = [float(_reach(imager, depth, radius)) for depth in ends]
    pixels = max(reaches) / (imager.sensor.pixel_pitch * steps)
    if not pixels <= _FARTHEST:
        depth = ends[int(np.argmax(reaches))]
        raise InputError(
            f"blur must reach at most {_FARTHEST} pixels of the sensor each way, got {pixels:.3g} for an object at "
            f"{depth:g} mm."
        )
    size = steps * (2 * math.ceil(pixels + _WINDOW_MARGIN) + 1)
    # As fine as the aperture diffracts.
    samples = math.ceil(least_samples(imager, 2 * radius)) if kind == "diffraction" else None

    def psf(depth):
        return _mean_psf(imager, depth - float(height), radius, kind=kind, size=size, samples=samples)

    return psf


@jit
def _reach(imager: Imager, depth, radius):
    """Largest distance on the sensor of a ray from a point on the axis, mm, over the emission band."""
    # All zones: near the focus of the rim's rays those of other zones land farther out.
    fan = radius * jnp.linspace(0, 1, _FAN, dtype=radius.dtype)[:, None] * jnp.array([[1.0, 0.0]], radius.dtype)
    rays = [trace_lenslet(line, depth, fan) for _, line in emission_lines(imager)]
    return jnp.max(jnp.stack([jnp.where(r.valid, jnp.abs(r.landing[:, 0]), 0) for r in rays]))


@partial(jit, static_argnames=("kind", "size", "samples"))
def _mean_psf(imager: Imager, depth, radius, *, kind: str, size: int, samples: int | None):
    """The mean PSF over the emission band."""
    make = PSFS[kind] if samples is None else partial(PSFS[kind], samples=samples)
    psfs = [weight * make(line, depth, size=size, radius=radius) for weight, line in emission_lines(imager)]
    return jnp.sum(jnp.stack(psfs), 0)


@jit
def _even_rays(imager: Imager, depth, field, radius):
    """Points evenly over the pupil, where their rays land from the chief ray's spot, mm, and whether they do."""
    order = np.arange(_RAYS) + 0.5
    points = radius * jnp.asarray(vogel_spiral(np.sqrt(order / _RAYS), order), radius.dtype)
    rays = trace_lenslet(imager, depth, points, field)
    return points, rays.landing - _chief_landing(imager, depth, field, rays.landing.dtype)[None], rays.valid


@partial(jit, static_argnames=("size", "samples"))
def _pixel_energy(imager, depth, size, field, offset, radius, edges, samples) -> Float[Array, "row column"]:
    """Energy on the pixels, as fractions of the energy through the pupil."""
    _check_size(size)
    if samples < 1:
        raise ValueError(f"`samples` must be positive, got {samples}.")
    count = size * samples
    pupil = trace_exit_pupil(imager, depth, field, radius, edges, count)
    dtype = pupil.distance.dtype
    pitch = imager.sensor.pixel_pitch / samples
    shift = pupil.chief - _chief_landing(imager, depth, field, dtype)
    shift = shift + imager.sensor.pixel_pitch * jnp.asarray(offset, dtype)[::-1]
    place = pitch * (jnp.arange(count, dtype=dtype) - (count - 1) / 2)
    scale = imager.wavelength * pupil.distance
    light = abs2(fourier_transform(pupil, place - shift[0], place - shift[1], 2 * np.pi / scale))
    pixels = light.reshape(size, samples, size, samples).sum((1, 3))
    # Parseval: the step of the pupil's grid over wavelength and distance, times the step on the sensor.
    step = (pupil.coordinate[1] - pupil.coordinate[0]) * pitch / scale
    return pixels * step**2 / jnp.sum(pupil.amplitude**2)


def _chief_landing(imager: Imager, depth, field, dtype) -> Array:
    """Where `gs_jax.microscope.geometry` has the chief ray land, from the lens's axis."""
    magnification = imager.magnification(jnp.asarray(depth, dtype))
    return chief_ray(jnp.zeros(2, dtype), jnp.asarray(field, dtype), magnification)


def _check_size(size: int) -> None:
    if size < 1 or size % 2 == 0:
        raise ValueError(f"`size` must be odd and positive, got {size}.")
