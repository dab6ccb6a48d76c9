"""Terms of a study: objectives by name, in the unit that the name ends in.

A term's function takes an imager and its `Conditions` and gives a number or an array of them (over depths, lens types,
lenses, points). An `Objective` compares them with a target, for a solver. Terms of your own are added by a package's
entry point, by `add_terms`, or to `TERMS`; see `Term`. A study names terms, it never imports code.
"""

import difflib
import hashlib
import math
import runpy
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import entry_points
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from .. import objectives
from ..base.arrays import as_float
from ..base.errors import InputError, input_error, short_repr
from ..base.typing import PathLike, Real
from ..io.files import check_input, check_suffix
from ..microscope.geometry import Imager
from ..objectives.conditions import Conditions
from .linear_error import volume_error

Built = TypeVar("Built")

UM = 1000.0
# The group of entry points that are terms.
_GROUP = "gs_jax.terms"
GOALS = ("minimise", "maximise")
KINDS = ("at_most", "at_least", "equal", *GOALS)
SIGNS = {"at_most": "<=", "at_least": ">=", "equal": "=", "minimise": "min", "maximise": "max"}
# Exponent of the power mean that stands for the worst entry, and the largest logarithm of a ratio: e^50 does not
# overflow in float32.
_POWER, _LONGEST = 8, 50.0
# Terms that earlier versions called otherwise, which are still read.
_RENAMED = {"web_mm": "min_wall_mm"}
# Terms of earlier versions, all of which judged reconstructions or the layout.
_REMOVED = (
    "ghosts",
    "lens_shortage",
    "spectral_flatness",
    "condition_number",
    "localization_um",
    "crowded_precision_um",
    "reconstruction_error",
    "scene_error",
)


class Term(NamedTuple):
    """A term: its meaning in words, and its function of an imager and `Conditions`.

    With `log` the function gives the value's logarithm; with `random` it takes a key as a third argument. `source` is
    the hash of the file that `add_terms` read it from, by which a checkpoint knows whether its terms have changed.
    """

    meaning: str
    function: Callable[..., Float[Array, "..."]]
    log: bool = False
    random: bool = False
    source: str = ""


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
    "lenses_per_point": Term("lenses within the field radius of a point, N_e", objectives.lenses_per_point),
    "occupancy": Term("occupancy V of the lenses within the field radius (Eq. 11)", objectives.occupancy),
    "light_percent": Term(
        "share of a point's light that the lenses within the field radius collect", _scaled(100, objectives.light)
    ),
    "field_of_view_mm": Term("width of the field of view", objectives.field_of_view),
    "thickness_mm": Term("thickness: filters, plate and sensor distance", _of_imager(objectives.thickness)),
    "fwhm_um": Term("full width at half maximum of the PSF on the axis, in the object", _scaled(UM, objectives.fwhm)),
    "rms_width_um": Term("RMS width of the PSF, in the object", _scaled(UM, objectives.rms_width)),
    "half_light_radius_um": Term("radius of half the light, in the object", _scaled(UM, objectives.half_light_radius)),
    "psf_width_um": Term("2.355 times the RMS width of the PSF, in the object", _scaled(UM, objectives.spot_width)),
    "width_per_light_um": Term(
        "width of the spot over the fourth root of the light in percent", _scaled(UM, objectives.width_per_light)
    ),
    "encircled_radius_um": Term("radius of 80 % of the rays, in the object", _scaled(UM, objectives.encircled_radius)),
    "depth_span_mm": Term("span of the depths", lambda _, at: at.depths[-1] - at.depths[0]),
    "spacing_mm": Term("distance of nearest lenses", _of_imager(objectives.spacing)),
    "min_wall_mm": Term("mask left between neighbouring apertures", _of_imager(objectives.aperture_gap)),
    "hole_mm": Term(
        "distance of a point of the plate from the nearest lens", _of_imager(objectives.uncovered_distance)
    ),
    "coverage": Term("share of the plate that is clear aperture", objectives.coverage),
    "sag_mm": Term("height of a whole lens", objectives.sag),
    "volume_error": Term(
        "relative error of volumes by the best linear estimate from all lenses, for an exposure", volume_error
    ),
    "edge_slope_deg": Term("slope at the clear aperture's rim", _scaled(180 / math.pi, objectives.edge_slope)),
    "least_radius_mm": Term("least radius of curvature of a lens's surface", objectives.surface_radius),
}

# As they are in every process, whatever a caller puts into the table.
_OURS = dict(TERMS)

_UNITS = {"um": "um", "mm": "mm", "deg": "degrees", "percent": "%", "waves": "waves"}


def current_name(name: str) -> str:
    """The name of a term that may be an earlier version's."""
    return name if name in TERMS else _RENAMED.get(name, name)


def check_term(name: str) -> None:
    """Raise `ValueError` unless `name` is a registered term; load it from an entry point if needed.

    An installed package registers its terms as entry points of the group `gs_jax.terms`, whose names are those of the
    terms and whose objects are `Term`s.
    """
    if name not in TERMS:
        TERMS.update({point.name: point.load() for point in entry_points(group=_GROUP, name=name)})
    if name in _REMOVED and name not in TERMS:
        raise ValueError(f"name: {name} is no longer a term; volume_error judges layouts and reconstructions")
    if name not in TERMS:
        near = difflib.get_close_matches(name, TERMS, n=3) or list(TERMS)[:3]
        others = len(TERMS) - len(near)
        own = "; a study imports no code, --terms FILE.py adds terms of your own" if ":" in name else ""
        raise ValueError(f"name must be {', '.join(near)} or one of {others} others, got {short_repr(name)}{own}")


def add_terms(path: PathLike) -> None:
    """Run a Python file and add its terms to `TERMS`.

    The file defines a dictionary `TERMS` from names to `Term`s. Workers of a search get the terms, not the file.

    Raises `InputError` if the file cannot be read or run, has no such dictionary, or redefines a term.
    """
    check_suffix(path, (".py",))
    source = hashlib.sha256(check_input(path).read_bytes()).hexdigest()
    try:
        own = runpy.run_path(str(path), run_name="gs_jax_terms").get("TERMS")
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path}: cannot be run: {reason.rstrip('.')}.") from error
    terms = own.items() if isinstance(own, dict) else ()
    if not terms or not all(isinstance(name, str) and isinstance(term, Term) for name, term in terms):
        raise input_error("TERMS", "a dictionary from names to `gs_jax.codesign.terms.Term`", short_repr(own), path)
    if twice := [name for name, term in terms if name in TERMS and TERMS[name].source != source]:
        raise input_error("TERMS", "names that are no terms yet", twice[0], path)
    TERMS.update({name: term._replace(source=source) for name, term in terms})


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


def evaluate(term: Term, imager: Imager, at: Conditions, key: Key[Array, ""]) -> Float[Array, " entry"]:
    """Entries of a term, in its unit."""
    entries = _entries(term, imager, at, key)
    return jnp.exp(entries) if term.log else entries


class Objective(eqx.Module):
    """A term as a search sees it: its kind, `at_most` and so on, its target in the term's unit, and its weight."""

    term: Term = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    target: Float[Array, ""] = eqx.field(converter=as_float)
    weight: Float[Array, ""] = eqx.field(converter=as_float)

    def residual(self, imager: Imager, at: Conditions, key: Key[Array, ""], *, margin: Real) -> Float[Array, " entry"]:
        """Residual of a term, relative to its target: zero where a limit holds, so that its square is smooth.

        `ln(1 + relu(x/t - (1 - margin)))` for at most, `relu(1 + margin - x/t)` for at least, `x/t - 1` for equal;
        times the weight over the root of the number of entries. For a term that is a logarithm `ln(x/t)` takes the
        place of `x/t - 1` in a limit. For a goal it is one entry, the mean of `(x/t)^8` (or `(t/x)^8`) to the power
        1/8.

        `margin`: fraction by which a limit is tightened.
        """
        ratio = self._ratio(_entries(self.term, imager, at, key))
        missing = _missing(self.kind, ratio, jnp.asarray(margin, ratio.dtype))
        return missing * (self.weight.astype(ratio.dtype) / math.sqrt(missing.size))

    def _ratio(self, entries: Float[Array, " entry"]) -> Float[Array, " entry"]:
        if not self.term.log:
            return entries / self.target
        logarithm = entries - jnp.log(self.target)
        # A goal needs a positive ratio.
        is_goal = self.kind in GOALS
        return jnp.exp(jnp.clip(logarithm, -_LONGEST, _LONGEST)) if is_goal else 1 + logarithm


def _missing(kind: str, ratio: Float[Array, " entry"], margin: Float[Array, ""]) -> Float[Array, " _"]:
    match kind:
        case "at_most":
            return jnp.log1p(jax.nn.relu(ratio - (1 - margin)))
        case "at_least":
            return jax.nn.relu(1 + margin - ratio)
        case "equal":
            return ratio - 1
        case "minimise":
            return _power_mean(ratio)
        case _:
            positive = ratio > 0
            return _power_mean(jnp.where(positive, 1 / jnp.where(positive, ratio, 1), 1e6))


def _power_mean(x: Float[Array, " entry"]) -> Float[Array, "1"]:
    """Power mean of non-negative numbers; zero, with zero slope, where all are zero."""
    largest = jax.lax.stop_gradient(jnp.max(x))
    largest = jnp.where(largest > 0, largest, 1)
    mean = jnp.mean((x / largest) ** _POWER)
    positive = mean > 0
    return jnp.where(positive, largest * jnp.where(positive, mean, 1) ** (1 / _POWER), 0)[None]


def _entries(term, imager, at, key):
    entries = jnp.ravel(term.function(imager, at, key) if term.random else term.function(imager, at))
    if not jnp.issubdtype(entries.dtype, jnp.floating):
        # They have no slope: a search would stay where it begins.
        raise input_error(f"a term ({term.meaning})", "of floating point", entries.dtype)
    return entries
