"""The field-varying PSF: all light that the lenses transmit, as tables for `gs_jax.forward`.

A spot is a sharp core (`gs_jax.optics.psf_core`) and stray light, which is everything else. Stray light has tables in
polar coordinates about the lens's axis. A round lens is symmetric under rotation: at a field `(rho, phi)` its spot is
the one at `(rho, 0)`, turned by `phi`. In polar coordinates on both sides imaging is therefore a convolution over the
angle: a small matrix over the radii maps each angular harmonic of the object to that of the image. The clear area of
each lens counts to first order.

Sparse tables resample between square nodes (or pixels) and polar ones.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int, Num

from ..base.caches import cache_by_value, cached_on_disk, key_of
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..base.workers import map_in_threads
from ..linear.sparse_table import SparseTable
from ..microscope.geometry import Imager
from .apertures import clear_area
from .psf_core import (
    HARMONICS,
    RINGS,
    PsfCores,
    half_light_radii,
    harmonic_shares,
    narrow_kernel,
    render_harmonics,
    render_kernel,
    ring_edges,
    ring_light,
    sample_profile,
    sharpen,
    trace_cores,
)
from .pupil import ApertureProfile, add_diffraction, aperture_profile, sample_pupil
from .raytrace import to_numpy

# Widest field, in reduced depths of the nearest plane: beyond, a lens transmits a third of its light and less.
_WIDEST = 0.9
# The object's nodes are evenly spaced up to about this part of the widest field, then exponentially; nodes in that
# part.
_LINEAR, _NODES = 0.45, 44
# How far beyond the widest field's chief ray light is followed on the sensor, in images of the widest field.
_BEYOND = 0.35
# Nodes around may be wider apart than outward by so much, so that their number is a power of two or three times one.
_WIDER = 1.1
# Tables and kernels have so many radii at once.
RADII = 8
# Inner rings of polar nodes, which are closer to each other than pixels.
_INNER_RINGS = 4


class PolarGrid(NamedTuple):
    """Polar nodes about a lens's axis, on the object's side and on the sensor's.

    `step`: spacing of the inner nodes in the object, mm; `pixel`: of those on the sensor. `bend`: radius from which on
    the spacing grows, in steps. `angles`, `fields`, `radii`: numbers of nodes around, and outward on either side.
    """

    step: float
    pixel: float
    bend: float
    angles: int
    fields: int
    radii: int

    def nodes(self, count: int) -> Float64[np.ndarray, " node"]:
        """Radii of the nodes, in steps. Where the spacing grows, it is that around."""
        return self.bend * np.sinh(np.arange(count) / self.bend)

    def areas(self, count: int) -> Float64[np.ndarray, " node"]:
        """Area of a node's cell, in squared steps."""
        edges = self.bend * np.sinh((np.arange(count + 1) - 0.5) / self.bend)
        edges[0] = 0
        return np.pi * np.diff(edges**2) / self.angles


def make_polar_grid(
    imager: Imager, depths: Float64[np.ndarray, " depth"], *, extent: float | None = None, coarser: int = 1
) -> PolarGrid:
    """Nodes of the stray light for a range of depths and an object's extent, mm; by default the sensor's.

    `coarser` is a factor by which they are farther apart.

    Fields are from the axes of the lenses, which lean if the array is tilted.
    """
    extent = extent or 2 * max(map(abs, imager.sensor.extent))
    lean = float(np.linalg.norm(to_numpy(imager).axis_offset(depths.max())))
    imager, height = imager.level()
    depths = depths - float(height)
    largest_field = math.sqrt(2) * (float(jnp.abs(imager.array.centers).max()) + extent / 2) + lean
    near = float(imager.reduced_depth(float(depths.min())))
    widest = min(_WIDEST * near, largest_field)
    middle = float(imager.magnification(float(depths.min() + depths.max()) / 2))
    linear = _LINEAR * _WIDEST * near
    # A whole number of pixels.
    pixels = max(round(coarser * middle * linear / _NODES / imager.sensor.pixel_pitch), 1)
    pixel = pixels * imager.sensor.pixel_pitch
    step = pixel / middle
    bend = linear / step
    count = lambda reach: math.ceil(bend * math.asinh(reach / bend)) + 2
    largest = float(imager.magnification(float(depths.min()))) / middle
    radii = math.ceil(count((1 + _BEYOND) * largest * widest / step) / RADII) * RADII
    around = math.log2(2 * math.pi * bend / _WIDER)
    angles = min(2 ** math.ceil(around), 3 * 2 ** math.ceil(around - math.log2(3)))
    return PolarGrid(step, pixel, bend, angles, count(widest / step), radii)


def polar_weights(
    grid: PolarGrid, count: int, x: Num[np.ndarray, " place"], y: Num[np.ndarray, " place"]
) -> tuple[Int[np.ndarray, " entry"], Int[np.ndarray, " entry"], Float64[np.ndarray, " entry"]]:
    """Bilinear weights of the four nodes around each place (in steps), as entries (place, node, weight).

    Places beyond the nodes, `count` outward, have no entries.
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


@lru_cache(maxsize=4)
def to_polar_table(polar_grid: PolarGrid) -> SparseTable:
    """From the square nodes about a lens to the polar ones: what each node holds is shared by the four around it."""
    reach = math.ceil(polar_grid.nodes(polar_grid.fields)[-2])
    node, polar, share = polar_weights(polar_grid, polar_grid.fields, *_square(reach))
    polar = _angle_first(polar_grid, polar_grid.fields, polar)
    side, polars = 2 * reach + 1, polar_grid.fields * polar_grid.angles
    return SparseTable.of(side, polar, node, share, (polars, side**2))


@lru_cache(maxsize=4)
def to_pixels_table(polar_grid: PolarGrid) -> SparseTable:
    """From polar nodes to the pixels about a lens: the density of light, interpolated, so that no ring loses any.

    Up to the radius `bend` nodes are closer around than pixels, and some are near no pixel: the nodes of a ring keep
    their light together, not each its own. About the axis they are closer outward, too, and are shared by the four
    pixels around them instead.
    """
    reach = math.ceil(polar_grid.nodes(polar_grid.radii)[-2])
    pixel, node, share = polar_weights(polar_grid, polar_grid.radii, *_square(reach))
    outer = (node >= _INNER_RINGS * polar_grid.angles) & (share > 0)
    pixel, node, share = pixel[outer], node[outer], share[outer]
    ring = node // polar_grid.angles
    total = np.bincount(ring, share, polar_grid.radii) / polar_grid.angles
    # The last rings are cut by the window's edge, and have no more light than that.
    share = share / np.where(ring < polar_grid.radii - 3, total[ring], polar_grid.areas(polar_grid.radii)[ring])
    parts = [(pixel, node, share), *_near_axis(polar_grid, reach)]
    pixel, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    node = _angle_first(polar_grid, polar_grid.radii, node)
    side, polars = 2 * reach + 1, polar_grid.radii * polar_grid.angles
    return SparseTable.of(side, pixel, node, share, (side**2, polars))


def _angle_first(polar_grid, radii, node):
    """Numbers of nodes `(radius, angle)` as those of `(angle, radius)`."""
    return node % polar_grid.angles * radii + node // polar_grid.angles


def _near_axis(polar_grid: PolarGrid, reach: int):
    """Entries (pixel, polar node, share) of the inner polar nodes, for each of the four pixels around them."""
    node = np.arange(_INNER_RINGS * polar_grid.angles)
    radius, angle = (
        polar_grid.nodes(_INNER_RINGS)[node // polar_grid.angles],
        2 * np.pi * (node % polar_grid.angles) / polar_grid.angles,
    )
    place = np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1) + reach
    whole = np.floor(place).astype(int)
    for corner in np.ndindex(2, 2):
        row, column = (whole + corner).T
        yield row * (2 * reach + 1) + column, node, np.where(corner, place - whole, 1 - (place - whole)).prod(-1)


def _square(reach: int):
    side = np.arange(-reach, reach + 1)
    y, x = np.meshgrid(side, side, indexing="ij")
    return x.ravel(), y.ravel()


# Reach of a core's kernel, in pixels of stray light: what is wider is smooth enough for these.
CORE_REACH = 5
# Rings whose cores have half of their light within so many of the sensor's pixels are computed on these.
_SHARP = 2.0
# Cores with half of their light within this part of the field radius's image are too sharp for one magnification in a
# wide ring, and for symmetric kernels: they get these rings, and harmonics.
_PRECISE = 0.012
_SHARP_RINGS = (0.35, 0.6, 0.8, 1.0, 1.17, 1.33, 1.5, 1.67, 2.0, 2.5, 3.0)
# The first rings of these have no harmonics: coma and astigmatism grow with the field.
_PLAIN = 3
# What the model adds to the width of a core, as a variance in squared pixels each way: four pixels share the light of a
# chief ray (the mean over its places); and large pixels stand for those of half their width.
_SHARED, _LARGE = 1 / 6, 1 / 12 - 1 / 48
# Order of the low-pass filter of angular harmonics, which ends where a wave is two pixels.
_FILTER_ORDER = 8
# Part of the stray light's root mean square that its tables leave out, but not of the first harmonics, which hold the
# light. Its change with the clear area counts as for lenses that differ by this part or more.
_LEFT_OUT, _WHOLE, _LEAST_SPREAD = 0.005, 4, 0.1
# Rays of each field, and samples of a core.
_RAYS, _CORE_SAMPLES = 8192, 2048


class StrayLight(eqx.Module):
    """All light but the cores', at some depths; made by `trace_stray_light`.

    `table`: of `stray_light_table`, for each depth. `area`: mean clear area of the lenses, mm^2. `sensor_distance`: of
    the tables, `v'`, mm. `to_polar`, `to_pixels`: between square and polar nodes. `grid`: the nodes.
    """

    table: Float[Array, "depth harmonic block order field radius"]
    area: Float[Array, ""]
    sensor_distance: Float[Array, ""]
    to_polar: SparseTable
    to_pixels: SparseTable
    grid: PolarGrid = eqx.field(static=True)

    @classmethod
    def on(cls, grid: PolarGrid, table, area, sensor_distance) -> "StrayLight":
        """Stray light on these nodes."""
        return cls(table, area, sensor_distance, to_polar_table(grid), to_pixels_table(grid), grid)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arguments of `on` besides the nodes, for a file."""
        return {name: np.asarray(getattr(self, name)) for name in ("table", "area", "sensor_distance")}


class FieldVaryingPsf(eqx.Module):
    """Where all of a point's light goes, at some depths; made by `field_varying_psf`.

    `distortion`: magnification of the cores over the chief ray's. `light`: coefficients of `ring_light`. `kernels`: of
    the inner rings, on the sensor's pixels, with the sum 1. `wide_kernels`: of the outer rings, on pixels twice as
    large. `harmonics` and `wide_harmonics`: the kernels of `cos t`, `sin t`, `cos 2t` and `sin 2t` for those of the
    rings that have them, which are the last; `t` is the angle from the field's direction (`PsfCores`). `rings`: outer
    radii of the rings, in field radii. `windows`: sides of the squares of pixels, of inner and outer rings, in which
    each lens shows all voxels of a small grid, or 0, and `widest` the width of the grids that fit into them, mm; both
    set by `psf_model`.
    """

    distortion: Float[Array, "depth ring"]
    light: Float[Array, "depth ring coefficient"]
    kernels: Float[Array, "depth inner size size"]
    wide_kernels: Float[Array, "depth outer small small"]
    harmonics: Float[Array, "depth oriented wave size size"]
    wide_harmonics: Float[Array, "depth wide_oriented wave small small"]
    stray_light: StrayLight
    rings: tuple[float, ...] = eqx.field(static=True)
    windows: tuple[int, int] = eqx.field(static=True, default=(0, 0))
    widest: Float[Array, ""] | None = None


def field_varying_psf(
    imager: Imager,
    depths: Sequence[float] | Float[Array | np.ndarray, " depth"],
    *,
    extent: float | None = None,
    polar_grid: PolarGrid | None = None,
    rings: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> FieldVaryingPsf:
    """Trace the tables of a microscope at some depths: a second each. They are kept in the user's cache folder.

    They are constants to JAX: derivatives by the lens centres and the sensor's distance move the spots and leave their
    shapes. For another lens, make new tables.

    Parameters
    ----------
    imager
        Its lens, layout and sensor count, and the mean height of its lenses if it is tilted; its rotation and shift do
        not.
    depths
        Of the planes, mm, in their order.
    extent
        Size of the object, mm: light from farther off is not followed. By default the sensor's.
    polar_grid
        Nodes of the stray light, by `make_polar_grid`: tables with the same nodes share compiled programs.
    rings
        Outer radii of the field's rings, in field radii; each has a core of its own. By default six, or eleven if cores
        are sharp, which have coma and astigmatism from 0.8 field radii on. Fewer, such as `(1.0, 2.5)`, are faster and
        less accurate. Those that are given have symmetric cores, and if they are beyond the field radius, pixels twice
        as large, so that microscopes with the same nodes and rings share compiled programs.
    progress
        Shows how many depths are done.

    Raises
    ------
    InputError
        If `rings` are not two or more that ascend.

    Examples
    --------
    >>> image = forward(volume, imager, grid, field_varying_psf(imager, grid.depths))
    """
    rings = None if rings is None else tuple(rings)
    if rings is not None and (len(rings) < 2 or not (np.diff((0.0, *rings)) > 0).all()):
        raise InputError(f"rings must be two or more radii that ascend, got {short_repr(rings)}.")
    depths = np.asarray(depths, np.float64)
    polar_grid = polar_grid or make_polar_grid(imager, depths, extent=extent)
    imager, height = imager.level()
    depths = depths - float(height)
    return _tables(imager, depths, polar_grid, rings, progress=progress)


# Captures of a microscope share tables, one for each type of lens; 80 MiB each at full scale.
@cache_by_value(maxsize=4)
def _tables(imager: Imager, depths, grid: PolarGrid, rings, *, progress: Progress | None) -> FieldVaryingPsf:
    """The tables of a level imager, of this process or from the disk."""
    key = key_of((imager, depths, grid, rings))
    arrays = cached_on_disk(key, lambda: _trace_tables(imager, depths, grid, rings, progress))
    rings = tuple(arrays.pop("rings").tolist())
    dtype = imager.sensor_distance.dtype
    # Not `jnp.asarray`, which compiles a program for each shape.
    tables = {name: jax.device_put(np.asarray(array, dtype)) for name, array in arrays.items()}
    stray_light = StrayLight.on(grid, tables["table"], tables["area"], tables["sensor_distance"])
    names = "distortion", "light", "kernels", "wide_kernels", "harmonics", "wide_harmonics"
    return FieldVaryingPsf(**{name: tables[name] for name in names}, stray_light=stray_light, rings=rings)


def _trace_tables(imager: Imager, depths, grid: PolarGrid, given, progress) -> dict[str, np.ndarray]:
    """Arrays of `FieldVaryingPsf` and its `StrayLight`, by name; by default the cores decide on the rings."""
    sharp = not given and has_sharp_cores(imager, depths, grid)
    rings = given or (_SHARP_RINGS if sharp else RINGS)
    cores = trace_cores(imager, depths, CORE_REACH * grid.pixel, rings, progress, oriented=sharp)
    cores.harmonics[:, :_PLAIN] = 0
    stray_light = trace_stray_light(imager, depths, grid, cores, rings, progress)
    size = kernel_size(imager, grid)
    # Of each kind of pixels there is one ring at least.
    fine = half_light_radii(cores) < _SHARP if given is None else np.array(rings) <= 1
    inner = 1 + int(np.argmin(np.append(fine[1:-1], False)))
    # The first ring with harmonics.
    oriented = _PLAIN if sharp else len(rings)
    small, large = size // 4 * 2 + 1, _SHARED + _LARGE
    arrays = {"distortion": cores.distortion, "light": cores.light, "rings": np.array(rings)}
    arrays["kernels"] = _kernels(cores, slice(inner), size, 1, _SHARED)
    arrays["wide_kernels"] = _kernels(cores, slice(inner, None), small, 0.5, large)
    arrays["harmonics"] = _harmonics(cores, slice(oriented, inner), size, 1, _SHARED)
    arrays["wide_harmonics"] = _harmonics(cores, slice(max(oriented, inner), None), small, 0.5, large)
    return arrays | stray_light.arrays()


def has_sharp_cores(imager: Imager, depths: Float64[np.ndarray, " depth"], grid: PolarGrid) -> bool:
    """Whether cores within the field radius are so sharp, at one of the depths, that they are to be oriented."""
    half = half_light_radii(trace_cores(imager, depths, CORE_REACH * grid.pixel, RINGS[:1])) * imager.sensor.pixel_pitch
    return bool(half[0] < _PRECISE * imager.field_radius * grid.pixel / grid.step)


def _kernels(
    cores: PsfCores, rings: slice, size: int, parts: float | int, variance: float
) -> Float64[np.ndarray, "depth ring size size"]:
    """Kernels of rings, narrower by a variance, on pixels of which one is `parts` of the sensor's."""
    make = lambda profile: narrow_kernel(render_kernel(profile, size, parts), variance)
    return np.array([[make(profile) for profile in at_depth] for at_depth in cores.profile[:, rings]])


def _harmonics(
    cores: PsfCores, rings: slice, size: int, parts: float | int, variance: float
) -> Float64[np.ndarray, "depth ring wave size size"]:
    """`_kernels` of the harmonics."""
    profiles, harmonics = cores.profile[:, rings], cores.harmonics[:, rings]
    kernels = np.zeros((*profiles.shape[:2], 2 * harmonics.shape[2], size, size))
    for place in np.ndindex(profiles.shape[:2]):
        kernels[place] = sharpen(render_harmonics(profiles[place], harmonics[place], size, parts), variance)
    return kernels


def kernel_size(imager: Imager, grid: PolarGrid) -> int:
    """Pixels along a side of a core's kernel, odd."""
    return 2 * round(CORE_REACH * grid.pixel / imager.sensor.pixel_pitch) + 1


def trace_stray_light(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    grid: PolarGrid,
    cores: PsfCores,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> StrayLight:
    """The light at each depth that is not the cores', whose rings end at `ends`, in field radii."""
    aperture = aperture_profile(imager.array)
    each = zip(depths, map(PsfCores, *cores), strict=True)
    tables = map_in_threads(lambda one: stray_light_table(imager, one[0], aperture, grid, one[1], ends), each)
    tracked = zip((progress or Progress()).track(depths, "Tracing stray light"), tables, strict=True)
    table = jax.device_put(np.stack([table for _, table in tracked]).astype(imager.sensor_distance.dtype))
    return StrayLight.on(grid, table, jnp.mean(clear_area(imager.array)), imager.reduced_sensor_distance)


def stray_light_table(
    imager: Imager,
    depth: float,
    aperture: ApertureProfile,
    grid: PolarGrid,
    cores: PsfCores,
    ends: Sequence[float] = RINGS,
) -> Float32[np.ndarray, "harmonic block order field radius"]:
    """Maps each harmonic of the object over the fields to the image's over the radii, at one depth.

    Order 0 is the mean lens, less its cores; order 1 its change with the clear area, 1/mm^2. The image is the adjoint
    of the Fourier transform of these harmonics. What is far from a field's core or smooth is zero in most harmonics:
    blocks of `RADII` numbers that together have `_LEFT_OUT` of the light's root mean square are left out.
    """
    fields = grid.step * grid.nodes(grid.fields)
    rays = add_diffraction(imager, sample_pupil(imager, depth, fields, aperture, _RAYS), aperture)
    chief = float(imager.magnification(float(depth)))
    table, orders = np.zeros((2, grid.fields, grid.radii * grid.angles)), 1 + int(aperture.by_area.any())
    for number, landing in enumerate(rays.landing):
        lights = (rays.light[number], rays.light_per_area[number])[:orders]
        table[:orders, number] = _bin_polar(grid, landing, *lights)
    for (inner, outer), distortion, light, profile, harmonics in zip(ring_edges(imager, ends), *cores, strict=True):
        amount = ring_light(fields**2, light, inner, outer)
        core = sample_profile(profile, _CORE_SAMPLES)
        shares = harmonic_shares(core, profile, harmonics)
        for number in np.flatnonzero(amount):
            landing = imager.sensor.pixel_pitch * core - [chief * distortion * fields[number], 0]
            part = np.ones(len(core))
            for order, (along, _) in zip(HARMONICS, shares, strict=False):
                part += (fields[number] / outer) ** order * along
            table[0, number] -= _bin_polar(grid, landing, amount[number] / len(core) * part)[0]
    around = table.reshape(2, grid.fields, grid.radii, grid.angles)
    # Spots are symmetric about the field's direction: their spectra are real. Near the axis nodes are closer together
    # than pixels, so that high harmonics would alias.
    finest = np.pi * np.maximum(grid.nodes(grid.radii), 0.5)
    low_pass = 1 / (1 + (np.arange(grid.angles // 2 + 1) / finest[:, None]) ** _FILTER_ORDER)
    spectra = np.fft.rfft(around).real * low_pass
    # The image lies opposite to the object, half a turn away; all harmonics but the first and last count twice.
    count = np.full(spectra.shape[-1], 2.0)
    count[[0, -1]] = 1
    table = (spectra * (count / grid.angles * (-1.0) ** np.arange(len(count)))).transpose(3, 0, 1, 2)
    table = table.reshape(*table.shape[:3], -1, RADII)  # harmonic, order, field, block, radius
    clear = np.asarray(clear_area(imager.array))
    spread = max(np.std(clear), _LEAST_SPREAD * np.mean(clear))
    areas = grid.areas(grid.radii).reshape(-1, RADII)
    orders, fields = np.array([1, spread**2]), grid.areas(grid.fields)
    energy = np.einsum("h,hofbr,o,f,br->hofb", 1 / count, table**2, orders, fields, 1 / areas)
    ascending = np.sort(energy, None)
    few = np.searchsorted(np.cumsum(ascending), _LEFT_OUT**2 * ascending.sum())
    kept = energy >= ascending[min(few, ascending.size - 1)]
    kept[:_WHOLE] = True
    return (table * kept[..., None]).transpose(0, 3, 1, 2, 4).astype(np.float32)


def _bin_polar(grid, landing, *lights):
    """Each of several lights of rays on the polar nodes, `(radius angle)`."""
    x, y = -landing.T / grid.pixel
    ray, node, share = polar_weights(grid, grid.radii, x, y)
    return [np.bincount(node, light[ray] * share, grid.radii * grid.angles) for light in lights]
