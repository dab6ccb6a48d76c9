"""Tables of traces, a row for each region and frame: CSV, or HDF5 with a data set for each column.

Also label images, and tables of tracks.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from jaxtyping import Float64, Int, Shaped

from ..base.errors import InputError, input_error, needs_extra, short_repr
from ..base.typing import PathLike
from .files import TIFF_SUFFIXES, atomic_write, check_input, check_output, check_suffix, decoding
from .ngff import import_zarr
from .point_tables import read_point_columns, write_rows
from .provenance import KEY, Provenance
from .recordings import zarr_image

TRACE_SUFFIXES = (".csv", ".h5")
# Columns that every table of traces has.
_NEEDED = ("region", "frame", "x_mm", "y_mm", "z_mm", "dff")
# First columns of a table of tracks, and what the names of this and of its picture add to that of the points.
TRACKS_HEADER, TRACKS_SUFFIXES = "particle,points,first_frame,last_frame", (".tracks.csv", ".tracks.png")
# F, of which a table has one or more.
SIGNALS = ("demixed", "intensity", "mean")

Columns = Mapping[str, Shaped[np.ndarray, " row"]]


def import_h5py() -> Any:
    """The package h5py, which CSV does not need; `InputError` if it is not installed."""
    with needs_extra("hdf5"):
        import h5py
    return h5py


def write_traces(path: PathLike, columns: Columns, provenance: Provenance | None = None) -> None:
    """Write columns of one length; `InputError` as `check_output`."""
    if check_output(path, TRACE_SUFFIXES).suffix.lower() == ".csv":
        write_rows(path, columns, zip(*columns.values(), strict=True), provenance)
        return
    h5py = import_h5py()
    with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs[KEY] = json.dumps(dict(provenance or {}))
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip", shuffle=True)


def read_traces(path: PathLike) -> dict[str, np.ndarray]:
    """Read what `write_traces` wrote; `InputError` if it is anything else."""
    suffix, path = check_suffix(path, TRACE_SUFFIXES), check_input(path)
    h5py = import_h5py() if suffix == ".h5" else None
    with decoding(path, "table of traces"):
        if h5py:
            with h5py.File(path) as file:
                columns = {name: np.asarray(file[name]) for name in file}
        else:
            columns = _read_csv(path)
    _check_columns(path, "table of `gs-jax traces`", columns, _NEEDED)
    if len({values.shape for values in columns.values()}) > 1 or columns["dff"].ndim != 1 or not len(columns["dff"]):
        raise InputError(f"{path}: must be a table of `gs-jax traces`, with rows, and columns of one length.")
    if not np.isfinite(columns["dff"]).any() and not any(name in columns for name in SIGNALS):
        raise InputError(f"{path}: must be a table of `gs-jax traces`, got no signal: dff is nan in all rows.")
    return {name: values.astype(int) if name in _NEEDED[:2] else values for name, values in columns.items()}


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    """Columns by name, which may have NaN."""
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=float, ndmin=1, encoding="utf-8-sig")
    return {name: rows[name] for name in rows.dtype.names or ()}


def _check_columns(path: Path, kind: str, columns: Iterable[str], needed: Iterable[str]) -> None:
    if missing := [name for name in needed if name not in columns]:
        raise InputError(f"{path}: must be a {kind}, got no column {missing[0]}.")


class Tracks(NamedTuple):
    """Points of particles in frames, columns of the tracks that they belong to, and seconds between frames if known."""

    points: Float64[np.ndarray, "point 4"]
    frames: Int[np.ndarray, " point"]
    particles: Int[np.ndarray, " point"]
    columns: dict[str, Float64[np.ndarray, " point"]]
    interval: float | None


def read_tracks(path: Path) -> Tracks:
    """Read POINTS.csv.tracks.csv of `gs-jax reconstruct --track`, and POINTS.csv beside it.

    Raises `InputError` if one of them cannot be read, is another table, or lacks particles of the other.
    """
    suffix, header = TRACKS_SUFFIXES[0], TRACKS_HEADER.split(",")
    if (name := path.name.removesuffix(suffix)) in ("", path.name):
        raise input_error("table of tracks", f"named POINTS.csv{suffix}", short_repr(path.name))
    with decoding(check_input(path), "table of tracks"):
        table = _read_csv(path)
    _check_columns(path, "table of tracks", table, header)
    # A spreadsheet may have sorted them otherwise.
    order = np.argsort(table["particle"])
    table = {name: values[order] for name, values in table.items()}
    number, points, first, last = (table.pop(name) for name in header)
    beside = path.with_name(name)
    places, more = read_point_columns(beside)
    _check_columns(beside, "table of points by `gs-jax reconstruct --track`", more, ("frame", "particle"))
    frames, particles = (more[name].astype(int) for name in ("frame", "particle"))
    found, owner, counts = np.unique(particles, return_inverse=True, return_counts=True)
    if not len(found) or not (np.array_equal(found, number) and np.array_equal(counts, points)):
        raise InputError(f"{path}: must have the particles of {beside.name}, and there must be some.")
    lasting, duration = last > first, table.get("duration_s")
    interval = None
    if duration is not None and lasting.any():
        interval = float(np.median((duration / np.maximum(last - first, 1))[lasting]))
    return Tracks(places, frames, particles, {name: values[owner] for name, values in table.items()}, interval)


def read_labels(path: Path, shape: tuple[int, int, int]) -> Int[np.ndarray, "depth y x"]:
    """Read a label image of a volume's shape, or of a plane's, which then holds for all planes.

    It is a TIFF, as napari saves Labels and Fiji its ROIs as a mask of counts, or the array of labels in Zarr, such as
    `volumes.zarr/labels/cells`. Axes of length 1 before the others are left out.

    Raises `InputError` if it cannot be read, is of another shape, holds no whole numbers of 0 or more, or is empty.
    """
    if path.suffix.lower() in TIFF_SUFFIXES:
        path = check_input(path)
        with decoding(path, "TIFF"):
            labels = tifffile.imread(path)
    elif path.is_dir():
        zarr = import_zarr()
        with decoding(path, "Zarr store"):
            store = zarr.open(path, mode="r")
            array = store if isinstance(store, zarr.Array) else zarr_image(store)
            labels = None if array is None else np.asarray(array[...])
        if labels is None:
            raise InputError(f"{path}: no image; must be a Zarr array of labels, or OME-Zarr of one image.")
    else:
        raise input_error("labels", "a TIFF or a Zarr folder", short_repr(path.name))
    while labels.ndim > 2 and labels.shape[0] == 1 and labels.shape != shape:
        labels = labels[0]
    if labels.shape not in (shape, shape[1:]):
        raise input_error("labels", f"of the volume's shape {shape}, or {shape[1:]}", labels.shape, path)
    if labels.dtype.kind not in "biu" or labels.min() < 0:
        raise input_error("labels", "whole numbers of 0 or more", f"{labels.dtype}, from {labels.min():g}", path)
    if not labels.any():
        raise input_error("labels", "above 0 in the regions", "0 everywhere", path)
    if (most := int(labels.max())) > np.iinfo(np.int32).max:
        raise input_error("labels", f"at most {np.iinfo(np.int32).max}", most, path)
    return np.array(np.broadcast_to(labels, shape), np.int32)
