"""Reads and writes volumes and planes as OME-TIFF or, when the name ends in `.zarr`, as OME-Zarr; sheets as OME-TIFF.

All hold float32 values `[depth, row, column]` as they are, the grid in micrometres (lateral pitch, every depth, centre
of the first voxel), so that Fiji and napari show the volume to scale and in place, and a display range.

The OME-TIFF of a volume has ImageJ's description after OME's: readers of TIFF take the first, ImageJ without
Bio-Formats the last.

OME-Zarr is written in version 0.4 (Zarr 2), which every reader of Fiji and napari knows, rather than 0.5 (Zarr 3);
both are read. Chunks are one plane deep, as viewers ask for planes, and compressed with Blosc (LZ4), the default of
bioformats2raw and ome-zarr-py.
"""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile
from jaxtyping import Array, Float32, Int, Shaped

from ..base.arrays import host_code
from ..base.errors import InputError, input_error, short_repr
from ..base.typing import PathLike, Volume
from ..microscope.grid import Grid
from .captures import write_npy
from .files import TIFF_SUFFIXES, atomic_write, check_input, check_output, check_suffix, decoding
from .meshes import Maps, as_ply, surface_mesh
from .names import mm_per
from .ngff import (
    display_range,
    first_um,
    image_attributes,
    ngff_attributes,
    plain_depths,
    plane_chunks,
    title,
    um,
)
from .provenance import DEVIATION, Provenance, annotation, moved, read_provenance, surface_of, write_sidecar
from .remote import import_zarr, open_store, remote_url
from .tiff import decode_page, decode_plane, open_tiff

VOLUME_SUFFIXES = (*TIFF_SUFFIXES, ".zarr")
STACK_SUFFIXES = (*VOLUME_SUFFIXES, ".npy")
SURFACE_SUFFIXES = (*TIFF_SUFFIXES, ".ply")
MAX_VOXELS = 10**10
# Tags of TIFF: a description, and the tag after it, in whose place a second description is written.
_DESCRIPTION, _AFTER = 270, 271
# Channels of a sheet.
_CHANNELS = ("brightness", "depth_um", "sd_um")


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
    >>> gs.write_volume("volume.ome.tif", np.zeros(grid.volume_shape, np.float32), grid)
    """
    path = check_output(path, VOLUME_SUFFIXES)
    voxels = _as_float32(path, np.asarray(volume))
    if voxels.shape != grid.volume_shape:
        raise ValueError(f"`volume` must have the grid's shape {grid.volume_shape}, got {voxels.shape}.")
    if not np.isfinite(voxels).all():
        raise ValueError("`volume` must be finite, got a NaN or an infinity.")
    if path.suffix.lower() == ".zarr":
        _write_zarr(path, voxels, grid, provenance)
    else:
        _write_ome(path, voxels, "ZYX", provenance, **_known(grid), for_imagej=True)


def write_channels(
    path: PathLike,
    volumes: dict[str, Volume],
    wavelengths: Sequence[float],
    grid: Grid,
    provenance: Provenance | None = None,
) -> None:
    """Write the volumes of channels by their names as one image `(c, z, y, x)`; as `write_volume`.

    `wavelengths` are theirs, nm, which OME-TIFF has.
    """
    path, voxels, names = check_output(path, VOLUME_SUFFIXES), np.stack(list(volumes.values())), list(volumes)
    if path.suffix.lower() == ".zarr":
        _write_zarr(path, voxels, grid, provenance, names)
    else:
        _write_ome(path, voxels, "CZYX", provenance, **_known(grid), channels=names, wavelengths=wavelengths)


def _known(grid: Grid) -> dict[str, Any]:
    return {"depths": plain_depths(grid), "pitch": grid.pitch, "first": first_um(grid)}


def _write_zarr(path: Path, voxels: np.ndarray, grid: Grid, provenance: Provenance | None, channels=()) -> None:
    zarr = import_zarr()
    attributes = image_attributes(path, plain_depths(grid), grid, 1, voxels, provenance, channels=channels)
    with atomic_write(path) as temporary:
        group = zarr.create_group(store=temporary, zarr_format=2, attributes=attributes)
        array = group.create_array("0", shape=voxels.shape, dtype=voxels.dtype, **plane_chunks(voxels.shape))
        array[...] = voxels


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
    >>> gs.write_volume("volume.ome.tif", np.zeros(grid.volume_shape, np.float32), grid)
    >>> volume, same = gs.read_volume("volume.ome.tif")
    >>> volume.shape == grid.volume_shape, same.pitch
    (True, 0.1)
    """
    read = _read_zarr if check_suffix(path, VOLUME_SUFFIXES) == ".zarr" else _read_tiff
    voxels, grid = read(Path(path))
    if not np.isfinite(voxels).all():
        raise input_error("voxels", "finite", "a NaN or an infinity", path)
    return voxels, grid


def read_deviation(path: PathLike, grid: Grid) -> Volume:
    """Standard deviations of `gs-jax reconstruct --deviation` of the voxels of a grid.

    Raises `InputError` as `read_volume`, for other volumes, and for another grid.
    """
    values, own = read_volume(path)
    if DEVIATION not in read_provenance(path):
        raise input_error("volume", "the standard deviations of gs-jax reconstruct --deviation", "another volume", path)
    alike = own.volume_shape == grid.volume_shape
    if not (alike and np.allclose(own.depths, grid.depths) and math.isclose(own.pitch, grid.pitch, rel_tol=1e-6)):
        raise input_error("voxels", "those of VOLUME", "those of another grid", path)
    return values


def write_planes(
    path: Path,
    planes: Float32[np.ndarray, "depth row column"],
    depths: Sequence[float] | None = None,
    pitch: float | None = None,
    provenance: Provenance | None = None,
) -> None:
    """Write planes as a volume, with the lengths that are known; whole or not at all.

    Parameters
    ----------
    path
        Ends in `.tif`, `.tiff` (best `.ome.tif`) or `.npy`; or in `.zarr`, if all lengths are known.
    planes
        As they are.
    depths
        Depth of each plane, mm. None: planes have numbers alone.
    pitch
        Lateral pitch of voxels, mm. None: voxels are a pixel wide.
    provenance
        Kept in the file, or beside an .npy.

    Raises
    ------
    InputError
        As `check_output` and `write_volume`, or if a length is missing for Zarr.
    """
    suffix = check_output(path, STACK_SUFFIXES).suffix.lower()
    if suffix == ".npy":
        write_npy(path, planes, provenance)
    elif depths is not None and pitch is not None:
        write_volume(path, planes, Grid(depths, planes.shape[1:], pitch), provenance)
    elif suffix == ".zarr":
        raise input_error("--depths and --voxel-um", "given for OME-Zarr, which has all lengths", "not both", path)
    else:
        _write_ome(path, planes, "ZYX", provenance, depths=depths, pitch=pitch)


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


def _checked_grid(path: Path, depths: list[float], shape: tuple[int, int], pitches, first) -> Grid:
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


def _write_ome(
    path: Path,
    planes: np.ndarray,
    axes: str,
    provenance: Provenance | None,
    *,
    depths: Sequence[float] | None = None,
    pitch: float | None = None,
    first: tuple[float, float] | None = None,
    channels: Sequence[str] = (),
    wavelengths: Sequence[float] = (),
    for_imagej: bool = False,
) -> None:
    """Write planes as OME-TIFF, with the depths and the pitch (mm) and the centre of the first voxel (um) if known.

    `channels` are names along the first of the `axes`, if that is c, and `wavelengths` theirs, nm, if known;
    `for_imagej` adds the description of ImageJ, if all is known.
    """
    count = math.prod(planes.shape[:-2])
    # The mean step of uneven depths serves viewers that know one step only; the planes have exact depths.
    step = float(np.mean(np.abs(np.diff(depths)))) if depths is not None and len(depths) > 1 else 0.0
    sizes = {axis: um(length) for axis, length in (("X", pitch), ("Y", pitch), ("Z", step)) if length}
    at = dict(zip("YX", first or (), strict=False))
    positions = {axis: [at[axis]] * count for axis in "XY" if axis in at}
    positions |= {"Z": list(map(um, depths)) * (count // len(depths))} if depths is not None else {}
    metadata: dict[str, Any] = {"axes": axes, "Name": title(path)}
    metadata |= {f"PhysicalSize{axis}": size for axis, size in sizes.items()}
    metadata |= {f"PhysicalSize{axis}Unit": "µm" for axis in sizes}
    plane = {f"Position{axis}": values for axis, values in positions.items()}
    plane |= {f"Position{axis}Unit": ["µm"] * count for axis in positions}
    channel: dict[str, Any] = {"Name": channels} if channels else {}
    if wavelengths:
        channel |= {"EmissionWavelength": wavelengths, "EmissionWavelengthUnit": ["nm"] * len(wavelengths)}
    metadata |= ({"Plane": plane} if plane else {}) | ({"Channel": channel} if channel else {})
    metadata |= annotation(provenance)
    options: dict[str, Any] = {}
    if for_imagej:
        description = _imagej_description(planes, sizes, {axis: values[0] for axis, values in positions.items()})
        # The unit is in ImageJ's description: TIFF has inches and centimetres only.
        options = {"resolution": (1 / sizes["X"], 1 / sizes["X"]), "resolutionunit": "NONE"}
        options |= {"extratags": [(_AFTER, 2, 0, description, True)]}
    with atomic_write(path) as temporary:
        tifffile.imwrite(temporary, planes, ome=True, photometric="minisblack", metadata=metadata, **options)
        if for_imagej:
            # tifffile writes one description, so the second one has another tag until here.
            with tifffile.TiffFile(temporary) as tiff:
                entry, order = tiff.pages.first.tags[_AFTER].offset, tiff.byteorder
            with temporary.open("r+b") as file:
                file.seek(entry)
                file.write(_DESCRIPTION.to_bytes(2, "little" if order == "<" else "big"))


def _imagej_description(voxels: np.ndarray, sizes: dict[str, float], first: dict[str, float]) -> str:
    """ImageJ's description of a stack, from steps and the centre of the first voxel, um; without a step, of a plane."""
    low, high = display_range(voxels)
    stack = f"images={len(voxels)}\nslices={len(voxels)}\n" if len(voxels) > 1 else ""
    spacing = f"spacing={sizes['Z']}\n" if "Z" in sizes else ""
    # The position of zero, in voxels.
    zero = "".join(f"{axis.lower()}origin={-first[axis] / size:.6f}\n" for axis, size in sizes.items())
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
    depths = [_ome_length(path, planes[str(index)], "PositionZ") for index in range(shape[0])]
    is_centred = any(planes["0"].get(f"Position{axis}") is None for axis in "YX")
    return _lateral_grid(path, depths, shape[1:], pixels, None if is_centred else planes["0"])


def _lateral_grid(path: Path, depths: list[float], shape, pixels: ElementTree.Element, first) -> Grid:
    """Grid of depths (mm), with pitches of OME's `Pixels` and the position of the plane `first`, centred without."""
    pitches = [_ome_length(path, pixels, f"PhysicalSize{axis}") for axis in "YX"]
    at = None if first is None else [_ome_length(path, first, f"Position{axis}") for axis in "YX"]
    return _checked_grid(path, depths, shape, pitches, at)


def _ome_length(path: Path, element: ElementTree.Element, name: str) -> float:
    """A length or a position of OME-XML in mm; without a unit it is in that of the schema."""
    text = element.get(name)
    unit = element.get(f"{name}Unit", "µm" if name.startswith("PhysicalSize") else "reference frame")
    try:
        return _mm(float(text or ""), mm_per(unit))
    except (ValueError, KeyError) as error:
        given = "nothing" if text is None else f"{short_repr(text)} in {short_repr(unit)}"
        raise input_error(f"OME-XML `{name}`", "a length in µm", given, path) from error


def _read_zarr(path: Path) -> tuple[np.ndarray, Grid]:
    zarr, url = import_zarr(), remote_url(path)
    if url is None and not os.path.exists(path):
        raise InputError(f"{path}: cannot be read: no such folder.")
    if url is None and not os.path.isdir(path):
        raise input_error("volume", "a Zarr folder", "a file", path)
    with decoding(url or path, "OME-Zarr"):
        group = open_store(path, group=True)
        attributes = ngff_attributes(group)
    name, scale, first = _parse_multiscales(path, attributes)
    with decoding(path, "OME-Zarr"):
        array = group[name]
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: no array {short_repr(name)}, which the metadata names.")
    _check_declared(path, array.shape, array.dtype)
    depths, rows, columns = array.shape
    z = [_mm(first[0] + index * scale[0], 1.0) for index in range(depths)]
    grid = _checked_grid(path, z, (rows, columns), scale[1:], first[1:])
    with decoding(path, "OME-Zarr"):
        return np.asarray(array[...], dtype=np.float32), grid


def _parse_multiscales(path: Path, attributes: dict[str, Any]) -> tuple[str, list[float], list[float]]:
    """Name of the full-size array, scale and translation `(z, y, x)` in mm, of NGFF 0.4 or 0.5."""
    try:
        (multiscale,) = attributes["multiscales"]
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


def write_labels(
    path: PathLike, labels: Int[np.ndarray, "depth row column"], grid: Grid, provenance: Provenance | None = None
) -> None:
    """Write a label image as OME-TIFF of 16 bits, or of 32 if there are many; `InputError` as `check_output`."""
    path = check_output(path, TIFF_SUFFIXES)
    voxels = labels.astype(np.uint16 if labels.max() < 2**16 else np.uint32)
    _write_ome(path, voxels, "ZYX", provenance, depths=plain_depths(grid), pitch=grid.pitch, first=first_um(grid))


class SurfaceMaps(NamedTuple):
    """Sheets of a file: brightness, depth from the array and its standard deviation, mm, and where the columns are."""

    brightness: Maps
    depth: Maps
    depth_sd: Maps
    grid: Grid


def write_surface(
    path: PathLike,
    brightness: Maps,
    depth: Maps,
    depth_sd: Maps,
    grid: Grid,
    *,
    below: float = 0.0,
    provenance: Provenance | None = None,
) -> None:
    """Writes sheets, whole or not at all.

    Parameters
    ----------
    path
        Ends in `.tif` or `.tiff` (best `.ome.tif`): brightness, depth and its standard deviation, um, as channels of a
        float32 image; NaN where it is dark. Or in `.ply`: a mesh in mm, coloured by brightness.
    brightness, depth, depth_sd
        As in `SurfaceFit`, mm.
    grid
        Positions of the columns.
    below
        Depth from which those of the file count, mm.
    provenance
        Kept in the OME-TIFF, or beside a mesh.

    Raises
    ------
    InputError
        As `check_output`.
    """
    path = check_output(path, SURFACE_SUFFIXES)
    depth = depth - np.float32(below)
    if path.suffix.lower() == ".ply":
        data = as_ply(surface_mesh(brightness, depth, grid))
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
        write_sidecar(path, provenance)
        return
    sheets = range(1, len(depth) + 1)
    names = [f"{what}{f' {n}' if len(sheets) > 1 else ''}" for n in sheets for what in _CHANNELS]
    planes = np.stack([brightness, 1000 * depth, 1000 * depth_sd], 1, dtype=np.float32).reshape(-1, *depth.shape[1:])
    _write_ome(path, planes, "CYX", provenance, pitch=grid.pitch, first=first_um(grid), channels=names)


def read_surface(path: PathLike) -> SurfaceMaps:
    """Read an OME-TIFF of `write_surface`.

    Depths are returned relative to the array, also for files that store them relative to the sample. Raises
    `InputError` if it cannot be read, or holds no sheets.
    """
    check_suffix(path, TIFF_SUFFIXES)
    path = check_input(path)
    with open_tiff(path, "OME-TIFF") as tiff:
        with decoding(path, "OME-TIFF"):
            text = tiff.first.description
            pixels = ElementTree.fromstring(text).find("{*}Image/{*}Pixels") if text.startswith("<?xml") else None
        names = [] if pixels is None else [channel.get("Name", "") for channel in pixels.findall("{*}Channel")]
        planes = [decode_plane(*tiff.at(image, number)) for number, image in enumerate(tiff.stack.images)]
        with decoding(path, "OME-TIFF"):
            maps = np.stack(planes)
    count = len(maps) // len(_CHANNELS)
    kinds = [name.split(" ")[0] for name in names]
    if pixels is None or kinds != [*_CHANNELS] * count or len(kinds) != len(maps) or maps.dtype != np.float32:
        raise input_error("channels", f"{', '.join(_CHANNELS)} of float32, as --surface writes", names or "none", path)
    brightness, depth, sd = maps.reshape(count, len(_CHANNELS), *maps.shape[1:]).swapaxes(0, 1)
    depth = depth / np.float32(1000)
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 1.0
    first = next(pixels.iterfind("{*}Plane"), ElementTree.Element("Plane"))
    grid = _lateral_grid(path, [middle], maps.shape[1:], pixels, first)
    return SurfaceMaps(brightness, depth + np.float32(surface_of(path)), sd / np.float32(1000), grid)
