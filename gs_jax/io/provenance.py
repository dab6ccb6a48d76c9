"""Provenance of files: the command that made a file, its input files, and the design.

It is a table of texts, kept where the format has a place for it: a structured annotation of OME-TIFF, attributes of
OME-Zarr, metadata of 3MF, weights and captures, a table of designs. Files without such a place (CSV, .npy, drawings)
have a file beside them, named theirs plus `.json`; STL has the report of the mold.
"""

import hashlib
import json
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import equinox as eqx
import jax
import numpy as np
import tifffile
from PIL import Image

from .._version import __version__
from ..base.errors import input_error, needs_extra
from ..base.typing import PathLike
from ..microscope.grid import Grid
from .files import TIFF_SUFFIXES, check_input, check_suffix, decoding, read_text, side_file, write_json
from .names import plain_text
from .remote import remote_url, without_queries

Provenance = Mapping[str, str]

# Namespace of annotations, and key of the table among others.
NAMESPACE, KEY = "gs_jax/provenance", "provenance"
# Key of a volume's cross-validation in words, which a report shows beside the volume.
SCORE = "score"
# Key that says of which volume a file has the standard deviations.
DEVIATION = "standard deviation"
# What the intensities of points in a capture are.
INTENSITY = {"intensity": "all light that the point emits, in counts of the capture"}


def made_by(command: str, inputs: Iterable[PathLike] = (), design: str = "") -> dict[str, str]:
    """Provenance of what `command` makes of input files, with their SHA-256, and of the text of a design."""
    table = {"software": f"gs_jax {__version__}", "command": plain_text(without_queries(command))}
    for path in map(Path, inputs):
        if path.is_file():
            with path.open("rb") as file:
                table[input_key(path)] = f"sha256 {hashlib.file_digest(file, 'sha256').hexdigest()}"
        else:
            table[input_key(path)] = without_queries(remote_url(path) or "a folder")
    return table | ({"design": design} if design else {})


def annotation(provenance: Provenance | None) -> dict[str, Any]:
    """Provenance as a structured annotation in the metadata that `tifffile` writes as OME-XML."""
    return {"MapAnnotation": {"Namespace": NAMESPACE, **provenance}} if provenance else {}


def input_key(path: Path) -> str:
    """The key under which provenance has an input file."""
    name = Path(without_queries(remote_url(path) or "")).name or path.name
    return f"input {plain_text(name)}"


def sidecar(path: PathLike) -> Path:
    """The file beside one that has no place for its provenance."""
    return side_file(path, ".json")


def write_sidecar(path: PathLike, provenance: Provenance | None) -> None:
    """Write the file beside `path`, or remove an old one, which would now be wrong."""
    if provenance is not None:
        write_json(sidecar(path), {KEY: dict(provenance)})
    elif sidecar(path).exists() and _from_json(sidecar(path)):
        sidecar(path).unlink()


def read_provenance(path: PathLike) -> dict[str, str]:
    """Read the provenance of a file; empty if it has none.

    Raises `InputError` if it cannot be read, or is of no format that `gs_jax` writes.
    """
    suffix = check_suffix(path, tuple(_READERS))
    if suffix != ".zarr":
        check_input(path)
    with decoding(path, f"{suffix} file"):
        table = _READERS[suffix](Path(path))
        texts = (value if isinstance(value, str) else json.dumps(value, ensure_ascii=False) for value in table.values())
        return dict(zip(map(str, table), texts, strict=True))


def _from_json(path: Path) -> dict:
    data = json.loads(read_text(path))
    return data.get(KEY, {}) if isinstance(data, dict) else {}


def _from_sidecar(path: Path) -> dict:
    # The second name is that of older versions.
    names = [sidecar(path), *([path.with_suffix(".json")] if path.suffix.lower() == ".stl" else ())]
    return next((table for name in names if name.exists() and (table := _from_json(name))), {})


def _from_tiff(path: Path) -> dict:
    with tifffile.TiffFile(path, is_ome=False) as tiff:
        text = tiff.pages.first.description
    if text.startswith("{"):
        return json.loads(text).get(KEY, {})
    if not text.startswith(("<?xml", "<OME")):
        return {}
    annotations = ElementTree.fromstring(text).iterfind("{*}StructuredAnnotations/{*}MapAnnotation")
    ours = [annotation for annotation in annotations if annotation.get("Namespace") == NAMESPACE]
    return {pair.get("K", ""): pair.text or "" for own in ours for pair in own.iterfind("{*}Value/{*}M")}


def _from_png(path: Path) -> dict:
    with Image.open(path, formats=["PNG"]) as image:
        return json.loads(getattr(image, "text", {}).get(KEY, "{}"))


def _from_zarr(path: Path) -> dict:
    if (path / "zarr.json").exists():
        return json.loads(read_text(path / "zarr.json")).get("attributes", {}).get(KEY, {})
    return _from_json(path / ".zattrs") if (path / ".zattrs").exists() else {}


def _from_weights(path: Path) -> dict:
    with np.load(path, allow_pickle=False) as archive:
        return json.loads(str(archive[KEY])) if KEY in archive else {}


def _from_3mf(path: Path) -> dict:
    with zipfile.ZipFile(path) as archive, archive.open("3D/3dmodel.model") as file:
        for _, element in ElementTree.iterparse(file):
            if element.tag.endswith("}metadata") and element.get("name", "").endswith(f":{KEY}"):
                return json.loads(element.text or "{}")
            if element.tag.endswith("}resources"):
                break
    return {}


def _from_hdf5(path: Path) -> dict:
    with needs_extra("hdf5"):
        import h5py
    with h5py.File(path) as file:
        return json.loads(str(file.attrs.get(KEY, "{}")))


_READERS: dict[str, Callable[[Path], dict]] = {
    **dict.fromkeys(TIFF_SUFFIXES, _from_tiff),
    ".png": _from_png,
    ".zarr": _from_zarr,
    ".toml": lambda path: tomllib.loads(read_text(path)).get(KEY, {}),
    ".npz": _from_weights,
    ".3mf": _from_3mf,
    ".json": _from_json,
    ".h5": _from_hdf5,
    **dict.fromkeys((".npy", ".csv", ".stl", ".dxf", ".svg", ".gds", ".xyz", ".dat", ".ply"), _from_sidecar),
}


# Keys of provenance; the second is also a column of points.
FRAME, SURFACE = "depths_from", "sample_surface_mm"


class DepthFrame(NamedTuple):
    """What the depths of an output count from: the array (None), or a surface at a depth, mm."""

    surface: float | None = None

    @property
    def note(self) -> dict[str, str]:
        """What provenance says of it."""
        return {FRAME: "array"} if self.surface is None else {FRAME: "sample", SURFACE: f"{self.surface:.9g}"}

    def grid(self, grid: Grid) -> Grid:
        """The grid of an output, from one with depths from the array."""
        if self.surface is None:
            return grid
        # Not `at`: at the surface a depth is 0.
        depths = np.asarray(moved(grid.depths, -self.surface), grid.depths.dtype)
        return eqx.tree_at(lambda g: g.depths, grid, jax.device_put(depths))

    def columns(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Columns of points in single precision, nine digits, from those with depths from the array."""
        if self.surface is not None:
            depths = moved(columns["z_mm"], -self.surface)
            columns = {**columns, "z_mm": depths, SURFACE: np.full(len(depths), self.surface)}
        return {name: _single(values) for name, values in columns.items()}

    def points(self, points: Any, more: Mapping[str, Any] | None) -> tuple[Any, Mapping[str, Any]]:
        """Points and their further columns in single precision, from points with depths from the array."""
        columns = self.columns({"z_mm": np.asarray(points)[:, 2]} | dict(more or {}))
        rows = np.array(points, np.float32)
        rows[:, 2] = columns.pop("z_mm")
        return rows, columns


def _single(values: Any) -> np.ndarray:
    values = np.asarray(values)
    return values.astype(np.float32) if values.dtype.kind == "f" else values


def moved(depths: Any, by: float) -> np.ndarray:
    """Depths to a nanometre, which float32's digits do not show."""
    return np.round(np.asarray(depths, float) + by, 6)


def frame_of(path: PathLike) -> str | None:
    """What the depths of a volume or of points count from, "array" or "sample"; None if it does not say."""
    if Path(path).suffix.lower() == ".csv":
        with open(path, "rb") as file:
            if SURFACE.encode() in file.readline(1000):
                return "sample"
    return read_provenance(path).get(FRAME)


def surface_of(path: PathLike) -> float:
    """Depth from which those of a volume count, mm; 0 from the array."""
    provenance = read_provenance(path)
    if provenance.get(FRAME) != "sample":
        return 0.0
    try:
        return float(provenance[SURFACE])
    except (KeyError, ValueError) as error:
        raise input_error(SURFACE, "a number of mm", provenance.get(SURFACE, "nothing"), path) from error
