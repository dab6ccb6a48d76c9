"""The datasheet of a design, Eqs. 1-11 over its working distance: numbers, tables, and violated assumptions."""

import dataclasses
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.table import Table

from .. import objectives
from ..base.errors import InputError, short_repr
from ..microscope.geometry import Imager
from ..microscope.layouts import check_positive, nearest_neighbour_distances
from ..objectives.conditions import Conditions, by_type, per_type
from ..objectives.quantities import third_order_wavefront
from ..optics import aberrations, theory
from ..optics.pupil import emission_lines
from ..optics.raytrace import to_numpy, trace_lenslet
from .design import Design

# Sizes of a point's image in the object, on a lens's axis and over its field; depths if the caller names none.
SIZES, _DEPTHS = ("fwhm_um", "rms_width_um", "half_light_radius_um", "spot_radius_um"), 7


def parts_of(
    design: Design, depths: Sequence[float] | np.ndarray, *, circle_of_confusion: float | None = None
) -> list[tuple[Imager, Conditions]]:
    """The lenses of each type of a design, in the order of their first lenses, and their conditions.

    `depths` and the circle of confusion are in mm; the latter is two pixels by default.
    """
    imager = design.imager()
    at = Conditions(depths, circle_of_confusion_of(design, circle_of_confusion))
    # Computed once for the ten quantities that follow from it.
    return [
        (lens_type, dataclasses.replace(own, clear_diameter=objectives.clear_diameter(lens_type, own)))
        for lens_type, own in per_type(imager, at)
    ]


def circle_of_confusion_of(design: Design, circle_of_confusion: float | None) -> float:
    """The circle of confusion asked for, by default two pixels, mm; `InputError` unless positive and finite."""
    if circle_of_confusion is None:
        return 2 * design.sensor.pixel_pitch_um / 1000
    check_positive("circle_of_confusion", circle_of_confusion)
    return circle_of_confusion


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
    default = np.linspace(*design.imaging.working_distance_mm, _DEPTHS)
    depths = [float(depth) for depth in (default if depths is None else depths)]
    if not depths or not all(0 < depth < math.inf for depth in depths):
        raise InputError(f"`depths` must be one or more positive lengths, mm, got {short_repr(depths)}.")
    parts, imager = parts_of(design, depths, circle_of_confusion=circle_of_confusion), design.imager()
    distances = nearest_neighbour_distances(np.array(design.array.centers_mm))
    columns = [{name: np.asarray(column) for name, column in columns_of(*part).items()} for part in parts]
    numbers = [jax.device_get(_numbers_of_lens(*part)) for part in parts]
    best = np.argmin([column["spot_width_um"] for column in columns], 0)
    shown = {name: [columns[k][name][i] for i, k in enumerate(best)] for name in columns[0]}
    shown |= {name: np.sum([column[name] for column in columns], 0) for name in ("lenses_per_point", "occupancy")}
    lenses = [len(lens.array.centers) if at.lenses is None else int(np.sum(at.lenses)) for lens, at in parts]
    scalars = ("f_number", "numerical_aperture", "focal_length_mm")
    sheet = {
        "depth_mm": depths,
        **shown,
        **{name: np.average([own[name] for own in numbers], weights=lenses) for name in scalars},
        "pitch_mm": distances.mean(),
        "pitch_sd_mm": distances.std() if len(distances) > 1 else 0.0,
        "field_radius_mm": design.imaging.field_radius_mm,
        **_light_path(imager),
        **_over_the_band(imager, depths[len(depths) // 2]),
        "coverage": sum(float(objectives.coverage(*part)) for part in parts),
    }
    if len(parts) > 1:
        spots = [{name: column[name] for name in ("spot_width_um", *SIZES)} for column in columns]
        kinds = [{"lenses": count, **own, **spot} for count, own, spot in zip(lenses, numbers, spots, strict=True)]
        sheet |= {"sharpest_kind": best + 1, "kinds": kinds}
    return _rounded(sheet) | {"depth_mm": depths, "field_radius_mm": design.imaging.field_radius_mm}


def six_digits(value: float) -> float | None:
    """Six digits, more than any of the formulas is worth; None stands for what is not finite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _rounded(value: Any) -> Any:
    """Numbers of dictionaries and lists as those of JSON, with six digits."""
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    if isinstance(value, list) or np.ndim(value):
        return [_rounded(inner) for inner in value]
    return int(value) if np.issubdtype(np.asarray(value).dtype, np.integer) else six_digits(float(value))


def _light_path(imager: Imager) -> dict[str, Any]:
    """Layers and sample: their thickness, the air that has their reduced one, and the shift of the depth in focus."""
    path: dict[str, Any] = {}
    imager = to_numpy(imager)
    for side, layers in (("object", imager.filters), ("sensor", imager.windows)):
        if layers is not None:
            path[f"{side}_layers_mm"] = layers.total
            path[f"{side}_layers_reduced_mm"] = layers.total - layers.shortening
    if imager.sample is not None:
        path |= {"sample_index": imager.sample.refractive_index, "sample_surface_mm": imager.sample_surface}
    if path and imager.array.alike:
        air = dataclasses.replace(imager, filters=None, windows=None, sample=None)
        path["focus_shift_mm"] = _depth_in_focus(imager) - _depth_in_focus(air)
    return path


def _depth_in_focus(imager: Imager) -> float:
    focal_length, v = imager.array.focal_length, imager.reduced_sensor_distance
    return float(imager.depth_of(theory.depth_in_focus(focal_length, v))) if v > focal_length else math.inf


def _over_the_band(imager: Imager, depth: float) -> dict[str, Any]:
    """Focus and width of the spot at each wavelength of the emission band, at a depth, by the sharpest lens type."""
    if imager.band is None:
        return {}
    at, lines = Conditions([depth]), [line for _, line in emission_lines(imager)]
    widths = np.array([[float(objectives.rms_width(*part)[0]) for part in per_type(line, at)] for line in lines])
    best = int(np.argmin(np.mean(widths, 0)))
    return {
        "band_nm": [1e6 * float(line.wavelength) for line in lines],
        "band_depth_mm": depth,
        "band_focus_distance_mm": [float(objectives.focus_distance(*per_type(line, at)[best])[0]) for line in lines],
        "band_rms_width_um": 1000 * widths[:, best],
        "band_spot_width_um": 1000 * theory.FWHM * widths[:, best],
    }


def columns_of(imager: Imager, at: Conditions) -> dict[str, Array]:
    """The columns of a datasheet by name, for lenses that are alike; may be traced."""
    return {**_columns_of_array(imager, at), **_columns_of_lenses(imager, at)}


# JAX sorts the keys of dictionaries, but not of `OrderedDict`.
@eqx.filter_jit
def _columns_of_array(imager: Imager, at: Conditions) -> OrderedDict[str, Array]:
    magnification = imager.magnification(at.depths)
    return OrderedDict(
        magnification=magnification,
        scale=1 + magnification,
        lenses_per_point=jnp.broadcast_to(objectives.lenses_per_point(imager, at), at.depths.shape),
        occupancy=objectives.occupancy(imager, at),
    )


@by_type
def _columns_of_lenses(imager: Imager, at: Conditions) -> OrderedDict[str, Array]:
    wavefront = third_order_wavefront(imager, at, jnp.zeros(1, at.depths.dtype))
    width = objectives.rms_width(imager, at)
    return OrderedDict(
        lateral_resolution_um=1000 * objectives.lateral_resolution(imager, at),
        axial_resolution_um=1000 * objectives.axial_resolution(imager, at),
        depth_of_field_mm=objectives.depth_of_field(imager, at),
        near_limit_mm=objectives.near_limit(imager, at),
        far_limit_mm=objectives.far_limit(imager, at),
        strehl_on_axis=aberrations.strehl(aberrations.linear_rms(wavefront)[:, 0], imager.wavelength),
        focus_distance_mm=objectives.focus_distance(imager, at),
        blur_um=1000 * objectives.sensor_blur(imager, at),
        fwhm_um=1000 * objectives.fwhm(imager, at),
        rms_width_um=1000 * width,
        half_light_radius_um=1000 * objectives.half_light_radius(imager, at),
        spot_radius_um=1000 * objectives.encircled_radius(imager, at),
        spot_width_um=1000 * theory.FWHM * width,
    )


@by_type
def _numbers_of_lens(imager: Imager, at: Conditions) -> OrderedDict[str, Array]:
    array = imager.array
    return OrderedDict(
        f_number=objectives.f_number(imager, at),
        numerical_aperture=objectives.numerical_aperture(imager, at),
        radius_of_curvature_mm=array.radius_of_curvature,
        aperture_diameter_mm=array.aperture_diameter,
        conic_constant=array.conic_constant,
        focal_length_mm=array.focal_length,
        clear_diameter_mm=objectives.clear_diameter(imager, at),
    )


def summary(design: Design, sheet: dict[str, Any]) -> str:
    """The lens and the array in one line."""
    types = ""
    if kinds := sheet.get("kinds"):
        ends = _ends([kind["focal_length_mm"] for kind in kinds], _plain)
        types = f"; {len(kinds)} types of lenses, f = {ends} mm: means above, the sharpest type at each depth below"
    return (
        f"{design.name}: f = {_plain(sheet['focal_length_mm'])} mm, F/{_plain(sheet['f_number'])}, "
        f"NA {_plain(sheet['numerical_aperture'])}, pitch {_plain(sheet['pitch_mm'])} mm "
        f"(SD {_plain(sheet['pitch_sd_mm'])} mm), field radius {_plain(sheet['field_radius_mm'])} mm, "
        f"{100 * sheet['coverage']:.1f} % of the plate covered{types}"
    )


def overview(design: Design, sheet: dict[str, Any], *, circle_of_confusion: float | None = None) -> list[str]:
    """The light's path, the emission band, and over the depths a point's image, focus and overlap, a line each."""

    def ends(key: str) -> str:
        return _ends([value for value in sheet[key] if value is not None], "{:.3g}".format)

    depths, limit = sheet["depth_mm"], 1000 * circle_of_confusion_of(design, circle_of_confusion)
    blurred = sum(blur > limit for blur in sheet["blur_um"])
    lines = [
        format_light_path(sheet),
        format_band(sheet),
        f"a point at {ends('depth_mm')} mm, seen in the object: FWHM {ends('fwhm_um')} um on the axis, half of the "
        f"light within {ends('half_light_radius_um')} um, RMS width {ends('rms_width_um')} um; Eq. 5 promises "
        f"{ends('lateral_resolution_um')} um, Eq. 6 {ends('axial_resolution_um')} um along z",
        f"{blurred} of {len(depths)} depths out of focus (blur above {_plain(limit)} um); "
        f"{ends('lenses_per_point')} lenses within the field radius of a point; occupancy {ends('occupancy')}",
    ]
    return [line for line in lines if line]


def format_light_path(sheet: dict[str, Any]) -> str:
    """Layers and sample of a datasheet in one line; empty without any."""
    parts = []
    for side, where in (("object", "before the array"), ("sensor", "before the sensor")):
        if thickness := sheet.get(f"{side}_layers_mm"):
            air = _plain(sheet[f"{side}_layers_reduced_mm"])
            parts.append(f"{_plain(thickness)} mm of layers {where} are {air} mm of air")
    if "sample_index" in sheet:
        parts.append(f"objects in n = {_plain(sheet['sample_index'])} from {_plain(sheet['sample_surface_mm'])} mm")
    if sheet.get("focus_shift_mm") is not None:
        parts.append(f"together they move the depth in focus by {sheet['focus_shift_mm']:+.3g} mm")
    return "; ".join(parts)


def format_band(sheet: dict[str, Any]) -> str:
    """The emission band of a datasheet in one line; empty without one."""
    if "band_nm" not in sheet:
        return ""
    focus, width = sheet["band_focus_distance_mm"], sheet["band_rms_width_um"]
    moved = "" if None in focus else f"the image moves by {1000 * (max(focus) - min(focus)):.3g} um and "
    ends = f"{min(sheet['band_nm']):.4g} to {max(sheet['band_nm']):.4g} nm"
    return f"from {ends}, {moved}RMS widths are {_plain(min(width))} to {_plain(max(width))} um in the object"


TABLES = {
    "In focus, without aberrations (Eqs. 1-8, 11)": {
        "magnification": "magnifi-\ncation",
        "scale": "scale",
        "lateral_resolution_um": "lateral\nresol. um",
        "axial_resolution_um": "axial\nresol. um",
        "lenses_per_point": "lenses\na point",
        "occupancy": "occu-\npancy",
    },
    "Focus: depth of field of a sensor at the image; blur and Strehl ratio of the sensor where it is (Eqs. 7-10)": {
        "focus_distance_mm": "image at\nmm",
        "depth_of_field_mm": "depth of\nfield mm",
        "near_limit_mm": "near\nmm",
        "far_limit_mm": "far\nmm",
        "blur_um": "blur\num",
        "strehl_on_axis": "Strehl\nratio",
    },
    "Image of a point (PSF), seen in the object: width of its core, and of all its light, um": {
        "fwhm_um": "FWHM on\nthe axis",
        "rms_width_um": "RMS\nwidth",
        "half_light_radius_um": "half-light\nradius",
        "spot_radius_um": "radius of\n80 %",
    },
}
# Types that a table has room for; Strehl ratio below which it only says that diffraction does not limit the image.
_MOST_TYPES, _LEAST_STREHL = 6, 0.01


def tables(sheet: dict[str, Any]) -> list[Table]:
    """A datasheet to read: an image in focus, how far out of focus it is, and what to expect. All fit 80 columns."""
    results = []
    for title, heads in TABLES.items():
        heads = {"depth_mm": "depth\nmm"} | heads
        columns = [[_plain(value) for value in sheet[key]] for key in heads]
        if "strehl_on_axis" in heads:
            low = f"< {_LEAST_STREHL:g}"
            columns[-1] = [low if x < _LEAST_STREHL else _plain(x) for x in sheet["strehl_on_axis"]]
        results.append(text_table(title, heads.values(), zip(*columns, strict=True)))
    kinds = sheet.get("kinds", ())
    if 2 <= len(kinds) <= _MOST_TYPES:
        heads = [f"{kind['lenses']} of f =\n{_plain(kind['focal_length_mm'])} mm" for kind in kinds]
        columns = [map(_plain, values) for values in (sheet["depth_mm"], *(kind["rms_width_um"] for kind in kinds))]
        title = "RMS width of a point's image by each type of lens: in the object, um"
        results.append(text_table(title, ["depth\nmm", *heads], zip(*columns, strict=True)))
    return results


def violations(design: Design, sheet: dict[str, Any]) -> dict[str, list[str]]:
    """By key of a datasheet, the assumption that the value at each depth violates, or an empty text."""
    limit = 1000 * circle_of_confusion_of(design, None)
    beyond = {
        "blur_um": (sheet["blur_um"], [limit], f"more than the circle of confusion, {_plain(limit)} um: out of focus"),
        "rms_width_um": (
            sheet["spot_width_um"],
            _FAR * np.array(sheet["lateral_resolution_um"]),
            "2.355 times it, as of a Gaussian, is more than twice the prediction of Eq. 5",
        ),
        "occupancy": (sheet["occupancy"], [1.0], "sub-images of an object that fills the field overlap"),
    }
    return {key: np.where(np.greater(values, most), why, "").tolist() for key, (values, most, why) in beyond.items()}


def text_table(title: str, heads: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    """A table for the terminal, flush right but for the column "tolerance" and the one without a head."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for head in heads:
        table.add_column(head, justify="left" if head in ("tolerance", "") else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _plain(value: float | None) -> str:
    return "inf" if value is None else f"{value:.4g}"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _ends(values: Any, text: Callable[[float], str] = _two_digits) -> str:
    """The least and the greatest value, or the only one."""
    low, high = text(float(min(values))), text(float(max(values)))
    return low if low == high else f"{low} to {high}"


def _length(mm: float) -> str:
    return f"{_two_digits(mm)} mm" if mm >= 1 else f"{_two_digits(mm * 1000)} um"


# Spots so many times wider than promised are remarked.
_FAR = 2.0
# Depths at which the brightest core is looked for, rays across the pupil, and how bright the others are at least.
_CORE_DEPTHS, _RAYS, _NEARLY = 300, 4000, 0.5
# Share of the plate without lenses that needs no mask; RMS wavefront error, in waves, below which Eq. 9 holds.
_LEAST_BETWEEN, _STREHL_DOMAIN = 0.005, 0.1


def findings(design: Design, sheet: dict[str, Any], *, circle_of_confusion: float | None = None) -> list[str]:
    """Violated assumptions of a design and its datasheet, in short sentences; arguments and errors as `datasheet`."""
    parts = parts_of(design, sheet["depth_mm"], circle_of_confusion=circle_of_confusion)
    remarks = [spots_remark(sheet), *_focus(design, sheet, parts, circle_of_confusion_of(design, circle_of_confusion))]
    if len(parts) == 1:  # each type has its own wavefront error
        remarks += _strehl(design, sheet, *parts[0])
    return [remark for remark in (*remarks, *lens_and_plate_remarks(design, sheet)) if remark]


def spots_remark(sheet: dict[str, Any]) -> str:
    """The spots by exact rays, where they are far wider than the formulas promise."""
    wide, promised = np.array(sheet["spot_width_um"]), np.array(sheet["lateral_resolution_um"])
    if not (wide > _FAR * promised).any():
        return ""
    core, half, rms = (_ends(sheet[f"{key}_um"]) for key in ("fwhm", "half_light_radius", "rms_width"))
    return (
        f"Eq. 5 promises {_ends(promised)} um. By diffraction a point's image is {core} um wide at half its height on "
        f"the axis; by exact rays half of its light is within a radius of {half} um, and the RMS width is {rms} um: "
        "light far outside the core is a background."
    )


def _focus(
    design: Design, sheet: dict[str, Any], parts: list[tuple[Imager, Conditions]], circle_of_confusion: float
) -> Iterator[str]:
    v, blurs = design.imaging.sensor_distance_mm, sheet["blur_um"]
    outside = [i for i, blur in enumerate(blurs) if blur > circle_of_confusion * 1000]
    if not outside:
        return
    for i in sorted({outside[0], outside[-1]}):
        depth, image, blur = sheet["depth_mm"][i], sheet["focus_distance_mm"][i], blurs[i] / 1000
        size = f"blur {_length(blur)} on the sensor, {_length(blur / sheet['magnification'][i])} in the object"
        where = "no real image forms"
        if image is not None:
            where = f"the image forms {_length(abs(image - v))} {'behind' if image > v else 'before'} the sensor"
        yield f"At {depth:g} mm {where}: {size}."
    limit = f"the circle of confusion, {_length(circle_of_confusion)}"
    yield f"{len(outside)} of {len(blurs)} depths are out of focus: blurred by more than {limit}."
    for imager, at in parts:
        for remark in filter(None, (_sharp_range(design, imager, at), _sharp_cores(imager, at))):
            of_type = f"Lenses of f = {float(imager.array.focal_length):.4g} mm: {remark[:1].lower()}{remark[1:]}"
            yield of_type if len(parts) > 1 else remark


def _sharp_range(design: Design, imager: Imager, at: Conditions) -> str:
    host = to_numpy(imager)
    v, f, start = design.imaging.sensor_distance_mm, float(host.array.focal_length), float(host.sample_surface)
    if host.reduced_sensor_distance <= f:
        return f"The sensor at {v:g} mm is not behind the focal plane at {f:.4g} mm: no depth is in focus."
    near, far = map(float, _limits(imager, at))
    working = "the working distance is {:g} to {:g} mm".format(*design.imaging.working_distance_mm)
    if far <= start:
        where = f"before {start:g} mm, where the object's medium begins," if start else "within the plate"
        return f"The sensor at {v:g} mm is so far that only points {where} are in focus; {working}."
    return f"In focus by Eqs. 7 and 8, of a thin lens, are {max(near, start):.4g} to {far:.4g} mm; {working}."


@eqx.filter_jit
def _limits(imager, at):
    """Nearest and farthest depth in focus."""
    in_focus = imager.depth_of(theory.depth_in_focus(imager.array.focal_length, imager.reduced_sensor_distance))
    focused = dataclasses.replace(at, depths=in_focus[None])
    return objectives.near_limit(imager, focused)[0], objectives.far_limit(imager, focused)[0]


def _sharp_cores(imager: Imager, at: Conditions) -> str:
    """The depths at which most light falls into a core three pixels wide, on the axis."""
    depths, within = map(np.asarray, _light_within(imager, at, 1.5 * imager.sensor.pixel_pitch))
    best = within.argmax()
    if best in (0, _CORE_DEPTHS - 1):
        return ""
    near, far = (float(depths[i]) for i in np.flatnonzero(within >= _NEARLY * within[best])[[0, -1]])
    near = max(near, float(imager.sample_surface))
    return f"By exact rays cores of spots hold half of the most light, or more, at {near:.3g} to {far:.3g} mm."


@eqx.filter_jit
def _light_within(imager, at, radius):
    """Depths, and of a point there on a lens's axis the light within a radius, by exact rays, relative."""
    depths = jnp.geomspace(at.depths[0] / 2, 2 * at.depths[-1], _CORE_DEPTHS)
    radii = jnp.asarray((np.arange(_RAYS) + 0.5) / _RAYS, depths.dtype) * objectives.clear_diameter(imager, at) / 2
    pupil = jnp.stack([radii, jnp.zeros_like(radii)], -1)
    rays = jax.vmap(lambda depth: trace_lenslet(imager, depth, pupil))(depths)
    return depths, jnp.sum(jnp.where(rays.valid & (jnp.abs(rays.landing[..., 0]) < radius), radii, 0), -1)


@eqx.filter_jit
def _wavefront(imager, at):
    """RMS error on the axis, waves; the field where the Strehl ratio halves, spherical aberration and balanced, mm."""
    error, pupil = third_order_wavefront(imager, at, jnp.zeros(1, at.depths.dtype)), at.clear_diameter / 2
    v, reduced = imager.reduced_sensor_distance, imager.reduced_depth(at.depths)
    half = aberrations.linear_field_radius(imager.array, pupil, reduced, v, imager.wavelength)
    waves = aberrations.linear_rms(error)[:, 0] / imager.wavelength
    return waves, half, error.spherical[0, 0], aberrations.balanced_rms(error).spherical[0, 0]


def _strehl(design: Design, sheet: dict[str, Any], imager: Imager, at: Conditions) -> Iterator[str]:
    waves, half, spherical, balanced = map(np.asarray, _wavefront(imager, at))
    if waves.max() <= _STREHL_DOMAIN:
        return
    yield (
        f"The wavefront error on the axis is {_ends(waves)} waves RMS, and Eq. 9 holds below about {_STREHL_DOMAIN}: "
        "the Strehl ratios only say that the image is far from diffraction-limited."
    )
    if design.lens.focal_length_mm is not None:  # an ideal lens: all of it is defocus
        return
    yield (
        f"By Eqs. 9 and 10 the Strehl ratio halves {_ends(1000 * half)} um beside the axis, "
        f"not at the field radius of {_length(sheet['field_radius_mm'])}."
    )
    paraxial = sheet["focus_distance_mm"][0]
    host, pupil = to_numpy(imager), float(objectives.clear_diameter(imager, at)) / 2
    if paraxial is not None and balanced > _STREHL_DOMAIN * host.wavelength:
        image = paraxial + float(host.reduced_sensor_distance - host.sensor_distance)
        sharpest = 1 / (1 / image + 2 * float(spherical) / pupil**2)
        yield (
            "Focus and blur are a thin lens's; spherical aberration draws the sharpest image of "
            f"{sheet['depth_mm'][0]:g} mm toward the lens, by up to {_length(image - sharpest)}."
        )


def lens_and_plate_remarks(design: Design, sheet: dict[str, Any]) -> Iterator[str]:
    """Remarks about pixels, pitch, overlap and the plate between the lenses."""
    aperture, f, pitch = sheet["numerical_aperture"], sheet["focal_length_mm"], sheet["pitch_mm"]
    pixel, spot = design.sensor.pixel_pitch_um, design.imaging.wavelength_nm / 2000 / aperture
    if spot < pixel:
        yield f"Pixels limit the lateral resolution: the diffraction spot is {spot:.2g} um, a pixel {pixel:g} um."
    if pitch is not None and abs(pitch / (2 * f * aperture) - 1) >= 0.05:
        yield (
            f"The numerical aperture of {aperture:.3f} is that of the clear diameter, {2 * f * aperture:.3g} mm; the "
            f"paper takes the pitch, {pitch:.3g} mm, for the diameter, which gives {pitch / (2 * f):.3f}."
        )
    worst = int(np.argmax(sheet["occupancy"]))
    depth, occupancy = sheet["depth_mm"][worst], sheet["occupancy"][worst]
    if occupancy > 1:
        yield f"At {depth:g} mm the occupancy is {occupancy:.2g}: sub-images of an object that fills the field overlap."
    if (between := 1 - sheet["coverage"]) >= _LEAST_BETWEEN:
        yield f"{100 * between:.1f} % of the plate is no lens's: an opaque mask must cover it (`gs-jax mask`)."
