"""Options of the light's path that several commands share: the sample, the wavelength and the origin of depths."""

import functools
import warnings
from collections.abc import Iterable
from typing import Any, NamedTuple

import click

from ..base.errors import InputError
from .options import NEAREST, Number

_NM, _SURFACE = Number(10.0, 1e5, "nm"), Number(0.0, 1e4, "mm", usual=(0.0, 2000.0))


class Light(NamedTuple):
    """What holds the object, at which wavelength it is seen, and what depths count from."""

    sample: str | None
    refractive_index: float | None
    surface: float | None
    wavelength_nm: float | None
    depths_from: str = "array"

    def imager(self, design) -> Any:
        """The geometry of a design with these."""
        from ..layers import Sample

        sample = self.sample if self.refractive_index is None else Sample(self.refractive_index, self.surface)
        return design.imager(sample, self.wavelength_nm)

    def design(self, design) -> Any:
        """The design with these in place of its own, whose working distance begins in the object's medium."""
        from ..design.conversion import object_begins, sample_table

        changes: dict[str, Any] = {} if self.wavelength_nm is None else {"wavelength_nm": self.wavelength_nm}
        if self.refractive_index is not None:
            changes["sample"] = {"refractive_index": self.refractive_index, "surface_mm": self.surface}
        elif self.sample is not None or design.samples:
            changes["sample"] = sample_table(design, self.sample)
        changed = design.replace(**changes) if changes else design
        begins, (near, far) = object_begins(changed), changed.imaging.working_distance_mm
        return changed if near >= begins else changed.replace(working_distance_mm=(begins, far))

    def working_distance(self, design, imager) -> tuple[float, float]:
        """Nearest and farthest object of a design, in this medium, mm."""
        near, far = design.imaging.working_distance_mm
        return max(near, float(str(imager.sample_surface))), far

    def origin(self, imager) -> float | None:
        """Depth from which depths count, mm; None if it is the array."""
        if self.depths_from == "array":
            return None
        if imager.sample is None:
            raise InputError("--depths-from sample must be used with a sample, got air.")
        return float(str(imager.sample_surface))

    def from_array(self, depths: list[float], imager) -> list[float]:
        """Depths of the command line, counted from the array."""
        origin = self.origin(imager)
        moved = depths if origin is None else [round(depth + origin, 9) for depth in depths]
        if min(moved) < NEAREST:
            raise InputError(f"--depths must be {NEAREST:g} mm or more from the array, got {min(moved):g}.")
        check_beyond(imager, moved, "--depths")
        return moved


def objects_in(imager) -> str:
    """The medium that a command takes to hold the object, in words."""
    from ..design.conversion import medium_in_words

    return f"objects in {medium_in_words(imager)}"


def ask_for_unit(path, points) -> None:
    """Warn, as for keys of designs, if all of several points of a file are so far away that they may be in um."""
    from ..base.errors import InputWarning
    from ..design.validation import USUAL, slip

    depths, key = points[:, 2], "imaging.working_distance_mm"
    if len(depths) > 1 and (depths > USUAL[key][1]).all():
        ends = sorted({float(depths.min()), float(depths.max())})
        if question := slip(key, ends, "z_mm"):
            warnings.warn(f"{path}: {question}", InputWarning, stacklevel=2)


def check_beyond(imager, depths: Iterable[float], name: str) -> None:
    """As `gs_jax.geometry.check_beyond`, whose import takes long."""
    from ..geometry import check_beyond

    check_beyond(imager, depths, name)


def sample_options(command):
    """Add the options of sample and wavelength; the command receives `light`, a `Light`."""

    @functools.wraps(command)
    def wrapper(*args, sample, sample_index, sample_at, wavelength_nm, depths_from="array", **kwargs):
        if (sample_index is None) != (sample_at is None):
            given, other = ("--sample-at", "--sample-index")[:: 1 if sample_index is None else -1]
            raise InputError(f"{given} must be used with {other}.")
        if sample is not None and sample_index is not None:
            raise InputError("--sample must be used without --sample-index and --sample-at.")
        light = Light(sample, sample_index, sample_at, wavelength_nm, depths_from)
        return command(*args, light=light, **kwargs)

    for option in reversed(_SAMPLE_OPTIONS):
        wrapper = option(wrapper)
    return wrapper


# Names of the options of `sample_options`.
LIGHT_OPTIONS = ("sample", "sample_index", "sample_at", "wavelength_nm")
_SAMPLE_OPTIONS = (
    click.option("--sample", help="NAME of one of [samples] in DESIGN, or none for air.  [default: DESIGN's [sample]]"),
    click.option("--sample-index", type=Number(1.0, 5.0), help="Refractive index of the object's medium."),
    click.option("--sample-at", type=_SURFACE, help="Depth at which that medium begins."),
    click.option("--wavelength-nm", type=_NM, help="Wavelength of the light.  [default: DESIGN's]"),
)


def light_options(command):
    """As `sample_options`, with `--depths-from`."""
    return click.option(
        "--depths-from",
        type=click.Choice(["array", "sample"]),
        default="array",
        help="What depths count from: the array's front, or the sample's surface. Files say which.",
    )(sample_options(command))
