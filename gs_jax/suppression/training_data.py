"""What the networks of `unet` are trained on: the paper's synthetic slices, and simulated captures, back-projected.

Everything is a function of a seed and a number: the same arguments give the same data. Host code, but for the optics.
"""

import math
import os
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Float32
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from ..base.precision import in_float32
from ..base.progress import Progress
from ..geometry import Grid, Imager, MicrolensArray, Sensor
from ..io.disk import atomic_write, decoding, make_folder
from ..layouts.patterns import random_layout
from ..optics.aperture import clear_diameter
from ..optics.psf import geometric_psf
from ..projection.backprojection import backproject
from ..projection.forward_model import forward
from ..simulation.camera import Camera, electrons, expose
from .unet import standardized

# The paper's training: slices in a set, how the others blur (voxels a slice) and count (factor a slice), and the noise.
# It gives the ten and the 5 %; the rest is in a supplement that is not available, and ours.
SLICES, BLUR, FADE, NOISE = 10, 2.0, 0.6, 0.05

# Ours: pixels and voxels (mm) that designs are drawn from, one volume each of `PLANES` planes. A smaller microscope
# than the paper's, of the same lenses: what a voxel sees is the same.
SIZES = ((0.0045, 0.02), (0.00675, 0.03), (0.009, 0.04))
PIXELS, PLANES, SCENE_PLANES = 1280, 17, 6
# Lenses image beyond the radius that back-projection takes (mm): the light that it does not account for.
FIELD_RADIUS, LIT_RADIUS = 3.0, 4.5
# Side of the square that a lens has to itself, mm: sqrt(400 / 213) on the authors' plate.
LENS_SPACING = 1.37
# The truth is as sharp as the voxels can show, standard deviation in voxels.
TRUTH_BLUR = 1.0
# Parts of a piece's own energy, and of a standard deviation's, that its errors are relative to at least.
_GHOSTS, _LEAST_ENERGY = 0.05, 1e-3
# Half the window of the PSF, pixels.
_REACH = 64
_TEXT = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"


class Stack(NamedTuple):
    """A back-projected volume and what it should show, in its units."""

    volume: Float16[np.ndarray, "depth y x"]
    truth: Float16[np.ndarray, "depth y x"]


class Batch(NamedTuple):
    """Some slices, or neighbourhoods of slices, what the network should make of them, and how much each counts."""

    slices: Float32[np.ndarray, "batch channel y x"]
    truth: Float32[np.ndarray, "batch y x"]
    weight: Float32[np.ndarray, " batch"]


def paper_batch(rng: np.random.Generator, size: int = 64) -> Batch:
    """One set of the paper's: ten slices of polygons, each with the others' on top, blurred and weaker, and noise.

    Materials and Methods, "Background suppression through a convolutional neural network". The set is divided by its
    largest value.
    """
    sharp = np.stack([_drawn(size, rng, int(rng.integers(0, 4)), ("polygon",)) for _ in range(SLICES)])
    blurred = np.zeros_like(sharp)
    for distance in range(1, SLICES):
        faint = FADE**distance * gaussian_filter(sharp, (0, BLUR * distance, BLUR * distance))
        blurred[distance:] += faint[:-distance]
        blurred[:-distance] += faint[distance:]
    mixed = sharp + blurred
    largest = max(mixed.max(), 1e-6)
    noisy = mixed / largest + NOISE * rng.standard_normal(mixed.shape, np.float32)
    return Batch(noisy[:, None].astype(np.float32), sharp / largest, np.ones(SLICES, np.float32))


def simulated_stack(seed: int, number: int) -> Stack:
    """A random scene, imaged by a random microscope with its PSF and a camera's noise, and back-projected.

    Drawn are the lenses, the sensor's distance, the depths and their step, the objects, the exposure and a pedestal.
    One stack in sixteen shows nothing but noise. Rays make the PSF; diffraction is finer than these pixels. Objects
    lie at depths between the volume's planes and beyond them, on voxels half as large.

    Parameters
    ----------
    seed, number
        Which stack it is.

    Returns
    -------
    Stack
        In the unit of `unet.standardized`. The truth is the scene, shared out to the nearest planes and blurred
        by `TRUTH_BLUR`, times the slope of the volume's voxels by it: what is in focus keeps its brightness.
    """
    rng = np.random.default_rng([seed, number])
    pixel, pitch = SIZES[number % len(SIZES)]
    imager, lit = _microscope(rng, pixel)
    depths = rng.uniform(18.5, 22.5) + rng.uniform(0.15, 0.6) * (np.arange(PLANES) - PLANES // 2)
    grid = in_float32(Grid.over(imager.sensor, depths=depths, pitch=pitch))
    beyond = 2 * (depths[1] - depths[0])
    between = np.sort(rng.uniform(depths[0] - beyond, depths[-1] + beyond, SCENE_PLANES))
    fine = in_float32(Grid(between, (2 * grid.shape[0], 2 * grid.shape[1]), pitch / 2))
    scene = np.zeros((SCENE_PLANES, *fine.shape), np.float32) if number % 16 == 15 else _scene(fine.shape, rng)
    image = _capture(scene, lit, fine, rng)
    volume, unit = standardized(np.asarray(backproject(image, imager, grid)))
    truth = gaussian_filter(_shared_out(scene, np.asarray(fine.depths), depths), (0, TRUTH_BLUR, TRUTH_BLUR))
    spread = float(truth.var())
    slope = float(np.mean((truth - truth.mean()) * volume)) / spread if spread > 0 else 0.0
    return Stack((volume / unit).astype(np.float16), (max(slope, 0.0) / unit * truth).astype(np.float16))


def stacks(folder: str | os.PathLike[str], count: int, seed: int, progress: Progress | None = None) -> list[Stack]:
    """The first `count` simulated stacks of a seed, from `folder`, or made and kept there.

    Raises
    ------
    InputError
        If the folder cannot be made, or a file in it is no stack.
    """
    folder = make_folder(folder)
    return [
        _kept(folder / f"{seed}-{i}.npz", seed, i)
        for i in (progress or Progress()).track(range(count), "Simulating captures")
    ]


def _kept(path: Path, seed: int, number: int) -> Stack:
    if path.exists():
        with decoding(path, "stack (.npz)"), np.load(path, allow_pickle=False) as arrays:
            return Stack(arrays["volume"], arrays["truth"])
    stack = simulated_stack(seed, number)
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, volume=stack.volume, truth=stack.truth)
    return stack


def patches(
    stacks: list[Stack], offsets: tuple[int, ...], rng: np.random.Generator, *, size: int = 96, count: int = 8
) -> Batch:
    """Random pieces of stacks, turned and mirrored; three in four are chosen for showing something.

    Stacks are in the network's unit (`unet.standardized`). Errors count relative to what a piece shows, so that dim
    objects count as bright ones do; where it shows nothing, to a part of the ghosts in it.
    """
    pieces = [_patch(stacks[rng.integers(len(stacks))], offsets, rng, size, bool(i % 4)) for i in range(count)]
    slices, truth = (np.stack(part) for part in zip(*pieces, strict=True))
    energy = np.mean(truth**2, (1, 2)) + _GHOSTS * np.mean(slices**2, (1, 2, 3)) + _LEAST_ENERGY
    return Batch(slices, truth, (1 / energy).astype(np.float32))


def _patch(stack: Stack, offsets, rng, size, interesting: bool):
    """The brightest truth of eight places if it is to be interesting, else the first."""
    limits = [n - size + 1 for n in stack.volume.shape[1:]]
    places = rng.integers(0, [PLANES, *limits], (8, 3))
    places = [(d, slice(r, r + size), slice(c, c + size)) for d, r, c in places % [len(stack.volume), *limits]]
    place = max(places, key=lambda place: stack.truth[place].max()) if interesting else places[0]
    depths = np.clip(place[0] + np.array(offsets), 0, len(stack.volume) - 1)
    slices = stack.volume[depths][:, *place[1:]].astype(np.float32)
    truth = stack.truth[place].astype(np.float32)
    if rng.random() < 0.5:
        slices, truth = slices.swapaxes(1, 2), truth.T
    flips = slice(None, None, rng.choice([1, -1])), slice(None, None, rng.choice([1, -1]))
    return slices[:, *flips], truth[flips]


def _microscope(rng: np.random.Generator, pixel: float) -> tuple[Imager, Imager]:
    """What is reconstructed with, and the same with all the light that its lenses let through."""
    side = PIXELS * pixel
    # As many lenses at each size, on a plate more or less large: their number decides shapes, and shapes compile.
    count = round((side / LENS_SPACING) ** 2)
    plate = side * rng.uniform(0.9, 1.1)
    centers = random_layout(count, (plate, plate), diameter=None, seed=int(rng.integers(2**31)))
    distance = rng.uniform(5.6, 6.0)
    make = lambda radius: Imager(MicrolensArray(centers), Sensor((PIXELS, PIXELS), pixel), distance, radius)
    return in_float32(make(FIELD_RADIUS)), in_float32(make(LIT_RADIUS))


def _capture(scene: np.ndarray, imager: Imager, grid: Grid, rng: np.random.Generator) -> Float[Array, "row column"]:
    """Electrons of a noisy exposure, on a pedestal half of the time."""
    psfs = jax.vmap(lambda depth: _psf(imager, depth))(grid.depths)
    image = jnp.maximum(forward(scene, imager, grid, psfs), 0)
    largest = float(image.max())
    pedestal = float(rng.uniform(0, 0.2) * image.mean()) if largest > 0 else float(rng.uniform(0, 1))
    key = jax.random.key(int(rng.integers(2**31)))
    peak = 10 ** rng.uniform(2.3, 4.3) if largest > 0 else 100.0
    if rng.random() < 0.5 or largest == 0:
        image = image + pedestal
    return electrons(expose(image, Camera(), key, peak_electrons=peak), Camera())


def _psf(imager: Imager, depth):
    radius = clear_diameter(imager.array) / 2
    return geometric_psf(imager, depth, size=2 * _REACH + 1, radius=radius)


def _shared_out(scene: np.ndarray, at: np.ndarray, depths: np.ndarray) -> Float32[np.ndarray, "depth y x"]:
    """A scene on voxels half as large, on the volume's: means of 2 x 2, and linear weights along z."""
    planes, rows, columns = scene.shape
    coarse = scene.reshape(planes, rows // 2, 2, columns // 2, 2).mean((2, 4))
    step = depths[1] - depths[0]
    weights = np.maximum(1 - np.abs(depths[:, None] - at[None]) / step, 0).astype(np.float32)
    return np.tensordot(weights, coarse, 1)


def _scene(shape: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """Objects in some of the planes, or in a sheet across all: sparse or dense, of one kind or of all."""
    kinds = tuple(_DRAW) if rng.random() < 0.4 else (str(rng.choice(list(_DRAW))),)
    few = {"point": 300, "disc": 150}.get(kinds[0], 30) if len(kinds) == 1 else 60
    total = math.ceil(few ** rng.uniform(0.3, 1))
    if rng.random() < 0.25:
        return _inclined(_drawn(shape[0], rng, total, kinds), rng)
    used = rng.choice(SCENE_PLANES, rng.integers(1, SCENE_PLANES + 1), replace=False)
    counts = np.bincount(rng.choice(used, total), minlength=SCENE_PLANES)
    return np.stack([_drawn(shape[0], rng, int(count), kinds) for count in counts])


def _inclined(page: np.ndarray, rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """A page that crosses the planes, one after the other, in some direction; its parts are in the two nearest."""
    turn = rng.uniform(0, 2 * np.pi)
    place = np.linspace(-1, 1, len(page), dtype=np.float32)
    along = (np.cos(turn) * place + np.sin(turn) * place[:, None]) / (abs(np.cos(turn)) + abs(np.sin(turn)))
    plane = (along + 1) / 2 * (SCENE_PLANES - 1)
    return np.stack([page * np.maximum(1 - abs(plane - i), 0) for i in range(SCENE_PLANES)]).astype(np.float32)


def _drawn(size: int, rng: np.random.Generator, count: int, kinds: tuple[str, ...]) -> Float32[np.ndarray, "y x"]:
    """A square plane with `count` objects of random intensity, drawn over each other."""
    page = Image.new("F", (size, size))
    for _ in range(count):
        draw, brightness = _DRAW[str(rng.choice(kinds))], float(rng.uniform(0.2, 1))
        middle = rng.uniform(0, size, 2)
        # As many small objects as large ones, by ratio.
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
    # A single fine voxel holds little light beside an area: brighter, to be seen in the same scene.
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
