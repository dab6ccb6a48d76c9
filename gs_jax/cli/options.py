"""Types of options, and options that several commands share: of captures, of the light's path, and of workers.

Commands import what they run only when they run, so that their help is quick. So the names of methods and models are
repeated here.
"""

import itertools
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import click

from ..base.errors import InputError, InputWarning, input_error
from ..base.workers import Workers
from .commands import OptionGroup, print_warning

# Far more planes than any sensor resolves; a mistyped step asks for millions.
_MAX_DEPTHS = 10_000
# Depths beyond are in another unit: the farthest usual object of designs, mm.
_FARTHEST = 2000.0
# Nearest depth that a file of volumes may have, mm.
NEAREST = 1e-6
# Voxels along the side of a tile, which its margin would otherwise outnumber.
_LEAST_TILE = 16

METHODS = ("backproject", "list-rl", "richardson-lucy", "fista", "admm", "unrolled", "surface")
SUPPRESSIONS = ("none", "points", "clusters", "unet")
FIDELITIES = ("full", "near", "pinhole")
SIMULATED = ("full", "near")
PSFS = ("diffraction", "geometric", "gaussian")


class Number(click.ParamType):
    """A number within bounds. A length beyond the `usual` ones that would be one of them in another unit is refused."""

    def __init__(self, least: float, most: float, unit: str = "", usual: tuple[float, float] | None = None):
        self.least, self.most, self.unit, self.name, self.usual = least, most, unit, unit or "number", usual

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


def parse_depths(text: str, *, least: float = NEAREST, usual: float = _FARTHEST) -> list[float]:
    """Depths of `START:STOP:STEP` in mm, inclusive of STOP when it falls on the step; of a list, `10,40`; or one depth.

    Raises `click.BadParameter` for depths below `least` or not in order, and for those beyond `usual` that look as if
    they were in another unit.
    """

    def check(is_right: bool, allowed: str, remark: str = "") -> None:
        if not is_right:
            raise click.BadParameter(f"must {allowed}, got {text!r}{remark}.")

    is_range, start, stop, step = ":" in text, 0.0, 0.0, 1.0
    try:
        numbers = [float(number) for number in text.split(":" if is_range else ",")]
        if is_range:
            start, stop, step = numbers
    except ValueError:
        check(False, "be START:STOP:STEP in mm, such as 18:22:0.25, or a list such as 10,40, or one depth")
        raise
    if is_range:
        is_right = all(map(math.isfinite, numbers)) and least <= start <= stop and step > 0
        check(is_right, f"have {least:g} <= START <= STOP and STEP > 0, in mm")
        # A step that misses STOP by rounding alone falls on it.
        count = (stop - start) / step + 1 + 1e-6
        check(count <= _MAX_DEPTHS + 1, f"have at most {_MAX_DEPTHS} depths", f", {count:.3g} depths")
        depths = [round(start + i * step, 9) for i in range(int(count))]
    else:
        check(all(least <= depth < math.inf for depth in numbers), f"be depths of {least:g} mm or more")
        check(all(after > before for before, after in itertools.pairwise(numbers)), "be depths in ascending order")
        depths = numbers
    if max(numbers) > usual and (question := _other_unit(numbers, (0.0, _FARTHEST), "mm")):
        raise click.BadParameter(question)
    return depths


class Parsed(click.ParamType):
    """A value that a function makes of its text, which raises `click.BadParameter`."""

    def __init__(self, name: str, parse: Callable[[str], Any]):
        self.name, self.parse = name, parse

    def convert(self, value, param, ctx):
        return self.parse(value) if isinstance(value, str) else value


def find_design(name: str) -> Path:
    """The path of a design file, or of a design that comes with the package, by its name."""
    path = Path(name)
    if path.parent == Path() and not path.suffix and not path.exists():
        return next((shipped for shipped in shipped_designs() if shipped.stem == name), path)
    return path


def _page(text: str) -> int | str:
    if text == "mean":
        return text
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise click.BadParameter(f"must be a page, 1 or more, or mean, got {text!r}.")


def _region(text: str) -> tuple[int, ...]:
    numbers = text.split(",")
    if len(numbers) != 4 or not all(number.strip().isdecimal() for number in numbers):
        raise click.BadParameter(f"must be ROW,COLUMN,ROWS,COLUMNS in pixels, from 0, got {text!r}.")
    return tuple(map(int, numbers))


def shipped_designs() -> list[Path]:
    """The designs that come with the package; in a checkout, those in its folder."""
    inside = Path(__file__).parents[1] / "design" / "shipped"
    return sorted((inside if inside.is_dir() else Path(__file__).parents[2] / "design").glob("*.toml"))


def _tile_side(text: str) -> int | str:
    if text == "auto" or text.isdecimal() and int(text) >= _LEAST_TILE:
        return text if text == "auto" else int(text)
    raise click.BadParameter(f"must be auto, or voxels along a side, {_LEAST_TILE} or more, got {text!r}.")


DesignPath = Annotated[Path, Parsed("design", find_design)]
Page = Annotated[int | str, Parsed("n|mean", _page)]
TileSide = Annotated[int | str, Parsed("auto|voxels", _tile_side)]
_DEPTHS = "start:stop:step|z,z,..."
DepthList = Annotated[list[float], Parsed(_DEPTHS, parse_depths)]
# From the sample's surface, where 0 is a depth; and of any mask, whose objects may be metres away.
SampleDepthList = Annotated[list[float], Parsed(_DEPTHS, partial(parse_depths, least=0.0))]
MaskDepthList = Annotated[list[float], Parsed(_DEPTHS, partial(parse_depths, usual=1e5))]
Steps = Annotated[int, click.IntRange(1, 100_000)]
Seed = Annotated[int, click.IntRange(0, 2**31 - 1)]
Binning = Annotated[int, click.IntRange(1, 64)]
# Lengths on a plate; and in the image or the object, of a voxel or a blur.
Mm = Annotated[float, Number(1e-3, 1e4, "mm", usual=(0.005, 500.0))]
Um = Annotated[float, Number(1e-2, 1e6, "um", usual=(0.1, 2e4))]
Counts = Annotated[float, Number(0.0, 65535.0, "counts")]


class WorkerOptions(Workers, OptionGroup):
    """The workers of a command, which enters them when there is work.

    Options:
        workers: Number of processes on this machine that share the work. Needs pip install 'gs-jax[cluster]'.
            [default: this process]
        scheduler: Dask scheduler whose workers do the work: tcp://HOST:8786.
    """

    def __init__(self, workers: Annotated[int, click.IntRange(1, 1000)] | None = None, scheduler: str | None = None):
        super().__init__(workers, scheduler)


@dataclass
class PictureOptions(OptionGroup):
    """Reads captures of any camera, and collects what was corrected in them.

    Options:
        page: Page of a capture of several, from 1; or mean, to average repeated frames.
        channel: red, green or blue of a colour capture or a --bayer mosaic; or a channel of CAPTURE, by its name or its
            number from 1. Of several, separated by commas, `reconstruct` makes one volume, each at the wavelength of
            [channels.NAME] in DESIGN.
        bayer: The capture is a raw mosaic whose first pixels are these. Nothing is interpolated.
        dark: DARK.tif: dark frame of the capture's exposure; several pages are averaged.
        flat: FLAT.tif: even light on the sensor without the array; several pages are averaged.
        bad_pixels: MASK.png, nonzero at bad pixels; none; or auto: hot pixels of DARK, or isolated ones of the capture.
        offset: Counts of a dark pixel, if there is no --dark.
    """

    page: Page | None = None
    channel: str | None = None
    bayer: Annotated[str, click.Choice(["RGGB", "BGGR", "GRBG", "GBRG"])] | None = None
    dark: Path | None = None
    flat: Path | None = None
    bad_pixels: str = "auto"
    offset: Counts = 0.0
    # Lines to print, with the captures that each is about, and warnings.
    done: dict[str, list[Path]] = field(default_factory=dict, init=False)
    warnings: dict[str, None] = field(default_factory=dict, init=False)
    sensor: Any = field(default=None, init=False)
    # The whole sensor, without binning.
    roi, binning = None, 1

    @cached_property
    def readout(self):
        from ..io.camera import Readout

        return Readout(self.roi, self.binning, self.bayer, self.channel)

    @cached_property
    def correction(self):
        from ..io.camera import Correction

        mask = self.bad_pixels if self.bad_pixels in ("auto", "none") else Path(self.bad_pixels)
        return Correction(self.dark, self.flat, mask, self.offset)

    @property
    def files(self) -> list[Path]:
        """Files that correct the captures."""
        candidates = (self.correction.dark, self.correction.flat, self.correction.bad_pixels)
        return [path for path in candidates if isinstance(path, Path)]

    def read(self, path: Path):
        """Read and correct a capture."""
        from ..io.camera import read_corrected

        options = {"page": self.page, "readout": self.readout, "correction": self.correction}
        return self._note(path, read_corrected(path, self.sensor, **options))

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

    def recorded(self, provenance: dict[str, str]) -> dict[str, str]:
        """Add the corrections to a provenance."""
        from ..io.names import plain_text

        return provenance | ({"correction": plain_text("; ".join(self._lines()))} if self.done else {})

    def print_corrections(self) -> None:
        """Print what was corrected, a line each, and warnings on standard error."""
        for line in self._lines():
            click.echo(line)
        for line in self.warnings:
            print_warning(line)

    def _lines(self) -> list[str]:
        return [
            f"{paths[0].name if len(paths) == 1 else f'{len(paths)} captures'}: {line}"
            for line, paths in self.done.items()
        ]


@dataclass
class CaptureOptions(PictureOptions):
    """Reads captures by the sensor of a design.

    Options:
        roi: Region of the sensor that the capture covers, in unbinned pixels.
        binning: Side of the squares of pixels that the camera combined.
    """

    roi: Annotated[tuple[int, ...], Parsed("row,column,rows,columns", _region)] | None = None
    binning: Binning = 1

    def imager(self, imager):
        """The microscope with the pixels of its captures."""
        import equinox as eqx

        self.sensor = imager.sensor
        return eqx.tree_at(lambda i: i.sensor, imager, self.readout.sensor(imager.sensor))

    def read_frame(self, path: Path, recording):
        """Read and correct the first frame of a recording, as `read` does a capture."""
        image, done, warnings = self.frames(recording)(0)
        self.done = dict.fromkeys([*done, *self.done], [path])
        self.warnings |= dict.fromkeys(warnings)
        return image

    def frames(self, recording):
        """Read the correction of a recording; return the function that reads a frame.

        It returns the frame's image, and lines about corrections and warnings of this frame alone.
        """
        from ..io.camera import prepare, read_frame
        from ..io.captures import Selection, is_grey

        shape, readout = self.readout.region(self.sensor).shape, self.readout
        selection = Selection(shape, None, readout.channel, readout.bayer)
        # Zarr stores, which have no files, are grey.
        grey = not recording.files or is_grey(recording.files[0], self.page, readout.channel)
        prepared = prepare(readout.sensor(self.sensor).shape, shape, readout, self.correction, grey)
        self.done = {line: [Path(f"{len(recording.names)} frames")] for line in prepared.done}
        shared = [*prepared.done, *prepared.warnings]
        self.warnings |= dict.fromkeys(prepared.warnings)

        def read(frame):
            capture = read_frame(recording.names[frame], recording.images(frame, selection), prepared, readout)
            done, warnings = (
                [line for line in lines if line not in shared] for lines in (capture.done, capture.warnings)
            )
            return capture.image, done, warnings

        return read


# Options of captures, and of `Light`, by name.
CAPTURE_OPTIONS = ("page", "channel", "bayer", "dark", "flat", "bad_pixels", "offset", "roi", "binning")
LIGHT_OPTIONS = ("sample", "sample_index", "sample_at", "wavelength_nm")


@dataclass(frozen=True)
class Light(OptionGroup):
    """The medium of the object, and the wavelength at which it is seen.

    Options:
        sample: NAME of one of [samples] in DESIGN, or none for air. [default: DESIGN's [sample]]
        sample_index: Refractive index of the object's medium.
        sample_at: Depth at which that medium begins.
        wavelength_nm: Wavelength of the light. [default: DESIGN's]
    """

    sample: str | None = None
    sample_index: Annotated[float, Number(1.0, 5.0)] | None = None
    sample_at: Annotated[float, Number(0.0, 1e4, "mm", usual=(0.0, _FARTHEST))] | None = None
    wavelength_nm: Annotated[float, Number(10.0, 1e5, "nm")] | None = None

    def __post_init__(self):
        if (self.sample_index is None) != (self.sample_at is None):
            given, other = ("--sample-at", "--sample-index")[:: 1 if self.sample_index is None else -1]
            raise InputError(f"{given} must be used with {other}.")
        if self.sample is not None and self.sample_index is not None:
            raise InputError("--sample must be used without --sample-index and --sample-at.")

    def imager(self, design) -> Any:
        """The geometry of a design with these."""
        from ..microscope.media import Sample

        sample = self.sample if self.sample_index is None else Sample(self.sample_index, self.sample_at)
        return design.imager(sample, self.wavelength_nm)

    def of_channel(self, design, name: str | None) -> Any:
        """These, with the wavelength that a design lists for a channel, which is printed, unless another was given.

        Warns if a design lists channels, but not this one.
        """
        if not name or not design.channels or self.wavelength_nm:
            return self
        listed = find_channel(design, name)
        if listed not in design.channels:
            names, used = ", ".join(design.channels), design.imaging.wavelength_nm
            print_warning(f"--channel {name} is none of [channels] in the design, {names}: {used:g} nm is used")
            return self
        wavelength = design.channels[listed].wavelength_nm
        click.echo(f"--channel {name}: {listed} at {wavelength:g} nm")
        return replace(self, wavelength_nm=wavelength)

    def read_design(self, path: Path) -> Any:
        """Read a design, with these in place of its own; its working distance begins in the object's medium."""
        from ..design.conversion import object_begins, sample_table
        from ..design.design import read_design

        design, changes = read_design(path), {}
        if self.wavelength_nm is not None:
            changes["wavelength_nm"] = self.wavelength_nm
        if self.sample_index is not None:
            changes["sample"] = {"refractive_index": self.sample_index, "surface_mm": self.sample_at}
        elif self.sample is not None or design.samples:
            changes["sample"] = sample_table(design, self.sample)
        changed = design.replace(**changes) if changes else design
        start, (near, far) = object_begins(changed), changed.imaging.working_distance_mm
        return changed if near >= start else changed.replace(working_distance_mm=(start, far))


@dataclass(frozen=True)
class DepthLight(Light):
    """As `Light`, with the origin of depths.

    Options:
        depths_from: What depths count from: the array's front, or the sample's surface. Files say which.
    """

    depths_from: Annotated[str, click.Choice(["array", "sample"])] = "array"

    def origin(self, imager) -> float | None:
        """Depth from which depths count, mm; None if it is the array."""
        if self.depths_from == "array":
            return None
        if imager.sample is None:
            raise InputError("--depths-from sample must be used with a sample, got air.")
        return float(str(imager.sample_surface))

    def from_array(self, depths: list[float], imager) -> list[float]:
        """Depths of the command line, counted from the array."""
        from ..microscope.geometry import check_beyond

        origin = self.origin(imager)
        moved = depths if origin is None else [round(depth + origin, 9) for depth in depths]
        if min(moved) < NEAREST:
            raise InputError(f"--depths must be {NEAREST:g} mm or more from the array, got {min(moved):g}.")
        check_beyond(imager, moved, "--depths")
        return moved


def find_channel(design, name: str) -> str:
    """The name of a channel as a design spells it, whatever its case here; unchanged if the design does not list it."""
    same = [own for own in design.channels if own.lower() == name.strip().lower()]
    return name.strip() if name.strip() in same or not same else same[0]


def objects_in(imager) -> str:
    """The medium that a command takes to hold the object, as text."""
    from ..design.conversion import format_medium

    return f"objects in {format_medium(imager)}"


def ask_for_unit(path, points) -> None:
    """Warn, as for keys of designs, if all of several points of a file are so far away that they may be in um."""
    from ..design.validation import USUAL, slip

    depths, key = points[:, 2], "imaging.working_distance_mm"
    if len(depths) > 1 and (depths > USUAL[key][1]).all():
        ends = sorted({float(depths.min()), float(depths.max())})
        if question := slip(key, ends, "z_mm"):
            warnings.warn(f"{path}: {question}", InputWarning, stacklevel=2)


def check_even(output: Path, depths: list[float] | None) -> None:
    """Raise `InputError` before the work if a file has one step for all depths, and they are uneven."""
    if output.suffix.lower() != ".zarr" or not depths or len(depths) < 3:
        return
    steps = [after - before for before, after in itertools.pairwise(depths)]
    if max(steps) - min(steps) > 1e-6 * max(depths):
        raise input_error("depths", "in even steps for OME-Zarr", "uneven ones; use .ome.tif", output)


def voxels(shape: Iterable[int], axes: str, pitch: float, depths: list[float], imager) -> str:
    """Size, pitch, depths and medium of a volume, as text."""
    size = f"{' x '.join(map(str, shape))} voxels ({axes}), {pitch * 1000:.4g} um laterally"
    return f"{size}, {depth_range(depths)}, {objects_in(imager)}"


def depth_range(depths: list[float]) -> str:
    """The depths as text."""
    if len(depths) == 1:
        return f"at {depths[0]:g} mm"
    if len(depths) == 2:
        return f"2 depths, {depths[0]:g} and {depths[1]:g} mm"
    return f"{len(depths)} depths from {depths[0]:g} to {depths[-1]:g} mm"
