"""A design whose numbers sliders move: datasheet, spots, ghosts, and a small simulated reconstruction. Lengths in mm.

Everything is compiled once, for any values of the sliders.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve

from .. import objectives
from ..base.errors import InputError
from ..codesign.parameters import candidate, depths_between, evaluated, start_values
from ..codesign.study import Study
from ..codesign.terms import SIGNS, TERMS, evaluate as evaluate_term
from ..design.conversion import object_begins
from ..design.datasheets import SIZES, circle_of_confusion_of, columns_of, lens_and_plate_remarks, spots_remark
from ..design.design import Design
from ..microscope.geometry import Imager, envelope
from ..microscope.grid import Grid, Sensor
from ..microscope.lenses import lenses_by_type
from ..objectives.conditions import Conditions, per_type
from ..optics.psf import least_samples, spot_image
from ..optics.raytrace import to_numpy
from ..simulation import random_points
from .device_model import lenses_that_see
from .drawings import plate_and_sensor

# Depths of the datasheet, and the indices of those at which spots are shown, at these shares of the field radius.
_DEPTHS, SPOT_DEPTHS, SPOT_FIELDS = 7, (0, 3, 6), (0.0, 1.0)
# Pixels along a side of a spot's window.
SIZE = 49
_LENS_KEYS = ("radius_of_curvature_mm", "aperture_diameter_mm")
# Cells across the map of ghosts, and its depths.
_CELLS, _GHOST_DEPTHS = 141, 9
# Pixels across the small sensor; planes, points and voxels across of the reconstruction.
_PIXELS, _PLANES, _POINTS, _VOXELS = 640, 5, 20, 181
# Columns of the datasheet that are shown, of the type with the narrowest spot at each depth.
_NUMBERS = (
    *("lateral_resolution_um", "axial_resolution_um", "spot_width_um", *SIZES),
    *("blur_um", "depth_of_field_mm", "strehl_on_axis"),
)

Values = dict[str, float]


class Slider(NamedTuple):
    """A number of the design that may move from `low` to `high`."""

    title: str
    low: float
    high: float
    start: float


class Start(NamedTuple):
    """The imager and the conditions from which the sliders of a design move."""

    imager: Imager
    at: Conditions

    @property
    def types(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the lenses of each type."""
        return lenses_by_type(self.imager.array)


def start_of(design: Design, study: Study | None = None) -> Start:
    """The design as the start of all moves, with the study's circle of confusion, exposure and detail."""
    scene = {} if study is None else study.scene
    scene |= {"circle_of_confusion": circle_of_confusion_of(design, scene.get("circle_of_confusion"))}
    return Start(*evaluated(design, depth_count=_DEPTHS, **scene))


def make_sliders(design: Design) -> dict[str, Slider]:
    """The sliders of a design. Of several lens types, a slider is the first type's; the others keep their ratio to it.

    An ideal lens has no curvature, a single lens no pitch.
    """
    lens, imaging, start = design.lens, design.imaging, start_of(design)
    of_type = f" of type 1 of {len(start.types)}, others in proportion" if len(start.types) > 1 else ""
    radius, aperture = (float(np.ravel(x)[0]) for x in (lens.radius_of_curvature_mm, lens.aperture_diameter_mm))
    near, far = imaging.working_distance_mm
    ranges = {
        "sensor_distance_mm": ("sensor distance v", 0.6, 1.5, imaging.sensor_distance_mm),
        "radius_of_curvature_mm": (f"radius of curvature R{of_type}", 0.5, 2.0, radius),
        "aperture_diameter_mm": (f"aperture D{of_type}", 0.15, 1.5, aperture),
        "pitch_mm": ("pitch", 0.6, 1.8, float(start_values(*start)["pitch_mm"])),
        "near_mm": ("nearest depth", 0.4, 1.6, near),
        "far_mm": ("farthest depth", 0.6, 2.0, far),
        "field_radius_mm": ("field radius", 0.3, 2.0, imaging.field_radius_mm),
    }
    if lens.focal_length_mm is not None:
        del ranges["radius_of_curvature_mm"]
    if len(design.array.centers_mm) < 2:
        del ranges["pitch_mm"]
    begins = object_begins(design)
    least = {
        "sensor_distance_mm": sum(layer.thickness_mm for layer in design.layers.sensor),
        "near_mm": begins,
        "far_mm": begins,
    }
    lowest = lambda name, low, at: min(max(low * at, least.get(name, 0.0)), at)
    return {n: Slider(title, lowest(n, low, at), high * at, at) for n, (title, low, high, at) in ranges.items()}


def complete_values(sliders: dict[str, Slider], values: Values) -> Values:
    """A value for every slider; those that are missing are at their start.

    Raises `InputError` if there is no such slider, a value is out of range, or the nearest depth is not below the
    farthest.
    """
    if unknown := [name for name in values if name not in sliders]:
        raise InputError(f"the sliders are {', '.join(sliders)}, got {unknown[0]!r}.")
    complete = {name: float(values.get(name, slider.start)) for name, slider in sliders.items()}
    for name, value in complete.items():
        title, low, high, _ = sliders[name]
        if not low * (1 - 1e-9) <= value <= high * (1 + 1e-9):
            raise InputError(f"{title} must be {low:.4g} to {high:.4g} mm, got {value:g} mm.")
    near, far = complete["near_mm"], complete["far_mm"]
    if not near < far:
        raise InputError(f"nearest depth must be below the farthest, {far:g} mm, got {near:g} mm.")
    return complete


def live_terms(study: Study | None) -> tuple[str, ...]:
    """Names of the study's terms that are evaluated at each move; random terms are left out."""
    names = () if study is None else tuple(table.name for table in study.terms)
    return tuple(name for name in names if not TERMS[name].random)


class Evaluation(NamedTuple):
    """Numbers of a design at `depths`, scalars, and terms of a study.

    Of several lens types, `numbers` and `spots` are those of the type with the narrowest spot at each depth, and
    scalars are means over the lenses. `clear_diameters` has an entry per type. The sum of a spot is the share of the
    light through the lens that falls into its window.
    """

    depths: Float[np.ndarray, " depth"]
    numbers: dict[str, Float[np.ndarray, " depth"]]
    scalars: dict[str, Float[np.ndarray, ""]]
    terms: dict[str, Float[np.ndarray, " _"]]
    clear_diameters: Float[np.ndarray, " type"]
    spots: Float[np.ndarray, "depth field row column"]


def evaluate_design(start: Start, values: Values, terms: tuple[str, ...] = ()) -> Evaluation:
    """Evaluate the design of these values, which `complete_values` has checked."""
    traced = {name: jnp.asarray(value) for name, value in values.items()}
    results, sharpest = _evaluate(start, traced, terms)
    depths, numbers, scalars, entries, diameters = jax.tree.map(lambda x: np.asarray(x, np.float64), results)
    units, samples = [lens_unit(start, values, number) for number in range(len(diameters))], pupil_samples(start)
    spots = np.empty((len(SPOT_DEPTHS), len(SPOT_FIELDS), SIZE, SIZE))
    for row, column in np.ndindex(spots.shape[:2]):
        number, height = int(sharpest[SPOT_DEPTHS[row]]), SPOT_FIELDS[column] * values["field_radius_mm"]
        depth, radius = depths[SPOT_DEPTHS[row]], diameters[number] / 2
        spots[row, column] = spot_image(units[number], depth, height, size=SIZE, radius=radius, samples=samples)
    return Evaluation(depths, numbers, scalars, entries, diameters, spots)


@eqx.filter_jit
def _evaluate(start: Start, values: dict[str, Array], terms: tuple[str, ...]):
    imager, at = _moved(start, values)
    by_type = per_type(imager, at)
    columns = [columns_of(*lens_type) for lens_type in by_type]
    numbers = {name: jnp.stack([column[name] for column in columns]) for name in _NUMBERS}
    sharpest = jnp.argmin(numbers["spot_width_um"], 0)
    numbers = {name: jnp.take_along_axis(values, sharpest[None], 0)[0] for name, values in numbers.items()}
    numbers |= {"magnification": imager.magnification(at.depths), "occupancy": objectives.occupancy(imager, at)}
    whole = jnp.ones((), at.depths.dtype)
    shares = [whole if at.lenses is None else jnp.mean(at.lenses, dtype=at.depths.dtype) for _, at in by_type]

    def mean(quantity):
        return sum(share * quantity(*lens_type) for share, lens_type in zip(shares, by_type, strict=True))

    scalars = {
        "focal_length_mm": mean(lambda imager, _: imager.array.focal_length),
        "f_number": mean(objectives.f_number),
        "numerical_aperture": mean(objectives.numerical_aperture),
        "lenses_per_point": objectives.lenses_per_point(imager, at),
        "coverage": objectives.coverage(imager, at),
        "clear_diameter_mm": objectives.clear_diameter(imager, at),
    }
    key = jax.random.key(0)
    entries = {name: evaluate_term(TERMS[name], imager, at, key) for name in terms}
    diameters = jnp.stack([objectives.clear_diameter(*lens_type) for lens_type in by_type])
    return (at.depths, numbers, scalars, entries, diameters), sharpest


def _moved(start: Start, values: Mapping[str, Any]) -> tuple[Imager, Conditions]:
    near, far, first = values["near_mm"], values["far_mm"], start_values(*start)
    own = {name: values[name] for name in ("sensor_distance_mm", "pitch_mm") if name in values}
    # A slider is the first type's number.
    own |= {name: values[name] * (first[name] / first[name].ravel()[0]) for name in _LENS_KEYS if name in values}
    imager, at = candidate(*start, own)
    depths = depths_between((near + far) / 2, far - near, at.depths.size)
    return imager, dataclasses.replace(at, depths=depths, field_radius=values["field_radius_mm"])


def moved_imager(start: Start, values: Values) -> Imager:
    """The imager of these values."""
    imager, _ = _moved(start, {name: jnp.asarray(value) for name, value in values.items()})
    return dataclasses.replace(imager, field_radius=values["field_radius_mm"])


def moved_design(design: Design, start: Start, values: Values, provenance: dict[str, Any]) -> Design:
    """The design of these values as a file holds it, to 0.1 um; `InputError` if they make no microscope."""
    array, rounded = moved_imager(start, values).array, lambda x: np.round(np.asarray(x, float), 4)
    size = rounded(array.plate)
    of_lenses = lambda key: array.of_lenses(key) if not array.alike else getattr(array, key)
    own = {name: rounded(of_lenses(name.removesuffix("_mm"))) for name in _LENS_KEYS if name in values}
    own |= {name: rounded(values[name]) for name in ("sensor_distance_mm", "field_radius_mm")}
    return design.replace(
        **own,
        size_mm=size,
        # Rounding may not push a lens off the plate.
        centers_mm=np.clip(rounded(array.centers), -size / 2, size / 2),
        working_distance_mm=rounded([values["near_mm"], values["far_mm"]]),
        provenance=provenance,
    )


def lens_unit(start: Start, values: Values, number: int = 0) -> Imager:
    """The first lens of a type, alone on the axis."""
    moved = moved_imager(start, values)
    array = dataclasses.replace(moved.array.lens(start.types[number][0]), centers=jnp.zeros((1, 2)))
    # The field radius is static, and does not change spots.
    radius, shift = start.imager.field_radius, jnp.zeros_like(moved.shift)
    return dataclasses.replace(moved, array=array, field_radius=radius, shift=shift, tilt=None)


def pupil_samples(start: Start) -> int:
    """Samples per pixel that resolve the spots of the starting design: decides shapes, so no slider changes it."""
    widest = float(start.imager.array.aperture_diameter.max())
    return int(np.clip(math.ceil(1.5 * least_samples(start.imager, widest)), 2, 4))


def find_violations(
    design: Design, study: Study | None, start: Start, values: Values, evaluation: Evaluation
) -> list[str]:
    """Sentences on missed targets of the study, and on violated assumptions of the formulas."""
    sentences, numbers = [], evaluation.numbers
    if not all(np.isfinite(value).all() for value in (*numbers.values(), *evaluation.scalars.values())):
        sentences.append("Some numbers are not finite: rays do not get through this lens.")
    array = to_numpy(moved_imager(start, values).array)
    aperture, sphere = np.broadcast_arrays(array.aperture_diameter, 2 * array.radius_of_curvature)
    too_wide = (array.conic_constant == 0) & (aperture > sphere)
    if "radius_of_curvature_mm" in values and not design.lens.aspheric_terms and too_wide.any():
        sizes = aperture[too_wide].ravel()[0], sphere[too_wide].ravel()[0]
        sentences.append("The aperture of {:.3g} mm is wider than its sphere, which has {:.3g} mm.".format(*sizes))
    for table in () if study is None else study.terms:
        if table.name in evaluation.terms:
            row = table.assess(evaluation.terms[table.name])
            if row.met is False:
                span = " to ".join(dict.fromkeys(f"{end:.3g}" for end in (row.low, row.high)))
                target = f"{SIGNS[table.kind]} {table.target:g}"
                sentences.append(f"Target missed: {TERMS[table.name].meaning} ({table.name}) is {span}, not {target}.")
    assert start.at.circle_of_confusion is not None
    circle_of_confusion, blur = 1000 * float(start.at.circle_of_confusion), numbers["blur_um"]
    if (out := int((blur > circle_of_confusion).sum())) > 0:
        sentences.append(
            f"{out} of {len(blur)} depths are out of focus: a thin lens blurs a point over up to {blur.max():.3g} um "
            f"of the sensor, more than the circle of confusion, {circle_of_confusion:.3g} um."
        )
    sheet = {"depth_mm": evaluation.depths, "pitch_mm": values.get("pitch_mm"), **numbers, **evaluation.scalars}
    remarks = (spots_remark(sheet), *lens_and_plate_remarks(design, sheet))
    return [*sentences, *filter(None, remarks)]


class GhostMap(NamedTuple):
    """How many rays of back-projection cross each cell of `box`, `(left, top, right, bottom)`, mm.

    `lenses` see the point.
    """

    crossings: Int[np.ndarray, "row column"]
    box: tuple[float, float, float, float]
    lenses: int


def map_ghosts(imager: Imager, near: float, far: float) -> GhostMap:
    """Count where back-projection puts the light of a point on the axis, in the middle of the depths, over all depths.

    Each lens throws each image back along its own chief ray. Rays meet at the point at its depth; all else is its blur
    at other depths, and ghosts, which are other lenses' images. Lenses count within the field radius.
    """
    depths = np.linspace(near, far, _GHOST_DEPTHS)
    box = plate_and_sensor(imager)
    # On the axis, at each depth and in the middle of them.
    on_axis = np.column_stack([np.zeros((_GHOST_DEPTHS + 1, 2)), [*depths, (near + far) / 2]])
    axis = to_numpy(imager).views_of_all(on_axis)
    offsets, images = axis.offset, axis.spot[lenses_that_see(imager, on_axis[-1:])[:, 0], -1]
    magnifications = np.broadcast_to(imager.magnifications(depths), (len(axis.spot), _GHOST_DEPTHS))
    # A spot moves by -M for a point that moves by 1.
    points = (axis.spot[:, None, :-1] - images[None, :, None]) / magnifications[:, None, :, None]
    kept = np.hypot(*np.moveaxis(points + offsets[:, None, :-1], -1, 0)) <= imager.field_radius
    edges = [np.linspace(low, high, _CELLS + 1) for low, high in ((box[1], box[3]), (box[0], box[2]))]
    crossings = np.histogram2d(points[kept][:, 1], points[kept][:, 0], edges)[0].astype(int)
    return GhostMap(crossings, box, len(images))


class Reconstruction(NamedTuple):
    """Maxima along z over `(left, top, right, bottom)`, mm, and the true points.

    `contrast` is the mean brightness of the points above the volume's median, over its standard deviation.
    """

    maxima: Float[np.ndarray, "row column"]
    points: Float[np.ndarray, "point 3"]
    box: tuple[float, float, float, float]
    contrast: float


def reconstruct_points(start: Start, values: Values, clear_diameters: Float[np.ndarray, " type"]) -> Reconstruction:
    """Image points in five planes with the spots of each lens type onto a coarse sensor, and back-project them.

    Light outside a spot's window is left out. `clear_diameters` are those of the types, mm.
    """
    near, far, imager = values["near_mm"], values["far_mm"], moved_imager(start, values)
    coarse = max(-(-max(imager.sensor.shape) // _PIXELS), 1)
    rows, columns = (max(n // coarse, 2) for n in imager.sensor.shape)
    sensor = Sensor((rows, columns), imager.sensor.pixel_pitch * coarse, imager.sensor.origin)
    small = dataclasses.replace(imager, sensor=sensor)
    depths = np.linspace(near, far, _PLANES)
    side = 0.7 * min(*imager.array.plate, *(n * sensor.pixel_pitch for n in sensor.shape))
    points = random_points(_POINTS, (side, side), (near, far), seed=2)[:, :3]
    plane = np.arange(_POINTS) % _PLANES
    points[:, 2] = depths[plane]
    image, samples = np.zeros(sensor.shape), pupil_samples(start)
    for number, (lenses, diameter) in enumerate(zip(start.types, clear_diameters, strict=True)):
        unit = lens_unit(start, values, number)
        for k, depth in enumerate(depths):
            binned = _bin(spot_image(unit, float(depth), 0.0, size=SIZE, radius=diameter / 2, samples=samples), coarse)
            image += fftconvolve(_dots(small, points[plane == k], lenses), binned, mode="same")
    grid = Grid.over(sensor, depths=depths, pitch=max(sensor.shape) * sensor.pixel_pitch / _VOXELS)
    volume = _backproject(np.maximum(image, 0), small, grid)
    left, right, bottom, top = grid.extent
    return Reconstruction(volume.max(0), points, (left, top, right, bottom), _contrast(volume, points, grid))


def _backproject(image, imager: Imager, grid: Grid) -> np.ndarray:
    """`gs_jax.backproject` more slowly, but compiled once for all field radii, which are static there."""
    image, radius = (jnp.asarray(x, imager.sensor_distance.dtype) for x in (image, imager.field_radius))
    return np.asarray(_sum_lenses(image, dataclasses.replace(imager, field_radius=1.0), grid, radius))


@jax.jit
def _sum_lenses(image: Array, imager: Imager, grid: Grid, field_radius: Array) -> Array:
    def plane(depth):
        # Views are separable in x and y: one line of points along each is enough.
        across = jnp.stack([grid.x, 0 * grid.x, jnp.full_like(grid.x, depth)], -1)
        along = jnp.stack([0 * grid.y, grid.y, jnp.full_like(grid.y, depth)], -1)

        def add_lens(lens, plane):
            by_x, by_y = imager.views(across, lens[None]), imager.views(along, lens[None])
            rows = _interpolate(image, imager.sensor.to_pixels(by_y.spot)[:, 0])
            seen = _interpolate(rows.T, imager.sensor.to_pixels(by_x.spot)[:, 1]).T
            squared = by_y.offset[:, 1:] ** 2 + by_x.offset[None, :, 0] ** 2
            return plane + envelope(squared, by_x.reduced_depth[None], field_radius) * seen

        return jax.lax.fori_loop(0, len(imager.array.centers), add_lens, jnp.zeros(grid.shape, image.dtype))

    return jax.lax.map(plane, grid.depths)


def _interpolate(image: Array, position: Array | np.ndarray) -> Array:
    """Rows of an image at fractional positions, zero outside."""
    low = jnp.clip(jnp.floor(position), 0, len(image) - 2).astype(int)
    share, inside = position - low.astype(position.dtype), (position >= 0) & (position <= len(image) - 1)
    part = lambda weight: jnp.where(inside, weight, 0)[:, None]
    return part(1 - share) * image[low] + part(share) * image[low + 1]


def _bin(spot: np.ndarray, coarse: int) -> np.ndarray:
    """A spot on pixels `coarse` times as large, an odd number of them, its middle in the middle pixel."""
    reach = max(-(-(SIZE - coarse) // (2 * coarse)), 0)
    side = 2 * reach + 1
    before = (side * coarse - SIZE) // 2
    padded = np.pad(spot, (before, side * coarse - SIZE - before))
    return padded.reshape(side, coarse, side, coarse).sum((1, 3))


def _dots(imager: Imager, points: np.ndarray, lenses: tuple[int, ...]) -> np.ndarray:
    """Chief-ray images of points by some lenses, each shared by the four nearest pixels."""
    host = to_numpy(imager)
    views = host.views(points[None], np.array(lenses)[:, None])
    spots, light = host.sensor.to_pixels(views.spot), np.asarray(host.brightness(views))
    corner, image = np.floor(spots).astype(int), np.zeros(imager.sensor.shape)
    for step in np.ndindex(2, 2):
        pixel, share = corner + step, light * np.prod(1 - np.abs(corner + step - spots), -1)
        on = ((pixel >= 0) & (pixel < image.shape)).all(-1)
        np.add.at(image, tuple(pixel[on].T), share[on])
    return image


def _contrast(volume: np.ndarray, points: np.ndarray, grid: Grid) -> float:
    axes = (grid.depths, grid.y, grid.x)
    nearest = tuple(np.abs(np.asarray(axis)[:, None] - points[:, 2 - k]).argmin(0) for k, axis in enumerate(axes))
    bright, deviation = maximum_filter(volume, (1, 3, 3))[nearest].mean(), volume.std()
    return float((bright - np.median(volume)) / deviation) if deviation > 0 else 0.0
