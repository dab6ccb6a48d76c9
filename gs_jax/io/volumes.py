"""Volumes on disk: OME-TIFF, or OME-Zarr when the name ends in `.zarr`.

Both hold float32 voxels `[depth, row, column]` as they are, and the grid in micrometres: the lateral pitch, every
depth, and the centre of the first voxel, so that Fiji and napari show the volume to scale and in place; and the range
of values to show.

OME-TIFF has a second description after OME's, as ImageJ writes it: without Bio-Formats ImageJ knows no other. Readers
of TIFF take the first, ImageJ takes the last.

OME-Zarr is written in version 0.4 (Zarr 2), not 0.5 (Zarr 3): every reader of Fiji (n5-viewer, MoBIE, Bio-Formats)
and of napari knows 0.4, while 0.5 needs recent versions of each; both are read here. Chunks are compressed with
Blosc (LZ4), the default of bioformats2raw and ome-zarr-py and several times as fast as zlib; they are one plane deep,
as planes are what a viewer asks for.

To add a format, add its suffix to `_FORMATS` at the end with a function that reads it and one that writes it.
"""

import contextlib
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast
from xml.etree import ElementTree

import numpy as np
import tifffile
from jaxtyping import Array, Shaped

from ..base.errors import InputError, needs_extra, short_repr
from ..grid import Grid
from ..typing import PathLike, Volume
from .files import atomic_write, check_input, check_output, decoding
from .provenance import KEY, NAMESPACE, Provenance
from .tiff import decode_page, place_for_description, take_place

MAX_VOXELS = 10**10

_MM_PER_UNIT = {"nm": 1e-6, "µm": 1e-3, "μm": 1e-3, "um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
_MM_PER_NAME = {"nanometer": 1e-6, "micrometer": 1e-3, "millimeter": 1.0, "centimeter": 10.0, "meter": 1e3}


def write_volume(
    path: PathLike,
    volume: Shaped[Array | np.ndarray, "depth row column"],
    grid: Grid,
    provenance: Provenance | None = None,
) -> None:
    """Writes a volume as float32, never rescaled or clipped, whole or not at all.

    *File.*

    Parameters
    ----------
    path
        Ends in `.tif` or `.tiff` (best `.ome.tif`) or in `.zarr`.
    volume
        `(depth, row, column)` of floating-point numbers, rounded to float32, or of integers that float32 holds exactly.
    grid
        Where its voxels are.
    provenance
        Where it comes from.

    Raises
    ------
    InputError
        As `check_output`; if values are out of float32's range, or integers that it would round; if the depths are
        uneven or do not ascend and the path is `.zarr`, which has one step only.
    ValueError
        If the volume has not the grid's shape, or holds a NaN or an infinity.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> grid = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)
    >>> gs.write_volume("volume.ome.tif", np.zeros(grid.volume_shape, np.float32), grid)
    """
    path = check_output(path, VOLUME_SUFFIXES)
    voxels = _as_float32(path, np.asarray(volume))
    depths = plain_depths(grid)
    if voxels.shape != grid.volume_shape:
        raise ValueError(f"`volume` must have the grid's shape {grid.volume_shape}, got {voxels.shape}.")
    if not np.isfinite(voxels).all():
        raise ValueError("`volume` must be finite, got a NaN or an infinity.")
    _FORMATS[path.suffix.lower()].write(path, voxels, depths, grid, provenance or {})


def read_volume(path: PathLike) -> tuple[Volume, Grid]:
    """A volume and its grid, from an OME-TIFF or an OME-Zarr (0.4 or 0.5) that has depths.

    *File.*

    Raises
    ------
    InputError
        If it cannot be read, is damaged, is not one image with the axes z, y, x, has values that float32 cannot
        hold or that are not finite, or lacks the metadata: pitch, a depth above 0 for each plane.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> grid = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)
    >>> gs.write_volume("volume.ome.tif", np.zeros(grid.volume_shape, np.float32), grid)
    >>> volume, same = gs.read_volume("volume.ome.tif")
    >>> volume.shape, same.pitch
    ((3, 41, 41), 0.1)
    """
    suffix = Path(path).suffix.lower()
    if suffix not in VOLUME_SUFFIXES:
        raise InputError(f"{path}: found the suffix {short_repr(suffix)}, allowed: {', '.join(VOLUME_SUFFIXES)}.")
    voxels, grid = _FORMATS[suffix].read(Path(path))
    if not np.isfinite(voxels).all():
        raise InputError(f"{path}: found a NaN or an infinity among the voxels, allowed: finite numbers.")
    return voxels, grid


def _as_float32(path: Path, voxels: np.ndarray) -> Volume:
    if voxels.dtype == np.float32:
        return voxels
    if voxels.dtype.kind in "buif":
        with np.errstate(over="ignore", invalid="ignore"):
            cast = voxels.astype(np.float32)
        # Of floating-point numbers only the range may be too wide; a count that is rounded is another count.
        is_float = voxels.dtype.kind == "f"
        fits = np.isfinite(cast) == np.isfinite(voxels) if is_float else cast.astype(np.float64) == voxels
        if fits.all():
            return cast
    allowed = "floating-point numbers in float32's range, or integers that float32 holds exactly"
    raise InputError(f"{path}: found voxels of type {voxels.dtype}, allowed: {allowed}.")


def _mm(value: float, unit: float) -> float:
    return float(f"{value * unit:.12g}")


def _check_declared(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if len(shape) != 3 or min(shape) < 1 or math.prod(shape) > MAX_VOXELS:
        raise InputError(f"{path}: found {shape} voxels, allowed: (depth, row, column), at most {MAX_VOXELS} in all.")
    if dtype.kind not in "buif" or not np.can_cast(dtype, np.float32):
        raise InputError(f"{path}: found voxels of type {dtype}, allowed: float32, or integers up to 16 bits.")


def _checked_grid(path: Path, depths: list[float], shape: tuple[int, int], pitches, first) -> Grid:
    """The grid of `depths` and of pitches and first voxel centres, both `(y, x)`, mm; centred if `first` is None."""
    pitch = pitches[1]
    if not (1e-6 <= pitch <= 1e4 and math.isclose(pitches[0], pitch, rel_tol=1e-6)):
        raise InputError(f"{path}: found voxels of {pitches} mm (y, x), allowed: squares from 1e-6 to 1e4 mm.")
    for depth in depths:
        if not 1e-6 <= depth <= 1e4:
            raise InputError(f"{path}: found a plane at the depth {depth} mm, allowed: from 1e-6 to 1e4 mm.")
    if first is None:
        return Grid(depths, shape, pitch)
    if not all(abs(place) <= 1e4 for place in first):
        raise InputError(f"{path}: found the first voxel at {list(first)} mm (y, x), allowed: up to 1e4 mm.")
    # To a picometre: what is centred is exactly so.
    y, x = (round(at + (n - 1) / 2 * pitch, 9) for at, n in zip(first, shape, strict=True))
    return Grid(depths, shape, pitch, (x, y))


# OME-TIFF


def _write_tiff(path: Path, voxels: np.ndarray, depths: list[float], grid: Grid, provenance: Provenance) -> None:
    planes, pitch, (first_y, first_x) = len(depths), grid.pitch, first_um(grid)
    plane: dict[str, Any] = {"PositionZ": [um(depth) for depth in depths]}
    plane |= {"PositionX": [first_x] * planes, "PositionY": [first_y] * planes}
    metadata = {
        "axes": "ZYX",
        "Name": title(path),
        "PhysicalSizeX": um(pitch),
        "PhysicalSizeY": um(pitch),
        "Plane": plane,
    }
    # Uneven depths: the mean step is what a viewer that knows one step only can show; the planes keep the truth.
    step = float(np.mean(np.abs(np.diff(depths)))) if planes > 1 else 0.0
    if step > 0:
        metadata["PhysicalSizeZ"] = um(step)
    metadata |= {f"{name}Unit": "µm" for name in list(metadata) if name.startswith("PhysicalSize")}
    plane |= {f"{name}Unit": ["µm"] * planes for name in list(plane)}
    if provenance:
        metadata["MapAnnotation"] = {"Namespace": NAMESPACE, **provenance}
    described = imagej_description(voxels, um(pitch), um(step), (first_x, first_y, um(depths[0])))
    per_um = 1 / um(pitch)  # the unit is in ImageJ's description: TIFF knows inches and centimetres alone
    with atomic_write(path) as temporary:
        tifffile.imwrite(
            temporary,
            voxels,
            ome=True,
            photometric="minisblack",
            metadata=metadata,
            resolution=(per_um, per_um),
            resolutionunit="NONE",
            extratags=[place_for_description(described)],
        )
        take_place(temporary)


def _read_tiff(path: Path) -> tuple[np.ndarray, Grid]:
    check_input(path)
    with contextlib.ExitStack() as stack:
        with decoding(path, "OME-TIFF"):
            # The pages of this file in their order: tifffile's own view of OME opens further files.
            tiff = stack.enter_context(tifffile.TiffFile(path, is_ome=False))
            pages = cast(list[tifffile.TiffPage], list(tiff.pages))
            kinds = {(tuple(page.shape), page.dtype) for page in pages}
            root = ElementTree.fromstring(tiff.pages.first.description)
        if len(kinds) != 1:
            raise InputError(f"{path}: found pages of {len(kinds)} sizes or types, allowed: one.")
        size, dtype = kinds.pop()
        shape = (len(pages), *size)
        _check_declared(path, shape, np.dtype(dtype))
        grid = _grid_of_ome(path, root, (len(pages), size[0], size[1]))
        voxels = np.empty(shape, np.float32)
        for index, page in enumerate(pages):
            voxels[index] = decode_page(path, page)
    return voxels, grid


def _grid_of_ome(path: Path, root: ElementTree.Element, shape: tuple[int, int, int]) -> Grid:
    images = root.findall("{*}Image/{*}Pixels")
    if len(images) != 1:
        raise InputError(f"{path}: found {len(images)} images in the OME-XML, allowed: one.")
    pixels = images[0]
    found = tuple(pixels.get(f"Size{axis}") for axis in "TCZYX")
    if found != ("1", "1", *(str(n) for n in shape)):
        raise InputError(f"{path}: found the OME sizes {found} (T, C, Z, Y, X), allowed: {(1, 1, *shape)}.")
    planes = {plane.get("TheZ"): plane for plane in pixels.findall("{*}Plane")}
    missing = [index for index in range(shape[0]) if str(index) not in planes]
    if missing:
        raise InputError(f"{path}: found no `PositionZ` of plane {missing[0] + 1}, allowed: a depth for each plane.")
    ordered = [planes[str(index)] for index in range(shape[0])]
    depths = [_length(path, plane, "PositionZ", "reference frame") for plane in ordered]
    pitches = [_length(path, pixels, f"PhysicalSize{axis}", "µm") for axis in "YX"]
    placed = all(ordered[0].get(f"Position{axis}") is not None for axis in "YX")
    first = [_length(path, ordered[0], f"Position{axis}", "reference frame") for axis in "YX"] if placed else None
    return _checked_grid(path, depths, shape[1:], pitches, first)


def _length(path: Path, element: ElementTree.Element, name: str, default_unit: str) -> float:
    """An attribute of OME-XML, mm. `default_unit` is the schema's, where the attribute `...Unit` is missing."""
    found, unit = element.get(name), element.get(f"{name}Unit", default_unit)
    try:
        return _mm(float(found or ""), _MM_PER_UNIT[unit])
    except (ValueError, KeyError) as error:
        value = "nothing" if found is None else f"{short_repr(found)} in {short_repr(unit)}"
        raise InputError(f"{path}: OME-XML `{name}`: found {value}, allowed: a length in µm.") from error


# OME-Zarr


def _write_zarr(path: Path, voxels: np.ndarray, depths: list[float], grid: Grid, provenance: Provenance) -> None:
    with needs_extra("zarr"):
        import zarr  # 0.15 s that TIFF does not need

    attributes = image_attributes(path, depths, grid, [voxels.shape[1:]], voxels, provenance)
    with atomic_write(path) as temporary:
        group = zarr.create_group(store=temporary, zarr_format=2, attributes=attributes)
        array = group.create_array("0", shape=voxels.shape, dtype=voxels.dtype, **chunked(voxels.shape))
        array[...] = voxels


def _read_zarr(path: Path) -> tuple[np.ndarray, Grid]:
    with needs_extra("zarr"):
        import zarr

    if not os.path.isdir(path):
        raise InputError(f"{path}: found {'a file' if os.path.exists(path) else 'nothing'}, allowed: a Zarr folder.")
    with decoding(path, "OME-Zarr"):
        group = zarr.open_group(path, mode="r")
        attributes = group.attrs.asdict()
    name, scale, first = _ngff(path, attributes)
    with decoding(path, "OME-Zarr"):
        array = group[name]
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: found no array {short_repr(name)}, allowed: the one that the metadata names.")
    _check_declared(path, array.shape, array.dtype)
    depths, rows, columns = array.shape
    z = [_mm(first[0] + index * scale[0], 1.0) for index in range(depths)]
    grid = _checked_grid(path, z, (rows, columns), scale[1:], first[1:])
    with decoding(path, "OME-Zarr"):
        voxels = np.asarray(array[...], dtype=np.float32)
    return voxels, grid


def _ngff(path: Path, attributes: dict[str, Any]) -> tuple[str, list[float], list[float]]:
    """Name of the full-size array, scale and translation `(z, y, x)`, mm; of NGFF 0.4, or 0.5 (in `ome`)."""
    try:
        (multiscale,) = attributes.get("ome", attributes)["multiscales"]
        axes = [(axis["name"], _MM_PER_NAME[axis["unit"]]) for axis in multiscale["axes"]]
        if [name for name, _ in axes] != ["z", "y", "x"] or "coordinateTransformations" in multiscale:
            raise ValueError("not three axes with one scale each")
        dataset = multiscale["datasets"][0]
        scale, translation = dataset["coordinateTransformations"]
        step, first = (
            [_mm(value * 1.0, unit) for value, (_, unit) in zip(values, axes, strict=True)]
            for values in (scale["scale"], translation["translation"])
        )
        return str(dataset["path"]), step, first
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        allowed = "NGFF 0.4 or 0.5, axes z, y, x in micrometer, one scale and one translation"
        raise InputError(f"{path}: found other `multiscales` metadata ({error!r:.80}), allowed: {allowed}.") from error


class _Format(NamedTuple):
    """How a volume is read, and how voxels of float32 are written with their depths (mm) and grid."""

    read: Callable[[Path], tuple[np.ndarray, Grid]]
    write: Callable[[Path, np.ndarray, list[float], Grid, Provenance], None]


_TIFF, _ZARR = _Format(_read_tiff, _write_tiff), _Format(_read_zarr, _write_zarr)
_FORMATS = {".tif": _TIFF, ".tiff": _TIFF, ".zarr": _ZARR}
VOLUME_SUFFIXES = tuple(_FORMATS)


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
    voxels: Volume,
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
    with needs_extra("zarr"):
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


# Percentiles of the values shown, of up to so many rows and columns.
_SHOWN, _SAMPLED = (1, 99.9), 512


def title(path: Path) -> str:
    """The name of a volume in a file."""
    return path.name.removesuffix(path.suffix).removesuffix(".ome")


def display_range(voxels: np.ndarray) -> tuple[float, float]:
    """What a viewer should show as black and white: few voxels are darker or brighter."""
    some = voxels[:, :: max(voxels.shape[1] // _SAMPLED, 1), :: max(voxels.shape[2] // _SAMPLED, 1)]
    for low, high in (np.percentile(some, _SHOWN), (voxels.min(), voxels.max())):
        if low < high:
            return float(low), float(high)
    return float(low), float(low) + 1


def imagej_description(voxels: np.ndarray, pitch_um: float, step_um: float, first_um: tuple[float, ...]) -> str:
    """ImageJ's description of a stack whose first voxel is at `(x, y, z)`; without a step it is one plane."""
    low, high = display_range(voxels)
    stack = f"images={len(voxels)}\nslices={len(voxels)}\n" if len(voxels) > 1 else ""
    spacing = f"spacing={step_um}\n" if step_um > 0 else ""
    # Where zero is, counted in voxels.
    sides = {"x": pitch_um, "y": pitch_um, "z": step_um}
    zero = "".join(f"{a}origin={-at / sides[a]:.6f}\n" for a, at in zip("xyz", first_um, strict=True) if sides[a])
    return f"ImageJ=1.54f\n{stack}unit=um\n{spacing}{zero}loop=false\nmin={low}\nmax={high}\n"
