"""The exit pupil of a lens unit: the field to be transformed to the sensor.

Huygens' principle sums `exp(2 pi i (L + |P - B|) / wavelength)` over the points B of the convex surface, with the
path L from the object to B. For each B, `|P - B| - (P - P_0)^2 / (2 rho)`, with the chief ray's end P_0 and its length
rho, is made linear in P about the point where the ray from B lands. What is left out is of the second order in
the distance from there, and that is small: light is near its ray. So both limits are right, the Fresnel integral of a
lens with a small angle and the ray density of one with strong aberrations, and the sum becomes a Fourier transform.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from ..geometry import Imager
from .unit import chief_length, direction_cosines, pupil_disc, pupil_radius, unit_rays

# The grid in the exit pupil reaches this much beyond the lens's own radius, for the pupil's distortion.
_MARGIN = 1.08
# The ray from a point of the exit pupil: degree of the polynomials that start the search, and its steps.
_DEGREE = 7
_STEPS = 1
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
    reach = _MARGIN * radius
    chief = unit_rays(imager, depth, np.zeros(2), field)
    distance = chief_length(imager, chief)

    def trace(points):
        rays = unit_rays(imager, depth, points, field)
        end, cosines = rays.landing - chief.landing[None], direction_cosines(rays.tangent)
        return rays, end, cosines, end - distance * (cosines - direction_cosines(chief.tangent)[None])

    known, weights = pupil_disc(radius)
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
    # Around the lens the search may end at another ray: nothing comes from there.
    lit = rays.valid & (jnp.sum((wanted - found) ** 2, -1) < (_CLOSE * radius) ** 2)
    share = inside(points, radius, edges, coordinate[1] - coordinate[0])
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


def inside(points: Float[Array, "point 2"], radius: Array, edges, step: Array) -> Float[Array, " point"]:
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
