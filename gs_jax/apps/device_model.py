"""A device with fabrication errors: its imager, the sharpness of its images, and the errors of depths found with it.

A printer makes a slope `s` of terraces, `layer` high and `layer / s` wide, and smooths their edges over its `pixel`, to
ramps of that width. This differs from the wanted slope by a sawtooth of up to `(layer - pixel s) / 2` to both sides:
the mean square is `(layer - pixel s)^2 / 12`, that of its slope `s (layer / pixel - s)`. Terraces narrower than a pixel
vanish: a running mean over a pixel would leave a tail, but a printer's spot is rounder.

A device puts the spots of a point where `gs_jax.calibration` expects cores: on chief rays, displaced as exact rays
show. The displacement changes linearly with the lens's shape, as far as tolerances go. A point is located from its
spots by least squares, with the geometry of the design, or with one that is first fitted to the spots of point sources
at known positions. There is no noise: what is left is the device's error.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Float64, Int, Key

from ..base.errors import InputError
from ..base.typing import ScalarLike
from ..calibration.spot_model import (
    FITTED,
    CoreOffsets,
    Observations,
    Unknowns,
    apply_to_imager,
    core_polynomials,
    initial_unknowns,
    residuals,
    trace_core_offsets,
)
from ..design.datasheets import parts_of
from ..design.design import Design
from ..microscope.geometry import Imager
from ..microscope.lenses import MicrolensArray
from ..objectives.conditions import Conditions, clear_diameter
from ..objectives.quantities import spot_width
from ..optics.diffraction import axial_strehl
from ..optics.raytrace import to_numpy
from ..optics.theory import FWHM
from .tolerance_spec import ToleranceSpec

# The field of `Errors` that each tolerance sets.
ERROR_FIELDS = {
    "position": "centers",
    "radius": "radius",
    "conic": "conic",
    "index": "index",
    "sensor distance": "sensor_distance",
    "tilt": "tilt",
    "roughness": "roughness",
    "printed layers": "layer",
}
# The tolerances that are the same for every device and change no depth, and the one that changes no image.
CONSTANT, POSITION = ("roughness", "printed layers"), "position"
# Rings of equal area in a lens: terraces are wide in its middle only.
_RINGS = 256
# A single lens gives no depth. Lists of lenses are filled up to a multiple of so many.
_MIN_LENSES, _ROUNDED = 2, 8
# Steps of the finite differences of core positions: relative, of the conic constant, and of the index.
_STEPS = {"radius": 0.01, "conic": 0.05, "index": 0.005}
# Depths at which cores are traced; interpolation has kinks there, which few asked depths meet.
_CORE_DEPTHS = 4
# Devices per compiled call, whose rays are in memory at once.
BATCH = 8
# Gauss-Newton steps: lens position errors leave a residual, which each step makes a few times smaller.
_ITERATIONS = 10


class Errors(eqx.Module):
    """The errors of a device, or their standard deviations.

    `centers` of the lenses `(lens, 2)`, mm; `radius`, relative; `conic`; `index`; `sensor_distance`, mm; `tilt`, slopes
    `(x, y)`; RMS `roughness`, mm; `layer` of the printer, mm.
    """

    centers: Float[Array, "..."]
    radius: Float[Array, "..."]
    conic: Float[Array, "..."]
    index: Float[Array, "..."]
    sensor_distance: Float[Array, "..."]
    tilt: Float[Array, "..."]
    roughness: Float[Array, "..."]
    layer: Float[Array, "..."]


def standard_deviations(spec: ToleranceSpec) -> Errors:
    """The tolerances in mm and slopes."""
    numbers = {
        "centers": spec.position_um / 1000,
        "radius": spec.radius_percent / 100,
        "conic": spec.conic,
        "index": spec.index,
        "sensor_distance": spec.sensor_distance_um / 1000,
        "tilt": math.tan(math.radians(spec.tilt_deg)),
        "roughness": spec.roughness_nm * 1e-6,
        "layer": spec.layer_um / 1000,
    }
    return Errors(**{name: jnp.asarray(number) for name, number in numbers.items()})


def no_errors(lenses: int) -> Errors:
    """The errors of a perfect device."""
    zero = jnp.zeros(())
    return Errors(jnp.zeros((lenses, 2)), zero, zero, zero, zero, jnp.zeros(2), zero, zero)


@partial(jax.jit, static_argnames="lenses")
def sample_errors(keys: Key[Array, " device"], lenses: int, deviations: Errors) -> Errors:
    """Sample the errors of devices, each with a key."""
    flat, tree = jax.tree.flatten(no_errors(lenses))

    def sample(key):
        parts = zip(jax.random.split(key, len(flat)), flat, strict=True)
        normal = jax.tree.unflatten(tree, [jax.random.normal(own, part.shape) for own, part in parts])
        normal = dataclasses.replace(normal, **{ERROR_FIELDS[name]: jnp.ones(()) for name in CONSTANT})
        return jax.tree.map(jnp.multiply, normal, deviations)

    return jax.vmap(sample)(keys)


def without_tolerance(deviations: Errors, name: str) -> Errors:
    """The standard deviations with one tolerance at zero."""
    field = ERROR_FIELDS[name]
    return dataclasses.replace(deviations, **{field: jnp.zeros_like(getattr(deviations, field))})


def perturb(imager: Imager, errors: Errors) -> Imager:
    """The imager of a device with errors."""

    def printed(array: MicrolensArray) -> MicrolensArray:
        return dataclasses.replace(
            array,
            radius_of_curvature=array.radius_of_curvature * (1 + errors.radius),
            conic_constant=array.conic_constant + errors.conic,
            refractive_index=array.refractive_index + errors.index,
            others=None if array.others is None else printed(array.others),
        )

    array = dataclasses.replace(printed(imager.array), centers=imager.array.centers + errors.centers)
    tilt = errors.tilt if imager.tilt is None else imager.tilt + errors.tilt
    distance = imager.sensor_distance + errors.sensor_distance
    return dataclasses.replace(imager, array=array, sensor_distance=distance, tilt=tilt)


def step_squares(
    slope: Float[Array | np.ndarray, " place"], layer: ScalarLike, pixel: ScalarLike
) -> tuple[Float[Array, " place"], Float[Array, " place"]]:
    """Mean squares of a printed surface's height error, mm^2, and of its slope error, by the wanted slope."""
    slope = jnp.asarray(slope)
    left = jnp.maximum(layer - pixel * slope, 0)
    return left**2 / 12, slope * left / pixel


def lens_squares(
    array: MicrolensArray, radius: ScalarLike, layer: ScalarLike, pixel: ScalarLike, wavelength: ScalarLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean squares of a lens's height error, mm^2, and of the slope error that bends rays, within a radius, mm.

    Steps of many waves bend rays by their slope. Thin ones diffract a little light far away and leave the core as
    narrow as it is. Between them slopes count by the share of the light that their height takes from the core.
    """
    squared = jnp.asarray((np.arange(_RINGS) + 0.5) / _RINGS) * radius**2
    height, slope = step_squares(array.sag_slope_over_r(squared) * jnp.sqrt(squared), layer, pixel)
    scattered = -jnp.expm1(log_strehl_of_height(height, array.refractive_index, wavelength))
    return jnp.mean(height), jnp.mean(slope * scattered)


def log_strehl_of_height(
    square: ScalarLike | Float[Array, " place"], refractive_index: ScalarLike, wavelength: ScalarLike
) -> Float[Array, "..."]:
    """Logarithm of `exp(-(2 pi (n - 1) sigma / lambda)^2)`, the light that stays in the spot's core.

    Exact for normally distributed heights; `square` is `sigma^2`, mm^2.
    """
    return -((2 * np.pi * (jnp.asarray(refractive_index) - 1) / wavelength) ** 2) * square


def log_sharpness(
    nominal: Imager, at: Conditions, errors: Errors, pixel: Float[Array, ""]
) -> tuple[Float[Array, " depth"], Float[Array, " depth"]]:
    """Logarithms of the spot width in the object, mm, and of the Strehl ratio on the axis.

    Both are means over the plate (the width's square), whose tilt changes the lenses' distance from the sensor; the
    width also over the field, as in `gs_jax.objectives.spot_width`. Slopes of the printer's steps widen spots by
    `(n - 1)` times the slope times `v'`. `pixel` is the printer's, mm.
    """
    # Lens positions do not change images.
    errors = dataclasses.replace(errors, centers=jnp.zeros_like(nominal.array.centers))
    imager, radius = perturb(nominal, errors), clear_diameter(nominal, at) / 2
    assert imager.tilt is not None
    # The square of a width is a quadratic of the height: four places at the RMS coordinates give the lenses' mean.
    counted = True if at.lenses is None else at.lenses[:, None]
    x, y = jnp.sqrt(jnp.mean(nominal.centers**2, 0, where=counted))
    heights = jnp.stack([jnp.stack(place) for place in ((x, y), (x, -y), (-x, y), (-x, -y))]) @ imager.tilt

    def at_height(height):
        level, here = imager.at_height(height), dataclasses.replace(at, depths=at.depths - height)
        ratio = jax.vmap(lambda depth: axial_strehl(level, depth, radius=radius))(here.depths)
        return spot_width(level, here), ratio

    widths, ratios = jax.vmap(at_height)(heights)
    array = imager.array
    height_square, slope_square = lens_squares(array, radius, errors.layer, pixel, imager.wavelength)
    # A printer's steps are along the radius: half of their slopes' square is along each axis.
    bent = (array.refractive_index - 1) * imager.reduced_depth(at.depths)
    squared = jnp.mean(widths**2, 0) + (FWHM * bent) ** 2 * slope_square / 2
    scatter = log_strehl_of_height(errors.roughness**2 + height_square, array.refractive_index, imager.wavelength)
    return jnp.log(squared) / 2, jnp.log(jnp.mean(ratios, 0)) + scatter


class VisiblePoints(NamedTuple):
    """Points, mm, and the lenses that see each; entries of `lenses` count where `seen`."""

    points: Float[Array, "point 3"]
    lenses: Int[Array, "point lens"]
    seen: Bool[Array, "point lens"]


class CoreModel(NamedTuple):
    """Core positions of the design, and their derivatives by radius, conic constant and index."""

    offsets: CoreOffsets
    slopes: Float[Array, "change type depth power"]


def depth_arguments(
    imager: Imager, depths: Float64[np.ndarray, " depth"], sources: Float64[np.ndarray, "source 3"] | None = None
) -> tuple[Imager, CoreModel, VisiblePoints, VisiblePoints]:
    """The imager, cores, sources and points that `depth_errors` takes.

    Points are, at each of the depths, in the middle of the plate and half-way to its corners. The default sources are
    on the axis at the nearest, the middle and the farthest depth, and a field radius beside it at the middle one.

    Raises `InputError` if fewer than two lenses see a point or a source.
    """
    if imager.tilt is None:
        imager = dataclasses.replace(imager, tilt=np.zeros(2))
    near, far = depths.min(), max(depths.max(), 1.01 * depths.min())
    if sources is None:
        middle = (near + far) / 2
        sources = np.array([[0, 0, near], [0, 0, middle], [imager.field_radius, 0, middle], [0, 0, far]])
    centers = to_numpy(imager).centers
    x, y = np.abs(centers - centers.mean(0)).max(0) / 2
    places = centers.mean(0) + np.array([[0, 0], [-x, -y], [x, -y], [-x, y], [x, y]])
    points = np.array([[*place, depth] for depth in depths for place in places])
    near, far = min(near, sources[:, 2].min()), max(far, sources[:, 2].max())
    beyond = min(0.1 * (far - near), near / 2)
    traced = np.linspace(near - beyond, far + beyond, _CORE_DEPTHS)
    offsets, perfect, slopes = trace_core_offsets(imager, traced), no_errors(len(centers)), []
    here = np.asarray(offsets.offset, np.float64)
    for name, step in _STEPS.items():
        changed = perturb(imager, dataclasses.replace(perfect, **{name: jnp.asarray(step)}))
        slopes.append(jnp.asarray((core_polynomials(changed, traced) - here) / step))
    cores = CoreModel(offsets, jnp.stack(slopes))
    return imager, cores, _visible(imager, sources), _visible(imager, points)


def lenses_that_see(imager: Imager, points: Float64[np.ndarray, "point 3"]) -> Bool[np.ndarray, "lens point"]:
    """Whether a point is within the field radius of a lens, and its image on the sensor."""
    views = to_numpy(imager).views_of_all(points)
    left, right, bottom, top = imager.sensor.extent
    on_sensor = (views.spot >= (left, top)) & (views.spot <= (right, bottom))
    return on_sensor.all(-1) & ((views.offset**2).sum(-1) <= imager.field_radius**2)


def _visible(imager: Imager, points: Float64[np.ndarray, "point 3"]) -> VisiblePoints:
    """With the lenses that see each point."""
    seen = lenses_that_see(imager, points).T
    count = seen.sum(1)
    if count.min() < _MIN_LENSES:
        x, y, z = points[count.argmin()]
        point = f"the point at x {x:.4g}, y {y:.4g}, z {z:.4g} mm"
        raise InputError(f"{_MIN_LENSES} or more lenses must see {point} to know its depth, got {count.min()}.")
    # Devices that differ little take the same program.
    most = -(-count.max() // _ROUNDED) * _ROUNDED
    lenses = np.argsort(~seen, axis=1, kind="stable")[:, :most]
    return VisiblePoints(jnp.asarray(points), jnp.asarray(lenses), jnp.asarray(np.take_along_axis(seen, lenses, 1)))


def depth_errors(
    imager: Imager,
    cores: CoreModel,
    sources: VisiblePoints,
    points: VisiblePoints,
    errors: Errors,
    *,
    steps: int = _ITERATIONS,
) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
    """Depth errors of points seen by a device, mm: with the geometry of the design, and with a calibrated one.

    The imager is the design's, with a `tilt`; the device is calibrated by the sources. Without errors no residual is
    left, and the first of the Gauss-Newton steps has the derivatives of all.
    """
    device = perturb(imager, errors)
    change = jnp.tensordot(jnp.stack([errors.radius, errors.conic, errors.index]), cores.slopes, 1)
    offsets = cores.offsets._replace(offset=cores.offsets.offset + change)
    photographed = _photograph(device, offsets, sources, imager, cores.offsets)
    start = initial_unknowns(FITTED, photographed)
    fitted = _least_squares(lambda unknowns: residuals(unknowns, photographed), start, steps)
    assumed = jax.tree.map(lambda *two: jnp.stack(two), imager, apply_to_imager(fitted, imager))

    def error(assumed, point):
        one = VisiblePoints(*(part[None] for part in point))
        spots = _photograph(device, offsets, one, assumed, cores.offsets)
        spots = spots._replace(unknown=jnp.array([[0, 0], [0, 1], [0, 2]]))
        start = Unknowns(coordinates=point.points)
        located = _least_squares(lambda unknowns: residuals(unknowns, spots), start, steps)
        assert located.coordinates is not None
        return located.coordinates[2] - point.points[2]

    designed, calibrated = jax.vmap(lambda assumed: jax.vmap(lambda point: error(assumed, point))(points))(assumed)
    return designed, calibrated


def _photograph(
    device: Imager, offsets: CoreOffsets, points: VisiblePoints, assumed: Imager, known: CoreOffsets
) -> Observations:
    """The device's spots of points, as a calibration that assumes another imager takes them."""
    count, most = points.lenses.shape
    sources, lenses, seen = jnp.repeat(jnp.arange(count), most), points.lenses.ravel(), points.seen.ravel()
    nowhere, sharp = jnp.zeros((count * most, 2), points.points.dtype), jnp.ones(count * most, points.points.dtype)
    none = jnp.zeros((0, 2), int)
    spots = Observations(device, points.points, none, sources, lenses, nowhere, seen, sharp, offsets)
    places = residuals(Unknowns(), spots) * device.sensor.pixel_pitch
    return spots._replace(positions=places, imager=assumed, offsets=known)


def _least_squares(residual: Callable[[Unknowns], Array], start: Unknowns, steps: int) -> Unknowns:
    """Minimise a sum of squares by Gauss-Newton steps."""
    state, unravel = ravel_pytree(start)
    flat = lambda state: residual(unravel(state)).ravel()

    def step(_, state):
        slopes = jax.jacfwd(flat)(state)
        # Units in which all unknowns move spots equally.
        scale = 1 / jnp.sqrt(jnp.sum(slopes**2, 0))
        q, r = jnp.linalg.qr(slopes * scale[None])
        return state - scale * solve_triangular(r, q.T @ flat(state))

    return unravel(jax.lax.fori_loop(0, steps, step, state))


class Measures(NamedTuple):
    """Logarithms of the spot width, mm, and of the Strehl ratio, and depth errors, mm, of devices.

    Depth errors are with the geometry of the `designed` and of the `calibrated` device.
    """

    log_width: Float[Array | np.ndarray, "*device depth"]
    log_strehl: Float[Array | np.ndarray, "*device depth"]
    designed: Float[Array | np.ndarray, "*device point"]
    calibrated: Float[Array | np.ndarray, "*device point"]


class Problem(NamedTuple):
    """The lenses of each type and their conditions, the arguments of `depth_errors`, and the printer's pixel, mm."""

    parts: tuple[tuple[Imager, Conditions], ...]
    depth_arguments: tuple[Imager, CoreModel, VisiblePoints, VisiblePoints]
    pixel: Float[Array, ""]

    @property
    def lenses(self) -> int:
        """Number of lenses."""
        return len(self.depth_arguments[0].array.centers)


def make_problem(
    design: Design,
    depths: Float64[np.ndarray, " depth"],
    sources: Float64[np.ndarray, "source 3"] | None = None,
    pixel: float = 0.005,
) -> Problem:
    """The problem of a design at some depths, mm."""
    # Each device has clear apertures of its own.
    parts = tuple((imager, dataclasses.replace(at, clear_diameter=None)) for imager, at in parts_of(design, depths))
    return Problem(parts, depth_arguments(design.imager(), depths, sources), jnp.asarray(pixel))


def measure_devices(problem: Problem, errors: Errors, advance: Callable[[], None] = lambda: None) -> Measures:
    """Measure devices; `advance` is called after each half of a batch."""
    functions = sharpness_of_devices, depth_errors_of_devices
    return Measures(*(values for one in functions for values in measure(one, problem, errors, advance)))


def measure(
    function: Callable[[Problem, Errors], tuple[Array, Array]],
    problem: Problem,
    errors: Errors,
    advance: Callable[[], None] = lambda: None,
) -> tuple[np.ndarray, ...]:
    """Half of the measures of devices, in batches of one size for any number of them, so that one program is compiled.

    `function` is one of the next two.
    """
    batches, errors = [], jax.device_get(errors)
    for start in range(0, count := len(errors.radius), BATCH):
        index = np.minimum(np.arange(start, start + BATCH), count - 1)
        batch = function(problem, jax.tree.map(lambda error, index=index: error[index], errors))
        batches.append([np.asarray(values, np.float64)[: count - start] for values in batch])
        advance()
    return tuple(map(np.concatenate, zip(*batches, strict=True)))


@eqx.filter_jit
def sharpness_of_devices(problem: Problem, errors: Errors) -> tuple[Array, Array]:
    """`sharpness` of a batch of devices."""
    return jax.vmap(lambda device: sharpness(problem, device))(errors)


@eqx.filter_jit
def depth_errors_of_devices(problem: Problem, errors: Errors) -> tuple[Array, Array]:
    """`depth_errors` of a batch of devices."""
    return jax.vmap(lambda device: depth_errors(*problem.depth_arguments, device))(errors)


def sharpness(problem: Problem, errors: Errors) -> tuple[Float[Array, " depth"], Float[Array, " depth"]]:
    """`log_sharpness` of the lens type that is best at each depth."""
    by_type = [log_sharpness(*lens_type, errors, problem.pixel) for lens_type in problem.parts]
    widths, ratios = map(jnp.stack, zip(*by_type, strict=True))
    return jnp.min(widths, 0), jnp.max(ratios, 0)
