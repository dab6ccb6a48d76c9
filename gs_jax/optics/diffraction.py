"""Scalar diffraction from a lenslet's exit pupil to the sensor, and Strehl ratios.

Huygens' principle sums `exp(2 pi i (L + |P - B|) / wavelength)` over the points B of the curved surface, with the path
L from the object to B. For each B, `|P - B| - (P - P_0)^2 / (2 rho)`, with the chief ray's end P_0 and its length rho,
is linearised in P about the point where the ray from B lands. The error is of second order in the distance from there,
which is small as light is near its ray. The sum becomes a Fourier transform of the field in an exit pupil, done by two
matrix products (Soummer et al., Opt. Express 15, 15935, 2007). It has both limits: the Fresnel integral for small
angles, and the density of rays for strong aberrations.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..base.arrays import jit
from ..base.typing import ScalarLike
from ..linear.fourier import phasor
from ..microscope.geometry import Imager
from .pupil import pupil_quadrature, pupil_radius
from .raytrace import Point, chief_ray_length, direction_cosines, trace_lenslet

# Straight edges of the aperture: vectors `(x, y)` from the vertex to the nearest point of each, mm.
Edges = Float[Array | np.ndarray, "edge 2"] | None

# Width of the exit pupil's grid over the lens's own diameter, which allows for the pupil's distortion.
_MARGIN = 1.08
# Inversion of the map from lens to exit pupil: degree of the first polynomial fit, Newton steps, and the largest
# distance left, in radii, of a ray that counts. The error of its phase is of second order in that distance.
_DEGREE, _STEPS, _CLOSE = 7, 1, 0.02
# Nodes of a panel of `axial_pupil`, over which the path may change by dozens of waves, and panels by default.
_NODES, _PANELS = 64, 8
# Coefficients of `_bessel_j0`, highest powers first.
_J0 = (0.0002100, -0.0039444, 0.0444479, -0.3163866, 1.2656208, -2.2499997, 1.0)
_J0_SIZE = (0.00014476, -0.00072805, 0.00137237, -0.00009512, -0.00552740, -0.00000077, 0.79788456)
_J0_PHASE = (0.00013558, -0.00029333, -0.00054125, 0.00262573, -0.00003954, -0.04166397, -0.78539816)


class ExitPupil(NamedTuple):
    """The exit pupil on a square grid.

    `coordinate`: along each side, mm. `field` and its modulus `amplitude`. `chief`: where the chief ray meets the
    sensor, `(x, y)` from the lens's axis, mm; `distance`: its `chief_ray_length`.
    """

    coordinate: Float[Array, " sample"]
    field: Complex[Array, "sample sample"]
    amplitude: Float[Array, "sample sample"]
    chief: Float[Array, "2"]
    distance: Float[Array, ""]


def trace_exit_pupil(imager: Imager, depth, field, radius, edges, count: int) -> ExitPupil:
    """The field in the exit pupil: for each of `count` x `count` grid points the ray from there, and its phase.

    The coordinate is `u = D - rho (e - e_0)` with the ray's end D from the chief ray's, its direction cosines e and the
    chief ray's length rho: the point of the lens, but for third order. The phase is that of the path less
    `e D - D^2 / (2 rho)`. By Hamilton's theorem its slope is `-D / rho`, which corrects for the rest of the inversion.
    Other parameters are those of `diffraction_psf`.
    """
    radius = pupil_radius(imager, radius)
    reach = _MARGIN * radius
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
    for _ in range(_STEPS):
        rays, _, _, found = trace(points)
        missing = jnp.where(rays.valid[:, None], wanted - found, 0)
        points = points + along_x * missing[:, :1] + along_y * missing[:, 1:]
    rays, end, cosines, found = trace(points)
    path = rays.path - jnp.sum(end * cosines, -1) + jnp.sum(end * (end / 2 - wanted + found), -1) / distance
    # Outside the lens the search may end at another ray, which must not count.
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
    """Points of the lens for a grid over [-1, 1] of the exit pupil, and their derivatives by x and y.

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
    """1 inside the aperture, 0 outside, linear over one step, so that it has gradients."""
    inward = radius - jnp.sqrt(jnp.maximum(jnp.sum(points**2, -1), step**2))
    if edges is not None:
        edges = jnp.asarray(edges, radius.dtype)
        length = jnp.sqrt(jnp.sum(edges**2, -1))
        for edge, at in zip(edges, length, strict=True):
            inward = jnp.minimum(inward, at - points @ (edge / at))
    return jnp.clip(inward / step + 0.5, 0, 1)


def fourier_transform(pupil: ExitPupil, x: Array, y: Array, turn: Array) -> Array:
    """The field at sensor points `(x, y)` from the chief ray's end."""
    rows = phasor(1, -turn * y[:, None] * pupil.coordinate[None])
    columns = phasor(1, -turn * pupil.coordinate[:, None] * x[None])
    return rows @ pupil.field @ columns


def abs2(field: Array) -> Array:
    return field.real**2 + field.imag**2


@partial(jit, static_argnames=("samples",))
def strehl(
    imager: Imager,
    depth: ScalarLike,
    *,
    field: Point = (0.0, 0.0),
    radius: ScalarLike | None = None,
    edges: Edges = None,
    samples: int = 256,
) -> Float[Array, ""]:
    """Strehl ratio on the sensor: peak irradiance, wherever it is, over that of the same pupil without aberrations.

    Defocus counts. Unlike Eq. (9) it holds for any wavefront error. The first parameters are those of
    `diffraction_psf`; `samples` along a side of the pupil are enough for a blur of `samples / 2` times
    `wavelength v / (2 radius)`.
    """
    pupil = trace_exit_pupil(imager, depth, field, radius, edges, samples)
    scale = imager.wavelength * pupil.distance
    turn = 2 * np.pi / scale

    def irradiance(point):
        return abs2(fourier_transform(pupil, point[:1], point[1:], turn))[0, 0] / jnp.sum(pupil.amplitude) ** 2

    spacing = scale / (2 * (pupil.coordinate[-1] - pupil.coordinate[0]))
    places = spacing * (jnp.arange(samples, dtype=spacing.dtype) - samples // 2)
    table = abs2(fourier_transform(pupil, places, places, turn))
    row, column = jnp.unravel_index(jnp.argmax(table), table.shape)
    start = jnp.stack([places[column], places[row]])

    def newton(point, _):
        gradient, hessian = jax.grad(irradiance)(point), jax.hessian(irradiance)(point)
        step = jnp.linalg.solve(hessian, gradient[:, None])[:, 0]
        return point - jnp.clip(step, -spacing / 2, spacing / 2), None

    peak, _ = jax.lax.scan(newton, start, length=3)
    # The position of the peak needs no derivative: the irradiance's derivative by it is zero.
    return irradiance(jax.lax.stop_gradient(peak))


class AxialPupil(NamedTuple):
    """The exit pupil of a point on the axis, along its radius.

    `radius`: in the exit pupil, mm. `amplitude` and `phase` of the field, and where the rays land, mm. `weight`: the
    share of the lens's area that each stands for; `lit`: whether its ray arrives. `distance`: length of the chief ray.
    """

    radius: Float[Array, " node"]
    amplitude: Float[Array, " node"]
    phase: Float[Array, " node"]
    landing: Float[Array, " node"]
    weight: Float[Array, " node"]
    lit: Bool[Array, " node"]
    distance: Float[Array, ""]


def axial_pupil(
    imager: Imager, depth: ScalarLike, *, radius: ScalarLike | None = None, panels: int = _PANELS
) -> AxialPupil:
    """Trace the exit pupil of a point on the axis: `panels` of 64 nodes in the lens's squared radius.

    With the exit pupil's radius `u`, the phase `phi` there and the lens's radius `r`, the field in the middle of the
    spot is `int exp(i phi) sqrt(u u'/r) r dr`.
    """
    radius = pupil_radius(imager, radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    squared = ((nodes + 1) / 2 + np.arange(panels)[:, None]).ravel() / panels
    weight = jnp.asarray(np.tile(weights / 2, panels) / panels, radius.dtype)
    at = radius * jnp.asarray(np.sqrt(squared), radius.dtype)
    distance = chief_ray_length(imager, trace_lenslet(imager, depth, np.zeros(2)))

    def trace(at):
        rays = trace_lenslet(imager, depth, jnp.stack([at, jnp.zeros_like(at)], -1))
        tangent, end = rays.tangent[:, 0], rays.landing[:, 0]
        sine = tangent / jnp.sqrt(1 + tangent**2)
        return end - distance * sine, (end, rays.path - end * sine + end**2 / (2 * distance), rays.valid)

    seen, denser, (end, path, valid) = jax.jvp(trace, (at,), (jnp.ones_like(at),), has_aux=True)
    denser = seen * denser / at
    lit = valid & (denser > 0)
    amplitude = jnp.where(lit, weight * jnp.sqrt(jnp.where(lit, denser, 1)), 0)
    phase = jnp.where(lit, 2 * np.pi / imager.wavelength * path, 0)
    return AxialPupil(seen, amplitude, phase, end, weight, valid, distance)


def axial_irradiance(imager: Imager, pupil: AxialPupil, places: Float[Array, " place"]) -> Float[Array, " place"]:
    """Irradiance at distances from the middle of the spot, mm, over that in the middle without aberrations."""
    turn = 2 * np.pi / (imager.wavelength * pupil.distance)
    waves = _bessel_j0(turn * places[:, None] * pupil.radius[None])
    field = waves @ (pupil.amplitude * jnp.cos(pupil.phase)), waves @ (pupil.amplitude * jnp.sin(pupil.phase))
    return (field[0] ** 2 + field[1] ** 2) / jnp.maximum(jnp.sum(pupil.amplitude), 1e-15) ** 2


def _bessel_j0(x: Array) -> Array:
    """Bessel's function of order 0 to 1e-7: Abramowitz and Stegun 9.4.1 and 9.4.3. JAX has none that is fast."""
    x = jnp.abs(x)
    t, s = jnp.minimum(x / 3, 1) ** 2, 3 / jnp.maximum(x, 3)
    inner = jnp.polyval(jnp.asarray(_J0, x.dtype), t)
    size, phase = jnp.polyval(jnp.asarray(_J0_SIZE, x.dtype), s), jnp.polyval(jnp.asarray(_J0_PHASE, x.dtype), s)
    return jnp.where(x < 3, inner, size * jnp.sqrt(s / 3) * jnp.cos(x + phase))


def axial_strehl(imager: Imager, depth: ScalarLike, *, radius: ScalarLike | None = None) -> Float[Array, ""]:
    """Irradiance in the middle of the spot of a point on the axis, over that without aberrations and defocus.

    As of `strehl`, up to a thousand times faster. Where the Strehl ratio is above 0.1 the middle is the peak; a spot
    far out of focus may be brighter around it.
    """
    pupil = axial_pupil(imager, depth, radius=radius, panels=1)
    return axial_irradiance(imager, pupil, jnp.zeros(1, pupil.radius.dtype))[0]
