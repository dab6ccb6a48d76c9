"""What a calibration may find, and where spots are due: chief rays, and cores beside them by exact rays."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry import Imager
from ..lenses import MicrolensArray, lenses_by_type, type_of_lens
from ..optics.lens_types import split_by_type
from .spots import core_offsets

# Fields at which exact rays are traced, the degree of what is laid through them, and depths at most.
_FIELDS, _DEGREE, _DEPTHS = 13, 7, 5
# Of the sensor's distance, relative, for the slope of what exact rays say.
_STEP = 1e-2
# Residuals beyond so many pixels count less (Huber); noise of a spot, pixels, that deviations of lenses are weighed by.
OUTLIER, NOISE = 0.5, 0.1


class Unknowns(eqx.Module):
    """What is fitted; None is held.

    `scale` is of the array about its own centre, `depth_offset` is added to the depths of all sources, mm, `lenses` are
    deviations of the centres in the array's frame, mm, and `coordinates` are those of the sources that nobody gave, mm.
    """

    sensor_distance: Float[Array, ""] | None = None
    rotation: Float[Array, ""] | None = None
    shift: Float[Array, "2"] | None = None
    tilt: Float[Array, "2"] | None = None
    scale: Float[Array, ""] | None = None
    depth_offset: Float[Array, ""] | None = None
    lenses: Float[Array, "lens 2"] | None = None
    coordinates: Float[Array, " unknown"] | None = None


FITTED = ("sensor_distance", "rotation", "shift", "tilt")
FITTABLE = (*FITTED, "scale", "depth_offset", "lenses")


class Offsets(NamedTuple):
    """How far cores are from chief rays at some depths, as coefficients of odd powers of the field, mm.

    `slope` is how they change with the sensor's distance, from `sensor_distance` on. `type_of` is each lens's type.
    """

    depths: Float[Array, " depth"]
    here: Float[Array, "type depth power"]
    slope: Float[Array, "type depth power"]
    sensor_distance: Float[Array, ""]
    type_of: Int[Array, " lens"]


class Known(NamedTuple):
    """What a fit is given: the microscope so far, sources with what is known of them, and spots of known lenses.

    `points` `(source, 3)` hold the best guess of what is not known, which `unknown` names: `(unknown, 2)`, source and
    coordinate. Spots fill arrays of one size, so that one shape is compiled; `are` says which are some.
    """

    imager: Imager
    points: Float[Array, "source 3"]
    unknown: Int[Array, "unknown 2"]
    sources: Int[Array, " spot"]
    lenses: Int[Array, " spot"]
    places: Float[Array, "spot 2"]
    are: Bool[Array, " spot"]
    offsets: Offsets


def guessed(names: Sequence[str], known: Known) -> Unknowns:
    """The unknowns as they are so far."""
    imager, dtype = known.imager, known.places.dtype
    zero = jnp.zeros((), dtype)
    values = {
        "sensor_distance": imager.sensor_distance,
        "rotation": imager.rotation,
        "shift": imager.shift,
        "tilt": jnp.zeros(2, dtype) if imager.tilt is None else imager.tilt,
        "scale": zero + 1,
        "depth_offset": zero,
        "lenses": jnp.zeros(imager.array.centers.shape, dtype),
    }
    coordinates = known.points[known.unknown[:, 0], known.unknown[:, 1]] if len(known.unknown) else None
    return Unknowns(**{name: values[name].astype(dtype) for name in names}, coordinates=coordinates)


def applied(unknowns: Unknowns, imager: Imager) -> Imager:
    """The microscope with what was found."""
    array = imager.array
    if unknowns.scale is not None or unknowns.lenses is not None:
        centers = array.centers if unknowns.scale is None else array.centers * unknowns.scale
        array = moved_lenses(array, centers if unknowns.lenses is None else centers + unknowns.lenses)
    found = (unknowns.sensor_distance, unknowns.rotation, unknowns.shift, unknowns.tilt)
    names = ("sensor_distance", "rotation", "shift", "tilt")
    new = {name: value for name, value in zip(names, found, strict=True) if value is not None}
    return eqx.tree_at(
        lambda i: (i.array, *(getattr(i, name) for name in new)),
        imager,
        (array, *new.values()),
        is_leaf=lambda leaf: leaf is None,
    )


def moved_lenses(array: MicrolensArray, centers) -> MicrolensArray:
    """The array with other centres `(lens, 2)`, mm, maybe of another number."""
    return eqx.tree_at(lambda a: a.centers, array, jnp.asarray(centers, array.centers.dtype))


def found_points(unknowns: Unknowns, known: Known) -> Float[Array, "source 3"]:
    """The sources with what was found of them."""
    points = known.points
    if unknowns.coordinates is not None:
        points = points.at[known.unknown[:, 0], known.unknown[:, 1]].set(unknowns.coordinates)
    return points if unknowns.depth_offset is None else points.at[:, 2].add(unknowns.depth_offset)


@jax.jit
def residuals(unknowns: Unknowns, known: Known) -> Float[Array, "spot 2"]:
    """Where spots are due, less where they are, pixels; 0 where none is."""
    imager, points = applied(unknowns, known.imager), found_points(unknowns, known)[known.sources]
    off = (_due(imager, points, known.lenses, known.offsets) - known.places) / imager.sensor.pixel_pitch
    return jnp.where(known.are[:, None], off, 0)


def weighed(state: Unknowns, given: tuple[Known, Float[Array, ""]]):
    """Residuals of Huber's loss, whose squares grow like the distance where that is large, and lenses in their SDs."""
    known, loose = given
    off = residuals(state, known)
    squared = jnp.sum(off**2, -1, keepdims=True)
    large = squared > OUTLIER**2
    distance = jnp.sqrt(jnp.where(large, squared, 1.0))
    off = off * jnp.where(large, jnp.sqrt(2 * OUTLIER * distance - OUTLIER**2) / distance, 1.0)
    return off, None if state.lenses is None else state.lenses * (NOISE / loose)


def _due(imager: Imager, points, lenses, offsets: Offsets) -> Float[Array, "spot 2"]:
    views = imager.views(points, lenses)
    field2 = jnp.sum(views.offset**2, -1) / imager.field_radius**2
    of_type = jax.vmap(lambda column: jnp.interp(points[:, 2], offsets.depths, column))
    at = lambda columns: of_type(columns)[offsets.type_of[lenses], jnp.arange(len(lenses))]
    along = jnp.zeros_like(field2)
    for power in reversed(range(offsets.here.shape[2])):
        here, slope = at(offsets.here[..., power]), at(offsets.slope[..., power])
        along = along * field2 + here + (imager.sensor_distance - offsets.sensor_distance) * slope
    return views.spot + views.offset / imager.field_radius * along[:, None]


def offsets_of(imager: Imager, depths: Float[np.ndarray, " source"]) -> Offsets:
    """By exact rays, at these depths, or at a few that span them. The polynomial evens out the rays' noise."""
    nodes = np.unique(depths)
    if len(nodes) > _DEPTHS:
        nodes = np.linspace(nodes[0], nodes[-1], _DEPTHS)
    v = float(imager.sensor_distance)
    farther = eqx.tree_at(lambda i: i.sensor_distance, imager, imager.sensor_distance * (1 + _STEP))
    here, beyond = (core_powers(each, nodes) for each in (imager, farther))
    tables = nodes, here, (beyond - here) / (v * _STEP), v
    at, here, slope, distance = (jnp.asarray(table, imager.sensor_distance.dtype) for table in tables)
    return Offsets(at, here, slope, distance, jnp.asarray(type_of_lens(imager.array)))


def core_powers(imager: Imager, depths: Float[np.ndarray, " depth"]) -> Float[np.ndarray, "type depth power"]:
    """By exact rays, how far the cores of each type of lens are from chief rays: coefficients as of `Offsets`."""
    fields = np.linspace(0, imager.field_radius, _FIELDS)
    # A tilt turns the field a little; the lens is the same.
    level = eqx.tree_at(lambda i: i.tilt, imager, None, is_leaf=lambda leaf: leaf is None)
    powers = (fields / imager.field_radius)[:, None] ** np.arange(1, _DEGREE + 1, 2)
    fitted = lambda one: np.linalg.lstsq(powers, core_offsets(one, depths, fields).T)[0].T
    return np.stack([fitted(one) for one in split_by_type(level, lenses_by_type(level.array))])


@jax.jit
def due(
    imager: Imager, points: Float[Array | np.ndarray, "source 3"], offsets: Offsets
) -> Float[Array, "source lens 2"]:
    """Where the spots of sources are due under every lens, mm."""
    lenses, dtype = jnp.arange(len(imager.array.centers)), imager.sensor_distance.dtype
    of_source = lambda point: _due(imager, jnp.tile(point, (len(lenses), 1)), lenses, offsets)
    return jax.lax.map(of_source, jnp.asarray(points, dtype))
