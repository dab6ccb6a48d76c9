"""What a person explores: the design as it is now, what was kept to compare with, and pictures for the page."""

import time
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import InputError
from ...codesign.study import Study
from ...design.design import Design, write_design
from ...pictures.volume_pictures import in_range, png
from ..report.drawings import layout, line_chart
from ..report.page import render
from .evaluation import (
    SPOT_DEPTHS,
    SPOT_FIELDS,
    Bench,
    Judged,
    Values,
    bench_of,
    checked_values,
    design_of,
    imager_of,
    judge,
    knobs_of,
    violations,
)
from .preview import Small, ghosts_of, small_reconstruction

# Kept designs at most; of a file's name, numbers at most.
_KEPT, _MOST_NAMES = 50, 10_000
# What the history shows of each: name of a number, its unit, and which of all depths counts.
_SHOWN = {
    "spot_width_um": ("spot, um", np.max),
    "lateral_resolution_um": ("promised, um", np.max),
    "axial_resolution_um": ("axial, um", np.max),
    "blur_um": ("blur, um", np.max),
    "occupancy": ("occupancy", np.max),
}


class Session:
    """One design that is explored by one person.

    Parameters
    ----------
    design
        Where it begins.
    study
        Whose targets are judged.
    saves
        The file to save designs to; where one is there, a number is added to its name.
    origin
        What saved designs say of where they come from.
    """

    def __init__(self, design: Design, study: Study | None, saves: Path, origin: dict[str, str]):
        self.bench: Bench = bench_of(design, study)
        self.saves, self.origin = saves, origin
        self.knobs = knobs_of(design)
        self.kept: list[tuple[str, Values, Judged]] = []
        self.keep({}, "start")

    def page(self, token: str) -> str:
        """The page, as HTML."""
        late = [t.name for t in (self.bench.study.terms if self.bench.study else ()) if t.name not in self.bench.terms]
        context = {"design": self.bench.design, "knobs": self.knobs, "token": token, "late": late}
        return render("explore.html", context, folder="explore")

    def move(self, values: Values) -> dict[str, Any]:
        """What becomes of the design: parts of the page by name, and how long it took."""
        began = time.perf_counter()
        values = checked_values(self.bench.design, values)
        found = judge(self.bench, values)
        imager = imager_of(self.bench, values)
        ghosts = ghosts_of(imager, values["near_mm"], values["far_mm"])
        picture = png(in_range(np.sqrt(ghosts.crossings), 0.0, float(np.sqrt(max(ghosts.crossings.max(), 1)))), "magma")
        wrong = violations(self.bench, values, found)
        parts = {
            "violations": _listed(wrong),
            "numbers": self._numbers(found),
            "spots": _spots(found, values),
            "layout": layout(imager, picture, ghosts.box, "where back-projection puts a point"),
            "chart": self._chart(found),
        }
        return {"parts": parts, "ms": round(1000 * (time.perf_counter() - began))}

    def reconstruct(self, values: Values) -> dict[str, Any]:
        """A small simulated reconstruction, as a part of the page."""
        began = time.perf_counter()
        values = checked_values(self.bench.design, values)
        diameter = float(judge(self.bench, values).scalars["clear_diameter_mm"])
        made = small_reconstruction(self.bench, values, diameter)
        return {"parts": {"small": _small(made)}, "ms": round(1000 * (time.perf_counter() - began))}

    def keep(self, values: Values, name: str = "") -> dict[str, Any]:
        """Puts the design of these values into the history."""
        values = checked_values(self.bench.design, values)
        if len(self.kept) >= _KEPT:
            raise InputError(f"found {_KEPT} kept designs, allowed: as many.")
        self.kept.append((name or f"{len(self.kept)}", values, judge(self.bench, values)))
        return {"parts": {"history": self._history()}, "kept": [values for _, values, _ in self.kept]}

    def save(self, values: Values) -> dict[str, Any]:
        """Writes the design of these values to a file that is not there yet."""
        values = checked_values(self.bench.design, values)
        design = design_of(self.bench, values, dict(self.origin))
        path = _free_name(self.saves)
        write_design(path, design)
        return {"said": f"Saved as {path.name}."}

    def history(self) -> dict[str, Any]:
        """What was kept, as a part of the page."""
        return {"parts": {"history": self._history()}, "kept": [values for _, values, _ in self.kept]}

    def _numbers(self, found: Judged) -> str:
        start = self.kept[0][2]
        rows = [
            f"<tr><th scope='row'>{name.replace('_', ' ')}</th>{_cell(found.scalars[name])}{_cell(value)}</tr>"
            for name, value in start.scalars.items()
        ]
        depths = "".join(f"<th scope='col'>{z:.4g}</th>" for z in found.depths)
        table = "".join(
            f"<tr><th scope='row'>{name.replace('_', ' ')}</th>{''.join(map(_cell, values))}</tr>"
            for name, values in found.numbers.items()
        )
        return (
            "<table class='numbers'><thead><tr><th scope='col'></th><th scope='col'>now</th><th scope='col'>start</th>"
            f"</tr></thead><tbody>{''.join(rows)}</tbody></table>"
            f"<table class='numbers'><thead><tr><th scope='col'>depth z, mm</th>{depths}</tr></thead>"
            f"<tbody>{table}</tbody></table>"
        )

    def _chart(self, found: Judged) -> str:
        of = lambda judged, name: (judged.depths, judged.numbers[name])
        lines = {"now": of(found, "spot_width_um"), "now, promised": of(found, "lateral_resolution_um")}
        lines["start"] = of(self.kept[0][2], "spot_width_um")
        if len(self.kept) > 1:
            lines[f"kept {self.kept[-1][0]}"] = of(self.kept[-1][2], "spot_width_um")
        return line_chart(lines, x="depth z, mm", y="width of a spot, um", title="Spots by depth", log=True, marks=True)

    def _history(self) -> str:
        knobs = "".join(f"<th scope='col'>{knob.title}</th>" for knob in self.knobs.values())
        heads = "".join(f"<th scope='col'>{title}</th>" for title, _ in _SHOWN.values())
        rows = "".join(
            f"<tr><th scope='row'><button type='button' data-kept='{index}'>{name}</button></th>"
            + "".join(_cell(worst(found.numbers[key])) for key, (_, worst) in _SHOWN.items())
            + _cell(found.scalars["lenses_per_point"])
            + "".join(_cell(values[key]) for key in self.knobs)
            + "</tr>"
            for index, (name, values, found) in enumerate(self.kept)
        )
        more = "<th scope='col'>lenses a point</th>"
        return (
            f"<table class='numbers'><thead><tr><th scope='col'>back to</th>{heads}{more}{knobs}</tr></thead>"
            f"<tbody>{rows}</tbody></table>"
        )


def _cell(value: Any) -> str:
    value = float(value)
    return f"<td>{value:.4g}</td>" if np.isfinite(value) else "<td>-</td>"


def _listed(sentences: list[str]) -> str:
    return (
        "<p>Nothing does.</p>" if not sentences else f"<ul>{''.join(f'<li>{escape(s)}</li>' for s in sentences)}</ul>"
    )


def _spots(found: Judged, values: Values) -> str:
    near, far, field = (values[name] for name in ("near_mm", "far_mm", "field_radius_mm"))
    heads = "".join(f"<th scope='col'>{near + share * (far - near):.4g} mm</th>" for share in SPOT_DEPTHS)
    rows = ""
    for column, share in enumerate(SPOT_FIELDS):
        cells = ""
        for spots in found.spots:
            spot = np.nan_to_num(spots[column])
            shown = png(in_range(np.sqrt(np.maximum(spot, 0) / max(spot.max(), 1e-30)), 0.0, 1.0), "magma")
            cells += f"<td><img src='{shown}' alt='Spot'><small>{100 * spot.sum():.0f} %</small></td>"
        rows += f"<tr><th scope='row'>{share * field:.3g} mm</th>{cells}</tr>"
    head = f"<thead><tr><th scope='col'>beside</th>{heads}</tr></thead>"
    return f"<table class='spots'>{head}<tbody>{rows}</tbody></table>"


def _small(made: Small) -> str:
    left, top, right, bottom = made.box
    low, high = (float(v) for v in np.percentile(made.maxima, (50, 99.9)))
    picture = png(in_range(made.maxima, low, max(high, low + 1e-12)), "magma")
    radius = (right - left) / 60
    rings = "".join(f"<circle class='ring' cx='{x:.4g}' cy='{y:.4g}' r='{radius:.4g}'/>" for x, y, _ in made.points)
    box = f"{left:.5g} {top:.5g} {right - left:.5g} {bottom - top:.5g}"
    place = f"x='{left:.5g}' y='{top:.5g}' width='{right - left:.5g}' height='{bottom - top:.5g}'"
    return (
        f"<svg class='layout' viewBox='{box}' role='img' aria-label='Maxima of a small reconstruction'>"
        f"<image {place} href='{picture}'/>{rings}</svg>"
        f"<p class='note'>Points stand {made.contrast:.3g} standard deviations above the volume's median.</p>"
    )


def _free_name(path: Path) -> Path:
    """The path, or with the first number after its name that is free."""
    for number in range(1, _MOST_NAMES):
        free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not free.exists():
            return free
    raise InputError(f"{path}: found {_MOST_NAMES} files of this name, allowed: another.")
