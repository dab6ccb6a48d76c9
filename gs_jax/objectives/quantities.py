"""Quantities of an imager: by paraxial and third-order optics (Eqs. 4-11), by the array's geometry, and by exact rays.

The first are resolution, focus, light and Strehl ratio, the second spacing, gaps between apertures, height and slope of
the lenses. The last are sizes of a point's image (PSF), seen in the object. They differ by a factor of ten where a
sharp core stands in wide stray light: `fwhm` is the width of the core, `rms_width` and `spot_width` are of all light.

What is said of a point's lenses, or of a lens's field, ends at the field radius, as the paper's back-projection does.
`gs_jax.codesign.linear_error` counts all lenses.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..microscope.geometry import Imager, envelope
from ..microscope.media import object_index
from ..optics import aberrations, theory
from ..optics.diffraction import AxialPupil, axial_irradiance, axial_pupil
from ..optics.pupil import pupil_quadrature
from ..optics.raytrace import trace_lenslet
from .conditions import (
    Conditions,
    Depths,
    as_conditions,
    best_type,
    by_type,
    clear_diameter,
    field_heights,
    field_radius,
    finite_plate,
    whole_array,
)

# Points along a side of the plate where the distance to the nearest lens is computed, and along a lens's radius; the
# curvature, 1/mm, below which a surface counts as flat.
_POINTS, _FLAT = 41, 1e-6
# Radii at which a profile is computed, and of arcs within a pixel.
_RADII, _ARCS = 256, 48
# FWHM in pixels and Airy discs above which rays alone give the profile: fringes do not count there.
_WIDE = 6.0
# Width of the Gaussian that smooths ray counts, over the mean squared radius of the rays and then over that of half the
# height, in so many passes; a number that is nothing beside a squared radius, mm^2.
_COARSE, _FINE, _PASSES, _NOTHING = 0.1, 0.06, 5, 1e-16
# Random moves of each ray by the pixel and the Airy disc, for the radius of half the light, and the width over which a
# ray counts in part, over the standard deviation of the moves.
_MOVES, _SMOOTH = 16, 0.2


@by_type
def f_number(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """F-number `f / D` of the clear aperture (below Eq. 8); one a type."""
    return imager.array.focal_length / clear_diameter(imager, depths)


@by_type
def numerical_aperture(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Numerical aperture `D / (2 f)` of the clear aperture (the paper's 0.13 takes the pitch for `D`); one a type."""
    return clear_diameter(imager, depths) / (2 * imager.array.focal_length)


@by_type
def lateral_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Lateral resolution in focus, without aberrations, `max(lambda / (2 NA), d_p) / M` (Eqs. 4, 5); a row a type.

    Its derivative jumps where the spot is as large as the pixel.
    """
    at = as_conditions(imager, depths)
    diffraction = imager.wavelength / (2 * numerical_aperture(imager, at))
    return jnp.maximum(diffraction, imager.sensor.pixel_pitch) / imager.magnification(at.depths)


@by_type
def axial_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Axial resolution in focus, without aberrations, `r_xy z / sqrt(A_e / pi)` (Eq. 6); a row a type."""
    at = as_conditions(imager, depths)
    return lateral_resolution(imager, at) * imager.depth_in_medium(at.depths) / field_radius(imager, at)


@by_type
def depth_of_field(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Depth of field of a sensor that is focused on each depth (Eq. 8); infinite beyond the hyperfocal distance."""
    return theory.depth_of_field(*_focus(imager, depths)) * object_index(imager.sample)


@by_type
def approximate_depth_of_field(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Depth of field by the approximation of Eq. 7; a row a type."""
    return theory.approximate_depth_of_field(*_focus(imager, depths)) * object_index(imager.sample)


@by_type
def near_limit(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """The nearest depth that is in focus with a sensor focused on each depth; a row a type."""
    at = as_conditions(imager, depths)
    return imager.depth_of(theory.near_limit(*_focus(imager, at))) + (0 if at.height is None else at.height)


@by_type
def far_limit(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """The farthest depth that is in focus with a sensor focused on each depth; a row a type."""
    at = as_conditions(imager, depths)
    return imager.depth_of(theory.far_limit(*_focus(imager, at))) + (0 if at.height is None else at.height)


def _focus(imager, depths):
    at = as_conditions(imager, depths)
    circle_of_confusion = 2 * imager.sensor.pixel_pitch if at.circle_of_confusion is None else at.circle_of_confusion
    circle_of_confusion = jnp.asarray(circle_of_confusion, at.depths.dtype)
    return imager.array.focal_length, f_number(imager, at), imager.reduced_depth(at.depths), circle_of_confusion


@by_type
def focus_distance(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Sensor distance `v` at which a thin lens images each depth; infinite if it does not; a row a type."""
    at = as_conditions(imager, depths)
    reduced = theory.focus_distance(imager.array.focal_length, imager.reduced_depth(at.depths))
    return imager.sensor_distance_of(reduced) - (0 if at.height is None else at.height)


@by_type
def focus_offset(imager: Imager, depths: Depths) -> Float[Array, ""]:
    """Distance of the depth in focus (thin lens) from the middle of the depths, in vergence; one a type.

    It is 1 at the nearest and the farthest depth. In vergence, focus at infinity and beyond is nothing special.
    """
    at, f = as_conditions(imager, depths), imager.array.focal_length
    near, far = imager.reduced_depth(at.depths[0]), imager.reduced_depth(at.depths[-1])
    in_focus = 1 / f - 1 / imager.reduced_sensor_distance
    return jnp.abs(2 * in_focus - 1 / near - 1 / far) / (1 / near - 1 / far)


@by_type
def sensor_blur(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Diameter of a thin lens's blur on the sensor; a row a type."""
    at = as_conditions(imager, depths)
    reduced, v = imager.reduced_depth(at.depths), imager.reduced_sensor_distance
    return theory.blur(imager.array.focal_length, clear_diameter(imager, at), reduced, v)


@best_type
def blur(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Diameter of a thin lens's blur in the object; of the best type."""
    at = as_conditions(imager, depths)
    return sensor_blur(imager, at) / imager.magnification(at.depths)


@whole_array
def lenses_per_point(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Number of lenses within the field radius of a point, `N_e`: lenses on the plate over its area, times `pi r^2`."""
    at = as_conditions(imager, depths)
    return jnp.pi * field_radius(imager, at) ** 2 * _count(imager, at) / jnp.prod(finite_plate(imager))


def _count(imager, at):
    """Number of lenses of the type, or of all."""
    return float(len(imager.array.centers)) if at.lenses is None else jnp.sum(at.lenses).astype(at.depths.dtype)


@whole_array
def occupancy(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Occupancy of the sensor, `V = N_e M^2` (Eq. 11), by the lenses of all types.

    The fraction of the sensor that the fields of the lenses fill, each as wide as the field radius.
    """
    at = as_conditions(imager, depths)
    return imager.magnification(at.depths) ** 2 * lenses_per_point(imager, at)


@partial(whole_array, aperture=True)
def coverage(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Share of the plate that is clear aperture."""
    at = as_conditions(imager, depths)
    discs = math.pi / 4 * clear_diameter(imager, at) ** 2
    return _count(imager, at) * discs / jnp.prod(finite_plate(imager))


@partial(whole_array, aperture=True)
def light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses collect, `N_e pi a^2 / (4 pi n^2 z'^2)` for a clear radius `a`.

    `n` is the index of the object's medium. Losses are left out. All lenses collect several times as much.
    """
    at = as_conditions(imager, depths)
    away = imager.depth_in_medium(at.depths)
    return lenses_per_point(imager, at) * (clear_diameter(imager, at) / 4 / away) ** 2


@whole_array
def field_of_view(imager: Imager, depths: Depths) -> Float[Array, "depth axis"]:
    """Width of the object that at least one lens images onto the sensor, along x and y.

    A lens at `c`, `|c| <= plate/2`, counts for a point at `q` within the field radius r whose chief ray lands at
    `|s c - M q| <= sensor/2`. The outermost such lens, at `c = min(plate/2, sensor/2 + M r)`, counts for points up to
    `c + r`.
    """
    at, sensor, plate = as_conditions(imager, depths), imager.sensor, finite_plate(imager)
    half = jnp.array(sensor.shape[::-1], plate.dtype) * (sensor.pixel_pitch / 2)
    radius = field_radius(imager, at)
    reach = half[None] + imager.magnification(at.depths)[:, None] * radius
    return 2 * (jnp.minimum(plate[None] / 2, reach) + radius)


@whole_array
def thickness(imager: Imager) -> Float[Array, ""]:
    """Thickness of the device: from its front, that of the array or of the filters on it, to the sensor."""
    filters = 0 if imager.filters is None else imager.filters.total
    return imager.sensor_distance + imager.array.substrate_thickness + filters


def third_order_wavefront(
    imager: Imager, depths: Depths, heights: Float[Array, " field"]
) -> aberrations.WavefrontCoefficients:
    """Third-order errors of lenses that are alike at heights beside a lens's axis: `(depth, field)`, or broadcast."""
    at, v = as_conditions(imager, depths), imager.reduced_sensor_distance
    radius, reduced = clear_diameter(imager, at) / 2, imager.reduced_depth(at.depths)
    return aberrations.seidel_of_array(imager.array, radius, reduced[:, None], heights[None], v)


@partial(best_type, best=jnp.argmax)
def log_strehl(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """Logarithm of the Strehl ratio (Eq. 9 with Eq. 10) at four heights of the field; of the best type."""
    at = as_conditions(imager, depths)
    wavefront = third_order_wavefront(imager, at, field_heights(imager, at))
    return aberrations.log_strehl(aberrations.linear_rms(wavefront), imager.wavelength)


def strehl(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """Strehl ratio (Eq. 9 with Eq. 10) at four heights of the field, 0 to 1; of the best type."""
    return jnp.exp(log_strehl(imager, depths))


@best_type
def wavefront_error(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """RMS of the third-order wavefront, astigmatism and field curvature included, in waves; of the best type."""
    at = as_conditions(imager, depths)
    wavefront = third_order_wavefront(imager, at, field_heights(imager, at))
    return aberrations.independent_rms(wavefront) / imager.wavelength


@whole_array
def spacing(imager: Imager) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; infinite for a single lens."""
    return safe_sqrt(_nearest(_squared_distances(imager.array.centers, imager.array.centers)))


@whole_array
def aperture_gap(imager: Imager) -> Float[Array, " lens"]:
    """Gap between each lens's aperture and the nearest other one; negative where they overlap.

    It is the smallest feature of a mask that blocks the light between the lenses.
    """
    centers, radius = imager.array.centers, imager.array.of_lenses("aperture_diameter") / 2
    return _nearest(safe_sqrt(_squared_distances(centers, centers)) - radius[:, None] - radius[None])


@whole_array
def uncovered_distance(imager: Imager) -> Float[Array, " point"]:
    """Distance of 41 x 41 points of the plate, from edge to edge, from the nearest lens centre."""
    plate = finite_plate(imager)
    side = jnp.linspace(-0.5, 0.5, _POINTS, dtype=plate.dtype)
    points = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]
    return safe_sqrt(jnp.min(_squared_distances(points, imager.array.centers), 1))


def _squared_distances(points, centers):
    return jnp.sum((points[:, None] - centers[None]) ** 2, -1)


def _nearest(distances):
    return jnp.min(jnp.where(jnp.eye(len(distances), dtype=bool), jnp.inf, distances), 1)


@by_type
def sag(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Height of a whole lens, of a sphere `R - sqrt(R^2 - D^2/4)`: the depth of the mold; one a type."""
    return imager.array.sag(_on_surface(imager, (imager.array.aperture_diameter / 2) ** 2))


@by_type
def edge_slope(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Slope of the surface at the rim of the clear disc, of a sphere `asin(a / R)`, radians; one a type."""
    square = _on_surface(imager, (clear_diameter(imager, depths) / 2) ** 2)
    return jnp.arctan(safe_sqrt(square) * imager.array.sag_slope_over_r(square))


@by_type
def surface_radius(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, " point"]:
    """Radius of curvature of the surface at points from the vertex to the rim: a cutting tool's is below the least."""
    diameter = clear_diameter(imager, depths)
    radii = jnp.linspace(0, 1, _POINTS, dtype=diameter.dtype) * diameter / 2
    array, square = imager.array, _on_surface(imager, radii**2)
    sag_slope_over_r, change = jax.jvp(array.sag_slope_over_r, (square,), (jnp.ones_like(square),))
    length2 = 1 + square * sag_slope_over_r**2
    # Along the radius s'' / (1 + s'^2)^(3/2), across it s' / r / (1 + s'^2)^(1/2).
    along, across = (sag_slope_over_r + 2 * square * change) / length2**1.5, sag_slope_over_r / length2**0.5
    return 1 / jnp.maximum(jnp.maximum(along, across), _FLAT)


def _on_surface(imager, squared_radius):
    """Squared radii, limited to where a conic surface ends."""
    array = imager.array
    ends = 1 + array.conic_constant > 0
    end = (1 - 1e-6) ** 2 * array.radius_of_curvature**2 / jnp.where(ends, 1 + array.conic_constant, 1)
    return jnp.where(ends, jnp.minimum(squared_radius, end), squared_radius)


@best_type
def fwhm(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Full width at half maximum of the PSF of a point on a lens's axis, seen in the object, mm.

    The profile through the middle of the image, as pixels see it: diffraction with the exact wavefront of the round
    clear aperture, averaged over the area of a pixel. The width is that between the outermost points of half the
    height. A blur of more than six pixels and Airy discs is that of rays.
    """
    at = as_conditions(imager, depths)
    radius, pixel, airy = clear_diameter(imager, at) / 2, imager.sensor.pixel_pitch, _airy(imager, at)

    def on_sensor(depth):
        pupil = axial_pupil(imager, depth, radius=radius)
        by_rays = _width_by_rays(pupil)
        narrow = _WIDE * jnp.maximum(pixel, theory.FWHM * airy)
        positions = (narrow + pixel) * jnp.linspace(0, 1, _RADII, dtype=narrow.dtype)
        # Dense in the middle: the core may be much smaller than a pixel.
        irradiance = axial_irradiance(imager, pupil, positions**2 / positions[-1])
        by_waves = _outermost_half(positions, _over_pixels(positions, irradiance, pixel))
        return jnp.where(by_rays > narrow, by_rays, by_waves)

    return jax.lax.map(on_sensor, at.depths) / imager.magnification(at.depths)


def _over_pixels(positions, irradiance, pixel) -> Float[Array, " position"]:
    """Light in square pixels whose middles are at positions along an axis, of a round image given at positions squared.

    The circle of each radius has an arc within the pixel, which is exact: images may be much smaller than a pixel, or
    larger.
    """
    half, count, last = pixel / 2, irradiance.shape[0], positions[-1]
    # Radii that meet the pixel, dense at the lower end, where the middle of the image may be.
    low, high = jnp.maximum(positions - math.sqrt(2) * half, 0), jnp.minimum(positions + math.sqrt(2) * half, last)
    t = jnp.asarray((np.arange(_ARCS) + 0.5) / _ARCS, positions.dtype)[None]
    span = (high - low)[:, None]
    radius = low[:, None] + span * t**2
    index = (count - 1) * jnp.sqrt(radius / last)
    floor = jnp.minimum(jnp.floor(index), count - 2)
    below, above = (irradiance[floor.astype(int) + step] for step in (0, 1))
    first, end = (_arccos((positions[:, None] + side) / radius) for side in (half, -half))
    side = jnp.pi / 2 - _arccos(half / radius)
    arc = jnp.maximum(jnp.minimum(end, side) - first, 0) + jnp.maximum(end - jnp.maximum(first, jnp.pi - side), 0)
    return jnp.sum(arc * (below + (index - floor) * (above - below)) * radius * span * t, 1)


def _arccos(cosine):
    """The angle of a cosine, or of the nearest one; at the ends without a derivative, which is infinite."""
    inside = jnp.abs(cosine) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, cosine, 0)), jnp.where(cosine < 0, jnp.pi, 0))


def _width_by_rays(pupil: AxialPupil) -> Float[Array, ""]:
    """Full width at half of the highest density of rays, mm: density over squared radii, blurred a little."""
    share, squared = jnp.where(pupil.lit, pupil.weight, 0), pupil.landing**2
    mean = jnp.sum(share * squared) / jnp.maximum(jnp.sum(share), _NOTHING)

    def width_squared(reach, blur):
        positions = reach * jnp.linspace(0, 1, _RADII, dtype=share.dtype)
        gauss = lambda apart: jnp.exp(-((apart / blur) ** 2) / 2)
        away, mirrored = (positions[:, None] + sign * squared[None] for sign in (-1, 1))
        return _outermost_half(positions, jnp.sum(share[None] * (gauss(away) + gauss(mirrored)), 1)) / 2

    # Stray light makes the mean large: the core shows once the blur is small beside it.
    finer = lambda width, _: (width_squared(2 * width, _FINE * width), None)
    first = width_squared(4 * mean + _NOTHING, _COARSE * mean + _NOTHING)
    return 2 * safe_sqrt(jax.lax.scan(finer, first, length=_PASSES)[0])


def _outermost_half(positions, profile) -> Float[Array, ""]:
    """Twice the largest radius at which a profile has half of its maximum; linear between radii."""
    half = jnp.max(profile) / 2
    last = jnp.minimum(jnp.max(jnp.where(profile >= half, jnp.arange(len(profile)), 0)), len(profile) - 2)
    high, low = profile[last], profile[last + 1]
    part = (high - half) / jnp.where(high > low, high - low, 1)
    return 2 * (positions[last] + part * (positions[last + 1] - positions[last]))


@best_type
def rms_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """RMS width of the PSF along an axis, the standard deviation of its light, seen in the object, mm.

    Exact rays through the clear aperture, with all that defocus and aberrations do, averaged over the lens's field
    with its envelope; plus the variances of the pixel and of a Gaussian as wide as the Airy disc. Light far from the
    core counts, so with stray light this is many times the width of the core, `fwhm`.
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    squared = jnp.sum(lit * jnp.sum((landing - _centroid(landing, lit)) ** 2, -1), -1) / 2
    rays = jnp.sum(weight * squared, -1)
    return jnp.sqrt(rays + _airy(imager, at) ** 2 + imager.sensor.pixel_pitch**2 / 12) / imager.magnification(at.depths)


def spot_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Width of the spot, 2.355 times `rms_width`, seen in the object, mm: the FWHM of a Gaussian of that variance.

    Of a PSF that is no Gaussian it is not the FWHM, which `fwhm` is. Of the best type.
    """
    return theory.FWHM * rms_width(imager, depths)


def width_per_light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """`spot_width` over the fourth root of the percentage of light that all lenses collect: sharpness and noise in one.

    In mm, as `spot_width` where the lenses collect 1 %. It ranks designs as Richardson-Lucy at equal exposure does
    (`experiments/results/codesign.md`).
    """
    return _per_light(spot_width(imager, depths), light(imager, depths))


@jax.jit
def _per_light(width, light):
    return width / (100 * light) ** 0.25


@best_type
def half_light_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius about the centroid that holds half of the PSF's light, seen in the object, mm.

    Rays as for `rms_width`, each moved by numbers with the distribution of the pixel and of a Gaussian as wide as the
    Airy disc (fixed seed; right to 2 %).
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    airy, pixel = _airy(imager, at), imager.sensor.pixel_pitch
    rng, shape = np.random.default_rng(0), (_MOVES, *landing.shape[2:])
    even, normal = rng.uniform(-0.5, 0.5, shape), rng.normal(size=shape)
    moves = pixel * jnp.asarray(even, landing.dtype) + airy * jnp.asarray(normal, landing.dtype)
    moved = (landing[:, :, None] + moves[None, None]).reshape(*landing.shape[:2], -1, 2)
    smooth = _SMOOTH * jnp.sqrt(airy**2 + pixel**2 / 12)
    on_sensor = _radius_of(0.5, moved, weight, jnp.tile(lit, (1, 1, _MOVES)) / _MOVES, smooth)
    return on_sensor / imager.magnification(at.depths)


@best_type
def encircled_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius about the rays' centroid that holds 80 % of them, seen in the object, mm; rays as for `rms_width`.

    A ray counts as within by a logistic curve half a pixel wide: without it the radius would have a kink wherever
    one ray overtakes another.
    """
    at = as_conditions(imager, depths)
    return _radius_of(0.8, *_spots(imager, at), imager.sensor.pixel_pitch / 2) / imager.magnification(at.depths)


def _radius_of(part: float, landing, weight, lit, width) -> Float[Array, " depth"]:
    """Radius about the centroid that holds a part of the rays of all heights, each counted by a logistic curve."""
    radius = safe_sqrt(jnp.sum((landing - _centroid(landing, lit)) ** 2, -1))
    share = weight[..., None] * lit
    radius, share = (x.reshape(x.shape[0], -1) for x in (radius, share))
    return jax.vmap(lambda x, share: _quantile(part, x, share, width))(radius, share)


def _quantile(part: float, x: Float[Array, " entry"], share: Float[Array, " entry"], width) -> Float[Array, ""]:
    """Where a part of the entries is below, each counted by a logistic curve; bisection, then Newton's step.

    The step changes next to nothing but has the derivatives of the implicit function.
    """
    below = lambda at: jnp.sum(share * jax.nn.sigmoid((at - x) / width)) - part
    fixed = jax.lax.stop_gradient

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        under = fixed(below(middle)) < 0
        return jnp.where(under, middle, low), jnp.where(under, high, middle)

    top = fixed(jnp.max(x)) + 20 * width
    at, _ = jax.lax.fori_loop(0, 40, halve, (jnp.zeros_like(top), top))
    slope = fixed(jax.grad(below)(at))
    lit = slope > 0
    return at - jnp.where(lit, below(at) / jnp.where(lit, slope, 1), 0)


def _spots(imager: Imager, at: Conditions):
    """Where rays land, `(depth, field, ray, 2)`; the share of each height, and of each ray of it."""
    points, weights = pupil_quadrature(clear_diameter(imager, at) / 2)
    heights = field_heights(imager, at)
    trace = lambda z, h: trace_lenslet(imager, z, points, (h, jnp.zeros_like(h)))
    rays = jax.vmap(jax.vmap(trace, (None, 0)), (0, None))(at.depths, heights)
    lit = jnp.where(rays.valid, weights[None, None], 0)
    total = jnp.sum(lit, -1, keepdims=True)
    weight = envelope(heights[None] ** 2, imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    return rays.landing, weight / jnp.sum(weight, -1, keepdims=True), lit / jnp.where(total > 0, total, 1)


def _centroid(landing, lit):
    return jnp.sum(lit[..., None] * landing, -2, keepdims=True)


def _airy(imager, at):
    return theory.airy_sigma(imager.wavelength, imager.reduced_sensor_distance, clear_diameter(imager, at))
