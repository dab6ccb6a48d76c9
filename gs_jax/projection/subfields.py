"""A part of the field as an imager of its own, for what does not fit into memory at once."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..geometry import Imager, Sensor


def subfield(
    imager: Imager, place: Float[Array | np.ndarray, "2"], shape: tuple[int, int]
) -> tuple[Imager, Bool[Array, "row column"]]:
    """The imager as seen from a place of the field, with a small sensor there.

    The chief-ray map does not mind where the origin is: with the origin at `place`, lenses and sensor are moved by
    `-place`, and voxels of a centred grid lie around the place. The place is rounded to whole pixels (half of one if
    the shapes differ by an odd number), so that pixels stay pixels. A voxel at `q` from the place is imaged up to
    `|q| + (1 + M) field_radius` from it; what the new sensor does not hold of that is lost.

    Parameters
    ----------
    imager
        The whole.
    place
        `(x, y)`, mm.
    shape
        `(rows, columns)` of the new sensor.

    Returns
    -------
    tuple
        The imager, and which of its pixels are on the sensor of the whole.
    """
    sensor = imager.sensor
    # Where the first pixel comes to lie on the whole sensor.
    whole = jnp.array(sensor.shape, place.dtype)
    origin = jnp.array(sensor.origin, place.dtype)
    middle = (place - origin)[::-1] / sensor.pixel_pitch + (whole - jnp.array(shape, place.dtype)) / 2
    corner = lax.stop_gradient(jnp.round(middle))
    moved = origin + (corner - (whole - jnp.array(shape, place.dtype)) / 2)[::-1] * sensor.pixel_pitch
    rows, columns = (
        (first + jnp.arange(size) >= 0) & (first + jnp.arange(size) < total)
        for first, size, total in zip(corner.astype(int), shape, sensor.shape, strict=True)
    )
    local = eqx.tree_at(
        lambda i: (i.sensor, i.shift), imager, (Sensor(shape, sensor.pixel_pitch), imager.shift - moved)
    )
    return local, rows[:, None] & columns[None]
