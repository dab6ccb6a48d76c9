"""Volumes, points and parts, small enough for a page: projections, and what the browser turns."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from ...grid import Grid
from ...lenses import MicrolensArray
from ...mold.solids import MoldShape, preview_solid
from ...pictures.volume_pictures import brightness, in_range, packed, png, thinned

# Bytes of all slices before they are compressed; pixels of a projection's side; voxels in space, and a side's.
SLICE_BYTES, _SIDE, _VOXELS, _CUBE = 6_000_000, 720, 60_000, 200
# Points that a table lists, and that space shows.
LISTED, _DRAWN = 300, 5000


class Projection(NamedTuple):
    """A picture of maxima, lengths of its sides, mm, and its depths in words."""

    picture: str
    wide: float
    high: float
    ends: str


def projections(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> list[Projection]:
    """Maxima along z, y and x, each to its own brightness: the more voxels a ray has, the brighter are its maxima.

    Pictures are `[y, x]`, `[z, x]` and `[y, z]`.
    """
    z = np.asarray(grid.depths, float)
    order, ends = np.argsort(z), f"z from {z.min():.4g} to {z.max():.4g} mm"
    width, height = grid.shape[1] * grid.pitch, grid.shape[0] * grid.pitch
    deep = float(np.ptp(z)) * (1 + 1 / max(len(z) - 1, 1)) or grid.pitch
    made = []
    for image, wide, high in (
        (volume.max(0), width, height),
        (_even(volume.max(1)[order], z[order]), width, deep),
        (_even(volume.max(2)[order], z[order]).T, deep, height),
    ):
        small = _thinned_maxima(image, _SIDE)
        made.append(Projection(png(in_range(small, *brightness(small)), "magma"), wide, high, ends))
    return made


def _even(image: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Rows at uneven depths as rows at even ones: the nearest."""
    if len(depths) < 3 or np.allclose(np.diff(depths), depths[1] - depths[0], rtol=1e-3):
        return image
    count = min(int(np.ceil(np.ptp(depths) / np.diff(depths).min())) + 1, 400)
    even = np.linspace(depths[0], depths[-1], count)
    return image[np.abs(even[:, None] - depths[None]).argmin(1)]


def _thinned_maxima(image: np.ndarray, most: int) -> np.ndarray:
    for axis in (0, 1):
        step = -(-image.shape[axis] // most)
        starts = np.arange(0, image.shape[axis], step)
        image = np.maximum.reduceat(image, starts, axis)
    return image


def cloud(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> dict[str, Any]:
    """The brightest voxels for the browser: places as whole numbers of voxels, brightness 1 to 255."""
    low, high = brightness(volume)
    step = [-(-n // _CUBE) for n in volume.shape]
    small = volume
    for axis, width in enumerate(step):
        if width > 1:
            small = np.maximum.reduceat(small, np.arange(0, volume.shape[axis], width), axis)
    values = in_range(small, low, high)
    flat = values.ravel()
    floor = max(1, int(np.partition(flat, -_VOXELS)[-_VOXELS])) if flat.size > _VOXELS else 1
    places = np.flatnonzero(flat >= floor)
    # Equal ones at the floor may be many: some of them, spread over all.
    if len(places) > _VOXELS:
        bright = places[flat[places] > floor]
        rest = places[flat[places] == floor]
        take = np.linspace(0, len(rest) - 1, _VOXELS - len(bright)).round().astype(int)
        places = np.sort(np.concatenate([bright, rest[take]]))
    z, y, x = np.unravel_index(places, values.shape)
    depths = np.asarray(grid.depths, float)
    mm = [float(depths[min(k * step[0] + (step[0] - 1) // 2, len(depths) - 1)]) for k in range(values.shape[0])]
    left, _, _, top = grid.extent
    return {
        "kind": "cloud",
        "count": len(places),
        "voxels": packed(np.column_stack([x, y, z, flat[places]]).astype(np.uint8)),
        "pitch": [grid.pitch * step[2], grid.pitch * step[1]],
        "first": [left + grid.pitch * step[2] / 2, top + grid.pitch * step[1] / 2],
        "depths": mm,
        "box": _box(grid),
    }


def _box(grid: Grid) -> list[list[float]]:
    left, right, bottom, top = grid.extent
    z = np.asarray(grid.depths, float)
    return [[left, top, float(z.min())], [right, bottom, float(z.max())]]


def scatter(points: Float[np.ndarray, "point 4"], grid: Grid | None) -> dict[str, Any]:
    """Points for the browser, the brightest if they are many."""
    kept = points[np.argsort(-points[:, 3], kind="stable")[:_DRAWN]]
    low, high = kept[:, :3].min(0), kept[:, :3].max(0)
    box = _box(grid) if grid is not None else [low.tolist(), high.tolist()]
    return {"kind": "points", "count": len(kept), "places": packed(kept[:, :3].astype(np.float32)), "box": box}


def part(array: MicrolensArray) -> dict[str, Any]:
    """The mold for the browser: corners as shares of its box, three of them a facet."""
    mesh = preview_solid(array, MoldShape()).to_mesh64()
    corners, facets = mesh.vert_properties[:, :3], mesh.tri_verts
    low, high = corners.min(0), corners.max(0)
    shares = np.round((corners - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return {
        "kind": "mesh",
        "count": len(facets),
        "corners": packed(shares),
        "facets": packed(facets.astype(np.uint32)),
        "box": [low.tolist(), high.tolist()],
    }


def capture_pictures(image: Num[np.ndarray, "row column"], most: int = 900) -> tuple[str, str, int]:
    """The whole, and as many pixels of its middle as they are; and how many pixels one of the whole is each way."""
    low, high = (float(v) for v in np.percentile(image, (0.5, 99.8)))
    middle = image[tuple(slice(max(n // 2 - 250, 0), n // 2 + 250) for n in image.shape)]
    step = -(-max(image.shape) // most)
    return png(in_range(thinned(image, most), low, high)), png(in_range(middle, low, high)), step
