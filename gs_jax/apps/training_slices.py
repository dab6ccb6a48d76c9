"""Training data of the networks of `unet`: the paper's synthetic slices, and back-projected simulated captures.

The same seed and number give the same data.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float16, Float32
from scipy.ndimage import gaussian_filter

from ..base.caches import digest_of
from ..base.progress import Progress
from ..base.workers import Workers
from ..detection.unet import standardize
from ..io.files import atomic_write, decoding, make_folder
from ..optics.psf_core import core_distortion
from ..projection.backprojection import backproject
from ..typing import PathLike
from .training_data import SCENES, CaptureSpec, draw_objects, simulate_example

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
    # One worker makes what one microscope images.
    groups = [[n for n in missing if n // SCENES == group] for group in sorted({n // SCENES for n in missing})]
    stream = (workers or Workers()).mapper(partial(_writer, paths, seed, specs))
    with (progress or Progress()).counter("Simulating captures", len(groups)) as advance:
        for _, result in stream(groups):
            result()
            advance()
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
