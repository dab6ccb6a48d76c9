"""Files of the molded surface for makers and optical programs, read back and compared with the design. Lengths in mm.

Heights are written as float TIFF and 16-bit PNG, as x y z text and as OpticStudio's grid sag; lenses as a table.
"""

import csv
import json
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image, PngImagePlugin

from ..base.errors import InputError, input_error
from ..base.progress import Progress
from ..design.conversion import AIR
from ..design.design import Design, read_design
from ..io.files import atomic_write, check_output, decoding, write_json
from ..io.provenance import KEY, Provenance, sidecar
from ..typing import PathLike
from .height_map import MAKER, OPTICAL, HeightMap, lens_table
from .manufacturability import check_design, raise_first_error
from .solids import MoldShape

# Largest difference between a file and the design, mm. PNG has half a step more.
TOLERANCE = 1e-6
# Points of a file: text takes up to 80 bytes each.
_MAX_POINTS, _MAX_LINES = 2**28, 2**25
_COUNTS = 2**16 - 1
# Points along the shorter side at which a list of lenses is compared.
_LIST_POINTS = 500
# Digits of x, y and z in text: 0.05 nm.
_XYZ = "%.7f %.7f %.7f\n"
_GRID_SAG = "%.8f %.9g %.9g %.9g 0\n"


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
    source = f"design {design.name!r}" if isinstance(design, Design) else os.fspath(design)
    design = design if isinstance(design, Design) else read_design(design)
    raise_first_error(check_design(design, MoldShape(), chord=4e-4, resolution=0.025), InputError, source)
    array, suffix = design.imager(AIR).array, path.suffix.lower()
    is_list, is_optical = suffix == ".csv", suffix in (".csv", ".dat")
    heights = HeightMap(array, min(array.plate) / _LIST_POINTS if is_list else step)
    _check_count(heights, _MAX_LINES if suffix in (".xyz", ".dat") else _MAX_POINTS)
    report = {
        "design": design.name,
        "file": path.name,
        "unit": "mm",
        "frame": OPTICAL if is_optical else MAKER,
        "lenses_face": "the sensor" if array.orientation == "plano" else "the object",
        "design_x_y": "x, -y" if is_optical or array.orientation == "plano" else "x, y",
        "vertex_height_mm": heights.top,
        "plate_thickness_mm": float(array.substrate_thickness),
    }
    if is_list:
        report["objects"] = 1 + len(array.centers)
    else:
        report |= {"points": heights.shape[::-1], "step_mm": step}
    if suffix == ".png":
        report["mm_per_count"] = heights.top / _COUNTS
    # The temporary file gets its name only if it passes.
    with atomic_write(path) as temporary:
        with progress.step("Writing"):
            _WRITERS[suffix](temporary, heights, report | {KEY: dict(provenance or {})})
        with progress.step("Reading back"):
            deviation = _deviation(temporary, suffix, heights)
        allowed = TOLERANCE + report.get("mm_per_count", 0.0) / 2
        if not deviation <= allowed:
            raise RuntimeError(f"{path} deviates from the design by {deviation:.3g} mm, more than {allowed:.3g} mm")
    report["deviation_nm"] = 1e6 * deviation
    write_json(beside, report | {KEY: dict(provenance or {})})
    return report


def _check_count(heights: HeightMap, most: int) -> None:
    rows, columns = heights.shape
    if rows * columns > most:
        least = 1000 * heights.step * (rows * columns / most) ** 0.5
        given = f"{1000 * heights.step:g} um: {columns} x {rows} points"
        raise input_error("step of the grid", f"at least {least:.3g} um for this file and plate", given)


def _write_tiff(path: Path, heights: HeightMap, report: dict[str, Any]) -> None:
    per_cm = 10 / heights.step
    tifffile.imwrite(
        path,
        _all(heights, np.float32, 1.0),
        photometric="minisblack",
        description=json.dumps(report),
        metadata=None,
        resolution=(per_cm, per_cm),
        resolutionunit="CENTIMETER",
    )


def _write_png(path: Path, heights: HeightMap, report: dict[str, Any]) -> None:
    about = PngImagePlugin.PngInfo()
    for key, value in report.items():
        about.add_text(key, json.dumps(value))
    Image.fromarray(_all(heights, np.uint16, report["mm_per_count"])).save(path, format="PNG", pnginfo=about)


def _all(heights: HeightMap, dtype, unit: float) -> np.ndarray:
    pixels = np.empty(heights.shape, dtype)
    for rows in heights.blocks():
        found = heights.surface(rows)[0] / unit
        pixels[rows] = np.rint(found) if np.issubdtype(dtype, np.integer) else found
    return pixels


def _write_xyz(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    with open(path, "w", encoding="ascii", newline="\n") as file:
        for rows in heights.blocks():
            y, x = np.meshgrid(heights.y[rows], heights.x, indexing="ij")
            _write_lines(file, _XYZ, x, y, heights.surface(rows)[0])


def _write_grid_sag(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    """OpticStudio: a line of sizes, then z, dz/dx, dz/dy, d2z/dxdy and a flag of each point, from the largest y."""
    (rows, columns), step = heights.shape, f"{heights.step:.10g}"
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"{columns} {rows} {step} {step} 0 0 0\n")
        for part in _optical_blocks(heights):
            height, owner = heights.surface(part)
            _write_lines(file, _GRID_SAG, *_to_optical(heights, height, heights.derivatives(part, owner)))


def _optical_blocks(heights: HeightMap) -> list[slice]:
    """Rows in the order of grid sags. An array that is turned over has the other y."""
    blocks = list(heights.blocks())
    return blocks if heights.array.orientation == "plano" else blocks[::-1]


def _to_optical(heights: HeightMap, height, derivatives):
    """Sag and its derivatives from heights, turned over about x if the curved side faces the object."""
    dx, dy, dxdy = derivatives
    if heights.array.orientation == "plano":
        return height - heights.top, dx, dy, dxdy
    return (heights.top - height)[::-1], -dx[::-1], dy[::-1], dxdy[::-1]


def _write_lines(file, line: str, *columns: np.ndarray) -> None:
    table = np.stack([column.ravel() for column in columns], axis=1)
    # Zeros without a sign.
    file.write(line * len(table) % tuple((table + 0.0).ravel().tolist()))


def _write_lenses(path: Path, heights: HeightMap, _: dict[str, Any]) -> None:
    columns, rows = lens_table(heights.array)
    with open(path, "w", encoding="ascii", newline="") as file:
        table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({key: x if isinstance(x, str) else f"{x + 0.0:.7g}" for key, x in row.items()})


_WRITERS = {".tif": _write_tiff, ".png": _write_png, ".xyz": _write_xyz, ".dat": _write_grid_sag, ".csv": _write_lenses}
HEIGHT_SUFFIXES = tuple(_WRITERS)


def _deviation(path: Path, suffix: str, heights: HeightMap) -> float:
    """Largest difference between the heights in a file and those of the design, mm."""
    with decoding(path, f"{suffix} file"):
        if suffix == ".csv":
            return _lens_deviation(path, heights)
        read = {".tif": _read_tiff, ".png": _read_png, ".xyz": _read_xyz, ".dat": _read_grid_sag}[suffix]
        found = read(path, heights)
        return max(
            float(np.abs(next(found) - heights.surface(rows)[0]).max())
            for rows in (_optical_blocks(heights) if suffix == ".dat" else heights.blocks())
        )


def _read_tiff(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    pixels = tifffile.memmap(path, mode="r")
    yield from (pixels[rows].astype(float) for rows in heights.blocks())


def _read_png(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with Image.open(path, formats=["PNG"]) as image:
        scale, pixels = json.loads(getattr(image, "text", {})["mm_per_count"]), np.asarray(image)
    yield from (pixels[rows] * scale for rows in heights.blocks())


def _read_xyz(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with open(path, encoding="ascii") as file:
        for rows in heights.blocks():
            x, y, z = _read_lines(file, 3, (rows.stop - rows.start, heights.shape[1]))
            off = max(np.abs(x - heights.x).max(), np.abs(y.T - heights.y[rows]).max())
            yield z if off <= TOLERANCE else np.full_like(z, np.inf)


def _read_grid_sag(path: Path, heights: HeightMap) -> Iterator[np.ndarray]:
    with open(path, encoding="ascii") as file:
        columns, rows, dx, dy, unit, *_ = map(float, file.readline().split())
        if (rows, columns) != heights.shape or unit or not np.allclose((dx, dy), heights.step, rtol=1e-9, atol=0):
            raise ValueError("another grid")
        for part in _optical_blocks(heights):
            z, *_ = _read_lines(file, 5, (part.stop - part.start, int(columns)))
            yield z + heights.top if heights.array.orientation == "plano" else (heights.top - z)[::-1]


def _read_lines(file, columns: int, shape: tuple[int, int]) -> np.ndarray:
    text = "".join(islice(file, shape[0] * shape[1]))
    return np.fromstring(text, sep=" ").reshape(*shape, columns).transpose(2, 0, 1)


def _lens_deviation(path: Path, heights: HeightMap) -> float:
    """As `_deviation`, of the union of the listed objects, except on walls, which have no draft in the list."""
    with open(path, encoding="ascii", newline="") as file:
        plate, *lenses = csv.DictReader(file)
    # The plate's face and the vertices are in front if the curved side faces the object.
    turned = heights.array.orientation == "curved"
    face, sign, end = ("1", -1.0, 0.0) if turned else ("2", 1.0, 1.0)
    number = lambda row, name: float(row[name])
    base = number(plate, "z_mm") + end * number(plate, "thickness_mm")
    worst = 0.0
    for rows in heights.blocks():
        height, owner = heights.surface(rows)
        y, x = np.meshgrid(sign * heights.y[rows], heights.x, indexing="ij")
        found = np.zeros(x.shape)
        for lens in lenses:
            squared = (x - number(lens, "x_mm")) ** 2 + (y - number(lens, "y_mm")) ** 2
            inside = squared <= number(lens, f"clear_semi_diameter_{face}_mm") ** 2
            c, k, r2 = 1 / number(lens, f"radius_{face}_mm"), number(lens, f"conic_{face}"), squared[inside]
            z = number(lens, "z_mm") + end * number(lens, "thickness_mm")
            z = z + c * r2 / (1 + np.sqrt(1 - (1 + k) * c**2 * r2))
            for order, name in enumerate((name for name in lens if name.startswith("coefficient_")), 2):
                z = z + number(lens, name) * r2**order
            found[inside] = np.maximum(found[inside], sign * (z - base))
        difference = np.abs(found - height)[(owner >= 0) | (height == 0)]
        worst = max(worst, float(difference.max(initial=0.0)))
    return worst
