"""What tolerances cost: sensitivities by gradient, devices drawn at random, and how many of these come out well."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from ...base.errors import InputError
from ...base.progress import Progress
from ...design.datasheets import parts_of
from ...design.design import Design
from ...geometry import Imager
from ...layouts import check_positive
from ...objectives.conditions import Conditions
from ...objectives.paraxial import axial_resolution
from .depth_recovery import Bench, bench_of, depth_errors
from .device_model import LEVELS, RULED, Errors, drawn, in_units, no_errors, spreads_of, without
from .images import log_sharpness
from .tolerance_spec import Tolerances

# Depths of a caller who names none; devices at a time, and those of them whose rays are in memory together.
_DEPTHS, _BATCH, _TOGETHER = 5, 64, 8
# Directions in which lenses that differ are cut off by their neighbours: enough for the mean clear aperture to 1e-3.
_EDGES = 64
# What a device may be by default: so much wider spots, so much of the Strehl ratio where that says anything.
WIDER, KEPT, LEAST_STREHL = 1.2, 0.8, 0.1


class Measures(NamedTuple):
    """Of devices: logarithms of the spots' width, mm, and of the Strehl ratio, and how wrong depths are, mm.

    The last two are of the points of a `Bench`, found with the geometry of the design, and with a calibrated one.
    """

    log_width: Float[Array | np.ndarray, "*device depth"]
    log_strehl: Float[Array | np.ndarray, "*device depth"]
    designed: Float[Array | np.ndarray, "*device point"]
    calibrated: Float[Array | np.ndarray, "*device point"]


class Limits(NamedTuple):
    """What a device must keep at every depth: widths, mm, Strehl ratios (0 where none is asked), and depths, mm."""

    width: Float64[np.ndarray, " depth"]
    strehl: Float64[np.ndarray, " depth"]
    depth_error: Float64[np.ndarray, " depth"]


class Outcome(NamedTuple):
    """What was found.

    Parameters
    ----------
    design, tolerances, depths, limits
        What was asked.
    points
        Where depths are judged, mm: at each depth the same places, one after the other.
    nominal, devices
        As designed, and of the devices that were drawn, `(draw, ...)`.
    alone
        Of each tolerance, the RMS change of each measure that it makes alone: its derivative times its standard
        deviation; of those that every device has, the change itself.
    met
        By target, which devices keep it.
    yields_without
        The yield if one tolerance is zero.
    """

    design: str
    tolerances: Tolerances
    depths: Float64[np.ndarray, " depth"]
    points: Float64[np.ndarray, "point 3"]
    limits: Limits
    nominal: Measures
    devices: Measures
    alone: dict[str, Measures]
    met: dict[str, Bool[np.ndarray, " draw"]]
    yields_without: dict[str, float]

    @property
    def all_met(self) -> Bool[np.ndarray, " draw"]:
        """Which devices keep all targets."""
        return np.all(list(self.met.values()), axis=0)


class _Question(NamedTuple):
    """`parts`: the lenses of each type and their conditions. `pixel`: of the printer, mm."""

    parts: tuple[tuple[Imager, Conditions], ...]
    bench: Bench
    pixel: Float[Array, ""]


def tolerance(
    design: Design,
    tolerances: Tolerances = Tolerances(),
    *,
    depths: Sequence[float] | None = None,
    sources: Float64[np.ndarray, "source 3"] | None = None,
    max_width: float | None = None,
    min_strehl: float | None = None,
    max_depth_error: float | None = None,
    draws: int = 1000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Outcome:
    """What tolerances do to a microscope: sensitivities by gradient, devices drawn at random, and the yield.

    Parameters
    ----------
    design
        The microscope.
    tolerances
        Standard deviations of what is made.
    depths
        Where devices are judged, from the plate, mm; by default five over the working distance.
    sources
        Places `(x, y, z)` of the point sources by which devices are calibrated, mm, one a capture; see
        `gs_jax.apps.tolerance.depth_recovery.bench_of` for the default.
    max_width
        Of spots in the object, mm; by default 1.2 times the design's, depth by depth.
    min_strehl
        On the axis; by default 0.8 of the design's, at depths where that is 0.1 or more.
    max_depth_error
        Of calibrated devices, mm; by default the axial resolution (Eq. 6).
    draws, seed
        How many devices, and which ones.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If lenses are ideal, points are seen by fewer than two lenses, or an argument is not allowed.
    """
    progress = progress or Progress()
    asked = np.linspace(*design.imaging.working_distance_mm, _DEPTHS) if depths is None else np.array(depths, float)
    _check(design, asked, draws, max_width, min_strehl, max_depth_error)
    # Each device has clear apertures of its own.
    changes = {"directions": _EDGES, "clear_diameter": None}
    parts = tuple((one, dataclasses.replace(at, **changes)) for one, at in parts_of(design, asked))
    with progress.step("Tracing cores"):
        bench = bench_of(design.imager(), asked, sources)
    question = _Question(parts, bench, jnp.asarray(tolerances.pixel_um / 1000))
    spreads, lenses = spreads_of(tolerances), len(design.array.centers_mm)
    with progress.step("Gradients"):
        alone = _by_gradient(question, spreads)
    with progress.step("Nominal"):
        nominal, levels = _nominal_and_levels(question, spreads)
    limits = _limits(parts, nominal, max_width, min_strehl, max_depth_error)
    others = [name for name, field in RULED.items() if float(getattr(spreads, field)) > 0]
    variants = [spreads, *(without(spreads, name) for name in others)]
    units = jax.vmap(lambda key: drawn(key, lenses))(jax.random.split(jax.random.key(seed), draws))
    with progress.counter("Devices", len(variants) * -(-draws // _BATCH)) as done:
        made = [_of_devices(question, in_units(units, each), done) for each in variants]
    met = [_met(limits, devices) for devices in made]
    yields = [float(np.all(list(each.values()), axis=0).mean()) for each in met]
    points = np.asarray(bench.points.points, np.float64)
    kept = dict(zip(others, yields[1:], strict=True))
    return Outcome(design.name, tolerances, asked, points, limits, nominal, made[0], alone | levels, met[0], kept)


def _check(design, depths, draws, *targets) -> None:
    if design.lens.focal_length_mm is not None:
        found = f"found {design.lens.focal_length_mm:g}"
        raise InputError(f"`lens.focal_length_mm`: {found}, allowed: none, as ideal lenses have no surface.")
    if not depths.size or not np.isfinite(depths).all() or not (depths > 0).all():
        raise InputError(f"`depths` must be one or more positive lengths, mm, got {depths.tolist()}.")
    if draws < 1:
        raise InputError(f"`draws` must be one or more, got {draws}.")
    for name, target in zip(("max_width", "min_strehl", "max_depth_error"), targets, strict=True):
        if target is not None:
            check_positive(name, target)


@eqx.filter_jit
def _measured(question: _Question, errors: Errors) -> Measures:
    """Of several devices."""
    of_one = lambda each: Measures(*_sharpness(question, each), *depth_errors(question.bench, each))
    return jax.lax.map(of_one, errors, batch_size=_TOGETHER)


def _sharpness(question: _Question, errors: Errors) -> tuple[Float[Array, " depth"], Float[Array, " depth"]]:
    """`log_sharpness` of the type of lens that is best at each depth."""
    each = [log_sharpness(*part, errors, question.pixel) for part in question.parts]
    widths, ratios = (jnp.stack(parts) for parts in zip(*each, strict=True))
    return jnp.min(widths, 0), jnp.max(ratios, 0)


@eqx.filter_jit
def _slopes(question: _Question, nothing: Errors) -> tuple[dict[str, Array], ...]:
    """Each measure's derivatives by what is drawn, by fields of `Errors`; where lenses are does not change images."""
    named = {field: getattr(nothing, field) for name, field in RULED.items() if name not in LEVELS}
    shapes = {field: value for field, value in named.items() if field != "centers"}
    changed = lambda values: dataclasses.replace(nothing, **values)
    images = lambda values: _sharpness(question, changed(values))
    depths = lambda values: depth_errors(question.bench, changed(values))
    return (*jax.jacfwd(images)(shapes), *jax.jacfwd(depths)(named))


def _of_devices(question: _Question, errors: Errors, done=lambda: None) -> Measures:
    """In batches of one size, so that one program is compiled."""
    found, count = [], len(errors.radius)
    size = min(_BATCH, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        batch = _measured(question, jax.tree.map(lambda part, index=index: part[index], errors))
        found.append(Measures(*(np.asarray(part, np.float64)[: count - start] for part in batch)))
        done()
    return Measures(*map(np.concatenate, zip(*found, strict=True)))


def _nominal_and_levels(question: _Question, spreads: Errors) -> tuple[Measures, dict[str, Measures]]:
    """As designed, and what changes with what every device has: its square counts, so there is no slope at zero."""
    nothing = no_errors(len(question.bench.imager.array.centers))
    each = [dataclasses.replace(nothing, **{RULED[name]: getattr(spreads, RULED[name])}) for name in LEVELS]
    found = _of_devices(question, jax.tree.map(lambda *parts: jnp.stack(parts), nothing, *each))
    nominal, *levels = (Measures(*(part[row] for part in found)) for row in range(1 + len(LEVELS)))
    changes = [Measures(*(a - b for a, b in zip(level, nominal, strict=True))) for level in levels]
    return nominal, dict(zip(LEVELS, changes, strict=True))


def _by_gradient(question: _Question, spreads: Errors) -> dict[str, Measures]:
    """RMS change of each measure by each of what is drawn."""
    slopes, alone = _slopes(question, no_errors(len(question.bench.imager.array.centers))), {}
    for name, field in RULED.items():
        if name not in LEVELS:
            spread = float(getattr(spreads, field))
            alone[name] = Measures(*(spread * _length(each.get(field), each["radius"]) for each in slopes))
    return alone


def _length(slope: Array | None, one: Array) -> Float64[np.ndarray, "..."]:
    """Over all numbers of a kind; `one` is the slope by a single number. None is no slope."""
    flat = np.zeros((*one.shape, 1)) if slope is None else np.asarray(slope, np.float64).reshape(*one.shape, -1)
    return np.sqrt((flat**2).sum(-1))


def together(alone: dict[str, Measures]) -> Measures:
    """RMS change by all tolerances, by gradient: what is drawn adds up as squares, what every device has as it is."""
    drawn_ones = [alone[name] for name in alone if name not in LEVELS]
    levels = [alone[name] for name in alone if name in LEVELS]
    squares = (sum(part**2 for part in parts) for parts in zip(*drawn_ones, strict=True))
    shifts = (sum(parts) for parts in zip(*levels, strict=True))
    return Measures(*(np.sqrt(square + shift**2) for square, shift in zip(squares, shifts, strict=True)))


def _limits(parts: tuple[tuple[Imager, Conditions], ...], nominal: Measures, width, strehl, depth_error) -> Limits:
    everywhere = np.ones(len(parts[0][1].depths))
    axial = np.min([np.asarray(axial_resolution(*part), np.float64) for part in parts], axis=0)
    designed = np.exp(nominal.log_strehl)
    return Limits(
        WIDER * np.exp(nominal.log_width) if width is None else width * everywhere,
        np.where(designed >= LEAST_STREHL, KEPT * designed, 0.0) if strehl is None else strehl * everywhere,
        axial if depth_error is None else depth_error * everywhere,
    )


def _met(limits: Limits, devices: Measures) -> dict[str, Bool[np.ndarray, " draw"]]:
    errors = np.abs(devices.calibrated).reshape(len(devices.calibrated), len(limits.depth_error), -1)
    kept = {
        "spot width": np.exp(devices.log_width) <= limits.width,
        "Strehl ratio": np.exp(devices.log_strehl) >= limits.strehl,
        "depth": errors.max(-1) <= limits.depth_error,
    }
    return {name: np.asarray(each.all(1)) for name, each in kept.items()}
