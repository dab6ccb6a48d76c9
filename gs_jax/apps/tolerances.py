"""Tolerance analysis of a design: sensitivities by gradient, random devices, and the yield; tables and figure of it."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float64
from matplotlib.figure import Figure
from rich.table import Table

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import compile_at_once
from ..design.datasheets import text_table
from ..design.design import Design
from ..microscope.geometry import Imager, check_beyond
from ..microscope.layouts import check_positive
from ..objectives.conditions import Conditions
from ..objectives.quantities import axial_resolution
from .device_model import (
    BATCH,
    CONSTANT,
    ERROR_FIELDS,
    POSITION,
    Errors,
    Measures,
    Problem,
    depth_errors,
    depth_errors_of_devices,
    make_problem,
    measure,
    measure_devices,
    no_errors,
    sample_errors,
    sharpness,
    sharpness_of_devices,
    standard_deviations,
    without_tolerance,
)
from .tolerance_spec import ToleranceSpec

# Default number of depths.
_DEPTHS = 5
# Default limits, relative to the design: spot width, and Strehl ratio where that is at least so large.
MAX_WIDTH, MIN_STREHL, LEAST_STREHL = 1.2, 0.8, 0.1


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
    deviations = standard_deviations(tolerances)
    perfect = no_errors(problem.lenses)
    batch = jax.tree.map(lambda error: np.stack([error] * BATCH), jax.device_get(perfect))
    with progress.step("Compiling"):
        calls = [(one, (problem, perfect)) for one in (_slopes_of_sharpness, _slopes_of_depths)]
        compile_at_once(*calls, *((one, (problem, batch)) for one in (sharpness_of_devices, depth_errors_of_devices)))
    with progress.step("Gradients"):
        slopes = jax.device_get([*_slopes_of_sharpness(problem, perfect), *_slopes_of_depths(problem, perfect)])
    with progress.step("Nominal"):
        nominal, constant = _nominal_and_constant(problem, deviations)
    alone = {name: Measures(*(_change(one, field, deviations) for one in slopes)) for name, field in _RANDOM.items()}
    limits = _make_limits(problem.parts, nominal, max_width, min_strehl, max_depth_error)
    names = [name for name, field in ERROR_FIELDS.items() if float(getattr(deviations, field)) > 0]
    keys, sample = jax.random.split(jax.random.key(seed), draws), partial(sample_errors, lenses=problem.lenses)
    # What a tolerance does not change is as with all of them.
    same = [name for name in names if name in (POSITION, *CONSTANT)]
    with progress.counter("Devices", (2 + 2 * len(names) - len(same)) * -(-draws // BATCH)) as advance:
        devices = measure_devices(problem, sample(keys, deviations=deviations), advance)
        met = [_find_met(limits, devices)]
        for name in names:
            errors = sample(keys, deviations=without_tolerance(deviations, name))
            sharp, deep = devices[:2], devices[2:]
            if name != POSITION:
                sharp = measure(sharpness_of_devices, problem, errors, advance)
            if name not in CONSTANT:
                deep = measure(depth_errors_of_devices, problem, errors, advance)
            met.append(_find_met(limits, Measures(*sharp, *deep)))
    yields = [float(np.all(list(by_target.values()), axis=0).mean()) for by_target in met]
    without = dict(zip(names, yields[1:], strict=True))
    points = np.asarray(problem.depth_arguments[3].points, np.float64)
    return Outcome(design.name, tolerances, z, points, limits, nominal, devices, alone | constant, met[0], without)


# Fields of `Errors` that are random.
_RANDOM = {name: field for name, field in ERROR_FIELDS.items() if name not in CONSTANT}


@eqx.filter_jit
def _slopes_of_sharpness(problem: Problem, perfect: Errors) -> tuple[dict[str, Array], ...]:
    """Derivatives of `sharpness` by fields of `Errors`; lens positions do not change it."""
    fields = {field: getattr(perfect, field) for name, field in _RANDOM.items() if name != POSITION}
    return jax.jacfwd(lambda values: sharpness(problem, dataclasses.replace(perfect, **values)))(fields)


@eqx.filter_jit
def _slopes_of_depths(problem: Problem, perfect: Errors) -> tuple[dict[str, Array], ...]:
    """Derivatives of `depth_errors` by fields of `Errors`."""
    fields = {field: getattr(perfect, field) for field in _RANDOM.values()}

    def errors(values):
        return depth_errors(*problem.depth_arguments, dataclasses.replace(perfect, **values), steps=1)

    return jax.jacfwd(errors)(fields)


def _change(slopes: dict[str, np.ndarray], field: str, deviations: Errors) -> Float64[np.ndarray, "..."]:
    """The RMS change of a measure by the deviation of a field."""
    shape = slopes["radius"].shape
    slope = np.asarray(slopes.get(field, np.zeros(shape)), np.float64).reshape(*shape, -1)
    return float(getattr(deviations, field)) * np.sqrt((slope**2).sum(-1))


def _nominal_and_constant(problem: Problem, deviations: Errors) -> tuple[Measures, dict[str, Measures]]:
    """Measures as designed, and their changes by the constant tolerances, whose squares have no slope at zero."""
    perfect = no_errors(problem.lenses)
    fields = [ERROR_FIELDS[name] for name in CONSTANT]
    changed = [dataclasses.replace(perfect, **{field: getattr(deviations, field)}) for field in fields]
    measures = measure_devices(problem, jax.tree.map(lambda *errors: jnp.stack(errors), perfect, *changed))
    nominal, *others = (Measures(*(values[row] for values in measures)) for row in range(1 + len(CONSTANT)))
    changes = {name: jax.tree.map(np.subtract, other, nominal) for name, other in zip(CONSTANT, others, strict=True)}
    return nominal, changes


def combine_changes(alone: dict[str, Measures]) -> Measures:
    """RMS change by all tolerances: random ones add as squares, constant ones as they are."""

    def combine(*changes: np.ndarray) -> np.ndarray:
        by_name = dict(zip(alone, changes, strict=True))
        shift = sum(by_name[name] for name in CONSTANT)
        return np.sqrt(sum(by_name[name] ** 2 for name in alone if name not in CONSTANT) + shift**2)

    return jax.tree.map(combine, *alone.values())


def _make_limits(parts: tuple[tuple[Imager, Conditions], ...], nominal: Measures, width, strehl, depth_error) -> Limits:
    ones = np.ones(len(parts[0][1].depths))
    axial = np.min([np.asarray(axial_resolution(*lens_type), np.float64) for lens_type in parts], axis=0)
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
    return {name: np.asarray(met.all(1)) for name, met in by_depth.items()}


# Each tolerance with its unit, by fields of `ToleranceSpec`.
_FORMATS = {
    "position": "{position_um:g} um",
    "radius": "{radius_percent:g} %",
    "conic": "{conic:g}",
    "index": "{index:g}",
    "sensor distance": "{sensor_distance_um:g} um",
    "tilt": "{tilt_deg:g} deg",
    "roughness": "{roughness_nm:g} nm",
    "printed layers": "{layer_um:g}, {pixel_um:g} um",
}
# Percentiles that are shown.
_PERCENTILES = (5, 50, 95)


def _in_units(measures: Measures, depths: int) -> dict[str, Float64[np.ndarray, "_ depth"]]:
    """Measures by their names in JSON, with all devices and points along the first axis."""
    width, ratio = (np.exp(np.atleast_2d(log)) for log in measures[:2])
    errors = [1000 * error for error in _errors_by_depth(measures, depths)]
    return dict(zip(_MEASURES, (1000 * width, ratio, *errors), strict=True))


def _changes_in_units(changes: Measures, depths: int) -> dict[str, Float64[np.ndarray, "_ depth"]]:
    """Changes of measures as `_in_units`; those of logarithms in percent."""
    logarithms = [100 * np.atleast_2d(log) for log in changes[:2]]
    errors = [1000 * error for error in _errors_by_depth(changes, depths)]
    return dict(zip(_CHANGES, (*logarithms, *errors), strict=True))


_MEASURES = ("spot_width_um", "strehl_on_axis", "depth_error_um", "depth_error_calibrated_um")
_CHANGES = ("spot_width_percent", "strehl_percent", *_MEASURES[2:])


def _errors_by_depth(measures: Measures, depths: int) -> list[Float64[np.ndarray, "_ depth"]]:
    """Depth errors, mm, with the geometry of the design and of the calibrated device."""
    by_point = (np.reshape(error, (-1, depths, error.shape[-1] // depths)) for error in measures[2:])
    return [error.transpose(0, 2, 1).reshape(-1, depths) for error in by_point]


def _rms(values: np.ndarray, axis: int | None = None) -> Any:
    return np.sqrt(np.mean(values**2, axis))


def summarise_changes(outcome: Outcome) -> dict[str, dict[str, float | None]]:
    """RMS over depths and points of the change by each tolerance, by all together by gradient, and of the devices.

    The Strehl ratio counts at depths where it is 0.1 or more as designed; None if nowhere.
    """
    strong = np.exp(outcome.nominal.log_strehl) >= LEAST_STREHL
    drawn = jax.tree.map(np.subtract, outcome.devices, outcome.nominal)
    rows = {**outcome.alone, "all, by gradient": combine_changes(outcome.alone), "all, drawn": drawn}
    summary = {}
    for name, changes in rows.items():
        values = _changes_in_units(changes, len(outcome.depths))
        values["strehl_percent"] = values["strehl_percent"][:, strong]
        summary[name] = {key: float(_rms(value)) if value.size else None for key, value in values.items()}
    return summary


def rank_tolerances(outcome: Outcome) -> list[str]:
    """The tolerances by cost: by the yield without each, then by its share in the change of a measure."""
    changes = summarise_changes(outcome)
    total = changes["all, by gradient"]
    keys = ("spot_width_percent", "strehl_percent", "depth_error_calibrated_um")

    def cost(name: str) -> tuple[float, float]:
        share = max(((changes[name][key] or 0.0) / (total[key] or 1.0)) ** 2 for key in keys)
        return outcome.yields_without.get(name, 0.0), share

    return sorted(ERROR_FIELDS, key=cost, reverse=True)


def sentences(outcome: Outcome) -> list[str]:
    """The result in words."""
    by_target = ", ".join(f"{name} {100 * met.mean():.3g} %" for name, met in outcome.met.items())
    first = rank_tolerances(outcome)[0]
    without = outcome.yields_without.get(first, 0.0)
    lines = [f"Yield: {_yield_text(outcome)} ({by_target})."]
    if without > outcome.all_met.mean():
        cost = f"Costs most: {first} ({_amount(outcome, first)})."
        lines.append(f"{cost} Without it the yield is {100 * without:.3g} %.")
    else:
        lines.append("No tolerance alone costs yield: setting one to zero does not raise it.")
    rms = summarise_changes(outcome)["all, drawn"]
    lines.append(
        f"The RMS depth error is {rms['depth_error_um']:.3g} um with the design's geometry, "
        f"{rms['depth_error_calibrated_um']:.3g} um after calibration."
    )
    if rms["strehl_percent"] is None:
        lines.append(f"The Strehl ratio is below {LEAST_STREHL:g} at all depths: it is no target for this design.")
    return lines


def _yield_text(outcome: Outcome) -> str:
    return f"{100 * outcome.all_met.mean():.3g} % of {len(outcome.all_met)} devices meet all targets"


def _amount(outcome: Outcome, name: str) -> str:
    return _FORMATS[name].format(**outcome.tolerances.model_dump())


def tables(outcome: Outcome) -> list[Table]:
    """The effect of each tolerance, and the devices depth by depth. Both fit 80 columns."""

    def cell(value: float | None) -> str:
        return "-" if value is None else "0" if value < 5e-4 else f"{value:.3g}"

    changes, depths = summarise_changes(outcome), len(outcome.depths)
    without = {name: f"{100 * value:.3g}" for name, value in outcome.yields_without.items()}
    without["all, drawn"] = f"{100 * outcome.all_met.mean():.3g}"
    amounts = {name: _amount(outcome, name) for name in ERROR_FIELDS}
    amounts["all, drawn"] = f"{len(outcome.all_met)} devices"
    by_tolerance = text_table(
        "Effect of each tolerance alone, by gradient: RMS over depths and points",
        ("tolerance", "", "width\n%", "Strehl\n%", "depth\num", "calibrated\num", "yield %\nwithout"),
        (
            (name, amounts.get(name, ""), *map(cell, changes[name].values()), without.get(name, ""))
            for name in (*rank_tolerances(outcome), "all, by gradient", "all, drawn")
        ),
    )
    (width, ratio, *_), (widths, ratios, *errors) = (
        _in_units(measures, depths).values() for measures in (outcome.nominal, outcome.devices)
    )
    low, middle, high = _PERCENTILES
    strehl = np.concatenate([ratio, np.percentile(ratios, (middle, low), axis=0)])
    columns = (
        outcome.depths,
        *np.concatenate([width, np.percentile(widths, (middle, high), axis=0)]),
        *np.where(strehl >= 1e-3, strehl, 0.0),
        *(_rms(error, 0) for error in errors),
    )
    by_depth = text_table(
        "By depth: as designed, and of the devices",
        ("depth\nmm", "width\num", "\nmedian", "\n95 %", "Strehl\n", "\nmedian", "\n5 %", "depth\num", "calib.\num"),
        ([f"{x:.0f}" if x >= 100 else f"{x:.3g}" for x in row] for row in zip(*columns, strict=True)),
    )
    return [by_tolerance, by_depth]


def as_json(outcome: Outcome) -> dict[str, Any]:
    """The numbers of an outcome to six digits; lists have an entry per depth."""
    depths, limits = len(outcome.depths), outcome.limits

    def rounded(values) -> list[float]:
        return [float(f"{value:.6g}") for value in np.asarray(values)]

    def distribution(values) -> dict[str, list[float]]:
        percentiles = dict(zip(("p5", "p50", "p95"), np.percentile(values, _PERCENTILES, axis=0), strict=True))
        numbers = {"mean": values.mean(0), "sd": values.std(0)} | percentiles
        return {key: rounded(value) for key, value in numbers.items()}

    def by_depth(changes: Measures) -> dict[str, list[float]]:
        """With the sign, where a change has one value per depth."""
        values = _changes_in_units(changes, depths).items()
        return {key: rounded(value[0] if len(value) == 1 else _rms(value, 0)) for key, value in values}

    nominal, devices = (_in_units(measures, depths) for measures in (outcome.nominal, outcome.devices))
    changes = {**outcome.alone, "all": combine_changes(outcome.alone)}
    return {
        "design": outcome.design,
        "tolerances": outcome.tolerances.model_dump(),
        "depth_mm": rounded(outcome.depths),
        "places_mm": [rounded(point) for point in outcome.points[: len(outcome.points) // depths, :2]],
        "targets": {
            "max_width_um": rounded(1000 * limits.width),
            "min_strehl": rounded(limits.strehl),
            "max_depth_error_um": rounded(1000 * limits.depth_error),
        },
        "nominal": {key: rounded(nominal[key][0]) for key in _MEASURES[:2]},
        "drawn": {"devices": len(outcome.all_met)} | {key: distribution(value) for key, value in devices.items()},
        "by_gradient": {name: by_depth(change) for name, change in changes.items()},
        "over_depths": summarise_changes(outcome),
        "yield": float(outcome.all_met.mean()),
        "yield_by_target": {name: float(met.mean()) for name, met in outcome.met.items()},
        "yield_without": outcome.yields_without,
        "costs": rank_tolerances(outcome),
    }


def picture(outcome: Outcome) -> Figure:
    """Shares of the tolerances in each measure's mean square, and the devices' measures by depth."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    (shares, *sharpness), errors = (axes := figure.subplots(2, 2)).flat[:3], axes.flat[3]
    _draw_shares(shares, outcome)
    z, limits = outcome.depths, outcome.limits
    nominal, devices = (_in_units(measures, len(z)) for measures in (outcome.nominal, outcome.devices))
    targets = (1000 * limits.width, np.where(limits.strehl > 0, limits.strehl, np.nan))
    for axes, key, target in zip(sharpness, _MEASURES, targets, strict=False):
        low, middle, high = np.percentile(devices[key], _PERCENTILES, axis=0)
        axes.fill_between(z, low, high, color="C0", alpha=0.25, label="devices, 5 to 95 %")
        axes.plot(z, middle, "C0o-", label="devices, median")
        axes.plot(z, nominal[key][0], "k-", label="as designed")
        axes.plot(z, target, "k:", label="target")
    for key, label, color in zip(_MEASURES[2:], ("design's geometry", "calibrated"), ("C1", "C0"), strict=True):
        errors.plot(z, _rms(devices[key], 0), "o-", color=color, label=label)
    errors.plot(z, 1000 * limits.depth_error, "k:", label="target, of each point")
    labels = (
        ("2.355 RMS widths in the object, um", "spot width"),
        ("Strehl ratio on the axis", "Strehl ratio"),
        ("depth error, um RMS", "depth of a point, over devices and points"),
    )
    for axes, (label, title) in zip((*sharpness, errors), labels, strict=True):
        axes.set(xlabel="depth z, mm", ylabel=label, title=title, ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=10)
    name = "".join(c for c in outcome.design if " " <= c <= "~").replace("$", r"\$")
    figure.suptitle(f"{name}: {_yield_text(outcome)}")
    return figure


def _draw_shares(axes, outcome: Outcome) -> None:
    changes = summarise_changes(outcome)
    labels = ["spot width", "Strehl ratio", "depth", "depth,\ncalibrated"]
    if changes["position"]["strehl_percent"] is None:
        labels[1] += f",\nnot above {LEAST_STREHL:g}"
    values = np.array([[(x or 0.0) ** 2 for x in changes[name].values()] for name in ERROR_FIELDS])
    total = values.sum(0)
    values = 100 * values / np.where(total > 0, total, 1)
    rows, left = np.arange(len(labels)), np.cumsum(values, 0) - values
    for number, name in enumerate(ERROR_FIELDS):
        label = f"{name}, {_amount(outcome, name)}"
        axes.barh(rows, values[number], left=left[number], color=f"C{number}", label=label)
    axes.set_yticks(rows, labels)
    axes.invert_yaxis()
    axes.set(xlabel="share of the mean square change, by gradient, %", xlim=(0, 100), title="shares of the tolerances")
    axes.legend(fontsize=10, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
