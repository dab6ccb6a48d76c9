"""Scenes of the benchmark: a microscope of any size, images of particles whose truth is known, and the scores."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32
from skimage.feature import peak_local_max

from ..base.arrays import in_float32
from ..base.progress import Progress
from ..design.builtin import geomscope
from ..geometry import Imager, Sensor
from ..grid import Grid
from ..lenses import MicrolensArray
from ..metrics import localization, quality
from ..optics.apertures import clear_diameter
from ..optics.psf import geometric_psf
from ..optics.theory import FWHM
from ..simulation.synthetic import Camera, electrons, expose, simulate_points
from ..typing import Volume

WIDTH, DEPTH, PARTICLES, PEAK_ELECTRONS = 5.76, 20.0, 10, 10_000.0
# Emitters across a particle.
_ACROSS = 6
# A peak exceeds this part of the largest value: particles differ by a factor of 2.
_PEAK = 0.3


class Case(NamedTuple):
    """An image of known truth: particles `(x, y, z, intensity)`, and the same on the grid."""

    image: Float32[np.ndarray, "row column"]
    particles: Float[np.ndarray, "particle 4"]
    truth: Float32[np.ndarray, "1 y x"]


class Bench(NamedTuple):
    """The microscope at one size, and its lateral resolution as a standard deviation, mm: pixel / M by Eq. (5)."""

    imager: Imager
    grid: Grid
    psf: Float32[np.ndarray, "1 tall wide"]
    width: float


def bench(side: int) -> Bench:
    """The microscope with `side^2` pixels and voxels."""
    design = geomscope()
    lens, plate = design.imager(), WIDTH / 2 + 1.0
    centers = np.asarray(lens.centers)
    centers = centers[(np.abs(centers) < plate).all(axis=1)]
    pitch = WIDTH / side
    sensor = Sensor((side, side), pitch)
    imager = Imager(
        MicrolensArray(centers), sensor, lens.sensor_distance, lens.field_radius, wavelength=lens.wavelength
    )
    grid = Grid([DEPTH], (side, side), pitch)
    # The rays' blur is 0.1 mm and more: in pixels, and a pixel for what is beside it.
    size = 2 * math.ceil(0.1 / pitch) + 3
    psf = geometric_psf(imager, DEPTH, size=size, radius=clear_diameter(imager.array) / 2)
    width = pitch / float(lens.magnification(DEPTH)) / FWHM
    return Bench(in_float32(imager), in_float32(grid), np.asarray(psf, np.float32)[None], width)


def case(bench: Bench, seed: int, progress: Progress | None = None) -> Case:
    """Particles at random, as wide as the microscope resolves, and their image with noise."""
    _, grid, _, width = bench
    # In JAX's own precision, as the PSFs are computed.
    imager = jax.tree.map(lambda leaf: leaf.astype(float), bench.imager)
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.3 * WIDTH, 0.3 * WIDTH, (PARTICLES, 2))
    brightness = rng.uniform(0.5, 1, PARTICLES)
    particles = np.column_stack([place, np.full(PARTICLES, DEPTH), brightness])
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-2 * width, 2 * width, _ACROSS)]))
    weight = np.exp(-(x**2 + y**2) / (2 * width**2))
    offsets = np.column_stack([x, y, 0 * x, 0 * x])
    emitters = (particles[:, None] + offsets[None]) * np.stack([*3 * [np.ones_like(weight)], weight], axis=1)[None]
    # Diffraction is finer than a coarse pixel by far, and would take a huge pupil there.
    kind = "diffraction" if imager.sensor.pixel_pitch < 0.02 else "geometric"
    image = simulate_points(emitters.reshape(-1, 4), imager, kind=kind, progress=progress)
    camera = Camera(gain=1.0)
    counts = expose(jnp.asarray(image), camera, jax.random.key(seed), peak_electrons=PEAK_ELECTRONS)
    return Case(np.asarray(electrons(counts, camera)), particles, spots(particles, grid, width))


def spots(points: Float[np.ndarray, "point 4"], grid: Grid, width: float) -> Volume:
    """Points as Gaussians of standard deviation `width` in the nearest plane; their maximum is the intensity."""
    z = np.asarray(grid.depths)
    volume = np.zeros(grid.volume_shape, np.float32)
    for px, py, pz, intensity in points:
        across, along = (np.exp(-((np.asarray(a) - p) ** 2) / (2 * width**2)) for a, p in ((grid.x, px), (grid.y, py)))
        volume[np.abs(z - pz).argmin()] += (intensity * along[:, None] * across[None]).astype(np.float32)
    return volume


def peaks(volume: Float[Array | np.ndarray, "depth y x"], grid: Grid) -> Float[np.ndarray, "point 4"]:
    """Where a volume shows points, by one rule for every method, which does not know how many there are.

    Less each plane's median, the local maxima more than 2 voxels apart that exceed 0.3 of the largest value.
    """
    volume = np.asarray(volume, np.float32)
    volume = volume - np.median(volume, axis=(1, 2), keepdims=True)
    least = max(float(_PEAK * volume.max()), 0.0)
    found = peak_local_max(volume, min_distance=2, threshold_abs=least, exclude_border=False)
    return np.column_stack([grid.to_mm(found), volume[tuple(found.T)]])


def scores(volume: Float[Array | np.ndarray, "depth y x"], case: Case, bench: Bench) -> dict[str, Any]:
    """PSNR, SSIM and MSE, and F1 of the `peaks` within a particle's full width of a particle."""
    q = quality(volume, case.truth)
    f1 = localization(peaks(volume, bench.grid), case.particles, lateral=FWHM * bench.width).f1
    return {"psnr_db": q.psnr_db, "ssim": q.ssim, "mse": q.mse, "f1": f1}
