"""`gs-jax layout`, `metrics`, `info`, `optimize` and `pareto`: layouts, datasheets and searches of designs."""

import re
from itertools import groupby
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..io.files import checkpoint_path, make_folder, write_json
from .commands import PARTIAL, RESUMABLE, check_outputs, command, partial_outputs, plural, provenance_of
from .options import DepthList, DesignPath, Light, Mm, Um, WorkerOptions, objects_in, shipped_designs


@command("layout", "Example: gs-jax layout --count 200 --size-mm 20 20 --pitch-mm 1.23 -o centers.csv")
def layout_command(
    *,
    count: Annotated[int, click.IntRange(1, 100_000)],
    size_mm: tuple[Mm, Mm],
    pitch_mm: Mm,
    diameter_mm: Mm = 2.0,
    seed: Annotated[int, click.IntRange(0)] = 0,
    output: Path,
    force: bool = False,
):
    """Make a random layout of lenses, for the key `centers_file` of a design.

    Options:
        count: Number of lenses.
        size_mm: Size of the plate, X Y.
        pitch_mm: Mean distance of a lens from its nearest neighbour.
        diameter_mm: Lens diameter; the lenses cover the plate.
        seed: Seed of the layout.
        output: CENTERS.csv, with the header x_mm,y_mm.
    """
    from ..design.tables import write_centers
    from ..microscope.layouts import coverage, nearest_neighbour_distances, random_layout

    check_outputs(output, [".csv"], force=force)
    centers = random_layout(count, size_mm, pitch=pitch_mm, diameter=diameter_mm, seed=seed)
    write_centers(output, centers, provenance_of())
    distances = nearest_neighbour_distances(centers)
    covered = coverage(centers, size_mm, diameter=diameter_mm)
    spread = f"pitch {distances.mean():.3f} mm, SD {distances.std():.3f} mm, " if count > 1 else ""
    click.echo(f"{output}: {count} lenses, {spread}{100 * covered:.1f} % of the plate covered")


@command("metrics", "Example: gs-jax metrics design/geomscope.toml --depths 18:22:1")
def metrics_command(
    design: DesignPath,
    *,
    json: Path | None = None,
    depths: DepthList | None = None,
    confusion_um: Um | None = None,
    bound: bool = False,
    detail_um: Um | None = None,
    light: Light,
):
    """Show what the microscope of DESIGN resolves (the paper's Eqs. 1-11, and exact rays), in five lines.

    --verbose adds the tables by depth and all problems; --json has all numbers.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.

    Options:
        json: Also write the numbers to this file.
        depths: START:STOP:STEP in mm. [default: seven in the working distance]
        confusion_um: Diameter of the circle of confusion, um. [default: two pixels]
        bound: Also compare the error of volumes with the least that any lenses on this plate could have.
        detail_um: With --bound, width of the scenes' voxels, um. [default: 40]
    """
    from rich.console import Console

    from ..base.progress import VERBOSE, verbosity
    from ..codesign.bound import bound_sheet, format_bound
    from ..design.datasheets import datasheet, findings, overview, summary, tables
    from ..microscope.geometry import check_beyond
    from ..objectives.conditions import DETAIL, Conditions

    if detail_um is not None and not bound:
        raise InputError("--detail-um must be used with --bound.")
    check_outputs(json, [".json"], inputs=(design,))
    circle_of_confusion = confusion_um and confusion_um / 1000
    microscope = light.read_design(design)
    if depths:
        check_beyond(microscope.imager(), depths, "--depths")
    sheet = datasheet(microscope, depths, circle_of_confusion=circle_of_confusion)
    if bound:
        detail = DETAIL if detail_um is None else detail_um / 1000
        sheet["bound"] = bound_sheet(microscope.imager(), Conditions(sheet["depth_mm"], detail=detail))
    if json:
        write_json(json, sheet)
    click.echo(summary(microscope, sheet))
    click.echo(f"  {objects_in(microscope.imager())}; {_calibration(microscope.provenance)}")
    for line in overview(microscope, sheet, circle_of_confusion=circle_of_confusion):
        click.echo(f"  {line}")
    if bound:
        click.echo(f"  {format_bound(sheet['bound'], len(sheet['depth_mm']))}")
    problems = findings(microscope, sheet, circle_of_confusion=circle_of_confusion)
    if verbosity.get() != VERBOSE:
        click.echo(f"  tables by depth and {plural(len(problems), 'remark')}: --verbose")
        return
    console = Console()
    for table in tables(sheet):
        console.print()
        console.print(table)
    click.echo()
    for sentence in problems:
        click.echo(f"- {sentence}")


def _calibration(provenance) -> str:
    """The line about what `gs-jax calibrate` wrote into the file."""
    if "calibrated_spots" not in provenance:
        return "not calibrated: the geometry is that of the design"
    spots, captures = provenance["calibrated_spots"], provenance["calibrated_captures"]
    rms, deviations = provenance["calibrated_rms_pixels"], provenance["standard_deviations"]
    known = ", ".join(f"{name} +- {deviation:g}" for name, deviation in deviations.items())
    return f"calibrated by {spots} spots of {captures} captures, {rms:.3f} pixels RMS: {known}"


@command("info", "Examples: gs-jax info volume.ome.tif, gs-jax info --designs")
def info_command(file: Path | None = None, *, designs: bool = False):
    """Show versions, devices and memory; with FILE, which gs-jax command made it, and from what.

    Of long lists in the design the first lines are shown, with --verbose all. Of an image that another program made:
    its size, type and axes, and what commands take it for.

    Options:
        designs: List the names of the designs that come with the package.
    """
    from ..base.progress import VERBOSE, verbosity

    if designs and file:
        raise InputError(f"--designs must be used without a FILE, got {file}.")
    if designs:
        from ..design.design import read_design

        # The second line of a design describes its array.
        lines = {path.stem: repr(read_design(path)).splitlines()[1].strip() for path in shipped_designs()}
    elif file:
        from ..io.captures import summarise
        from ..io.provenance import read_provenance

        lines = read_provenance(file) or summarise(file) | {"provenance": f"{file} has no provenance."}
    else:
        from ..base.machine import describe

        lines = describe()
    width = max(map(len, lines))
    for name, value in lines.items():
        # The text of a design has many lines, most of them of its lenses' centres.
        value = value if verbosity.get() == VERBOSE else _shortened(value)
        click.echo(f"{name:<{width}} {value}" if "\n" not in value else f"{name}\n\n{value}")


# A line of a list of numbers, or of pairs of them, in TOML; lines of a list that are shown.
_NUMBERS, _SHOWN = re.compile(r"\s*\[?[-+0-9.e, ]+\]?,?\s*"), 3


def _shortened(text: str) -> str:
    """A text without most lines of long lists of numbers."""
    lines = []
    for is_list, group in groupby(text.split("\n"), lambda line: bool(line.strip() and _NUMBERS.fullmatch(line))):
        rows = list(group)
        if is_list and len(rows) > 2 * _SHOWN:
            rows = [*rows[:_SHOWN], f"    # and {len(rows) - _SHOWN} more"]
        lines += rows
    return "\n".join(lines)


@command("optimize", "Example: gs-jax optimize design/geomscope.toml --study study.toml -o new.toml")
def optimize_command(
    design: DesignPath,
    *,
    study: Path,
    terms: Path | None = None,
    resume: bool = False,
    output: Path,
    workers: WorkerOptions,
    force: bool = False,
):
    """Search for a better microscope than that of the file DESIGN, and compare both.

    The first design that meets all targets is written at once. The table at the end says what the goal changes by with
    each limit. NEW.toml.json (the terms, every start and step) and NEW.toml.png (layout and history) are written beside
    it. Workers run the starts of the study's first stage.

    Options:
        study: STUDY.toml: free parameters, goals and solvers.
        resume: Continue from the checkpoint of an interrupted run beside NEW.toml.
        output: NEW.toml; numbers and a picture are written beside it.
    """
    import jax
    from rich.console import Console

    from ..codesign import search
    from ..codesign.search_report import before_and_after, side_files, write_first, write_outcome
    from ..codesign.terms import add_terms

    # An interrupted run may have left its first design.
    left = resume and checkpoint_path(output, resume=True).exists()
    check_outputs(output, [".toml"], *side_files(output), inputs=(design, study, terms), force=force or left)
    # Single precision stops far from the minimum.
    jax.config.update("jax_enable_x64", True)
    checkpoint = checkpoint_path(output, resume=resume)
    if resume and not checkpoint.exists():
        raise InputError(f"--resume must be used after an interrupted run, got no checkpoint {checkpoint}.")
    if terms:
        add_terms(terms)
    partial_outputs[checkpoint] = RESUMABLE
    files = {"parent": design, "source": study, "provenance": provenance_of(design, study, terms)}

    def first(found):
        write_first(output, found, **files)
        partial_outputs[output] = PARTIAL
        click.echo(f"{output}: the first design that meets all targets; the search goes on")

    with Progress() as progress, workers:
        options = {"progress": progress, "checkpoint": checkpoint, "resume": resume, "workers": workers}
        outcome = search.run_study(design, study, first=first, **options)
    write_outcome(output, outcome, **files)
    checkpoint.unlink(missing_ok=True)
    Console().print(before_and_after(outcome))
    for end in outcome.log.ends:
        click.echo(f"stage {end['stage'] + 1}, start {end['start']}: {end['reason']} ({end['steps']} steps)")
    click.echo(f"{output}: {outcome.design.name}, from {outcome.parent.name} in {outcome.seconds:.0f} s")


@command("pareto", "Example: gs-jax pareto design/studies/geomscope-sharpness.toml --out front")
def pareto_command(
    study: Path, *, out: Path = Path("gs-jax-pareto"), terms: Path | None = None, workers: WorkerOptions
):
    """Compute the trade-off of the file STUDY: its one goal against one or two moving limits.

    The folder gets pareto.json, to which each design is added when it is found, and pareto.png.
    """
    import jax
    from rich.console import Console
    from rich.table import Table

    from ..base.errors import errors_name_file
    from ..codesign.pareto import as_json, picture, sweep_of, trade_off
    from ..codesign.study import parent_path, read_study
    from ..codesign.terms import SIGNS, add_terms
    from ..design.design import read_design
    from ..io.files import write_figure
    from ..io.provenance import KEY

    # Single precision stops far from the minimum.
    jax.config.update("jax_enable_x64", True)
    if terms:
        add_terms(terms)
    question = read_study(study)
    start = parent_path(study, question)
    parent = read_design(start)
    with errors_name_file(study):
        sweep_of(parent, question)
    make_folder(out)
    numbers, drawing = out / "pareto.json", out / "pareto.png"
    check_outputs(numbers, [".json"], drawing, inputs=(study, start, terms))
    provenance = provenance_of(study, start, terms, design=parent)

    def each(front):
        write_json(numbers, {KEY: provenance} | as_json(front))
        partial_outputs[numbers] = PARTIAL

    with Progress() as progress, workers:
        front = trade_off(parent, question, each=each, progress=progress, workers=workers)
    write_figure(drawing, picture(front))
    limits = [f"{term.name} {SIGNS[term.kind]}" for term in front.objectives[1:]]
    table = Table(*limits, *(term.name for term in front.objectives), "", box=None, pad_edge=False)
    for row, point, best in zip(front.values, front.points, front.best, strict=True):
        status = "" if best else "dominated" if point.feasible else "misses a target"
        table.add_row(*(f"{x:g}" for x in point.limits), *(f"{x:.4g}" for x in row), status)
    Console().print(table)
    click.echo(f"{drawing}: {front.best.sum()} of {len(front.points)} points on the front")
