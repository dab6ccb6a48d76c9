"""The molded surface as a height map and as a list of lenses, in files for makers and optical programs.

Heights are written as float TIFF and 16-bit PNG, as x y z text and as OpticStudio's grid sag; lenses as a table. Each
file is read back and compared with the design. Lengths in mm.

There are two frames, both right-handed, with the design's x. That of the maker looks at the lenses: x to the right, y
up, z toward the viewer, 0 on the plate between the lenses. That of optical programs has z along the light, 0 at the
vertices, and y against the design's. Where the plano side faces the object, they differ by a shift along z alone.
"""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Float, Int
from PIL import Image, PngImagePlugin

from ..base.errors import InputError, input_error
from ..base.progress import Progress
from ..base.typing import PathLike
from ..design.conversion import AIR
from ..design.design import Design
from ..io.files import atomic_write, check_output, decoding, write_json
from ..io.provenance import KEY, Provenance, sidecar
from .lenslets import Part
from .manufacturability import check_design, open_design, raise_first_error
from .solids import MoldShape

# OpticStudio reads no smaller grids.
MIN_POINTS = 5
# Largest difference between a file and the design, mm. PNG has half a step more.
TOLERANCE = 1e-6
# Points of a file (text takes up to 80 bytes each), and points that are computed at a time.
_MAX_POINTS, _MAX_LINES, _BLOCK = 2**28, 2**25, 2**19
_COUNTS = 2**16 - 1
# Points along the shorter side at which a list of lenses is compared.
_LIST_POINTS = 500
# Relative step of the difference that gives the cross derivative.
_STEP = 1e-4
# Digits of x, y and z in text: 0.05 nm.
_XYZ = "%.7f %.7f %.7f\n"
_GRID_SAG = "%.8f %.9g %.9g %.9g 0\n"

MAKER = "seen from the side of the lenses: x to the right, y up, z toward the viewer, z = 0 on the plate between lenses"
OPTICAL = "z along the light, z = 0 at the vertices of the lenses"

Heights = Float[np.ndarray, "row column"]


@dataclass(frozen=True)
class HeightMap:
    """Heights above the plate between the lenses, at points `step` apart, centred on the plate, mm.

    Columns are ordered from the smallest x. Rows are ordered from the largest y to the smallest: of the frame of the
    maker, or of optical programs if `optical`.

    Raises `InputError` if the plate is infinite, or `step` leaves fewer than `MIN_POINTS` or more than `most` points.
    """

    part: Part
    step: float
    optical: bool = False
    most: int = _MAX_POINTS

    def __post_init__(self):
        if self.part.array.size is None:
            raise InputError("`array.size_mm` must be finite, got an infinite plate.")
        (rows, columns), given = self.shape, f"{1000 * self.step:g} um"
        if min(rows, columns) < MIN_POINTS:
            most = min(self.part.size) / (MIN_POINTS - 1)
            raise input_error("step of the grid", f"at most {1000 * most:.4g} um", given)
        if rows * columns > self.most:
            least = 1000 * self.step * (rows * columns / self.most) ** 0.5
            needs = f"at least {least:.3g} um for this file and plate"
            raise input_error("step of the grid", needs, f"{given}: {columns} x {rows} points")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        columns, rows = (math.floor(side / self.step * (1 + 1e-9)) + 1 for side in self.part.size)
        return rows, columns

    @property
    def sign(self) -> float:
        """Direction of the heights along z: -1 for optical programs if the curved side faces the object."""
        return -1.0 if self.optical and self.part.array.orientation == "curved" else 1.0

    @cached_property
    def x(self) -> Float[np.ndarray, " column"]:
        """Of each column, mm."""
        return _centred(self.shape[1]) * self.step

    @cached_property
    def y(self) -> Float[np.ndarray, " row"]:
        """Of each row, in the frame of the part, which is against that of the maker, mm."""
        return self.sign * _centred(self.shape[0]) * self.step

    def blocks(self) -> Iterator[tuple[slice, Heights, Int[np.ndarray, "row column"]]]:
        """Yields some rows at a time, their heights, and the lenslet at each point, -1 on the plate and walls."""
        rows, columns = self.shape
        size = max(1, _BLOCK // columns)
        for first in range(0, rows, size):
            some = slice(first, min(first + size, rows))
            yield some, *self.part.surface(self.x, self.y[some])

    def pixels(self, dtype: type, unit: float) -> np.ndarray:
        """All heights in a unit, mm, rounded if the type is of integers."""
        pixels = np.empty(self.shape, dtype)
        for rows, height, _ in self.blocks():
            pixels[rows] = np.rint(height / unit) if np.issubdtype(dtype, np.integer) else height / unit
        return pixels

    def derivatives(self, rows: slice, owner: Int[np.ndarray, "row column"]) -> Float[np.ndarray, "3 row column"]:
        """Derivatives of the heights by x, by y and by both, in the frame of the part; 0 on the plate and walls."""
        x, y = np.meshgrid(self.x, self.y[rows])
        values = np.zeros((3, *x.shape))
        for number in np.unique(owner[owner >= 0]).tolist():
            lenslet, its = self.part.lenslets[number], owner == number
            dx, dy = x[its] - lenslet.center[0], y[its] - lenslet.center[1]
            squared, around = dx**2 + dy**2, _STEP * lenslet.semi_aperture**2
            low, high = np.maximum(squared - around, 0), np.minimum(squared + around, lenslet.semi_aperture**2)
            slope = lenslet.sag_slope_over_r(squared)
            change = (lenslet.sag_slope_over_r(high) - lenslet.sag_slope_over_r(low)) / (high - low)
            values[:, its] = -slope * dx, -slope * dy, -2 * change * dx * dy
        return values


def _centred(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


def write_heights(
    design: Design | PathLike,
    path: PathLike,
    *,
    step: float = 0.01,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Writes the molded surface of a design for makers and optical programs, and a description beside it.

    The file is read back and compared with the design.

    Parameters
    ----------
    design
        The microscope, or its file.
    path
        `.tif` for heights in float32, `.png` for heights in 16 bits, `.xyz` for text, `.dat` for a grid sag, `.csv` for
        a list of lenses. The description has this name plus `.json`.
    step
        Distance of points, mm; not of lenses.
    provenance
        Metadata of the file.
    progress
        Shows the steps; nothing by default.

    Returns
    -------
    dict
        The description.

    Raises
    ------
    InputError
        If a file cannot be read or written, the design cannot be manufactured, or the grid has too few or too many
        points, before anything is written.
    RuntimeError
        If the file that was read back deviates from the design by more than 1 nm, for PNG more than half a step: an
        error of the program.
    """
    progress = progress or Progress()
    path = check_output(path, HEIGHT_SUFFIXES)
    beside = check_output(sidecar(path), [".json"])
    design, source = open_design(design)
    raise_first_error(check_design(design, MoldShape(), chord=4e-4, resolution=0.025), InputError, source)
    part, suffix = Part(design.imager(AIR).array), path.suffix.lower()
    is_list, optical = suffix == ".csv", suffix in (".csv", ".dat")
    step_used = min(part.size) / _LIST_POINTS if is_list else step
    heights = HeightMap(part, step_used, optical, _MAX_LINES if suffix in (".xyz", ".dat") else _MAX_POINTS)
    from_sensor = part.array.orientation == "plano"
    report = {
        "design": design.name,
        "file": path.name,
        "unit": "mm",
        "frame": OPTICAL if optical else MAKER,
        "lenses_face": "the sensor" if from_sensor else "the object",
        "design_x_y": "x, -y" if optical or from_sensor else "x, y",
        "vertex_height_mm": part.height,
        "plate_thickness_mm": part.thickness,
    }
    report |= {"objects": 1 + len(part.centers)} if is_list else {"points": heights.shape[::-1], "step_mm": step}
    if suffix == ".png":
        report["mm_per_count"] = part.height / _COUNTS
    write, read = _FORMATS[suffix]
    # The temporary file gets its name only if it passes.
    with atomic_write(path) as temporary:
        with progress.step("Writing"):
            write(temporary, heights, report | {KEY: dict(provenance or {})})
        with progress.step("Reading back"), decoding(temporary, f"{suffix} file"):
            deviation = max(float(np.abs(values).max()) for values in read(temporary, heights))
        allowed = TOLERANCE + report.get("mm_per_count", 0.0) / 2
        if not deviation <= allowed:
            raise RuntimeError(f"{path} deviates from the design by {deviation:.3g} mm, more than {allowed:.3g} mm")
    report["deviation_nm"] = 1e6 * deviation
    write_json(beside, report | {KEY: dict(provenance or {})})
    return report


# Each format has a function that writes a file, and one that reads it and yields differences from the design, mm.


def _write_tiff(path: Path, heights: HeightMap, report: dict[str, Any]) -> None:
    per_cm = 10 / heights.step
    tags = {"resolution": (per_cm, per_cm), "resolutionunit": "CENTIMETER", "description": json.dumps(report)}
    tifffile.imwrite(path, heights.pixels(np.float32, 1.0), photometric="minisblack", metadata=None, **tags)


def _write_png(path: Path, heights: HeightMap, report: dict[str, Any]) -> None:
    about = PngImagePlugin.PngInfo()
    for key, value in report.items():
        about.add_text(key, json.dumps(value))
    Image.fromarray(heights.pixels(np.uint16, report["mm_per_count"])).save(path, format="PNG", pnginfo=about)


def _check_tiff(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    yield from _check_pixels(tifffile.memmap(path, mode="r"), 1.0, heights)


def _check_png(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with Image.open(path, formats=["PNG"]) as image:
        yield from _check_pixels(np.asarray(image), json.loads(image.info["mm_per_count"]), heights)


def _check_pixels(pixels: np.ndarray, unit: float, heights: HeightMap) -> Iterator[np.ndarray]:
    yield from (pixels[rows] * unit - height for rows, height, _ in heights.blocks())


def _write_xyz(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    with open(path, "w", encoding="ascii", newline="\n") as file:
        for rows, height, _owner in heights.blocks():
            _write_lines(file, _XYZ, *np.meshgrid(heights.x, -heights.y[rows]), height)


def _check_xyz(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with open(path, encoding="ascii") as file:
        for rows, height, _ in heights.blocks():
            yield _read_lines(file, 3, height.shape) - np.stack([*np.meshgrid(heights.x, -heights.y[rows]), height])


def _write_grid_sag(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    """OpticStudio: a line of sizes, then z, dz/dx, dz/dy, d2z/dxdy and a flag of each point, from the largest y."""
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"{heights.shape[1]} {heights.shape[0]} {heights.step:.10g} {heights.step:.10g} 0 0 0\n")
        for rows, height, owner in heights.blocks():
            dx, dy, dxdy = heights.derivatives(rows, owner)
            z = heights.sign * (height - heights.part.height)
            _write_lines(file, _GRID_SAG, z, heights.sign * dx, -dy, -dxdy)


def _check_grid_sag(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with open(path, encoding="ascii") as file:
        columns, rows, dx, dy, unit, *_ = map(float, file.readline().split())
        if (rows, columns) != heights.shape or unit or not np.allclose((dx, dy), heights.step, rtol=1e-9, atol=0):
            raise ValueError("another grid")
        for _rows, height, _owner in heights.blocks():
            z, *_ = _read_lines(file, 5, height.shape)
            yield z - heights.sign * (height - heights.part.height)


def _write_lines(file, line: str, *columns: np.ndarray) -> None:
    table = np.stack([column.ravel() for column in columns], axis=1)
    # Zeros without a sign.
    file.write(line * len(table) % tuple((table + 0.0).ravel().tolist()))


def _read_lines(file, columns: int, shape: tuple[int, ...]) -> np.ndarray:
    text = "".join(islice(file, math.prod(shape)))
    return np.fromstring(text, sep=" ").reshape(*shape, columns).transpose(2, 0, 1)


def lens_table(part: Part) -> list[dict[str, str | float]]:
    """A list of objects for non-sequential ray tracing, in the frame of optical programs.

    The first is the plate, the others are plano-convex lenses of the same material, which begin in its middle: the
    array is their union. Positions are those of front faces, radii and coefficients have the signs of OpticStudio.
    """
    array, middle = part.array, part.plate_thickness / 2 + part.height
    is_front, index = array.orientation == "curved", float(array.refractive_index)
    side = 1.0 if is_front else -1.0  # of the centres of curvature, and of the plate, along z
    front = part.height if is_front else -part.thickness
    plate = {"object_type": "Rectangular Volume", "comment": "plate", "x_mm": 0.0, "y_mm": 0.0, "z_mm": front}
    plate |= {"refractive_index": index, "x_half_width_mm": part.size[0] / 2, "y_half_width_mm": part.size[1] / 2}
    rows: list[dict[str, str | float]] = [plate | {"thickness_mm": part.plate_thickness}]
    for number, (lens, (x, y)) in enumerate(zip(part.lenslets, np.asarray(array.centers, float), strict=True), 1):
        row: dict[str, str | float] = {"object_type": "Even Asphere Lens" if lens.terms else "Standard Lens"}
        row |= {"comment": f"lens {number}", "x_mm": x, "y_mm": -y, "z_mm": 0.0 if is_front else -middle}
        row |= {"refractive_index": index, "thickness_mm": middle}
        for face in "12":
            is_curved = (face == "1") == is_front
            row |= {f"radius_{face}_mm": side * lens.radius if is_curved else 0.0}
            row |= {f"conic_{face}": lens.conic if is_curved else 0.0}
            row |= {f"{kind}_semi_diameter_{face}_mm": lens.semi_aperture for kind in ("clear", "edge")}
        for order, term in enumerate(lens.terms, 2):
            row |= {f"coefficient_r{2 * order}_per_mm{2 * order - 1}": side * term}
        rows.append(row)
    return rows


def _write_lenses(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    # A column of a plate is empty in lenses, and the other way round.
    plate, *lenses = rows = lens_table(heights.part)
    with open(path, "w", encoding="ascii", newline="") as file:
        table = csv.DictWriter(file, list(plate | lenses[0]), restval="", lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({key: x if isinstance(x, str) else f"{x + 0.0:.7g}" for key, x in row.items()})


def _check_lenses(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    """Differences of the vertices' heights, and of the listed surfaces but for walls, which have no draft there."""
    with open(path, encoding="ascii", newline="") as file:
        plate, *rows = csv.DictReader(file)
    # The plate's face and the vertices are in front if the curved side faces the object.
    face, sign, end = ("1", -1.0, 0.0) if heights.sign < 0 else ("2", 1.0, 1.0)

    def of(row: dict[str, str], *names: str) -> np.ndarray:
        return np.array([float(row[name]) for name in names])

    base = of(plate, "z_mm", "thickness_mm") @ (1, end)
    vertices = np.array([of(row, "z_mm", "thickness_mm") @ (1, end) for row in rows])
    yield sign * (vertices - base) - heights.part.height
    # By the formula of the list's own numbers, not by the code that wrote them.
    for some, height, owner in heights.blocks():
        y, x = np.meshgrid(-sign * heights.y[some], heights.x, indexing="ij")
        values = np.zeros(x.shape)
        for row, vertex in zip(rows, vertices, strict=True):
            radius, conic, edge = of(row, f"radius_{face}_mm", f"conic_{face}", f"clear_semi_diameter_{face}_mm")
            squared = (x - float(row["x_mm"])) ** 2 + (y - float(row["y_mm"])) ** 2
            inside = squared <= edge**2
            c, r2 = 1 / radius, squared[inside]
            z = vertex + c * r2 / (1 + np.sqrt(1 - (1 + conic) * c**2 * r2))
            for order, term in enumerate(of(row, *(name for name in row if name.startswith("coefficient_"))), 2):
                z = z + term * r2**order
            values[inside] = np.maximum(values[inside], sign * (z - base))
        yield np.where((owner >= 0) | (height == 0), values - height, 0)


_FORMATS = {
    ".tif": (_write_tiff, _check_tiff),
    ".png": (_write_png, _check_png),
    ".xyz": (_write_xyz, _check_xyz),
    ".dat": (_write_grid_sag, _check_grid_sag),
    ".csv": (_write_lenses, _check_lenses),
}
HEIGHT_SUFFIXES = tuple(_FORMATS)
