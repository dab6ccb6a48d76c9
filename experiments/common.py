"""Helpers for all experiments: command line, output files, and ray-traced captures.

An experiment has a function `run`, which tests call at a small size, and a function `report`, which takes the values
of the command line, calls `run` at full size, and returns what to write and print. The last line of the script is
`main(report)`.
"""

import argparse
import contextlib
import dataclasses
import inspect
import json
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.figure import Figure
from rich.console import Console, RenderableType
from rich.table import Table
from skimage.feature import peak_local_max

from gs_jax import Design, Grid, Imager, InputError, Progress, Sensor, geomscope, read_design
from gs_jax.apps.benchmark import markdown_table
from gs_jax.apps.pictures import PALETTE
from gs_jax.io.files import make_folder, write_figure, write_json, write_text
from gs_jax.microscope.lenses import EACH

# Designs that only experiments use.
DESIGNS = Path(__file__).parent / "designs"
OPTIONAL_PATH = {"type": Path, "nargs": "?"}
# Resolution of all pictures of experiments.
matplotlib.rcParams.update({"axes.prop_cycle": cycler(color=PALETTE), "font.size": 9.5, "legend.frameon": False})


class Report(NamedTuple):
    """Output of an experiment.

    Parameters
    ----------
    files
        Contents by file name: a figure for `.png`, text for `.md`, and any JSON-serialisable value for `.json`.
    shown
        Tables and text for the terminal.
    """

    files: dict[str, Any]
    shown: Sequence[RenderableType] = ()


def main(report: Callable[..., Report], arguments: dict[str, dict[str, Any]] | None = None, folder: str = "") -> None:
    """Run the command line of a script; `--out DIR` names the output folder. Invalid input exits with status 2.

    Parameters
    ----------
    report
        Takes the values of the arguments by name, and `progress`.
    arguments
        Arguments of the script beside `--out`: their names, and the options of `add_argument`.
    folder
        Subfolder of `out/`; by default the name of the script.
    """
    explanation = inspect.getdoc(inspect.getmodule(report)) or ""
    parser = argparse.ArgumentParser(description=explanation.splitlines()[0])
    for name, options in (arguments or {}).items():
        parser.add_argument(name, **options)
    parser.add_argument("--out", type=Path, default=Path("out") / (folder or Path(inspect.getfile(report)).stem))
    values = vars(parser.parse_args())
    out = values.pop("out")
    empty = not out.exists()
    try:
        make_folder(out)
        with Progress() as progress:
            results = report(**values, progress=progress)
        write(out, results)
    except InputError as error:
        if empty:
            with contextlib.suppress(OSError):
                out.rmdir()
        parser.error(str(error))
    Console(width=160).print(*results.shown, sep="\n")


def write(folder: Path, report: Report) -> None:
    """Write the files of a report, each atomically."""
    for name, content in report.files.items():
        if isinstance(content, Figure):
            write_figure(folder / name, content)
        elif isinstance(content, str):
            write_text(folder / name, content, [".md"])
        else:
            write_json(folder / name, content)


def table(columns: Iterable[str], rows: Iterable[Iterable[str]], title: str | None = None) -> Table:
    """Build a table for the terminal."""
    lines = Table(*columns, title=title, title_justify="left")
    for row in rows:
        lines.add_row(*row)
    return lines


def tables_report(
    name: str,
    numbers: Any,
    *tables: tuple[Sequence[str], Sequence[Sequence[str]]],
    title: str = "",
    text: str = "",
    **pictures: Figure,
) -> Report:
    """Report tables of columns and rows on the terminal and in `NAME.md`, numbers in `NAME.json`, and `NAME.png`."""
    parts = [f"# {title}" if title else "", *(markdown_table(*part) for part in tables), text]
    files = {f"{name}.json": numbers, f"{name}.md": "\n\n".join(filter(None, parts)) + "\n"}
    files |= {f"{name}.{suffix}": figure for suffix, figure in pictures.items()}
    return Report(files, [*(table(*part) for part in tables), *filter(None, [text])])


def names_of(allowed: Collection[str]) -> Callable[[str], list[str]]:
    """Type of an option that takes some of these names, separated by commas."""

    def names(text: str) -> list[str]:
        given = [name.strip() for name in text.split(",")]
        if unknown := [name for name in given if name not in allowed]:
            raise argparse.ArgumentTypeError(f"must be of {', '.join(allowed)}, got {', '.join(unknown)}.")
        return given

    return names


def half_light_radius(distances: np.ndarray, light: np.ndarray) -> float:
    """Radius that encloses half of the light, which is given at these distances from the middle."""
    order = np.argsort(distances)
    enclosed = np.cumsum(light[order])
    return float(np.interp(enclosed[-1] / 2, enclosed, distances[order]))


def design_file(name: str) -> Path:
    """File of a design that comes with the package, or of one in `DESIGNS`."""
    shipped = DESIGNS.parents[1] / "design" / f"{name}.toml"
    return shipped if shipped.exists() else DESIGNS / shipped.name


def designs_by_name(files: Sequence[Path], taken: Collection[str] = ()) -> dict[str, Design]:
    """Read designs, by name or by that of their file; raise `InputError` if two have the same name, or one is taken."""
    designs: dict[str, Design] = {}
    for file in files:
        design = read_design(file)
        name = design.name or file.stem
        if name in designs or name in taken:
            raise InputError(f"designs must have names of their own, got another {name}.")
        designs[name] = design
    return designs


def read_records(file: Path, key: str, value: Any, empty: dict[str, Any]) -> dict[str, Any]:
    """Read the records that earlier runs left in a file; without a file, return empty ones of this value of a key.

    Raise `InputError` if the file holds records of another value, or none.
    """
    if not file.exists():
        return {key: value} | empty
    try:
        records = json.loads(file.read_text())
    except ValueError:
        records = None
    if not isinstance(records, dict) or records.get(key) != value:
        got = records.get(key, "none") if isinstance(records, dict) else "no records"
        raise InputError(f"{file} must be of {key} {value}, got {got}.")
    return records


def design_of(data: Path | None) -> Design:
    """Design of the ray-traced captures in a folder; without a folder, the built-in design."""
    return read_design(data / "P1.toml") if data else geomscope()


def points_of(data: Path, scene: str) -> np.ndarray:
    """Points `(x, y, z, flux)` of a ray-traced scene, mm."""
    return np.array(json.loads((data / f"{scene}.json").read_text())["points_x_y_z_flux"])


def local_maxima(volume: np.ndarray, grid: Grid, **options) -> np.ndarray:
    """Peaks `(x, y, z, value)`, mm, by scikit-image's `peak_local_max` with these options."""
    voxels = peak_local_max(volume, exclude_border=False, **options)
    return np.column_stack([grid.to_mm(voxels), volume[tuple(voxels.T)]])


def cropped(imager: Imager, pixels: int, reach: float) -> Imager:
    """The middle of a sensor, and the lenses so near to it, mm."""
    centers = np.asarray(imager.array.centers)
    near = np.hypot(*centers.T) < reach
    own = {name: np.asarray(imager.array.of_lenses(name))[near] for name in EACH if getattr(imager.array, name).ndim}
    array = dataclasses.replace(imager.array, centers=centers[near], types=None, **own)
    sensor = Sensor((pixels, pixels), imager.sensor.pixel_pitch)
    return eqx.tree_at(lambda i: (i.array, i.sensor), imager, (array, sensor))
