"""Parameter types and options that several commands share, and the reading of captures with them.

Commands import what they run only when they run, so that their help is quick. So the names of methods and models are
repeated here.
"""

import functools
import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ..base.workers import Workers

# Far more planes than any sensor resolves; a mistyped step asks for millions.
_MAX_DEPTHS = 10_000
# Depths beyond are in another unit: the farthest usual object of designs, mm.
_FARTHEST = 2000.0
# Nearest depth that a file of volumes may have, mm.
NEAREST = 1e-6

METHODS = ("backproject", "list-rl", "richardson-lucy", "fista", "admm", "unrolled", "surface")
SUPPRESSIONS = ("none", "points", "clusters", "unet")
FIDELITIES = ("full", "near", "pinhole")
SIMULATED = ("full", "near")
PSFS = ("diffraction", "geometric", "gaussian")
CHANNELS = ("red", "green", "blue")
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
# Names of the options that read a picture, and of those of a capture.
_PICTURE = ("page", "channel", "bayer", "dark", "flat", "bad_pixels", "offset")
CAPTURE_OPTIONS = (*_PICTURE, "roi", "binning")


class Number(click.ParamType):
    """A number within bounds. A length beyond the `usual` ones that would be one of them in another unit is refused."""

    def __init__(self, least: float, most: float, unit: str = "", usual: tuple[float, float] | None = None):
        self.least, self.most, self.unit, self.name = least, most, unit, unit or "number"
        self.usual = usual

    def convert(self, value, param, ctx):
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not self.least <= number <= self.most:
            unit = f" {self.unit}" if self.unit else ""
            self.fail(f"must be {self.least:g} to {self.most:g}{unit}, got {value!r}.", param, ctx)
        if self.usual and (question := _other_unit([number], self.usual, self.unit)):
            self.fail(question, param, ctx)
        return number


def _other_unit(numbers: list[float], usual: tuple[float, float], unit: str) -> str | None:
    # The module's import takes longer than the help of a command; usual numbers need it not.
    if all(usual[0] <= number <= usual[1] for number in numbers if number):
        return None
    from ..design.validation import other_unit

    return other_unit(numbers, usual, unit)


class Depths(click.ParamType):
    """START:STOP:STEP in mm, inclusive of STOP when it falls on the step; or a list, `10,40`; or one depth."""

    name = "start:stop:step|z,z,..."

    def __init__(self, least: float = NEAREST, usual: float = _FARTHEST):
        self.least, self.usual = least, usual

    def convert(self, value, param, ctx):
        if isinstance(value, list):
            return value
        try:
            if ":" not in value:
                return self._list(value, [float(depth) for depth in value.split(",")], param, ctx)
            start, stop, step = map(float, value.split(":"))
        except ValueError:
            allowed = "START:STOP:STEP in mm, such as 18:22:0.25, or a list such as 10,40, or one depth"
            self.fail(f"must be {allowed}, got {value!r}.", param, ctx)
        if not all(map(math.isfinite, (start, stop, step))) or not self.least <= start <= stop or not step > 0:
            self.fail(f"must have {self.least:g} <= START <= STOP and STEP > 0, in mm, got {value!r}.", param, ctx)
        # A step that misses STOP by rounding alone falls on it.
        count = (stop - start) / step + 1 + 1e-6
        if count > _MAX_DEPTHS + 1:
            self.fail(f"must have at most {_MAX_DEPTHS} depths, got {value!r}, {count:.3g} depths.", param, ctx)
        self._check_unit([start, stop, step], param, ctx)
        return [round(start + i * step, 9) for i in range(int(count))]

    def _list(self, value, depths, param, ctx):
        """Depths of a list, which ascend."""
        if not all(self.least <= depth < math.inf for depth in depths):
            self.fail(f"must be depths of {self.least:g} mm or more, got {value!r}.", param, ctx)
        if any(after <= before for before, after in itertools.pairwise(depths)):
            self.fail(f"must be depths in ascending order, got {value!r}.", param, ctx)
        self._check_unit(depths, param, ctx)
        return depths

    def _check_unit(self, values, param, ctx):
        """Fail if depths look as if they were given in another unit."""
        if max(values) > self.usual and (question := _other_unit(values, (0.0, _FARTHEST), "mm")):
            self.fail(question, param, ctx)


class DesignFile(click.ParamType):
    """A file, or the name of a design that comes with the package."""

    name = "design"

    def convert(self, value, param, ctx):
        path = Path(value)
        if path.parent == Path() and not path.suffix and not path.exists():
            return next((shipped for shipped in shipped_designs() if shipped.stem == value), path)
        return path


class Page(click.ParamType):
    """A page, from 1, or `mean` of all."""

    name = "n|mean"

    def convert(self, value, param, ctx):
        if value == "mean" or isinstance(value, int):
            return value
        if value.isdecimal() and int(value) > 0:
            return int(value)
        self.fail(f"must be a page, 1 or more, or mean, got {value!r}.", param, ctx)


class Region(click.ParamType):
    """ROW,COLUMN,ROWS,COLUMNS: whole numbers of pixels."""

    name = "row,column,rows,columns"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        numbers = value.split(",")
        if len(numbers) != 4 or not all(number.strip().isdecimal() for number in numbers):
            self.fail(f"must be ROW,COLUMN,ROWS,COLUMNS in pixels, from 0, got {value!r}.", param, ctx)
        return tuple(map(int, numbers))


def shipped_designs() -> list[Path]:
    """The designs that come with the package; in a checkout, those in its folder."""
    inside = Path(__file__).parents[1] / "design" / "shipped"
    return sorted((inside if inside.is_dir() else Path(__file__).parents[2] / "design").glob("*.toml"))


DESIGN = DesignFile()
# Lengths on a plate; and in the image or the object, of a voxel or a blur.
MM = Number(1e-3, 1e4, "mm", usual=(0.005, 500.0))
UM = Number(1e-2, 1e6, "um", usual=(0.1, 2e4))


terms_option = click.option(
    "--terms",
    type=Path,
    help="FILE.py with terms of your own for the study, in a dictionary TERMS. The file is executed.",
)


def worker_options(command):
    """Add `--workers` and `--scheduler`; the command receives `workers`, which it enters when there is work."""

    @functools.wraps(command)
    def wrapper(*args, workers, scheduler, **kwargs):
        return command(*args, workers=Workers(workers, scheduler), **kwargs)

    count = click.option(
        "--workers",
        type=click.IntRange(1, 1000),
        help="Number of processes on this machine that share the work. Needs pip install 'gs-jax[cluster]'.  "
        "[default: this process]",
    )
    address = click.option("--scheduler", help="Dask scheduler whose workers do the work: tcp://HOST:8786.")
    return count(address(wrapper))


_FORMAT_OPTIONS = (
    click.option(
        "--page", type=Page(), help="Page of a capture of several, from 1; or mean, to average repeated frames."
    ),
    click.option("--channel", type=click.Choice(CHANNELS), help="Channel of a colour capture or of a --bayer mosaic."),
    click.option(
        "--bayer",
        type=click.Choice(PATTERNS),
        help="The capture is a raw mosaic whose first pixels are these. Nothing is interpolated.",
    ),
)
_REGION_OPTIONS = (
    click.option("--roi", type=Region(), help="Region of the sensor that the capture covers, in unbinned pixels."),
    click.option(
        "--binning",
        type=click.IntRange(1, 64),
        default=1,
        help="Side of the squares of pixels that the camera combined.",
    ),
)
_CORRECTION_OPTIONS = (
    click.option(
        "--dark", type=Path, help="DARK.tif: dark frame of the capture's exposure; several pages are averaged."
    ),
    click.option(
        "--flat", type=Path, help="FLAT.tif: even light on the sensor without the array; several pages are averaged."
    ),
    click.option(
        "--bad-pixels",
        default="auto",
        help="MASK.png, nonzero at bad pixels; none; or auto: hot pixels of DARK, or isolated ones of the capture.",
    ),
    click.option(
        "--offset",
        type=Number(0.0, 65535.0, "counts"),
        default=0.0,
        help="Counts of a dark pixel, if there is no --dark.",
    ),
)


class CaptureOptions:
    """Reads captures with the capture options, and collects what was corrected in them."""

    def __init__(self, page=None, channel=None, bayer=None, roi=None, binning=1, *, dark, flat, bad_pixels, offset):
        from ..io.camera import Correction, Readout

        self.page, self.readout = page, Readout(roi, binning, bayer, channel)
        mask = bad_pixels if bad_pixels in ("auto", "none") else Path(bad_pixels)
        self.correction = Correction(dark, flat, mask, offset)
        self.sensor: Any = None
        # Lines to print, with the captures that each is about.
        self.done, self.warnings = {}, {}

    @property
    def files(self) -> list[Path]:
        """Files that correct the captures."""
        candidates = (self.correction.dark, self.correction.flat, self.correction.bad_pixels)
        return [path for path in candidates if isinstance(path, Path)]

    def imager(self, imager):
        """The microscope with the pixels of its captures."""
        import equinox as eqx

        self.sensor = imager.sensor
        return eqx.tree_at(lambda i: i.sensor, imager, self.readout.sensor(imager.sensor))

    def read(self, path: Path):
        """Read and correct a capture."""
        from ..io.camera import read_corrected

        return self._note(
            path, read_corrected(path, self.sensor, page=self.page, readout=self.readout, correction=self.correction)
        )

    def read_spots(self, paths: tuple[Path, ...], page: int | str | None):
        """Read and correct images of a point as planes, one for each page; or for each file with `page`.

        Single sharp pixels are kept. A colour capture and grey images of the point may be combined. Returns a list, as
        the planes may differ in size.
        """
        from ..io.recordings import read_spots

        spots = read_spots(paths, page=page, readout=self.readout, correction=self.correction)
        return [self._note(path, capture) for path, capture in spots]

    def _note(self, path, capture):
        for line in capture.done:
            self.done.setdefault(line, []).append(path)
        self.warnings |= dict.fromkeys(capture.warnings)
        return capture.image

    def frames(self, recording):
        """Read the correction of a recording; return the function that reads a frame.

        It returns the frame's image, float32, and lines about corrections and warnings of this frame alone.
        """
        import numpy as np

        from ..io.camera import prepare, read_frame
        from ..io.captures import Selection

        shape, readout = self.readout.region(self.sensor).shape, self.readout
        wanted = Selection(shape, None, readout.channel, readout.bayer)
        prepared = prepare(readout.sensor(self.sensor).shape, shape, readout, self.correction)
        self.done = {line: [Path(f"{len(recording.names)} frames")] for line in prepared.done}
        shared = [*prepared.done, *prepared.warnings]
        self.warnings |= dict.fromkeys(prepared.warnings)

        def read(frame):
            capture = read_frame(recording.names[frame], recording.images(frame, wanted), prepared, readout)
            done, warnings = (
                [line for line in lines if line not in shared] for lines in (capture.done, capture.warnings)
            )
            # One type for all frames, so that nothing is compiled twice.
            return np.asarray(capture.image, np.float32), done, warnings

        return read

    def recorded(self, provenance: dict[str, str]) -> dict[str, str]:
        """Add the corrections to a provenance."""
        from ..io.names import plain_text

        return provenance | ({"correction": plain_text("; ".join(self._lines()))} if self.done else {})

    def print_corrections(self) -> None:
        """Print what was corrected, a line each, and warnings on standard error."""
        for line in self._lines():
            click.echo(line)
        for line in self.warnings:
            click.echo(f"gs-jax: warning: {line}", err=True)

    def _lines(self):
        names = lambda paths: paths[0].name if len(paths) == 1 else f"{len(paths)} captures"
        return [f"{names(paths)}: {line}" for line, paths in self.done.items()]


def capture_options(command):
    """Add the options of captures; the command receives them as `camera`, a `CaptureOptions`."""
    return _with_camera(command, (*_FORMAT_OPTIONS, *_REGION_OPTIONS, *_CORRECTION_OPTIONS), CAPTURE_OPTIONS)


def picture_options(command):
    """As `capture_options`, without those that place the capture on a sensor."""
    return _with_camera(command, (*_FORMAT_OPTIONS, *_CORRECTION_OPTIONS), _PICTURE)


def given_options(names: Iterable[str]) -> list[str]:
    """Those of some options of the running command that its user gave, as `--name`."""
    source = click.get_current_context().get_parameter_source
    return [f"--{name.replace('_', '-')}" for name in names if source(name) is ParameterSource.COMMANDLINE]


def _with_camera(command, options, names):
    @functools.wraps(command)
    def wrapper(*args, **kwargs):
        camera = CaptureOptions(**{name: kwargs.pop(name) for name in names})
        return command(*args, camera=camera, **kwargs)

    for option in reversed(options):
        wrapper = option(wrapper)
    return wrapper


def depth_range(depths: list[float]) -> str:
    """The depths in words."""
    if len(depths) == 1:
        return f"at {depths[0]:g} mm"
    if len(depths) == 2:
        return f"2 depths, {depths[0]:g} and {depths[1]:g} mm"
    return f"{len(depths)} depths from {depths[0]:g} to {depths[-1]:g} mm"
