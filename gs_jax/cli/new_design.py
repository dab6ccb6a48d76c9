"""`gs-jax new-design`: a design file from options, and from questions at a terminal."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError, errors_name_file
from ..io.files import check_output
from .command import check_may_write, force_option, provenance_of
from .options import given_options

# Table of each option that is a key of the file, in the order of the questions.
_TABLES = {
    "pixel_pitch_um": "sensor",
    "shape": "sensor",
    "refractive_index": "lens",
    "radius_of_curvature_mm": "lens",
    "size_mm": "array",
    "aperture_diameter_mm": "lens",
    "substrate_thickness_mm": "array",
    "working_distance_mm": "imaging",
    "sensor_distance_mm": "imaging",
    "wavelength_nm": "imaging",
    "field_radius_mm": "imaging",
}
# Answers that a terminal suggests where there is no default: the paper's.
_OFFERED = {"pixel_pitch_um": 4.5, "shape": (5120, 5120), "working_distance_mm": (18.0, 30.0)}
_FOCAL_LENGTH_MM, _COUNT = 4.65, 200


def at_terminal() -> bool:
    """Whether questions can be answered."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _print_schema(context: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from ..design.keys import schema

        click.echo(json.dumps(schema(), indent=2))
        context.exit()


@click.command(
    "new-design",
    epilog="Example: gs-jax new-design --pixel-pitch-um 3.45 --shape 3000 4096 --focal-length-mm 4.6 "
    "--centers vendor.csv --working-distance-mm 18 23 -o my.toml",
)
@click.option("--pixel-pitch-um", type=float, help="Pixel pitch of the camera.")
@click.option("--shape", type=int, nargs=2, help="Rows and columns of the camera.")
@click.option(
    "--focal-length-mm", "--focal-length", type=float, help="Focal length of a lens in air; R = f (n - 1) is written."
)
@click.option(
    "--radius-of-curvature-mm", type=float, help="Radius of curvature of a lens, instead of --focal-length-mm."
)
@click.option("--refractive-index", type=float, help="Index of lenses and plate.  [default: 1.43, PDMS]")
@click.option(
    "--aperture-diameter-mm",
    type=float,
    help="Diameter of a lens.  [default: mean nearest-neighbour distance; with --count 1.46 times the root of the "
    "plate's area per lens, as the paper's; at most 2 R / n]",
)
@click.option("--centers", type=Path, help="Lens centres: a text table with x and y in each line and any header.")
@click.option(
    "--centers-unit", type=click.Choice(["mm", "um", "px"]), help="Unit of --centers.  [default: the header's, else mm]"
)
@click.option("--centers-columns", nargs=2, help="Names of the columns of x and y, if they are ambiguous.")
@click.option(
    "--centers-origin",
    type=click.Choice(["center", "corner"]),
    help="Origin of --centers: the plate's middle or corner. In px the corner is the sensor's first pixel.",
)
@click.option("--mirror", is_flag=True, help="Reverse x: the list shows the plate from its other side.")
@click.option("--rotation-deg", type=float, help="Approximate rotation of the array, +x toward +y.  [default: 0]")
@click.option("--crop", is_flag=True, help="Leave out lenses without an image on the sensor.")
@click.option("--count", type=click.IntRange(1, 100_000), help="Make a random layout of this many lenses.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the random layout.")
@click.option("--size-mm", type=float, nargs=2, help="Plate, X Y.  [default: around the lenses, or the sensor's]")
@click.option(
    "--substrate-thickness-mm",
    type=float,
    help="Thickness of the plate with lenses.  [default: 1, or the lenses' height plus 0.3]",
)
@click.option("--working-distance-mm", type=float, nargs=2, help="NEAR FAR of the object from the plate.")
@click.option("--sensor-distance-mm", type=float, help="Lenses to sensor.  [default: thin-lens focus]")
@click.option("--wavelength-nm", type=float, help="Wavelength.  [default: 520]")
@click.option(
    "--field-radius-mm",
    type=float,
    help="Field of a lens about its axis.  [default: 14 lenses see a point, at most NEAR / 4]",
)
@click.option("--name", help="Name in reports.  [default: the file's]")
@click.option("-o", "--output", type=Path, required=True, help="MY.toml, with a comment for each key.")
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON schema of design files, for editors, and exit.",
)
@force_option
def new_design_command(output: Path, centers: Path | None, name: str | None, force: bool, **options: Any):
    """Write the design file of your own microlens array and camera.

    At a terminal it asks for options that are not given. Elsewhere those without a default are required. Lens centres
    are read from a file (--centers) or random (--count).
    """
    from ..design.design import checked_design
    from ..design.keys import commented
    from ..io.files import write_text

    check_output(output, [".toml"])
    check_may_write(output, inputs=(centers,), force=force)
    known = {key: value for key, value in options.items() if value is not None}
    asking = at_terminal()
    _check_together(known, centers, asking)
    given = set(known)
    _lenses(known, asking)
    _centers(known, centers, asking)
    for key in list(_TABLES)[list(_TABLES).index("aperture_diameter_mm") :]:
        _fill(known, key, asking)
    left_out = _crop(known, asking)
    tables: dict[str, Any] = {"name": name or output.stem, "sensor": {}, "lens": {}, "array": {}, "imaging": {}}
    for key, table in _TABLES.items():
        tables[table][key] = list(known[key]) if isinstance(known[key], tuple) else known[key]
    tables["array"]["centers_mm"] = known["centers"].round(6).tolist()
    if "rotation_deg" in known:
        tables["calibration"] = {"rotation_deg": known["rotation_deg"]}
    tables["provenance"] = provenance_of(known.get("file"))
    design = checked_design(output, tables)
    write_text(output, commented(design), [".toml"])
    defaults = [f"{key} = {_format(known[key])}" for key in _TABLES if key not in given | {"radius_of_curvature_mm"}]
    if defaults and not asking:
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
        click.echo(f"gs-jax: warning: {output}: `gs-jax mold` refuses it: {fault}", err=True)


def _faults_of_mold(design) -> list[str]:
    """What keeps the lenses of a design from being molded."""
    from ..mold.manufacturability import check_design
    from ..mold.solids import MoldShape, default_chord

    chord = default_chord(design.imager().array)
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
    missing = [_option(key) for key in ("pixel_pitch_um", "shape") if key not in known]
    if not {"focal_length_mm", "radius_of_curvature_mm"} & known.keys():
        missing.append("--focal-length-mm (or --radius-of-curvature-mm)")
    if not centers and "count" not in known:
        missing.append("--centers (or --count)")
    if "working_distance_mm" not in known:
        missing.append("--working-distance-mm")
    if missing:
        raise InputError(f"{', '.join(missing)} must be given where no terminal can ask for them.")


def _lenses(known: dict[str, Any], asking: bool) -> None:
    """Add camera and lens."""
    from ..design.start import radius_of

    for key in ("pixel_pitch_um", "shape", "refractive_index"):
        _fill(known, key, asking)
    if "radius_of_curvature_mm" in known:
        return
    if "focal_length_mm" not in known:
        kinds = click.Choice(["focal-length", "radius"])
        if (
            click.prompt("what is known of a lens: its focal length or its radius", "focal-length", type=kinds)
            == "radius"
        ):
            return _fill(known, "radius_of_curvature_mm", asking)
        known["focal_length_mm"] = _ask(
            known, "lens.focal_length_mm", _FOCAL_LENGTH_MM, "focal length of a lens, in air"
        )
    known["radius_of_curvature_mm"] = radius_of(known["focal_length_mm"], known["refractive_index"])


def _centers(known: dict[str, Any], file: Path | None, asking: bool) -> None:
    """Add lens centres and the plate's size, from a file or random."""
    from ..design.start import generated_centers

    while asking and file is None and "count" not in known:
        answer = click.prompt("file of lens centres (empty: make a random layout)", "", show_default=False).strip()
        if not answer:
            known["count"] = click.prompt("number of lenses", _COUNT, type=click.IntRange(1, 100_000))
        else:
            file = Path(answer)
            try:
                _read(known, file, asking)
            except InputError as error:
                click.echo(f"Error: {error}")
                file = None
    if file is None:
        _fill(known, "size_mm", asking)
        known["centers"] = generated_centers(known["count"], tuple(known["size_mm"]), known["seed"])
        return
    if "centers" not in known:
        _read(known, file, asking)
    _fill(known, "size_mm", asking)


def _read(known: dict[str, Any], file: Path, asking: bool) -> None:
    """Read the file's centres, when unit and origin are known."""
    from ..design.centers import lens_columns, read_centers, unit_of_file
    from ..design.start import check_origin_said, check_unit_said

    columns, unit, origin = (known.get(f"centers_{key}") for key in ("columns", "unit", "origin"))
    size = tuple(known["size_mm"]) if "size_mm" in known else None
    shape, pitch = tuple(map(float, known["shape"])), known["pixel_pitch_um"] / 1000
    found = unit_of_file(file, columns)
    if own := next(iter(lens_columns(file, columns)), None):
        raise InputError(f"{file}: a column {own} must be in the `centers_file` of a design, got it in --centers.")
    if unit is None and found is None and asking:
        unit = click.prompt("unit of the file's numbers", "mm", type=click.Choice(["mm", "um", "px"]))
    place = {"columns": columns, "unit": unit, "size": size, "shape": shape, "pixel_pitch": pitch}
    plain = read_centers(file, origin="center", **place)
    with errors_name_file(file):
        if (unit or found) is None:
            check_unit_said(plain)
        if origin is None and (unit or found) != "px":
            try:
                check_origin_said(plain)
            except InputError:
                if not asking:
                    raise
                kinds = click.Choice(["center", "corner"])
                origin = click.prompt("no x or y is below 0: what are they counted from", "corner", type=kinds)
    known["centers"] = read_centers(file, origin=origin, mirror=known["mirror"], **place)
    known["file"] = file


def _crop(known: dict[str, Any], asking: bool) -> int:
    """Leave out lenses without an image on the sensor, if wanted, and fit the plate; return their number."""
    from ..design.start import plate_of, within_reach

    kept = within_reach(known)
    beyond = len(kept) - int(kept.sum())
    if not beyond:
        return 0
    found = f"{beyond} of {len(kept)} lenses are beyond the sensor's reach"
    if not kept.any() or not (known["crop"] or (asking and click.confirm(f"{found}: leave them out?", default=True))):
        raise InputError(f"{known.get('file', 'layout')}: {found}; --crop leaves them out.")
    known["centers"] = known["centers"][kept]
    known["size_mm"] = tuple(map(min, known["size_mm"], plate_of(known["centers"])))
    return beyond


def _fill(known: dict[str, Any], key: str, asking: bool) -> None:
    """Add a missing value: the answer to a question, or the default."""
    from ..design.start import DEFAULTS

    if key in known:
        return
    default = DEFAULTS[key](known) if key in DEFAULTS else None
    if asking:
        known[key] = _ask(known, f"{_TABLES[key]}.{key}", default or _OFFERED.get(key))
    elif default is None:
        raise InputError(f"{_option(key)} must be given: it does not follow from other options.")
    else:
        known[key] = default


def _ask(known: dict[str, Any], path: str, default: Any, meaning: str = "") -> Any:
    """Ask until the answer is allowed; confirm values that look like a wrong unit."""
    from ..design.keys import design_keys, problem
    from ..design.start import clash
    from ..design.validation import USUAL, meant, slip

    key = design_keys()[path]
    hint = f"usually {key.usual}" if key.usual else key.allowed
    text = f"{meaning or key.meaning} ({hint})"
    while True:
        answer = click.prompt(text, None if default is None else _format(default))
        value = _number(answer, whole=path == "sensor.shape", pair=key.allowed.startswith("["))
        if path in USUAL and (question := slip(path, value)):
            other = meant(path, value)
            if click.confirm(question, default=other is not None):
                value = value if other is None else other
            elif other is None:
                continue
        if not (wrong := problem(path, value) or clash(path.partition(".")[2], value, known)):
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
    return " ".join(f"{each:g}" for each in value) if isinstance(value, list | tuple) else f"{value:g}"


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"
