"""The exit pupil of a lens unit: the field to be transformed to the sensor.

Huygens' principle sums `exp(2 pi i (L + |P - B|) / wavelength)` over the points B of the convex surface, with the
path L from the object to B. For each B, `|P - B| - (P - P_0)^2 / (2 rho)`, with the chief ray's end P_0 and its length
rho, is made linear in P about the point where the ray from B lands. What is left out is of the second order in
the distance from there, and that is small: light is near its ray. So both limits are right, the Fresnel integral of a
lens with a small angle and the ray density of one with strong aberrations, and the sum becomes a Fourier transform.

The point spread function of one lens unit on the sensor: PSF_o of Eq. (2).

`diffraction_psf` is scalar diffraction with the exact wavefront; `geometric_psf` counts rays
and `gaussian_psf` is a Gaussian, for a fraction of the time. They return `(size, size)` pixels `[row, column]` with
the sum 1, however little of the light falls into the window (`window_fraction` says how much). In the middle is the
chief ray of `gs_jax.geometry`, not the true one: what the map gets wrong (distortion, coma) is in the PSF.

The field of `gs_jax.optics.psf` goes to the sensor by a Fourier transform, done by two small matrix products
(Soummer et al., Opt. Express 15, 15935, 2007).

PSFs of many depths in one window, which holds the rays of all.

To add a kind of PSF, write its function beside those of `gs_jax.optics.psf` and name it in `PSFS`.

The Strehl ratio of a lens unit on its axis by one line of rays: fast enough for thousands of lenses.

`gs_jax.optics.psf.strehl` has any field, any aperture and the peak wherever it is, for as much as a thousand times the
work. A spot on the axis is round, and what `gs_jax.optics.psf` sums over the exit pupil is an integral over its
radius `u`: with the phase `phi` of the path there, and light that is even over the lens, hence the amplitude
`sqrt(r dr / (u du))` of the lens's radius `r`, the field in the middle is `int exp(2 pi i phi / wavelength)
sqrt(u u'/r) r dr`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from ..base.errors import InputError
from ..geometry import Imager, chief_ray
from ..typing import ScalarLike
from .apertures import clear_diameter
from .raytrace import Point, chief_ray_length, direction_cosines, pupil_quadrature, pupil_radius, trace_lenslet
from .theory import airy_sigma

# The grid in the exit pupil reaches this much beyond the lens's own radius, for the pupil's distortion.
_PUPIL_MARGIN = 1.08
# The ray from a point of the exit pupil: degree of the polynomials that start the search, and its steps.
_DEGREE = 7
_PUPIL_STEPS = 1
# How far from its place, in radii, a ray may come: the error of its phase is of the second order in that.
_CLOSE = 0.02


class ExitPupil(NamedTuple):
    """The exit pupil on a square grid.

    `coordinate`: along each side, mm. `field` and its modulus `amplitude`. `chief`: where the chief ray meets the
    sensor, `(x, y)` from the lens's axis, mm; `distance`: its length behind the vertex as the sensor sees it, mm.
    """

    coordinate: Float[Array, " sample"]
    field: Complex[Array, "sample sample"]
    amplitude: Float[Array, "sample sample"]
    chief: Float[Array, "2"]
    distance: Float[Array, ""]


def trace_exit_pupil(imager: Imager, depth, field, radius, edges, count: int) -> ExitPupil:
    """The lens seen from the sensor: for each point of a grid the ray that comes from there, and its phase.

    The coordinate is `u = D - rho (e - e_0)` with the ray's end D from the chief ray's, its direction cosines e and
    the chief ray's length rho: the point of the lens, but for the third order. The phase is that of the path
    less `e D - D^2 / (2 rho)`. By Hamilton's theorem its slope is `-D / rho`, which makes up for what `_lens_points`
    leaves. Parameters are `gs_jax.optics.psf.diffraction_psf`'s, with `count` samples along a side.
    """
    radius = pupil_radius(imager, radius)
    reach = _PUPIL_MARGIN * radius
    chief = trace_lenslet(imager, depth, np.zeros(2), field)
    distance = chief_ray_length(imager, chief)

    def trace(points):
        rays = trace_lenslet(imager, depth, points, field)
        end, cosines = rays.landing - chief.landing[None], direction_cosines(rays.tangent)
        return rays, end, cosines, end - distance * (cosines - direction_cosines(chief.tangent)[None])

    known, weights = pupil_quadrature(radius)
    rays, _, _, found = trace(known)
    coordinate = reach * jnp.asarray(np.linspace(-1, 1, count), radius.dtype)
    wanted = jnp.stack(jnp.meshgrid(coordinate, coordinate), -1).reshape(-1, 2)
    points, along_x, along_y = _lens_points(known / reach, found / reach, jnp.where(rays.valid, weights, 0), count)
    points = reach * points
    for _ in range(_PUPIL_STEPS):
        rays, _, _, found = trace(points)
        missing = jnp.where(rays.valid[:, None], wanted - found, 0)
        points = points + along_x * missing[:, :1] + along_y * missing[:, 1:]
    rays, end, cosines, found = trace(points)
    path = rays.path - jnp.sum(end * cosines, -1) + jnp.sum(end * (end / 2 - wanted + found), -1) / distance
    # Around the lens the search may end at another ray: nothing comes from there.
    lit = rays.valid & (jnp.sum((wanted - found) ** 2, -1) < (_CLOSE * radius) ** 2)
    share = soft_aperture(points, radius, edges, coordinate[1] - coordinate[0])
    # Light that is even over the lens is denser where the exit pupil is narrower.
    density = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
    lit = lit & (density > 0)
    amplitude = jnp.where(lit, share * jnp.sqrt(jnp.where(lit, density, 1)), 0)
    phase = jnp.where(lit, 2 * np.pi / imager.wavelength * path, 0)
    amplitude, phase = amplitude.reshape(count, count), phase.reshape(count, count)
    return ExitPupil(coordinate, phasor(amplitude, phase), amplitude, chief.landing, distance)


def _lens_points(known: Array, found: Array, weights: Array, count: int) -> list[Float[Array, "point 2"]]:
    """Points of the lens for a `count` x `count` grid over [-1, 1] of the exit pupil, and their derivatives by x and y.

    Polynomials of total degree `_DEGREE`, fitted to pairs of points `known` on the lens and `found` in the exit pupil.
    """
    x, y = (_chebyshev(c) for c in found.T)
    rows, columns = np.nonzero(np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE)
    basis = y[:, rows] * x[:, columns]
    weighted = basis * weights[:, None]
    fit = jnp.linalg.solve(weighted.T @ basis, weighted.T @ known)
    table = jnp.zeros((2, _DEGREE + 1, _DEGREE + 1), known.dtype).at[:, rows, columns].set(fit.T)
    side = jnp.asarray(np.linspace(-1, 1, count), known.dtype)
    value, slope = jax.jvp(_chebyshev, (side,), (jnp.ones_like(side),))
    pairs = ((value, value), (value, slope), (slope, value))
    return [(row @ table @ column.T).reshape(2, -1).T for row, column in pairs]


def _chebyshev(x: Float[Array, " point"]) -> Float[Array, "point degree"]:
    terms = [jnp.ones_like(x), x]
    for _ in range(_DEGREE - 1):
        terms.append(2 * x * terms[-1] - terms[-2])
    return jnp.stack(terms, -1)


def soft_aperture(points: Float[Array, "point 2"], radius: Array, edges, step: Array) -> Float[Array, " point"]:
    """How far points of the lens are within the aperture: from 0 to 1 over one step, for the sake of gradients."""
    inward = radius - jnp.sqrt(jnp.maximum(jnp.sum(points**2, -1), step**2))
    if edges is not None:
        edges = jnp.asarray(edges, radius.dtype)
        length = jnp.sqrt(jnp.sum(edges**2, -1))
        for edge, at in zip(edges, length, strict=True):
            inward = jnp.minimum(inward, at - points @ (edge / at))
    return jnp.clip(inward / step + 0.5, 0, 1)


def phasor(length: ArrayLike, phase: Array) -> Complex[Array, "..."]:
    """`length exp(i phase)`, in the phase's precision."""
    return jax.lax.complex(length * jnp.cos(phase), length * jnp.sin(phase))


_RAYS = 2**15
# Turn of Vogel's spiral, which spreads any number of points evenly over a disc.
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


@partial(jax.jit, static_argnames=("size", "samples"))
def diffraction_psf(
    imager: Imager,
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
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
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
    edges: Float[Array | np.ndarray, "edge 2"] | None = None,
    samples: int = 4,
) -> Float[Array, ""]:
    """Share of the light through the pupil that falls into the window of `diffraction_psf`; same arguments."""
    return jnp.sum(_pixels(imager, depth, size, field, offset, radius, edges, samples))


@partial(jax.jit, static_argnames=("size",))
def geometric_psf(
    imager: Imager,
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
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
    rays = trace_lenslet(imager, depth, points, field)
    weights = jnp.where(rays.valid, soft_aperture(points, radius, edges, radius * (np.pi / _RAYS) ** 0.5), 0)
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
    depth: ScalarLike,
    *,
    size: int,
    field: Point = (0.0, 0.0),
    offset: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
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
    points, weights = pupil_quadrature(radius)
    rays = trace_lenslet(imager, depth, points, field)
    weights = jnp.where(rays.valid, weights, 0)
    weights = (weights / jnp.sum(weights))[:, None]
    centroid = jnp.sum(weights * rays.landing, 0)
    spread = jnp.sum(weights * (rays.landing - centroid[None]) ** 2) / 2
    airy = airy_sigma(imager.wavelength, imager.reduced_sensor_distance, 2 * radius)
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
    depth: ScalarLike,
    *,
    field: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
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


PSFS = {"diffraction": diffraction_psf, "geometric": geometric_psf, "gaussian": gaussian_psf}
# Window of the PSF: room for the diffraction around the rays, and the most that the rays may reach, pixels.
_WINDOW_MARGIN, _FARTHEST = 16, 128
# Rays along the aperture's radius that are asked how far they reach.
_ZONES = 65


def psf_of_depth(
    imager: Imager, depths: Sequence[float] | np.ndarray, kind: str, steps: int = 1
) -> Callable[..., Float[Array, "row column"]]:
    """Function from a depth to its PSF, in a window that holds the rays of all depths.

    Rays that the lens reflects totally do not count.

    Parameters
    ----------
    imager
        Its mean clear aperture is taken.
    depths
        Between the nearest and the farthest of them, mm.
    kind
        Of the PSF: a key of `PSFS`.
    steps
        As many pixels of the sensor as make a pixel that is meant: the margins of the window grow with them.

    Raises
    ------
    InputError
        If the rays reach farther than 128 pixels.
    """
    radius = clear_diameter(imager.array) / 2
    # All zones: near the focus of the rim's rays those of other zones land farther out.
    fan = radius * jnp.linspace(0, 1, _ZONES)[:, None] * jnp.array([[1.0, 0.0]])
    ends = [trace_lenslet(imager, depth, fan) for depth in (min(depths), max(depths))]
    reaches = [float(jnp.where(rays.valid, jnp.abs(rays.landing[:, 0]), 0).max()) for rays in ends]
    pixels = max(reaches) / (imager.sensor.pixel_pitch * steps)
    if not pixels <= _FARTHEST:
        depth = (min(depths), max(depths))[int(np.argmax(reaches))]
        raise InputError(
            f"found an object at {depth:g} mm, blurred over {pixels:.3g} pixels of the sensor each way, "
            f"allowed: {_FARTHEST}."
        )
    size = steps * (2 * math.ceil(pixels + _WINDOW_MARGIN) + 1)
    make = PSFS[kind]
    if kind == "diffraction":  # as fine as the aperture diffracts
        sharp = float(2 * radius * imager.sensor.pixel_pitch / (imager.wavelength * imager.reduced_sensor_distance))
        make = partial(make, samples=math.ceil(sharp))
    return lambda depth: make(imager, depth, size=size, radius=radius)


# Of Gauss and Legendre's rule in the squared radius: the path may change by dozens of waves.
_NODES = 64


def axial_strehl(
    imager: Imager, depth: Float[ArrayLike, ""], *, radius: Float[ArrayLike, ""] | None = None
) -> Float[Array, ""]:
    """Irradiance in the middle of the spot of a point on the axis, over that without aberrations and defocus.

    Where the Strehl ratio is above 0.1 the middle is the peak; a spot far out of focus may be brighter around it.

    Parameters
    ----------
    imager
        The lens, the light and the sensor's distance.
    depth
        `z` of the object point, mm.
    radius
        Of the clear aperture, mm. Half the aperture's diameter by default.
    """
    radius = pupil_radius(imager, radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    at = radius * jnp.asarray(np.sqrt((nodes + 1) / 2), radius.dtype)
    distance = chief_ray_length(imager, trace_lenslet(imager, depth, np.zeros(2)))

    def trace(at):
        rays = trace_lenslet(imager, depth, jnp.stack([at, jnp.zeros_like(at)], -1))
        tangent, end = rays.tangent[:, 0], rays.landing[:, 0]
        sine = tangent / jnp.sqrt(1 + tangent**2)
        return end - distance * sine, (rays.path - end * sine + end**2 / (2 * distance), rays.valid)

    seen, denser, (path, valid) = jax.jvp(trace, (at,), (jnp.ones_like(at),), has_aux=True)
    squared = seen * denser / at
    lit = valid & (squared > 0)
    amplitude = jnp.where(lit, jnp.asarray(weights, at.dtype) * jnp.sqrt(jnp.where(lit, squared, 1)), 0)
    phase = jnp.where(lit, 2 * np.pi / imager.wavelength * path, 0)
    light = jnp.sum(amplitude * jnp.cos(phase)) ** 2 + jnp.sum(amplitude * jnp.sin(phase)) ** 2
    return light / jnp.sum(amplitude) ** 2
