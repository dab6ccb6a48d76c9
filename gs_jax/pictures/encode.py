"""Pictures and numbers as text that stands in a page."""

import base64
import io

import numpy as np
from jaxtyping import Num, Shaped, UInt8
from matplotlib import colormaps
from PIL import Image


def in_range(values: Num[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Values from `low` to `high` as 0 to 255; what is beyond is cut."""
    width = high - low if high > low else 1.0
    return np.clip((np.asarray(values, np.float32) - low) * (255 / width) + 0.5, 0, 255).astype(np.uint8)


def png(image: UInt8[np.ndarray, "row column"], colours: str = "gray") -> str:
    """An image of 256 colours, by the name of Matplotlib's map, as a data URI; without loss."""
    drawn = Image.fromarray(image, mode="L" if colours == "gray" else "P")
    if colours != "gray":
        drawn.putpalette(palette(colours))
    file = io.BytesIO()
    drawn.save(file, "PNG")
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def palette(colours: str) -> list[int]:
    """Red, green and blue of 256 colours, one after the other."""
    return colormaps[colours](np.arange(256), bytes=True)[:, :3].ravel().tolist()


def packed(numbers: Shaped[np.ndarray, "*shape"]) -> str:
    """The bytes of an array, little-endian, as base64."""
    numbers = np.ascontiguousarray(numbers)
    return base64.b64encode(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes()).decode()


def thinned(image: Num[np.ndarray, "row column"], most: int) -> Num[np.ndarray, "fewer_rows fewer_columns"]:
    """An image of at most `most` pixels a side: means of squares of pixels; rows and columns left over are cut."""
    step = -(-max(image.shape) // most)
    if step == 1:
        return image
    rows, columns = (max(n // step, 1) for n in image.shape)
    cut = np.asarray(image[: rows * step, : columns * step], np.float32)
    return cut.reshape(rows, min(step, cut.shape[0]), columns, min(step, cut.shape[1])).mean((1, 3))
