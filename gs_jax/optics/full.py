"""All of the light that lenses pass on, as tables: what `gs_jax.forward` needs for the true image of a volume."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ..base.progress import Progress
from ..geometry import Imager
from .cores import core_table, drawn
from .halo import HaloGrid, halo_grid, halo_table
from .light import zones

# Reach of a core's kernel, in the halo's pixels: what is wider is smooth enough for them.
_REACH = 5


class FullOptics(eqx.Module):
    """Where all of a point's light goes, at some depths; made by `full_optics`.

    A lens's spot has a core, sharp, where the field is not too wide, and a halo, which is everything else. Cores
    are splatted at full resolution, ring by ring, and each ring has one kernel. The halo is computed on coarse pixels.

    Parameters
    ----------
    stretch
        `(depth, ring)`: magnification of the cores, over the chief ray's.
    light
        `(depth, ring, coefficient)` of `gs_jax.optics.cores.ring_light`.
    kernels
        `(depth, ring, size, size)` on the sensor's pixels, each with the sum 1.
    table
        `(depth, kind, harmonic, radius, field)` of `gs_jax.optics.halo.halo_table`.
    area
        Mean clear area of the lenses, mm^2.
    sensor_distance
        Of the tables, mm.
    grid
        Of the halo.
    """

    stretch: Float[Array, "depth ring"]
    light: Float[Array, "depth ring coefficient"]
    kernels: Float[Array, "depth 1 size size"]
    rough: Float[Array, "depth outer small small"]
    table: Float[Array, "depth kind harmonic radius field"]
    area: Float[Array, ""]
    sensor_distance: Float[Array, ""]
    grid: HaloGrid = eqx.field(static=True)


def full_optics(
    imager: Imager,
    depths: Sequence[float] | Float64[np.ndarray, " depth"],
    *,
    extent: float | None = None,
    progress: Progress | None = None,
) -> FullOptics:
    """The tables of a microscope at some depths, by exact rays; a third of a second each.

    They are constants to JAX: derivatives of an image by the lens centres and the sensor's distance move the spots and
    leave their shapes. Whoever changes the lens makes new tables.

    Parameters
    ----------
    imager
        Its lens, pitch and sensor count; where it is rotated or shifted to does not.
    depths
        Of the planes, mm, in their order.
    extent
        Size of the object, mm: no light is followed that comes from farther off. By default the sensor's.
    progress
        Shows how many depths are done.

    Examples
    --------
    >>> image = forward(volume, imager, grid, full_optics(imager, grid.depths))
    """
    depths = np.asarray(depths, np.float64)
    aperture = zones(imager.array)
    extent = extent or max(imager.sensor.shape) * imager.sensor.pixel_pitch
    farthest = float(jnp.abs(imager.array.centers).max()) + extent / 2
    grid = halo_grid(imager, depths, math.sqrt(2) * farthest)
    reach = _REACH * grid.pixel
    size = 2 * round(reach / imager.sensor.pixel_pitch) + 1
    parts = []
    for depth in (progress or Progress()).track(depths, "Tracing spots"):
        core = core_table(imager, depth, aperture, reach)
        kernels = drawn(core.profile[0], size)[None]
        rough = np.stack([drawn(profile, size // 4 * 2 + 1, 0.5) for profile in core.profile[1:]])
        parts.append((core.stretch, core.light, kernels, rough, halo_table(imager, depth, aperture, grid, core)))
    dtype = imager.sensor_distance.dtype
    tables = (jnp.asarray(np.stack(part), dtype) for part in zip(*parts, strict=True))
    return FullOptics(*tables, jnp.asarray(aperture.area, dtype), imager.sensor_distance, grid)
