"""From camera pixels to light: regions, binning and mosaics; dark frames, flat fields, hot and saturated pixels."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Num, Shaped

from ..base.errors import InputError, errors_name_file, input_error
from ..base.typing import PathLike
from ..microscope.grid import Sensor
from .captures import (
    CHANNELS,
    DTYPES,
    REPEATS,
    GreyError,
    Selection,
    average,
    is_grey,
    mosaic_channel,
    mosaic_sites,
    read_images,
    size_text,
)

# Pixels of the flat field below this share of its median are bad.
_MIN_GAIN = 0.05
# Pixels binned by more hold whole spots of a well corrected lens, which look like hot pixels.
_MAX_SHARP_BINNING = 2
MAX_LIGHT = 1e15
_MASK_DTYPES = (*DTYPES, "bool")
# Full scale is that of a converter of so many bits, as such or in the upper bits of 16.
_BITS = (8, 10, 12, 14, 16)
# Images are also saturated if at least `_MIN_PILE` pixels have the maximum, more than twice those of the hundredth (or
# `_FEW_COUNTS`) below it, and there are at least `_MIN_LEVELS` levels among about `_LEVEL_PIXELS` pixels.
_MIN_PILE, _FEW_COUNTS, _MIN_LEVELS, _LEVEL_PIXELS = 10, 5, 32, 500_000
# A pixel of a dark frame is hot if it exceeds the median of its 5 x 5 neighbourhood by so many standard deviations,
# which are at least the rounding of a count.
_HOT, _ROUNDING = 10.0, 0.5
# A pixel of a capture is hot if it exceeds the background by so many standard deviations, and none of its eight
# neighbours by more than this share of that. In 24 ray-traced captures of points, whose spots are one pixel wide at
# half maximum, the brightest neighbour of a spot has 7 % or more, binned or not.
_BRIGHT, _NEIGHBOUR = 100.0, 0.03


class Readout(NamedTuple):
    """How a camera delivered a capture: the region, binning and colour of its sensor.

    Coordinates stay those of the whole sensor: points and volumes are the same as from a whole capture.

    Parameters
    ----------
    roi
        `(row, column, rows, columns)` of the region, in pixels of the whole sensor, counted from 0. None: all of it.
    binning
        Pixels each way that are binned into one, from the region's first on; a rest at its end is lost.
    bayer
        Colours of the first 2 x 2 pixels of a mosaic, row by row: one of `PATTERNS`.
    channel
        Channel of a mosaic or a colour image: one of `CHANNELS`. A mosaic gives one pixel per 2 x 2 cell, without
        interpolation: red and blue are the cell's one pixel, green is the mean of its two.

    Examples
    --------
    >>> sensor = Readout(roi=(1024, 512, 2048, 2048), binning=2).sensor(scope.sensor)
    """

    roi: tuple[int, int, int, int] | None = None
    binning: int = 1
    bayer: str | None = None
    channel: str | None = None

    def region(self, sensor: Sensor) -> Sensor:
        """Return the pixels that the camera read out of a whole sensor, as in the file.

        Raises `InputError` if the region exceeds the sensor, less than 2 x 2 pixels are left, or a mosaic is binned.
        """
        row, column, rows, columns = self.roi or (0, 0, *sensor.shape)
        if not (0 <= row <= sensor.shape[0] - rows and 0 <= column <= sensor.shape[1] - columns):
            given = f"rows {row} to {row + rows - 1} and columns {column} to {column + columns - 1}"
            raise input_error("--roi", f"within the sensor of {size_text(sensor.shape)} pixels, from 0", given)
        if self.bayer and self.binning > 1:
            raise input_error("--binning", f"1 with --bayer {self.bayer}", f"--binning {self.binning}")
        return _part(sensor, (row, column), (rows, columns), self.binning)

    def sensor(self, sensor: Sensor) -> Sensor:
        """Return the pixels of the image that is made of such a capture; errors as `region` and `mosaic_sites`."""
        region = self.region(sensor)
        if not self.bayer:
            return region
        cells = _part(region, (0, 0), region.shape, 2)
        y, x = np.mean(mosaic_sites(self.bayer, self.channel), axis=0)
        x, y = (float(at - 0.5) * region.pixel_pitch + middle for at, middle in zip((x, y), cells.origin, strict=True))
        return Sensor(cells.shape, cells.pixel_pitch, (x, y))

    def describe(self, grey: bool = False) -> list[str]:
        """One line for each of channel, region and binning that is set; `grey` as in `prepare`."""
        lines = []
        if self.channel:
            mosaic = f"the mosaic {self.bayer}, an image of its cells of 2 x 2 pixels"
            is_colour = self.bayer or (self.channel in CHANNELS and not grey)
            of = f" of {mosaic if self.bayer else 'a colour image'}"
            lines.append(f"{self.channel}{of}" if is_colour else f"channel {self.channel}")
        if self.roi:
            row, column, rows, columns = self.roi
            lines.append(f"rows {row} to {row + rows - 1}, columns {column} to {column + columns - 1} of the sensor")
        if self.binning > 1:
            lines.append(f"pixels binned {self.binning} x {self.binning}")
        return lines


def _part(sensor: Sensor, first: tuple[int, int], shape: tuple[int, int], side: int) -> Sensor:
    """Squares of `side` pixels, as many as fit into the part of a sensor that begins at `first`."""
    count = tuple(n // side for n in shape)
    if min(count) < 2:
        raise input_error("--roi, --binning", "such that 2 x 2 pixels or more are left", size_text(count))
    middle = [at + n * side / 2 - whole / 2 for at, n, whole in zip(first, count, sensor.shape, strict=True)]
    y, x = (at * sensor.pixel_pitch + origin for at, origin in zip(middle, sensor.origin[::-1], strict=True))
    return Sensor(count, side * sensor.pixel_pitch, (x, y))


class Correction(NamedTuple):
    """Calibration files of a camera.

    Parameters
    ----------
    dark
        File of the same exposure without light, which is subtracted; its pages are averaged, its hot pixels are bad.
    flat
        File of the evenly lit sensor without the array, which is divided out; its pages are averaged, and dark frame or
        offset are subtracted from it. Pixels with less than 5 % of its median are bad.
    bad_pixels
        File in which every pixel but 0 is bad; "auto" finds single hot pixels of each capture, if there is no dark
        frame, no mosaic, and a binning of 2 at most; "none" fills only those of `dark` and `flat`.
    offset
        Counts of a pixel without light, where there is no dark frame.
    """

    dark: Path | None = None
    flat: Path | None = None
    bad_pixels: Path | str = "auto"
    offset: float = 0.0


class Corrected(NamedTuple):
    """A corrected capture, a line for each step that was done, and warnings."""

    image: Num[np.ndarray, "row column"]
    done: list[str]
    warnings: list[str]


class Prepared(NamedTuple):
    """A correction whose files have been read, for any number of captures.

    `bad` are the pixels to fill, `bad_counts` says how many were found where, and `find_hot` whether each capture is
    searched for hot pixels.
    """

    dark: Num[np.ndarray, "row column"] | float | None
    gain: Float32[np.ndarray, "row column"] | None
    bad: Bool[np.ndarray, "row column"]
    bad_counts: list[str]
    find_hot: bool
    done: list[str]
    warnings: list[str]


def read_corrected(
    path: PathLike,
    sensor: Sensor | None = None,
    *,
    page: int | str | None = None,
    readout: Readout = Readout(),
    correction: Correction = Correction(),
) -> Corrected:
    """Read and correct a capture: an image for `readout.sensor(sensor)`.

    The image keeps the type of the file if there is nothing to correct, otherwise it is float32. The files of the
    correction have the same region, binning and channel as the capture.

    Parameters
    ----------
    path, page
        As for `read_capture`.
    sensor
        The whole sensor of the design. None: captures of any size, without a region.
    readout, correction
        How the camera delivered all files, and its calibration files.

    Raises
    ------
    InputError
        As `read_capture` and `Readout`, naming the file; if there are both a dark frame and an offset, the flat field
        is dark, or more than half of the pixels are masked.

    Examples
    --------
    >>> image, done, warnings = read_corrected("a.tif", scope.sensor, correction=Correction(dark=Path("dark.tif")))
    """
    shape = readout.region(sensor).shape if sensor else None
    images = read_images(path, Selection(shape, page, readout.channel, readout.bayer))
    image, done, warnings = _average(path, images, readout)
    grey = is_grey(Path(path), page, readout.channel)
    return _apply(prepare(image.shape, shape, readout, correction, grey), image, done, warnings)


def read_frame(
    name: str, images: Iterator[Shaped[np.ndarray, "row column"]], prepared: Prepared, readout: Readout = Readout()
) -> Corrected:
    """Average and correct images, as `read_corrected` does those of a file; `name` is for messages."""
    return _apply(prepared, *_average(name, images, readout))


def prepare(
    size: tuple[int, int],
    shape: tuple[int, int] | None = None,
    readout: Readout = Readout(),
    correction: Correction = Correction(),
    grey: bool = False,
) -> Prepared:
    """Read the files of a correction.

    Parameters
    ----------
    size
        Shape of the images that are corrected.
    shape
        Shape of the captures in their files, if it is known.
    readout, correction
        As for `read_corrected`, with the same errors.
    grey
        Whether the images that are corrected are grey, whatever their channel is called.
    """
    if correction.dark and correction.offset:
        raise InputError(f"--offset must not be given with --dark, got {correction.dark}; its offset is the dark's.")
    bad, bad_counts = np.zeros(size, bool), []
    done, warnings = readout.describe(grey), []
    dark, gain = correction.offset or None, None

    def read_like_capture(path: Path, page: str | None = REPEATS, dtypes: tuple[str, ...] = DTYPES) -> np.ndarray:
        selection = Selection(shape, page, readout.channel, readout.bayer, dtypes)
        try:
            image, _, more = _average(path, read_images(path, selection), readout)
        except GreyError:
            # A file of one channel corrects all.
            if readout.channel in CHANNELS and not grey:
                raise
            image, _, more = _average(path, read_images(path, selection._replace(channel=None)), readout)
        warnings.extend(more if dtypes == DTYPES else ())
        return _checked_size(path, image, size)

    def mark(pixels: np.ndarray, where: str) -> None:
        bad[pixels] = True
        if count := int(pixels.sum()):
            bad_counts.append(f"{count} {where}")

    if correction.dark:
        dark = read_like_capture(correction.dark)
        mark(find_hot_in_dark(dark), f"hot in {correction.dark.name}")
        done.append(f"dark frame {correction.dark.name} taken off, median {np.median(dark):g}")
    elif correction.offset:
        done.append(f"offset {correction.offset:g} taken off")
    if correction.flat:
        flat = read_like_capture(correction.flat)
        with errors_name_file(correction.flat):
            gain, unlit = flat_field_gain(flat, 0.0 if dark is None else dark)
        mark(unlit, f"unlit in {correction.flat.name}")
        done.append(f"flat field {correction.flat.name} divided out, {gain.min():.3g} to {gain.max():.3g}")
    if isinstance(correction.bad_pixels, Path):
        mask = read_like_capture(correction.bad_pixels, None, _MASK_DTYPES) != 0
        if mask.mean() > 0.5:  # a mask that marks good pixels
            got = f"{mask.mean():.0%}"
            raise input_error("bad pixels", "at most half of all, with 0 for good ones", got, correction.bad_pixels)
        mark(mask, f"in {correction.bad_pixels.name}")
    automatic = correction.bad_pixels == "auto" and not (correction.dark or readout.bayer)
    return Prepared(dark, gain, bad, bad_counts, automatic and readout.binning <= _MAX_SHARP_BINNING, done, warnings)


def _apply(prepared: Prepared, image: np.ndarray, done: list[str], warnings: list[str]) -> Corrected:
    bad, bad_counts, done = prepared.bad, list(prepared.bad_counts), done + prepared.done
    if prepared.find_hot:
        hot = find_hot_in_capture(image)
        bad = bad | hot
        if hot.any():
            bad_counts.append(f"{int(hot.sum())} hot in the capture")
    if prepared.dark is not None or prepared.gain is not None:
        image = correct(image, 0.0 if prepared.dark is None else prepared.dark, prepared.gain)
    if count := int(bad.sum()):
        image = fill_bad_pixels(image, bad)
        done.append(f"{count} bad pixel{'s' * (count > 1)} filled from neighbours: {', '.join(bad_counts)}")
    return Corrected(image, done, warnings + prepared.warnings)


def correct(
    image: Num[np.ndarray, "row column"],
    dark: Num[np.ndarray, "row column"] | float = 0.0,
    gain: Float[np.ndarray, "row column"] | None = None,
) -> Float32[np.ndarray, "row column"]:
    """Light of an image `gain * light + dark`."""
    light = np.asarray(image, np.float32) - np.asarray(dark, np.float32)
    return light if gain is None else light / np.asarray(gain, np.float32)


def flat_field_gain(
    flat: Num[np.ndarray, "row column"], dark: Num[np.ndarray, "row column"] | float = 0.0
) -> tuple[Float32[np.ndarray, "row column"], Bool[np.ndarray, "row column"]]:
    """Relative gain of each pixel, with a mean of 1, and which pixels are too dark to tell; these have 1.

    Raises `InputError` if the median of the flat field is not above the dark.
    """
    light = correct(flat, dark)
    middle = float(np.median(light))
    if not middle > 0:
        raise input_error("flat field", "even light, brighter than the dark", f"a median of {middle:g} above it")
    unlit = light < _MIN_GAIN * middle
    return np.where(unlit, 1, light / light[~unlit].mean(dtype=np.float64)).astype(np.float32), unlit


def _average(name: PathLike, images, readout: Readout) -> tuple[np.ndarray, list[str], list[str]]:
    """Mean of images, of one channel of a mosaic; what was done; warnings."""
    sizes, saturated = [], []

    def inspect(image):
        # Float32 holds the squares of such pixels, and their sums, in the solvers.
        if image.dtype.kind == "f" and image.size and (most := float(np.abs(image).max())) > MAX_LIGHT:
            raise input_error("pixels", f"at most {MAX_LIGHT:g} in size", f"{most:g}", name)
        sizes.append(image.size)
        saturated.append(count_saturated(image))
        return image

    image = average(map(inspect, images))
    image = mosaic_channel(image, readout.bayer, readout.channel) if readout.bayer else image
    done = [f"mean of {len(sizes)} pages"] if len(sizes) > 1 else []
    if not any(saturated):
        return image, done, []
    counts, values = zip(*filter(None, saturated), strict=True)
    count, value = sum(counts), max(values)
    share = f"{count} pixels ({count / sum(sizes):.2g} of all)"
    return image, done, [f"{name}: {share} are saturated at {value}: the camera cut off their light"]


def _checked_size(path: Path, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if image.shape != size:
        raise input_error("image", f"{size_text(size)} pixels, as the capture", size_text(image.shape), path)
    return image


def count_saturated(image: Num[np.ndarray, "row column"]) -> tuple[int, int] | None:
    """Number of saturated pixels and their value; None without such, or if the type is no camera's.

    The maximum is saturated if it is the full scale of 8 to 16 bits, or if many more pixels have it than values just
    below.
    """
    if image.dtype.kind != "u":
        return None
    top = int(image.max())
    count = int(np.count_nonzero(image == top))
    full = {2**bits - 1 for bits in _BITS} | {2**16 - 2 ** (16 - bits) for bits in _BITS}
    # Rounded noise piles up within a few counts, too; drawings have few levels.
    least = max(top - max(top // 100, _FEW_COUNTS), 0)
    below = int(np.count_nonzero(image >= least)) - count
    step = math.isqrt(image.size // _LEVEL_PIXELS) + 1
    levels = np.count_nonzero(np.bincount(image[::step, ::step].ravel()))
    piled = count >= max(_MIN_PILE, 2 * below + 1) and levels >= _MIN_LEVELS
    return (count, top) if piled or (top in full and count > 1) else None


def find_hot_in_dark(dark: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Find hot pixels of a dark frame; gradual changes, such as an amplifier's glow, do not count."""
    dark = np.asarray(dark, np.float32)
    middle = float(np.median(dark))
    deviation = max(1.4826 * float(np.median(np.abs(dark - middle))), _ROUNDING)
    hot = dark > middle + _HOT * deviation
    for pixels in _in_parts(np.argwhere(hot)):
        local = np.median(_neighbourhoods(dark, pixels, 2), axis=1)
        hot[tuple(pixels.T)] = dark[tuple(pixels.T)] > local + _HOT * deviation
    return hot


def find_hot_in_capture(image: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Find single pixels of a capture that light cannot have made: the sharpest spot is seen by its neighbours, too.

    It finds only pixels far above the noise. Mosaics and binned pixels have no such neighbours.
    """
    image = np.asarray(image)
    sample = np.asarray(image[::3, ::3], np.float32)
    level = float(np.median(sample))
    noise = float(np.sqrt(2 * np.mean(np.minimum(sample - level, 0) ** 2)))
    # Noiseless images have bright pixels, too.
    least = (float(image.max()) - level) / 100 if image.dtype.kind == "f" else _BRIGHT * _ROUNDING
    hot = image > level + max(_BRIGHT * noise, least)
    for pixels in _in_parts(np.argwhere(hot)):
        brightest = np.delete(_neighbourhoods(image, pixels, 1), 4, axis=1).max(1)
        hot[tuple(pixels.T)] = brightest - level < _NEIGHBOUR * (image[tuple(pixels.T)] - level)
    return hot


def fill_bad_pixels(
    image: Num[np.ndarray, "row column"], bad: Bool[np.ndarray, "row column"]
) -> Float32[np.ndarray, "row column"]:
    """Replace bad pixels by the median of their good 3 x 3 neighbours; larger defects are filled from their edge.

    Raises `ValueError` if all pixels are bad.
    """
    image, bad = np.array(image, np.float32), bad.copy()
    if bad.all():
        raise ValueError("`bad` must leave a good pixel.")
    pixels = np.argwhere(bad)
    while len(pixels):
        near = np.where(_neighbourhoods(bad, pixels, 1), np.nan, _neighbourhoods(image, pixels, 1))
        reached = ~np.isnan(near).all(1)
        filled = tuple(pixels[reached].T)
        image[filled], bad[filled] = np.nanmedian(near[reached], axis=1), False
        pixels = pixels[~reached]
    return image


def _in_parts(pixels):
    """Split pixels into parts whose neighbourhoods need little memory."""
    return np.array_split(pixels, len(pixels) // 100_000 + 1)


def _neighbourhoods(image, pixels, reach):
    """Squares around pixels, `(place, pixel)`; beyond the image's edge its nearest pixels."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"), -1).reshape(1, -1, 2)
    near = np.clip(pixels[:, None] + offsets, 0, np.array(image.shape) - 1)
    return image[near[..., 0], near[..., 1]]
