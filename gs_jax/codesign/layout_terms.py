"""Terms of a study that judge the layout, and terms at equal exposure.

They apply `array_psf`, `fisher`, `linear_error` and `end_to_end` at points, depths and frequencies that follow from the
imager and its conditions. Points lie where they see a whole field of lenses. Random terms draw new ones for each key.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..geometry import Imager, field_limit
from ..grid import Grid
from ..objectives.conditions import Conditions, finite_plate, per_type
from .array_psf import array_spectrum, condition_number, mean_inverse_views, sidelobes, spectral_flatness
from .end_to_end import reconstruction_loss
from .fisher import crowded_bound, localization_bound
from .linear_error import PLACE, lens_electrons, lost_power, spots

# Numbers of sources and targets for sidelobes, of points that are located or whose spectrum is computed; and electrons
# a lens of a point.
_SOURCES, _TARGETS, _POINTS, _PHOTONS = 4, 256, 4, 1000.0
# Spatial frequencies of a spectrum.
_FREQUENCIES = 256
# Points along a side of the plate.
_RASTER = 15
# Voxels along a side of a random scene, blobs per voxel, each as wide as a voxel; scenes of a draw.
_VOXELS, _DENSITY, _SCENES = 99, 0.008, 2
# Places along a side of the part of the plate whose points see a whole field of lenses.
_PLACES = 2
# Side of a lens's own spot, pixels.
_SPOT = 65


def ghosts(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """RMS sidelobe of random points at random targets, relative to the peak; spots are a pixel wide."""
    near, far = jax.random.split(key)
    sources, targets = _points(imager, at, near, _SOURCES), _points(imager, at, far, _TARGETS)
    pixel = imager.sensor.pixel_pitch
    size = 4 * pixel / imager.magnification(at.depths)[0]
    axial = size * imager.depth_in_medium(at.depths)[0] / imager.field_radius
    return sidelobes(imager, sources, targets, width=pixel, lateral=size, axial=axial).rms


def shortage(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """`mean_inverse_views` over the whole plate, at the middle depth."""
    plate = finite_plate(imager)
    side = jnp.linspace(-0.5, 0.5, _RASTER, dtype=plate.dtype)
    places = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]
    depth = jnp.broadcast_to(at.middle.depths, (len(places), 1))
    return mean_inverse_views(imager, jnp.concatenate([places, depth], 1))


def flatness(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`spectral_flatness` of random points at random frequencies."""
    return spectral_flatness(_spectrum(imager, at, key))


def conditioning(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`condition_number` of the same spectrum."""
    return condition_number(_spectrum(imager, at, key))


def _spectrum(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, "point frequency"]:
    """Power at frequencies between `1 / field_radius` and Nyquist, log-uniform, in all directions."""
    place, size, angle = jax.random.split(key, 3)
    low, high = 1 / imager.field_radius, 0.5 / imager.sensor.pixel_pitch
    draw = lambda key: jax.random.uniform(key, (_FREQUENCIES,), at.depths.dtype)
    frequency, turn = low * (high / low) ** draw(size), jnp.pi * draw(angle)
    frequencies = jnp.stack([frequency * jnp.cos(turn), frequency * jnp.sin(turn)], 1)
    return array_spectrum(imager, _points(imager, at, place, _POINTS), frequencies)


def localization(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, "3"]:
    """Cramer-Rao bound of x, y, z at random points, um; the spot has a standard deviation of one pixel."""
    points, spot = _points(imager, at, key, _POINTS), imager.sensor.pixel_pitch
    return 1000 * localization_bound(imager, points, photons=_PHOTONS, spot=spot)


def log_error(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """Logarithm of the relative error, `sqrt(1 - <a,b>^2 / (<a,a> <b,b>))`, of reconstructed random scenes.

    Scenes have three depths of 99 x 99 voxels, as wide as the field of a lens, at a random place of the plate:
    sub-images overlap as much as those of an object that fills the field. Spots are points, and all lenses have the
    same light.
    """
    return _log_error(imager, at, key)


def log_error_for_exposure(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`log_error` with the lenses' own spots and the light of the exposure."""
    at = dataclasses.replace(at, depths=_three(at))
    # `forward` does not scale light with the depth: all three planes have the mean.
    share = (_voxel_pitch(imager) / PLACE) ** 2
    of_type = lambda one, own: (one, spots(one, own, _SPOT), share * jnp.mean(lens_electrons(one, own)))
    return _log_error(imager, at, key, types=[of_type(*part) for part in per_type(imager, at)])


def _three(at: Conditions) -> Float[Array, "3"]:
    return jnp.concatenate([at.depths[:1], at.middle.depths, at.depths[-1:]])


def _voxel_pitch(imager: Imager) -> float:
    """Pitch of the voxels of a random scene, mm."""
    return 2 * imager.field_radius / _VOXELS


def _log_error(imager: Imager, at: Conditions, key: PRNGKeyArray, **light) -> Float[Array, ""]:
    sensor, reach = imager.sensor, imager.field_radius
    depths, pitch = _three(at), _voxel_pitch(imager)
    # Distance of a voxel from its image by the farthest lens that sees it.
    beside = (1 + at.largest_magnification) * field_limit(reach)
    rows, columns = (math.ceil(min(n, 2 * (reach + beside) / sensor.pixel_pitch)) for n in sensor.shape)
    height, width = (max(0.0, n * sensor.pixel_pitch - 4 * reach) for n in sensor.shape)
    found = reconstruction_loss(
        imager,
        key,
        grid=Grid(depths, (_VOXELS, _VOXELS), pitch),
        scenes=_SCENES,
        density=_DENSITY,
        width=pitch,
        background_width=4 * pitch,
        window=(rows, columns),
        field=(width, height),
        **light,
    )
    return found * jnp.log(jnp.asarray(10.0, found.dtype)) / 20


def _inner_plate(imager: Imager) -> Float[Array, "2"]:
    """Size of the part of the plate a field radius from its edge, or a quarter of the plate where that is larger."""
    plate = finite_plate(imager)
    return jnp.maximum(plate - 2 * imager.field_radius, plate / 4)


def _points(imager: Imager, at: Conditions, key: PRNGKeyArray, count: int) -> Float[Array, "point 3"]:
    """Random points over the depths and the field, a field radius from the plate's edge where it is that large."""
    inner = _inner_plate(imager)
    middle = jnp.stack([0 * inner[0], 0 * inner[0], at.middle.depths[0]])
    size = jnp.stack([inner[0], inner[1], at.depths[-1] - at.depths[0]])
    return middle[None] + size[None] * jax.random.uniform(key, (count, 3), inner.dtype, -0.5, 0.5)


def volume_error(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """Relative error of volumes by the best linear estimate: the root of the mean of `lost_power` over the depths."""
    return jnp.sqrt(jnp.mean(lost_power(per_type(imager, at), places_of(imager))))


def crowded_precision(imager: Imager, at: Conditions) -> Float[Array, "depth 3"]:
    """`crowded_bound` of x, y, z at each depth, um."""
    return 1000 * crowded_bound(per_type(imager, at), places_of(imager))


def places_of(imager: Imager) -> Float[Array, "place 2"]:
    """Four points that stand for the plate, a field radius from its edge where it is that large, mm."""
    inner = _inner_plate(imager)
    side = jnp.asarray((np.arange(_PLACES) + 0.5) / _PLACES - 0.5, inner.dtype)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * inner[None]
