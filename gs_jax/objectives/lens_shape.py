"""Quantities of the array's geometry: spacing, gaps between apertures, height and slope of the lenses."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager
from .conditions import Depths, by_type, clear_diameter, finite_plate

# Points along a side of the plate where the distance to the nearest lens is computed, and along a lens's radius.
_POINTS = 41
# The curvature, 1/mm, below which a surface counts as flat.
_FLAT = 1e-6


def spacing(imager: Imager) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; infinite for a single lens."""
    return safe_sqrt(_nearest(_squared_distances(imager.array.centers, imager.array.centers)))


def aperture_gap(imager: Imager) -> Float[Array, " lens"]:
    """Gap between each lens's aperture and the nearest other one; negative where they overlap.

    It is the smallest feature of a mask that blocks the light between the lenses.
    """
    centers = imager.array.centers
    radius = jnp.broadcast_to(imager.array.aperture_diameter, len(centers)) / 2
    return _nearest(safe_sqrt(_squared_distances(centers, centers)) - radius[:, None] - radius[None])


def uncovered_distance(imager: Imager) -> Float[Array, " point"]:
    """Distance of 41 x 41 points of the plate, from edge to edge, from the nearest lens centre."""
    plate = finite_plate(imager)
    side = jnp.linspace(-0.5, 0.5, _POINTS, dtype=plate.dtype)
    points = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]
    return safe_sqrt(jnp.min(_squared_distances(points, imager.array.centers), 1))


def _squared_distances(points, centers):
    return jnp.sum((points[:, None] - centers[None]) ** 2, -1)


def _nearest(distances):
    return jnp.min(jnp.where(jnp.eye(len(distances), dtype=bool), jnp.inf, distances), 1)


@by_type
def sag(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Height of a whole lens, of a sphere `R - sqrt(R^2 - D^2/4)`: the depth of the mold; one a type."""
    return imager.array.sag(_on_surface(imager, (imager.array.aperture_diameter / 2) ** 2))


@by_type
def edge_slope(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Slope of the surface at the rim of the clear disc, of a sphere `asin(a / R)`, radians; one a type."""
    square = _on_surface(imager, (clear_diameter(imager, depths) / 2) ** 2)
    return jnp.arctan(safe_sqrt(square) * imager.array.sag_slope_over_r(square))


@by_type
def surface_radius(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, " point"]:
    """Radius of curvature of the surface at points from the vertex to the rim: a cutting tool's is below the least."""
    diameter = clear_diameter(imager, depths)
    radii = jnp.linspace(0, 1, _POINTS, dtype=diameter.dtype) * diameter / 2
    array, square = imager.array, _on_surface(imager, radii**2)
    sag_slope_over_r, change = jax.jvp(array.sag_slope_over_r, (square,), (jnp.ones_like(square),))
    length2 = 1 + square * sag_slope_over_r**2
    # Along the radius s'' / (1 + s'^2)^(3/2), across it s' / r / (1 + s'^2)^(1/2).
    along, across = (sag_slope_over_r + 2 * square * change) / length2**1.5, sag_slope_over_r / length2**0.5
    return 1 / jnp.maximum(jnp.maximum(along, across), _FLAT)


def _on_surface(imager, squared_radius):
    """Squared radii, limited to where a conic surface ends."""
    array = imager.array
    ends = 1 + array.conic_constant > 0
    end = (1 - 1e-6) ** 2 * array.radius_of_curvature**2 / jnp.where(ends, 1 + array.conic_constant, 1)
    return jnp.where(ends, jnp.minimum(squared_radius, end), squared_radius)
