"""Report of a search: a table, a figure, JSON, and the design with its provenance."""

import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from rich.table import Column, Table

from ..base.typing import PathLike
from ..design.datasheets import six_digits
from ..design.design import Design, write_design
from ..design.validation import of_each
from ..io.files import side_file, write_figure, write_json
from ..io.provenance import Provenance
from ..microscope.layouts import plate_corners
from ..microscope.lenses import lenses_by_type
from ..optics.raytrace import to_numpy
from .limits import Limit
from .parameters import significant
from .search import Outcome
from .study import Row, TermTable, labels, only_goal
from .terms import SIGNS, TERMS, unit_of

# As `gs_jax.apps.pictures`.
PALETTE = color_sequences["petroff10"]


def before_and_after(outcome: Outcome) -> Table:
    """Table of the study's terms before and after and of bounds that bind, and what the goal changes by with each."""
    slopes, goal = limit_texts(outcome), only_goal(outcome.study.stages[-1].of(outcome.study.terms))
    heads = [Column("term", no_wrap=True), "target", "before", "after", "", *(["goal per limit"] if goal else [])]
    table = Table(*heads, box=None, pad_edge=False)
    for term, old, new in zip(outcome.study.terms, outcome.before, outcome.after, strict=True):
        met, target = {True: "met", False: "MISSED", None: ""}[new.met], target_text(term)
        row = term.name, target, span(old), span(new), met, slopes.pop(f"{term.name} {target}", "")
        table.add_row(*row[: len(heads)])
    for limit, slope in slopes.items():
        table.add_row(*limit.split(" ", 1), "", "", "bound", slope)
    return table


def limit_texts(outcome: Outcome) -> dict[str, str]:
    """What the goal changes by per unit of each limit, with units, or that it does not bind, by the limit as text."""
    goal = only_goal(outcome.study.stages[-1].of(outcome.study.terms))
    unit = unit_of(goal.name) if goal else ""

    def text(limit: Limit) -> str:
        per = unit_of(limit.name).removesuffix("s") or "1"
        return f"{limit.slope:+.3g} {unit} per {per}".replace("  ", " ") if limit.slope else "does not bind"

    return {f"{limit.name} {SIGNS[limit.kind]} {limit.value:g}": text(limit) for limit in outcome.limits}


def target_text(term: TermTable) -> str:
    """The target of a term as text."""
    return SIGNS[term.kind] if term.is_goal else f"{SIGNS[term.kind]} {term.target:g}"


def span(row: Row) -> str:
    """Lowest and highest entry of a term."""
    low, high = f"{row.low:.4g}", f"{row.high:.4g}"
    return low if low == high else f"{low} to {high}"


def write_outcome(
    path: PathLike, outcome: Outcome, *, parent: PathLike, source: PathLike, provenance: Provenance | None = None
) -> list[Path]:
    """Write the design with its provenance, and beside it the numbers (.json) and a figure (.png).

    Parameters
    ----------
    path
        Of the new design.
    parent, source
        The files of the old design and of the study, for the provenance.
    provenance
        Further entries of the provenance.

    Returns
    -------
    list
        The files.
    """
    path, study, records = Path(path), outcome.study, as_records(outcome)
    paths = [path, *side_files(path)]
    limits = [limit._asdict() | {"slope": six_digits(limit.slope)} for limit in outcome.limits]
    history = {"starts": list(map(_plain, outcome.log.ends)), "steps": list(map(_plain, outcome.log.steps))}
    write_json(
        paths[1],
        {"name": study.name, "seconds": round(outcome.seconds, 1), "terms": records, "limits": limits} | history,
    )
    write_figure(paths[2], picture(outcome))
    reason = outcome.log.best_end(len(study.stages) - 1)["reason"]
    table = origin(parent=parent, source=source, reason=reason, provenance=provenance)
    table |= {"seed": study.seed}
    table["objectives"] = {record["term"]: record["after"] for record in records if None not in record["after"]}
    table |= {"limits": texts} if (texts := limit_texts(outcome)) else {}
    write_design(paths[0], outcome.design.model_copy(update={"provenance": table}))
    return paths


def write_first(path: PathLike, design: Design, **of: Any) -> None:
    """Write the first design that meets all targets of a study; `of` as `origin`, without a reason."""
    reason = "the first that meets all targets; the search had not ended"
    write_design(path, design.model_copy(update={"provenance": origin(reason=reason, **of)}))


def origin(*, parent: PathLike, source: PathLike, reason: str, provenance: Provenance | None = None) -> dict[str, Any]:
    """Provenance of a design that a search found: the files of the old design and of the study, and why it ended."""
    own = {"parent": Path(parent).name, "study": Path(source).name}
    return {**(provenance or {}), **own, "date": datetime.date.today().isoformat(), "reason": reason}


def as_records(outcome: Outcome) -> list[dict[str, Any]]:
    """Terms before and after as records for a JSON file; `None` stands for infinity."""
    ends = lambda row: [six_digits(row.low), six_digits(row.high)]
    return [
        {
            "term": term.name,
            "meaning": TERMS[term.name].meaning,
            "unit": unit_of(term.name),
            "kind": term.kind,
            "target": None if term.is_goal else term.target,
            "before": ends(old),
            "after": ends(new),
            "met_before": old.met,
            "met_after": new.met,
        }
        for term, old, new in zip(outcome.study.terms, outcome.before, outcome.after, strict=True)
    ]


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    """A record of the log with fewer digits: six of a number, seven of each value of the free parameters."""
    numbers = {key: six_digits(x) if isinstance(x, float) else x for key, x in record.items()}
    if "free" in record:
        numbers["free"] = {name: significant(x).tolist() for name, x in record["free"].items()}
    return numbers


def picture(outcome: Outcome) -> Figure:
    """Figure of the layout, and of cost and terms over the steps of the best start."""
    figure = Figure(figsize=(14.5, 5), dpi=110, layout="constrained")
    layout, cost, terms = figure.subplots(1, 3, width_ratios=(1.3, 1, 1.5))
    _draw_layout(layout, outcome.design)
    asked = outcome.study.terms
    best = lambda stage: outcome.log.best_end(stage)["start"]
    steps = [step for step in outcome.log.steps if step["start"] == best(step["stage"])]
    numbers = np.arange(1, len(steps) + 1)
    cost.semilogy(numbers, [max(step["cost"], 1e-12) for step in steps], "k")
    cost.set(xlabel="step", ylabel="cost", title="cost of the best start")
    for number, (term, label) in enumerate(zip(asked, labels(asked, outcome.study), strict=True)):
        values = np.array([step.get(label, np.nan) for step in steps], float)
        style = "-" if term.is_goal else ("--", ":")[number >= len(PALETTE)]
        text = f"{TERMS[term.name].meaning}\n{target_text(term)} {unit_of(term.name)}"
        color = PALETTE[number % len(PALETTE)]
        terms.plot(numbers, np.maximum(values / term.target, 1e-3), style, color=color, label=text)
    terms.axhline(1, color="0.6", lw=0.8)
    terms.set(yscale="log", xlabel="step", ylabel="value over target", title="terms (goals solid: over their unit)")
    terms.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def _draw_layout(axes: Axes, design: Design) -> None:
    """Lenses on the plate, each with its disc in the colour of its type, and the sensor, in the sensor's frame."""
    imager, diameters = design.imager(), of_each(design, "aperture_diameter_mm")
    discs = [Circle(center, d / 2) for center, d in zip(to_numpy(imager).centers, diameters, strict=True)]
    for colour, which in zip(PALETTE, lenses_by_type(imager.array), strict=False):
        some = [discs[lens] for lens in which]
        axes.add_collection(PatchCollection(some, facecolor=colour, alpha=0.35, edgecolor=colour, linewidth=0.5))
    left, right, bottom, top = imager.sensor.extent
    plate, sensor = plate_corners(imager), np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    for corners, color, name in ((plate, "k", "plate"), (sensor, PALETTE[2], "sensor")):
        axes.add_patch(Polygon(corners, fill=False, edgecolor=color, label=name))
    reach = 1.1 * float(np.abs(np.vstack([plate, sensor])).max())
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_title(f"{len(discs)} lenses, D = {max(diameters):.3g} mm")
    axes.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)


def side_files(path: Path) -> list[Path]:
    """The files of numbers and of the picture beside a new design."""
    return [side_file(path, suffix) for suffix in (".json", ".png")]
