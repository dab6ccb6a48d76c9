"""Devices as they come out: what is wrong with each, and the microscope that it then is."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ...geometry import Imager
from .tolerance_spec import Tolerances

# What a tolerance is called, and the fields of `Errors` that it rules.
RULED = {
    "position": "centers",
    "radius": "radius",
    "conic": "conic",
    "index": "index",
    "sensor distance": "sensor_distance",
    "tilt": "tilt",
    "roughness": "roughness",
    "printed layers": "layer",
}
# Those that every device has as they are.
LEVELS = ("roughness", "printed layers")


class Errors(eqx.Module):
    """What is wrong with a device, each number in its unit or in standard deviations.

    `centers` of the lenses `(lens, 2)`, mm; `radius`, relative; `conic`; `index`; `sensor_distance`, mm; `tilt`, slopes
    `(x, y)`; `roughness`, RMS, and `layer` of the printer, mm.
    """

    centers: Float[Array, "..."]
    radius: Float[Array, "..."]
    conic: Float[Array, "..."]
    index: Float[Array, "..."]
    sensor_distance: Float[Array, "..."]
    tilt: Float[Array, "..."]
    roughness: Float[Array, "..."]
    layer: Float[Array, "..."]


def spreads_of(tolerances: Tolerances) -> Errors:
    """Standard deviations, or levels, as numbers in mm and slopes."""
    t = tolerances
    return Errors(
        centers=jnp.asarray(t.position_um / 1000),
        radius=jnp.asarray(t.radius_percent / 100),
        conic=jnp.asarray(t.conic),
        index=jnp.asarray(t.index),
        sensor_distance=jnp.asarray(t.sensor_distance_um / 1000),
        tilt=jnp.asarray(math.tan(math.radians(t.tilt_deg))),
        roughness=jnp.asarray(t.roughness_nm * 1e-6),
        layer=jnp.asarray(t.layer_um / 1000),
    )


def no_errors(lenses: int) -> Errors:
    """Of a device as it is designed."""
    zero = jnp.zeros(())
    return Errors(jnp.zeros((lenses, 2)), zero, zero, zero, zero, jnp.zeros(2), zero, zero)


def drawn(key: Key[Array, ""], lenses: int) -> Errors:
    """A device, in standard deviations."""
    flat, tree = jax.tree.flatten(no_errors(lenses))
    keys = jax.random.split(key, len(flat))
    unit = jax.tree.unflatten(tree, [jax.random.normal(k, part.shape) for k, part in zip(keys, flat, strict=True)])
    one = jnp.ones(())
    return dataclasses.replace(unit, **{RULED[name]: one for name in LEVELS})


def in_units(unit: Errors, spreads: Errors) -> Errors:
    """What is wrong, from standard deviations."""
    return jax.tree.map(jnp.multiply, unit, spreads)


def without(spreads: Errors, name: str) -> Errors:
    """The same with one tolerance at zero."""
    field = RULED[name]
    return dataclasses.replace(spreads, **{field: jnp.zeros_like(getattr(spreads, field))})


def built(imager: Imager, errors: Errors) -> Imager:
    """The microscope that a device is."""
    a = imager.array
    array = dataclasses.replace(
        a,
        centers=a.centers + errors.centers,
        radius_of_curvature=a.radius_of_curvature * (1 + errors.radius),
        conic_constant=a.conic_constant + errors.conic,
        refractive_index=a.refractive_index + errors.index,
    )
    tilt = errors.tilt if imager.tilt is None else imager.tilt + errors.tilt
    distance = imager.sensor_distance + errors.sensor_distance
    return dataclasses.replace(imager, array=array, sensor_distance=distance, tilt=tilt)
