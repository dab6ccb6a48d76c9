"""Random scenes to train on: planes of objects of many kinds, sparse and dense, flat, inclined and curved."""

import math

import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from ...typing import Volume

# Planes of a scene.
PLANES = 6
_TEXT = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"


def random_scene(shape: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """Objects in some of the planes, or on a sheet across all: sparse or dense, of one kind or of all.

    A sheet is inclined or curved. Some scenes have a texture, and some a smooth background in all planes, as tissue.
    """
    kinds = tuple(_DRAW) if rng.random() < 0.4 else (str(rng.choice(list(_DRAW))),)
    few = {"point": 300, "disc": 150}.get(kinds[0], 30) if len(kinds) == 1 else 60
    total = math.ceil(few ** rng.uniform(0.3, 1))
    if rng.random() < 0.25:
        scene = on_sheet(drawn(shape[0], rng, total, kinds), rng)
    else:
        used = rng.choice(PLANES, rng.integers(1, PLANES + 1), replace=False)
        counts = np.bincount(rng.choice(used, total), minlength=PLANES)
        scene = np.stack([drawn(shape[0], rng, int(count), kinds) for count in counts])
    if rng.random() < 0.15:
        scene = scene * _smooth(scene.shape, shape[0] * 10 ** rng.uniform(-2, -1.3), rng)
    if rng.random() < 0.2:
        tissue = _smooth(scene.shape, shape[0] * 10 ** rng.uniform(-1.3, -0.7), rng)
        scene = scene + scene.max() * 10 ** rng.uniform(-2.5, -1) * tissue
    return scene.astype(np.float32)


def on_sheet(page: Float32[np.ndarray, "y x"], rng: np.random.Generator) -> Float32[np.ndarray, "plane y x"]:
    """A page that crosses the planes, straight or curved, in some direction; its parts are in the two nearest."""
    turn, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * (rng.random() < 0.5)
    place = np.linspace(-1, 1, len(page), dtype=np.float32)
    along = (np.cos(turn) * place + np.sin(turn) * place[:, None]) / (abs(np.cos(turn)) + abs(np.sin(turn)))
    height = (1 - bend) * (along + 1) / 2 + bend * along**2
    plane = height * (PLANES - 1)
    return np.stack([page * np.maximum(1 - abs(plane - i), 0) for i in range(PLANES)]).astype(np.float32)


def shared_out(scene: Float32[np.ndarray, "plane y2 x2"], at: np.ndarray, depths: np.ndarray) -> Volume:
    """A scene on voxels half as large, on the volume's: means of 2 x 2, and linear weights along z."""
    planes, rows, columns = scene.shape
    coarse = scene.reshape(planes, rows // 2, 2, columns // 2, 2).mean((2, 4))
    step = depths[1] - depths[0]
    weights = np.maximum(1 - np.abs(depths[:, None] - at[None]) / step, 0).astype(np.float32)
    return np.tensordot(weights, coarse, 1)


def _smooth(shape, size, rng):
    """Positive noise of a correlation length in voxels, with the mean 1."""
    noise = gaussian_filter(rng.standard_normal(shape, np.float32), (0.7, size, size))
    return np.exp(noise / max(float(noise.std()), 1e-6) * 0.7 - 0.245)


def drawn(size: int, rng: np.random.Generator, count: int, kinds: tuple[str, ...]) -> Float32[np.ndarray, "y x"]:
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
