"""A tolerance analysis as tables, sentences, a figure, and numbers for JSON."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..design.datasheets import text_table
from .device_model import ERROR_FIELDS
from .tolerance_analysis import LEAST_STREHL, Measures, Outcome, combine_changes

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
_LOW, _HIGH = 5, 95


def summarise_changes(outcome: Outcome) -> dict[str, dict[str, float | None]]:
    """RMS over depths and points of the change by each tolerance, by all together by gradient, and of the devices.

    The Strehl ratio counts at depths where it is 0.1 or more as designed; None if nowhere.
    """
    strong = np.exp(outcome.nominal.log_strehl) >= LEAST_STREHL
    drawn = Measures(*(each - one for each, one in zip(outcome.devices, outcome.nominal, strict=True)))
    rows = {**outcome.alone, "all, by gradient": combine_changes(outcome.alone), "all, drawn": drawn}
    rms = lambda x: float(np.sqrt(np.mean(np.asarray(x) ** 2)))
    return {
        name: {
            "spot_width_percent": 100 * rms(each.log_width),
            "strehl_percent": 100 * rms(each.log_strehl[..., strong]) if strong.any() else None,
            "depth_error_um": 1000 * rms(each.designed),
            "depth_error_calibrated_um": 1000 * rms(each.calibrated),
        }
        for name, each in rows.items()
    }


def rank_tolerances(outcome: Outcome) -> list[str]:
    """The tolerances by cost: by the yield without each, then by its share in the change of a measure."""
    changes = summarise_changes(outcome)
    total = changes["all, by gradient"]
    keys = ("spot_width_percent", "strehl_percent", "depth_error_calibrated_um")
    share = lambda name: max(((changes[name][key] or 0.0) / (total[key] or 1.0)) ** 2 for key in keys)
    return sorted(ERROR_FIELDS, key=lambda name: (outcome.yields_without.get(name, 0.0), share(name)), reverse=True)


def sentences(outcome: Outcome) -> list[str]:
    """The result in words."""
    percent = lambda x: f"{100 * x:.3g} %"
    parts = ", ".join(f"{name} {percent(met.mean())}" for name, met in outcome.met.items())
    whole, first = outcome.all_met.mean(), rank_tolerances(outcome)[0]
    lines = [f"Yield: {percent(whole)} of {len(outcome.all_met)} devices meet all targets ({parts})."]
    gained = outcome.yields_without.get(first, whole)
    if gained > whole:
        lines.append(f"Costs most: {first} ({_amount(outcome, first)}). Without it the yield is {percent(gained)}.")
    else:
        lines.append("No tolerance alone costs yield: setting one to zero does not raise it.")
    rms = summarise_changes(outcome)["all, drawn"]
    before, after = rms["depth_error_um"], rms["depth_error_calibrated_um"]
    lines.append(
        f"The RMS depth error is {before:.3g} um with the design's geometry, {after:.3g} um after calibration."
    )
    if not (np.exp(outcome.nominal.log_strehl) >= LEAST_STREHL).any():
        lines.append(f"The Strehl ratio is below {LEAST_STREHL:g} at all depths: it is no target for this design.")
    return lines


def tables(outcome: Outcome) -> list[Table]:
    """The effect of each tolerance, and the devices depth by depth. Both fit 80 columns."""
    cell = lambda value: "-" if value is None else "0" if value < 5e-4 else f"{value:.3g}"
    changes, whole = summarise_changes(outcome), f"{100 * outcome.all_met.mean():.3g}"
    without = {name: f"{100 * value:.3g}" for name, value in outcome.yields_without.items()} | {"all, drawn": whole}
    amounts = {name: _amount(outcome, name) for name in ERROR_FIELDS} | {
        "all, drawn": f"{len(outcome.all_met)} devices"
    }
    by_tolerance = text_table(
        "Effect of each tolerance alone, by gradient: RMS over depths and points",
        ("tolerance", "", "width\n%", "Strehl\n%", "depth\num", "calibrated\num", "yield %\nwithout"),
        (
            (name, amounts.get(name, ""), *map(cell, changes[name].values()), without.get(name, ""))
            for name in (*rank_tolerances(outcome), "all, by gradient", "all, drawn")
        ),
    )
    (width, strehl), (widths, strehls) = _linear(outcome.nominal), _linear(outcome.devices)
    columns = (
        outcome.depths,
        *1000 * np.array([width, *np.percentile(widths, (50, _HIGH), axis=0)]),
        *(np.where(ratio >= 1e-3, ratio, 0.0) for ratio in (strehl, *np.percentile(strehls, (50, _LOW), axis=0))),
        *1000 * np.array(_rms_by_depth(outcome)),
    )
    by_depth = text_table(
        "By depth: as designed, and of the devices",
        ("depth\nmm", "width\num", "\nmedian", "\n95 %", "Strehl\n", "\nmedian", "\n5 %", "depth\num", "calib.\num"),
        ([f"{x:.0f}" if x >= 100 else f"{x:.3g}" for x in row] for row in zip(*columns, strict=True)),
    )
    return [by_tolerance, by_depth]


def _amount(outcome: Outcome, name: str) -> str:
    return _FORMATS[name].format(**outcome.tolerances.model_dump())


def _linear(measures: Measures) -> tuple[np.ndarray, np.ndarray]:
    """Widths, mm, and Strehl ratios."""
    return np.exp(measures.log_width), np.exp(measures.log_strehl)


def _by_depth(errors, count: int) -> np.ndarray:
    """Depth errors of all devices and points, `(_, depth)`."""
    return errors.reshape(-1, count, errors.shape[-1] // count).transpose(0, 2, 1).reshape(-1, count)


def _rms_by_depth(outcome: Outcome) -> list[np.ndarray]:
    """RMS depth errors, mm: with the geometry of the design, and of the calibrated device."""
    pair = (outcome.devices.designed, outcome.devices.calibrated)
    return [np.sqrt((_by_depth(errors, len(outcome.depths)) ** 2).mean(0)) for errors in pair]


def as_json(outcome: Outcome) -> dict[str, Any]:
    """The numbers of an outcome; lists have an entry per depth."""
    (width, strehl), (widths, strehls) = _linear(outcome.nominal), _linear(outcome.devices)
    count = len(outcome.depths)

    def distribution(values):
        low, middle, high = np.percentile(values, (_LOW, 50, _HIGH), axis=0)
        numbers = {"mean": values.mean(0), "sd": values.std(0), "p5": low, "p50": middle, "p95": high}
        return {key: _rounded(value) for key, value in numbers.items()}

    rms = lambda errors: _rounded(1000 * np.sqrt((_by_depth(errors, count) ** 2).mean(0)))
    by_gradient = {
        name: {
            "spot_width_percent": _rounded(100 * each.log_width),
            "strehl_percent": _rounded(100 * each.log_strehl),
            "depth_error_um": rms(each.designed),
            "depth_error_calibrated_um": rms(each.calibrated),
        }
        for name, each in {**outcome.alone, "all": combine_changes(outcome.alone)}.items()
    }
    return {
        "design": outcome.design,
        "tolerances": outcome.tolerances.model_dump(),
        "depth_mm": _rounded(outcome.depths),
        "places_mm": [_rounded(place) for place in outcome.points[: len(outcome.points) // count, :2]],
        "targets": {
            "max_width_um": _rounded(1000 * outcome.limits.width),
            "min_strehl": _rounded(outcome.limits.strehl),
            "max_depth_error_um": _rounded(1000 * outcome.limits.depth_error),
        },
        "nominal": {"spot_width_um": _rounded(1000 * width), "strehl_on_axis": _rounded(strehl)},
        "drawn": {
            "devices": len(outcome.all_met),
            "spot_width_um": distribution(1000 * widths),
            "strehl_on_axis": distribution(strehls),
            "depth_error_um": distribution(1000 * _by_depth(outcome.devices.designed, count)),
            "depth_error_calibrated_um": distribution(1000 * _by_depth(outcome.devices.calibrated, count)),
        },
        "by_gradient": by_gradient,
        "over_depths": summarise_changes(outcome),
        "yield": float(outcome.all_met.mean()),
        "yield_by_target": {name: float(met.mean()) for name, met in outcome.met.items()},
        "yield_without": outcome.yields_without,
        "costs": rank_tolerances(outcome),
    }


def _rounded(values) -> list[float]:
    """To six digits."""
    return [float(f"{value:.6g}") for value in np.asarray(values)]


def picture(outcome: Outcome) -> Figure:
    """Shares of the tolerances in each measure's mean square, and the devices' measures by depth."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    (shares, widths), (ratios, errors) = figure.subplots(2, 2)
    _draw_shares(shares, outcome)
    limits = outcome.limits
    targets = (1000 * limits.width, np.where(limits.strehl > 0, limits.strehl, np.nan))
    for axes, factor, nominal, devices, target in zip(
        (widths, ratios), (1000, 1), _linear(outcome.nominal), _linear(outcome.devices), targets, strict=True
    ):
        low, middle, high = np.percentile(factor * devices, (_LOW, 50, _HIGH), axis=0)
        axes.fill_between(outcome.depths, low, high, color="C0", alpha=0.25, label="devices, 5 to 95 %")
        axes.plot(outcome.depths, middle, "C0o-", label="devices, median")
        axes.plot(outcome.depths, factor * nominal, "k-", label="as designed")
        axes.plot(outcome.depths, target, "k:", label="target")
    for rms, label, color in zip(
        _rms_by_depth(outcome), ("design's geometry", "calibrated"), ("C1", "C0"), strict=True
    ):
        errors.plot(outcome.depths, 1000 * rms, "o-", color=color, label=label)
    errors.plot(outcome.depths, 1000 * limits.depth_error, "k:", label="target, of each point")
    widths.set(ylabel="2.355 RMS widths in the object, um", title="spot width")
    ratios.set(ylabel="Strehl ratio on the axis", title="Strehl ratio")
    errors.set(ylabel="depth error, um RMS", title="depth of a point, over devices and points")
    for axes in (widths, ratios, errors):
        axes.set(xlabel="depth z, mm", ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=10)
    name = "".join(c for c in outcome.design if " " <= c <= "~").replace("$", r"\$")
    whole = f"{100 * outcome.all_met.mean():.3g} % of {len(outcome.all_met)} devices meet all targets"
    figure.suptitle(f"{name}: {whole}")
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
