"""What a page says in tables: the datasheet with what violates what, calibration, tolerances, origins of files."""

import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ...base.errors import InputError
from ...design.datasheets import circle_of_confusion_of
from ...design.design import Design, span_of
from ...io.files import read_text
from ...typing import PathLike

# A spot so many times wider than promised is marked, as `gs_jax.design.diagnostics` has it in words.
_FAR = 2.0
_LEAST_STREHL = 0.01

# Of the datasheet: what, unit, equation of the paper.
_ROWS = {
    "magnification": ("magnification M", "", "Eq. 3"),
    "scale": ("scale of the pattern", "", "Eq. 1"),
    "lateral_resolution_um": ("lateral resolution, promised", "um", "Eq. 5"),
    "axial_resolution_um": ("axial resolution, promised", "um", "Eq. 6"),
    "spot_width_um": ("width of a spot at half height, in the object", "um", "exact rays"),
    "spot_radius_um": ("radius of 80 % of a spot's light, in the object", "um", "exact rays"),
    "blur_um": ("blur of a thin lens on the sensor", "um", ""),
    "focus_distance_mm": ("image at", "mm", ""),
    "depth_of_field_mm": ("depth of field, if focused there", "mm", "Eq. 8"),
    "near_limit_mm": ("from", "mm", "Eq. 8"),
    "far_limit_mm": ("to", "mm", "Eq. 8"),
    "strehl_on_axis": ("Strehl ratio on the axis", "", "Eq. 9"),
    "lenses_per_point": ("lenses that see a point", "", ""),
    "occupancy": ("occupancy", "", "Eq. 11"),
}


class Row(NamedTuple):
    """A line of the datasheet, and which of its cells violate something, in words or not at all."""

    name: str
    unit: str
    source: str
    cells: list[tuple[str, str]]


def sheet_rows(design: Design, sheet: Mapping[str, Any]) -> list[Row]:
    """The datasheet by depth."""
    circle_of_confusion = 1000 * circle_of_confusion_of(design, None)
    promised = sheet["lateral_resolution_um"]

    def fault(key: str, i: int, value: float | None) -> str:
        if key == "blur_um" and value is not None and value > circle_of_confusion:
            return f"out of focus: more than the circle of confusion, {circle_of_confusion:.3g} um"
        if key == "spot_width_um" and value is not None and value > _FAR * promised[i]:
            return "more than twice what Eq. 5 promises"
        if key == "occupancy" and value is not None and value > 1:
            return "sub-images of an object that fills the field overlap"
        return ""

    return [
        Row(name, unit, source, [(_cell(key, value), fault(key, i, value)) for i, value in enumerate(sheet[key])])
        for key, (name, unit, source) in _ROWS.items()
    ]


def _cell(key: str, value: float | None) -> str:
    if key == "strehl_on_axis" and value is not None and value < _LEAST_STREHL:
        return f"< {_LEAST_STREHL:g}"
    return plain(value)


def plain(value: float | None) -> str:
    """A number to read."""
    return "infinite" if value is None else f"{value:.4g}"


def device_facts(design: Design, sheet: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The device in a few numbers."""
    sensor, lens, array, imaging = design.sensor, design.lens, design.array, design.imaging
    rows, columns = sensor.shape
    side = lambda n: f"{n * sensor.pixel_pitch_um / 1000:.4g}"
    shape = f"radius {span_of(lens.radius_of_curvature_mm)} mm, index {lens.refractive_index:g}"
    if lens.focal_length_mm is not None:
        shape = "ideal, thin"
    bent = f", conic constant {span_of(lens.conic_constant)}" if lens.conic_constant else ""
    terms = f", {len(lens.aspheric_terms)} aspheric terms" if lens.aspheric_terms else ""
    return [
        ("lenses", f"{len(array.centers_mm)} on {array.size_mm[0]:g} x {array.size_mm[1]:g} mm"),
        ("a lens", f"{shape}{bent}{terms}, {span_of(lens.aperture_diameter_mm)} mm wide"),
        ("faces the object", f"the lenses' {lens.orientation} side"),
        ("focal length", f"{plain(sheet['focal_length_mm'])} mm"),
        ("F-number, NA", f"{plain(sheet['f_number'])}, {plain(sheet['numerical_aperture'])}"),
        ("pitch", f"{plain(sheet['pitch_mm'])} mm (SD {plain(sheet['pitch_sd_mm'])} mm)"),
        ("plate", f"{array.substrate_thickness_mm:g} mm thick, {100 * sheet['coverage']:.1f} % covered by lenses"),
        ("sensor", f"{rows} x {columns} pixels of {sensor.pixel_pitch_um:g} um: {side(rows)} x {side(columns)} mm"),
        ("sensor distance", f"{imaging.sensor_distance_mm:g} mm"),
        ("objects at", f"{imaging.working_distance_mm[0]:g} to {imaging.working_distance_mm[1]:g} mm"),
        ("light", f"{imaging.wavelength_nm:g} nm"),
        ("field radius", f"{imaging.field_radius_mm:g} mm"),
    ]


def calibration_rows(design: Design) -> list[tuple[str, str, str]]:
    """What `gs-jax calibrate` found, with standard deviations; empty if it did not."""
    said = design.provenance
    values, deviations = said.get("calibrated_values", {}), said.get("standard_deviations", {})
    if not isinstance(values, dict) or not isinstance(deviations, dict):
        return []
    return [(str(name), f"{value}", f"{deviations.get(name, '')}") for name, value in values.items()]


def calibration_summary(design: Design) -> str:
    """In one line, or none."""
    said = design.provenance
    if "calibrated_spots" not in said:
        return ""
    found = f"{said['calibrated_spots']} spots of {said.get('calibrated_captures', '?')} captures"
    mirrored = ", mirrored" if said.get("mirrored") else ""
    return f"{found}, {said.get('calibrated_rms_pixels', '?')} pixels RMS{mirrored}."


def read_tolerance(path: PathLike) -> dict[str, Any]:
    """What `gs-jax tolerance -o` wrote; `InputError` if it is anything else."""
    try:
        found = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {str(error):.200}.") from error
    keys = ("depth_mm", "over_depths", "drawn", "nominal", "targets", "yield")
    missing = [key for key in keys if not isinstance(found, dict) or key not in found]
    if missing:
        raise InputError(f"{path}: found no {missing[0]!r}, allowed: what `gs-jax tolerance -o` writes.")
    return found


class Tolerances(NamedTuple):
    """Of a tolerance analysis: its yield in words, a line a tolerance, and widths by depth for a chart."""

    summary: str
    rows: list[tuple[str, ...]]
    widths: dict[str, tuple[list[float], list[float]]]


def tolerance_facts(found: Mapping[str, Any], path: str = "the analysis") -> Tolerances:
    """What devices become, from the numbers of `gs-jax tolerance`; `InputError` if they are not as it writes them."""
    try:
        cells = lambda each: tuple("-" if x is None else f"{x:.3g}" for x in each.values())
        without = found.get("yield_without", {})
        rows = [
            (name, *cells(each), f"{100 * without[name]:.3g}" if name in without else "")
            for name, each in found["over_depths"].items()
        ]
        drawn, depths = found["drawn"], found["depth_mm"]
        summary = f"{100 * found['yield']:.3g} % of {drawn['devices']} devices keep all targets."
        widths = {"as designed": (depths, found["nominal"]["spot_width_um"])}
        names = {"p50": "devices, median", "p5": "5 %", "p95": "95 %"}
        widths |= {name: (depths, drawn["spot_width_um"][key]) for key, name in names.items()}
        widths["target"] = (depths, found["targets"]["max_width_um"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        allowed = "what `gs-jax tolerance -o` writes"
        raise InputError(f"{path}: found other numbers ({error!r:.80}), allowed: {allowed}.") from error
    return Tolerances(summary, rows, widths)


# From the first slash to the last but one word: a folder of somebody's machine.
_ABSOLUTE = re.compile(r"""(?<![^\s='"(\[,])(?:file://)?(?:[A-Za-z]:)?[\\/](?:[^\s'"=,]*[\\/])?([^\s'"\\/=,]+)""")


def without_folders(text: str) -> str:
    """The same with the names of files in place of their absolute paths."""
    try:
        words = shlex.split(text) if text.startswith("gs-jax ") else []
    except ValueError:
        words = []
    if words:
        text = shlex.join(_name_only(word) for word in words)
    return _ABSOLUTE.sub(r"\1", text)


def _name_only(word: str) -> str:
    option, equals, value = word.partition("=")
    if option.startswith("-") and equals:
        return f"{option}={_name_only(value)}"
    return re.split(r"[\\/]", word.rstrip("\\/"))[-1] if re.match(r"(?:[A-Za-z]:)?[\\/]", word) else word


def origin_rows(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Where a file comes from, without its design, which is a text of many lines, and without folders."""
    text = lambda value: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return [(str(key), without_folders(text(value))) for key, value in provenance.items() if key != "design"]


def versions() -> list[tuple[str, str]]:
    """Of what made the page."""
    from ...base.machine import describe

    found = describe()
    return [(name, found[name]) for name in ("gs-jax", "python", "jax", "system")]


def name_of(path: PathLike) -> str:
    """Without its folder."""
    return Path(path).name
