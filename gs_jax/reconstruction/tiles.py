"""Reconstruction of volumes that do not fit into memory, in tiles over the field.

A voxel's light reaches the sensor through lenses all over it, so the images of all tiles overlap, and a tile alone
cannot be fitted to a capture. First the whole field is reconstructed by the same method, with wider voxels. Then each
tile explains what the image of the other tiles leaves of the capture, and starts from the volume so far: in a quarter
of the steps with the others as wide voxels, then in all steps with the others as they were found. What a method takes
from the whole volume (the mean sensitivity, the largest back-projected value) all tiles share, so that they agree where
they meet. Back-projection does not couple voxels, and its tiles are exact.
"""

import dataclasses
import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..base.errors import InputError
from ..base.machine import available_memory
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..base.workers import Workers
from ..io.files import TILES, atomic_write, make_folder
from ..io.ngff import VolumeSeries, open_levels, tile_unit
from ..microscope.grid import Grid
from ..solvers.admm import ADMM
from ..solvers.base import start_solver
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from .pipeline import BackProjection, Reconstructor, State
from .plan import Plan
from .recording import reconstruct_frames, reconstruct_frames_by

# Arrays of a tile's size that a method allocates, and of the capture's size.
_ARRAYS, _IMAGES = {BackProjection: 2.5, RichardsonLucy: 9, FISTA: 9, ADMM: 18}, 12
# Bytes of JAX and its programs.
_PROGRAMS = 2**29
# Share of the steps that the second run takes; the first takes all. Starts of Richardson-Lucy are uniform in part.
_FURTHER, _UNIFORM = 0.4, 0.2
# Voxels around a tile that are computed with it: differences and blurs reach across its edges.
_MARGIN = 4
# Files in the folder of what tiles share: of the first run and of the second, and the volume of the first.
_FIELDS, _ROUGH = ("first.npz", "second.npz"), "first.zarr"


@dataclasses.dataclass(frozen=True)
class Tiles:
    """Squares of `side` voxels into which the planes of a grid are divided, row by row; those at the end are smaller.

    Each is computed with a `margin`, in a window of the same shape for all, which lies within the grid.
    """

    grid: Grid
    side: int
    margin: int = 0

    @property
    def _columns(self) -> int:
        return -(-self.grid.shape[1] // self.side)

    @property
    def count(self) -> int:
        return -(-self.grid.shape[0] // self.side) * self._columns

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a window."""
        rows, columns = (min(n, self.side + 2 * self.margin) for n in self.grid.shape)
        return rows, columns

    def core(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of a tile."""
        first = [self.side * at for at in divmod(number, self._columns)]
        rows, columns = (slice(a, min(a + self.side, n)) for a, n in zip(first, self.grid.shape, strict=True))
        return rows, columns

    def window(self, number: int) -> tuple[slice, slice]:
        """Rows and columns with the margin."""
        sizes = zip(self.core(number), self.shape, self.grid.shape, strict=True)
        first = [(max(0, min(core.start - self.margin, n - size)), size) for core, size, n in sizes]
        rows, columns = (slice(a, a + size) for a, size in first)
        return rows, columns

    def inner(self, number: int) -> tuple[slice, slice]:
        """The tile's rows and columns within its window."""
        pairs = zip(self.core(number), self.window(number), strict=True)
        rows, columns = (slice(core.start - whole.start, core.stop - whole.start) for core, whole in pairs)
        return rows, columns

    def window_grid(self, number: int) -> Grid:
        """Grid of a window; those of all tiles differ in their origin alone."""
        sizes = zip(self.window(number), self.grid.shape, strict=True)
        middles = [(part.start + part.stop - n) / 2 for part, n in sizes]
        origin = np.asarray(self.grid.origin, np.float64) + self.grid.pitch * np.array(middles[::-1])
        return dataclasses.replace(self.grid, shape=self.shape, origin=jnp.asarray(origin, self.grid.origin.dtype))

    @property
    def wider(self) -> Grid:
        """Grid of the whole field with as many voxels as a window, at most."""
        factor = max(-(-n // size) for n, size in zip(self.grid.shape, self.shape, strict=True))
        rows, columns = (2 * round((n / factor - 1) / 2) + 1 for n in self.grid.shape)
        return dataclasses.replace(self.grid, shape=(max(rows, 1), max(columns, 1)), pitch=factor * self.grid.pitch)


def make_tiles(plan: Plan, side: int | None, jobs: int = 1) -> Tiles:
    """Tiles of a side, in voxels, or of the largest for which the memory of `jobs` at a time is enough."""
    grid, unit = plan.grid, tile_unit(plan.grid.shape)
    arrays = next((count for kind, count in _ARRAYS.items() if isinstance(plan.method, kind)), 0)
    if not arrays:
        allowed = "backproject, list-rl, richardson-lucy, fista or admm"
        raise InputError(f"--tiles must be used with {allowed}, got {type(plan.method).__name__}.")
    sieve = getattr(plan.method, "sieve", None)
    if isinstance(sieve, float) and sieve > 0:
        raise InputError("--sieve must not be given with --tiles, got both.")
    margin = 0 if isinstance(plan.method, BackProjection) else _MARGIN
    if side is None:
        memory = available_memory() / jobs - _PROGRAMS - 4 * _IMAGES * math.prod(plan.imager.sensor.shape)
        side = largest_side(grid.shape, memory / (4 * arrays * grid.depths.size), 2 * margin)
    return Tiles(grid, -(-side // unit) * unit, margin)


def largest_side(shape: tuple[int, int], voxels: float, around: int) -> int:
    """Largest power of two, which divides into chunks, for which the voxels of a plane are enough, with those around.

    At most the side of the grid, and at least what tiles need.
    """
    return min(2 ** int(math.log2(max(math.sqrt(max(voxels, 1)) - around, tile_unit(shape)))), max(shape))


class Field(NamedTuple):
    """What all tiles share: the capture, its volume of wide voxels with the background that was fitted to it, the mean
    sensitivity or the largest back-projected value (`unit`), and the image of the whole volume so far.
    """

    capture: Image
    wide: Volume
    knots: Float[np.ndarray, "knot knot"] | None = None
    unit: Any = 1.0
    image: Any = 0.0


def reconstruct_tiles(
    plan: Plan, tiles: Tiles, capture: Image, series: VolumeSeries, workers: Workers, progress: Progress
) -> None:
    """Reconstruct a capture tile by tile, in this process or by workers, and write each as it is done.

    `series` is the store of the volume, with `tile=tiles.side`. What it has is kept, and so is what its tiles share.
    `workers` are entered. Raises `InputError` if every tile failed.
    """
    if series.exists and not series.unfinished:
        shutil.rmtree(series.path / TILES, ignore_errors=True)
        return
    folder, whole = series.path / TILES, _reconstructor(plan, progress)
    first, second = (folder / name for name in _FIELDS)
    if not (series.exists and first.exists()):
        field = _prepare(whole, plan, tiles, capture, progress)
        if not series.exists:
            series.create(field.wide)
        make_folder(folder)
        _save(first, field)

    def run(plan: Plan, store: VolumeSeries, path: Path, number: int) -> None:
        opened = partial(_open_tiles, plan, tiles, path, number)
        if workers.remote:
            reconstruct_frames_by(workers, store, opened, progress=progress)
        else:
            reconstruct_frames(store, *opened(), progress=progress)

    if isinstance(plan.method, BackProjection):
        run(plan, series, first, 0)
    else:
        options = {"request": series.request, "resume": True, "tile": tiles.side}
        rough = VolumeSeries(folder / _ROUGH, tiles.count, tiles.grid, **options)
        if rough.unfinished:
            run(plan, rough, first, 0)
        if rough.failed:
            raise InputError(next(iter(rough.failed.values())))
        if not second.exists():
            field = _load(first)
            image = _field_image(whole, tiles, _so_far(field, tiles, second, 1), progress)
            _save(second, field._replace(image=image))
        method: Any = plan.method
        method = dataclasses.replace(method, steps=math.ceil(_FURTHER * method.steps))
        run(dataclasses.replace(plan, method=method), series, second, 1)
    if not series.unfinished:
        shutil.rmtree(folder)


def _save(path: Path, field: Field) -> None:
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **{name: value for name, value in field._asdict().items() if value is not None})


def _load(path: Path) -> Field:
    with np.load(path) as arrays:
        return Field(**arrays)


def _open_tiles(plan: Plan, tiles: Tiles, path: Path, number: int):
    """`read` and `make` of `reconstruct_frames` for the tiles of the first run, 0, or the second."""
    field, whole = _load(path), _reconstructor(plan, Progress())
    # Of the whole capture, without the state of a solver.
    state, so_far = whole.init(field.capture, ()), _so_far(field, tiles, path, number)

    def make(tile: int, _) -> tuple[Volume, dict[str, Any], None]:
        local, before = _at(whole, tiles.window_grid(tile)), state
        if not isinstance(plan.method, BackProjection):
            before = local.run(_started(local, state, field, so_far(tile)), Progress())
        return np.asarray(local.finish(before), np.float32)[(slice(None), *tiles.inner(tile))], {}, None

    return int, make


def _reconstructor(plan: Plan, progress: Progress, grid: Grid | None = None) -> Reconstructor:
    # Tiles take no steps on wide voxels but those of the whole field.
    return Reconstructor(plan.imager, grid or plan.grid, plan.method, plan.optics, wide=False, progress=progress)


def _at(whole: Reconstructor, grid: Grid) -> Reconstructor:
    """The same for a part of the volume; one program serves all of a shape."""
    return eqx.tree_at(lambda r: r.problem.grid, whole, grid)


def _prepare(whole: Reconstructor, plan: Plan, tiles: Tiles, capture: Image, progress: Progress) -> Field:
    """Reconstruct the whole field with wide voxels, and image it with the pixels of the tiles."""
    wide = _reconstructor(plan, progress, tiles.wider)
    state = wide.run(wide.init(capture), progress)
    field = Field(capture, np.asarray(wide.finish(state, progress), np.float32))
    if isinstance(plan.method, BackProjection):
        return field
    light, total, largest = whole.init(capture, ()).light, 0.0, 0.0
    if is_lucy := isinstance(plan.method, RichardsonLucy):
        light = jnp.ones_like(light)
    for number in range(tiles.count):
        problem = _at(whole, tiles.window_grid(number)).problem
        back = np.asarray(_back(problem, light))[(slice(None), *tiles.inner(number))]
        total, largest = total + float(back.sum(dtype=float)), max(largest, float(back.max()))
    if is_lucy and (knots := state.solver.knots) is not None:
        # The light of a pixel, not of a wide one.
        field = field._replace(knots=np.asarray(knots) * (whole.problem.binning / wide.problem.binning) ** 2)
    field = field._replace(unit=total / math.prod(tiles.grid.volume_shape) if is_lucy else largest)
    return field._replace(image=_field_image(whole, tiles, _so_far(field, tiles), progress))


def _so_far(field: Field, tiles: Tiles, path: Path | None = None, number: int = 0) -> Callable[[int], Volume]:
    """Function of a tile's number: the volume so far in its window, of wide voxels or of the first run."""
    if number == 0 or path is None:
        return lambda tile: _interpolated(field.wide, tiles, tiles.window(tile))
    array = open_levels(path.with_name(_ROUGH), tiles.grid)[0]
    return lambda tile: array[(slice(None), *tiles.window(tile))]


def _field_image(whole: Reconstructor, tiles: Tiles, so_far: Callable[[int], Volume], progress: Progress) -> Any:
    """The image of a volume, tile by tile."""
    image = 0
    for number in progress.track(range(tiles.count), "Imaging the field"):
        problem, inner = _at(whole, tiles.window_grid(number)).problem, (slice(None), *tiles.inner(number))
        part = np.zeros(problem.grid.volume_shape, problem.in_structure().dtype)
        part[inner] = so_far(number)[inner]
        image = image + np.asarray(_image(problem, part))
    return image


@jax.jit
def _image(problem, volume):
    return problem.imaging.mv(volume)


@jax.jit
def _back(problem, image):
    return problem.T.mv(image)


def _started(local: Reconstructor, state: State, field: Field, so_far: Volume) -> State:
    """State before the first step, with the light of the rest, and what depends on the whole volume as there."""
    method, start = cast(Any, local.method), jnp.asarray(so_far, local.problem.in_structure().dtype)
    own = _image(local.problem, start)
    rest = jnp.asarray(field.image) - own
    if isinstance(method, RichardsonLucy):
        state = state._replace(background=state.background + jnp.maximum(rest, 0))
        free = dataclasses.replace(method, background=state.background, sieve=state.sieve, min_sensitivity=0.0)
        solver = start_solver(free, state.light, local.problem)
        sensitivity = solver.sensitivity
        if method.min_sensitivity is not None:
            least = jnp.asarray(method.min_sensitivity * field.unit, sensitivity.dtype)
            sensitivity = jnp.where(sensitivity > 0, jnp.maximum(sensitivity, least), 0)
        # No step lights a voxel that is dark.
        x = jnp.where(sensitivity > 0, (1 - _UNIFORM) * start + _UNIFORM * start.mean(), 0)
        # Copies, as steps overwrite their state.
        momentum = solver.momentum and (jnp.copy(x), *solver.momentum[1:])
        knots = None if field.knots is None else jnp.array(field.knots, x.dtype)
        return state._replace(solver=solver._replace(x=x, sensitivity=sensitivity, momentum=momentum, knots=knots))
    state = state._replace(light=state.light - local.problem.detrend(rest))
    solver = with_weights(start_solver(method, state.light, local.problem), method, field.unit)
    if isinstance(method, FISTA):
        # Not ADMM: with more steps it fits errors of the model.
        solver = solver._replace(x=start, point=jnp.copy(start))
    return state._replace(solver=solver)


def with_weights(state: Any, solver: Any, unit: float) -> Any:
    """The state of a least-squares solver with weights relative to `unit`, that of the whole volume."""
    if isinstance(solver, FISTA):
        return state._replace(weight=jnp.full_like(state.weight, solver.sparsity * unit))
    if isinstance(solver, RichardsonLucy):
        return state
    tv, l1 = (jnp.full_like(state.weights.tv, weight * unit) for weight in (solver.tv, solver.sparsity))
    return state._replace(weights=state.weights._replace(tv=tv, l1=l1))


def _interpolated(volume: Volume, tiles: Tiles, window: tuple[slice, slice]) -> Volume:
    """The wide voxels, bilinear at the voxels of a window, each of which has its share of their light."""
    wide = tiles.wider
    factor = wide.pitch / tiles.grid.pitch
    for axis, part in enumerate(window, 1):
        count, voxels = volume.shape[axis], np.arange(part.start, part.stop)
        place = np.clip((voxels - (tiles.grid.shape[axis - 1] - 1) / 2) / factor + (count - 1) / 2, 0, count - 1)
        low = np.minimum(place.astype(int), max(count - 2, 0))
        share = (place - low).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        last = np.minimum(low + 1, count - 1)
        volume = volume.take(low, axis) * (1 - share) + volume.take(last, axis) * share
    return volume / np.float32(factor**2)
