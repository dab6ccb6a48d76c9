"""Scenes to image, and synthetic captures: the noiseless image on the sensor, and a camera's noise and counts.

A scene is `(emitter, 4)`, rows of `(x, y, z, intensity)`, in mm and the frame of the imager; `np.concatenate` joins
scenes. Areas and volumes are filled with emitters, whose intensity is the area (mm^2) or volume (mm^3) that each stands
for: brightness does not depend on their spacing, `pitch`, the largest distance of neighbouring emitters in mm. Scenes
are made in NumPy, volumes in JAX. Lengths and counts out of range raise `InputError`.
"""

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Float32, PRNGKeyArray, UInt8, UInt16
from PIL import Image, ImageDraw, ImageFont

from .base.arrays import NOT_NEGATIVE, POSITIVE, as_float, check_fields, check_finite, host_code, jit, native
from .base.errors import InputError, input_error, short_repr
from .base.machine import available_memory
from .base.progress import Progress
from .base.typing import Number, PathLike
from .io.point_tables import read_scene_points
from .io.volumes import read_volume
from .microscope.geometry import Imager, check_beyond
from .microscope.grid import Grid, Sensor
from .microscope.layouts import check_positive, half_size
from .microscope.media import object_index
from .optics.apertures import relative_areas, split_groups
from .optics.field_varying import field_varying_psf, make_polar_grid
from .optics.psf import PSFS, psf_of_depth
from .projection.forward_model import FIDELITIES, forward
from .projection.point_sources import STEPS, forward_points, full_image_of_points, make_stamps

Emitters = Float[np.ndarray, "emitter 4"]

# Smallest height of rendered text in pixels, as Pillow fits letters to whole pixels.
_LEAST_ROWS = 600


def random_points(count: int, size: Sequence[Number], depth_range: Sequence[Number], *, seed: int = 0) -> Emitters:
    """Points of intensity 1, uniform in a box of the size `(x, y)` on the axis and the depths `(near, far)`, mm."""
    return as_emitters(uniform_points(count, half_size(size), check_range(depth_range), seed).T, 1)


def letters(text: str, *, depth: Number, height: Number, pitch: Number) -> Emitters:
    """Glowing text, one line or more, upright in an image with row 0 at the top, its middle on the axis.

    In Pillow's own font, with capitals of a `height`, in the plane `depth`, mm.
    """
    for name, length in (("depth", depth), ("height", height), ("pitch", pitch)):
        check_positive(name, length)
    rows = math.ceil(height / pitch)
    parts = math.ceil(_LEAST_ROWS / rows)
    ink = _render_text(text, rows * parts * 1000 / len(_render_text("H", 1000)))
    if not ink.any():
        raise InputError(f"`text` must have a visible character, got {text!r}.")
    padded, square = np.pad(ink, [(0, -n % parts) for n in ink.shape]), height / rows
    covered = padded.reshape(len(padded) // parts, parts, -1, parts).mean(axis=(1, 3))
    row, column = np.nonzero(covered)
    y, x = (square * (at + 0.5 - n / (2 * parts)) for at, n in zip((row, column), ink.shape, strict=True))
    return as_emitters([x, y, depth], covered[row, column] * square**2)


def rasterize(emitters: Float[Array | np.ndarray, "emitter 4"], grid: Grid) -> Float[Array, "depth y x"]:
    """The volume that a scene makes on a grid: linear weights along x, y and z.

    *Host.*

    The weights of an emitter between voxel centres keep its total and its centroid. In the outer half of a voxel at the
    grid's edge all goes to that voxel; what lies beyond is left out. Of a single depth, voxels are as thick as
    `grid.pitch`. Differentiable with respect to the emitters and the depths.

    Parameters
    ----------
    emitters, grid
        The scene, and the voxels, whose depths ascend, evenly or not. The volume has the grid's type.

    Raises
    ------
    ValueError
        If the depths do not ascend or a number is not finite (values traced by JAX are not checked).

    Examples
    --------
    >>> volume = gs.rasterize(np.array([[0.05, 0.0, 21.0, 1.0]]), grid)  # between two voxels and two planes
    >>> print(round(float(volume.sum()), 3), int((volume > 0.2).sum()))
    1.0 4
    """
    depths = grid.depths
    if not isinstance(depths, Tracer) and not (np.diff(np.asarray(depths)) > 0).all():
        raise ValueError(f"`grid.depths` must ascend, got {short_repr(depths.tolist())}.")
    if isinstance(emitters, Tracer):
        return _rasterize(emitters.astype(depths.dtype), grid)
    emitters = np.asarray(emitters, depths.dtype)
    if not (finite := np.isfinite(emitters).all(axis=1)).all():
        raise ValueError(f"`emitters` must be finite, got {emitters[np.argmin(finite)].tolist()}.")
    # Dark ones make it a power of two: scenes of about as many emitters share a program.
    size = 1 << max(len(emitters) - 1, 0).bit_length()
    return _rasterize(np.pad(emitters, [(0, size - len(emitters)), (0, 0)]), grid)


@jax.jit
def _rasterize(emitters, grid):
    x, y, z, intensity = jnp.asarray(emitters, grid.depths.dtype).T
    shape = grid.volume_shape
    places = ((y - grid.origin[1], grid.shape[0]), (x - grid.origin[0], grid.shape[1]))
    row, column = (at / grid.pitch + (n - 1) / 2 for at, n in places)
    axes = [_shares(index, n) for index, n in zip((_depth_index(z, grid), row, column), shape, strict=True)]
    volume = jnp.zeros(shape, intensity.dtype)
    for corner in product(*axes):
        indices, weights = zip(*corner, strict=True)
        volume = volume.at[indices].add(intensity * math.prod(weights), mode="drop")
    return volume


def _depth_index(z, grid):
    """Fractional index of a depth: linear between the grid's depths, and beyond them as between the last two."""
    depths = grid.depths
    if depths.size == 1:
        return (z - depths[0]) / grid.pitch
    below = jnp.clip(jnp.searchsorted(depths, z, side="right") - 1, 0, depths.size - 2)
    return below.astype(z.dtype) + (z - depths[below]) / jnp.diff(depths)[below]


def _shares(index, size):
    """The two neighbours of fractional indices along an axis, as `(index, weight)`; zero weight off the axis."""
    inside = ((index >= -0.5) & (index <= size - 0.5)).astype(index.dtype)
    index = jnp.clip(index, 0, size - 1)
    below = jnp.clip(jnp.floor(index), 0, max(size - 2, 0))
    fraction, below = index - below, below.astype(jnp.int32)
    return (below, inside * (1 - fraction)), (below + 1, inside * fraction)


def check_range(depth_range) -> tuple[float, float]:
    """The depths `(near, far)`, mm, as floats; `InputError` unless they are positive and ascend."""
    if len(depth_range) != 2 or not 0 < depth_range[0] <= depth_range[1] < math.inf:
        raise InputError(f"`depth_range` must be (near, far), positive and ascending, mm, got {tuple(depth_range)}.")
    return float(depth_range[0]), float(depth_range[1])


def uniform_points(count, half, depth_range, seed):
    """Random points `(point, 3)` of a box from `-half` to `half` (x, y), and of a range of depths."""
    if count < 1:
        raise InputError(f"`count` must be 1 or more, got {count}.")
    return np.random.default_rng(seed).uniform([*-half, depth_range[0]], [*half, depth_range[1]], (count, 3))


def as_emitters(xyz, intensity) -> Emitters:
    """Emitters of coordinates and intensities that broadcast."""
    return np.stack(np.broadcast_arrays(*xyz, intensity), axis=1, dtype=float)


def _render_text(text, font_size):
    """Coverage, 0 to 1, of each pixel `(row, column)` of a text's bounding box."""
    font = ImageFont.load_default(size=font_size)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font)
    page = Image.new("L", (math.ceil(right - left) + 2, math.ceil(bottom - top) + 2))
    ImageDraw.Draw(page).text((1 - left, 1 - top), text, fill=255, font=font)
    return np.asarray(page.crop(page.getbbox())) / 255


Counts = UInt8[Array | np.ndarray, "row column"] | UInt16[Array | np.ndarray, "row column"]

# Chief rays alone make no image of a point.
OPTICS = tuple(level for level in FIDELITIES if level != "pinhole")
# Spacing of the reduced depths at which the PSF of points is computed, mm: between, it changes by less than a pixel's
# width; and the number of these depths held in memory at once.
_STEP, _SLAB = 0.1, 48
# Largest intensity, such that float32 holds sums of many.
MAX_LIGHT = 1e30
# Mean from which `poisson` uses an expansion. The first term of the sum below is larger than `_poisson_by_sum` needs.
EXPANDED = 16.0
# Rows exposed at once: their data stay in the cache.
_ROWS = 16


def read_scene(path: PathLike) -> tuple[np.ndarray, Grid | None]:
    """Read a scene: points `(point, 4)` from a CSV file, else a volume with its grid."""
    if Path(path).suffix.lower() == ".csv":
        return read_scene_points(path), None
    return read_volume(path)


@host_code("use `forward` with a PSF that is computed from the lens")
def simulate(
    scene: Float[Array | np.ndarray, "..."],
    imager: Imager,
    grid: Grid | None = None,
    *,
    optics: str = "full",
    psf: str | None = None,
    progress: Progress | None = None,
) -> Float[np.ndarray, "row column"]:
    """The noiseless image of points or of a volume on the sensor; `expose` adds a camera's noise.

    *Host.*

    Parameters
    ----------
    scene
        Points `(point, 4)`, `(x, y, z, intensity)` in mm; or, with a grid, a volume of `grid.volume_shape`. Neither is
        negative.
    imager
        The microscope.
    grid
        Of a volume.
    optics
        "full": all light of every lens, by exact rays; intensities are what is emitted in all directions. "near":
        Eq. (2), one PSF for all lenses (of a type) within the field radius; intensities are what the mean lens on the
        axis gets.
    psf
        Of a lens, for "near": "diffraction" (the default), "geometric" (rays alone) or "gaussian", from slow to fast.
    progress
        Shows the progress.

    Raises
    ------
    InputError
        If an option does not exist, a voxel is negative, an intensity is above 1e30, a number is not finite, a point's
        depth is not positive, a depth is before the object's medium, the work does not fit into the memory, or a depth
        is blurred over more than 128 pixels each way ("near").

    Examples
    --------
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> image.shape
    (200, 200)
    """
    if optics not in OPTICS:
        raise InputError(f"`optics` must be one of {', '.join(OPTICS)}, got {short_repr(optics)}.")
    if psf and optics == "full":
        raise InputError(f'`psf` needs optics "near", which has one PSF; got {short_repr(psf)} with "full".')
    if psf not in (None, *PSFS):
        raise InputError(f"`psf` must be one of {', '.join(PSFS)}, got {short_repr(psf)}.")
    _check_shape(np.shape(scene), grid)
    check_beyond(imager, np.asarray(scene)[:, 2] if grid is None else np.asarray(grid.depths), "scene: depths")
    light = np.asarray(scene)[:, 3] if grid is None else np.asarray(scene)
    if light.size and (most := float(np.max(light))) > MAX_LIGHT:
        raise input_error("scene: intensity", f"at most {MAX_LIGHT:g}", f"{most:g}")
    kind = "full" if optics == "full" else psf or "diffraction"

    def image_of(imager):
        if grid is None:
            return simulate_points(np.asarray(scene, np.float64), imager, kind=kind, progress=progress)
        return simulate_volume(scene, imager, grid, kind=kind, progress=progress)

    groups, _ = split_groups(imager)
    if len(groups) == 1:
        return image_of(imager)
    shares = np.ones(len(groups)) if optics == "full" else relative_areas(groups)
    return np.sum([image_of(group) * np.float32(share) for group, share in zip(groups, shares, strict=True)], 0)


def _check_shape(shape: tuple[int, ...], grid: Grid | None) -> None:
    if grid is None and (len(shape) != 2 or shape[1] != 4):
        allowed = "points (point, 4), or a volume with its grid" if len(shape) == 3 else "points (point, 4)"
        raise InputError(f"scene must be {allowed}, got the shape {shape}.")
    if grid is not None and shape != grid.volume_shape:
        raise InputError(f"scene must have the grid's shape {grid.volume_shape}, got {shape}.")


def simulate_volume(
    volume: Float[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    *,
    kind: str = "diffraction",
    progress: Progress | None = None,
) -> Float[np.ndarray, "row column"]:
    """`simulate` for a volume of evenly lit voxels and identical lenses, plane by plane.

    Voxels are divided until they are half a pixel on the sensor or less, which leaves a ripple of 3 % at most. `kind`
    is a key of `gs_jax.optics.psf.PSFS`, or "full".
    """
    check_finite("scene", volume, "voxels")
    volume = np.asarray(volume, np.float32)
    finest = float(imager.magnification(grid.depths).max()) * grid.pitch / imager.sensor.pixel_pitch
    parts = math.ceil(2 * finest)
    rows, columns = (n * parts for n in grid.shape)
    if 16 * rows * columns > (memory := available_memory()):
        raise InputError(
            f"planes of {grid.shape} voxels of {grid.pitch * 1000:g} um, divided to half a pixel, need "
            f"{16 * rows * columns / 2**30:.3g} GiB of memory, got {memory / 2**30:.3g} GiB that are free."
        )
    if np.min(volume) < 0:
        raise InputError(f"voxels must not be negative, got {np.min(volume):g}.")
    of_depth = _psf_at_depth(imager, grid, kind)
    # On the host, where it is added to in place.
    image, progress = np.zeros(imager.sensor.shape, np.float32), progress or Progress()
    for depth, plane in zip(progress.track(np.asarray(grid.depths), "Imaging depths"), volume, strict=True):
        if not plane.any():
            continue
        fine = (plane * np.float32(1 / parts**2)).repeat(parts, 0).repeat(parts, 1)
        fine_grid = Grid(depth[None], (rows, columns), grid.pitch / parts, grid.origin)
        image += np.asarray(forward(fine[None], imager, fine_grid, of_depth(depth)))
    return np.maximum(image, 0, out=image)  # an FFT's rounding may be below zero


def _psf_at_depth(imager, grid, kind):
    depths = np.asarray(grid.depths, np.float64)
    if kind == "full":
        extent = max(grid.shape) * grid.pitch + 2 * float(jnp.abs(grid.origin).max())
        polar_grid = make_polar_grid(imager, depths, extent=extent)
        return lambda depth: field_varying_psf(imager, np.array([depth], np.float64), polar_grid=polar_grid)
    kernel = psf_of_depth(imager, depths, kind)
    return lambda depth: kernel(depth)[None]


def simulate_points(
    points: Float[np.ndarray, "point 4"], imager: Imager, *, kind: str = "diffraction", progress: Progress | None = None
) -> Float[np.ndarray, "row column"]:
    """`simulate` for points `(x, y, z, intensity)` and identical lenses; `kind` as in `simulate_volume`."""
    check_finite("scene", points, "numbers")
    if (behind := ~(points[:, 2] > 0)).any():
        raise InputError(f"scene: depths of points must be positive, got {points[behind][0, 2]:g} mm.")
    if not len(points):
        return np.zeros(imager.sensor.shape, np.float32)
    if kind == "full":
        return full_image_of_points(points, imager, progress)
    depths = np.unique(points[:, 2])
    if depths.size > (count := math.ceil(np.ptp(depths) / _STEP / float(object_index(imager.sample))) + 1):
        depths = np.linspace(depths[0], depths[-1], count)
    sensor = Sensor(imager.sensor.shape, imager.sensor.pixel_pitch / STEPS, imager.sensor.origin)
    kernel = psf_of_depth(eqx.tree_at(lambda i: i.sensor, imager, sensor), depths, kind, STEPS)
    # Each point is between two depths of its slab, whose last depth is the first of the next slab.
    between = np.clip(np.searchsorted(depths, points[:, 2], "right") - 1, 0, max(depths.size - 2, 0))
    slabs, image, progress = between // _SLAB, 0, progress or Progress()
    for slab in np.unique(slabs):
        own = depths[slab * _SLAB :][: _SLAB + 1]
        fine = np.stack([kernel(depth) for depth in progress.track(own, "Point spread functions")])
        image = image + forward_points(points[slabs == slab], imager, make_stamps(own, fine), progress)
    return np.asarray(image)


class Camera(eqx.Module):
    """A camera, which converts electrons to counts.

    *Compiled.*

    Parameters
    ----------
    gain
        Electrons per count.
    offset
        Counts of a pixel without light or noise.
    read_noise
        Standard deviation, electrons.
    full_well
        The most electrons that a pixel holds. By default no limit: the converter saturates first.
    bits
        Of the converter, 1 to 16: counts end at `2**bits - 1`.

    Raises
    ------
    ValueError
        If a number is out of range (values traced by JAX are not checked).

    Examples
    --------
    >>> camera = gs.Camera(gain=2.5, offset=100.0, read_noise=1.6, full_well=10_000.0, bits=12)
    """

    gain: Float[Array, ""] = eqx.field(converter=as_float, default=10.0)
    offset: Float[Array, ""] = eqx.field(converter=as_float, default=16.0)
    read_noise: Float[Array, ""] = eqx.field(converter=as_float, default=2.0)
    full_well: Float[Array, ""] = eqx.field(converter=as_float, default=math.inf)
    bits: int = eqx.field(static=True, default=16)

    def __check_init__(self):
        well = ("positive", lambda x: x > 0)
        check_fields(self, gain=POSITIVE, offset=NOT_NEGATIVE, read_noise=NOT_NEGATIVE, full_well=well)
        if not 1 <= self.bits <= 16:
            raise ValueError(f"`bits` must be 1 to 16, got {self.bits}.")


def expose(
    image: Float[Array | np.ndarray, "row column"],
    camera: Camera,
    key: PRNGKeyArray,
    *,
    peak_electrons: Number | Float[Array, ""],
) -> UInt8[Array, "row column"] | UInt16[Array, "row column"]:
    """The counts of one exposure: uint8 for a camera of up to 8 bits, else uint16.

    *Compiled.*

    The image is scaled; Poisson noise, the full well, Gaussian read noise, gain, offset, rounding and the converter's
    range follow. A few rows are computed at a time, each with its own key: memory is little beside image and counts.

    Parameters
    ----------
    image
        Linear intensity in any unit, finite and not negative.
    camera
        Its noise and range.
    key
        Of `jax.random`; the same key gives the same noise.
    peak_electrons
        Mean number of electrons in the brightest pixel. An image without light stays without.

    Raises
    ------
    ValueError
        If the image has a negative or infinite value or a NaN, or `peak_electrons` is not positive and finite (values
        traced by JAX are not checked).

    Examples
    --------
    >>> import jax
    >>> counts = gs.expose(np.eye(64), gs.Camera(), jax.random.key(0), peak_electrons=10_000)
    >>> print(counts.dtype, round(float(np.median(counts))))  # dark pixels: the offset
    uint16 16
    """
    image = native(image)
    # On the host: JAX would compile comparisons for each shape.
    if not isinstance(peak_electrons, Tracer) and not 0 < peak_electrons < math.inf:
        raise ValueError(f"`peak_electrons` must be positive and finite, got {peak_electrons}.")
    if not isinstance(image, Tracer):
        light = np.asarray(image)
        if wrong := np.count_nonzero(~((light >= 0) & (light < math.inf))):
            raise ValueError(f"`image` must be finite and not negative, got {wrong} pixels that are not.")
    return _expose(image, camera, key, peak_electrons)


def compile_exposure(shape: tuple[int, int], camera: Camera, peak_electrons: float) -> None:
    """Compile `expose` for images of a shape, float32, which may be computed meanwhile in another thread."""
    # A key itself would run a program.
    image, key = jax.ShapeDtypeStruct(shape, jnp.float32), jax.eval_shape(jax.random.key, 0)
    _expose.lower(image, camera, key, peak_electrons).compile()


@jax.jit
def _expose(image, camera, key, peak):
    camera, peak = jax.tree.map(lambda leaf: jnp.asarray(leaf, image.dtype), (camera, peak))
    brightest = image.max()
    scale = jnp.where(brightest > 0, peak / jnp.where(brightest > 0, brightest, 1), 0)

    def row(pixels, shot, read):
        charge = jnp.minimum(poisson(shot, scale * pixels), camera.full_well)
        charge += camera.read_noise * jax.random.normal(read, pixels.shape, pixels.dtype)
        counts = jnp.round(charge / camera.gain + camera.offset)
        return jnp.clip(counts, 0, 2**camera.bits - 1).astype(jnp.uint8 if camera.bits <= 8 else jnp.uint16)

    keys = jax.random.split(key, (2, image.shape[0]))
    return lax.map(lambda rows: row(*rows), (image, *keys), batch_size=_ROWS)


@jit
def electrons(counts: Counts, camera: Camera) -> Float32[Array, "row column"]:
    """Convert counts to electrons, `gain (counts - offset)`; dark pixels are on both sides of zero."""
    gain, offset = camera.gain.astype(jnp.float32), camera.offset.astype(jnp.float32)
    return gain * (counts.astype(jnp.float32) - offset)


def poisson(key: PRNGKeyArray, mean: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Poisson variates as whole floats, many times faster on a CPU than `jax.random.poisson`.

    The inverse of the distribution at one uniform variate `u` each. Below a mean `m` of 16 it is exact, by summing
    probabilities. Above, with the normal quantile `w` of `u`, it is

        floor(m + sqrt(m) w + (w^2 + 2) / 6 - (w^3 + 2 w) / (72 sqrt(m)))

    (Giles, ACM Trans. Math. Softw. 42, 7, 2016), worst at `m = 16`: cumulated probabilities are off by up to 1.3e-4,
    the mean by less than 1e-6, the variance by a fraction of 2.4e-5. In float32 `u` has steps of 1e-7: rarer events do
    not occur, and means are to be below 1.6e7, where whole numbers end.
    """
    # Without the ends, -1 and 1, where w would be infinite.
    v = jax.random.uniform(key, mean.shape, mean.dtype, minval=jnp.nextafter(jnp.array(-1, mean.dtype), 0))
    w, root = math.sqrt(2) * lax.erf_inv(v), jnp.sqrt(jnp.maximum(mean, EXPANDED))
    many = jnp.floor(mean + root * w + (w**2 + 2) / 6 - (w**3 + 2 * w) / (72 * root))
    return jnp.where(mean < EXPANDED, _poisson_by_sum((v + 1) / 2, jnp.where(mean < EXPANDED, mean, 0)), many)


def _poisson_by_sum(u, mean):
    """The smallest number whose cumulated probability reaches `u`."""
    # A term below the rounding of a sum near 1 adds nothing: without this bound some searches would not end.
    least = jnp.finfo(u.dtype).eps / 4

    def searching(state):
        _, _, term, total = state
        return (u > total) & (term > least)

    def step(state):
        index, count, term, total = state
        term = term * mean / index
        go_on = searching(state)
        return index + 1, jnp.where(go_on, count + 1, count), term, jnp.where(go_on, total + term, total)

    first = jnp.exp(-mean)
    start = (jnp.ones((), u.dtype), jnp.zeros_like(u), first, first)
    return lax.while_loop(lambda state: searching(state).any(), step, start)[1]
