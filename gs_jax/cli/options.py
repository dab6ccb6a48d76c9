"""Arguments that several commands take, and names that one has.

Commands import what they run when they run: their help needs none of it. So the names of methods and models are here
again.
"""

import functools
import math
from pathlib import Path

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
