"""What tolerances cost, for people and for files: tables, sentences, a picture, and numbers with their units."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from .device_model import RULED
from .tolerance_analysis import LEAST_STREHL, Measures, Outcome, together

# How an amount is said: the fields of `Tolerances`, and what comes after each.
_AMOUNTS = {
    "position": "{position_um:g} um",
    "radius": "{radius_percent:g} %",
    "conic": "{conic:g}",
    "index": "{index:g}",
    "sensor distance": "{sensor_distance_um:g} um",
    "tilt": "{tilt_deg:g} deg",
    "roughness": "{roughness_nm:g} nm",
    "printed layers": "{layer_um:g}, {pixel_um:g} um",
}
# Of percentiles that are shown.
_LOW, _HIGH = 5, 95


def changes(outcome: Outcome) -> dict[str, dict[str, float | None]]:
    """RMS over depths and places of what each tolerance does alone, of all together by gradient, and of the devices.

    Keys are the columns of `tables`; the Strehl ratio counts where it is 0.1 or more as designed, None if nowhere.
    """
    strong = np.exp(outcome.nominal.log_strehl) >= LEAST_STREHL
    drawn = Measures(*(each - one for each, one in zip(outcome.devices, outcome.nominal, strict=True)))
    rms = lambda x: float(np.sqrt(np.mean(np.asarray(x) ** 2)))
    return {
        name: {
            "spot_width_percent": 100 * rms(each.log_width),
            "strehl_percent": 100 * rms(each.log_strehl[..., strong]) if strong.any() else None,
            "depth_error_um": 1000 * rms(each.designed),
            "depth_error_calibrated_um": 1000 * rms(each.calibrated),
        }
        for name, each in {**outcome.alone, "all, by gradient": together(outcome.alone), "all, drawn": drawn}.items()
    }


def costs(outcome: Outcome) -> list[str]:
    """The tolerances, the one that costs most first: by the yield without it, then by what it does to a target."""
    found = changes(outcome)
    whole = found["all, by gradient"]

    def share(name: str) -> float:
        keys = ("spot_width_percent", "strehl_percent", "depth_error_calibrated_um")
        parts = [((found[name][key] or 0.0) / (whole[key] or 1.0)) ** 2 for key in keys]
        return max(parts)

    return sorted(RULED, key=lambda name: (outcome.yields_without.get(name, 0.0), share(name)), reverse=True)


def sentences(outcome: Outcome) -> list[str]:
    """What came out, in words."""
    percent = lambda x: f"{100 * x:.3g} %"
    parts = ", ".join(f"{name} {percent(met.mean())}" for name, met in outcome.met.items())
    whole = outcome.all_met.mean()
    said = [f"Yield: {percent(whole)} of {len(outcome.all_met)} devices keep all targets ({parts})."]
    first = costs(outcome)[0]
    gained = outcome.yields_without.get(first, whole)
    if gained > whole:
        said.append(f"Costs most: {first} ({_amount(outcome, first)}). Without it the yield is {percent(gained)}.")
    else:
        said.append("No tolerance alone costs yield: none of them at zero makes it larger.")
    rms = changes(outcome)["all, drawn"]
    before, after = rms["depth_error_um"], rms["depth_error_calibrated_um"]
    said.append(f"Depths are {before:.3g} um off RMS by the design's geometry, {after:.3g} um once it is calibrated.")
    if not (np.exp(outcome.nominal.log_strehl) >= LEAST_STREHL).any():
        text = f"below {LEAST_STREHL:g} at all depths: it says nothing of this design, and is no target."
        said.append(f"The Strehl ratio is {text}")
    return said


def tables(outcome: Outcome) -> list[Table]:
    """What each tolerance does, and the devices depth by depth. All fit 80 columns."""
    return [_by_tolerance(outcome), _by_depth(outcome)]


def _by_tolerance(outcome: Outcome) -> Table:
    title = "What each tolerance does alone, by gradient: RMS over depths and places"
    heads = ("tolerance", "", "width\n%", "Strehl\n%", "depth\num", "calibrated\num", "yield %\nwithout")
    table, found = _empty(title, heads), changes(outcome)
    for name in costs(outcome):
        without = outcome.yields_without.get(name)
        kept = "" if without is None else f"{100 * without:.3g}"
        table.add_row(name, _amount(outcome, name), *map(_cell, found[name].values()), kept)
    count, whole = len(outcome.all_met), 100 * outcome.all_met.mean()
    table.add_row("all, by gradient", "", *map(_cell, found["all, by gradient"].values()), "")
    table.add_row("all, drawn", f"{count} devices", *map(_cell, found["all, drawn"].values()), f"{whole:.3g}")
    return table


def _by_depth(outcome: Outcome) -> Table:
    title = "By depth: as designed, and of the devices"
    heads = ("depth\nmm", "width\num", "\nmedian", "\n95 %", "Strehl\n", "\nmedian", "\n5 %", "depth\num", "calib.\num")
    table = _empty(title, heads)
    one, many = _linear(outcome.nominal), _linear(outcome.devices)
    designed, calibrated = (1000 * errors for errors in _rms_by_depth(outcome))
    for row, depth in enumerate(outcome.depths):
        width, ratio = many[0][:, row], many[1][:, row]
        cells = (1000 * one[0][row], *1000 * np.percentile(width, (50, _HIGH)))
        ratios = (one[1][row], *np.percentile(ratio, (50, _LOW)))
        cells = (depth, *cells, *(x if x >= 1e-3 else 0.0 for x in ratios), designed[row], calibrated[row])
        table.add_row(*(f"{x:.0f}" if x >= 100 else f"{x:.3g}" for x in cells))
    return table


def _empty(title, heads) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for head in heads:
        table.add_column(head, justify="left" if head in ("tolerance", "") else "right")
    return table


def _cell(value: float | None) -> str:
    return "-" if value is None else "0" if value < 5e-4 else f"{value:.3g}"


def _amount(outcome: Outcome, name: str) -> str:
    return _AMOUNTS[name].format(**outcome.tolerances.model_dump())


def _linear(measures: Measures) -> tuple[np.ndarray, np.ndarray]:
    """Widths, mm, and Strehl ratios."""
    return np.exp(measures.log_width), np.exp(measures.log_strehl)


def _rms_by_depth(outcome: Outcome) -> list[np.ndarray]:
    """Of depth errors over devices and places, mm: with the design's geometry and a calibrated one."""
    pair, count = (outcome.devices.designed, outcome.devices.calibrated), len(outcome.depths)
    return [np.sqrt((errors.reshape(len(errors), count, -1) ** 2).mean((0, 2))) for errors in pair]


def as_json(outcome: Outcome) -> dict[str, Any]:
    """The numbers of an outcome; lists have an entry a depth."""
    one, many = _linear(outcome.nominal), _linear(outcome.devices)
    count = len(outcome.depths)

    def spread(values, factor=1.0):
        low, middle, high = np.percentile(factor * values, (_LOW, 50, _HIGH), axis=0)
        named = {"mean": factor * values.mean(0), "sd": factor * values.std(0), "p5": low, "p50": middle, "p95": high}
        return {key: _rounded(value) for key, value in named.items()}

    by_depth = lambda errors: errors.reshape(len(errors), count, -1).transpose(0, 2, 1).reshape(-1, count)
    alone = {
        name: {
            "spot_width_percent": _rounded(100 * each.log_width),
            "strehl_percent": _rounded(100 * each.log_strehl),
            "depth_error_um": _rounded(1000 * np.sqrt((each.designed.reshape(count, -1) ** 2).mean(1))),
            "depth_error_calibrated_um": _rounded(1000 * np.sqrt((each.calibrated.reshape(count, -1) ** 2).mean(1))),
        }
        for name, each in {**outcome.alone, "all": together(outcome.alone)}.items()
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
        "nominal": {"spot_width_um": _rounded(1000 * one[0]), "strehl_on_axis": _rounded(one[1])},
        "drawn": {
            "devices": len(outcome.all_met),
            "spot_width_um": spread(many[0], 1000),
            "strehl_on_axis": spread(many[1]),
            "depth_error_um": spread(by_depth(outcome.devices.designed), 1000),
            "depth_error_calibrated_um": spread(by_depth(outcome.devices.calibrated), 1000),
        },
        "by_gradient": alone,
        "over_depths": changes(outcome),
        "yield": float(outcome.all_met.mean()),
        "yield_by_target": {name: float(met.mean()) for name, met in outcome.met.items()},
        "yield_without": outcome.yields_without,
        "costs": costs(outcome),
    }


def _rounded(values) -> list[float]:
    """Six digits, more than any of these is worth."""
    return [float(f"{value:.6g}") for value in np.asarray(values)]


def picture(outcome: Outcome) -> Figure:
    """Shares of the tolerances in each measure's mean square, and the devices' spread over the depths."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    (shares, widths), (ratios, errors) = figure.subplots(2, 2)
    _draw_shares(shares, outcome)
    one, many, limits = _linear(outcome.nominal), _linear(outcome.devices), outcome.limits
    _draw_spread(widths, outcome.depths, 1000 * one[0], 1000 * many[0], 1000 * limits.width)
    widths.set(ylabel="spot width in the object, um", ylim=(0, None), title="spot width")
    _draw_spread(ratios, outcome.depths, one[1], many[1], np.where(limits.strehl > 0, limits.strehl, np.nan))
    ratios.set(ylabel="Strehl ratio on the axis", ylim=(0, None), title="Strehl ratio")
    labels = ("by the design's geometry", "calibrated")
    for rms, label, color in zip(_rms_by_depth(outcome), labels, ("C1", "C0"), strict=True):
        errors.plot(outcome.depths, 1000 * rms, "o-", color=color, label=label)
    errors.plot(outcome.depths, 1000 * limits.depth_error, "k:", label="target, of each point")
    errors.set(ylabel="depth error, um RMS", ylim=(0, None), title="depth of a point, over devices and places")
    for axes in (widths, ratios, errors):
        axes.set_xlabel("depth z, mm")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    name = "".join(c for c in outcome.design if " " <= c <= "~").replace("$", r"\$")
    whole = f"{100 * outcome.all_met.mean():.3g} % of {len(outcome.all_met)} devices keep all targets"
    figure.suptitle(f"{name}: {whole}")
    return figure


def _draw_shares(axes, outcome: Outcome) -> None:
    found = changes(outcome)
    below = "" if found[next(iter(RULED))]["strehl_percent"] is not None else f",\nnot above {LEAST_STREHL:g}"
    labels = ("spot width", f"Strehl ratio{below}", "depth", "depth,\ncalibrated")
    rows = np.arange(len(labels))
    values = np.array([[(x or 0.0) ** 2 for x in found[name].values()] for name in RULED])
    total = values.sum(0)
    values = 100 * values / np.where(total > 0, total, 1)
    left = np.zeros(len(labels))
    for number, name in enumerate(RULED):
        axes.barh(rows, values[number], left=left, color=f"C{number}", label=f"{name}, {_amount(outcome, name)}")
        left += values[number]
    axes.set_yticks(rows, labels)
    axes.invert_yaxis()
    axes.set(xlabel="share of the mean square change, by gradient, %", xlim=(0, 100), title="what costs what")
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))


def _draw_spread(axes, depths, nominal, many, limit) -> None:
    low, middle, high = np.percentile(many, (_LOW, 50, _HIGH), axis=0)
    axes.fill_between(depths, low, high, color="C0", alpha=0.25, label="devices, 5 to 95 %")
    axes.plot(depths, middle, "C0o-", label="devices, median")
    axes.plot(depths, nominal, "k-", label="as designed")
    axes.plot(depths, limit, "k:", label="target")
