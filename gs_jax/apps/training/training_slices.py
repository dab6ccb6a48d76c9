"""What the networks of `unet` are trained on: the paper's synthetic slices, and simulated captures, back-projected.

Everything is a function of a seed and a number: the same arguments give the same data.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float16, Float32
from scipy.ndimage import gaussian_filter

from ...base.progress import Progress
from ...base.workers import Workers
from ...detection.unet import standardize
from ...io.files import atomic_write, decoding, make_folder
from ...optics.psf_core import apparent_depths
from ...projection.backprojection import backproject
from ...typing import PathLike
from .random_scenes import drawn
from .simulated_captures import SCENES, Kind, example

# The paper's training: slices in a set, how the others blur (voxels a slice) and count (factor a slice), and the noise.
# It gives the ten and the 5 %; the rest is in a supplement that is not available, and ours.
SLICES, BLUR, FADE, NOISE = 10, 2.0, 0.6, 0.05

PLANES = 17
KINDS = tuple(Kind(1280, pixel, pitch, PLANES) for pixel, pitch in ((0.0045, 0.02), (0.00675, 0.03), (0.009, 0.04)))
# The truth is as sharp as the voxels can show, standard deviation in voxels.
TRUTH_BLUR = 1.0
# Parts of a piece's own energy, and of a standard deviation's, that its errors are relative to at least.
_GHOSTS, _LEAST_ENERGY = 0.05, 1e-3


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
    sharp = np.stack([drawn(size, rng, int(rng.integers(0, 4)), ("polygon",)) for _ in range(SLICES)])
    blurred = np.zeros_like(sharp)
    for distance in range(1, SLICES):
        faint = FADE**distance * gaussian_filter(sharp, (0, BLUR * distance, BLUR * distance))
        blurred[distance:] += faint[:-distance]
        blurred[:-distance] += faint[distance:]
    mixed = sharp + blurred
    largest = max(mixed.max(), 1e-6)
    noisy = mixed / largest + NOISE * rng.standard_normal(mixed.shape, np.float32)
    return Batch(noisy[:, None].astype(np.float32), sharp / largest, np.ones(SLICES, np.float32))


def simulated_stack(seed: int, number: int, kinds: Sequence[Kind] = KINDS) -> Stack:
    """An example of `gs_jax.apps.training.simulated_captures`, back-projected where the bright cores are.

    Parameters
    ----------
    seed, number
        Which stack it is.
    kinds
        Of the examples, in turn.

    Returns
    -------
    Stack
        In the unit of `unet.standardize`. The truth is the scene, shared out to the nearest planes and blurred
        by `TRUTH_BLUR`, times the slope of the volume's voxels by it: what is in focus keeps its brightness.
    """
    image, imager, grid, truth = example(seed, number, kinds[number // SCENES % len(kinds)])
    seen = grid.at(jnp.asarray(apparent_depths(imager, grid.depths), grid.depths.dtype))
    volume, unit = standardize(np.asarray(backproject(image, imager, seen)))
    truth = gaussian_filter(truth, (0, TRUTH_BLUR, TRUTH_BLUR))
    # In a unit of its own: a capture's is far from what half precision holds.
    truth = truth / max(float(truth.max()), 1e-30)
    spread = float(truth.var())
    slope = float(np.mean((truth - truth.mean()) * volume)) / spread if spread > 0 else 0.0
    return Stack((volume / unit).astype(np.float16), (max(slope, 0.0) / unit * truth).astype(np.float16))


def stacks(
    folder: PathLike,
    count: int,
    seed: int,
    progress: Progress | None = None,
    *,
    kinds: Sequence[Kind] = KINDS,
    workers: Workers | None = None,
) -> list[Stack]:
    """The first `count` simulated stacks of a seed, from `folder`, or made and kept there, by workers if there are any.

    Raises
    ------
    InputError
        If the folder cannot be made, or a file in it is no stack.
    """
    folder = make_folder(folder)
    missing = [number for number in range(count) if not _path(folder, seed, number).exists()]
    # What one microscope images is made by one worker.
    groups = [[n for n in missing if n // SCENES == group] for group in sorted({n // SCENES for n in missing})]
    stream = (workers or Workers()).stream_of(partial(_keeper, folder, seed, kinds))
    with (progress or Progress()).counter("Simulating captures", len(groups)) as advance:
        for _, result in stream(groups):
            result()
            advance()
    return [_read(_path(folder, seed, number)) for number in range(count)]


def _path(folder: Path, seed: int, number: int) -> Path:
    return folder / f"{seed}-{number}.npz"


def _keeper(folder: Path, seed: int, kinds: Sequence[Kind]):
    def keep(numbers: list[int]) -> None:
        for number in numbers:
            stack = simulated_stack(seed, number, kinds)
            with atomic_write(_path(folder, seed, number)) as temporary:
                np.savez(temporary, allow_pickle=False, volume=stack.volume, truth=stack.truth)

    return keep


def _read(path: Path) -> Stack:
    with decoding(path, "stack (.npz)"), np.load(path, allow_pickle=False) as arrays:
        return Stack(arrays["volume"], arrays["truth"])


def patches(
    stacks: list[Stack], offsets: tuple[int, ...], rng: np.random.Generator, *, size: int = 96, count: int = 8
) -> Batch:
    """Random pieces of stacks, turned and mirrored; three in four are chosen for showing something.

    Stacks are in the network's unit (`unet.standardize`). Errors count relative to what a piece shows, so that dim
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
