"""Layers of napari in um: of a reconstruction, and of files, by the reader that `napari.yaml` names. Needs no napari.

napari's own readers of OME-TIFF ignore the position of the first voxel, and those of CSV know pixels only.
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from jaxtyping import Float, Int, Num

from ..base.errors import InputError
from ..base.progress import CancellableProgress
from ..base.typing import Points
from ..cli.options import CaptureOptions, depth_range, find_design, parse_depths
from ..io.ngff import Series, display_range, read_series
from ..io.point_tables import POINTS_HEADER, read_points
from ..io.provenance import DEVIATION, read_provenance
from ..io.traces import TRACKS_HEADER, read_tracks
from ..io.volumes import VOLUME_SUFFIXES, SurfaceMaps, read_surface, read_volume, surface_mesh
from ..microscope.grid import Grid

# Seconds between looks whether the user cancelled.
_POLL_INTERVAL = 0.1
_UM = 1000.0


class Result(NamedTuple):
    """Layers to add, the transform of the capture's layer, and messages."""

    layers: list[Any]
    transform: dict[str, Any]
    status: str
    warnings: list[str]


class Newest:
    """Hands the newest value from one thread to another, which takes it once; older ones are dropped."""

    def __init__(self):
        # Its methods cannot be interrupted by another thread: a value that is put while one is taken stays.
        self._values: deque[Any] = deque(maxlen=1)

    def put(self, value: Any) -> None:
        self._values.append(value)

    def take(self) -> Any:
        """The newest value; None if it was taken, or there is none yet."""
        try:
            return self._values.pop()
        except IndexError:
            return None


def prepare_layers(
    design: Path,
    depths: str,
    voxel_um: float,
    method: str,
    suppress: str,
    points: bool,
    progress: CancellableProgress,
    deviation: bool = False,
) -> Callable[[str, Path | np.ndarray], Result]:
    """Returns the function that reconstructs a file, or the pixels of a layer, as `gs-jax reconstruct` does.

    `deviation` adds a layer with the standard deviation of each voxel.

    Raises `InputError` as the command.
    """
    from ..design.design import read_design
    from ..reconstruction.plan import Plan

    try:
        planes = parse_depths(depths)
    except click.BadParameter as error:
        raise InputError(f"Depths {error.message}") from error
    imager = read_design(design).imager()
    options = {"method": method, "suppress": suppress, "points": points}
    plan = Plan.from_options(imager, planes, voxel_um / _UM or None, **options)
    if deviation:
        plan.check_scored("Deviation")
    grid, volume_of = plan.grid, plan.prepare(progress)

    def reconstruct(name: str, capture: Path | np.ndarray) -> Result:
        with progress.step("Reading"):
            if isinstance(capture, Path):
                camera = CaptureOptions()
                camera.imager(imager)
                image, warnings = camera.read(capture), list(camera.warnings)
            else:
                image, warnings = _correct_pixels(name, capture, imager.sensor)
        with progress.step("Reconstructing"):
            found = volume_of(image, progress)
        progress.check_cancelled()
        layers = [volume_layer(found.volume, grid, f"{name}, {method if suppress == 'none' else suppress}")]
        if deviation:
            # Below the volume, which stays the layer that is seen.
            layers.insert(
                0, deviation_layer(plan.score(image, progress).deviation, grid, f"{name}, standard deviation")
            )
        if fit := found.surface:
            layers += surface_layers(SurfaceMaps(fit.brightness, fit.depth, fit.depth_sd, grid), name)
        if found.points is not None:
            layers.append(points_layer(found.points, f"{name}, {len(found.points)} points", mean_step(grid)))
        z, y, x = found.volume.shape
        status = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * _UM:.4g} um laterally, {depth_range(planes)}"
        warnings += [found.warning] if found.warning else []
        return Result(layers, _capture_transform(imager.sensor), status, warnings)

    return reconstruct


def newest_captures(folder: Path, make: Callable[[str, Path], Result], progress: CancellableProgress) -> Iterator:
    """Yields the `Result` of the newest capture of a folder again and again, or what is wrong with it in words.

    Raises `InputError` if the folder cannot be watched.
    """
    from ..io.recordings import WatchedFolder
    from ..reconstruction.recording import SETTLED

    name, since = "", 0.0
    with WatchedFolder(folder) as watched:
        while True:
            names = watched.changes(_POLL_INTERVAL)
            progress.check_cancelled()
            if names:
                name, since = names[-1], time.monotonic()
            if not name:
                continue
            try:
                result = make(name, folder / name)
                late = time.time() - (folder / name).stat().st_mtime
                yield result._replace(status=f"{name}, {1000 * late:.0f} ms after it was written")
            except (InputError, FileNotFoundError) as error:
                # It may be half-written.
                if time.monotonic() - since < SETTLED:
                    continue
                yield str(error)
            name = ""


def _correct_pixels(name, pixels, sensor):
    """Validates the pixels of a layer and repairs hot ones, as for a file; also returns warnings."""
    from ..io.camera import prepare, read_frame
    from ..io.captures import DTYPES, check_images

    pixels = np.asarray(pixels)
    if pixels.shape != sensor.shape or pixels.dtype.name not in DTYPES:
        given, expected = (" x ".join(map(str, shape)) for shape in (pixels.shape, sensor.shape))
        raise InputError(
            f"{name}: the layer must have {expected} pixels (rows x columns, as the design's sensor) of type "
            f"{', '.join(DTYPES)}, got {given} of {pixels.dtype}."
        )
    frame = read_frame(name, check_images(name, iter([pixels])), prepare(pixels.shape))
    return frame.image, frame.warnings


def _capture_transform(sensor) -> dict[str, Any]:
    """Scale and position of a capture's layer."""
    pitch, (x, y) = sensor.pixel_pitch, map(float, sensor.origin)
    first = [middle - (n - 1) / 2 * pitch for middle, n in zip((y, x), sensor.shape, strict=True)]
    return {
        "scale": (_UM * pitch, _UM * pitch),
        "translate": tuple(_UM * each for each in first),
        "units": ("um", "um"),
        "axis_labels": ("y", "x"),
    }


def sample() -> list[Any]:
    """A simulated capture of forty beads between 18 and 22 mm by `geomscope`, with camera noise."""
    import jax

    from ..design.design import read_design
    from ..simulation import Camera, expose, random_points, simulate

    imager = read_design(find_design("geomscope")).imager()
    light = simulate(random_points(40, (6.0, 6.0), (18.0, 22.0), seed=0), imager, optics="near", psf="geometric")
    image = np.asarray(expose(light, Camera(), jax.random.key(0), peak_electrons=2e4))
    limits = tuple(map(float, np.percentile(image, (1, 99.95))))
    return [(image, {"name": "beads", "contrast_limits": limits} | _capture_transform(imager.sensor), "image")]


def measure_points(
    volumes: Any,
    frames: list[int],
    points: Float[np.ndarray, "point 3"],
    numbers: Int[np.ndarray, " point"] | None = None,
) -> Generator[int, None, dict[str, np.ndarray]]:
    """Measures points as `gs-jax traces --from-points` does; returns signals `(frame, point)` by name.

    Yields the number of frames that are done. `points` are in voxels `(z, y, x)` of `volumes`, `(t, z, y, x)`, and
    errors name their `numbers`, by default from 1.

    Raises `InputError` as the command.
    """
    from ..reconstruction.traces import RegionSignals, regions_of_points, relative_change

    # Lengths are in voxels, as the layer may have no unit; depths must be above 0.
    depth, *shape = volumes.shape[1:]
    grid = Grid(1.0 + np.arange(depth), shape, 1.0, [(n - 1) / 2 for n in shape[::-1]])
    regions = RegionSignals(regions_of_points(points[:, ::-1] + np.array([0, 0, 1]), grid, numbers=numbers))
    rows = []
    for row in regions.measure(volumes, frames):
        rows.append(row)
        yield len(rows)
    means, backgrounds = (np.array(part) for part in zip(*rows, strict=True))
    return {"mean": means, "background": backgrounds, "dff": relative_change(means - backgrounds)}


Layer = tuple[Any, dict[str, Any], str]

_AXES: dict[str, Any] = {"axis_labels": ("z", "y", "x"), "units": ("um", "um", "um")}
# Diameter of the ring around a point, um.
_RING = 300.0


def reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """Return the function that reads this path, or None if it is not ours: napari then asks other readers."""
    if isinstance(path, list):
        return None
    suffix = Path(path).suffix.lower()
    if suffix in VOLUME_SUFFIXES:
        return _read_volume
    return _table_reader(path) if suffix == ".csv" else None


def _table_reader(path: str) -> Callable[[Any], list[Layer]] | None:
    try:
        with open(path, encoding="utf-8-sig") as file:
            header = file.readline()
    except (OSError, UnicodeDecodeError):
        return None
    readers = {POINTS_HEADER: _read_points, TRACKS_HEADER: _read_tracks}
    return next((read for first, read in readers.items() if header.startswith(first)), None)


def _read_points(path) -> list[Layer]:
    return [points_layer(read_points(path), Path(path).name)]


def _read_tracks(path) -> list[Layer]:
    """Lines from point to point of each particle."""
    points, frames, particles, columns, interval = read_tracks(Path(path))
    # napari takes the limits of colours without regard to NaN, which the speed of a single point is.
    features = {name: np.nan_to_num(values) for name, values in columns.items()}
    options = {"scale": (interval or 1.0, 1.0, 1.0, 1.0), "features": features, "name": Path(path).name}
    return [(np.column_stack([particles, frames, _UM * points[:, 2::-1]]), options | _in_time(interval), "tracks")]


def _read_volume(path) -> list[Layer]:
    if (series := read_series(path)) is not None:
        return [_series_layer(series, Path(path).name)]
    try:
        voxels, grid = read_volume(path)
    except InputError as error:
        try:
            return surface_layers(read_surface(path), Path(path).name)
        except InputError:
            raise ValueError(f"neither a volume nor a surface of gs_jax: {error}") from error
    layer_of = deviation_layer if DEVIATION in read_provenance(path) else volume_layer
    return [layer_of(voxels, grid, Path(path).name)]


def volume_layer(volume: Num[np.ndarray, "depth y x"], grid: Grid, name: str) -> Layer:
    """A volume, with the display range that files of it have too."""
    first = _UM * np.array([float(grid.depths[0]), float(grid.y[0]), float(grid.x[0])])
    scale = _UM * np.array([mean_step(grid), grid.pitch, grid.pitch])
    options = {"scale": scale, "translate": first, "contrast_limits": display_range(volume), "name": name}
    return volume, options | _AXES, "image"


def deviation_layer(deviation: Num[np.ndarray, "depth y x"], grid: Grid, name: str) -> Layer:
    """Standard deviations of the voxels of a volume."""
    data, options, kind = volume_layer(deviation, grid, name)
    return data, options | {"colormap": "viridis"}, kind


def mean_step(grid: Grid) -> float:
    """Mean distance of planes, mm; for a single plane the lateral pitch."""
    return float(np.diff(np.asarray(grid.depths, np.float64)).mean()) if grid.depths.size > 1 else grid.pitch


def points_layer(points: Points, name: str, thickness: float = 0.25) -> Layer:
    """Points as rings, shown in planes that are less than half of `thickness` from them, mm."""
    points = np.asarray(points, np.float64)
    # napari shows points within half a data unit of a plane.
    scale = np.array([_UM * thickness, 1.0, 1.0])
    options = {
        "features": {"intensity": points[:, 3]},
        "size": _RING,
        "scale": scale,
        "name": name,
        "face_color": "transparent",
        "border_color": "cyan",
        "border_width": 0.15,
        "blending": "translucent_no_depth",
    }
    return _UM * points[:, 2::-1] / scale, options | _AXES, "points"


def surface_layers(maps: SurfaceMaps, name: str) -> list[Layer]:
    """A depth map for each sheet, um, and a surface of all sheets, coloured by brightness, for the view in space."""
    grid, mesh = maps.grid, surface_mesh(maps.brightness, maps.depth, maps.grid)
    lit = maps.depth[np.isfinite(maps.depth)]
    low, high = (_UM * float(part(lit)) for part in (np.min, np.max)) if lit.size else (0.0, 1.0)
    options: dict[str, Any] = {
        "scale": (_UM * grid.pitch, _UM * grid.pitch),
        "translate": (_UM * float(grid.y[0]), _UM * float(grid.x[0])),
        "contrast_limits": (low, max(high, low + 1.0)),
        "colormap": "viridis",
        "axis_labels": ("y", "x"),
        "units": ("um", "um"),
    }
    names = [f"{name}, depth, um" + (f", sheet {n + 1}" if len(maps.depth) > 1 else "") for n in range(len(maps.depth))]
    layers: list[Layer] = [
        (_UM * depth, options | {"name": each}, "image") for depth, each in zip(maps.depth, names, strict=True)
    ]
    vertices, light, faces = mesh
    if not len(faces):
        # napari draws no empty surface.
        corner = [float(grid.x[0]), float(grid.y[0]), float(grid.depths[0])]
        vertices, light, faces = np.tile(corner, (3, 1)), np.zeros(3), np.array([[0, 1, 2]])
    shown: dict[str, Any] = {"name": f"{name}, surface", "contrast_limits": (0.0, 1.0), "colormap": "gray"}
    return [*layers, ((_UM * vertices[:, ::-1], faces, light), shown | {"shading": "none"} | _AXES, "surface")]


def _series_layer(series: Series, name: str) -> Layer:
    """Volumes in time, which napari reads as it shows them."""
    multiscale = len(series.levels) > 1
    options = {
        "scale": series.scale,
        "translate": series.first,
        "contrast_limits": series.display,
        "name": name,
        "multiscale": multiscale,
    }
    return series.levels if multiscale else series.levels[0], options | _in_time(series.interval), "image"


def _in_time(interval: float | None) -> dict[str, Any]:
    time = {"axis_labels": "t", "units": "s" if interval else "pixel"}
    return {name: (time[name], *space) for name, space in _AXES.items()}
