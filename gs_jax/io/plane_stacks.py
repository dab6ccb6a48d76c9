"""Stacks of planes: measured PSFs, read from pages and files, and volumes of which not all lengths are known."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Float32

from ..base.errors import InputWarning, input_error
from ..grid import Grid
from .camera import Corrected, Correction, Prepared, Readout, prepare, read_frame
from .captures import GreyError, Selection, read_images
from .files import atomic_write, check_output
from .names import natural_order
from .ngff import title, um
from .provenance import NAMESPACE, Provenance, write_sidecar
from .recordings import Recording, open_recording
from .volumes import VOLUME_SUFFIXES, write_volume

STACK_SUFFIXES = (*VOLUME_SUFFIXES, ".npy")


def read_spots(
    paths: Sequence[Path],
    *,
    page: int | str | None = None,
    readout: Readout = Readout(),
    correction: Correction = Correction(),
) -> Iterator[tuple[Path, Corrected]]:
    """Read and correct images of a point, and yield each with its file.

    Parameters
    ----------
    paths
        TIFF, PNG or .npy, each with a page or several; folders or patterns of such files; Zarr arrays (z, y, x).
    page
        None: a plane for each page. A page, or "mean" of all: a plane for each file.
    readout, correction
        As for `read_corrected`. With `bad_pixels="auto"` no pixel is taken for a hot one: a spot may be as sharp. A
        channel is selected of images in colour alone.

    Raises
    ------
    InputError
        As `open_recording` and `read_corrected`.
    """
    if correction.bad_pixels == "auto":
        correction = correction._replace(bad_pixels="none")
    wanted = Selection(None, page, readout.channel, readout.bayer)
    prepared = {}
    for path in paths:
        with open_recording(path, page=page, axes="tz") as several:
            stack = several or Recording([path.name], lambda _, wanted, path=path: read_images(path, wanted), [path])
            for plane, name in enumerate(stack.names):
                selected = readout
                try:
                    images = list(stack.images(plane, wanted))
                except GreyError:
                    selected = readout._replace(channel=None)
                    images = list(stack.images(plane, wanted._replace(channel=None)))
                shape = images[0].shape
                if (key := (shape, selected)) not in prepared:
                    prepared[key] = _prepare(shape, selected, correction)
                yield path, read_frame(name, iter(images), prepared[key], selected)


def spot_names(paths: Sequence[Path], page: int | str | None = None) -> list[str]:
    """Names of the images of `read_spots`, in their order; warns where files are in the order of texts, not numbers.

    Raises `InputError` as `open_recording`.
    """
    names = [path.name for path in paths]
    if names == sorted(names) and names != (ordered := natural_order(names)):
        text = f"{names[0]} to {names[-1]} are taken in this order; by their numbers {ordered[0]} is the first"
        warnings.warn(
            InputWarning(f"{text}, and {ordered[-1]} the last: give their folder to sort them so."), stacklevel=2
        )
    names = []
    for path in paths:
        with open_recording(path, page=page, axes="tz") as several:
            names += several.names if several else [path.name]
    return names


def _prepare(size: tuple[int, int], readout: Readout, correction: Correction) -> Prepared:
    rows, columns = (n // 2 for n in size) if readout.bayer else size
    return prepare((rows, columns), size, readout, correction)


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
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.save(file, planes, allow_pickle=False)
        write_sidecar(path, provenance)
    elif depths is not None and pitch is not None:
        write_volume(path, planes, Grid(depths, planes.shape[1:], pitch), provenance)
    elif suffix == ".zarr":
        raise input_error("--depths and --voxel-um", "given for OME-Zarr, which has all lengths", "not both", path)
    else:
        metadata: dict[str, Any] = {"axes": "ZYX", "Name": title(path)}
        if depths is not None:
            metadata["Plane"] = {"PositionZ": [um(z) for z in depths], "PositionZUnit": ["µm"] * len(planes)}
        if pitch is not None:
            metadata |= {f"PhysicalSize{axis}": um(pitch) for axis in "XY"}
            metadata |= {f"PhysicalSize{axis}Unit": "µm" for axis in "XY"}
        if provenance:
            metadata["MapAnnotation"] = {"Namespace": NAMESPACE, **provenance}
        with atomic_write(path) as temporary:
            tifffile.imwrite(temporary, planes, ome=True, photometric="minisblack", metadata=metadata)
