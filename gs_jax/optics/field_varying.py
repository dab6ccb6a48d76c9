"""All of a spot's light that is not its core, out to where light ends: tables in polar coordinates about the lens.

A round lens turns with the point that it images: at a field `(rho, phi)` its spot is the one at `(rho, 0)`, turned by
`phi`. So in polar coordinates about the lens's axis, on both sides, the image is a convolution over the angle: each
angular harmonic of the object becomes the same harmonic of the image by a small matrix over the radii, without a limit
on the rank. A lens's own clear area counts to first order.

All of the light that lenses pass on, as tables: what `gs_jax.forward` needs for the true image of a volume."""

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int, Num

from ..base.machine import in_threads
from ..base.progress import Progress
from ..geometry import Imager
from .psf_core import (
    RINGS,
    ApertureProfile,
    PsfCores,
    add_diffraction,
    aperture_profile,
    clear_area,
    render_kernel,
    ring_edges,
    ring_light,
    sample_profile,
    sample_pupil,
    trace_cores,
)

# Widest field, in reduced depths of the nearest plane: beyond, a lens passes on a third of its light and less.
_WIDEST = 0.9
# Radii of the object's nodes grow linearly up to about this part of the widest field, then exponentially.
_LINEAR = 0.45
# Nodes in the linear part. The nodes' distance at the sensor is the halo's pixel.
_NODES = 44
# How far beyond the widest field's chief ray light is followed on the sensor, in the image of the widest field.
_BEYOND = 0.35
# How steeply angular harmonics end where waves of two pixels do.
_STEEP = 8
# Of each field; samples of a core.
_HALO_RAYS, _CORE_SAMPLES = 16384, 2048


class PolarGrid(NamedTuple):
    """Polar nodes about a lens's axis, on the object's side and on the sensor's.

    `step`: distance of the inner nodes in the object, mm; `pixel`: of those on the sensor. `bend`: radius at which
    they begin to spread, in steps. `angles`, `fields`, `radii`: numbers of nodes, around and outward on either
    side.
    """

    step: float
    pixel: float
    bend: float
    angles: int
    fields: int
    radii: int

    def nodes(self, count: int) -> Float64[np.ndarray, " node"]:
        """Radii of the nodes, in steps: as far apart as they are around, where they spread."""
        return self.bend * np.sinh(np.arange(count) / self.bend)

    def areas(self, count: int) -> Float64[np.ndarray, " node"]:
        """Area of a node's cell, in squared steps."""
        edges = self.bend * np.sinh((np.arange(count + 1) - 0.5) / self.bend)
        edges[0] = 0
        return np.pi * np.diff(edges**2) / self.angles


def _polar_grid(imager: Imager, depths: Float64[np.ndarray, " depth"], most: float) -> PolarGrid:
    """Nodes for a range of depths.

    Parameters
    ----------
    imager
        Its sensor and magnification decide.
    depths
        Of the object, mm.
    most
        The largest field that occurs, mm: no point is farther from a lens.
    """
    near = float(imager.reduced_depth(float(depths.min())))
    widest = min(_WIDEST * near, most)
    middle = float(imager.magnification(float(depths.min() + depths.max()) / 2))
    linear = _LINEAR * _WIDEST * near
    # A whole number of pixels.
    pixels = max(round(middle * linear / _NODES / imager.sensor.pixel_pitch), 1)
    pixel = pixels * imager.sensor.pixel_pitch
    step = pixel / middle
    bend = linear / step
    count = lambda reach: math.ceil(bend * math.asinh(reach / bend)) + 2
    largest = float(imager.magnification(float(depths.min()))) / middle
    radii = count((1 + _BEYOND) * largest * widest / step)
    return PolarGrid(step, pixel, bend, 4 * round(2 * math.pi * bend / 4), count(widest / step), radii)


def stray_light_table(
    imager: Imager,
    depth: float,
    aperture: ApertureProfile,
    grid: PolarGrid,
    cores: PsfCores,
    ends: Sequence[float] = RINGS,
) -> Float32[np.ndarray, "kind harmonic radius field"]:
    """From each object harmonic over the fields to the image's over the radii, at one depth.

    The first kind is that of a mean lens, less its cores; the second is what it changes by with the clear area, 1/mm^2.
    An object in the direction `phi` is imaged in the opposite one, from which the image's angle counts.
    """
    fields = grid.step * grid.nodes(grid.fields)
    rays = add_diffraction(imager, sample_pupil(imager, depth, fields, aperture, _HALO_RAYS))
    chief = float(imager.magnification(float(depth)))
    table = np.zeros((2, grid.fields, grid.radii * grid.angles))
    share = lambda landing, light: np.stack([_shared(grid, *one) for one in zip(landing, light, strict=True)])
    table[0] = share(rays.landing, rays.light)
    if aperture.by_area.any():
        table[1] = share(rays.landing, rays.light_per_area)
    for (inner, outer), distortion, light, profile in zip(ring_edges(imager, ends), *cores, strict=True):
        # The share of a core's light that a lens has at each field.
        amount = np.asarray(ring_light(fields**2, light, inner, outer), np.float64)
        core = imager.sensor.pixel_pitch * sample_profile(profile, _CORE_SAMPLES)
        for field in np.flatnonzero(amount):
            landing = core - [chief * distortion * fields[field], 0]
            table[0, field] -= _shared(grid, landing, np.full(len(core), amount[field] / len(core)))
    around = table.reshape(2, grid.fields, grid.radii, grid.angles)
    # Spots are symmetric about the field's direction: their spectra are real.
    spectra = np.fft.rfft(around).real * _resolved(grid)
    return spectra.transpose(0, 3, 2, 1).astype(np.float32)


def _resolved(grid: PolarGrid) -> Float64[np.ndarray, "radius harmonic"]:
    """Near the axis nodes are closer together than pixels, which would sample what they cannot resolve."""
    finest = np.pi * np.maximum(grid.nodes(grid.radii), 0.5)
    return 1 / (1 + (np.arange(grid.angles // 2 + 1) / finest[:, None]) ** _STEEP)


def polar_weights(
    grid: PolarGrid, count: int, x: Num[np.ndarray, " place"], y: Num[np.ndarray, " place"]
) -> tuple[Int[np.ndarray, " entry"], Int[np.ndarray, " entry"], Float64[np.ndarray, " entry"]]:
    """How the four nodes around each place share it, bilinearly in the nodes' numbers: (place, node, share).

    Places are in steps; of those beyond the nodes, `count` outward, there are no entries.
    """
    outward = grid.bend * np.arcsinh(np.hypot(x, y) / grid.bend)
    place = np.flatnonzero(outward < count - 1)
    outward = outward[place]
    turned = np.arctan2(y, x)[place] * (grid.angles / (2 * np.pi)) % grid.angles
    radius, around = outward.astype(int), turned.astype(int)
    parts = []
    for step, turn in np.ndindex(2, 2):
        node = (radius + step) * grid.angles + (around + turn) % grid.angles
        share = np.abs(1 - step - (outward - radius)) * np.abs(1 - turn - (turned - around))
        parts.append((place, node, share))
    place, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    return place, node, share


def _shared(grid, landing, light):
    """Light of rays on the polar nodes, `(radius angle)`."""
    x, y = -landing.T / grid.pixel
    ray, node, share = polar_weights(grid, grid.radii, x, y)
    return np.bincount(node, light[ray] * share, grid.radii * grid.angles)


# Reach of a core's kernel, in the halo's pixels: what is wider is smooth enough for them.
CORE_REACH = 5


class StrayLight(eqx.Module):
    """All light but the cores', at some depths; made by `trace_stray_light`.

    Parameters
    ----------
    table
        Of `gs_jax.optics.field_varying.stray_light_table`, one a depth.
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
    grid: PolarGrid = eqx.field(static=True)

    @property
    def reach(self) -> float:
        """Of a core's kernel, mm."""
        return CORE_REACH * self.grid.pixel


class FieldVaryingPsf(eqx.Module):
    """Where all of a point's light goes, at some depths; made by `field_varying_psf`.

    A lens's spot has a core, sharp, where the field is not too wide, and a halo, which is everything else. Cores
    are splatted ring by ring, and each ring has one kernel. The halo is computed on coarse pixels.

    Parameters
    ----------
    distortion
        Magnification of the cores, over the chief ray's.
    light
        Coefficients of `gs_jax.optics.psf_core.ring_light`.
    kernel
        Of the inner ring, on the sensor's pixels, with the sum 1.
    wide_kernels
        Of the outer rings, on pixels twice as large.
    stray_light
        The rest.
    rings
        Where the rings end, in field radii.
    """

    distortion: Float[Array, "depth ring"]
    light: Float[Array, "depth ring coefficient"]
    kernel: Float[Array, "depth size size"]
    wide_kernels: Float[Array, "depth outer small small"]
    stray_light: StrayLight
    rings: tuple[float, ...] = eqx.field(static=True)


def field_varying_psf(
    imager: Imager,
    depths: Sequence[float] | Float[Array | np.ndarray, " depth"],
    *,
    extent: float | None = None,
    polar_grid: PolarGrid | None = None,
    rings: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> FieldVaryingPsf:
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
    polar_grid
        Of the stray light, by `make_polar_grid`: what is compiled for tables of some nodes serves others of the same.
        By default those that suit the depths.
    rings
        Where the rings of the field end that have a core each, in field radii. Fewer are faster and less true,
        such as `(1.0, 2.5)`.
    progress
        Shows how many depths are done.

    Examples
    --------
    >>> image = forward(volume, imager, grid, field_varying_psf(imager, grid.depths))
    """
    depths = np.asarray(depths, np.float64)
    leaves, structure = jax.tree.flatten(imager)
    same = structure, *(np.asarray(leaf).tobytes() for leaf in (*leaves, depths))
    polar_grid = polar_grid or make_polar_grid(imager, depths, extent=extent)
    return _tables(_Wanted(same, polar_grid, tuple(rings), imager, depths, progress))


@dataclasses.dataclass(frozen=True)
class _Wanted:
    """What tables are asked for; equal if the tables are."""

    same: tuple
    grid: PolarGrid
    rings: tuple[float, ...]
    imager: Imager = dataclasses.field(compare=False)
    depths: Float64[np.ndarray, " depth"] = dataclasses.field(compare=False)
    progress: Progress | None = dataclasses.field(compare=False)


# Capture after capture of a microscope has the same tables, one for each type of lens; these are kept, some 80 MiB each
# at full scale.
@lru_cache(maxsize=4)
def _tables(wanted):
    imager, depths, grid, progress = wanted.imager, wanted.depths, wanted.grid, wanted.progress
    cores = trace_cores(imager, depths, CORE_REACH * grid.pixel, wanted.rings, progress)
    halo = trace_stray_light(imager, depths, grid, cores, wanted.rings, progress)
    size = kernel_size(imager, halo)
    kernel = np.stack([render_kernel(profile, size) for profile in cores.profile[:, 0]])
    outer = cores.profile[:, 1:]
    wide = np.stack([[render_kernel(profile, size // 4 * 2 + 1, 0.5) for profile in profiles] for profiles in outer])
    tables = (jnp.asarray(part, imager.sensor_distance.dtype) for part in (cores.distortion, cores.light, kernel, wide))
    distortion, light, kernel, wide = tables
    return FieldVaryingPsf(distortion, light, kernel, wide, halo, wanted.rings)


def make_polar_grid(imager: Imager, depths: Float64[np.ndarray, " depth"], *, extent: float | None = None) -> PolarGrid:
    """The halo's nodes for a range of depths and an object's extent, mm; by default the sensor's."""
    extent = extent or 2 * max(map(abs, imager.sensor.extent))
    farthest = float(jnp.abs(imager.array.centers).max()) + extent / 2
    return _polar_grid(imager, depths, math.sqrt(2) * farthest)


def trace_stray_light(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    grid: PolarGrid,
    cores: PsfCores,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> StrayLight:
    """What the cores leave of the light at each depth, theirs being those of rings with these ends, in field radii."""
    aperture = aperture_profile(imager.array)
    each = zip(depths, map(PsfCores, *cores), strict=True)
    tables = in_threads(lambda one: stray_light_table(imager, one[0], aperture, grid, one[1], ends), each)
    tracked = zip((progress or Progress()).track(depths, "Tracing halos"), tables, strict=True)
    table = np.stack([table for _, table in tracked])
    return StrayLight(
        jnp.asarray(table, imager.sensor_distance.dtype),
        jnp.mean(clear_area(imager.array)),
        imager.reduced_sensor_distance,
        grid,
    )


def kernel_size(imager: Imager, halo: StrayLight) -> int:
    """Pixels along a side of a core's kernel, odd."""
    return 2 * round(halo.reach / imager.sensor.pixel_pitch) + 1
