"""How wrong the depths of points come out: by the microscope as it is designed, and once it is calibrated.

A device puts the spots of a point where `gs_jax.calibration` says that cores are: on chief rays, and beside them by
what exact rays have shown. Cores move with the lens's shape linearly, as far as tolerances go. From the spots a point's
place is found by least squares, with the geometry of the design, or with one that is fitted first, by least squares
too, to the spots of point sources at four known places. There is no noise: what is left is the device's.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Float64, Int

from ...base.errors import InputError
from ...calibration.unknowns import (
    FITTED,
    Known,
    Offsets,
    Unknowns,
    applied,
    core_powers,
    guessed,
    offsets_of,
    residuals,
)
from ...geometry import Imager
from ...optics.raytrace import to_numpy
from .device_model import Errors, built, no_errors

# Lenses that must see a point: one says no depth.
_FEWEST = 2
# Of a lens, for the slope of what exact rays say: relative, of the conic constant, and of the index.
_STEPS = {"radius": 0.01, "conic": 0.05, "index": 0.005}
# Depths of which exact rays are asked. Between them is interpolated, with kinks at them, which gradients do not like:
# they are none that people ask for.
_DEPTHS = 4
# Gauss's and Newton's: lenses that are not where the fit has them leave an error, which each makes a few times smaller.
_ROUNDS = 10


class Sights(NamedTuple):
    """Points `(point, 3)`, mm, and the lenses that see each; `are` says which of `(point, lens)` are some."""

    points: Float[Array, "point 3"]
    lenses: Int[Array, "point lens"]
    are: Bool[Array, "point lens"]


class Bench(NamedTuple):
    """What depths are judged with: the design, where its cores are, and how these move with radius, conic and index.

    `sources` are photographed to calibrate, `points` are then looked for.
    """

    imager: Imager
    offsets: Offsets
    changes: Float[Array, "change depth power"]
    sources: Sights
    points: Sights


def bench_of(
    imager: Imager, depths: Float64[np.ndarray, " depth"], sources: Float64[np.ndarray, "source 3"] | None = None
) -> Bench:
    """For points at these depths, mm, at five places: over the plate's middle, and half-way to its corners.

    Parameters
    ----------
    imager
        As designed.
    depths
        Of the points, mm.
    sources
        Places `(x, y, z)` of what is photographed to calibrate, mm. By default four, the least that people are told: on
        the axis at the nearest, the middle and the farthest depth, and a field radius beside it at the middle one.

    Raises
    ------
    InputError
        If fewer than two lenses see a point or a source.
    """
    if imager.tilt is None:
        imager = dataclasses.replace(imager, tilt=np.zeros(2))
    near, far = depths.min(), max(depths.max(), 1.01 * depths.min())
    if sources is None:
        middle, beside = (near + far) / 2, imager.field_radius
        sources = np.array([[0, 0, near], [0, 0, middle], [beside, 0, middle], [0, 0, far]])
    near, far = min(near, sources[:, 2].min()), max(far, sources[:, 2].max())
    centers = np.asarray(imager.centers, np.float64)
    x, y = np.abs(centers - centers.mean(0)).max(0) / 2
    places = centers.mean(0) + np.array([[0, 0], [-x, -y], [x, -y], [-x, y], [x, y]])
    points = np.array([[*place, depth] for depth in depths for place in places])
    beyond = min(0.1 * (far - near), near / 2)
    asked = np.linspace(near - beyond, far + beyond, _DEPTHS)
    offsets = offsets_of(imager, asked)
    here = np.asarray(offsets.here, np.float64)
    slopes = jnp.stack([jnp.asarray((core_powers(_changed(imager, n), asked) - here) / s) for n, s in _STEPS.items()])
    return Bench(imager, offsets, slopes, _seen(imager, sources), _seen(imager, points))


def _changed(imager: Imager, name: str) -> Imager:
    """With another lens."""
    return built(imager, dataclasses.replace(no_errors(len(imager.array.centers)), **{name: jnp.asarray(_STEPS[name])}))


def _seen(imager: Imager, points: Float64[np.ndarray, "point 3"]) -> Sights:
    """The lenses within the field radius of each point whose image is on the sensor."""
    views = to_numpy(imager).views_of_all(points)
    ends = views.spot.transpose(1, 0, 2)
    left, right, bottom, top = imager.sensor.extent
    on = (ends > (left, top)).all(-1) & (ends < (right, bottom)).all(-1)
    near = np.hypot(*views.offset.T) < imager.field_radius
    seen = near & on
    count = seen.sum(1)
    if count.min() < _FEWEST:
        x, y, z = points[count.argmin()]
        found = f"a point at x {x:.4g}, y {y:.4g}, z {z:.4g} mm that {count.min()} lenses see"
        raise InputError(f"`array.centers_mm`: found {found}, allowed: {_FEWEST} or more, or its depth is not known.")
    lenses = np.argsort(~seen, axis=1, kind="stable")[:, : count.max()]
    return Sights(jnp.asarray(points), jnp.asarray(lenses), jnp.asarray(np.take_along_axis(seen, lenses, 1)))


def depth_errors(bench: Bench, errors: Errors) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
    """Of a device's points, mm, found less true: without a calibration, and after one."""
    device = built(bench.imager, errors)
    moved = jnp.tensordot(jnp.stack([errors.radius, errors.conic, errors.index]), bench.changes, 1)
    offsets = bench.offsets._replace(here=bench.offsets.here + moved)
    spots = _known(device, bench.sources, offsets)
    photographed = spots._replace(places=_due(spots), imager=bench.imager, offsets=bench.offsets)
    found = _solved(lambda unknowns: residuals(unknowns, photographed), guessed(FITTED, photographed))
    calibrated = applied(found, bench.imager)
    believed = jax.tree.map(lambda *two: jnp.stack(two), bench.imager, calibrated)
    depth = lambda imager, sight: _depth_error(device, offsets, imager, bench.offsets, sight)
    designed, fitted = jax.vmap(lambda imager: jax.vmap(lambda s: depth(imager, s))(bench.points))(believed)
    return designed, fitted


def _depth_error(device: Imager, offsets: Offsets, believed: Imager, known: Offsets, sight: Sights):
    one = Sights(*(part[None] for part in sight))
    spots = _known(device, one, offsets)
    seen = spots._replace(places=_due(spots), imager=believed, offsets=known)
    asked = seen._replace(unknown=jnp.array([[0, 0], [0, 1], [0, 2]]))
    found = _solved(lambda unknowns: residuals(unknowns, asked), Unknowns(coordinates=sight.points))
    assert found.coordinates is not None
    return found.coordinates[2] - sight.points[2]


def _known(imager: Imager, sights: Sights, offsets: Offsets) -> Known:
    """Spots as a calibration has them, at no place yet."""
    count, many = sights.lenses.shape
    sources = jnp.repeat(jnp.arange(count), many)
    places = jnp.zeros((count * many, 2), sights.points.dtype)
    lenses, are = sights.lenses.ravel(), sights.are.ravel()
    return Known(imager, sights.points, jnp.zeros((0, 2), int), sources, lenses, places, are, offsets)


def _due(spots: Known) -> Float[Array, "spot 2"]:
    """Where a device puts its spots, mm."""
    return residuals(Unknowns(), spots) * spots.imager.sensor.pixel_pitch


def _solved(residual: Callable[[Unknowns], Array], start: Unknowns) -> Unknowns:
    """What has the least squares, by Gauss's and Newton's steps."""
    state, back = ravel_pytree(start)
    flat = lambda state: residual(back(state)).ravel()

    def step(_, state):
        slopes = jax.jacfwd(flat)(state)
        # Numbers in steps that move spots equally.
        scale = 1 / jnp.sqrt(jnp.sum(slopes**2, 0))
        q, r = jnp.linalg.qr(slopes * scale[None])
        return state - scale * solve_triangular(r, q.T @ flat(state))

    return back(jax.lax.fori_loop(0, _ROUNDS, step, state))
