"""Error of the best linear estimate of volumes: defocus, aberrations, light, noise and parallax in one number.

Scenes are planes of random objects with edges, as wide as the plate, stationary and independent of each other. The best
linear estimate (Wiener's) depends on second moments of scene, image and noise only, and treats each frequency `v` of
the sensor by itself. Lens `j` images plane `k` with

    A_jk = H_jk(v) L_jk M_k exp(2 pi i v . r_j M_k) / n_j^(1/2)

for the transfer function `H`, the light `L` of a lit plane on the sensor, the magnification `M`, the lens's position
`r_j` beside the object and the density `n_j` of its noise. For planes with the spectrum `S_k` the relative error of
plane `k` is the diagonal of

    (1 + S^(1/2) A* A S^(1/2))^-1

(Kailath, Sayed and Hassibi, Linear Estimation, 2000, Theorem 3.2.1). No random numbers are drawn.

All lenses of the plate count whose images are on the sensor: exact rays, Fresnel losses and the clear aperture give the
light and the blur at each one's angle. Nothing ends at the field radius, which is that of back-projection.

Approximations: where sub-images overlap, their light counts as noise; a lens differs from those of its type by its
angle alone; an emission band is left out, light is of the imager's wavelength; and frequencies above Nyquist count as
others do, since lenses sample an object with different parts of a pixel. Sums are coarse, alike for all candidates: for
four designs (`experiments/results/codesign.md`) 5 x 5 objects in place of 3 x 3 gave 3 to 4 % more, 40 angles in place
of 14 gave 0.5 to 2 % more, and 80 rings of rays in place of 45 gave at most 0.6 % more. For sparse scenes, solvers with
a positivity constraint do better than any linear estimate. The paper has no such measure.

An exposure is a time and a brightness, the same for all candidates: the electrons that each mm^2 of clear aperture, 20
mm away in air, would collect without losses from an emitter of 40 um x 40 um. So a smaller aperture pays for its
sharpness with light, and a magnification for its detail.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..microscope.geometry import Imager
from ..objectives.conditions import Conditions, by_type, clear_diameter, finite_plate, of_lenses
from ..optics import theory
from ..optics.pupil import pupil_quadrature, solid_angle, transmittance
from ..optics.raytrace import refract

# Lit fraction of a plane of the scene, and the distance over which its correlation falls to 1/e, in voxels.
FILL, _LENGTH = 0.03, 1.25
# Read noise, electrons.
_READ_NOISE = 2.0
# Nodes of the quadrature over frequencies, up to Nyquist of the scene's voxels.
_NODES = 16
# Squares along a side of the plate; an object in the middle of each stands for the square.
_SQUARES = 3
# Angles at which a lens is evaluated, and the largest tangent of these.
_ANGLES, _WIDEST = 14, 1.2
# Distance and side of the emitter that an exposure is defined by, mm.
EMITTER_DISTANCE, EMITTER_SIDE = 20.0, 0.04
# Rings of rays: enough at the largest tangent and the finest frequencies, where fewer alias.
_RINGS = 45
# Directions of frequencies over half a turn.
_DIRECTIONS = 4


def volume_error(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """Relative error of volumes by the best linear estimate: the root of the mean of `lost_power` over the depths."""
    return jnp.sqrt(jnp.mean(lost_power(imager, at, imager.on_plate(plate_positions(imager)))))


def lost_power(imager: Imager, at: Conditions, positions: Float[Array, "position 2"]) -> Float[Array, " depth"]:
    """Mean squared error of the best linear estimate over the scene's variance, at each depth: 0 to 1.

    Parameters
    ----------
    imager, at
        Lenses of any number of types, and conditions whose depths are the scene's planes.
    positions
        `(x, y)` of objects in the sensor's frame, mm; the result is the mean over them.
    """
    scene = scene_of(imager, at)
    views, spots = views_and_spots(imager, at, positions, scene)
    noise, planes = noise_density(imager, at, views), jnp.eye(at.depths.size, dtype=at.depths.dtype)

    def at_position(position):
        amplitude, turns = images(imager, at, scene, spots, *position)

        def at_frequency(frequency, amplitude):
            cos, sin = (amplitude[None] * wave(frequency * turns) for wave in (jnp.cos, jnp.sin))
            same = jnp.einsum("wlj,wlk->wjk", cos, cos) + jnp.einsum("wlj,wlk->wjk", sin, sin)
            other = jnp.einsum("wlj,wlk->wjk", cos, sin)
            real, imaginary = planes[None] + same, other - jnp.swapaxes(other, 1, 2)
            # A complex matrix as a real one of twice the size.
            normal = jnp.block([[real, -imaginary], [imaginary, real]])
            left = jnp.diagonal(jnp.linalg.inv(normal), axis1=1, axis2=2)
            return jnp.mean(left[:, : len(planes)], 0)

        return jax.vmap(at_frequency, (0, 2), 1)(scene.frequency, amplitude)

    return jnp.sum(jnp.mean(jax.lax.map(at_position, (views, noise)), 0) * scene.share, 1)


def plate_positions(imager: Imager) -> Float[Array, "position 2"]:
    """Middles of squares that divide the plate, `(x, y)` in the plate's frame, mm."""
    plate = finite_plate(imager)
    side = jnp.asarray((np.arange(_SQUARES) + 0.5) / _SQUARES - 0.5, plate.dtype)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]


class Scene(NamedTuple):
    """Random planes by frequencies of the sensor, 1/mm.

    `spectrum`: power of the objects' brightness, mm^2. `share`: share of a plane's power.
    """

    frequency: Float[Array, " frequency"]
    spectrum: Float[Array, "depth frequency"]
    share: Float[Array, "depth frequency"]


def scene_of(imager: Imager, at: Conditions) -> Scene:
    """The scene of `volume_error`, a plane at each depth."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, magnification = at.depths.dtype, imager.magnification(at.depths)
    detail = at.detail.astype(dtype)
    # Frequencies in the object, 1/mm; on the sensor they are those of the mean magnification.
    object_frequency = jnp.asarray((nodes + 1) / 4, dtype) / detail
    frequency = object_frequency / jnp.mean(magnification)
    spectrum = _spectrum(magnification[:, None] * frequency[None], detail)
    share = (jnp.asarray(weights, dtype) * object_frequency)[None] * spectrum
    return Scene(frequency, spectrum, share / jnp.sum(share, 1, keepdims=True))


def views_and_spots(
    imager: Imager, at: Conditions, positions: Float[Array, "position 2"], scene: Scene
) -> tuple["View", "Spots"]:
    """Views of objects at positions, and the spots of each lens at the angles of its views."""
    # Largest tangent between an object and the farthest lens.
    farthest = jnp.linalg.norm(finite_plate(imager)) * (1 - 1 / (2 * _SQUARES))
    widest = farthest / jnp.min(imager.reduced_depth(at.depths))
    tangents = jnp.minimum(widest, _WIDEST) * jnp.linspace(0, 1, _ANGLES, dtype=at.depths.dtype)
    spots = spots_of_types(imager, at, tangents, scene.frequency)
    spots = jax.tree.map(lambda values: of_lenses(imager, values), spots)
    return jax.vmap(lambda position: _view(imager, at, position, tangents, spots.electrons))(positions), spots


def images(
    imager: Imager, at: Conditions, scene: Scene, spots: "Spots", view: "View", noise: Float[Array, " lens"]
) -> tuple[Float[Array, "lens depth frequency"], Float[Array, "direction lens depth"]]:
    """Amplitudes of the planes in the sub-images of an object over their noise, and phases over the frequency."""
    turns = 2 * jnp.pi * jnp.moveaxis(view.displacement @ directions(at.depths.dtype), -1, 0)
    scale = safe_sqrt(view.on_sensor) * view.electrons / (EMITTER_SIDE**2 * imager.magnification(at.depths))[None]
    power = jnp.einsum("lda,ldaf,df->ldf", view.angles, spots.power, scene.spectrum)
    return (scale / jnp.sqrt(noise)[:, None])[..., None] * safe_sqrt(power), turns


class View(NamedTuple):
    """Views of an object at each depth by all lenses.

    `electrons`: of an emitter of 40 um x 40 um. `on_sensor`: how much of the square that the object stands for is
    imaged onto the sensor. `displacement`: of the image from the lens, mm. `angles`: weights of the angles at which
    lenses are evaluated.
    """

    electrons: Float[Array, "lens depth"]
    on_sensor: Float[Array, "lens depth"]
    displacement: Float[Array, "lens depth 2"]
    angles: Float[Array, "lens depth angle"]


def _view(imager, at, position, tangents, electrons) -> View:
    points = jnp.concatenate([jnp.tile(position, (at.depths.size, 1)), at.depths[:, None]], 1)
    views, sensor = imager.views_of_all(points), imager.sensor
    tangent = safe_sqrt(jnp.sum(views.offset**2, -1)) / views.reduced_depth
    # Linear between two angles; beyond the last as there, but for the law of the fourth power of the cosine.
    place = jnp.minimum(tangent / tangents[-1], 1) * (_ANGLES - 1)
    angles = jax.nn.relu(1 - jnp.abs(place[..., None] - jnp.arange(_ANGLES, dtype=place.dtype)[None, None]))
    light = jnp.einsum("lda,lda,a->ld", angles, electrons, (1 + tangents**2) ** 2) / (1 + tangent**2) ** 2
    half = jnp.asarray(sensor.shape[::-1], place.dtype) * (sensor.pixel_pitch / 2)
    image = imager.magnification(at.depths)[:, None] * (finite_plate(imager) / _SQUARES)[None]
    from_middle = jnp.abs(views.spot - jnp.asarray(sensor.origin, place.dtype)[None, None])
    inside = (half[None, None] - from_middle) / image[None] + 0.5
    return View(light, jnp.prod(jnp.clip(inside, 0, 1), -1), views.spot - imager.centers[:, None], angles)


def noise_density(imager: Imager, at: Conditions, views: View) -> Float[Array, "position lens"]:
    """Noise density of each lens's sub-image, electrons^2 per mm^2, for views of objects that stand for the plate.

    It is the shot noise of the planes, the light of all sub-images, which overlap, spread over the sensor, and the
    read noise.
    """
    sensor = imager.sensor
    own = views.electrons @ imager.magnification(at.depths) ** -2
    # All light that reaches the sensor from planes as large as the plate.
    whole = jnp.mean(jnp.sum(views.on_sensor * views.electrons, (1, 2))) * jnp.prod(finite_plate(imager))
    over = whole / (sensor.shape[0] * sensor.shape[1] * sensor.pixel_pitch**2)
    return FILL / EMITTER_SIDE**2 * (own + over) + (_READ_NOISE / sensor.pixel_pitch) ** 2


def _spectrum(frequency, detail):
    """Power spectrum of random objects with edges, whose correlation falls exponentially (Debye), mm^2."""
    length = _LENGTH * detail
    return FILL * (1 - FILL) * 2 * jnp.pi * length**2 / (1 + (2 * jnp.pi * length * frequency) ** 2) ** 1.5


def directions(dtype) -> Float[Array, "2 direction"]:
    """Unit vectors evenly over half a turn; the other half is equivalent."""
    angle = jnp.asarray((np.arange(_DIRECTIONS) + 0.5) * np.pi / _DIRECTIONS, dtype)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


class Spots(NamedTuple):
    """Electrons of an emitter of 40 um x 40 um under a lens; squared transfer function, the mean over directions."""

    electrons: Float[Array, "*type depth angle"]
    power: Float[Array, "*type depth angle frequency"]


@by_type
def spots_of_types(
    imager: Imager, at: Conditions, tangents: Float[Array, " angle"], frequencies: Float[Array, " frequency"]
) -> Spots:
    """Light and blur of lenses at angles, by exact rays through the clear aperture with Fresnel losses; a row a type.

    The transfer function is the Fourier transform of the rays, with defocus and all aberrations, times the transfer
    functions of a perfect lens and of a pixel. The product is exact for spots much wider than the Airy disc and for
    those without aberrations; between these limits it is a little low.

    Parameters
    ----------
    imager, at
        Lenses, and the depths.
    tangents
        Of the angles between the emitter and a lens's axis.
    frequencies
        On the sensor, 1/mm.
    """
    diameter = clear_diameter(imager, at)
    # Spots are symmetric about the field's direction, x: half of the rays and of the directions give all.
    half = [
        values.reshape(_RINGS, 4 * _RINGS, -1)[:, : 2 * _RINGS] for values in pupil_quadrature(diameter / 2, _RINGS)
    ]
    points, weights = half[0].reshape(-1, 2), 2 * half[1].ravel()
    ways = directions(at.depths.dtype)[:, : _DIRECTIONS // 2]

    def spot(depth, tangent):
        height = tangent * imager.reduced_depth(depth)

        def through(point):
            ray = refract(imager, depth, point, jnp.stack([height, jnp.zeros_like(height)]))
            return ray.landing, jnp.where(ray.valid, solid_angle(imager, ray) * transmittance(imager, ray), 0)

        landing, light = jax.vmap(through)(points)
        light = weights * light
        total = jnp.sum(light)
        share = light / jnp.where(total > 0, total, 1)
        # Phases are relative to the centroid.
        x, y = landing[:, 0] - jnp.sum(share * landing[:, 0]), landing[:, 1]
        along, across = (
            2 * jnp.pi * frequencies[:, None, None] * jnp.outer(*each)[None] for each in zip((x, y), ways, strict=True)
        )
        both = share[None, :, None] * jnp.cos(across)
        real, imaginary = (jnp.sum(both * wave(along), 1) for wave in (jnp.cos, jnp.sin))
        return total, jnp.mean(real**2 + imaginary**2, 1)

    # Recomputed in the reverse pass, which takes half the time of reading what all rays and frequencies would leave.
    at_depth = jax.checkpoint(lambda depth: jax.vmap(spot, (None, 0))(depth, tangents))
    total, power = jax.lax.map(at_depth, at.depths)
    electrons = at.exposure.astype(total.dtype) * EMITTER_DISTANCE**2 * (jnp.pi / 4 * diameter**2) * total
    cutoff = theory.cutoff_frequency(imager.wavelength, imager.reduced_sensor_distance, diameter)
    others = theory.ideal_mtf(frequencies, cutoff) * jnp.sinc(frequencies * imager.sensor.pixel_pitch)
    return Spots(electrons, power * (others**2)[None, None])
