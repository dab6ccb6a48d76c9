"""Captures in files of other programs: ND2, CZI and LIF by the readers of bioio, and HDF5 by h5py."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, input_error, needs_extra
from .axes import UNNAMED, axis_letter
from .captures import HDF5_SUFFIXES, Selection, Source, check_colour, check_declared, listed
from .files import decoding

# Packages of readers by the suffixes of their files.
_READERS = {".nd2": "bioio_nd2", ".czi": "bioio_czi", ".lif": "bioio_lif"}


@contextlib.contextmanager
def open_vendor(path: Path) -> Iterator[Source]:
    """Open the image of a file; `InputError` if it cannot be read, has several or none, or its reader is missing."""
    with _open_hdf5(path) if path.suffix.lower() in HDF5_SUFFIXES else _open_bioio(path) as source:
        yield source


def _source(path: Path, axes: list[tuple[str, int]], size: tuple[int, ...], dtype: Any, channels, read: Callable):
    """The images of an array whose axes before y and x are these; `read` takes the numbers along them."""

    def read_image(index: int, selection: Selection) -> np.ndarray:
        check_colour(path, None, selection)
        check_declared(path, size, str(dtype), selection)
        place = np.unravel_index(index, [length for _, length in axes] or [1])
        with decoding(path, "file"):
            return np.asarray(read(*map(int, place[: len(axes)])))

    count = int(np.prod([length for _, length in axes]))
    names = [f"{path.name}, image {number}" for number in range(1, count + 1)]
    return Source(axes or [(UNNAMED, 1)], size, names, read_image, [path], list(channels))


@contextlib.contextmanager
def _open_bioio(path: Path) -> Iterator[Source]:
    with needs_extra("bioio"):
        reader = import_module(_READERS[path.suffix.lower()]).Reader
    with decoding(path, f"{path.suffix[1:].upper()} file"):
        image = reader(path)
        scenes, order = list(image.scenes), str(image.dims.order)
        sizes = dict(zip(order, image.dims.shape, strict=True))
        channels, dtype = image.channel_names or [], image.dtype
    _check_one(path, scenes)
    if sizes.get("S", 1) != 1:
        raise input_error("image", "greyscale, one sample a pixel", "colour (RGB)", path)
    names = [name for name in order if name not in "YXS"]

    def read(*place: int):
        return image.get_image_dask_data("YX", **dict(zip(names, place, strict=True))).compute()

    axes = [(name.lower(), sizes[name]) for name in names]
    yield _source(path, axes, (sizes["Y"], sizes["X"]), dtype, channels, read)


@contextlib.contextmanager
def _open_hdf5(path: Path) -> Iterator[Source]:
    with needs_extra("bioio"):
        h5py = import_module("h5py")
    images: dict[str, Any] = {}

    def visit(name: str, found: Any) -> None:
        if isinstance(found, h5py.Dataset) and found.ndim >= 2 and found.dtype.kind in "buif":
            images[name] = found

    with contextlib.ExitStack() as stack:
        with decoding(path, "HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
            file.visititems(visit)
        _check_one(path, list(images))
        (array,) = images.values()
        names = [axis_letter(dimension.label) if dimension.label else UNNAMED for dimension in array.dims]
        if names[-2:] not in (["y", "x"], [UNNAMED] * 2):
            raise input_error("axes", "with y and x as the last", ", ".join(names), path)
        axes = list(zip(names[:-2], array.shape[:-2], strict=True))
        yield _source(path, axes, array.shape[-2:], array.dtype, [], lambda *place: array[place])


def _check_one(path: Path, names: Sequence[str]) -> None:
    if len(names) != 1:
        several = f" ({listed(names)}); save the one that is meant in a file of its own" if names else ""
        raise InputError(f"{path}: must hold one image, got {len(names)}{several}.")
