"""Terms of a study: objectives by name, in the unit that the name ends in.

A term's function takes an imager and its `Conditions` and gives a number or an array of them (over depths, lens types,
lenses, points). A term of your own is a callable of both, or `"module:name"` of one; see `Term`.
"""

import difflib
import importlib
import math
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import entry_points
from typing import NamedTuple, TypeVar, cast

from jaxtyping import Array, Float

from .. import objectives
from ..base.errors import short_repr
from .layout_terms import (
    conditioning,
    crowded_precision,
    flatness,
    ghosts,
    localization,
    log_error,
    log_error_for_exposure,
    shortage,
    volume_error,
)

Built = TypeVar("Built")

UM = 1000.0
# The group of entry points that are terms.
_GROUP = "gs_jax.terms"


class Term(NamedTuple):
    """A term: its meaning in words, and its function of an imager and `Conditions`.

    With `log` the function gives the value's logarithm; with `random` it takes a key as a third argument.
    """

    meaning: str
    function: Callable[..., Float[Array, "..."]]
    log: bool = False
    random: bool = False


def _scaled(unit, function):
    return lambda imager, at: unit * function(imager, at)


def _of_imager(function):
    return lambda imager, at: function(imager)


def _in_the_middle(function):
    return lambda imager, at: function(imager, at.middle)[..., 0]


TERMS: dict[str, Term] = {
    "lateral_resolution_um": Term("lateral resolution in focus (Eq. 5)", _scaled(UM, objectives.lateral_resolution)),
    "axial_resolution_um": Term("axial resolution in focus (Eq. 6)", _scaled(UM, objectives.axial_resolution)),
    "depth_of_field_mm": Term("depth of field (Eq. 8)", _in_the_middle(objectives.depth_of_field)),
    "depth_of_field_eq7_mm": Term("depth of field (Eq. 7)", _in_the_middle(objectives.approximate_depth_of_field)),
    "focus_offset": Term("focus from the middle of the depths, 1 at their ends", objectives.focus_offset),
    "blur_um": Term("diameter of the thin lens's blur, in the object", _scaled(UM, objectives.blur)),
    "strehl": Term("Strehl ratio over the field (Eqs. 9, 10)", objectives.log_strehl, log=True),
    "wavefront_waves": Term("RMS wavefront error over the field", objectives.wavefront_error),
    "lenses_per_point": Term("lenses that see a point, N_e", objectives.lenses_per_point),
    "occupancy": Term("occupancy V (Eq. 11)", objectives.occupancy),
    "light_percent": Term("share of a point's light that is used", _scaled(100, objectives.light)),
    "field_of_view_mm": Term("width of the field of view", objectives.field_of_view),
    "thickness_mm": Term("thickness: filters, plate and sensor distance", _of_imager(objectives.thickness)),
    "psf_width_um": Term("width of the spot (FWHM of its variance), in the object", _scaled(UM, objectives.spot_width)),
    "encircled_radius_um": Term("radius of 80 % of the rays, in the object", _scaled(UM, objectives.encircled_radius)),
    "depth_span_mm": Term("span of the depths", lambda _, at: at.depths[-1] - at.depths[0]),
    "spacing_mm": Term("distance of nearest lenses", _of_imager(objectives.spacing)),
    "web_mm": Term("mask left between neighbouring apertures", _of_imager(objectives.aperture_gap)),
    "hole_mm": Term("distance of a place on the plate from a lens", _of_imager(objectives.uncovered_distance)),
    "coverage": Term("share of the plate that is clear aperture", objectives.coverage),
    "sag_mm": Term("height of a whole lens", objectives.sag),
    "ghosts": Term("RMS sidelobe of the array PSF over its peak", ghosts, random=True),
    "lens_shortage": Term("mean over the plate of one over the lenses that see a point", shortage),
    "spectral_flatness": Term("flatness of the array PSF's spectrum, 1 if white", flatness, random=True),
    "condition_number": Term("largest over smallest power of that spectrum", conditioning, random=True),
    "localization_um": Term("least error of locating a point, x, y, z", localization, random=True),
    "reconstruction_error": Term("relative error of reconstructed scenes", log_error, log=True, random=True),
    "scene_error": Term(
        "relative error of reconstructed scenes, for an exposure", log_error_for_exposure, log=True, random=True
    ),
    "volume_error": Term("relative error of volumes, best linear estimate, for an exposure", volume_error),
    "crowded_precision_um": Term(
        "least error of locating a point in a scene, x, y, z, for an exposure", crowded_precision
    ),
    "edge_slope_deg": Term("slope at the clear aperture's rim", _scaled(180 / math.pi, objectives.edge_slope)),
    "least_radius_mm": Term("least radius of curvature of a lens's surface", objectives.surface_radius),
}

# As they are in every process, whatever a caller puts into the table.
_OURS = dict(TERMS)

_UNITS = {"um": "um", "mm": "mm", "deg": "degrees", "percent": "%", "waves": "waves"}


def check_term(name: str) -> None:
    """Whether there is a term of this name; those of other installed packages are looked up when they are asked for.

    A package has its own as entry points of the group `gs_jax.terms`, whose names are the terms' and whose objects are
    `Term`s. Python callers may also put theirs into `TERMS`; workers of a search get them. A name `"module:name"` is
    that of a `Term`, or of a callable of an imager and `Conditions`, in a module that Python can import.

    Raises `ValueError` if there is none.
    """
    if name not in TERMS and ":" in name:
        TERMS[name] = _imported(name)
    if name not in TERMS:
        TERMS.update({point.name: point.load() for point in entry_points(group=_GROUP, name=name)})
    if name not in TERMS:
        near = difflib.get_close_matches(name, TERMS, n=3) or list(TERMS)[:3]
        others = len(TERMS) - len(near)
        raise ValueError(f"name must be {', '.join(near)} or one of {others} others, got {short_repr(name)}")


def _imported(name: str) -> Term:
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"must be a term or `module:name` of one, got {short_repr(name)}: {error}") from error
    if isinstance(found, Term):
        return found
    if not callable(found):
        raise ValueError(f"`module:name` must name a callable or a `Term`, got {short_repr(found)}")
    words = (found.__doc__ or attribute).strip().splitlines()[0].rstrip(".")
    return Term(words, cast(Callable[..., Float[Array, "..."]], found))


def with_terms(build: Callable[[], Built], names: Iterable[str]) -> Callable[[], Built]:
    """`build` for another process, whose `TERMS` then are of these names what they are here: its own go with it."""
    terms = {name: None if TERMS[name] is _OURS.get(name) else TERMS[name] for name in names}
    return partial(_built_with, build, terms)


def _built_with(build, terms):
    TERMS.update({name: term or _OURS[name] for name, term in terms.items()})
    return build()


def unit_of(name: str) -> str:
    """The unit that a term's name ends in, as people write it; empty for a number without one."""
    return _UNITS.get(name.rpartition("_")[2], "")
