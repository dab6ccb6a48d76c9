"""Arguments that several commands take, and names that one has.

Commands import what they run when they run: their help needs none of it. So the names of methods and models are here
again.
"""

import functools
import math
from pathlib import Path
from typing import Any

import click

from ..base.workers import Workers

# Far more planes than any sensor resolves; a mistyped step asks for millions.
_MOST_DEPTHS = 10_000
# The nearest depth that a volume on disk may have, mm.
_NEAREST = 1e-6


METHODS = ("backproject", "list-rl", "richardson-lucy", "fista", "admm", "unrolled")
SUPPRESSIONS = ("none", "points", "clusters", "unet")
LEVELS = ("full", "near", "pinhole")
SIMULATED = ("full", "near")
PSFS = ("diffraction", "geometric", "gaussian")


class Number(click.ParamType):
    """A number within bounds."""

    def __init__(self, *, least: float, most: float, unit: str):
        self.least, self.most, self.unit, self.name = least, most, unit, unit or "number"

    def convert(self, value, param, ctx):
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not self.least <= number <= self.most:
            self.fail(f"found {value!r}, allowed: {self.least:g} to {self.most:g} {self.unit}.", param, ctx)
        return number


class Depths(click.ParamType):
    """START:STOP:STEP in mm, inclusive of STOP when it falls on the step; or one depth."""

    name = "start:stop:step"

    def convert(self, value, param, ctx):
        if isinstance(value, list):
            return value
        try:
            start, stop, step = map(float, value.split(":") if ":" in value else (value, value, 1))
        except ValueError:
            self.fail(f"found {value!r}, allowed: START:STOP:STEP, mm, such as 18:22:0.25, or one depth.", param, ctx)
        if not all(map(math.isfinite, (start, stop, step))) or not _NEAREST <= start <= stop or not step > 0:
            self.fail(f"found {value!r}, allowed: {_NEAREST:g} <= START <= STOP and STEP > 0, in mm.", param, ctx)
        # A step that misses STOP by rounding alone falls on it.
        count = (stop - start) / step + 1 + 1e-6
        if count > _MOST_DEPTHS + 1:
            self.fail(f"found {value!r}, {count:.3g} depths, allowed: at most {_MOST_DEPTHS}.", param, ctx)
        return [round(start + i * step, 9) for i in range(int(count))]


class DesignFile(click.ParamType):
    """A file, or the name of a design that comes with the package."""

    name = "design"

    def convert(self, value, param, ctx):
        path = Path(value)
        if path.parent == Path() and not path.suffix and not path.exists():
            return next((each for each in shipped_designs() if each.stem == value), path)
        return path


def shipped_designs() -> list[Path]:
    """The designs that come with the package; of a checkout, those in its folder."""
    inside = Path(__file__).parents[1] / "design" / "shipped"
    return sorted((inside if inside.is_dir() else Path(__file__).parents[2] / "design").glob("*.toml"))


DESIGN = DesignFile()
MM = Number(least=1e-3, most=1e4, unit="mm")
UM = Number(least=1e-2, most=1e6, unit="um")


def worker_options(command):
    """Who does the work; the command takes it as `workers`, and enters it when there is work."""

    @functools.wraps(command)
    def taking(*arguments, workers, scheduler, **given):
        return command(*arguments, workers=Workers(workers, scheduler), **given)

    count = click.option(
        "--workers",
        type=click.IntRange(1, 1000),
        help="Processes of this machine that share the work. Needs pip install 'gs-jax[cluster]'.  [default: this one]",
    )
    address = click.option(
        "--scheduler", help="Address of a Dask scheduler whose workers do the work: tcp://HOST:8786."
    )
    return count(address(taking))


def depth_range(depths: list[float]) -> str:
    """The depths in words."""
    if len(depths) == 1:
        return f"at {depths[0]:g} mm"
    return f"{len(depths)} depths from {depths[0]:g} to {depths[-1]:g} mm"


CHANNELS = ("red", "green", "blue")
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


class Page(click.ParamType):
    """A page, from 1, or `mean` of all."""

    name = "n|mean"

    def convert(self, value, param, ctx):
        if value == "mean" or isinstance(value, int):
            return value
        if value.isdecimal() and int(value) > 0:
            return int(value)
        self.fail(f"found {value!r}, allowed: a page, 1 or more, or mean.", param, ctx)


class Region(click.ParamType):
    """ROW,COLUMN,ROWS,COLUMNS: whole numbers of pixels."""

    name = "row,column,rows,columns"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        numbers = value.split(",")
        if len(numbers) != 4 or not all(number.strip().isdecimal() for number in numbers):
            self.fail(f"found {value!r}, allowed: ROW,COLUMN,ROWS,COLUMNS in pixels, from 0.", param, ctx)
        return tuple(map(int, numbers))


_READOUT = (
    click.option(
        "--page", type=Page(), help="Of a capture of several pages: one, from 1; or mean, of repeated frames."
    ),
    click.option("--channel", type=click.Choice(CHANNELS), help="Of a colour capture, or of the mosaic of --bayer."),
    click.option(
        "--bayer",
        type=click.Choice(PATTERNS),
        help="The capture is a raw mosaic, whose first pixels these are. Nothing is interpolated.",
    ),
)
_REGION = (
    click.option(
        "--roi", type=Region(), help="The part of the sensor that the capture is, in pixels of the whole; first row 0."
    ),
    click.option(
        "--binning",
        type=click.IntRange(1, 64),
        default=1,
        show_default=True,
        help="Pixels each way that the camera made one.",
    ),
)
_CORRECTION = (
    click.option("--dark", type=Path, help="DARK.tif: as exposed, without light; several pages are averaged."),
    click.option("--flat", type=Path, help="FLAT.tif: even light on the sensor, without the array; likewise."),
    click.option(
        "--bad-pixels",
        default="auto",
        show_default=True,
        help="MASK.png, in which all but 0 is bad; none; or auto: the hot ones of DARK, or single ones of the capture.",
    ),
    click.option(
        "--offset",
        type=Number(least=0.0, most=65535.0, unit="counts"),
        default=0.0,
        help="Counts of a dark pixel, if there is no --dark.",
    ),
)


class CaptureOptions:
    """What the options say, and what was done to the captures that were read with them."""

    def __init__(self, page=None, channel=None, bayer=None, roi=None, binning=1, *, dark, flat, bad_pixels, offset):
        from ..io.camera import Correction, Readout

        self.page, self.readout = page, Readout(roi, binning, bayer, channel)
        mask = bad_pixels if bad_pixels in ("auto", "none") else Path(bad_pixels)
        self.correction = Correction(dark, flat, mask, offset)
        self.sensor: Any = None
        self.done, self.warnings = {}, {}

    @property
    def files(self) -> list[Path]:
        """Files beside the captures."""
        return [
            each
            for each in (self.correction.dark, self.correction.flat, self.correction.bad_pixels)
            if isinstance(each, Path)
        ]

    def imager(self, imager):
        """The microscope with the pixels that its captures have."""
        import equinox as eqx

        self.sensor = imager.sensor
        return eqx.tree_at(lambda i: i.sensor, imager, self.readout.sensor(imager.sensor))

    def read(self, path: Path, *, is_spot: bool = False):
        """The image of a capture, corrected; of one spot, the mean of all pages, and no pixel of it is too sharp."""
        from ..io.camera import read_corrected

        page, correction = self.page, self.correction
        if is_spot:
            page = "mean"
            correction = correction._replace(bad_pixels="none") if correction.bad_pixels == "auto" else correction
        found = read_corrected(path, self.sensor, page=page, readout=self.readout, correction=correction)
        for line in found.done:
            self.done.setdefault(line, []).append(path)
        self.warnings |= dict.fromkeys(found.warnings)
        return found.image

    def frames(self, recording):
        """From a frame of a recording to its image, corrected, float32, what was done to it alone, and what is wrong.

        What corrects all frames is read here.
        """
        import numpy as np

        from ..io.camera import prepare, read_frame
        from ..io.captures import Wanted

        shape, readout = self.readout.region(self.sensor).shape, self.readout
        wanted = Wanted(shape, None, readout.channel, readout.bayer)
        prepared = prepare(readout.sensor(self.sensor).shape, shape, readout, self.correction)
        self.done = {line: [Path(f"{len(recording.names)} frames")] for line in prepared.done}
        shared = [*prepared.done, *prepared.warnings]
        self.warnings |= dict.fromkeys(prepared.warnings)

        def read(frame):
            found = read_frame(recording.names[frame], recording.images(frame, wanted), prepared, readout)
            # One type for all frames: nothing is compiled for another.
            done, warnings = ([line for line in lines if line not in shared] for lines in (found.done, found.warnings))
            return np.asarray(found.image, np.float32), done, warnings

        return read

    def recorded(self, provenance: dict[str, str]) -> dict[str, str]:
        """A provenance that says what was done, too."""
        return provenance | ({"correction": "; ".join(self._lines())} if self.done else {})

    def say(self) -> None:
        """Prints what was done to the captures, a line each, and on standard error what is wrong with them."""
        for line in self._lines():
            click.echo(line)
        for line in self.warnings:
            click.echo(f"gs-jax: warning: {line}", err=True)

    def _lines(self):
        named = lambda paths: paths[0].name if len(paths) == 1 else f"{len(paths)} captures"
        return [f"{named(paths)}: {line}" for line, paths in self.done.items()]


def capture_options(command):
    """The options; the command takes them as `camera`, a `CaptureOptions`."""
    return _with(command, (*_READOUT, *_REGION, *_CORRECTION))


def picture_options(command):
    """As `capture_options`, of captures without a design: their part of a sensor is all that there is."""
    return _with(command, (*_READOUT, *_CORRECTION))


def _with(command, options):
    @functools.wraps(command)
    def taking(*arguments, **given):
        names = ("page", "channel", "bayer", "roi", "binning", "dark", "flat", "bad_pixels", "offset")
        mine = {name: given.pop(name) for name in names if name in given}
        return command(*arguments, camera=CaptureOptions(**mine), **given)

    for option in reversed(options):
        taking = option(taking)
    return taking
