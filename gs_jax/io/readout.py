"""What of a camera's pixels a capture holds: a region, binned pixels, one colour of a mosaic; and where these are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Shaped

from ..base.errors import InputError, short_repr
from ..geometry import Sensor

CHANNELS = ("red", "green", "blue")
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


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


def sites(bayer: str, channel: str | None) -> list[tuple[int, int]]:
    """`(row, column)` in a cell of the pixels of a channel.

    Raises
    ------
    InputError
        If there is no such pattern or channel.
    """
    if bayer not in PATTERNS:
        raise InputError(f"--bayer: found {short_repr(bayer)}, allowed: {', '.join(PATTERNS)}.")
    if channel not in CHANNELS:
        raise InputError(
            f"--bayer {bayer}: found {f'--channel {channel}' if channel else 'no --channel'}, allowed: "
            f"--channel {', '.join(CHANNELS)}."
        )
    return [divmod(place, 2) for place, colour in enumerate(bayer) if colour == channel[0].upper()]


def channel_of(mosaic: Shaped[np.ndarray, "row column"], bayer: str, channel: str | None) -> Shaped[np.ndarray, "y x"]:
    """The image of a mosaic's cells in one colour: see `Readout`. Green is float32; errors as `sites`."""
    rows, columns = (n // 2 * 2 for n in mosaic.shape)
    parts = [mosaic[row:rows:2, column:columns:2] for row, column in sites(bayer, channel)]
    return parts[0] if len(parts) == 1 else np.asarray(np.mean(parts, axis=0, dtype=np.float32))
