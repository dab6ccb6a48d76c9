"""Volumes, points and the mold in compact form for the page: projections, and data that the browser draws in space."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from ...grid import Grid
from ...lenses import MicrolensArray
from ...mold.solids import MoldShape, preview_solid
from ...pictures.volume_pictures import display_range, downsample, png_uri, to_base64, to_uint8

# Bytes of all slices before compression.
SLICE_BYTES = 6_000_000
# Pixels along a projection; voxels in space, in all and along a side; points in space; pixels along a capture.
_MAX_PIXELS, _MAX_VOXELS, _MAX_SIDE, _MAX_POINTS, _MAX_CAPTURE = 720, 60_000, 200, 5000, 900


class Projection(NamedTuple):
    """A picture of maxima, its width and height, mm."""

    picture: str
    width: float
    height: float


def make_projections(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> list[Projection]:
    """Maxima along z, y and x, `[y, x]`, `[z, x]` and `[y, z]`, each with its own range."""
    z = np.asarray(grid.depths, float)
    order = np.argsort(z)
    width, height = grid.shape[1] * grid.pitch, grid.shape[0] * grid.pitch
    depth = float(np.ptp(z)) * (1 + 1 / max(len(z) - 1, 1)) or grid.pitch
    views = (
        (volume.max(0), width, height),
        (_resample_depths(volume.max(1)[order], z[order]), width, depth),
        (_resample_depths(volume.max(2)[order], z[order]).T, depth, height),
    )
    projections = []
    for image, across, down in views:
        small = _block_maxima(image, [-(-n // _MAX_PIXELS) for n in image.shape])
        projections.append(Projection(png_uri(to_uint8(small, *display_range(small)), "magma"), across, down))
    return projections


def _resample_depths(image: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Rows at even depths, by nearest neighbour, from rows at uneven depths."""
    if len(depths) < 3 or np.allclose(np.diff(depths), depths[1] - depths[0], rtol=1e-3):
        return image
    count = min(int(np.ceil(np.ptp(depths) / np.diff(depths).min())) + 1, 400)
    even = np.linspace(depths[0], depths[-1], count)
    return image[np.abs(even[:, None] - depths[None]).argmin(1)]


def _block_maxima(values: np.ndarray, steps: list[int]) -> np.ndarray:
    for axis, step in enumerate(steps):
        if step > 1:
            values = np.maximum.reduceat(values, np.arange(0, values.shape[axis], step), axis)
    return values


def voxel_view(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> dict[str, Any]:
    """The brightest voxels for the browser: indices of voxels, and brightness from 1 to 255."""
    step = [-(-n // _MAX_SIDE) for n in volume.shape]
    values = to_uint8(_block_maxima(volume, step), *display_range(volume))
    flat = values.ravel()
    floor = max(1, int(np.partition(flat, -_MAX_VOXELS)[-_MAX_VOXELS])) if flat.size > _MAX_VOXELS else 1
    kept = np.flatnonzero(flat >= floor)
    if len(kept) > _MAX_VOXELS:
        # Of the voxels at the floor, an even selection.
        brighter, at_floor = kept[flat[kept] > floor], kept[flat[kept] == floor]
        chosen = np.linspace(0, len(at_floor) - 1, _MAX_VOXELS - len(brighter)).round().astype(int)
        kept = np.sort(np.concatenate([brighter, at_floor[chosen]]))
    z, y, x = np.unravel_index(kept, values.shape)
    middles = np.minimum(np.arange(values.shape[0]) * step[0] + (step[0] - 1) // 2, len(grid.depths) - 1)
    left, _, _, top = grid.extent
    pitch_x, pitch_y = grid.pitch * step[2], grid.pitch * step[1]
    return {
        "kind": "cloud",
        "count": len(kept),
        "voxels": to_base64(np.column_stack([x, y, z, flat[kept]]).astype(np.uint8)),
        "pitch": [pitch_x, pitch_y],
        "first": [left + pitch_x / 2, top + pitch_y / 2],
        "depths": np.asarray(grid.depths, float)[middles].tolist(),
        "box": _box(grid),
    }


def _box(grid: Grid) -> list[list[float]]:
    left, right, bottom, top = grid.extent
    z = np.asarray(grid.depths, float)
    return [[left, top, float(z.min())], [right, bottom, float(z.max())]]


def point_view(points: Float[np.ndarray, "point 4"], grid: Grid | None) -> dict[str, Any]:
    """The brightest points for the browser."""
    kept = points[np.argsort(-points[:, 3], kind="stable")[:_MAX_POINTS], :3]
    box = _box(grid) if grid is not None else [kept.min(0).tolist(), kept.max(0).tolist()]
    return {"kind": "points", "count": len(kept), "places": to_base64(kept.astype(np.float32)), "box": box}


def mold_view(array: MicrolensArray) -> dict[str, Any]:
    """The mold for the browser: vertices as fractions of its box, and facets."""
    mesh = preview_solid(array, MoldShape()).to_mesh64()
    vertices = mesh.vert_properties[:, :3]
    low, high = vertices.min(0), vertices.max(0)
    fractions = np.round((vertices - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return {
        "kind": "mesh",
        "count": len(mesh.tri_verts),
        "corners": to_base64(fractions),
        "facets": to_base64(mesh.tri_verts.astype(np.uint32)),
        "box": [low.tolist(), high.tolist()],
    }


def capture_view(image: Num[np.ndarray, "row column"]) -> dict[str, Any]:
    """Pictures of the whole, each pixel a mean of `step` x `step`, and of 500 x 500 pixels in the middle."""
    low, high = (float(v) for v in np.percentile(image, (0.5, 99.8)))
    middle = image[tuple(slice(max(n // 2 - 250, 0), n // 2 + 250) for n in image.shape)]
    whole, crop = (png_uri(to_uint8(part, low, high)) for part in (downsample(image, _MAX_CAPTURE), middle))
    return {"whole": whole, "middle": crop, "step": -(-max(image.shape) // _MAX_CAPTURE), "shape": image.shape}
