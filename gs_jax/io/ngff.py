"""What OME-Zarr says of an image: axes, scales, what to show; volumes (0.4), and volumes in time (0.5).

Of volumes in time each frame is a file, a shard of Zarr 3; of single ones each plane is, which readers of Zarr 2 alone
read too.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from ..base.errors import InputError
from ..grid import Grid
from .provenance import KEY, Provenance
from .viewers import display_range, title

CHUNK = 1024


def um(mm: float) -> float:
    """18100, not 18100.000000000004."""
    return float(f"{mm * 1000:.12g}")


def first_um(grid: Grid) -> tuple[float, float]:
    """The centre of the first voxel of each plane, `(y, x)`, um, from what a float32 origin was meant to be."""
    x, y = (float(str(at)) for at in np.asarray(grid.origin))
    rows, columns = grid.shape
    return um(y - (rows - 1) / 2 * grid.pitch), um(x - (columns - 1) / 2 * grid.pitch)


def plain_depths(grid: Grid) -> list[float]:
    """Depths as they were meant: 18.1, not float32's 18.100000381."""
    return [float(str(depth)) for depth in np.asarray(grid.depths)]


def step_of(path: Path, depths: list[float], pitch: float) -> float:
    """The step of depths, mm; `InputError` if they have no single one, which OME-Zarr needs."""
    # One plane has no step, and the format wants one: the lateral pitch, as of a cube.
    step = (depths[-1] - depths[0]) / (len(depths) - 1) if len(depths) > 1 else pitch
    even = np.abs(np.array(depths) - depths[0] - step * np.arange(len(depths))).max() <= 1e-6 * max(depths)
    if step <= 0 or not even:
        raise InputError(f"{path}: found uneven or descending depths, allowed in OME-Zarr: even steps; use .ome.tif.")
    return step


def image_attributes(
    path: Path,
    depths: list[float],
    grid: Grid,
    shapes: Sequence[tuple[int, ...]],
    voxels: Float32[np.ndarray, "depth row column"],
    provenance: Provenance,
    *,
    in_time: bool = False,
    interval: float | None = None,
) -> dict[str, Any]:
    """Attributes of the group of an image.

    Parameters
    ----------
    path
        Whose name is the image's.
    depths
        Of the planes, mm.
    grid
        Where the voxels are.
    shapes
        `(row, column)` of the levels of a pyramid, the first of the full size, each next of half the rows and columns.
    voxels
        What the range of values to show is taken from.
    provenance
        Where the image comes from.
    in_time, interval
        The first axis is time; the seconds between frames, if they are known.

    Raises
    ------
    InputError
        As `step_of`.
    """
    pitch = grid.pitch
    scale, first = [um(step_of(path, depths, pitch)), um(pitch), um(pitch)], [um(depths[0]), *first_um(grid)]
    axes: list[dict[str, str]] = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    if in_time:
        axes.insert(0, {"name": "t", "type": "time"} | ({"unit": "second"} if interval else {}))
        scale, first = [interval or 1.0, *scale], [0.0, *first]
    low, high = display_range(voxels)
    window = {"min": float(voxels.min()), "max": float(voxels.max()), "start": low, "end": high}
    channel = {"active": True, "color": "FFFFFF", "label": title(path), "window": window}
    multiscale = {
        **({} if in_time else {"version": "0.4"}),
        "name": title(path),
        "axes": axes,
        "datasets": [
            {"path": str(level), "coordinateTransformations": _transforms(scale, first, 2**level)}
            for level in range(len(shapes))
        ],
    }
    attributes = {"multiscales": [multiscale], "omero": {"channels": [channel], "rdefs": {"model": "greyscale"}}}
    attributes = {"ome": {"version": "0.5", **attributes}} if in_time else attributes
    return attributes | ({KEY: dict(provenance)} if provenance else {})


def _transforms(scale, first, side):
    """Of voxels that are the mean of `side` by `side`: wider, and with a centre further in."""
    factors = [*[1] * (len(scale) - 2), side, side]
    wider = [step * factor for step, factor in zip(scale, factors, strict=True)]
    inner = [at + step * (factor - 1) / 2 for at, step, factor in zip(first, scale, factors, strict=True)]
    return [{"type": "scale", "scale": wider}, {"type": "translation", "translation": inner}]


def chunked(shape: tuple[int, int, int]) -> dict[str, Any]:
    """How a volume is stored: planes, or squares of them, each a file."""
    return {
        "chunks": (1, *_square(shape)),
        "compressors": {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1},
        "chunk_key_encoding": {"name": "v2", "separator": "/"},
    }


def sharded(shape: tuple[int, int, int, int]) -> dict[str, Any]:
    """How volumes in time are stored: planes, or squares of them, those of a frame in one file."""
    from zarr.codecs import BloscCodec

    rows, columns = _square(shape)
    whole = (-(-shape[-2] // rows) * rows, -(-shape[-1] // columns) * columns)
    return {
        "chunks": (1, 1, rows, columns),
        "shards": (1, shape[1], *whole),
        "compressors": BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
        "dimension_names": tuple("tzyx"),
    }


def _square(shape):
    return tuple(min(n, CHUNK) for n in shape[-2:])
