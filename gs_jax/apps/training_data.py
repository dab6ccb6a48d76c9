"""Training data: the paper's synthetic slices, and random scenes imaged with all of their light by random microscopes.

A scene has planes of objects of many kinds, sparse and dense, flat, inclined and curved. The same seed and number give
the same data. Host code, but for the optics.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float16, Float32
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from ..base.arrays import to_float32
from ..base.caches import digest_of
from ..base.progress import Progress
from ..base.typing import PathLike, Volume
from ..base.workers import Workers
from ..detection.unet import standardize
from ..io.files import atomic_write, decoding, make_folder
from ..microscope.geometry import Imager
from ..microscope.grid import Grid, Sensor
from ..microscope.layouts import hexagonal_layout, poisson_disc_layout, random_layout
from ..microscope.lenses import MicrolensArray
from ..optics.field_varying import FieldVaryingPsf, PolarGrid, field_varying_psf, make_polar_grid
from ..optics.psf_core import RINGS, core_distortion
from ..projection.backprojection import backproject
from ..projection.forward_model import forward
from ..simulation import Camera, electrons, expose

# Planes of a scene; scenes per microscope, whose tables take longer than an image.
SCENE_PLANES, SCENES = 6, 8
FIELD_RADIUS = 3.0
# Side of a lens's share of the plate, mm: sqrt(400 / 213) on the authors' plate.
LENS_SPACING = 1.37
# Depth range of all examples, mm: with common table nodes, programs are compiled once.
_DEPTHS = np.array([16.5, 24.5])
# Largest distance of a point from a lens, along x or y, in widths of the sensor.
_FARTHEST = 1.3
# Diameters of the lenses' apertures, mm: half of the microscopes have the paper's, the others narrower ones,
# log-uniform.
_APERTURE, _NARROWEST = 2.0, 0.5
# Standard deviations of what calibration leaves: lens positions, mm; sensor distance, relative; rotation, radians;
# shift, mm.
_LENS_ERROR, _DISTANCE_ERROR, _ROTATION_ERROR, _SHIFT_ERROR = 0.0015, 7e-4, 2e-4, 0.003
# Share of dead pixels; at most twice as many.
_DEAD = 1e-5
_TEXT = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"


class CaptureSpec(NamedTuple):
    """Size of a simulated capture, whose microscope has the paper's lenses on a smaller plate.

    `pixels` along a side and their size `pixel`, mm; `pitch` of the voxels, mm; number of `planes` of the volume;
    `binning`: sensor pixels along a side of a pixel.
    """

    pixels: int
    pixel: float
    pitch: float
    planes: int
    binning: int = 1

    @property
    def side(self) -> float:
        return self.pixels * self.pixel


class Example(NamedTuple):
    """A capture in electrons, the microscope as calibrated, the voxels, and their light in the capture's unit."""

    image: Float32[np.ndarray, "row column"]
    imager: Imager
    grid: Grid
    truth: Volume


def simulate_example(seed: int, number: int, spec: CaptureSpec) -> Example:
    """Simulate the capture of a random scene by a random microscope, with a camera's noise.

    Random are the layout (random, Poisson-disc or hexagonal), the sensor distance and the calibration's errors, the
    depths and their step, the objects, the exposure (200 to 20,000 electrons in the brightest pixel), an offset and
    dead pixels. One example in sixteen is an empty scene. Objects lie between the volume's planes and beyond them, on
    voxels half as large.
    """
    rng = np.random.default_rng([seed, 2, number])
    imager, calibrated, depths, scene_depths, optics = random_microscope(seed, number // SCENES, spec)
    grid = to_float32(Grid.over(calibrated.sensor, depths=depths, pitch=spec.pitch))
    fine = to_float32(Grid(scene_depths, tuple(2 * n for n in grid.shape), spec.pitch / 2))
    scene = np.zeros((SCENE_PLANES, *fine.shape), np.float32) if number % 16 == 15 else random_scene(fine.shape, rng)
    image = jnp.maximum(forward(scene, to_float32(imager), fine, optics), 0)
    counts, gain = _expose(image, spec, rng)
    truth = 4 * gain * resample_scene(scene, scene_depths, depths)
    return Example(counts, to_float32(calibrated), grid, truth.astype(np.float32))


@lru_cache(maxsize=2)
def random_microscope(
    seed: int, number: int, spec: CaptureSpec
) -> tuple[Imager, Imager, np.ndarray, np.ndarray, FieldVaryingPsf]:
    """The true imager and the calibrated one, the depths of its volumes and scenes, and its optics at the latter."""
    rng = np.random.default_rng([seed, 1, number])
    centers = _layout(spec, rng)
    aperture = _APERTURE * (_NARROWEST / _APERTURE) ** max(rng.uniform(-1, 1), 0)
    sensor = Sensor((spec.pixels, spec.pixels), spec.pixel)
    lenses = lambda centers: MicrolensArray(centers, aperture_diameter=aperture)
    calibrated = Imager(lenses(centers), sensor, rng.uniform(5.6, 6.0), FIELD_RADIUS)
    imager = Imager(
        lenses(centers + rng.normal(0, _LENS_ERROR, centers.shape)),
        sensor,
        float(calibrated.sensor_distance) * (1 + rng.normal(0, _DISTANCE_ERROR)),
        FIELD_RADIUS,
        rotation=rng.normal(0, _ROTATION_ERROR),
        shift=rng.normal(0, _SHIFT_ERROR, 2),
    )
    step = min(rng.uniform(0.15, 0.6), 5 / spec.planes)
    depths = rng.uniform(19, 21.5) + step * (np.arange(spec.planes) - spec.planes // 2)
    scene_depths = np.sort(rng.uniform(depths[0] - step, depths[-1] + step, SCENE_PLANES))
    return imager, calibrated, depths, scene_depths, trace_optics(imager, scene_depths, spec)


def trace_optics(imager: Imager, depths: np.ndarray, spec: CaptureSpec) -> FieldVaryingPsf:
    """All of the light of a microscope, in tables of one shape for all examples of a spec."""
    return to_float32(field_varying_psf(imager, depths, polar_grid=_nodes(spec), rings=RINGS))


@cache
def _nodes(spec: CaptureSpec) -> PolarGrid:
    typical = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((spec.pixels, spec.pixels), spec.pixel), 5.8, FIELD_RADIUS)
    return make_polar_grid(typical, _DEPTHS, extent=2 * _FARTHEST * spec.side)


def _layout(spec, rng):
    """Of the same number of lenses for every example: it decides shapes, which are compiled."""
    side = spec.side * rng.uniform(1, 1.2)
    count, seed = round((1.1 * spec.side / LENS_SPACING) ** 2), int(rng.integers(2**31))
    name = rng.choice(["random", "random", "poisson", "hexagonal"])
    if name == "random":
        return np.asarray(random_layout(count, (side, side), diameter=None, seed=seed))
    # More lenses than needed, of which those nearest to the middle are taken.
    if name == "poisson":
        centers = np.asarray(poisson_disc_layout((2 * side, 2 * side), min_distance=1.15, seed=seed))
    else:
        centers = np.asarray(hexagonal_layout((2.5 * side, 2.5 * side), pitch=rng.uniform(1.35, 1.6)))
        turn = rng.uniform(0, np.pi)
        centers = centers @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return centers[np.argsort(np.abs(centers).max(1), kind="stable")[:count]]


def _expose(image, spec, rng):
    """Electrons of a noisy exposure, and their number per unit of the image."""
    largest, pixels = float(image.max()), spec.binning**2
    peak = pixels * 10 ** rng.uniform(2.3, 4.3)
    camera = Camera(gain=10.0 * pixels, read_noise=2.0 * spec.binning)
    if largest > 0:
        offset = float(rng.uniform(0, 0.2) * image.mean()) if rng.random() < 0.5 else 0.0
    else:
        image, offset, peak = image + 1, 0.0, 100.0 * pixels
    image = image + offset
    gain = peak / float(image.max())
    key = jax.random.key(int(rng.integers(2**31)))
    counts = np.array(electrons(expose(image, camera, key, peak_electrons=peak), camera), np.float32)
    counts[rng.random(counts.shape) < _DEAD * rng.integers(0, 3)] = 0
    return counts, gain


def random_scene(shape: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """Objects in some of the planes, or on a sheet across all: sparse or dense, of one kind or of all.

    A sheet is inclined or curved. Some scenes have a texture, and some a smooth background in all planes, like tissue.
    """
    kinds = tuple(_DRAW) if rng.random() < 0.4 else (str(rng.choice(list(_DRAW))),)
    few = {"point": 300, "disc": 150}.get(kinds[0], 30) if len(kinds) == 1 else 60
    total = math.ceil(few ** rng.uniform(0.3, 1))
    if rng.random() < 0.25:
        scene = lay_on_sheet(draw_objects(shape[0], rng, total, kinds), rng)
    else:
        used = rng.choice(SCENE_PLANES, rng.integers(1, SCENE_PLANES + 1), replace=False)
        counts = np.bincount(rng.choice(used, total), minlength=SCENE_PLANES)
        scene = np.stack([draw_objects(shape[0], rng, int(count), kinds) for count in counts])
    if rng.random() < 0.15:
        scene = scene * _smooth_noise(scene.shape, shape[0] * 10 ** rng.uniform(-2, -1.3), rng)
    if rng.random() < 0.2:
        tissue = _smooth_noise(scene.shape, shape[0] * 10 ** rng.uniform(-1.3, -0.7), rng)
        scene = scene + scene.max() * 10 ** rng.uniform(-2.5, -1) * tissue
    return scene.astype(np.float32)


def lay_on_sheet(page: Float32[np.ndarray, "y x"], rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """Lay a page across the planes, flat or curved; each part is in the two nearest planes."""
    turn, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * (rng.random() < 0.5)
    axis = np.linspace(-1, 1, len(page), dtype=np.float32)
    along = (np.cos(turn) * axis + np.sin(turn) * axis[:, None]) / (abs(np.cos(turn)) + abs(np.sin(turn)))
    height = (1 - bend) * (along + 1) / 2 + bend * along**2
    plane = height * (SCENE_PLANES - 1)
    return np.stack([page * np.maximum(1 - abs(plane - i), 0) for i in range(SCENE_PLANES)]).astype(np.float32)


def resample_scene(scene: Float32[np.ndarray, "plane y2 x2"], plane_depths: np.ndarray, depths: np.ndarray) -> Volume:
    """A scene on the volume's voxels, twice as wide: means of 2 x 2, and linear weights along z."""
    planes, rows, columns = scene.shape
    coarse = scene.reshape(planes, rows // 2, 2, columns // 2, 2).mean((2, 4))
    step = depths[1] - depths[0]
    weights = np.maximum(1 - np.abs(depths[:, None] - plane_depths[None]) / step, 0).astype(np.float32)
    return np.tensordot(weights, coarse, 1)


def _smooth_noise(shape, size, rng):
    """Positive noise with the mean 1 and a correlation length of `size` voxels."""
    noise = gaussian_filter(rng.standard_normal(shape, np.float32), (0.7, size, size))
    return np.exp(noise / max(float(noise.std()), 1e-6) * 0.7 - 0.245)


def draw_objects(size: int, rng: np.random.Generator, count: int, kinds: tuple[str, ...]) -> Float32[np.ndarray, "y x"]:
    """A square plane with `count` objects of random intensity, drawn over each other."""
    page = Image.new("F", (size, size))
    for _ in range(count):
        draw, brightness = _DRAW[str(rng.choice(kinds))], float(rng.uniform(0.2, 1))
        middle = rng.uniform(0, size, 2)
        # Radii are log-uniform.
        radius = size * 10 ** rng.uniform(-1.5, -0.5)
        draw(ImageDraw.Draw(page), middle, radius, brightness, rng)
    return np.asarray(page)


def _polygon(page, middle, radius, brightness, rng):
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 9)))
    corners = middle + (radius * rng.uniform(0.4, 1, len(angles)) * np.stack([np.cos(angles), np.sin(angles)])).T
    page.polygon(list(corners.ravel()), fill=brightness)


def _lines(page, middle, radius, brightness, rng):
    corners = middle + rng.uniform(-1, 1, (rng.integers(2, 5), 2)) * max(radius, 8)
    page.line(list(corners.ravel()), fill=brightness, width=int(rng.integers(1, 2 + max(2, radius / 4))))


def _bars(page, middle, radius, brightness, rng):
    """Three parallel bars as far apart as wide, upright or not."""
    width, turned = max(radius / 5, 1), rng.random() < 0.5
    for i in (-2, 0, 2):
        corners = width * np.array([[i - 0.5, -2.5], [i + 0.5, 2.5]])
        page.rectangle(list((middle + (corners[:, ::-1] if turned else corners)).ravel()), fill=brightness)


def _snowflake(page, middle, radius, brightness, rng):
    """Six arms with a pair of branches each."""
    turn, width = rng.uniform(0, np.pi / 3), max(1, int(radius * rng.uniform(0.04, 0.12)))
    for angle in turn + np.pi / 3 * np.arange(6):
        at = lambda length, angle=angle: length * radius * np.array([np.cos(angle), np.sin(angle)])
        tip, fork = middle + at(1.0), middle + at(0.55)
        page.line([*middle, *tip], fill=brightness, width=width)
        for side in (angle - np.pi / 3, angle + np.pi / 3):
            page.line([*fork, *(fork + at(0.35, side))], fill=brightness, width=width)


def _letters(page, middle, radius, brightness, rng):
    text = "".join(rng.choice(list(_TEXT), rng.integers(1, 4)))
    font = ImageFont.load_default(size=max(2 * radius, 8))
    page.text(tuple(middle - radius), text, fill=brightness, font=font)


def _disc(page, middle, radius, brightness, rng):
    half = np.full(2, max(radius / 8, 0.7))
    page.ellipse([*(middle - half), *(middle + half)], fill=brightness)


def _point(page, middle, radius, brightness, rng):
    # A single voxel has little light beside an area: brighter, to be seen in the same scene.
    page.point(list(middle), fill=brightness * 10 ** float(rng.uniform(0, 0.7)))


_DRAW = {
    "polygon": _polygon,
    "lines": _lines,
    "bars": _bars,
    "snowflake": _snowflake,
    "letters": _letters,
    "disc": _disc,
    "point": _point,
}


# The paper's training sets: slices, and per slice of distance the blur (voxels) and the factor of others' light; noise.
# The ten and the 5 % are the paper's; the rest is ours, as its supplement is not available.
SLICES, BLUR, FADE, NOISE = 10, 2.0, 0.6, 0.05
PLANES = 17
_PIXELS = ((0.0045, 0.02), (0.00675, 0.03), (0.009, 0.04))
SPECS = tuple(CaptureSpec(1280, pixel, pitch, PLANES) for pixel, pitch in _PIXELS)
# Standard deviation of the truth's blur, voxels: as sharp as they can show.
TRUTH_BLUR = 1.0
# Squared errors are relative to a patch's energy, plus this share of its ghosts', plus a constant.
_GHOSTS, _MIN_ENERGY = 0.05, 1e-3


class Stack(NamedTuple):
    """A back-projected volume and the network's target, in the same unit."""

    volume: Float16[np.ndarray, "depth y x"]
    truth: Float16[np.ndarray, "depth y x"]


class Batch(NamedTuple):
    """Slices with their neighbours, the network's targets, and weights."""

    slices: Float32[np.ndarray, "batch channel y x"]
    truth: Float32[np.ndarray, "batch y x"]
    weight: Float32[np.ndarray, " batch"]


def sample_paper_batch(rng: np.random.Generator, size: int = 64) -> Batch:
    """One of the paper's sets: ten slices of polygons, each with the others on top, blurred and weaker, and noise.

    Materials and Methods, "Background suppression through a convolutional neural network". The set is divided by its
    largest value.
    """
    sharp = np.stack([draw_objects(size, rng, int(rng.integers(0, 4)), ("polygon",)) for _ in range(SLICES)])
    blurred = np.zeros_like(sharp)
    for distance in range(1, SLICES):
        faint = FADE**distance * gaussian_filter(sharp, (0, BLUR * distance, BLUR * distance))
        blurred[distance:] += faint[:-distance]
        blurred[:-distance] += faint[distance:]
    mixed = sharp + blurred
    largest = max(mixed.max(), 1e-6)
    noisy = mixed / largest + NOISE * rng.standard_normal(mixed.shape, np.float32)
    return Batch(noisy[:, None].astype(np.float32), sharp / largest, np.ones(SLICES, np.float32))


def simulate_groups(
    make: Callable[[], Callable[[list[int]], Any]],
    numbers: Sequence[int],
    progress: Progress | None,
    workers: Workers | None,
) -> Iterator[Any]:
    """Results of the function that `make` returns, called with the numbers of the examples of each microscope.

    Workers call it, if there are any; results come as they are done.
    """
    groups = [[n for n in numbers if n // SCENES == group] for group in sorted({n // SCENES for n in numbers})]
    with (progress or Progress()).counter("Simulating captures", len(groups)) as advance:
        for _, result in (workers or Workers()).mapper(make)(groups):
            yield result()
            advance()


def simulate_stack(seed: int, number: int, specs: Sequence[CaptureSpec] = SPECS) -> Stack:
    """Simulate an example of one of the specs, in turn, and back-project it where the bright cores of spots are.

    The unit is that of `unet.standardize`. The truth is the scene on the volume's voxels, blurred by `TRUTH_BLUR`,
    times the slope of the volume's voxels against it: what is in focus keeps its brightness.
    """
    image, imager, grid, truth = simulate_example(seed, number, specs[number // SCENES % len(specs)])
    distortion = core_distortion(imager, grid.depths)
    volume, unit = standardize(np.asarray(backproject(image, imager, grid, distortion=distortion)))
    truth = gaussian_filter(truth, (0, TRUTH_BLUR, TRUTH_BLUR))
    # In a unit of its own: a capture's is beyond half precision.
    truth = truth / max(float(truth.max()), 1e-30)
    variance = float(truth.var())
    slope = float(np.mean((truth - truth.mean()) * volume)) / variance if variance > 0 else 0.0
    return Stack((volume / unit).astype(np.float16), (max(slope, 0.0) / unit * truth).astype(np.float16))


def simulate_stacks(
    folder: PathLike,
    count: int,
    seed: int,
    progress: Progress | None = None,
    *,
    specs: Sequence[CaptureSpec] = SPECS,
    workers: Workers | None = None,
) -> list[Stack]:
    """Read the first `count` stacks of a seed from `folder`; workers simulate and write those that are missing.

    Stacks of other specs, or that another version of the package simulated, are not read.

    Raises
    ------
    InputError
        If the folder cannot be made, or a file in it is no stack.
    """
    folder = make_folder(folder)
    paths = [_path(folder, seed, number, specs) for number in range(count)]
    missing = [number for number, path in enumerate(paths) if not path.exists()]
    for _ in simulate_groups(partial(_writer, paths, seed, specs), missing, progress, workers):
        pass
    return list(map(_read, paths))


def _path(folder: Path, seed: int, number: int, specs: Sequence[CaptureSpec]) -> Path:
    """Path of a stack, whose name has a digest of all that it depends on: another one is not read in its place."""
    key = seed, number, specs[number // SCENES % len(specs)], TRUTH_BLUR, jax.config.jax_enable_x64  # pyright: ignore
    return folder / f"{seed}-{number}-{digest_of([repr(key).encode()])[:12]}.npz"


def _writer(paths: Sequence[Path], seed: int, specs: Sequence[CaptureSpec]):
    def write(numbers: list[int]) -> None:
        for number in numbers:
            stack = simulate_stack(seed, number, specs)
            with atomic_write(paths[number]) as temporary:
                np.savez(temporary, allow_pickle=False, volume=stack.volume, truth=stack.truth)

    return write


def _read(path: Path) -> Stack:
    with decoding(path, "stack (.npz)"), np.load(path, allow_pickle=False) as arrays:
        return Stack(arrays["volume"], arrays["truth"])


def sample_patches(
    stacks: list[Stack], offsets: tuple[int, ...], rng: np.random.Generator, *, size: int = 96, count: int = 8
) -> Batch:
    """Random patches of stacks, transposed and mirrored; three in four are the brightest of eight.

    Errors are weighted relative to the energy of a patch's truth, so that dim objects count as bright ones do; where it
    is empty, to a part of the ghosts in it.
    """
    pieces = [_patch(stacks[rng.integers(len(stacks))], offsets, rng, size, bool(i % 4)) for i in range(count)]
    slices, truth = (np.stack(part) for part in zip(*pieces, strict=True))
    energy = np.mean(truth**2, (1, 2)) + _GHOSTS * np.mean(slices**2, (1, 2, 3)) + _MIN_ENERGY
    return Batch(slices, truth, (1 / energy).astype(np.float32))


def _patch(stack: Stack, offsets, rng, size, bright: bool):
    limits = [n - size + 1 for n in stack.volume.shape[1:]]
    corners = rng.integers(0, [PLANES, *limits], (8, 3)) % [len(stack.volume), *limits]
    places = [(d, slice(r, r + size), slice(c, c + size)) for d, r, c in corners]
    place = max(places, key=lambda place: stack.truth[place].max()) if bright else places[0]
    depths = np.clip(place[0] + np.array(offsets), 0, len(stack.volume) - 1)
    slices = stack.volume[depths][:, *place[1:]].astype(np.float32)
    truth = stack.truth[place].astype(np.float32)
    if rng.random() < 0.5:
        slices, truth = slices.swapaxes(1, 2), truth.T
    flips = slice(None, None, rng.choice([1, -1])), slice(None, None, rng.choice([1, -1]))
    return slices[:, *flips], truth[flips]
