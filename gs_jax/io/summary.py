"""What an image file of another program holds, and what commands take it for."""

from pathlib import Path

import numpy as np
import tifffile

from ..base.errors import InputError
from .axes import stack_axis
from .captures import CAPTURE_SUFFIXES, read_images, size_text
from .files import TIFF_SUFFIXES, decoding
from .tiff import open_tiff


def summarise(path: Path) -> dict[str, str]:
    """Size, type, axes and use of a TIFF, a PNG or an .npy, from its header and its first page; empty for other files.

    Raises `InputError` if the file cannot be read as what its suffix says.
    """
    suffix = path.suffix.lower()
    if suffix not in CAPTURE_SUFFIXES:
        return {}
    lines = _of_tiff(path) if suffix in TIFF_SUFFIXES else _of_npy(path) if suffix == ".npy" else {}
    try:
        image = next(read_images(path))
        use = "a capture, or a PSF for `gs-jax deconvolve`"
        lines = {"pixels": size_text(image.shape), "type": image.dtype.name} | lines
    except InputError as error:
        use = str(error).removeprefix(f"{path}: ").removesuffix(f" ({path}).").rstrip(".")
        if int(lines.get("pages", "1")) > 1 and _is_stack(path):
            use = f"a recording, a stack of PSFs for `gs-jax deconvolve`, or a capture ({use})"
    return lines | {"use": use}


def _is_stack(path):
    """Whether the images of a file follow each other, as frames or as planes."""
    if path.suffix.lower() not in TIFF_SUFFIXES:
        return True
    with open_tiff(path) as opened:
        return stack_axis(opened.stack.axes, "tz") is not None


def _of_tiff(path):
    with open_tiff(path) as opened, decoding(path, "TIFF"), tifffile.TiffFile(path) as file:
        series, page = file.series[0], opened.first
        return {
            "pixels": size_text(page.shape[:2] if page.planarconfig == 1 else page.shape[-2:]),
            "type": str(page.dtype),
            "pages": str(opened.count),
            "axes": f"{series.axes}, {size_text(series.shape)}",
            "colours": tifffile.PHOTOMETRIC(page.photometric).name.lower(),
            "compression": tifffile.COMPRESSION(page.compression).name.lower(),
        }


def _of_npy(path):
    with decoding(path, ".npy of numbers"):
        pixels = np.lib.format.open_memmap(path, mode="r")
    pages = str(pixels.shape[0]) if pixels.ndim == 3 else "1"
    return {"pixels": size_text(pixels.shape[-2:]), "type": pixels.dtype.name, "pages": pages}
