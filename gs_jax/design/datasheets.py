"""What a design promises, Eqs. 1-11 over its working distance, as numbers and as tables."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.table import Table

from .. import objectives
from ..base.errors import InputError, short_repr
from ..geometry import Imager
from ..layouts import check_positive, nearest_neighbour_distances
from ..objectives.conditions import Conditions, by_type, per_type
from ..objectives.quantities import third_order_wavefront
from ..optics import aberrations, theory
from ..optics.apertures import voronoi_cells
from ..optics.pupil import emission_lines
from ..optics.raytrace import to_numpy
from .design import Design

# Sizes of a point's image in the object, on a lens's axis and over its field.
SIZES = ("fwhm_um", "rms_width_um", "half_light_radius_um", "spot_radius_um")
# Depths of a datasheet whose caller names none.
_DEPTHS = 7


def parts_of(
    design: Design, depths: Sequence[float] | np.ndarray, *, circle_of_confusion: float | None = None
) -> list[tuple[Imager, Conditions]]:
    """The lenses of each type of a design, in the order of their first lenses, and their conditions.

    `depths` and the circle of confusion are in mm; the latter is two pixels by default.
    """
    imager = design.imager()
    cells = voronoi_cells(np.array(design.array.centers_mm), design.array.size_mm) if imager.array.alike else None
    at = Conditions(depths, circle_of_confusion_of(design, circle_of_confusion), cells=cells)
    # Computed once for the ten quantities that follow from it.
    return [
        (one, dataclasses.replace(own, clear_diameter=objectives.clear_diameter(one, own)))
        for one, own in per_type(imager, at)
    ]


def datasheet(
    design: Design, depths: Sequence[float] | None = None, *, circle_of_confusion: float | None = None
) -> dict[str, Any]:
    """The metrics of a design as numbers for a JSON file, with units in the names.

    Parameters
    ----------
    design
        The microscope. Its clear diameter is that of a disc as large as a lens's mean clear aperture: what the lenses'
        discs cover of the plate, by their number. If lenses differ, `kinds` holds spots of each type, and the lists
        are of the type with the narrowest spot at each depth (`sharpest_kind`, from 1); scalars are means of the
        lenses.
    depths
        From the plate, mm; by default seven over the working distance.
    circle_of_confusion
        Diameter of the circle of confusion on the sensor, mm; by default two pixels (paper, "Depth of field").

    Returns
    -------
    dict
        Lists with one entry a depth, and scalars. `None` stands for infinity. Of a point's image in the object,
        `fwhm_um` is the full width at half maximum on a lens's axis, `rms_width_um` and `half_light_radius_um` the RMS
        width along an axis and the radius of half of the light over the field, `spot_radius_um` that of 80 % of the
        rays, and `spot_width_um` 2.355 times the RMS width.

    Raises
    ------
    InputError
        If a depth or the circle_of_confusion is not positive and finite, or there is no depth.
    """
    depths, imager, centers = _checked(design, depths), design.imager(), np.array(design.array.centers_mm)
    parts = parts_of(design, depths, circle_of_confusion=circle_of_confusion)
    distances = nearest_neighbour_distances(centers)
    columns = [{name: np.asarray(column) for name, column in columns_of(*part).items()} for part in parts]
    numbers = [jax.device_get(_numbers_of_lens(*part)) for part in parts]
    best = np.argmin([column["spot_width_um"] for column in columns], 0)
    shown = {name: [float(columns[k][name][i]) for i, k in enumerate(best)] for name in columns[0]}
    for name in ("lenses_per_point", "occupancy"):
        shown[name] = np.sum([column[name] for column in columns], 0).tolist()
    lenses = [_count(*part) for part in parts]
    mean = lambda values: six_digits(float(np.average(values, weights=lenses)))
    return {
        "depth_mm": depths,
        **{name: [six_digits(value) for value in values] for name, values in shown.items()},
        **{name: mean([float(own[name]) for own in numbers]) for name in ("f_number", "numerical_aperture")},
        "focal_length_mm": mean([float(own["focal_length_mm"]) for own in numbers]),
        "pitch_mm": six_digits(float(distances.mean())),
        "pitch_sd_mm": six_digits(float(distances.std())) if len(centers) > 1 else 0.0,
        "field_radius_mm": design.imaging.field_radius_mm,
        **_light_path(imager),
        **_over_the_band(imager, depths[len(depths) // 2]),
        "coverage": six_digits(sum(float(objectives.coverage(*part)) for part in parts)),
        **({"sharpest_kind": (best + 1).tolist(), "kinds": _types(parts, numbers, columns)} if len(parts) > 1 else {}),
    }


def _light_path(imager: Imager) -> dict[str, Any]:
    """Layers and sample: thicknesses, what they are of air, and by how much they move the depth in focus."""
    found: dict[str, Any] = {}
    imager = to_numpy(imager)
    for side, layers in (("object", imager.filters), ("sensor", imager.windows)):
        if layers is not None:
            thickness = float(layers.total)
            found |= {
                f"{side}_layers_mm": six_digits(thickness),
                f"{side}_layers_reduced_mm": six_digits(thickness - float(layers.shortening)),
            }
    if imager.sample is not None:
        found["sample_index"] = six_digits(float(imager.sample.refractive_index))
        found["sample_surface_mm"] = six_digits(float(imager.sample_surface))
    if found and imager.array.alike:
        air = dataclasses.replace(imager, filters=None, windows=None, sample=None)
        shift = _depth_in_focus(imager) - _depth_in_focus(air)
        found["focus_shift_mm"] = six_digits(shift)
    return found


def _over_the_band(imager: Imager, depth: float) -> dict[str, Any]:
    """Focus and width of the spot at each wavelength of the emission band, at a depth, by the sharpest lens type."""
    if imager.band is None:
        return {}
    at, each = Conditions([depth]), [one for _, one in emission_lines(imager)]
    widths = [[float(objectives.rms_width(*part)[0]) for part in per_type(one, at)] for one in each]
    best = int(np.argmin(np.mean(widths, 0)))
    focus = [float(objectives.focus_distance(*per_type(one, at)[best])[0]) for one in each]
    width = [1000 * row[best] for row in widths]
    return {
        "band_nm": [six_digits(1e6 * float(one.wavelength)) for one in each],
        "band_depth_mm": six_digits(depth),
        "band_focus_distance_mm": [six_digits(value) for value in focus],
        "band_rms_width_um": [six_digits(value) for value in width],
        "band_spot_width_um": [six_digits(theory.FWHM * value) for value in width],
    }


def band_in_words(sheet: dict[str, Any]) -> str:
    """The emission band of a datasheet in one line; empty without one."""
    if "band_nm" not in sheet:
        return ""
    focus, width = sheet["band_focus_distance_mm"], sheet["band_rms_width_um"]
    moved = "" if None in focus else f"the image moves by {1000 * (max(focus) - min(focus)):.3g} um and "
    ends = f"{min(sheet['band_nm']):.4g} to {max(sheet['band_nm']):.4g} nm"
    return f"from {ends}, {moved}RMS widths are {_plain(min(width))} to {_plain(max(width))} um in the object"


def _depth_in_focus(imager: Imager) -> float:
    focal_length, v = imager.array.focal_length, imager.reduced_sensor_distance
    return float(imager.depth_of(theory.depth_in_focus(focal_length, v))) if v > focal_length else math.inf


def path_in_words(sheet: dict[str, Any]) -> str:
    """Layers and sample of a datasheet in one line; empty without any."""
    words = [
        f"{_plain(sheet[f'{side}_layers_mm'])} mm of layers {where} are {_plain(sheet[f'{side}_layers_reduced_mm'])} "
        "mm of air"
        for side, where in (("object", "before the array"), ("sensor", "before the sensor"))
        if f"{side}_layers_mm" in sheet
    ]
    if "sample_index" in sheet:
        words.append(f"objects in n = {_plain(sheet['sample_index'])} from {_plain(sheet['sample_surface_mm'])} mm")
    if sheet.get("focus_shift_mm") is not None:
        words.append(f"together they move the depth in focus by {sheet['focus_shift_mm']:+.3g} mm")
    return "; ".join(words)


def _count(imager: Imager, at: Conditions) -> int:
    return len(imager.array.centers) if at.lenses is None else int(np.sum(at.lenses))


def _types(parts, numbers: Sequence[dict[str, Array]], columns: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    names = "radius_of_curvature_mm", "aperture_diameter_mm", "conic_constant", "focal_length_mm", "clear_diameter_mm"
    return [
        {"lenses": _count(*part)}
        | {name: six_digits(float(own[name])) for name in names}
        | {name: [six_digits(float(x)) for x in column[name]] for name in ("spot_width_um", *SIZES)}
        for part, own, column in zip(parts, numbers, columns, strict=True)
    ]


def columns_of(imager: Imager, at: Conditions) -> dict[str, Array]:
    """The columns of a datasheet by name, for lenses that are alike; may be traced."""
    columns = _columns_of_array(imager, at) | _columns_of_lenses(imager, at)
    # JAX sorts the keys of dictionaries.
    return {name: columns[name] for name in _NAMES}


_NAMES = (
    "magnification",
    "scale",
    "lenses_per_point",
    "occupancy",
    "lateral_resolution_um",
    "axial_resolution_um",
    "depth_of_field_mm",
    "near_limit_mm",
    "far_limit_mm",
    "strehl_on_axis",
    "focus_distance_mm",
    "blur_um",
    *SIZES,
    "spot_width_um",
)


@eqx.filter_jit
def _columns_of_array(imager: Imager, at: Conditions) -> dict[str, Array]:
    magnification = imager.magnification(at.depths)
    return {
        "magnification": magnification,
        "scale": 1 + magnification,
        "lenses_per_point": jnp.broadcast_to(objectives.lenses_per_point(imager, at), at.depths.shape),
        "occupancy": objectives.occupancy(imager, at),
    }


@by_type
def _columns_of_lenses(imager: Imager, at: Conditions) -> dict[str, Array]:
    wavefront = third_order_wavefront(imager, at, jnp.zeros(1, at.depths.dtype))
    width = objectives.rms_width(imager, at)
    return {
        "lateral_resolution_um": objectives.lateral_resolution(imager, at) * 1000,
        "axial_resolution_um": objectives.axial_resolution(imager, at) * 1000,
        "depth_of_field_mm": objectives.depth_of_field(imager, at),
        "near_limit_mm": objectives.near_limit(imager, at),
        "far_limit_mm": objectives.far_limit(imager, at),
        "strehl_on_axis": aberrations.strehl(aberrations.linear_rms(wavefront)[:, 0], imager.wavelength),
        "focus_distance_mm": objectives.focus_distance(imager, at),
        "blur_um": objectives.sensor_blur(imager, at) * 1000,
        "fwhm_um": objectives.fwhm(imager, at) * 1000,
        "rms_width_um": width * 1000,
        "half_light_radius_um": objectives.half_light_radius(imager, at) * 1000,
        "spot_radius_um": objectives.encircled_radius(imager, at) * 1000,
        "spot_width_um": theory.FWHM * width * 1000,
    }


@by_type
def _numbers_of_lens(imager: Imager, at: Conditions) -> dict[str, Array]:
    array = imager.array
    return {
        "radius_of_curvature_mm": array.radius_of_curvature,
        "aperture_diameter_mm": array.aperture_diameter,
        "conic_constant": array.conic_constant,
        "focal_length_mm": array.focal_length,
        "clear_diameter_mm": objectives.clear_diameter(imager, at),
        "f_number": objectives.f_number(imager, at),
        "numerical_aperture": objectives.numerical_aperture(imager, at),
    }


def tables(sheet: dict[str, Any]) -> list[Table]:
    """A datasheet to read: an image in focus, how far out of focus it is, and what to expect. All fit 80 columns."""
    cells = lambda columns: zip(*([_cell(key, value) for value in sheet[key]] for key in columns), strict=True)
    made = [text_table(title, columns.values(), cells(columns)) for title, columns in _TABLES.items()]
    return made + ([_table_of_types(sheet)] if len(sheet.get("kinds", ())) in range(2, _COLUMNS + 1) else [])


def summary(design: Design, sheet: dict[str, Any]) -> str:
    """The lens and the array in one line."""
    return (
        f"{design.name}: f = {_plain(sheet['focal_length_mm'])} mm, F/{_plain(sheet['f_number'])}, "
        f"NA {_plain(sheet['numerical_aperture'])}, pitch {_plain(sheet['pitch_mm'])} mm "
        f"(SD {_plain(sheet['pitch_sd_mm'])} mm), field radius {_plain(sheet['field_radius_mm'])} mm, "
        f"{100 * sheet['coverage']:.1f} % of the plate covered{_types_in_words(sheet)}"
    )


def overview(design: Design, sheet: dict[str, Any], *, circle_of_confusion: float | None = None) -> list[str]:
    """The light's path, the emission band, and over the depths a point's image, focus and overlap, a line each."""
    ends = lambda key: _ends(value for value in sheet[key] if value is not None)
    depths, limit = sheet["depth_mm"], 1000 * circle_of_confusion_of(design, circle_of_confusion)
    blurred = sum(blur > limit for blur in sheet["blur_um"])
    return [
        *filter(None, (path_in_words(sheet), band_in_words(sheet))),
        f"a point at {_ends(depths)} mm, seen in the object: FWHM {ends('fwhm_um')} um on the axis, half of the light "
        f"within {ends('half_light_radius_um')} um, RMS width {ends('rms_width_um')} um; Eq. 5 promises "
        f"{ends('lateral_resolution_um')} um, Eq. 6 {ends('axial_resolution_um')} um along z",
        f"{blurred} of {len(depths)} depths out of focus (blur above {_plain(limit)} um); "
        f"{ends('lenses_per_point')} lenses see a point; occupancy {ends('occupancy')}",
    ]


def _ends(values: Iterable[float]) -> str:
    values = list(values)
    low, high = (f"{end:.3g}" for end in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _types_in_words(sheet: dict[str, Any]) -> str:
    if not (types := sheet.get("kinds")):
        return ""
    focal = [one["focal_length_mm"] for one in types]
    ends = f"f = {_plain(min(focal))} to {_plain(max(focal))} mm"
    return f"; {len(types)} types of lenses, {ends}: means above, the sharpest type at each depth below"


_TABLES = {
    "In focus, without aberrations (Eqs. 1-8, 11)": {
        "depth_mm": "depth\nmm",
        "magnification": "magnifi-\ncation",
        "scale": "scale",
        "lateral_resolution_um": "lateral\nresol. um",
        "axial_resolution_um": "axial\nresol. um",
        "lenses_per_point": "lenses\na point",
        "occupancy": "occu-\npancy",
    },
    "Focus: depth of field of a sensor at the image; blur and Strehl ratio of the sensor where it is (Eqs. 7-10)": {
        "depth_mm": "depth\nmm",
        "focus_distance_mm": "image at\nmm",
        "depth_of_field_mm": "depth of\nfield mm",
        "near_limit_mm": "near\nmm",
        "far_limit_mm": "far\nmm",
        "blur_um": "blur\num",
        "strehl_on_axis": "Strehl\nratio",
    },
    "Image of a point (PSF), seen in the object: width of its core, and of all its light, um": {
        "depth_mm": "depth\nmm",
        "fwhm_um": "FWHM on\nthe axis",
        "rms_width_um": "RMS\nwidth",
        "half_light_radius_um": "half-light\nradius",
        "spot_radius_um": "radius of\n80 %",
    },
}
# Types that a table has room for.
_COLUMNS = 6
# Below it a Strehl ratio only says that diffraction does not limit the image.
_LEAST_STREHL = 0.01


def text_table(title: str, heads: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    """A table for the terminal, flush right but for the column "tolerance" and the one without a head."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for head in heads:
        table.add_column(head, justify="left" if head in ("tolerance", "") else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _table_of_types(sheet: dict[str, Any]) -> Table:
    heads = [f"{one['lenses']} of f =\n{_plain(one['focal_length_mm'])} mm" for one in sheet["kinds"]]
    columns = [map(_plain, sheet["depth_mm"]), *(map(_plain, one["rms_width_um"]) for one in sheet["kinds"])]
    title = "RMS width of a point's image by each type of lens: in the object, um"
    return text_table(title, ["depth\nmm", *heads], zip(*columns, strict=True))


def _cell(key: str, value: float | None) -> str:
    is_low = key == "strehl_on_axis" and value is not None and value < _LEAST_STREHL
    return f"< {_LEAST_STREHL:g}" if is_low else _plain(value)


def _plain(value: float | None) -> str:
    return "inf" if value is None else f"{value:.4g}"


def six_digits(value: float) -> float | None:
    """Six digits, more than any of the formulas is worth; None stands for what is not finite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _checked(design: Design, depths: Sequence[float] | None) -> list[float]:
    if depths is None:
        return np.linspace(*design.imaging.working_distance_mm, _DEPTHS).tolist()
    found = [float(depth) for depth in depths]
    if not found or not all(0 < depth < math.inf for depth in found):
        raise InputError(f"`depths` must be one or more positive lengths, mm, got {short_repr(found)}.")
    return found


def circle_of_confusion_of(design: Design, circle_of_confusion: float | None) -> float:
    """The circle of confusion asked for, by default two pixels, mm; `InputError` unless positive and finite."""
    if circle_of_confusion is None:
        return 2 * design.sensor.pixel_pitch_um / 1000
    check_positive("circle_of_confusion", circle_of_confusion)
    return circle_of_confusion
