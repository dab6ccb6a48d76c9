"""Metadata of volumes for viewers: OME-Zarr attributes of volumes (0.4) and of volumes in time (0.5), display range.

A volume in time has a file per frame, a shard of Zarr 3; a single volume has one per plane, which readers of Zarr 2
read too.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import input_error, needs_extra
from ..grid import Grid
from ..typing import Volume
from .names import plain_text
from .provenance import KEY, Provenance

CHUNK = 1024
# Percentiles of the displayed values, of up to so many rows and columns.
_DISPLAYED, _SAMPLES = (1, 99.9), 512


def import_zarr() -> Any:
    """The package zarr, which TIFF does not need; `InputError` if it is not installed."""
    with needs_extra("zarr"):
        import zarr  # 0.15 s
    return zarr


def ngff_attributes(group: Any) -> dict[str, Any]:
    """NGFF's attributes of a group or an array of Zarr, which version 0.5 has in `ome`."""
    attributes = group.attrs.asdict()
    return attributes.get("ome", attributes)


def um(mm: float) -> float:
    """Micrometres to 12 digits: 18100 rather than 18100.000000000004."""
    return float(f"{mm * 1000:.12g}")


def first_um(grid: Grid) -> tuple[float, float]:
    """Centre of the first voxel `(y, x)`, um; a float32 origin is taken as the shortest decimal that it stands for."""
    x, y = (float(str(at)) for at in np.asarray(grid.origin))
    rows, columns = grid.shape
    return um(y - (rows - 1) / 2 * grid.pitch), um(x - (columns - 1) / 2 * grid.pitch)


def plain_depths(grid: Grid) -> list[float]:
    """Depths as the shortest decimals: 18.1 rather than float32's 18.100000381."""
    return [float(str(depth)) for depth in np.asarray(grid.depths)]


def _step(path: Path, depths: list[float], pitch: float) -> float:
    # OME-Zarr needs a step for a single plane, too: that of a cubic voxel.
    step = (depths[-1] - depths[0]) / (len(depths) - 1) if len(depths) > 1 else pitch
    even = np.abs(np.array(depths) - depths[0] - step * np.arange(len(depths))).max() <= 1e-6 * max(depths)
    if step <= 0 or not even:
        raise input_error("depths", "in even steps for OME-Zarr", "uneven or descending ones; use .ome.tif", path)
    return step


def title(path: Path) -> str:
    """Name of a volume in its file."""
    return plain_text(path.name.removesuffix(path.suffix).removesuffix(".ome"))


def display_range(voxels: np.ndarray) -> tuple[float, float]:
    """Values that a viewer shows as black and white."""
    sample = voxels[:, :: max(voxels.shape[1] // _SAMPLES, 1), :: max(voxels.shape[2] // _SAMPLES, 1)]
    for low, high in (np.percentile(sample, _DISPLAYED), (voxels.min(), voxels.max())):
        if low < high:
            return float(low), float(high)
    return float(low), float(low) + 1


def image_attributes(
    path: Path,
    depths: list[float],
    grid: Grid,
    levels: int,
    voxels: Volume,
    provenance: Provenance | None,
    *,
    in_time: bool = False,
    interval: float | None = None,
) -> dict[str, Any]:
    """Attributes of the Zarr group of an image; `InputError` if the depths are not in even, ascending steps.

    `levels` of a pyramid, each of half the rows and columns; `voxels` set the display range; `in_time`: the first axis
    is time, with `interval` seconds between frames, if they are known.
    """
    pitch = grid.pitch
    scale, first = [um(_step(path, depths, pitch)), um(pitch), um(pitch)], [um(depths[0]), *first_um(grid)]
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
            for level in range(levels)
        ],
    }
    attributes = {"multiscales": [multiscale], "omero": {"channels": [channel], "rdefs": {"model": "greyscale"}}}
    attributes = {"ome": {"version": "0.5", **attributes}} if in_time else attributes
    return attributes | ({KEY: dict(provenance)} if provenance else {})


def _transforms(scale: list[float], first: list[float], side: int) -> list[dict[str, Any]]:
    """Scale and translation of a level whose voxels are means of `side` x `side`."""
    factors = [*[1] * (len(scale) - 2), side, side]
    wider = [step * factor for step, factor in zip(scale, factors, strict=True)]
    inner = [at + step * (factor - 1) / 2 for at, step, factor in zip(first, scale, factors, strict=True)]
    return [{"type": "scale", "scale": wider}, {"type": "translation", "translation": inner}]


def missing_chunk(array, place: tuple[int, ...] = ()) -> str | None:
    """Key of a chunk of an array in a local store, or of the part `array[place]`, that is missing there.

    Zarr reads its fill value instead, as it does for what a program left out because it is dark.
    """
    root = Path(array.store.root, array.path)
    sizes = array.shards or array.chunks
    counts = [range(at // size, at // size + 1) for at, size in zip(place, sizes, strict=False)]
    rest = zip(array.shape[len(place) :], sizes[len(place) :], strict=True)
    counts += [range(-(-length // size)) for length, size in rest]
    keys = (array.metadata.encode_chunk_key(chunk) for chunk in itertools.product(*counts))
    return next((key for key in keys if not (root / key).exists()), None)


def plane_chunks(shape: tuple[int, int, int]) -> dict[str, Any]:
    """Storage of a volume: each plane, or square of it, is a file."""
    return {
        "chunks": (1, *_square(shape)),
        "compressors": {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1},
        "chunk_key_encoding": {"name": "v2", "separator": "/"},
    }


def frame_shards(shape: tuple[int, int, int, int]) -> dict[str, Any]:
    """Storage of volumes in time: each frame is a file, with its planes, or squares of them, as chunks."""
    rows, columns = _square(shape)
    padded = (-(-shape[-2] // rows) * rows, -(-shape[-1] // columns) * columns)
    return {
        "chunks": (1, 1, rows, columns),
        "shards": (1, shape[1], *padded),
        "compressors": import_zarr().codecs.BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
        "dimension_names": tuple("tzyx"),
    }


def _square(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(min(n, CHUNK) for n in shape[-2:])
