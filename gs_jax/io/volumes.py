"""Reads and writes volumes: OME-TIFF, or OME-Zarr when the name ends in `.zarr`.

Both hold float32 voxels `[depth, row, column]` as they are, the grid in micrometres (lateral pitch, every depth, centre
of the first voxel), so that Fiji and napari show the volume to scale and in place, and a display range.

An OME-TIFF has ImageJ's description after OME's: readers of TIFF take the first, ImageJ without Bio-Formats the last.

OME-Zarr is written in version 0.4 (Zarr 2), which every reader of Fiji and napari knows, rather than 0.5 (Zarr 3);
both are read. Chunks are one plane deep, as viewers ask for planes, and compressed with Blosc (LZ4), the default of
bioformats2raw and ome-zarr-py.

To add a format, add its suffix to `_FORMATS` with a function that reads it and one that writes it.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile
from jaxtyping import Array, Shaped

from ..base.arrays import host_code
from ..base.errors import InputError, input_error, needs_extra, short_repr
from ..grid import Grid
from ..typing import PathLike, Volume
from .files import TIFF_SUFFIXES, atomic_write, check_input, check_output, check_suffix, decoding
from .lengths import mm_per
from .ngff import display_range, first_um, image_attributes, plain_depths, plane_chunks, title, um
from .provenance import NAMESPACE, Provenance, moved, surface_of
from .tiff import decode_page, open_tiff

MAX_VOXELS = 10**10

# Tags of TIFF: a description, and the tag after it, in whose place a second description is written.
_DESCRIPTION, _AFTER = 270, 271


@host_code()
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
        Positions of the voxels.
    provenance
        Kept in the file.

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
    if voxels.shape != grid.volume_shape:
        raise ValueError(f"`volume` must have the grid's shape {grid.volume_shape}, got {voxels.shape}.")
    if not np.isfinite(voxels).all():
        raise ValueError("`volume` must be finite, got a NaN or an infinity.")
    _FORMATS[path.suffix.lower()].write(path, voxels, plain_depths(grid), grid, provenance or {})


def read_volume(path: PathLike) -> tuple[Volume, Grid]:
    """A volume and its grid, from an OME-TIFF or an OME-Zarr (0.4 or 0.5) that has depths.

    *File.*

    Depths are from the array, also those of a file that says it counts from the sample's surface.

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
    voxels, grid = _FORMATS[check_suffix(path, VOLUME_SUFFIXES)].read(Path(path))
    if not np.isfinite(voxels).all():
        raise input_error("voxels", "finite", "a NaN or an infinity", path)
    return voxels, grid


def _as_float32(path: Path, voxels: np.ndarray) -> Volume:
    if voxels.dtype == np.float32:
        return voxels
    if voxels.dtype.kind in "buif":
        with np.errstate(over="ignore", invalid="ignore"):
            cast = voxels.astype(np.float32)
        # Floating-point numbers may be rounded; an integer that is rounded is another count.
        is_float = voxels.dtype.kind == "f"
        fits = np.isfinite(cast) == np.isfinite(voxels) if is_float else cast.astype(np.float64) == voxels
        if fits.all():
            return cast
    allowed = "floating-point numbers in the range of float32, or integers that float32 holds exactly"
    raise input_error("voxels", allowed, voxels.dtype, path)


def _mm(value: float, unit: float) -> float:
    return float(f"{value * unit:.12g}")


def _check_declared(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if len(shape) != 3 or min(shape) < 1 or math.prod(shape) > MAX_VOXELS:
        raise input_error("volume", f"(depth, row, column), at most {MAX_VOXELS} voxels in all", shape, path)
    if dtype.kind not in "buif" or not np.can_cast(dtype, np.float32):
        raise input_error("voxels", "float32, or integers up to 16 bits", dtype, path)


def checked_grid(path: Path, depths: list[float], shape: tuple[int, int], pitches, first) -> Grid:
    """Grid of depths, pitches `(y, x)` and centre of the first voxel `(y, x)`, mm; centred if `first` is None.

    Its depths are from the array, also where those of the file count from the sample's surface.
    """
    pitch = pitches[1]
    if not (1e-6 <= pitch <= 1e4 and math.isclose(pitches[0], pitch, rel_tol=1e-6)):
        raise input_error("voxels", "squares from 1e-6 to 1e4 mm", f"{pitches} mm (y, x)", path)
    if surface := surface_of(path):
        depths = moved(depths, surface).tolist()
    for depth in depths:
        if not 1e-6 <= depth <= 1e4:
            raise input_error("depth of a plane", "from 1e-6 to 1e4 mm from the array", f"{depth} mm", path)
    if first is None:
        return Grid(depths, shape, pitch)
    if not all(abs(place) <= 1e4 for place in first):
        raise input_error("first voxel", "up to 1e4 mm from the axis", f"{list(first)} mm (y, x)", path)
    # Rounded to a picometre, so that a centred volume is centred exactly.
    y, x = (round(at + (n - 1) / 2 * pitch, 9) for at, n in zip(first, shape, strict=True))
    return Grid(depths, shape, pitch, (x, y))


# OME-TIFF


def _write_tiff(path: Path, voxels: np.ndarray, depths: list[float], grid: Grid, provenance: Provenance) -> None:
    planes, pitch, (first_y, first_x) = len(depths), grid.pitch, first_um(grid)
    plane: dict[str, Any] = {"PositionZ": [um(depth) for depth in depths]}
    plane |= {"PositionX": [first_x] * planes, "PositionY": [first_y] * planes}
    metadata = {"axes": "ZYX", "Name": title(path), "PhysicalSizeX": um(pitch), "PhysicalSizeY": um(pitch)}
    # The mean step of uneven depths serves viewers that know one step only; the planes have exact depths.
    step = float(np.mean(np.abs(np.diff(depths)))) if planes > 1 else 0.0
    if step > 0:
        metadata["PhysicalSizeZ"] = um(step)
    metadata |= {f"{name}Unit": "µm" for name in list(metadata) if name.startswith("PhysicalSize")}
    metadata["Plane"] = plane | {f"{name}Unit": ["µm"] * planes for name in plane}
    if provenance:
        metadata["MapAnnotation"] = {"Namespace": NAMESPACE, **provenance}
    imagej = _imagej_description(voxels, um(pitch), um(step), (first_x, first_y, um(depths[0])))
    per_um = 1 / um(pitch)  # the unit is in ImageJ's description: TIFF has inches and centimetres only
    with atomic_write(path) as temporary:
        tifffile.imwrite(
            temporary,
            voxels,
            ome=True,
            photometric="minisblack",
            metadata=metadata,
            resolution=(per_um, per_um),
            resolutionunit="NONE",
            extratags=[(_AFTER, 2, 0, imagej, True)],
        )
        # tifffile writes one description, so the second one has another tag until here.
        with tifffile.TiffFile(temporary) as tiff:
            entry, order = tiff.pages.first.tags[_AFTER].offset, tiff.byteorder
        with temporary.open("r+b") as file:
            file.seek(entry)
            file.write(_DESCRIPTION.to_bytes(2, "little" if order == "<" else "big"))


def _imagej_description(voxels: np.ndarray, pitch_um: float, step_um: float, first_um: tuple[float, ...]) -> str:
    """ImageJ's description of a stack whose first voxel is at `(x, y, z)`; without a step it is one plane."""
    low, high = display_range(voxels)
    stack = f"images={len(voxels)}\nslices={len(voxels)}\n" if len(voxels) > 1 else ""
    spacing = f"spacing={step_um}\n" if step_um > 0 else ""
    sides = {"x": pitch_um, "y": pitch_um, "z": step_um}
    # The position of zero, in voxels.
    zero = "".join(f"{a}origin={-at / sides[a]:.6f}\n" for a, at in zip("xyz", first_um, strict=True) if sides[a])
    return f"ImageJ=1.54f\n{stack}unit=um\n{spacing}{zero}loop=false\nmin={low}\nmax={high}\n"


def _read_tiff(path: Path) -> tuple[np.ndarray, Grid]:
    with open_tiff(check_input(path), "OME-TIFF") as tiff:
        with decoding(path, "OME-TIFF"):
            pages = [page.aspage() for page in tiff.file.pages]
            kinds = {(tuple(page.shape), page.dtype) for page in pages}
            root = ElementTree.fromstring(tiff.first.description)
        if len(kinds) != 1:
            raise input_error("pages", "of one size and type", f"{len(kinds)} sizes or types", path)
        size, dtype = kinds.pop()
        shape = (len(pages), *size)
        _check_declared(path, shape, np.dtype(dtype))
        grid = _grid_of_ome(path, root, (len(pages), size[0], size[1]))
        voxels = np.empty(shape, np.float32)
        for index, image in enumerate(tiff.stack.images):
            file, page = tiff.at(image, index)
            voxels[index] = decode_page(path, pages[page] if file is tiff else file.file.pages[page].aspage())
    return voxels, grid


def _grid_of_ome(path: Path, root: ElementTree.Element, shape: tuple[int, int, int]) -> Grid:
    images = root.findall("{*}Image/{*}Pixels")
    if len(images) != 1:
        raise input_error("OME-XML", "of one image", f"{len(images)} images", path)
    pixels = images[0]
    sizes = tuple(pixels.get(f"Size{axis}") for axis in "TCZYX")
    if sizes != ("1", "1", *(str(n) for n in shape)):
        raise input_error("OME sizes (T, C, Z, Y, X)", (1, 1, *shape), sizes, path)
    planes = {plane.get("TheZ"): plane for plane in pixels.findall("{*}Plane")}
    for index in range(shape[0]):
        if str(index) not in planes:
            raise InputError(f"{path}: no `PositionZ` of plane {index + 1}; a depth for each plane is needed.")
    ordered = [planes[str(index)] for index in range(shape[0])]
    depths = [ome_length(path, plane, "PositionZ", "reference frame") for plane in ordered]
    pitches = [ome_length(path, pixels, f"PhysicalSize{axis}", "µm") for axis in "YX"]
    placed = all(ordered[0].get(f"Position{axis}") is not None for axis in "YX")
    first = [ome_length(path, ordered[0], f"Position{axis}", "reference frame") for axis in "YX"] if placed else None
    return checked_grid(path, depths, shape[1:], pitches, first)


def ome_length(path: Path, element: ElementTree.Element, name: str, default_unit: str) -> float:
    """An attribute of OME-XML in mm; `default_unit` is the schema's, where the attribute `...Unit` is missing."""
    text, unit = element.get(name), element.get(f"{name}Unit", default_unit)
    try:
        return _mm(float(text or ""), mm_per(unit))
    except (ValueError, KeyError) as error:
        given = "nothing" if text is None else f"{short_repr(text)} in {short_repr(unit)}"
        raise input_error(f"OME-XML `{name}`", "a length in µm", given, path) from error


# OME-Zarr


def _write_zarr(path: Path, voxels: np.ndarray, depths: list[float], grid: Grid, provenance: Provenance) -> None:
    with needs_extra("zarr"):
        import zarr  # 0.15 s that TIFF does not need

    attributes = image_attributes(path, depths, grid, 1, voxels, provenance)
    with atomic_write(path) as temporary:
        group = zarr.create_group(store=temporary, zarr_format=2, attributes=attributes)
        array = group.create_array("0", shape=voxels.shape, dtype=voxels.dtype, **plane_chunks(voxels.shape))
        array[...] = voxels


def _read_zarr(path: Path) -> tuple[np.ndarray, Grid]:
    with needs_extra("zarr"):
        import zarr

    if not os.path.exists(path):
        raise InputError(f"{path}: cannot be read: no such folder.")
    if not os.path.isdir(path):
        raise input_error("volume", "a Zarr folder", "a file", path)
    with decoding(path, "OME-Zarr"):
        group = zarr.open_group(path, mode="r")
        attributes = group.attrs.asdict()
    name, scale, first = _parse_multiscales(path, attributes)
    with decoding(path, "OME-Zarr"):
        array = group[name]
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: no array {short_repr(name)}, which the metadata names.")
    _check_declared(path, array.shape, array.dtype)
    depths, rows, columns = array.shape
    z = [_mm(first[0] + index * scale[0], 1.0) for index in range(depths)]
    grid = checked_grid(path, z, (rows, columns), scale[1:], first[1:])
    with decoding(path, "OME-Zarr"):
        return np.asarray(array[...], dtype=np.float32), grid


def _parse_multiscales(path: Path, attributes: dict[str, Any]) -> tuple[str, list[float], list[float]]:
    """Name of the full-size array, scale and translation `(z, y, x)` in mm, of NGFF 0.4, or 0.5 (in `ome`)."""
    try:
        (multiscale,) = attributes.get("ome", attributes)["multiscales"]
        axes = [(axis["name"], mm_per(axis["unit"])) for axis in multiscale["axes"]]
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
        raise input_error("`multiscales`", allowed, f"{error!r:.80}", path) from error


class _Format(NamedTuple):
    """How a volume is read, and how float32 voxels are written with their depths (mm) and grid."""

    read: Callable[[Path], tuple[np.ndarray, Grid]]
    write: Callable[[Path, np.ndarray, list[float], Grid, Provenance], None]


_TIFF, _ZARR = _Format(_read_tiff, _write_tiff), _Format(_read_zarr, _write_zarr)
_FORMATS = {**dict.fromkeys(TIFF_SUFFIXES, _TIFF), ".zarr": _ZARR}
VOLUME_SUFFIXES = tuple(_FORMATS)
