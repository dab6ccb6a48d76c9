"""All of the light that lenses pass on, as tables: what `gs_jax.forward` needs for the true image of a volume."""

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ..base.machine import in_threads
from ..base.progress import Progress
from ..geometry import Imager
from .cores import RINGS, Cores, core_tables, drawn
from .halo import HaloGrid, halo_grid, halo_table
from .light import clear_area, zones

# Reach of a core's kernel, in the halo's pixels: what is wider is smooth enough for them.
CORE_REACH = 5


class Halo(eqx.Module):
    """All light but the cores', at some depths; made by `halo_of`.

    Parameters
    ----------
    table
        Of `gs_jax.optics.halo.halo_table`, one a depth.
    area
        Mean clear area of the lenses, mm^2.
    sensor_distance
        Of the tables, `v'`, mm.
    grid
        The nodes.
    """

    table: Float[Array, "depth kind harmonic radius field"]
    area: Float[Array, ""]
    sensor_distance: Float[Array, ""]
    grid: HaloGrid = eqx.field(static=True)

    @property
    def reach(self) -> float:
        """Of a core's kernel, mm."""
        return CORE_REACH * self.grid.pixel


class FullOptics(eqx.Module):
    """Where all of a point's light goes, at some depths; made by `full_optics`.

    A lens's spot has a core, sharp, where the field is not too wide, and a halo, which is everything else. Cores
    are splatted ring by ring, and each ring has one kernel. The halo is computed on coarse pixels.

    Parameters
    ----------
    stretch
        Magnification of the cores, over the chief ray's.
    light
        Coefficients of `gs_jax.optics.cores.ring_light`.
    kernel
        Of the inner ring, on the sensor's pixels, with the sum 1.
    wide_kernels
        Of the outer rings, on pixels twice as large.
    halo
        The rest.
    rings
        Where the rings end, in field radii.
    """

    stretch: Float[Array, "depth ring"]
    light: Float[Array, "depth ring coefficient"]
    kernel: Float[Array, "depth size size"]
    wide_kernels: Float[Array, "depth outer small small"]
    halo: Halo
    rings: tuple[float, ...] = eqx.field(static=True)


def full_optics(
    imager: Imager,
    depths: Sequence[float] | Float[Array | np.ndarray, " depth"],
    *,
    extent: float | None = None,
    nodes: HaloGrid | None = None,
    rings: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> FullOptics:
    """The tables of a microscope at some depths, by exact rays; a second each, and the last ones are kept.

    They are constants to JAX: derivatives of an image by the lens centres and the sensor's distance move the spots and
    leave their shapes. Whoever changes the lens makes new tables.

    Parameters
    ----------
    imager
        Its lens, the layout of its lenses and its sensor count; how it is turned or shifted does not.
    depths
        Of the planes, mm, in their order.
    extent
        Size of the object, mm: no light is followed that comes from farther off. By default the sensor's.
    nodes
        Of the halo, by `halo_nodes`: what is compiled for tables of some nodes serves others of the same. By default
        those that suit the depths.
    rings
        Where the rings of the field end that have a core each, in field radii. Fewer are faster and less true,
        such as `(1.0, 2.5)`.
    progress
        Shows how many depths are done.

    Examples
    --------
    >>> image = forward(volume, imager, grid, full_optics(imager, grid.depths))
    """
    depths = np.asarray(depths, np.float64)
    leaves, structure = jax.tree.flatten(imager)
    same = structure, *(np.asarray(leaf).tobytes() for leaf in (*leaves, depths))
    nodes = nodes or halo_nodes(imager, depths, extent=extent)
    return _tables(_Wanted(same, nodes, tuple(rings), imager, depths, progress))


@dataclasses.dataclass(frozen=True)
class _Wanted:
    """What tables are asked for; equal if the tables are."""

    same: tuple
    grid: HaloGrid
    rings: tuple[float, ...]
    imager: Imager = dataclasses.field(compare=False)
    depths: Float64[np.ndarray, " depth"] = dataclasses.field(compare=False)
    progress: Progress | None = dataclasses.field(compare=False)


# Capture after capture of a microscope has the same tables, one for each kind of lens; these are kept, some 80 MiB each
# at full scale.
@lru_cache(maxsize=4)
def _tables(wanted):
    imager, depths, grid, progress = wanted.imager, wanted.depths, wanted.grid, wanted.progress
    cores = core_tables(imager, depths, CORE_REACH * grid.pixel, wanted.rings, progress)
    halo = halo_of(imager, depths, grid, cores, wanted.rings, progress)
    size = kernel_size(imager, halo)
    kernel = np.stack([drawn(profile, size) for profile in cores.profile[:, 0]])
    outer = cores.profile[:, 1:]
    wide = np.stack([[drawn(profile, size // 4 * 2 + 1, 0.5) for profile in profiles] for profiles in outer])
    tables = (jnp.asarray(part, imager.sensor_distance.dtype) for part in (cores.stretch, cores.light, kernel, wide))
    stretch, light, kernel, wide = tables
    return FullOptics(stretch, light, kernel, wide, halo, wanted.rings)


def halo_nodes(imager: Imager, depths: Float64[np.ndarray, " depth"], *, extent: float | None = None) -> HaloGrid:
    """The halo's nodes for a range of depths and an object's extent, mm; by default the sensor's."""
    extent = extent or 2 * max(map(abs, imager.sensor.extent))
    farthest = float(jnp.abs(imager.array.centers).max()) + extent / 2
    return halo_grid(imager, depths, math.sqrt(2) * farthest)


def halo_of(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    grid: HaloGrid,
    cores: Cores,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> Halo:
    """What the cores leave of the light at each depth, theirs being those of rings with these ends, in field radii."""
    aperture = zones(imager.array)
    each = zip(depths, map(Cores, *cores), strict=True)
    tables = in_threads(lambda one: halo_table(imager, one[0], aperture, grid, one[1], ends), each)
    tracked = zip((progress or Progress()).track(depths, "Tracing halos"), tables, strict=True)
    table = np.stack([table for _, table in tracked])
    return Halo(
        jnp.asarray(table, imager.sensor_distance.dtype),
        jnp.mean(clear_area(imager.array)),
        imager.reduced_sensor_distance,
        grid,
    )


def kernel_size(imager: Imager, halo: Halo) -> int:
    """Pixels along a side of a core's kernel, odd."""
    return 2 * round(halo.reach / imager.sensor.pixel_pitch) + 1
