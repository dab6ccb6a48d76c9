"""Error of volumes against light and span of depths, for spheres and conics with either side facing the object.

For each span of depths, share of a point's light and lens type (with one to three foci), the search of
`geomscope-exposure` (`designs/studies`) minimises `volume_error`: the error of the best linear estimate of a volume
at equal exposure, in which a lens out of focus contributes blur and its light contributes noise, so that it is fair to
lenses of one focus and of several. The search uses four planes over the span; the results are means over these and the
three halfway between them, which are resolved separately, so that foci on the searched planes only do not pay. Light is
held within 2 % and given for 20.5 mm; there is no mask between the apertures. Conics with the plano side facing the
object start from the result for spheres with the same light, several foci from that of one focus, and these two from
the result with less light.

    python -m experiments.lens_front [--out DIR]

Writes `lens_front.json`, `lens_front.md` and `lens_front.png`; about half an hour on a core.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from experiments.common import DESIGNS, Report, design_file, main, table
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.pictures import PALETTE
from gs_jax.base.progress import Progress
from gs_jax.codesign.parameters import candidate, evaluated, start_values
from gs_jax.codesign.pareto import sweep_of
from gs_jax.codesign.study import Study, initial_design, read_study
from gs_jax.codesign.terms import TERMS
from gs_jax.design.conversion import reduced_depth
from gs_jax.design.design import Design, read_design

SPANS = ((18.0, 23.0), (17.0, 25.0), (15.0, 30.0))
# Shares of the light of a point 20.5 mm away, %, and their tolerance.
LIGHTS, MIDDLE, MORE = (0.05, 0.1, 0.2, 0.4), 20.5, 1.02
PLANES, STEPS = 4, 30
_TARGETS = ("light_percent", "occupancy", "lenses_per_point", "thickness_mm", "field_of_view_mm", "edge_slope_deg")


class Kind(NamedTuple):
    """A lens type: its initial design, whether it is a conic, its foci, and the type whose result it starts from."""

    design: str
    conic: bool
    foci: int = 1
    follows: str | None = None


KINDS = {
    "plano side, sphere": Kind("geomscope-optimized", False),
    "plano side, conic": Kind("geomscope-optimized", True, 1, "plano side, sphere"),
    "curved side, conic": Kind("geomscope-exposure", True),
    "curved side, conic, 2 foci": Kind("geomscope-exposure", True, 2, "curved side, conic"),
    "curved side, conic, 3 foci": Kind("geomscope-exposure", True, 3, "curved side, conic"),
}


def study_of(kind: Kind, span: tuple[float, float], steps: int) -> Study:
    """Study of a lens type over a span, without a mask, and with lower and upper limits of the light."""
    data = read_study(DESIGNS / "studies" / "geomscope-exposure.toml").model_dump()
    kept = [term for term in data["terms"] if term["name"] in (*_TARGETS, "volume_error")]
    sides = ("at_least", "at_most")
    kept += [{"name": "light_percent", side: 1.0, "weight": 30.0} for side in sides]
    free = {name: bounds for name, bounds in data["free"].items() if kind.conic or name != "conic_constant"}
    return Study.model_validate(
        data
        | {"depths_mm": span, "depth_count": PLANES, "types": kind.foci, "orientation": None, "free": free, "starts": 1}
        | {"terms": kept, "pareto": [{"name": "light_percent", side: [1.0]} for side in sides]}
        | {
            "stages": [
                {"solver": "levenberg-marquardt", "steps": 100, "terms": _TARGETS},
                {"solver": "bfgs", "steps": steps},
            ]
        }
    )


def limits_of(light: float, span: tuple[float, float], design: Design) -> tuple[float, float]:
    """Lower limit (farthest depth) and upper limit (nearest depth) of the light, %, for a share at `MIDDLE`."""
    middle = reduced_depth(design, MIDDLE)
    near, far = (light * (middle / reduced_depth(design, depth)) ** 2 for depth in span)
    return far, MORE * near


def front(kind: Kind, span: tuple[float, float], lights, followed: list[dict] | None, steps: int) -> list[dict]:
    """Results of a lens type, one record per share of the light."""
    design, study = posed(kind, span, steps)
    sweep = sweep_of(design, study)
    judge = judge_of(design, study)
    first, results = start_values(sweep.problem.imager, sweep.problem.at), []
    for number, light in enumerate(lights):
        limits = limits_of(light, span, design)
        start = results[-1]["values"] if results else first
        if followed:
            start = spread(followed[number]["values"], first)
        point = sweep.search(limits, start)
        (between, width), searched = judge(point.values), decibels(point.rows[0].high)
        errors = {"error_db": together(searched, between), "searched_db": searched, "between_db": between}
        record = {"light_percent": light, "off_target": off_target(point, sweep, limits), "values": point.values}
        results.append(record | errors | {"width_um": width})
    return results


def posed(kind: Kind, span: tuple[float, float], steps: int) -> tuple[Design, Study]:
    """Initial design of a lens type, and its study."""
    design, study = read_design(design_file(kind.design)), study_of(kind, span, steps)
    lens = design.lens if kind.conic else design.lens.model_copy(update={"conic_constant": 0.0})
    return initial_design(design.model_copy(update={"lens": lens}), study), study


def off_target(point, sweep, limits) -> float:
    """Relative violation of the worst target; up to a per cent counts as none."""
    missed = [
        row.high / term.target - 1 if term.kind == "at_most" else 1 - row.low / term.target
        for term, row in zip(sweep.terms(limits), point.rows, strict=True)
        if not term.is_goal
    ]
    return max(0.0, *missed) if max(missed) > 0.01 else 0.0


def spread(values: dict, first: dict) -> dict:
    """Start for several types from a result of identical lenses, with radii in the ratios of the design."""
    moved = {name: values[name] for name in ("sensor_distance_mm", "pitch_mm")}
    for name in ("radius_of_curvature_mm", "aperture_diameter_mm", "conic_constant"):
        moved[name] = jnp.broadcast_to(values[name], first[name].shape)
    radius = first["radius_of_curvature_mm"]
    return first | moved | {"radius_of_curvature_mm": moved["radius_of_curvature_mm"] * radius / jnp.mean(radius)}


def judge_of(design: Design, study: Study):
    """From parameters to the error of the planes between, and the width by the type in focus at the worst depth."""
    near, far = study.depths_mm or design.imaging.working_distance_mm
    half = (far - near) / (PLANES - 1) / 2
    between = evaluated(design, depths_mm=(near + half, far - half), depth_count=PLANES - 1, exposure=study.exposure)
    whole = evaluated(design, depths_mm=(near, far), depth_count=2 * PLANES - 1)

    @jax.jit
    def judged(values):
        values = {name: x for name, x in values.items() if name not in ("depth_span_mm", "centers_mm")}
        error = TERMS["volume_error"].function(*candidate(*between, values))
        return error, TERMS["psf_width_um"].function(*candidate(*whole, values))

    def judge(values) -> tuple[float, float]:
        error, widths = judged(values)
        return decibels(float(error)), float(widths.max())

    return judge


def together(searched: float, between: float) -> float:
    """Error of all planes, dB, from those of both sets."""
    power = PLANES * 10 ** (searched / 10) + (PLANES - 1) * 10 ** (between / 10)
    return 10 * float(np.log10(power / (2 * PLANES - 1)))


def decibels(error: float) -> float:
    return 20 * float(np.log10(error))


def run(spans=SPANS, lights=LIGHTS, kinds=tuple(KINDS), steps: int = STEPS, *, progress: Progress) -> list[dict]:
    """Return for each span the results by lens type, one record per share of the light."""
    results = [{"span_mm": span, "fronts": {}} for span in spans]
    cases = [(row, name) for row in results for name in kinds]
    for row, name in progress.track(cases, "Fronts"):
        kind = KINDS[name]
        followed = row["fronts"].get(kind.follows)
        row["fronts"][name] = front(kind, row["span_mm"], lights, followed, steps)
    return results


def picture(results: list[dict]) -> Figure:
    """Plot the error against light, one panel per span."""
    figure = Figure(figsize=(3.6 * len(results) + 0.6, 4.2), dpi=100, layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False, sharey=True)[0]
    for axes, row in zip(panels, results, strict=True):
        for (name, records), colour, marker in zip(row["fronts"].items(), PALETTE, "osDv^", strict=False):
            light = [record["light_percent"] for record in records]
            axes.plot(light, [record["error_db"] for record in records], color=colour, marker=marker, ms=5, label=name)
        near, far = row["span_mm"]
        axes.set(xscale="log", xlabel="light of a point at 20.5 mm, %", title=f"objects at {near:g} to {far:g} mm")
        axes.xaxis.set_major_locator(FixedLocator(LIGHTS))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("error of the volume, dB (less is better)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def numbers_of(record: dict) -> dict[str, Any]:
    """A record without the parts that are not written."""
    names = ("sensor_distance_mm", "pitch_mm", "radius_of_curvature_mm", "aperture_diameter_mm", "conic_constant")
    values = {name: np.round(np.asarray(record["values"][name], float), 4).tolist() for name in names}
    return {key: value for key, value in record.items() if key != "values"} | values


def report(progress: Progress) -> Report:
    with jax.enable_x64(True):
        return shown(run(progress=progress))


def shown(results: list[dict]) -> Report:
    """Table of errors and widths, and the picture; the file has all numbers."""
    plain = [
        row | {"fronts": {name: [numbers_of(record) for record in records] for name, records in row["fronts"].items()}}
        for row in results
    ]
    lights = [record["light_percent"] for record in next(iter(plain[0]["fronts"].values()))]
    columns = ("depths", "lens", *(f"{light:g} %" for light in lights))
    rows = [
        ["{:g} to {:g} mm".format(*row["span_mm"]), name, *map(cell, records)]
        for row in plain
        for name, records in row["fronts"].items()
    ]
    files = {
        "lens_front.json": plain,
        "lens_front.md": markdown_table(columns, rows),
        "lens_front.png": picture(results),
    }
    return Report(files, [table(columns, rows, title="error, dB / width at the worst depth, um")])


def cell(record: dict) -> str:
    """Error and width; `!` marks a missed target."""
    return f"{record['error_db']:.1f} / {record['width_um']:.0f}{' !' if record['off_target'] else ''}"


if __name__ == "__main__":
    main(report)
