"""Captures corrected for their camera: the one way from a file to light, of every command that reads captures."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Num, Shaped

from ..base.errors import InputError, errors_name_file
from ..geometry import Sensor
from ..typing import PathLike
from .captures import DTYPES, averaged, channel_of, frames, sites

# A pixel with less than this share of the flat field's median has no light to speak of.
_LEAST_GAIN = 0.05
# Binned more than so, pixels hold whole spots of a well corrected lens.
_SHARP = 2
# Full scale of converters of these bits, as such or in the upper bits of 16.
_BITS = (8, 10, 12, 14, 16)
# So many pixels at the maximum, and more than twice those of the hundredth or the few counts below it, were cut off.
_PILE, _FEW_COUNTS, _LEVELS = 10, 5, 32
# In so many pixels levels are counted.
_PIXELS = 500_000
MASK_DTYPES = (*DTYPES, "bool")
# So much of a mask may be bad: more is one that marks what is good.
_MOST_BAD = 0.5


class Readout(NamedTuple):
    """How a camera delivered a capture, so that the design of its whole sensor serves.

    The frame stays that of the whole sensor: points and volumes have the same coordinates as from a whole capture.

    Parameters
    ----------
    roi
        `(row, column, rows, columns)` of the region that was read out, in pixels of the whole sensor, counted from 0.
        None: all of it.
    binning
        So many pixels each way were made one, from the region's first on; what is left at its end is lost.
    bayer
        Colours of the capture's first pixels, row by row, where it is a mosaic: one of `PATTERNS`.
    channel
        Of a mosaic or a colour image: one of `CHANNELS`. Of a mosaic, an image of its cells of 2 x 2 pixels. Nothing is
        interpolated: red and blue are the one pixel of the cell, where it is; green is the mean of the cell's two,
        whose middle is the cell's.

    Examples
    --------
    >>> sensor = Readout(roi=(1024, 512, 2048, 2048), binning=2).sensor(scope.sensor)
    """

    roi: tuple[int, int, int, int] | None = None
    binning: int = 1
    bayer: str | None = None
    channel: str | None = None

    def region(self, sensor: Sensor) -> Sensor:
        """The pixels that the camera read out of a whole sensor: `shape` is that of the file.

        Raises
        ------
        InputError
            If the region is not on the sensor, less than 2 x 2 pixels are left, or the mosaic is binned.
        """
        row, column, rows, columns = self.roi or (0, 0, *sensor.shape)
        if not (0 <= row <= sensor.shape[0] - rows and 0 <= column <= sensor.shape[1] - columns):
            found = f"rows {row} to {row + rows - 1} and columns {column} to {column + columns - 1}"
            whole = f"{sensor.shape[0]} x {sensor.shape[1]}"
            raise InputError(f"--roi: found {found}, allowed: within the sensor of {whole} (rows x columns, from 0).")
        if self.bayer and self.binning > 1:
            raise InputError(
                f"--binning {self.binning}: found --bayer {self.bayer}, allowed: a mosaic without binning."
            )
        return _part(sensor, (row, column), (rows, columns), self.binning)

    def sensor(self, sensor: Sensor) -> Sensor:
        """The pixels of the image that is made of such a capture; errors as `region`, or as `sites`."""
        region = self.region(sensor)
        if not self.bayer:
            return region
        cells = _part(region, (0, 0), region.shape, 2)
        y, x = np.mean(sites(self.bayer, self.channel), axis=0)
        x, y = (float(at - 0.5) * region.pixel_pitch + middle for at, middle in zip((x, y), cells.origin, strict=True))
        return Sensor(cells.shape, cells.pixel_pitch, (x, y))

    def words(self) -> list[str]:
        """What was read out, a line each."""
        said = []
        if self.channel:
            mosaic = f"the mosaic {self.bayer}, an image of its cells of 2 x 2 pixels"
            said.append(f"{self.channel} of {mosaic if self.bayer else 'a colour image'}")
        if self.roi:
            row, column, rows, columns = self.roi
            said.append(f"rows {row} to {row + rows - 1}, columns {column} to {column + columns - 1} of the sensor")
        if self.binning > 1:
            said.append(f"pixels binned {self.binning} x {self.binning}")
        return said


def _part(sensor: Sensor, first: tuple[int, int], shape: tuple[int, int], side: int) -> Sensor:
    """Squares of `side` pixels, as many as fit whole into the part of a sensor that begins at `first`."""
    count = tuple(n // side for n in shape)
    if min(count) < 2:
        found = f"{count[0]} x {count[1]} pixels that are left"
        raise InputError(f"--roi, --binning: found {found}, allowed: 2 x 2 or more.")
    middle = [at + n * side / 2 - whole / 2 for at, n, whole in zip(first, count, sensor.shape, strict=True)]
    y, x = (at * sensor.pixel_pitch + origin for at, origin in zip(middle, sensor.origin[::-1], strict=True))
    return Sensor(count, side * sensor.pixel_pitch, (x, y))


class Correction(NamedTuple):
    """What is known of a camera.

    Parameters
    ----------
    dark
        A file of the same exposure without light, taken off; its pages are averaged, its hot pixels are bad.
    flat
        A file of the sensor evenly lit, without the array, divided out; its pages are averaged, and what is off the
        dark frame or the offset is off it, too. Pixels with less than 5 % of its median are bad.
    bad_pixels
        A file in which every pixel but 0 is bad; "auto" finds single hot pixels in a capture for which there is no dark
        frame, and whose pixels have their neighbours beside them (no mosaic, binned by 2 at most); "none"
        repairs none but those of `dark` and `flat`.
    offset
        Counts of a pixel without light, where there is no dark frame.
    """

    dark: Path | None = None
    flat: Path | None = None
    bad_pixels: Path | str = "auto"
    offset: float = 0.0


class Corrected(NamedTuple):
    """A capture, what was done to it, a line each, and what is to be said of it."""

    image: Num[np.ndarray, "row column"]
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
    """A capture of a part of a sensor, corrected: an image for `readout.sensor(sensor)`.

    Where nothing is to be done it has the file's own type, otherwise float32. Dark frame, flat field and mask are read
    as the capture is: the same region, binning and channel.

    Parameters
    ----------
    path
        As for `read_capture`.
    sensor
        The whole, of the design. None: captures of any size, and no region.
    page
        As for `read_capture`, of the capture alone.
    readout, correction
        How the camera delivered all files, and what is known of it.

    Raises
    ------
    InputError
        As `read_capture` and `Readout`, for each of the files under its own name; if there are both a dark frame and an
        offset, the flat field is dark, or more than half of the pixels are masked.

    Examples
    --------
    >>> image, done, warnings = read_corrected("a.tif", scope.sensor, correction=Correction(dark=Path("dark.tif")))
    """
    shape = readout.region(sensor).shape if sensor else None
    _check(correction)
    images = frames(path, shape, page=page, channel=readout.channel, bayer=readout.bayer)
    image, done, warnings = _averaged(path, images, readout)
    prepared = prepare(image.shape, shape, readout, correction)
    found = apply(image, prepared)
    return Corrected(found.image, done + found.done, warnings + found.warnings)


class Prepared(NamedTuple):
    """A correction whose files have been read, for any number of captures.

    Parameters
    ----------
    dark, gain
        What is taken off, and what is divided by; None: nothing is.
    bad
        Pixels to fill, and how many were found where.
    searched
        Single hot pixels of each capture are bad, too.
    done, warnings
        As of `Corrected`.
    """

    dark: Num[np.ndarray, "row column"] | float | None
    gain: Float32[np.ndarray, "row column"] | None
    bad: Bool[np.ndarray, "row column"]
    counted: list[str]
    searched: bool
    done: list[str]
    warnings: list[str]


def prepare(
    size: tuple[int, int],
    shape: tuple[int, int] | None = None,
    readout: Readout = Readout(),
    correction: Correction = Correction(),
) -> Prepared:
    """Reads what a correction needs, once.

    Parameters
    ----------
    size
        Of the images that are to be corrected.
    shape
        Of the captures in their files, if it is known.
    readout, correction
        As for `read_corrected`, errors too.
    """
    _check(correction)
    bad, counted = np.zeros(size, bool), []
    done, warnings = readout.words(), []
    dark, gain = correction.offset or None, None
    if correction.dark:
        dark, said = _read_like(correction.dark, size, shape, readout)
        warnings += said
        bad |= _counted(hot_in_dark(dark), f"hot in {correction.dark.name}", counted)
        done.append(f"dark frame {correction.dark.name} taken off, median {np.median(dark):g}")
    elif correction.offset:
        done.append(f"offset {correction.offset:g} taken off")
    if correction.flat:
        flat, said = _read_like(correction.flat, size, shape, readout)
        warnings += said
        with errors_name_file(correction.flat):
            gain, unlit = gain_of(flat, 0.0 if dark is None else dark)
        bad |= _counted(unlit, f"unlit in {correction.flat.name}", counted)
        done.append(f"flat field {correction.flat.name} divided out, {gain.min():.3g} to {gain.max():.3g}")
    if isinstance(correction.bad_pixels, Path):
        where = f"in {correction.bad_pixels.name}"
        bad |= _counted(_mask(correction.bad_pixels, size, shape, readout), where, counted)
    automatic = correction.bad_pixels == "auto" and not (correction.dark or readout.bayer)
    return Prepared(dark, gain, bad, counted, automatic and readout.binning <= _SHARP, done, warnings)


def apply(image: Num[np.ndarray, "row column"], prepared: Prepared) -> Corrected:
    """An image corrected; of its own type where nothing is to be done, otherwise float32."""
    bad, counted, done, light = prepared.bad, list(prepared.counted), list(prepared.done), image
    if prepared.searched:
        bad = bad | _counted(hot_in_capture(image), "hot in the capture", counted)
    if prepared.dark is not None or prepared.gain is not None:
        light = correct(image, 0.0 if prepared.dark is None else prepared.dark, prepared.gain)
    if bad.any():
        light = repaired(light, bad)
        count = int(bad.sum())
        done.append(f"{count} bad pixel{'s' * (count > 1)} filled from neighbours: {', '.join(counted)}")
    return Corrected(light, done, list(prepared.warnings))


def _check(correction):
    if correction.dark and correction.offset:
        raise InputError(
            f"--offset: found --dark {correction.dark}, allowed: one of them; the dark frame has the offset."
        )


def correct(
    image: Num[np.ndarray, "row column"],
    dark: Num[np.ndarray, "row column"] | float = 0.0,
    gain: Float[np.ndarray, "row column"] | None = None,
) -> Float32[np.ndarray, "row column"]:
    """`(image - dark) / gain`: light, where a camera says `gain * light + dark`."""
    light = np.asarray(image, np.float32) - np.asarray(dark, np.float32)
    return light if gain is None else light / np.asarray(gain, np.float32)


def gain_of(
    flat: Num[np.ndarray, "row column"], dark: Num[np.ndarray, "row column"] | float = 0.0
) -> tuple[Float32[np.ndarray, "row column"], Bool[np.ndarray, "row column"]]:
    """What each pixel makes of even light, 1 in the mean, and which pixels are too dark to say; these have 1.

    Raises
    ------
    InputError
        If the flat field's median is no brighter than the dark.
    """
    light = correct(flat, dark)
    middle = float(np.median(light))
    if not middle > 0:
        raise InputError(f"found a median of {middle:g} above the dark, allowed: a flat field of even light.")
    unlit = light < _LEAST_GAIN * middle
    return np.where(unlit, 1, light / light[~unlit].mean(dtype=np.float64)).astype(np.float32), unlit


def saturated(image: Num[np.ndarray, "row column"]) -> tuple[int, int] | None:
    """How many pixels were cut off, and the value at which; None if none were, or the type is no camera's.

    That is the brightest value, if it is the full scale of 8 to 16 bits, or if many more pixels have it than what is
    just below.
    """
    if image.dtype.kind != "u":
        return None
    top = int(image.max())
    count = int(np.count_nonzero(image == top))
    full = {2**bits - 1 for bits in _BITS} | {2**16 - 2 ** (16 - bits) for bits in _BITS}
    # Rounded noise piles up as well, within a few counts; a drawing has few values, in a part of its pixels, too.
    least = max(top - max(top // 100, _FEW_COUNTS), 0)
    below = int(np.count_nonzero(image >= least)) - count
    step = math.isqrt(image.size // _PIXELS) + 1
    levels = np.count_nonzero(np.bincount(image[::step, ::step].ravel()))
    piled = count >= max(_PILE, 2 * below + 1) and levels >= _LEVELS
    return (count, top) if piled or (top in full and count > 1) else None


def read_frame(
    name: str, images: Iterator[Shaped[np.ndarray, "row column"]], prepared: Prepared, readout: Readout = Readout()
) -> Corrected:
    """As `read_corrected`, of images that are being read, with a correction that has been; `name` is for messages."""
    image, done, warnings = _averaged(name, images, readout)
    found = apply(image, prepared)
    return Corrected(found.image, done + found.done, warnings + found.warnings)


def _averaged(name, images, readout) -> tuple[np.ndarray, list[str], list[str]]:
    """An image, or the mean of several; what was done; and what is to be said of it."""
    cut: list[tuple[int, int] | None] = []
    size = 0

    def looked_at():
        nonlocal size
        for frame in images:
            size = frame.size
            cut.append(saturated(frame))
            yield frame

    image = averaged(looked_at())
    image = channel_of(image, readout.bayer, readout.channel) if readout.bayer else image
    done = [f"mean of {len(cut)} pages"] if len(cut) > 1 else []
    found = [each for each in cut if each]
    if not found:
        return image, done, []
    count, value = sum(count for count, _ in found), max(value for _, value in found)
    share = f"{count} pixels ({count / (len(cut) * size):.2g} of all) at {value}"
    return image, done, [f"{name}: found {share}, where the camera cuts off: how much light they saw is unknown"]


def _read_like(path, size, shape, readout) -> tuple[np.ndarray, list[str]]:
    """A file as the capture is read, and what is to be said of it."""
    images = frames(path, shape, page="mean", channel=readout.channel, bayer=readout.bayer)
    found, _, warnings = _averaged(path, images, readout)
    _check_like(path, found, size)
    return found, warnings


def _check_like(path, found, size):
    if found.shape != size:
        seen, allowed = (" x ".join(map(str, each)) for each in (found.shape, size))
        raise InputError(f"{path}: found {seen} pixels (rows x columns), allowed: {allowed}, as the capture has.")


def _mask(path, size, shape, readout) -> Bool[np.ndarray, "row column"]:
    found = averaged(frames(path, shape, channel=readout.channel, bayer=readout.bayer, dtypes=MASK_DTYPES))
    bad = (channel_of(found, readout.bayer, readout.channel) if readout.bayer else found) != 0
    _check_like(path, bad, size)
    if bad.mean() > _MOST_BAD:
        raise InputError(f"{path}: found {bad.mean():.0%} of the pixels marked as bad, allowed: up to half; 0 is good.")
    return bad


def _counted(bad, where, counted):
    """Bad pixels, whose number is added to a list, with where they were found."""
    if count := int(bad.sum()):
        counted.append(f"{count} {where}")
    return bad


# A pixel of a dark frame is hot if it is so many standard deviations brighter than the median of its neighbourhood of
# 5 x 5; a count is rounded by half of one.
_HOT, _ROUNDING = 10.0, 0.5
# In a capture, a pixel is hot if it is brighter than all is dark by so many standard deviations, and none of its eight
# neighbours has more than this share of what it has. In 24 ray-traced captures of points, whose spots are a pixel wide
# at half their height, the brightest neighbour of a spot has 7 % or more, binned or not.
_BRIGHT, _NEIGHBOUR = 100.0, 0.03


def hot_in_dark(dark: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Which pixels of a dark frame are hot. Slow changes over the sensor, as an amplifier's glow, do not count."""
    dark = np.asarray(dark, np.float32)
    middle = float(np.median(dark))
    deviation = max(1.4826 * float(np.median(np.abs(dark - middle))), _ROUNDING)
    hot = dark > middle + _HOT * deviation
    for some in _in_parts(np.argwhere(hot)):
        local = np.median(_around(dark, some, 2), axis=1)
        hot[tuple(some.T)] = dark[tuple(some.T)] > local + _HOT * deviation
    return hot


def hot_in_capture(image: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Which single pixels of a capture no light can have made: a spot, however sharp, shows in its neighbours.

    Pixels that have their neighbours beside them; not those of a mosaic. It finds only what is far above the noise.
    """
    image = np.asarray(image)
    # Levels of a part of the pixels are as good.
    some = np.asarray(image[::3, ::3], np.float32)
    level = float(np.median(some))
    noise = float(np.sqrt(2 * np.mean(np.minimum(some - level, 0) ** 2)))
    # Images without noise have bright pixels, too.
    least = (float(image.max()) - level) / 100 if image.dtype.kind == "f" else _BRIGHT * _ROUNDING
    hot = image > level + max(_BRIGHT * noise, least)
    for some in _in_parts(np.argwhere(hot)):
        brightest = np.delete(_around(image, some, 1), 4, axis=1).max(1)
        hot[tuple(some.T)] = brightest - level < _NEIGHBOUR * (image[tuple(some.T)] - level)
    return hot


def repaired(
    image: Num[np.ndarray, "row column"], bad: Bool[np.ndarray, "row column"]
) -> Float32[np.ndarray, "row column"]:
    """An image with bad pixels filled by the median of their good neighbours of 3 x 3, larger defects from their edge.

    Raises
    ------
    ValueError
        If there is no good pixel.
    """
    image, bad = np.array(image, np.float32), bad.copy()
    if bad.all():
        raise ValueError("`bad` must leave a pixel, got none.")
    places = np.argwhere(bad)
    while len(places):
        near = np.where(_around(bad, places, 1), np.nan, _around(image, places, 1))
        reached = ~np.isnan(near).all(1)
        filled = tuple(places[reached].T)
        image[filled], bad[filled] = np.nanmedian(near[reached], axis=1), False
        places = places[~reached]
    return image


def _in_parts(places):
    """A few at a time, for the memory of their neighbourhoods."""
    return np.array_split(places, len(places) // 100_000 + 1)


def _around(image, places, reach):
    """The pixels of the square around each place, `(place, pixel)`; at the image's edge, the edge's."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"), -1).reshape(1, -1, 2)
    near = np.clip(places[:, None] + offsets, 0, np.array(image.shape) - 1)
    return image[near[..., 0], near[..., 1]]
