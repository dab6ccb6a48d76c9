"""Data of the report: datasheet with violated assumptions, calibration, tolerances, provenance, views of volumes."""

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from ..base.errors import InputError
from ..base.machine import describe
from ..design.conversion import NO_SAMPLE, default_sample, object_begins
from ..design.datasheets import circle_of_confusion_of
from ..design.design import Design, span_of
from ..grid import Grid
from ..io.files import read_text
from ..lenses import MicrolensArray
from ..mold.lenslets import Part
from ..mold.solids import MoldShape, preview_solid
from ..typing import PathLike
from .pictures import block_maxima, display_range, downsample, png_uri, shade, to_base64, to_uint8

# Spots this many times wider than Eq. 5 are marked, as in `gs_jax.design.datasheets`.
_FAR = 2.0
_MIN_STREHL = 0.01

# Title, unit and source of the datasheet's rows.
_ROWS = {
    "magnification": ("magnification M", "", "Eq. 3"),
    "scale": ("scale of the pattern", "", "Eq. 1"),
    "lateral_resolution_um": ("lateral resolution, predicted", "um", "Eq. 5"),
    "axial_resolution_um": ("axial resolution, predicted", "um", "Eq. 6"),
    "fwhm_um": ("full width at half maximum of the PSF on the axis, in the object", "um", "diffraction"),
    "rms_width_um": ("RMS width of the PSF, in the object", "um", "exact rays"),
    "half_light_radius_um": ("radius of half of the light, in the object", "um", "exact rays"),
    "spot_radius_um": ("radius of 80 % of the light, in the object", "um", "exact rays"),
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
    """A row of the datasheet; cells are texts and the assumption that the value violates, or ""."""

    name: str
    unit: str
    source: str
    cells: list[tuple[str, str]]


def datasheet_rows(design: Design, sheet: Mapping[str, Any]) -> list[Row]:
    """The datasheet by depth."""
    circle_of_confusion = 1000 * circle_of_confusion_of(design, None)

    def violation(key: str, i: int, value: float | None) -> str:
        if value is None:
            return ""
        if key == "blur_um" and value > circle_of_confusion:
            return f"out of focus: more than the circle of confusion, {circle_of_confusion:.3g} um"
        if key == "rms_width_um" and sheet["spot_width_um"][i] > _FAR * sheet["lateral_resolution_um"][i]:
            return "2.355 times it, as of a Gaussian, is more than twice the prediction of Eq. 5"
        if key == "occupancy" and value > 1:
            return "sub-images of an object that fills the field overlap"
        return ""

    def text(key: str, value: float | None) -> str:
        is_poor = key == "strehl_on_axis" and value is not None and value < _MIN_STREHL
        return f"< {_MIN_STREHL:g}" if is_poor else _number(value)

    return [
        Row(*titles, [(text(key, value), violation(key, i, value)) for i, value in enumerate(sheet[key])])
        for key, titles in _ROWS.items()
    ]


def _number(value: float | None) -> str:
    return "infinite" if value is None else f"{value:.4g}"


def device_rows(design: Design, sheet: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of the main properties of the microscope."""
    sensor, lens, array, imaging = design.sensor, design.lens, design.array, design.imaging
    rows, columns = sensor.shape
    height, width = (f"{n * sensor.pixel_pitch_um / 1000:.4g}" for n in sensor.shape)
    shape = f"radius {span_of(lens.radius_of_curvature_mm)} mm, index {design.refractive_index:g}"
    if lens.focal_length_mm is not None:
        shape = "ideal, thin"
    conic = f", conic constant {span_of(lens.conic_constant)}" if lens.conic_constant else ""
    terms = f", {len(lens.aspheric_terms)} aspheric terms" if lens.aspheric_terms else ""
    return [
        ("lenses", f"{len(array.centers_mm)} on {array.size_mm[0]:g} x {array.size_mm[1]:g} mm"),
        ("a lens", f"{shape}{conic}{terms}, {span_of(lens.aperture_diameter_mm)} mm wide"),
        ("faces the object", f"the lenses' {lens.orientation} side"),
        ("focal length", f"{_number(sheet['focal_length_mm'])} mm"),
        ("F-number, NA", f"{_number(sheet['f_number'])}, {_number(sheet['numerical_aperture'])}"),
        ("pitch", f"{_number(sheet['pitch_mm'])} mm (SD {_number(sheet['pitch_sd_mm'])} mm)"),
        ("plate", f"{array.substrate_thickness_mm:g} mm thick, {100 * sheet['coverage']:.1f} % covered by lenses"),
        ("sensor", f"{rows} x {columns} pixels of {sensor.pixel_pitch_um:g} um: {height} x {width} mm"),
        ("sensor distance", f"{imaging.sensor_distance_mm:g} mm"),
        *_path_rows(design),
        ("objects at", f"{imaging.working_distance_mm[0]:g} to {imaging.working_distance_mm[1]:g} mm"),
        ("light", f"{imaging.wavelength_nm:g} nm"),
        ("field radius", f"{imaging.field_radius_mm:g} mm"),
    ]


def _path_rows(design: Design) -> list[tuple[str, str]]:
    layers, sample = design.layers, default_sample(design)
    sides = {"on the array": layers.object, "before the object": sample.layers, "on the sensor": layers.sensor}

    def words(layer):
        if layer.refractive_index in (1, "air"):
            return f"{layer.name or 'air'}, {layer.thickness_mm:g} mm"
        return f"{layer.name or 'layer'}, {layer.thickness_mm:g} mm, n = {layer.refractive_index}"

    rows = [(side, "; ".join(map(words, parts))) for side, parts in sides.items() if parts]
    medium = "air" if sample == NO_SAMPLE else f"n = {sample.refractive_index} from {object_begins(design):g} mm"
    return [*rows, ("objects in", medium)]


def calibration_rows(design: Design) -> list[tuple[str, str, str]]:
    """Names, values and standard deviations from `gs-jax calibrate`; empty for a design without calibration."""
    values, deviations = (design.provenance.get(key, {}) for key in ("calibrated_values", "standard_deviations"))
    if not isinstance(values, dict) or not isinstance(deviations, dict):
        return []
    return [(str(name), f"{value}", f"{deviations.get(name, '')}") for name, value in values.items()]


def calibration_summary(design: Design) -> str:
    """The fit of the calibration in a line; empty for a design without calibration."""
    found = design.provenance
    if "calibrated_spots" not in found:
        return ""
    spots = f"{found['calibrated_spots']} spots of {found.get('calibrated_captures', '?')} captures"
    mirrored = ", mirrored" if found.get("mirrored") else ""
    return f"{spots}, {found.get('calibrated_rms_pixels', '?')} pixels RMS{mirrored}."


def read_tolerance(path: PathLike) -> dict[str, Any]:
    """Reads the JSON of `gs-jax tolerance -o`; `InputError` for other contents."""
    try:
        found = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {str(error):.200}.") from error
    for key in ("depth_mm", "over_depths", "drawn", "nominal", "targets", "yield"):
        if not isinstance(found, dict) or key not in found:
            raise InputError(f"{path}: must be what `gs-jax tolerance -o` writes, got no {key!r}.")
    return found


class ToleranceTable(NamedTuple):
    """The yield as a sentence, a row per tolerance, and spot widths by depth for a chart."""

    summary: str
    rows: list[tuple[str, ...]]
    widths: dict[str, tuple[list[float], list[float]]]


def tolerance_table(found: Mapping[str, Any]) -> ToleranceTable:
    """Tabulates the JSON of `gs-jax tolerance`; `InputError` for other contents."""
    try:
        cells = lambda each: tuple("-" if x is None else f"{x:.3g}" for x in each.values())
        without = found.get("yield_without", {})
        rows = [
            (name, *cells(each), f"{100 * without[name]:.3g}" if name in without else "")
            for name, each in found["over_depths"].items()
        ]
        devices, depths = found["drawn"], found["depth_mm"]
        summary = f"{100 * found['yield']:.3g} % of {devices['devices']} devices keep all targets."
        names = {"p50": "devices, median", "p5": "5 %", "p95": "95 %"}
        widths = {
            "as designed": (depths, found["nominal"]["spot_width_um"]),
            **{name: (depths, devices["spot_width_um"][key]) for key, name in names.items()},
            "target": (depths, found["targets"]["max_width_um"]),
        }
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"`tolerance` must be what `gs-jax tolerance -o` writes, got {error!r:.80}.") from error
    return ToleranceTable(summary, rows, widths)


# An absolute path, with its last part as the group.
_ABSOLUTE = re.compile(r"""(?<![^\s='"(\[,])(?:file://)?(?:[A-Za-z]:)?[\\/](?:[^\s'"=,]*[\\/])?([^\s'"\\/=,]+)""")


def strip_folders(text: str) -> str:
    """Replaces absolute paths in a text, or in a command of `gs-jax`, by the names of the files."""
    try:
        words = shlex.split(text) if text.startswith("gs-jax ") else []
    except ValueError:
        words = []
    return _ABSOLUTE.sub(r"\1", shlex.join(map(_strip_folder, words)) if words else text)


def _strip_folder(word: str) -> str:
    option, equals, value = word.partition("=")
    if option.startswith("-") and equals:
        return f"{option}={_strip_folder(value)}"
    return re.split(r"[\\/]", word.rstrip("\\/"))[-1] if re.match(r"(?:[A-Za-z]:)?[\\/]", word) else word


def provenance_rows(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values without folders, and without the design, a text of many lines."""
    text = lambda value: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return [(str(key), strip_folders(text(value))) for key, value in provenance.items() if key != "design"]


def versions() -> list[tuple[str, str]]:
    """Versions of the software that wrote the page."""
    found = describe()
    return [(name, found[name]) for name in ("gs-jax", "python", "jax", "system")]


# Bytes of all slices before compression.
SLICE_BYTES = 6_000_000
# Pixels along a projection; voxels in space, in all and along a side; points in space; pixels along a capture.
_MAX_PIXELS, _MAX_VOXELS, _MAX_SIDE, _MAX_POINTS, _MAX_CAPTURE = 720, 60_000, 200, 5000, 900


class Projection(NamedTuple):
    """A picture of maxima, its width and height, mm."""

    picture: str
    width: float
    height: float


def make_projections(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> list[Projection]:
    """Maxima along z, y and x, `[y, x]`, `[z, x]` and `[y, z]`, with the range of those along z."""
    z = np.asarray(grid.depths, float)
    order = np.argsort(z)
    width, height = grid.shape[1] * grid.pitch, grid.shape[0] * grid.pitch
    depth = float(np.ptp(z)) * (1 + 1 / max(len(z) - 1, 1)) or grid.pitch
    views = (
        (volume.max(0), width, height),
        (_resample_depths(volume.max(1)[order], z[order]), width, depth),
        (_resample_depths(volume.max(2)[order], z[order]).T, depth, height),
    )
    projections, shown = [], display_range(views[0][0])
    for image, across, down in views:
        small = block_maxima(image, [-(-n // _MAX_PIXELS) for n in image.shape])
        projections.append(Projection(png_uri(shade(small, *shown), "magma"), across, down))
    return projections


def _resample_depths(image: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Rows at even depths, by nearest neighbour, from rows at uneven depths."""
    if len(depths) < 3 or np.allclose(np.diff(depths), depths[1] - depths[0], rtol=1e-3):
        return image
    count = min(int(np.ceil(np.ptp(depths) / np.diff(depths).min())) + 1, 400)
    even = np.linspace(depths[0], depths[-1], count)
    return image[np.abs(even[:, None] - depths[None]).argmin(1)]


def voxel_view(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> dict[str, Any]:
    """The brightest voxels for the browser: indices of voxels, and brightness from 1 to 255."""
    step = [-(-n // _MAX_SIDE) for n in volume.shape]
    values = shade(block_maxima(volume, step), *display_range(volume))
    flat = values.ravel()
    floor = max(1, int(np.partition(flat, -_MAX_VOXELS)[-_MAX_VOXELS])) if flat.size > _MAX_VOXELS else 1
    kept = np.flatnonzero(flat >= floor)
    if len(kept) > _MAX_VOXELS:
        # Of the voxels at the floor, an even selection.
        brighter, at_floor = kept[flat[kept] > floor], kept[flat[kept] == floor]
        chosen = np.linspace(0, len(at_floor) - 1, _MAX_VOXELS - len(brighter)).round().astype(int)
        kept = np.sort(np.concatenate([brighter, at_floor[chosen]]))
    z, y, x = np.unravel_index(kept, values.shape)
    middles = np.minimum(np.arange(values.shape[0]) * step[0] + (step[0] - 1) // 2, len(grid.depths) - 1)
    left, _, _, top = grid.extent
    pitch_x, pitch_y = grid.pitch * step[2], grid.pitch * step[1]
    return {
        "kind": "cloud",
        "count": len(kept),
        "voxels": to_base64(np.column_stack([x, y, z, flat[kept]]).astype(np.uint8)),
        "pitch": [pitch_x, pitch_y],
        "first": [left + pitch_x / 2, top + pitch_y / 2],
        "depths": np.asarray(grid.depths, float)[middles].tolist(),
        "box": _box(grid),
    }


def _box(grid: Grid) -> list[list[float]]:
    left, right, bottom, top = grid.extent
    z = np.asarray(grid.depths, float)
    return [[left, top, float(z.min())], [right, bottom, float(z.max())]]


def point_view(points: Float[np.ndarray, "point 4"], grid: Grid | None) -> dict[str, Any]:
    """The brightest points for the browser."""
    kept = points[np.argsort(-points[:, 3], kind="stable")[:_MAX_POINTS], :3]
    box = _box(grid) if grid is not None else [kept.min(0).tolist(), kept.max(0).tolist()]
    return {"kind": "points", "count": len(kept), "places": to_base64(kept.astype(np.float32)), "box": box}


def mold_view(array: MicrolensArray) -> dict[str, Any]:
    """The mold for the browser."""
    mesh = preview_solid(Part(array), MoldShape()).to_mesh64()
    return mesh_view(mesh.vert_properties[:, :3], mesh.tri_verts)


def mesh_view(vertices: np.ndarray, facets: np.ndarray) -> dict[str, Any]:
    """A mesh for the browser: vertices as fractions of its box, and facets."""
    low, high = vertices.min(0).astype(float), vertices.max(0).astype(float)
    fractions = np.round((vertices - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return {
        "kind": "mesh",
        "count": len(facets),
        "corners": to_base64(fractions),
        "facets": to_base64(facets.astype(np.uint32)),
        "box": [low.tolist(), high.tolist()],
    }


def capture_view(image: Num[np.ndarray, "row column"]) -> dict[str, Any]:
    """Pictures of the whole, each pixel a mean of `step` x `step`, and of 500 x 500 pixels in the middle."""
    low, high = (float(v) for v in np.percentile(image, (0.5, 99.8)))
    middle = image[tuple(slice(max(n // 2 - 250, 0), n // 2 + 250) for n in image.shape)]
    whole, crop = (png_uri(to_uint8(part, low, high)) for part in (downsample(image, _MAX_CAPTURE), middle))
    return {"whole": whole, "middle": crop, "step": -(-max(image.shape) // _MAX_CAPTURE), "shape": image.shape}
