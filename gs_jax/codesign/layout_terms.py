"""What a layout of lenses does to the reconstruction, as terms of co-design.

The functions of `comb`, `fisher` and `end_to_end` want points, grids and windows; a study names a term and no more.
What is chosen here follows from the candidate: places over the part of the plate whose points see a whole field of
lenses, the depths that are judged, and blobs and spots of a few pixels. Random terms draw anew from their key.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..design.microscope import Microscope
from ..geometry import field_limit
from ..grid import Grid
from .comb import comb_spectrum, condition_number, lens_shortage, sidelobes, spectral_flatness
from .end_to_end import reconstruction_loss
from .fisher import localization_bound
from .transfer import PLACE, lens_electrons, spots

# Points whose ghosts are looked for, and places where; points that are located or whose combs are looked at; light of
# one, electrons a lens.
_SOURCES, _TARGETS, _POINTS, _PHOTONS = 4, 256, 4, 1000.0
# Spatial frequencies at which a point's comb is looked at.
_FREQUENCIES = 256
# Places along a side of the plate.
_RASTER = 15
# Voxels along a side of a random scene, blobs per voxel, each as wide as a voxel; scenes of a draw.
_VOXELS, _DENSITY, _SCENES = 99, 0.008, 2
# Side of a lens's own spot, pixels.
_SPOT = 65


def ghosts(c: Microscope, key: PRNGKeyArray) -> Float[Array, ""]:
    """RMS ghost of a point at random other places, over its own image; a pixel is the width of a tooth."""
    near, far = jax.random.split(key)
    sources, targets = _points(c, near, _SOURCES), _points(c, far, _TARGETS)
    pixel = c.imager.sensor.pixel_pitch
    size = 4 * pixel / c.magnification[0]
    axial = size * c.reduced[0] / c.imager.field_radius
    return sidelobes(c.imager, sources, targets, width=pixel, lateral=size, axial=axial).rms


def shortage(c: Microscope) -> Float[Array, ""]:
    """`comb.lens_shortage` over the whole plate, at the middle depth."""
    side = jnp.linspace(-0.5, 0.5, _RASTER, dtype=c.plate.dtype)
    places = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * c.plate[None]
    depth = jnp.broadcast_to((c.depths[0] + c.depths[-1]) / 2, (len(places), 1))
    return lens_shortage(c.imager, jnp.concatenate([places, depth], 1))


def flatness(c: Microscope, key: PRNGKeyArray) -> Float[Array, ""]:
    """`comb.spectral_flatness` of random points' combs, at random frequencies of `_spectrum`."""
    return spectral_flatness(_spectrum(c, key))


def conditioning(c: Microscope, key: PRNGKeyArray) -> Float[Array, ""]:
    """`comb.condition_number` of the same."""
    return condition_number(_spectrum(c, key))


def _spectrum(c: Microscope, key: PRNGKeyArray) -> Float[Array, "point frequency"]:
    """Power from one over the field radius to the Nyquist frequency, evenly over its logarithm and all directions."""
    place, size, angle = jax.random.split(key, 3)
    low, high = 1 / c.imager.field_radius, 0.5 / c.imager.sensor.pixel_pitch
    draw = lambda key: jax.random.uniform(key, (_FREQUENCIES,), c.depths.dtype)
    frequency, turn = low * (high / low) ** draw(size), jnp.pi * draw(angle)
    frequencies = jnp.stack([frequency * jnp.cos(turn), frequency * jnp.sin(turn)], 1)
    return comb_spectrum(c.imager, _points(c, place, _POINTS), frequencies)


def localization(c: Microscope, key: PRNGKeyArray) -> Float[Array, "3"]:
    """Cramer-Rao bound of x, y, z at random points, um; a spot of one pixel's standard deviation."""
    points, spot = _points(c, key, _POINTS), c.imager.sensor.pixel_pitch
    return 1000 * localization_bound(c.imager, points, photons=_PHOTONS, spot=spot)


def log_error(c: Microscope, key: PRNGKeyArray) -> Float[Array, ""]:
    """Logarithm of the relative error, `sqrt(1 - <a,b>^2 / (<a,a> <b,b>))`, of reconstructed random scenes.

    Three depths of 99 x 99 voxels, as wide as the field of a lens, at a random place of the plate: sub-images overlap
    as much as those of an object that fills the field. Spots are points, and light is the same for all lenses.
    """
    return _log_error(c, key)


def log_error_for_exposure(c: Microscope, key: PRNGKeyArray) -> Float[Array, ""]:
    """The same with the lens's own spots and the light of the exposure, from a blob's lit voxels."""
    at = dataclasses.replace(c, depths=_three(c))
    # `forward` has no inverse square of the depth: the same light for all three, the mean.
    electrons = jnp.mean(lens_electrons(at)) * (_pitch(c) / PLACE) ** 2
    return _log_error(c, key, psf=spots(at, _SPOT), electrons=electrons)


def _three(c: Microscope) -> Float[Array, "3"]:
    return jnp.stack([c.depths[0], (c.depths[0] + c.depths[-1]) / 2, c.depths[-1]])


def _pitch(c: Microscope) -> float:
    """Of the voxels of a random scene, mm."""
    return 2 * c.imager.field_radius / _VOXELS


def _log_error(c: Microscope, key: PRNGKeyArray, **light) -> Float[Array, ""]:
    sensor, reach = c.imager.sensor, c.imager.field_radius
    depths, pitch = _three(c), _pitch(c)
    # A voxel is imaged up to this far beside it, by the lens that is as far away as one can be that sees it.
    beside = (1 + c.largest_magnification) * field_limit(reach)
    rows, columns = (math.ceil(min(n, 2 * (reach + beside) / sensor.pixel_pitch)) for n in sensor.shape)
    height, width = (max(0.0, n * sensor.pixel_pitch - 4 * reach) for n in sensor.shape)
    found = reconstruction_loss(
        c.imager,
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


def _points(c: Microscope, key: PRNGKeyArray, count: int) -> Float[Array, "point 3"]:
    """Points evenly over the depths and the field, a field radius from the plate's edge where it is that large."""
    inner = jnp.maximum(c.plate - 2 * c.imager.field_radius, c.plate / 4)
    middle = jnp.stack([0 * inner[0], 0 * inner[0], (c.depths[0] + c.depths[-1]) / 2])
    size = jnp.stack([inner[0], inner[1], c.depths[-1] - c.depths[0]])
    return middle[None] + size[None] * jax.random.uniform(key, (count, 3), inner.dtype, -0.5, 0.5)
