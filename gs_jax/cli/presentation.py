"""`gs-jax report`, `explore`, `demo` and `benchmark`: pages and figures of designs and methods."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError, errors_name_file, input_error, needs_extra
from ..base.progress import Progress
from ..io.files import check_output, make_folder
from .commands import PARTIAL, check_outputs, command, given_options, partial_outputs, provenance_of
from .options import CAPTURE_OPTIONS, CaptureOptions, DesignPath, Light, objects_in


@command("report", "Example: gs-jax report my.toml volume.ome.tif --points beads.csv --capture beads.tif -o beads.html")
def report_command(
    design: DesignPath,
    volume: Path | None = None,
    *,
    output: Path,
    deviation: Path | None = None,
    points: Path | None = None,
    surface: Path | None = None,
    traces: Path | None = None,
    capture: Path | None = None,
    tolerance: Path | None = None,
    light: Light,
    camera: CaptureOptions,
):
    """Write one page, for any browser and without a network, about the microscope of DESIGN and a reconstruction.

    VOLUME is an output of `gs-jax reconstruct`. The page has the device to scale, the datasheet and violated
    assumptions, spots and contrast over depth and field, the layout and the mold; the capture, volume, surface and
    points that are given; the results of calibration and tolerances; and the files that it was made from. It is below
    15 MB.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.

    Options:
        output: REPORT.html.
        deviation: DEVIATION.ome.tif of `gs-jax reconstruct`: the standard deviation of VOLUME.
        points: POINTS.csv: points for a table and a 3-D view.
        surface: SURFACE.ome.tif of `gs-jax reconstruct`: maps and a 3-D view.
        traces: TRACES.csv or .h5 of `gs-jax traces`: its regions, and their signals over time.
        capture: CAPTURE.tif: the capture of VOLUME.
        tolerance: TOLERANCE.json of `gs-jax tolerance -o`.
    """
    from ..apps.report import read_tolerance, write_report
    from ..io.point_tables import read_scene_points
    from ..io.provenance import SCORE, read_provenance
    from ..io.traces import read_traces
    from ..io.volumes import read_deviation, read_surface, read_volume

    inputs = (design, volume, deviation, points, surface, traces, capture, tolerance)
    if not capture and (given := given_options(CAPTURE_OPTIONS)):
        raise InputError(f"{given[0]} must be used with --capture.")
    with needs_extra("report"):
        import_module("jinja2")
    check_outputs(output, [".html"], inputs=(*inputs, *camera.files))
    if volume and volume.suffix.lower() in (".csv", ".toml"):
        raise input_error("VOLUME", ".ome.tif or .zarr (points are given by --points)", volume.suffix, volume)
    microscope, results = light.read_design(design), {}
    if deviation and not volume:
        raise InputError("--deviation must be used with VOLUME, whose voxels it describes.")
    if volume:
        results["volume"], results["grid"] = read_volume(volume)
        if deviation:
            results["deviation"] = read_deviation(deviation, results["grid"])
    if surface:
        results["surface"] = read_surface(surface)
    if points:
        results["points"] = read_scene_points(points)
    if traces:
        results["traces"] = read_traces(traces)
    if capture:
        camera.imager(microscope.imager())
        results["image"] = camera.read(capture)
    if tolerance:
        results["tolerance"] = read_tolerance(tolerance)
    origins = {path.name: read_provenance(path) for path in inputs[1:] if path}
    if volume and (score := origins[volume.name].get(SCORE)):
        results["notes"] = {"volume": f"Of the capture, {score}."}
    provenance = camera.recorded(provenance_of(*inputs, design=microscope))
    with Progress() as progress, errors_name_file(design):
        write_report(output, microscope, **results, origins=origins, provenance=provenance, progress=progress)
    camera.print_corrections()
    size = f"{output.stat().st_size / 1e6:.1f} MB, opens in any browser"
    click.echo(f"{output}: {size}; {objects_in(microscope.imager())}")


@command("explore", "Example: gs-jax explore geomscope --study targets.toml -o mine.toml")
def explore_command(
    design: DesignPath,
    *,
    study: Path | None = None,
    output: Path | None = None,
    terms: Path | None = None,
    port: Annotated[int, click.IntRange(0, 65535)] = 0,
    browser: bool = True,
    light: Light,
):
    """Change sensor distance, curvature, aperture, pitch, depths and field of DESIGN by sliders in a browser.

    The page shows violated targets, spots, the layout with ghosts, the datasheet and a small simulated reconstruction.
    It compares and saves designs. Only this machine can open it; Ctrl-C ends it.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.

    Options:
        study: STUDY.toml whose targets are evaluated, as in `gs-jax optimize`.
        output: NEW.toml to save to; a number is added if it exists. [default: NAME-new.toml]
        port: Port of the page; 0 takes a free one.
        browser: Open the page in a browser.
    """
    import webbrowser

    from ..apps.explore import Server, Session
    from ..codesign.study import read_study
    from ..codesign.terms import add_terms

    if terms and not study:
        raise InputError("--terms must be used with --study, which names them.")
    if terms:
        add_terms(terms)
    saves = output or Path(f"{design.stem}-new.toml")
    check_output(saves, [".toml"])
    microscope, targets = light.read_design(design), read_study(study) if study else None
    with Progress() as progress:
        with progress.step("Compiling"):
            session = Session(microscope, targets, saves, provenance_of(design, study, terms))
            session.move({})
    with Server(session, port) as server:
        click.echo(f"{server.url} shows {microscope.name}, {objects_in(microscope.imager())}; Ctrl-C ends it")
        if browser:
            webbrowser.open_new_tab(server.url)
        server.serve_forever()


@command("demo", "Example: gs-jax demo --out demo")
def demo_command(*, out: Path = Path("gs-jax-demo")):
    """Run the whole pipeline on the built-in design: image a scene, reconstruct it, write a folder with reports."""
    from ..apps.example_pipeline import run

    with Progress() as progress:
        report = run(out, progress)
    click.echo(f"{report}: the files, and their results")
    click.echo(f"{report.with_suffix('.html')}: the microscope and its results, in a browser")


@command("benchmark", "Example: gs-jax benchmark --out benchmark")
def benchmark_command(*, out: Path = Path("gs-jax-benchmark")):
    """Compare back-projection with ADMM, Richardson-Lucy and others: time, memory and quality (the paper's Fig. 9)."""
    from ..apps.benchmark import run, write, write_records

    folder = make_folder(out)
    numbers, provenance = folder / "benchmark.json", provenance_of()

    def callback(records):
        write_records(numbers, records, provenance)
        partial_outputs[numbers] = PARTIAL

    with Progress() as progress:
        records, skipped = run(callback=callback, progress=progress)
    write(records, skipped, folder, provenance)
    for missing in skipped:
        click.echo(f"left out: {missing['method']} at {missing['pairs']:.1e} pairs: {missing['reason']}")
    click.echo(f"{folder}: benchmark.json, .csv, .md and .png")
