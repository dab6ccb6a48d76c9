"""Simulated captures with all of their light, by random microscopes, and what they show.

Everything is a function of a seed and a number: the same arguments give the same data. Host code, but for the optics.
"""

from functools import cache, lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32

from ...base.arrays import in_float32
from ...geometry import Imager, Sensor
from ...grid import Grid
from ...layouts import hexagonal_layout, poisson_disc_layout, random_layout
from ...lenses import MicrolensArray
from ...optics.field_varying import FieldVaryingPsf, PolarGrid, field_varying_psf, make_polar_grid
from ...projection.forward_model import forward
from ...simulation.synthetic import Camera, electrons, expose
from ...typing import Volume
from .random_scenes import PLANES as SCENE_PLANES, random_scene, shared_out

# Scenes that one microscope images: its tables take longer than an image.
SCENES = 8
FIELD_RADIUS = 3.0
# Side of the square that a lens has to itself, mm: sqrt(400 / 213) on the authors' plate.
LENS_SPACING = 1.37
# Depths that any example may have, mm: they share the tables' nodes, and so what is compiled.
_DEPTHS = np.array([16.5, 24.5])
# No point is farther from a lens, along x or y, in widths of the sensor.
_FARTHEST = 1.3
# How far a capture's microscope is from what is known of it, standard deviations: of the lenses' places, mm, the
# sensor's distance, relative, its turn, radians, and its place, mm.
_LENSES_OFF, _DISTANCE_OFF, _TURNED, _SHIFTED = 0.0015, 7e-4, 2e-4, 0.003
# Of the pixels, at most twice as many.
_DEAD = 1e-5


class Kind(NamedTuple):
    """Sizes of an example: pixels along a side and their pitch, that of the voxels, mm; planes; sensor's pixels in one.

    A smaller microscope than the paper's, of the same lenses: what a voxel sees is the same.
    """

    pixels: int
    pixel: float
    pitch: float
    planes: int
    binning: int = 1

    @property
    def side(self) -> float:
        return self.pixels * self.pixel


class Device(NamedTuple):
    """A microscope, what is known of it, depths of its volumes and of its scenes, and its light at the latter."""

    imager: Imager
    known: Imager
    depths: np.ndarray
    scene_depths: np.ndarray
    optics: FieldVaryingPsf


class Example(NamedTuple):
    """A capture in electrons, the microscope as it is known, the voxels, and their light in the capture's unit."""

    image: Float32[np.ndarray, "row column"]
    imager: Imager
    grid: Grid
    truth: Volume


def example(seed: int, number: int, kind: Kind) -> Example:
    """A random scene by a random microscope, with a camera's noise.

    Drawn are the layout (random, Poisson-disc or hexagonal), the sensor's distance and how well the lenses and the
    sensor are where they should be, the depths and their step, the objects, the exposure (200 to 20,000 electrons in
    the brightest pixel), an offset and dead pixels. One example in sixteen shows nothing but noise. Objects lie between
    the volume's planes and beyond them, on voxels half as large.
    """
    rng = np.random.default_rng([seed, 2, number])
    device = device_of(seed, number // SCENES, kind)
    grid = in_float32(Grid.over(device.known.sensor, depths=device.depths, pitch=kind.pitch))
    fine = in_float32(Grid(device.scene_depths, tuple(2 * n for n in grid.shape), kind.pitch / 2))
    scene = np.zeros((SCENE_PLANES, *fine.shape), np.float32) if number % 16 == 15 else random_scene(fine.shape, rng)
    image = jnp.maximum(forward(scene, in_float32(device.imager), fine, device.optics), 0)
    counts, gain = _exposed(image, kind, rng)
    truth = 4 * gain * shared_out(scene, device.scene_depths, device.depths)
    return Example(counts, in_float32(device.known), grid, truth.astype(np.float32))


@lru_cache(maxsize=2)
def device_of(seed: int, number: int, kind: Kind) -> Device:
    """The microscope that images some of the examples."""
    rng = np.random.default_rng([seed, 1, number])
    centers = _layout(kind, rng)
    sensor = Sensor((kind.pixels, kind.pixels), kind.pixel)
    known = Imager(MicrolensArray(centers), sensor, rng.uniform(5.6, 6.0), FIELD_RADIUS)
    imager = Imager(
        MicrolensArray(centers + rng.normal(0, _LENSES_OFF, centers.shape)),
        sensor,
        float(known.sensor_distance) * (1 + rng.normal(0, _DISTANCE_OFF)),
        FIELD_RADIUS,
        rotation=rng.normal(0, _TURNED),
        shift=rng.normal(0, _SHIFTED, 2),
    )
    step = min(rng.uniform(0.15, 0.6), 5 / kind.planes)
    depths = rng.uniform(19, 21.5) + step * (np.arange(kind.planes) - kind.planes // 2)
    scene_depths = np.sort(rng.uniform(depths[0] - step, depths[-1] + step, SCENE_PLANES))
    return Device(imager, known, depths, scene_depths, tables(imager, scene_depths, kind))


def tables(imager: Imager, depths: np.ndarray, kind: Kind) -> FieldVaryingPsf:
    """All of a microscope's light; of any example of a kind of the same shape."""
    return in_float32(field_varying_psf(imager, depths, polar_grid=_nodes(kind)))


@cache
def _nodes(kind: Kind) -> PolarGrid:
    typical = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((kind.pixels, kind.pixels), kind.pixel), 5.8, FIELD_RADIUS)
    return make_polar_grid(typical, _DEPTHS, extent=2 * _FARTHEST * kind.side)


def _layout(kind, rng):
    """As many lenses for each example: their number decides shapes, and shapes compile."""
    side = kind.side * rng.uniform(1, 1.2)
    count, seed = round((1.1 * kind.side / LENS_SPACING) ** 2), int(rng.integers(2**31))
    name = rng.choice(["random", "random", "poisson", "hexagonal"])
    if name == "random":
        return np.asarray(random_layout(count, (side, side), diameter=None, seed=seed))
    # More than are needed, of which those nearest to the middle are taken.
    if name == "poisson":
        centers = np.asarray(poisson_disc_layout((2 * side, 2 * side), min_distance=1.15, seed=seed))
    else:
        centers = np.asarray(hexagonal_layout((2.5 * side, 2.5 * side), pitch=rng.uniform(1.35, 1.6)))
        turn = rng.uniform(0, np.pi)
        centers = centers @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return centers[np.argsort(np.abs(centers).max(1), kind="stable")[:count]]


def _exposed(image, kind, rng):
    """Electrons of a noisy exposure, and how many there are for a unit of the image."""
    largest, pixels = float(image.max()), kind.binning**2
    peak = pixels * 10 ** rng.uniform(2.3, 4.3)
    camera = Camera(gain=10.0 * pixels, read_noise=2.0 * kind.binning)
    if largest > 0:
        offset = float(rng.uniform(0, 0.2) * image.mean()) if rng.random() < 0.5 else 0.0
    else:
        image, offset, peak = image + 1, 0.0, 100.0 * pixels
    image = image + offset
    gain = peak / float(image.max())
    key = jax.random.key(int(rng.integers(2**31)))
    found = np.array(electrons(expose(image, camera, key, peak_electrons=peak), camera), np.float32)
    found[rng.random(found.shape) < _DEAD * rng.integers(0, 3)] = 0
    return found, gain
