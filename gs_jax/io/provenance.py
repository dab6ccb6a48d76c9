"""Where a file comes from: the command that made it, of which files, with which design.

It is a table of texts, which every format has a place for: OME-TIFF as a structured annotation, OME-Zarr among its
attributes, 3MF as metadata, weights and captures with what else they say of themselves, designs as a table of their
own. Files without such a place (CSV, .npy, drawings) have a file beside them, whose name is theirs with `.json` after
it; STL has the mold's report.
"""

import hashlib
import json
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import tifffile
from PIL import Image

from .._version import __version__
from ..base.errors import InputError, short_repr
from ..typing import PathLike
from .files import check_input, decoding, read_text, write_json

Provenance = Mapping[str, str]

# Of the annotation and the metadata, and the key of the table where it is one of several.
NAMESPACE, KEY = "gs_jax/provenance", "provenance"


def made_by(command: str, inputs: Iterable[PathLike] = (), design: str = "") -> dict[str, str]:
    """Of what `command` makes of files, with their SHA-256; `design` is the text of the microscope's."""
    found = {"software": f"gs_jax {__version__}", "command": command}
    for path in map(Path, inputs):
        if path.is_file():  # an image in Zarr is many files
            with path.open("rb") as file:
                found[f"input {path.name}"] = f"sha256 {hashlib.file_digest(file, 'sha256').hexdigest()}"
        else:
            found[f"input {path.name}"] = "a folder"
    return found | ({"design": design} if design else {})


def sidecar(path: PathLike) -> Path:
    """The file beside one that has no place for its provenance."""
    return Path(f"{path}.json")


def write_sidecar(path: PathLike, provenance: Provenance | None) -> None:
    """Writes it, or removes an old one that would now be wrong."""
    if provenance is not None:
        write_json(sidecar(path), {KEY: dict(provenance)})
    elif sidecar(path).exists() and _in_json(sidecar(path)):
        sidecar(path).unlink()


def read_provenance(path: PathLike) -> dict[str, str]:
    """What a file says of where it comes from; empty if it says nothing.

    Raises
    ------
    InputError
        If it cannot be read, or is of no kind that `gs_jax` writes.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise InputError(f"{path}: found the suffix {short_repr(path.suffix)}, allowed: {', '.join(_READERS)}.")
    if suffix != ".zarr":
        check_input(path)
    with decoding(path, f"{suffix} file"):
        found = _READERS[suffix](path)
        return {str(key): _text(value) for key, value in found.items()}


def _text(value) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _in_json(path: Path) -> dict:
    data = json.loads(read_text(path))
    return data.get(KEY, {}) if isinstance(data, dict) else {}


def _beside(path: Path) -> dict:
    return _in_json(sidecar(path)) if sidecar(path).exists() else {}


def _in_report(path: Path) -> dict:
    report = path.with_suffix(".json")
    return _in_json(report) if report.exists() else {}


def _in_tiff(path: Path) -> dict:
    with tifffile.TiffFile(path, is_ome=False) as tiff:
        text = tiff.pages.first.description
    if text.startswith("{"):
        return json.loads(text).get(KEY, {})
    if not text.startswith(("<?xml", "<OME")):
        return {}
    annotations = ElementTree.fromstring(text).iterfind("{*}StructuredAnnotations/{*}MapAnnotation")
    ours = [each for each in annotations if each.get("Namespace") == NAMESPACE]
    return {pair.get("K", ""): pair.text or "" for each in ours for pair in each.iterfind("{*}Value/{*}M")}


def _in_png(path: Path) -> dict:
    with Image.open(path, formats=["PNG"]) as image:
        return json.loads(getattr(image, "text", {}).get(KEY, "{}"))


def _in_zarr(path: Path) -> dict:
    if (path / "zarr.json").exists():
        return json.loads(read_text(path / "zarr.json")).get("attributes", {}).get(KEY, {})
    place = path / ".zattrs"
    return _in_json(place) if place.exists() else {}


def _in_weights(path: Path) -> dict:
    with np.load(path, allow_pickle=False) as archive:
        return json.loads(str(archive[KEY])) if KEY in archive else {}


def _in_design(path: Path) -> dict:
    return tomllib.loads(read_text(path)).get(KEY, {})


def _in_3mf(path: Path) -> dict:
    with zipfile.ZipFile(path) as archive, archive.open("3D/3dmodel.model") as file:
        for _, element in ElementTree.iterparse(file):
            name = element.get("name", "")
            if element.tag.endswith("}metadata") and name.endswith(f":{KEY}"):
                return json.loads(element.text or "{}")
            if element.tag.endswith("}resources"):
                break
    return {}


# Of every format that is written.
_READERS: dict[str, Callable[[Path], dict]] = {
    ".tif": _in_tiff,
    ".tiff": _in_tiff,
    ".png": _in_png,
    ".npy": _beside,
    ".zarr": _in_zarr,
    ".csv": _beside,
    ".dxf": _beside,
    ".svg": _beside,
    ".gds": _beside,
    ".toml": _in_design,
    ".npz": _in_weights,
    ".3mf": _in_3mf,
    ".stl": _in_report,
    ".json": _in_json,
}
