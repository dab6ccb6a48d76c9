"""`gs-jax new-design`: a design file from options, and from questions at a terminal."""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import click

from ..base.errors import InputError, errors_name_file
from .commands import OptionGroup, check_outputs, command, given_options, print_warning, provenance_of

# Keys of the file that are options, in the order of the questions.
_KEYS = (
    "sensor.pixel_pitch_um",
    "sensor.shape",
    "lens.refractive_index",
    "lens.radius_of_curvature_mm",
    "array.size_mm",
    "lens.aperture_diameter_mm",
    "array.substrate_thickness_mm",
    "imaging.working_distance_mm",
    "imaging.sensor_distance_mm",
    "imaging.wavelength_nm",
    "imaging.field_radius_mm",
)
# Answers that a terminal suggests where there is no default: the paper's.
_OFFERED = {
    "sensor.pixel_pitch_um": 4.5,
    "sensor.shape": (5120, 5120),
    "lens.focal_length_mm": 4.65,
    "imaging.working_distance_mm": (18.0, 30.0),
}
_COUNT = 200
_UNITS, _ORIGINS = click.Choice(["mm", "um", "px"]), click.Choice(["center", "corner"])


@dataclass
class DesignOptions(OptionGroup):
    """What a lab knows of its camera and its array.

    Options:
        pixel_pitch_um: Pixel pitch of the camera.
        shape: Rows and columns of the camera.
        focal_length_mm: Focal length of a lens in air; R = f (n - 1) is written.
        radius_of_curvature_mm: Radius of curvature of a lens, instead of --focal-length-mm.
        refractive_index: Index of lenses and plate. [default: 1.43, PDMS]
        aperture_diameter_mm: Diameter of a lens. [default: mean nearest-neighbour distance; with --count 1.46 times the
            root of the plate's area per lens, as the paper's; at most 2 R / n]
        centers_unit: Unit of --centers. [default: the header's, else mm]
        centers_columns: Names of the columns of x and y, if they are ambiguous.
        centers_origin: Origin of --centers: the plate's middle or corner. In px the corner is the sensor's first pixel.
        mirror: Reverse x: the list shows the plate from its other side.
        rotation_deg: Approximate rotation of the array, +x toward +y. [default: 0]
        crop: Leave out lenses without an image on the sensor.
        count: Make a random layout of this many lenses.
        seed: Seed of the random layout.
        size_mm: Plate, X Y. [default: around the lenses, or the sensor's]
        substrate_thickness_mm: Thickness of the plate with lenses. [default: 1, or the lenses' height plus 0.3]
        working_distance_mm: NEAR FAR of the object from the plate.
        sensor_distance_mm: Lenses to sensor. [default: thin-lens focus]
        wavelength_nm: Wavelength. [default: 520]
        field_radius_mm: Field of a lens about its axis. [default: 14 lenses within it, at most NEAR / 4]
    """

    pixel_pitch_um: float | None = None
    shape: tuple[int, int] | None = None
    focal_length_mm: Annotated[float | None, "--focal-length"] = None
    radius_of_curvature_mm: float | None = None
    refractive_index: float | None = None
    aperture_diameter_mm: float | None = None
    centers_unit: Annotated[str, _UNITS] | None = None
    centers_columns: tuple[str, str] | None = None
    centers_origin: Annotated[str, _ORIGINS] | None = None
    mirror: bool = False
    rotation_deg: float | None = None
    crop: bool = False
    count: Annotated[int, click.IntRange(1, 100_000)] | None = None
    seed: Annotated[int, click.IntRange(0)] = 0
    size_mm: tuple[float, float] | None = None
    substrate_thickness_mm: float | None = None
    working_distance_mm: tuple[float, float] | None = None
    sensor_distance_mm: float | None = None
    wavelength_nm: float | None = None
    field_radius_mm: float | None = None


def at_terminal() -> bool:
    """Whether questions can be answered."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _print_schema(context: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from ..design.start import schema

        click.echo(json.dumps(schema(), indent=2))
        context.exit()


_SCHEMA = click.Option(
    ["--schema"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON schema of design files, for editors, and exit.",
)


@command(
    "new-design",
    "Example: gs-jax new-design --pixel-pitch-um 3.45 --shape 3000 4096 --focal-length-mm 4.6 --centers vendor.csv "
    "--working-distance-mm 18 23 -o my.toml",
    more=[_SCHEMA],
)
def new_design_command(
    *, options: DesignOptions, centers: Path | None = None, name: str | None = None, output: Path, force: bool = False
):
    """Write the design file of your own microlens array and camera.

    At a terminal it asks for options that are not given. Elsewhere those without a default are required. Lens centres
    are read from a file (--centers) or random (--count).

    Options:
        centers: Lens centres: a text table with x and y in each line and any header.
        name: Name in reports. [default: the file's]
        output: MY.toml, with a comment for each key.
    """
    from ..design.design import checked_design
    from ..design.start import commented
    from ..io.files import write_text

    check_outputs(output, [".toml"], inputs=(centers,), force=force)
    known = {key: value for key, value in vars(options).items() if value is not None}
    asking = at_terminal()
    _check_together(known, centers, asking)
    given = {*known, "radius_of_curvature_mm"}
    for path in _KEYS[:3]:
        _fill(known, path, asking)
    _fill_radius(known, asking)
    _fill_centers(known, centers, asking)
    for path in _KEYS[4:]:
        _fill(known, path, asking)
    left_out = _crop(known, asking)
    tables: dict[str, Any] = {"name": name or output.stem, "sensor": {}, "lens": {}, "array": {}, "imaging": {}}
    for table, _, key in (path.partition(".") for path in _KEYS):
        tables[table][key] = list(known[key]) if isinstance(known[key], tuple) else known[key]
    tables["array"]["centers_mm"] = known["centers"].round(6).tolist()
    if "rotation_deg" in known:
        tables["calibration"] = {"rotation_deg": known["rotation_deg"]}
    tables["provenance"] = provenance_of(known.get("file"))
    design = checked_design(output, tables)
    write_text(output, commented(design), [".toml"])
    keys = [path.partition(".")[2] for path in _KEYS]
    if (defaults := [f"{key} = {_format(known[key])}" for key in keys if key not in given]) and not asking:
        click.echo(f"by default: {', '.join(defaults)}")
    if left_out:
        click.echo(
            f"left out: {left_out} lenses beyond the sensor's reach; the plate is {_format(known['size_mm'])} mm"
        )
    radius, lenses = known["radius_of_curvature_mm"], len(design.array.centers_mm)
    lens = f"f = {radius / (design.refractive_index - 1):.4g} mm (R = {radius:.4g} mm)"
    sensor = f"sensor at {design.imaging.sensor_distance_mm:g} mm"
    click.echo(f"{output}: {lenses} lenses of {lens}, {sensor}; see gs-jax metrics {output}")
    for fault in _faults_of_mold(design):
        print_warning(f"{output}: `gs-jax mold` refuses it: {fault}")


def _faults_of_mold(design) -> list[str]:
    """Faults for which the lenses of a design cannot be molded."""
    from ..mold.lenslets import Part
    from ..mold.manufacturability import check_design
    from ..mold.solids import MoldShape

    chord = Part(design.imager().array).default_chord
    results = check_design(design, MoldShape(), chord=chord, resolution=0.025)
    return [result.text for result in results if result.level == "error"]


def _check_together(known: dict[str, Any], centers: Path | None, asking: bool) -> None:
    """Raise `InputError` for options that exclude each other, or are missing without a terminal."""
    if {"focal_length_mm", "radius_of_curvature_mm"} <= known.keys():
        raise InputError("--radius-of-curvature-mm must be used without --focal-length-mm.")
    if centers and "count" in known:
        raise InputError("--count must be used without --centers.")
    if centers and given_options(["seed"]):
        raise InputError("--seed must be used without --centers: it is of a random layout.")
    about = [key for key in ("centers_unit", "centers_columns", "centers_origin", "mirror") if known.get(key)]
    if about and not centers and not (asking and "count" not in known):
        raise InputError(f"{_option(about[0])} must be used with --centers.")
    if asking:
        return
    required = {
        "--pixel-pitch-um": "pixel_pitch_um" in known,
        "--shape": "shape" in known,
        "--focal-length-mm (or --radius-of-curvature-mm)": {"focal_length_mm", "radius_of_curvature_mm"} & known.keys(),
        "--centers (or --count)": centers or "count" in known,
        "--working-distance-mm": "working_distance_mm" in known,
    }
    if missing := [option for option, is_given in required.items() if not is_given]:
        raise InputError(f"{', '.join(missing)} must be given where no terminal can ask for them.")


def _fill_radius(known: dict[str, Any], asking: bool) -> None:
    """Add the radius of curvature, which may follow from the focal length."""
    from ..design.start import radius_of

    if "radius_of_curvature_mm" in known:
        return
    if "focal_length_mm" not in known:
        choice, text = (
            click.Choice(["focal-length", "radius"]),
            "what is known of a lens: its focal length or its radius",
        )
        if click.prompt(text, "focal-length", type=choice) == "radius":
            return _fill(known, "lens.radius_of_curvature_mm", asking)
        path = "lens.focal_length_mm"
        known["focal_length_mm"] = _ask(known, path, _OFFERED[path], "focal length of a lens, in air")
    known["radius_of_curvature_mm"] = radius_of(known["focal_length_mm"], known["refractive_index"])


def _fill_centers(known: dict[str, Any], file: Path | None, asking: bool) -> None:
    """Add lens centres, from a file or random."""
    from ..design.start import generated_centers

    while asking and file is None and "count" not in known:
        answer = click.prompt("file of lens centres (empty: make a random layout)", "", show_default=False).strip()
        if not answer:
            known["count"] = click.prompt("number of lenses", _COUNT, type=click.IntRange(1, 100_000))
            break
        try:
            _read(known, file := Path(answer), asking)
        except InputError as error:
            click.echo(f"Error: {error}")
            file = None
    if file is None:
        _fill(known, "array.size_mm", asking)
        known["centers"] = generated_centers(known["count"], tuple(known["size_mm"]), known["seed"])
    elif "centers" not in known:
        _read(known, file, asking)


def _read(known: dict[str, Any], file: Path, asking: bool) -> None:
    """Read the file's centres, when unit and origin are known."""
    from ..design.start import check_centered, check_in_mm
    from ..design.tables import CentersFile

    unit, origin = known.get("centers_unit"), known.get("centers_origin")
    table = CentersFile(file, known.get("centers_columns"))
    if own := next(iter(table.lens), None):
        raise InputError(f"{file}: a column {own} must be in the `centers_file` of a design, got it in --centers.")
    if unit is None and table.unit is None and asking:
        unit = click.prompt("unit of the file's numbers", "mm", type=_UNITS)
    options = {
        "unit": unit,
        "size": tuple(known["size_mm"]) if "size_mm" in known else None,
        "shape": tuple(map(float, known["shape"])),
        "pixel_pitch": known["pixel_pitch_um"] / 1000,
    }
    plain = table.centers(origin="center", **options)
    with errors_name_file(file):
        if (unit or table.unit) is None:
            check_in_mm(plain)
        if origin is None and (unit or table.unit) != "px":
            try:
                check_centered(plain)
            except InputError:
                if not asking:
                    raise
                question = "no x or y is below 0: what are they counted from"
                origin = click.prompt(question, "corner", type=_ORIGINS)
    known["centers"] = table.centers(origin=origin, mirror=known["mirror"], **options)
    known["file"] = file


def _crop(known: dict[str, Any], asking: bool) -> int:
    """Leave out lenses without an image on the sensor, if requested, and fit the plate; return their number."""
    from ..design.start import plate_of, within_reach

    mask = within_reach(known)
    beyond = len(mask) - int(mask.sum())
    if not beyond:
        return 0
    text = f"{beyond} of {len(mask)} lenses are beyond the sensor's reach"
    if not mask.any() or not (known["crop"] or (asking and click.confirm(f"{text}: leave them out?", default=True))):
        raise InputError(f"{known.get('file', 'layout')}: {text}; --crop leaves them out.")
    known["centers"] = known["centers"][mask]
    known["size_mm"] = tuple(map(min, known["size_mm"], plate_of(known["centers"])))
    return beyond


def _fill(known: dict[str, Any], path: str, asking: bool) -> None:
    """Add a missing value: the answer to a question, or the default."""
    from ..design.start import DEFAULTS

    key = path.partition(".")[2]
    if key in known:
        return
    default = DEFAULTS[key](known) if key in DEFAULTS else None
    if asking:
        known[key] = _ask(known, path, default or _OFFERED.get(path))
    elif default is None:
        raise InputError(f"{_option(key)} must be given: it does not follow from other options.")
    else:
        known[key] = default


def _ask(known: dict[str, Any], path: str, default: Any, meaning: str = "") -> Any:
    """Ask until the answer is allowed; confirm values that look like a wrong unit."""
    from ..design.start import clash, design_keys, problem
    from ..design.validation import USUAL, meant, slip

    key = design_keys()[path]
    text = f"{meaning or key.meaning} ({f'usually {key.usual}' if key.usual else key.allowed})"
    while True:
        answer = click.prompt(text, None if default is None else _format(default))
        value = _number(answer, whole=path == "sensor.shape", pair=key.allowed.startswith("["))
        if path in USUAL and (question := slip(path, value)):
            other = meant(path, value)
            if click.confirm(question, default=other is not None):
                value = value if other is None else other
            elif other is None:
                continue
        if not (wrong := problem(path, value) or clash(key.name, value, known)):
            return tuple(value) if isinstance(value, list) else value
        click.echo(f"Error: {wrong}")


def _number(answer: str, *, whole: bool, pair: bool) -> Any:
    """Parse an answer as a number, or two of them; other text is returned, to be refused."""
    try:
        numbers = [int(part) if whole else float(part) for part in re.split(r"[\s,x]+", answer.strip("[] "))]
    except ValueError:
        return answer
    return numbers if pair else numbers[0] if len(numbers) == 1 else answer


def _format(value: Any) -> str:
    return " ".join(f"{number:g}" for number in value) if isinstance(value, list | tuple) else f"{value:g}"


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"
