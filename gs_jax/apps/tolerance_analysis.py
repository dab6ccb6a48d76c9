"""Tolerance analysis of a design: sensitivities by gradient, random devices, and the yield."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from ..base.errors import InputError
from ..base.progress import Progress
from ..design.datasheets import parts_of
from ..design.design import Design
from ..geometry import Imager, check_beyond
from ..layouts import check_positive
from ..objectives.conditions import Conditions
from ..objectives.quantities import axial_resolution
from .device_model import (
    CONSTANT,
    ERROR_FIELDS,
    CoreModel,
    Errors,
    VisiblePoints,
    depth_arguments,
    depth_errors,
    log_sharpness,
    no_errors,
    sample_errors,
    standard_deviations,
    without_tolerance,
)
from .tolerance_spec import ToleranceSpec

# Default number of depths; devices per compiled call, and those whose rays are in memory at once.
_DEPTHS, _BATCH = 5, 8
# Default limits, relative to the design: spot width, and Strehl ratio where that is at least so large.
MAX_WIDTH, MIN_STREHL, LEAST_STREHL = 1.2, 0.8, 0.1


class Measures(NamedTuple):
    """Logarithms of the spot width, mm, and of the Strehl ratio, and depth errors, mm, of devices.

    Depth errors are with the geometry of the `designed` and of the `calibrated` device.
    """

    log_width: Float[Array | np.ndarray, "*device depth"]
    log_strehl: Float[Array | np.ndarray, "*device depth"]
    designed: Float[Array | np.ndarray, "*device point"]
    calibrated: Float[Array | np.ndarray, "*device point"]


class Limits(NamedTuple):
    """Limits of a good device: widths and depth errors at most, mm, Strehl ratios at least (0 is no limit)."""

    width: Float64[np.ndarray, " depth"]
    strehl: Float64[np.ndarray, " depth"]
    depth_error: Float64[np.ndarray, " depth"]


class Outcome(NamedTuple):
    """Result of a tolerance analysis.

    Parameters
    ----------
    design, tolerances, depths, limits
        The input, with defaults.
    points
        Where depth errors are evaluated, mm: the same places at each depth, depth by depth.
    nominal, devices
        Measures as designed, and of the random devices.
    alone
        The RMS change of each measure by one tolerance: its derivative times the standard deviation; of tolerances that
        are the same for every device, the change itself.
    met
        By target, which devices meet it.
    yields_without
        The yield if one tolerance is zero.
    """

    design: str
    tolerances: ToleranceSpec
    depths: Float64[np.ndarray, " depth"]
    points: Float64[np.ndarray, "point 3"]
    limits: Limits
    nominal: Measures
    devices: Measures
    alone: dict[str, Measures]
    met: dict[str, Bool[np.ndarray, " device"]]
    yields_without: dict[str, float]

    @property
    def all_met(self) -> Bool[np.ndarray, " device"]:
        """Which devices meet all targets."""
        return np.all(list(self.met.values()), axis=0)


class Problem(NamedTuple):
    """The lenses of each type and their conditions, the arguments of `depth_errors`, and the printer's pixel, mm."""

    parts: tuple[tuple[Imager, Conditions], ...]
    depth_arguments: tuple[Imager, CoreModel, VisiblePoints, VisiblePoints]
    pixel: Float[Array, ""]


def make_problem(
    design: Design,
    depths: Float64[np.ndarray, " depth"],
    sources: Float64[np.ndarray, "source 3"] | None = None,
    pixel: float = 0.005,
) -> Problem:
    """The problem of a design at some depths, mm."""
    # Each device has clear apertures of its own.
    parts = tuple((one, dataclasses.replace(at, clear_diameter=None)) for one, at in parts_of(design, depths))
    return Problem(parts, depth_arguments(design.imager(), depths, sources), jnp.asarray(pixel))


def tolerance(
    design: Design,
    tolerances: ToleranceSpec = ToleranceSpec(),
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
    """Analyse the tolerances of a microscope: sensitivities by gradient, random devices, and the yield.

    Parameters
    ----------
    design
        The microscope.
    tolerances
        Standard deviations of the fabrication errors.
    depths
        Where devices are evaluated, from the plate, mm; by default five over the working distance.
    sources
        Positions `(x, y, z)` of the point sources that devices are calibrated with, mm; by default those of
        `gs_jax.apps.device_model.depth_arguments`.
    max_width
        Of spots in the object, mm; by default 1.2 times the design's, depth by depth.
    min_strehl
        On the axis; by default 0.8 of the design's, at depths where that is 0.1 or more.
    max_depth_error
        Of calibrated devices, mm; by default the axial resolution (Eq. 6).
    draws, seed
        Number of random devices, and their seed.

    Raises
    ------
    InputError
        If lenses are ideal, fewer than two lenses see a point, or an argument is out of range.
    """
    progress = progress or Progress()
    z = np.linspace(*design.imaging.working_distance_mm, _DEPTHS) if depths is None else np.array(depths, float)
    if (focal := design.lens.focal_length_mm) is not None:
        raise InputError(f"`lens.focal_length_mm` must be left out, as ideal lenses have no surface, got {focal:g}.")
    if not z.size or not np.isfinite(z).all() or not (z > 0).all():
        raise InputError(f"`depths` must be one or more positive lengths, mm, got {z.tolist()}.")
    check_beyond(design.imager(), [*z, *([] if sources is None else sources[:, 2])], "`depths`")
    if draws < 1:
        raise InputError(f"`draws` must be one or more, got {draws}.")
    targets = {"max_width": max_width, "min_strehl": min_strehl, "max_depth_error": max_depth_error}
    for name, target in targets.items():
        if target is not None:
            check_positive(name, target)
    with progress.step("Tracing cores"):
        problem = make_problem(design, z, sources, tolerances.pixel_um / 1000)
    deviations, lenses = standard_deviations(tolerances), len(design.array.centers_mm)
    with progress.step("Gradients"):
        alone = _changes_by_gradient(problem, deviations)
    with progress.step("Nominal"):
        nominal, constant = _nominal_and_constant(problem, deviations)
    limits = _make_limits(problem.parts, nominal, max_width, min_strehl, max_depth_error)
    names = [name for name, field in ERROR_FIELDS.items() if float(getattr(deviations, field)) > 0]
    keys = jax.random.split(jax.random.key(seed), draws)
    devices, met = [], []
    with progress.counter("Devices", (1 + len(names)) * -(-draws // _BATCH)) as advance:
        for each in (deviations, *(without_tolerance(deviations, name) for name in names)):
            errors = jax.vmap(lambda key, each=each: sample_errors(key, lenses, each))(keys)
            devices.append(measure_devices(problem, errors, advance))
            met.append(_find_met(limits, devices[-1]))
    yields = [float(np.all(list(each.values()), axis=0).mean()) for each in met]
    without = dict(zip(names, yields[1:], strict=True))
    points = np.asarray(problem.depth_arguments[3].points, np.float64)
    return Outcome(design.name, tolerances, z, points, limits, nominal, devices[0], alone | constant, met[0], without)


def measure_devices(problem: Problem, errors: Errors, advance=lambda: None) -> Measures:
    """Measure devices, in batches of one size for any number of them, so that one program is compiled."""
    batches, count = [], len(errors.radius)
    for start in range(0, count, _BATCH):
        index = np.minimum(np.arange(start, start + _BATCH), count - 1)
        batch = _measure(problem, jax.tree.map(lambda part, index=index: part[index], errors))
        batches.append(Measures(*(np.asarray(part, np.float64)[: count - start] for part in batch)))
        advance()
    return Measures(*map(np.concatenate, zip(*batches, strict=True)))


@eqx.filter_jit
def _measure(problem: Problem, errors: Errors) -> Measures:
    one = lambda each: Measures(*_sharpness(problem, each), *depth_errors(*problem.depth_arguments, each))
    return jax.vmap(one)(errors)


def _sharpness(problem: Problem, errors: Errors) -> tuple[Float[Array, " depth"], Float[Array, " depth"]]:
    """`log_sharpness` of the lens type that is best at each depth."""
    by_type = [log_sharpness(*part, errors, problem.pixel) for part in problem.parts]
    widths, ratios = (jnp.stack(parts) for parts in zip(*by_type, strict=True))
    return jnp.min(widths, 0), jnp.max(ratios, 0)


@eqx.filter_jit
def _derivatives(problem: Problem, perfect: Errors) -> tuple[dict[str, Array], ...]:
    """The derivatives of each measure by fields of `Errors`; lens positions do not change sharpness."""
    fields = {field: getattr(perfect, field) for name, field in ERROR_FIELDS.items() if name not in CONSTANT}
    shapes = {field: value for field, value in fields.items() if field != "centers"}
    changed = lambda values: dataclasses.replace(perfect, **values)
    sharpness = jax.jacfwd(lambda values: _sharpness(problem, changed(values)))(shapes)
    return *sharpness, *jax.jacfwd(lambda values: depth_errors(*problem.depth_arguments, changed(values)))(fields)


def _changes_by_gradient(problem: Problem, deviations: Errors) -> dict[str, Measures]:
    """The RMS change of each measure by each random tolerance."""

    def norm(slopes: dict[str, Array], field: str) -> Float64[np.ndarray, "..."]:
        shape = slopes["radius"].shape
        slope = np.asarray(slopes[field], np.float64) if field in slopes else np.zeros(shape)
        return np.sqrt((slope.reshape(*shape, -1) ** 2).sum(-1))

    slopes, alone = _derivatives(problem, no_errors(len(problem.depth_arguments[0].array.centers))), {}
    for name, field in ERROR_FIELDS.items():
        if name not in CONSTANT:
            deviation = float(getattr(deviations, field))
            alone[name] = Measures(*(deviation * norm(each, field) for each in slopes))
    return alone


def _nominal_and_constant(problem: Problem, deviations: Errors) -> tuple[Measures, dict[str, Measures]]:
    """Measures as designed, and their changes by the constant tolerances, whose squares have no slope at zero."""
    perfect = no_errors(len(problem.depth_arguments[0].array.centers))
    fields = {name: ERROR_FIELDS[name] for name in CONSTANT}
    each = [dataclasses.replace(perfect, **{field: getattr(deviations, field)}) for field in fields.values()]
    measures = measure_devices(problem, jax.tree.map(lambda *parts: jnp.stack(parts), perfect, *each))
    nominal = Measures(*(part[0] for part in measures))
    changes = {name: Measures(*(part[row] - part[0] for part in measures)) for row, name in enumerate(fields, 1)}
    return nominal, changes


def combine_changes(alone: dict[str, Measures]) -> Measures:
    """RMS change by all tolerances: random ones add as squares, constant ones as they are."""
    squares = [sum(part**2 for part in parts) for parts in zip(*_some(alone, False), strict=True)]
    shifts = [sum(parts) for parts in zip(*_some(alone, True), strict=True)]
    return Measures(*(np.sqrt(square + shift**2) for square, shift in zip(squares, shifts, strict=True)))


def _some(alone: dict[str, Measures], constant: bool) -> list[Measures]:
    return [each for name, each in alone.items() if (name in CONSTANT) == constant]


def _make_limits(parts: tuple[tuple[Imager, Conditions], ...], nominal: Measures, width, strehl, depth_error) -> Limits:
    ones = np.ones(len(parts[0][1].depths))
    axial = np.min([np.asarray(axial_resolution(*part), np.float64) for part in parts], axis=0)
    designed = np.exp(nominal.log_strehl)
    return Limits(
        MAX_WIDTH * np.exp(nominal.log_width) if width is None else width * ones,
        np.where(designed >= LEAST_STREHL, MIN_STREHL * designed, 0.0) if strehl is None else strehl * ones,
        axial if depth_error is None else depth_error * ones,
    )


def _find_met(limits: Limits, devices: Measures) -> dict[str, Bool[np.ndarray, " device"]]:
    errors = np.abs(devices.calibrated).reshape(len(devices.calibrated), len(limits.depth_error), -1)
    by_depth = {
        "spot width": np.exp(devices.log_width) <= limits.width,
        "Strehl ratio": np.exp(devices.log_strehl) >= limits.strehl,
        "depth": errors.max(-1) <= limits.depth_error,
    }
    return {name: np.asarray(each.all(1)) for name, each in by_depth.items()}
