"""The least-squares problem of a calibration: unknowns, predicted spots, residuals, and standard errors.

Spots are predicted on chief rays, with the offsets of their bright cores by exact rays.

The Gauss-Newton covariance takes residuals as independent. Those of neighbouring lenses are not where something smooth
is not modelled: a stretch, a distortion, uneven light within discs. Estimates without a block of neighbouring lenses
then differ by more (jackknife).
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Float64, Int

from ..base.errors import InputError
from ..microscope.geometry import Imager
from ..microscope.layouts import nearest_neighbour_distances
from ..microscope.lenses import MicrolensArray, lenses_by_type
from ..microscope.media import Layers, object_surface
from ..optics.apertures import split_by_type
from ..optics.pupil import PupilSamples, aperture_profile, sample_pupil

# Fields at which exact rays are traced, degree of the polynomial through them, and number of depths at most.
_FIELDS, _DEGREE, _DEPTHS = 13, 7, 5
# Relative step of a number of the imager for the derivative of core offsets by it.
_STEP = 1e-2
# Rays of a spot, and distance from its chief ray within which its core lies, pixels.
_RAYS, _REACH = 8192, 40
# Gaussian window of the mean shift that defines the middle of a spot: standard deviation, pixels; steps; tolerance.
WINDOW, MAX_MOVES, MOVE_TOLERANCE = 1.5, 300, 1e-4
# Residual beyond which the loss is linear (Huber), and noise by which deviations of lenses are weighted, pixels.
OUTLIER, NOISE = 0.5, 0.1
# Least noise of a spot, pixels.
_MIN_NOISE = 0.01
# Relative singular value below which a direction is undetermined, and its least component that counts.
_SINGULAR, _COMPONENT = 1e-6, 1e-2
# Most blocks that are left out: few enough that a block is wider than what is alike in it, enough for a standard error
# to a fifth. Reciprocal condition number below which spots without a block determine nothing.
_BLOCKS, _SINGULAR_BLOCK = 16, 1e-12
# Names and units in files of the fields of `Unknowns`, and the standard error beyond which a value is undetermined;
# lengths are relative to `match_radius`.
_NAMES = {
    "sensor_distance": {"sensor_distance_mm": 3.33},
    "rotation": {"rotation_deg": 1.0},
    "shift": {"shift_x_mm": 3.33, "shift_y_mm": 3.33},
    "tilt": {"tilt_x_deg": 0.5, "tilt_y_deg": 0.5},
    "scale": {"scale": 0.02},
    "depth_offset": {"depth_offset_mm": 8.33},
    "sample_at": {"sample_at_mm": 8.33},
    "sample_index": {"sample_index": 0.05},
}
# A spot is at a lens within this distance, in pitches of the array: 0.06 mm on the paper's plate.
_MATCH_RADIUS = 0.0488
# A blurred spot is at a lens within this distance, over `match_radius`.
_BLURRED_RADIUS = 5.0

FITTED = ("sensor_distance", "rotation", "shift", "tilt")
# Where the sample begins, mm, and its refractive index.
OF_SAMPLE = ("sample_at", "sample_index")
OF_DEVICE = (*FITTED, "scale", "depth_offset", "lenses")
FITTABLE = (*OF_DEVICE, *OF_SAMPLE)
# What core offsets depend on in one step of a fit, beside depth and field.
_TRACED = ("sensor_distance", *OF_SAMPLE)


class Unknowns(eqx.Module):
    """The unknowns of a fit; None is held.

    `scale` is that of the array about its center, `depth_offset` is added to the depths of all sources, mm, `lenses`
    are deviations of the centers in the array's frame, mm, and `coordinates` the unknown ones of the sources, mm.
    `sample_at` is the depth at which the sample begins, mm, `sample_index` its refractive index.
    """

    sensor_distance: Float[Array, ""] | None = None
    rotation: Float[Array, ""] | None = None
    shift: Float[Array, "2"] | None = None
    tilt: Float[Array, "2"] | None = None
    scale: Float[Array, ""] | None = None
    depth_offset: Float[Array, ""] | None = None
    lenses: Float[Array, "lens 2"] | None = None
    sample_at: Float[Array, ""] | None = None
    sample_index: Float[Array, ""] | None = None
    coordinates: Float[Array, " unknown"] | None = None


class CoreOffsets(NamedTuple):
    """Distance of cores from chief rays at some depths: coefficients of odd powers of the field, mm.

    `slopes` are the derivatives by numbers of the imager at `values`, by their names in `Unknowns`. `type_of` is each
    lens's type.
    """

    depths: Float[Array, " depth"]
    offset: Float[Array, "type depth power"]
    slopes: dict[str, Float[Array, "type depth power"]]
    values: dict[str, Float[Array, ""]]
    type_of: Int[Array, " lens"]


class Observations(NamedTuple):
    """What a fit is given: the initial imager, sources, and spots of known lenses.

    `points` `(source, 3)` hold initial guesses of the coordinates that `unknown` `(unknown, 2)` lists by source and
    axis. Spots are padded to one size, so that one shape is compiled; `valid` marks the actual ones. `blur` is the
    width of each in that of a sharp one, by which its residual is divided.
    """

    imager: Imager
    points: Float[Array, "source 3"]
    unknown: Int[Array, "unknown 2"]
    sources: Int[Array, " spot"]
    lenses: Int[Array, " spot"]
    positions: Float[Array, "spot 2"]
    valid: Bool[Array, " spot"]
    blur: Float[Array, " spot"]
    offsets: CoreOffsets


def number(imager: Imager, name: str) -> Any:
    """A number of the imager, or of its sample by a name of `OF_SAMPLE`."""
    sample: Any = imager.sample
    of_sample = {"sample_at": "surface", "sample_index": "refractive_index"}
    return getattr(sample, of_sample[name]) if name in of_sample else getattr(imager, name)


def with_surface(imager: Imager, fit: Sequence[str]) -> Imager:
    """The imager with a surface of its sample, if that is to be fitted: the layers behind the last gap of air are its.

    `InputError` if the imager has no sample, or one without such a gap.
    """
    fitted = [name for name in fit if name in OF_SAMPLE]
    sample, filters = imager.sample, imager.filters
    if fitted and sample is None:
        raise InputError(f"fit: {fitted[0]} needs a microscope with a sample, got one in air.")
    if sample is None or "sample_at" not in fitted or sample.surface is not None:
        return imager
    gaps = [] if filters is None else np.flatnonzero(np.asarray(filters.refractive_index) == 1)
    if filters is None or not len(gaps):
        raise InputError("fit: sample_at needs a sample behind a gap of air, got one in contact with what is there.")

    def layers(slabs) -> Layers | None:
        return Layers(*map(np.array, zip(*slabs, strict=True))) if slabs else None

    # Layers of a sample go from the medium to the array.
    behind = [*([] if sample.layers is None else sample.layers.slabs), *filters.slabs[: gaps[-1] : -1]]
    sample = dataclasses.replace(sample, surface=imager.sample_surface, layers=layers(behind))
    return dataclasses.replace(imager, filters=layers(filters.slabs[: gaps[-1]]), sample=sample)


def check_fitted_sample(imager: Imager) -> None:
    """`InputError` if a fit puts the sample's surface into the layers before it, or its index below that of air."""
    if (sample := imager.sample) is None:
        return
    least = float(object_surface(imager.filters, dataclasses.replace(sample, surface=None)))
    for name, value, lowest, unit in (
        ("sample_at", sample.surface, least, " mm, where the layers before it end,"),
        ("sample_index", sample.refractive_index, 1.0, ""),
    ):
        if value is not None and float(value) < lowest * (1 - 1e-6):
            needs = f"{name} must be {lowest:.6g}{unit} or more"
            raise InputError(f"captures: {needs}, got {float(value):.6g} as what fits the spots best; hold {name}.")


def match_radius(centers: Float[Array | np.ndarray, "lens 2"]) -> float:
    """Distance within which a spot is at a lens of an array, mm: a twentieth of the pitch."""
    return _MATCH_RADIUS * float(nearest_neighbour_distances(np.asarray(centers, np.float64)).mean())


def blurred_radius(centers: Float[Array | np.ndarray, "lens 2"]) -> float:
    """Distance within which a blurred spot is at a lens of an array, mm: a quarter of the pitch."""
    return _BLURRED_RADIUS * match_radius(centers)


def initial_unknowns(names: Sequence[str], data: Observations) -> Unknowns:
    imager, dtype = data.imager, data.positions.dtype
    zero = jnp.zeros((), dtype)
    values = {
        "tilt": jnp.zeros(2, dtype) if imager.tilt is None else imager.tilt,
        "scale": zero + 1,
        "depth_offset": zero,
        "lenses": jnp.zeros(imager.array.centers.shape, dtype),
    }
    coordinates = data.points[data.unknown[:, 0], data.unknown[:, 1]] if len(data.unknown) else None
    initial = {name: values[name] if name in values else number(imager, name) for name in names}
    return Unknowns(**{name: value.astype(dtype) for name, value in initial.items()}, coordinates=coordinates)


def apply_to_imager(unknowns: Unknowns, imager: Imager) -> Imager:
    """The imager with the fitted values."""
    array = imager.array
    if unknowns.scale is not None or unknowns.lenses is not None:
        centers = array.centers if unknowns.scale is None else array.centers * unknowns.scale
        array = with_centers(array, centers if unknowns.lenses is None else centers + unknowns.lenses)
    values = {name: value for name in (*FITTED, *OF_SAMPLE) if (value := getattr(unknowns, name)) is not None}
    where = lambda i: (i.array, *(number(i, name) for name in values))
    return eqx.tree_at(where, imager, (array, *values.values()), is_leaf=lambda leaf: leaf is None)


def with_centers(array: MicrolensArray, centers) -> MicrolensArray:
    """The array with other centers `(lens, 2)`, mm; alike lenses may be of another number."""
    return eqx.tree_at(lambda a: a.centers, array, jnp.asarray(centers, array.centers.dtype))


def source_points(unknowns: Unknowns, data: Observations) -> Float[Array, "source 3"]:
    """Positions of the sources with the fitted values."""
    points = data.points
    if unknowns.coordinates is not None:
        points = points.at[data.unknown[:, 0], data.unknown[:, 1]].set(unknowns.coordinates)
    return points if unknowns.depth_offset is None else points.at[:, 2].add(unknowns.depth_offset)


@jax.jit
def residuals(unknowns: Unknowns, data: Observations) -> Float[Array, "spot 2"]:
    """Predicted less observed spots, pixels; 0 for padding."""
    imager, points = apply_to_imager(unknowns, data.imager), source_points(unknowns, data)[data.sources]
    off = (
        _predict(imager, points, data.lenses, data.offsets, data.blur == 1) - data.positions
    ) / imager.sensor.pixel_pitch
    return jnp.where(data.valid[:, None], off, 0)


def weighted_residuals(unknowns: Unknowns, args: tuple[Observations, Float[Array, ""]]):
    """Residuals of Huber's loss, and deviations of lenses over their prior standard deviation, the second argument."""
    data, lens_sd = args
    off = residuals(unknowns, data) / data.blur[:, None]
    squared = jnp.sum(off**2, -1, keepdims=True)
    large = squared > OUTLIER**2
    distance = jnp.sqrt(jnp.where(large, squared, 1.0))
    off = off * jnp.where(large, jnp.sqrt(2 * OUTLIER * distance - OUTLIER**2) / distance, 1.0)
    return off, None if unknowns.lenses is None else unknowns.lenses * (NOISE / lens_sd)


def _predict(imager: Imager, points, lenses, offsets: CoreOffsets, sharp) -> Float[Array, "spot 2"]:
    views = imager.views(points, lenses)
    # The middles of blurred spots are on chief rays, at any field.
    offset = jnp.where(jnp.asarray(sharp)[..., None], views.offset, 0)
    field2 = jnp.sum(offset**2, -1) / imager.field_radius**2
    lens_types, spots = offsets.type_of[lenses], jnp.arange(len(lenses))

    def at(columns: Float[Array, "type depth"]) -> Float[Array, " spot"]:
        return jax.vmap(lambda column: jnp.interp(points[:, 2], offsets.depths, column))(columns)[lens_types, spots]

    radial = jnp.zeros_like(field2)
    for power in reversed(range(offsets.offset.shape[2])):
        radial = radial * field2 + at(offsets.offset[..., power])
        for name, slope in offsets.slopes.items():
            radial = radial + (number(imager, name) - offsets.values[name]) * at(slope[..., power])
    return views.spot + offset / imager.field_radius * radial[:, None]


@jax.jit
def predict_spots(
    imager: Imager,
    points: Float[Array | np.ndarray, "source 3"],
    offsets: CoreOffsets,
    sharp: Bool[Array | np.ndarray, " source"],
) -> Float[Array, "source lens 2"]:
    """Predict the spots of sources, which are sharp or blurred, under every lens, mm."""
    lenses, dtype = jnp.arange(len(imager.array.centers)), imager.sensor_distance.dtype

    def of_source(source) -> Float[Array, "lens 2"]:
        return _predict(imager, jnp.tile(source[0], (len(lenses), 1)), lenses, offsets, source[1])

    return jax.lax.map(of_source, (jnp.asarray(points, dtype), jnp.asarray(sharp)))


def trace_core_offsets(imager: Imager, depths: Float[np.ndarray, " source"], fit: Sequence[str] = ()) -> CoreOffsets:
    """Trace core offsets at these depths, or a few that span them, with derivatives by what is fitted of `_TRACED`.

    Without depths, where all spots are blurred, there are none.
    """
    nodes, array = np.unique(depths), imager.array
    if len(nodes) > _DEPTHS:
        nodes = np.linspace(nodes[0], nodes[-1], _DEPTHS)
    values = {name: number(imager, name) for name in _TRACED if name in fit and len(nodes)}
    offset = core_polynomials(imager, nodes) if len(nodes) else np.zeros((array.type_count, 1, 1))
    slopes = {}
    for name, value in values.items():
        beyond = eqx.tree_at(lambda i, name=name: number(i, name), imager, value * (1 + _STEP))
        slopes[name] = (core_polynomials(beyond, nodes) - offset) / (float(value) * _STEP)
    tables = nodes if len(nodes) else np.zeros(1), offset, slopes, values
    typed = jax.tree.map(lambda table: jnp.asarray(table, imager.sensor_distance.dtype), tables)
    return CoreOffsets(*typed, type_of=jnp.asarray(array.type_of_lens))


def core_polynomials(imager: Imager, depths: Float[np.ndarray, " depth"]) -> Float[np.ndarray, "type depth power"]:
    """Coefficients of `CoreOffsets` for each type of lens. The polynomial averages the noise of the rays."""
    fields = np.linspace(0, imager.field_radius, _FIELDS)
    # A tilt changes the field a little, but not the lens.
    level = eqx.tree_at(lambda i: i.tilt, imager, None, is_leaf=lambda leaf: leaf is None)
    powers = (fields / imager.field_radius)[:, None] ** np.arange(1, _DEGREE + 1, 2)
    types = split_by_type(level, lenses_by_type(level.array))
    return np.stack([np.linalg.lstsq(powers, core_offsets(imager, depths, fields).T)[0].T for imager in types])


def core_offsets(
    imager: Imager, depths: Float64[np.ndarray, " depth"], fields: Float64[np.ndarray, " field"]
) -> Float64[np.ndarray, "depth field"]:
    """Trace the distance of the middle of spots from their chief rays, toward the point's side, mm.

    A point `field` beside a lens's axis is imaged at `-M_z field` from the axis, plus this.
    """
    aperture, pixel = aperture_profile(imager.array), imager.sensor.pixel_pitch
    offsets = np.empty((len(depths), len(fields)))
    for row, depth in zip(offsets, depths, strict=True):
        rays = sample_pupil(imager, float(depth), fields, aperture, _RAYS)
        chief = float(imager.magnification(depth)) * fields
        row[:] = [_middle_of_rays(rays, k, chief[k], pixel) for k in range(len(fields))]
    return offsets


def _middle_of_rays(rays: PupilSamples, field: int, chief: float, pixel: float) -> float:
    """Where the mean shift of `find_spots` comes to rest, from the densest pixel along the radius."""
    along, across, light = rays.landing[field, :, 0] + chief, rays.landing[field, :, 1], rays.light[field]
    near = np.hypot(along, across) < _REACH * pixel
    if not light[near].sum() > 0:
        return 0.0
    edges = pixel * np.arange(-_REACH, _REACH + 1)
    line = np.histogram(along, edges, weights=light * (np.abs(across) < pixel))[0]
    middle, width = (edges[line.argmax()] + pixel / 2), WINDOW * pixel
    for _ in range(MAX_MOVES):
        weight = light * np.exp(-((along - middle) ** 2 + across**2) / (2 * width**2))
        last, middle = middle, float(weight @ along / weight.sum())
        if abs(middle - last) < MOVE_TOLERANCE * pixel:
            break
    return middle


def named_values(unknowns: Unknowns) -> dict[str, float]:
    """Values by their names in files, in the unit of the name."""
    values = {}
    for field, names in _NAMES.items():
        if (value := getattr(unknowns, field)) is not None:
            value = np.asarray(value, np.float64)
            degrees = {"rotation": np.degrees, "tilt": lambda slope: np.degrees(np.arctan(slope))}
            values |= zip(names, np.ravel(degrees.get(field, np.asarray)(value)).tolist(), strict=True)
    return values


def estimate_noise(off: Float64[np.ndarray, "spot 2"], unknowns: Unknowns, lenses: Int[np.ndarray, " spot"]) -> float:
    """Standard deviation of the spots' coordinates, pixels, from their residuals, robust to outliers."""
    distance = np.linalg.norm(off, axis=-1)
    near = off[distance < max(3 * np.median(distance), OUTLIER)]
    noise = max(np.median(np.abs(off)) / 0.6745, np.sqrt((near**2).mean()))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(unknowns))
    if unknowns.lenses is not None:
        numbers -= unknowns.lenses.size - 2 * len(np.unique(lenses))
    return max(noise * math.sqrt(off.size / max(off.size - numbers, 1)), _MIN_NOISE)


def standard_errors(unknowns: Unknowns, data: Observations, lens_sd: float, noise: float) -> dict[str, float]:
    """Standard errors by name, from the Gauss-Newton covariance; infinite where undetermined."""
    # Lenses are weighted relative to the actual noise of the spots.
    args = data, jnp.asarray(lens_sd * NOISE / noise, data.positions.dtype)
    jacobian = np.asarray(residual_jacobian(unknowns, args), np.float64)
    lengths = np.linalg.norm(jacobian, axis=0)
    # Each unknown in steps that move spots equally, so that singular values can be compared.
    _, values, directions = np.linalg.svd(jacobian / np.where(lengths > 0, lengths, 1), full_matrices=False)
    singular = values <= _SINGULAR * values[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        spreads = np.where(singular, np.inf, noise / values)[:, None]
        counts = np.abs(directions) > np.where(singular, _COMPONENT, 0)[:, None]
        components = np.where(counts, np.abs(directions) * spreads, 0)
        errors = np.where(lengths > 0, np.sqrt((components**2).sum(0)) / lengths, np.inf)
    flat, unravel = ravel_pytree(unknowns)
    tree = unravel(jnp.asarray(errors, flat.dtype))
    named = named_values(tree)
    if tree.lenses is not None:
        named["lenses_mm"] = float(np.median(tree.lenses[np.unique(np.asarray(data.lenses)[data.valid])]))
    return named


@jax.jit
def residual_jacobian(unknowns: Unknowns, args: tuple[Observations, Float[Array, ""]]) -> Float[Array, "row number"]:
    """Derivatives of all weighted residuals by all unknowns, both raveled."""
    flat, unravel = ravel_pytree(unknowns)
    return jax.jacfwd(lambda flat: ravel_pytree(weighted_residuals(unravel(flat), args))[0])(flat)


def jackknife_errors(unknowns: Unknowns, data: Observations, lens_sd: float) -> dict[str, float]:
    """Standard errors by name, to first order in the change by each block; 0 of lenses and where a block is decisive.

    A lens that is left out itself says nothing of its own error.
    """
    args = data, jnp.asarray(lens_sd, data.positions.dtype)
    jacobian = np.asarray(residual_jacobian(unknowns, args), np.float64)
    off = np.asarray(weighted_residuals(unknowns, args)[0], np.float64)
    lengths = np.linalg.norm(jacobian, axis=0)
    scale = np.where(lengths > 0, lengths, 1)
    jacobian = jacobian / scale
    rows, normal = jacobian[: off.size].reshape(*off.shape, -1), jacobian.T @ jacobian
    valid = np.flatnonzero(data.valid)
    squares = np.zeros(len(scale))
    blocks = _blocks(np.asarray(data.imager.array.centers, np.float64), np.asarray(data.lenses)[valid])
    for block in blocks:
        its, residual = rows[valid[block]].reshape(-1, len(scale)), off[valid[block]].ravel()
        others = normal - its.T @ its
        if np.linalg.cond(others) * _SINGULAR_BLOCK > 1:
            return dict.fromkeys(named_values(unknowns), 0.0)
        squares += np.linalg.solve(others, its.T @ residual) ** 2
    errors = np.sqrt(squares * (1 - 1 / len(blocks))) / scale
    flat, unravel = ravel_pytree(unknowns)
    return named_values(unravel(jnp.asarray(errors, flat.dtype)))


def _blocks(centers: Float64[np.ndarray, "lens 2"], lenses: Int[np.ndarray, " spot"]) -> list[np.ndarray]:
    """Spots of neighbouring lenses, by halving the lenses across their wider side."""
    blocks = [np.unique(lenses)]
    while len(blocks) < _BLOCKS and max(map(len, blocks)) > 1:
        halves = []
        for block in blocks:
            across = centers[block, np.ptp(centers[block], axis=0).argmax()]
            halves += np.array_split(block[np.argsort(across, kind="stable")], 2)
        blocks = [half for half in halves if len(half)]
    return [np.flatnonzero(np.isin(lenses, block)) for block in blocks]


def check_determined(errors: dict[str, float], radius: float) -> None:
    """`InputError` if a standard error is too large to be useful, with the array's `match_radius`, mm."""
    limits = {name: limit for names in _NAMES.values() for name, limit in names.items()}
    unknown = [
        f"{name} to {sd:.2g}" if sd < 100 else name
        for name, sd in errors.items()
        if sd > limits.get(name, math.inf) * (radius if name.endswith("_mm") else 1)
    ]
    if unknown:
        remedy = "use sources at more depths and positions, or known ones, or hold some of these"
        if any(name.startswith("sample") for name in unknown):
            remedy = "give the depths of points in the sample, hold the other numbers, or fit one of the sample's"
        raise InputError(f"captures: the spots do not determine {', '.join(unknown)}; {remedy}.")
