"""OME-Zarr (NGFF): attributes of volumes (0.4) and of volumes in time (0.5), which are written frame by frame.

The frames of a large volume are its tiles (0.5).

A volume in time has a file per frame, a shard of Zarr 3; a single volume has one per plane, which readers of Zarr 2
read too.

The store has its full size from the first frame on, and opens at any moment; frames that are not written read as zeros.
`frames.jsonl` in it has a line of JSON for the request, then one per frame, appended when the frame is wholly written.
A last line without its end, which a crash cut off, does not count. A store whose number of frames is not known grows by
`add`, and its journal also has a line with the name of each frame.

The format is OME-Zarr 0.5 (Zarr 3), whose shards make one file of a frame's planes, written whole or not at all. In 0.4
each plane is a file: 1.3 million for 10^5 frames of 13 planes, which few file systems of clusters bear.
"""

import itertools
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from ..base.errors import InputError, input_error, short_repr
from ..base.typing import PathLike, Volume
from ..microscope.grid import Grid
from .files import JOURNAL, atomic_write, decoding, disk_errors_name
from .names import plain_text
from .provenance import KEY, Provenance, surface_of
from .remote import has_key, import_zarr

CHUNK = 1024
# Colours of channels, in turns.
_COLORS = ["00FF00", "FF00FF", "00FFFF", "FFFF00", "FF0000", "0000FF"]
# Percentiles of the displayed values, of up to so many rows and columns.
_DISPLAYED, _SAMPLES = (1, 99.9), 512


def ngff_attributes(group: Any) -> dict[str, Any]:
    """NGFF's attributes of a group or an array of Zarr, which version 0.5 has in `ome`."""
    attributes = group.attrs.asdict()
    return attributes.get("ome", attributes)


def um(mm: float) -> float:
    """Micrometres to 12 digits: 18100 rather than 18100.000000000004."""
    return float(f"{mm * 1000:.12g}")


def first_um(grid: Grid) -> tuple[float, float]:
    """Centre of the first voxel `(y, x)`, um; a float32 origin is taken as the shortest decimal that it stands for."""
    x, y = (float(str(at)) for at in np.asarray(grid.origin))
    rows, columns = grid.shape
    return um(y - (rows - 1) / 2 * grid.pitch), um(x - (columns - 1) / 2 * grid.pitch)


def plain_depths(grid: Grid) -> list[float]:
    """Depths as the shortest decimals: 18.1 rather than float32's 18.100000381."""
    return [float(str(depth)) for depth in np.asarray(grid.depths)]


def _step(path: Path, depths: list[float], pitch: float) -> float:
    # OME-Zarr needs a step for a single plane, too: that of a cubic voxel.
    step = (depths[-1] - depths[0]) / (len(depths) - 1) if len(depths) > 1 else pitch
    even = np.abs(np.array(depths) - depths[0] - step * np.arange(len(depths))).max() <= 1e-6 * max(depths)
    if step <= 0 or not even:
        raise input_error("depths", "in even steps for OME-Zarr", "uneven or descending ones; use .ome.tif", path)
    return step


def title(path: Path) -> str:
    """Name of a volume in its file."""
    return plain_text(path.name.removesuffix(path.suffix).removesuffix(".ome"))


def display_range(voxels: np.ndarray) -> tuple[float, float]:
    """Values that a viewer shows as black and white."""
    sample = voxels[:, :: max(voxels.shape[1] // _SAMPLES, 1), :: max(voxels.shape[2] // _SAMPLES, 1)]
    for low, high in (np.percentile(sample, _DISPLAYED), (voxels.min(), voxels.max())):
        if low < high:
            return float(low), float(high)
    return float(low), float(low) + 1


def image_attributes(
    path: Path,
    depths: list[float],
    grid: Grid,
    levels: int,
    voxels: Volume,
    provenance: Provenance | None,
    *,
    version: str = "0.4",
    in_time: bool = False,
    interval: float | None = None,
    channels: Sequence[str] = (),
) -> dict[str, Any]:
    """Attributes of the Zarr group of an image; `InputError` if the depths are not in even, ascending steps.

    `levels` of a pyramid, each of half the rows and columns; `voxels` set the display range; `version` of OME-Zarr, 0.4
    or 0.5; `in_time`: the first axis is time, with `interval` seconds between frames, if they are known. `channels` are
    names along a first axis of `voxels`, in place of time.
    """
    pitch = grid.pitch
    scale, first = [um(_step(path, depths, pitch)), um(pitch), um(pitch)], [um(depths[0]), *first_um(grid)]
    axes: list[dict[str, str]] = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    if in_time:
        axes.insert(0, {"name": "t", "type": "time"} | ({"unit": "second"} if interval else {}))
        scale, first = [interval or 1.0, *scale], [0.0, *first]
    if channels:
        axes.insert(0, {"name": "c", "type": "channel"})
        scale, first = [1.0, *scale], [0.0, *first]
    shown = (
        zip(channels, voxels, itertools.cycle(_COLORS), strict=False) if channels else [(title(path), voxels, "FFFFFF")]
    )
    entries = [_shown(*each) for each in shown]
    multiscale = {
        **({"version": version} if version == "0.4" else {}),
        "name": title(path),
        "axes": axes,
        "datasets": [
            {"path": str(level), "coordinateTransformations": _transforms(scale, first, 2**level)}
            for level in range(levels)
        ],
    }
    attributes = {"multiscales": [multiscale], "omero": {"channels": entries, "rdefs": {"model": "greyscale"}}}
    attributes = attributes if version == "0.4" else {"ome": {"version": version, **attributes}}
    return attributes | ({KEY: dict(provenance)} if provenance else {})


def _shown(label: str, voxels: np.ndarray, color: str) -> dict[str, Any]:
    low, high = display_range(voxels)
    window = {"min": float(voxels.min()), "max": float(voxels.max()), "start": low, "end": high}
    return {"active": True, "color": color, "label": label, "window": window}


def _transforms(scale: list[float], first: list[float], side: int) -> list[dict[str, Any]]:
    """Scale and translation of a level whose voxels are means of `side` x `side`."""
    factors = [*[1] * (len(scale) - 2), side, side]
    wider = [step * factor for step, factor in zip(scale, factors, strict=True)]
    inner = [at + step * (factor - 1) / 2 for at, step, factor in zip(first, scale, factors, strict=True)]
    return [{"type": "scale", "scale": wider}, {"type": "translation", "translation": inner}]


def missing_chunk(array, place: tuple[int, ...] = ()) -> str | None:
    """Key of a chunk of an array in its store, or of the part `array[place]`, that is missing there.

    Zarr reads its fill value instead, as it does for what a program left out because it is dark.
    """
    sizes = array.shards or array.chunks
    counts = [range(at // size, at // size + 1) for at, size in zip(place, sizes, strict=False)]
    rest = zip(array.shape[len(place) :], sizes[len(place) :], strict=True)
    counts += [range(-(-length // size)) for length, size in rest]
    keys = (array.metadata.encode_chunk_key(chunk) for chunk in itertools.product(*counts))
    return next((key for key in keys if not has_key(array, key)), None)


def plane_chunks(shape: tuple[int, ...]) -> dict[str, Any]:
    """Storage of a volume: each plane, or square of it, is a file."""
    return {
        "chunks": (*[1] * (len(shape) - 2), *_square(shape)),
        "compressors": {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1},
        "chunk_key_encoding": {"name": "v2", "separator": "/"},
    }


def frame_shards(shape: tuple[int, int, int, int]) -> dict[str, Any]:
    """Storage of volumes in time: each frame is a file, with its planes, or squares of them, as chunks."""
    rows, columns = _square(shape)
    padded = (-(-shape[-2] // rows) * rows, -(-shape[-1] // columns) * columns)
    return {
        "chunks": (1, 1, rows, columns),
        "shards": (1, shape[1], *padded),
        "compressors": import_zarr().codecs.BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
        "dimension_names": tuple("tzyx"),
    }


def tile_shards(planes: int, side: int) -> dict[str, Any]:
    """Storage of a volume in tiles: each tile of `side` x `side` is a file, with squares of its planes as chunks."""
    chunk = next(side // parts for parts in range(-(-side // CHUNK), side + 1) if side % parts == 0)
    storage = frame_shards((1, planes, side, side))
    return storage | {"chunks": (1, chunk, chunk), "shards": (planes, side, side), "dimension_names": tuple("zyx")}


def _square(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(min(n, CHUNK) for n in shape[-2:])


Note = dict[str, Any]


class VolumeSeries:
    """Writes the volumes of a recording; not thread-safe.

    Parameters
    ----------
    path
        Store, ends in `.zarr`. It is made with the first frame, and replaces an image of that name.
    count, grid
        Number of frames, None if they are to be added, and the grid of each.
    interval
        Seconds between frames, if they are known.
    request
        Options that the volumes depend on, as texts, which a resumed run must share.
    provenance
        Kept in the store.
    resume
        Continue what is there, if anything.
    tile
        Side of the tiles of one volume, in voxels: they are its frames, row by row. It is a multiple of `tile_unit`.

    Raises
    ------
    InputError
        If `resume` finds the store of another recording; on the first frame, if the depths are not in even steps.
    """

    def __init__(
        self,
        path: Path,
        count: int | None,
        grid: Grid,
        *,
        interval: float | None = None,
        request: dict[str, str] | None = None,
        provenance: Provenance | None = None,
        resume: bool = False,
        tile: int | None = None,
    ):
        self.path, self.grid, self.interval, self.tile = path, grid, interval, tile
        self._declared, self.count = count, count or 0
        # Of frames that were added, and how many of them the journal has.
        self.names: list[str] = []
        self._journaled = 0
        self.request, self.provenance = request or {}, provenance or {}
        self.finished: set[int] = set()
        self.failed: dict[int, str] = {}
        self._levels: list[Any] = []
        if resume and path.exists():
            self._resume()

    @property
    def unfinished(self) -> list[int]:
        """Frames to make, failed ones included."""
        return [frame for frame in range(self.count) if frame not in self.finished]

    @property
    def parts(self) -> str:
        """What its frames are."""
        return "tiles" if self.tile else "frames"

    @property
    def exists(self) -> bool:
        """Whether the store exists, so that other processes can write volumes by `write_frame`."""
        return bool(self._levels)

    def add(self, name: str) -> int:
        """Append a frame of this name, which the journal has with the next volume or failure; return its number."""
        self.names.append(name)
        self.count = len(self.names)
        return self.count - 1

    def write(self, frame: int, volume: Volume | None, note: Note | None = None) -> None:
        """Write the volume of a frame, counted from 0, then its note to the journal.

        `volume` is None if another process has written it.
        """
        if volume is not None:
            if not self._levels:
                self.create(volume)
            self._grow()
            write_frame(self.path, self._levels, frame, volume, self.tile)
        self._append({"frame": frame, **(note or {})})
        self.finished.add(frame)
        self.failed.pop(frame, None)

    def fail(self, frame: int, reason: str) -> None:
        """Record why a frame has no volume."""
        self.failed[frame] = reason
        if self._levels:
            self._grow()
            self._append({"frame": frame, "error": reason})

    def notes(self) -> Iterator[tuple[int, Note]]:
        """Yield the finished frames in their order with their notes, which are read one at a time."""
        if not self._levels:
            return
        with open(self.path / JOURNAL, "rb") as file:
            for frame, offset in sorted(_finished(self.path).items()):
                file.seek(offset)
                yield frame, json.loads(file.readline())

    def _append(self, *notes: Note) -> None:
        journal = self.path / JOURNAL
        with disk_errors_name(self.path, journal), open(journal, "a", encoding="utf-8", newline="\n") as file:
            file.write("".join(json.dumps(note) + "\n" for note in notes))

    def _grow(self) -> None:
        """Make room for the frames that were added, and write their names."""
        count, first = self.count, self._journaled
        if self._declared is not None or count == first:
            return
        with disk_errors_name(self.path, self.path):
            for array in self._levels:
                array.resize((count, *array.shape[1:]))
        self._append(*({"frame": frame, "name": self.names[frame]} for frame in range(first, count)))
        self._journaled = count

    def create(self, volume: Volume) -> None:
        """Make the store without a frame, with the display range of a volume."""
        zarr, shapes = import_zarr(), _pyramid(self.grid.shape)
        depths = plain_depths(self.grid)
        options = {"version": "0.5", "in_time": self.tile is None, "interval": self.interval}
        attributes = image_attributes(self.path, depths, self.grid, len(shapes), volume, self.provenance, **options)
        with atomic_write(self.path) as temporary:
            group = zarr.create_group(store=temporary, zarr_format=3, attributes=attributes)
            for level, shape in enumerate(shapes):
                size = (max(self.count, 1), len(depths), *shape)
                storage = tile_shards(len(depths), self.tile >> level) if self.tile else frame_shards(size)
                size = size[1:] if self.tile else size
                group.create_array(str(level), shape=size, dtype=volume.dtype, **storage)
            lines = [{"request": self.request, "frames": self._declared}]
            lines += [{"frame": frame, "error": reason} for frame, reason in self.failed.items()]
            text = "".join(json.dumps(line) + "\n" for line in lines)
            (temporary / JOURNAL).write_text(text, encoding="utf-8", newline="\n")
        self._levels = open_levels(self.path, self.grid)

    def _resume(self) -> None:
        head = _read_head(self.path)
        if head is None:
            raise input_error("store for --resume", "what an interrupted recording left", "another store", self.path)
        now, before = (
            {**request, "frames": "those of a watched folder" if count is None else str(count)}
            for request, count in ((self.request, self._declared), head)
        )
        for key in dict.fromkeys([*now, *before]):
            if before.get(key) != now.get(key):
                given, allowed = (short_repr(options[key]) if key in options else "none" for options in (now, before))
                raise input_error(f"{key} with --resume", f"{allowed}, as before", given, self.path)
        journal = self.path / JOURNAL
        with open(journal, "rb") as file:
            for note, _ in _lines(file):
                frame = note["frame"]
                if "name" in note:
                    self.names.append(note["name"])
                elif error := note.get("error", ""):
                    self.failed[frame] = error
                else:
                    self.finished.add(frame)
                    self.failed.pop(frame, None)
            whole = file.tell()
        if self._declared is None:
            self.count = self._journaled = len(self.names)
        os.truncate(journal, whole)
        self._levels = open_levels(self.path, self.grid)


def open_levels(path: Path, grid: Grid) -> list[Any]:
    """Open the arrays of an existing store for writing: the full size, and each next of half its rows and columns."""
    group = import_zarr().open_group(path, mode="r+")
    return [group[str(level)] for level in range(len(_pyramid(grid.shape)))]


def tile_unit(shape: tuple[int, ...]) -> int:
    """Number of which the side of tiles is a multiple, so that they end between voxels of all levels."""
    return 2 ** (len(_pyramid(shape)) - 1)


def write_frame(path: Path, levels: list[Any], frame: int, volume: Volume, tile: int | None = None) -> None:
    """Write the volume of a frame, or of a tile, to arrays of `open_levels`: one file each, whole or not at all."""
    zarr = import_zarr()
    key: tuple[int, ...] = (frame, 0, 0, 0)
    if tile:
        key = (0, *divmod(frame, -(-levels[0].shape[-1] // tile)))
    # Plane by plane, as zarr does otherwise, takes twice as long: each is handed to another thread and waited for.
    with disk_errors_name(path, path), zarr.config.set({"codec_pipeline.batch_size": len(volume)}):
        for level, array in enumerate(levels):
            volume = halve(volume) if level else volume
            # Left by a process that was killed while it wrote the frame.
            for partial in Path(path, str(level), "c", *map(str, key[:-1])).glob(f"{key[-1]}.*partial"):
                partial.unlink(missing_ok=True)
            if tile:
                first = [at * (tile >> level) for at in key[1:]]
                place = (slice(None), *(slice(a, a + n) for a, n in zip(first, volume.shape[1:], strict=True)))
            else:
                place = frame
            array[place] = volume


def _read_head(path: PathLike) -> tuple[dict[str, str], int | None] | None:
    """The request of a store and its number of frames, None of one that grows; None without a journal."""
    try:
        with open(Path(path) / JOURNAL, encoding="utf-8") as file:
            head = json.loads(file.readline())
        count = head["frames"]
        return {str(key): str(value) for key, value in head["request"].items()}, count and int(count)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


class Series(NamedTuple):
    """Volumes in time, not yet read.

    `levels` are Zarr arrays `(t, z, y, x)`, the first of the full size; `scale` and `first` its steps and the centre of
    its first voxel, in um and in seconds (frames, if `interval` is None); `display` is the range of displayed values.
    """

    levels: list[Any]
    scale: list[float]
    first: list[float]
    interval: float | None
    display: tuple[float, float]


def read_series(path: PathLike) -> Series | None:
    """Open what `VolumeSeries` wrote; None if it is anything else."""
    if _read_head(path) is None:
        return None
    zarr = import_zarr()
    with decoding(path, "OME-Zarr"):
        group = zarr.open_group(path, mode="r")
        attributes = ngff_attributes(group)
        (image,), window = attributes["multiscales"], attributes["omero"]["channels"][0]["window"]
        scale, first = image["datasets"][0]["coordinateTransformations"]
        interval = scale["scale"][0] if "unit" in image["axes"][0] else None
        levels = [group[each["path"]] for each in image["datasets"]]
        time, z, *rest = first["translation"]
        places = [time, z + um(surface_of(path)), *rest]
        return Series(levels, scale["scale"], places, interval, (window["start"], window["end"]))


def series_grid(series: Series) -> Grid:
    """Positions of the voxels of a frame, with depths from the array."""
    _, z, y, x = series.levels[0].shape
    step, _, pitch = (value / 1000 for value in series.scale[1:])
    depth, *first = (value / 1000 for value in series.first[1:])
    origin = [round(at + (n - 1) / 2 * pitch, 9) for at, n in zip(first, (y, x), strict=True)]
    return Grid([round(depth + index * step, 9) for index in range(z)], (y, x), pitch, origin[::-1])


def frames_of(count: int, path: PathLike | None) -> list[int]:
    """Numbers of the first `count` frames that have a volume; others of what `VolumeSeries` wrote read as zeros.

    Raises `InputError` if there is none.
    """
    frames = list(range(count))
    if path and _read_head(path) is not None:
        frames = [frame for frame in sorted(_finished(Path(path))) if frame < count]
    if not frames:
        raise InputError(f"{path or 'recording'}: must have volumes, got none that is finished.")
    return frames


def check_replaceable(path: Path, otherwise: str = "--force to replace it") -> None:
    """Raise `InputError` if the path has an unfinished recording, which `VolumeSeries` would replace."""
    if (head := _read_head(path)) is None:
        return
    done, (_, count) = len(_finished(path)), head
    if count is None or done < count:
        parts = "tiles of an interrupted run" if "tiles" in head[0] else "frames of an interrupted recording"
        watched = f"{done} frame{'s' * (done != 1)} of a watched folder"
        frames = watched if count is None else f"{done} of {count} {parts}"
        raise InputError(f"{path}: has {frames}; give --resume to continue it, or {otherwise}.")


def _lines(file) -> Iterator[tuple[Note, int]]:
    """Notes of an open journal and the offsets of their lines; it is left at the end of its last whole line."""
    file.readline()
    while (line := file.readline()).endswith(b"\n"):
        yield json.loads(line), file.tell() - len(line)
    file.seek(-len(line), os.SEEK_CUR)


def _finished(path: Path) -> dict[int, int]:
    """Frames that have a volume, each with the offset of its last note in the journal of a store."""
    with open(path / JOURNAL, "rb") as file:
        return {note["frame"]: offset for note, offset in _lines(file) if not {"error", "name"} & note.keys()}


def _pyramid(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Rows and columns of the levels, each half of the last, until one chunk holds a plane."""
    shapes = [(shape[0], shape[1])]
    while max(shapes[-1]) > CHUNK:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    return shapes


def halve(volume: Volume) -> Float32[np.ndarray, "depth _ _"]:
    """Mean of 2 x 2 voxels of each plane; at an odd end, of those that are there."""
    odd = [(0, 0), *((0, n % 2) for n in volume.shape[1:])]
    even = np.pad(volume, odd, mode="edge") if volume.shape[1] % 2 or volume.shape[2] % 2 else volume
    return (even[:, ::2, ::2] + even[:, 1::2, ::2] + even[:, ::2, 1::2] + even[:, 1::2, 1::2]) / np.float32(4)
