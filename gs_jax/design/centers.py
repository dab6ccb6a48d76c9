"""Lens centres on disk: the file that a design names, in whatever unit, order and frame it is."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, ValidationError

from ..base.errors import InputError, errors_name_file
from ..io.files import write_text
from ..io.names import PIXELS, in_mm, unit_of_name
from ..io.point_tables import read_columns
from ..io.provenance import Provenance, write_sidecar
from ..io.toml import Table, one_line
from ..typing import PathLike

CENTERS_HEADER = "x_mm,y_mm"
MAX_LENSES = 100_000
# Keys of `[lens]` that may have a number for each lens, and columns of these names in the file of the centres.
LENS_KEYS = ("radius_of_curvature_mm", "aperture_diameter_mm", "conic_constant")


class CentersTable(Table):
    """Keys of `[array]` that say where lens centres are read from. A design that was read has `centers_mm` instead."""

    centers_file: str | None = Field(
        default=None,
        min_length=1,
        title="in place of `centers_mm`: a table of text with x and y of each lens in a line, beside the design",
        description="the name of a CSV file",
    )
    centers_columns: Annotated[tuple[str, str], Field(strict=False)] | None = Field(
        default=None,
        title="what the file's header calls the columns of x and y, where it is not clear",
        description='["name of x", "name of y"], as in the header',
    )
    centers_unit: Literal["mm", "um", "px"] | None = Field(
        default=None,
        title="unit of the file, where its header does not say (x_um, y_um); mm by default; px are the sensor's pixels",
        description='"mm", "um" or "px"',
    )
    centers_origin: Literal["center", "corner"] | None = Field(
        default=None,
        title="where the file counts from: the plate's middle, or its corner of least x and y; px: from the middle of "
        "the sensor's first pixel, which is the default for px, or from the sensor's middle",
        description='"center" or "corner"',
    )
    mirror: bool = Field(
        default=False,
        title="whether every x becomes -x on reading: the list shows the plate from its other side",
        description="true or false",
    )


class _Centers(Table):
    array: CentersTable


def inline_centers(path: Path, data: dict[str, Any]) -> None:
    """Replaces, in the tables of the design file `path`, what `CentersTable` says by `centers_mm`.

    Columns of the file that are called as keys of `[lens]` become these keys.

    Raises `InputError` if one of its keys is wrong, or the file is, or `[lens]` has a key that the file has a column
    for.
    """
    array = data.get("array")
    if not isinstance(array, dict):
        return
    given = {key: array.pop(key) for key in CentersTable.model_fields if key in array}
    try:
        keys = _Centers.model_validate({"array": given}).array
    except ValidationError as error:
        raise InputError(f"{one_line(error, _Centers, {})} ({path}).") from error
    if keys.centers_file is None:
        if rest := next((key for key in given if key not in ("mirror", "centers_file")), None):
            raise InputError(f"{path}: `array.{rest}` needs `array.centers_file`.")
        if keys.mirror and "centers_mm" in array:
            array["centers_mm"] = _mirrored(array["centers_mm"])
        return
    if "centers_mm" in array:
        raise InputError(f"{path}: only one of `array.centers_file` and `array.centers_mm` may be given.")
    sensor = data.get("sensor")
    sensor = sensor if isinstance(sensor, dict) else {}
    file = path.parent / keys.centers_file
    try:
        rows = read_centers(
            file,
            columns=keys.centers_columns,
            unit=keys.centers_unit,
            origin=keys.centers_origin,
            mirror=keys.mirror,
            size=_numbers(array.get("size_mm")),
            shape=_numbers(sensor.get("shape")),
            pixel_pitch=_numbers([sensor.get("pixel_pitch_um")] * 2)[0] / 1000,
        )
        columns = lens_columns(file, keys.centers_columns)
    except InputError as error:
        raise InputError(f"{path}: `array.centers_file`: {error}") from error
    array["centers_mm"] = rows.tolist()
    if not columns or not isinstance(lens := data.setdefault("lens", {}), dict):
        return
    if both := next((name for name in columns if name in lens), None):
        raise InputError(f"{path}: only one of `lens.{both}` and that column of `array.centers_file` may be given.")
    lens |= columns


def lens_columns(path: PathLike, columns: tuple[str, str] | None = None) -> dict[str, list[float]]:
    """What a file of lens centres says of each lens besides, by `LENS_KEYS`. `InputError` as `read_columns`."""
    more = read_columns(Path(path), columns, most=MAX_LENSES, also=LENS_KEYS).more
    return {name: numbers.tolist() for name, numbers in more.items()}


def read_centers(
    path: PathLike,
    *,
    columns: tuple[str, str] | None = None,
    unit: str | None = None,
    origin: str | None = None,
    mirror: bool = False,
    size: tuple[float, float] | None,
    shape: tuple[float, float],
    pixel_pitch: float,
) -> Float[np.ndarray, "lens 2"]:
    """Lens centres in the plate's frame, mm, from a table of text as `read_columns` takes it.

    Parameters
    ----------
    columns, unit, origin, mirror
        As the keys of `CentersTable`.
    size
        `(x, y)` of the plate, mm; None: its corners are as far from the lenses as its others.
    shape, pixel_pitch
        Of the sensor: `(rows, columns)`, and mm.

    Raises
    ------
    InputError
        As `read_columns`, or if the unit is not that of the header.
    """
    path = Path(path)
    numbers, names, _ = read_columns(path, columns, most=MAX_LENSES)
    units = _units(path, names, unit)
    in_pixels = units == [PIXELS] * 2
    centers = numbers / (1 / pixel_pitch) if in_pixels else np.stack(list(map(in_mm, numbers.T, units)), 1)
    if (origin or ("corner" if in_pixels else "center")) == "corner":
        if in_pixels:
            middle = np.array([(n - 1) / 2 * pixel_pitch for n in shape[::-1]])
        else:
            middle = np.array(size) / 2 if size else (centers.min(axis=0) + centers.max(axis=0)) / 2
        centers = centers - middle
    return (centers * [-1.0, 1.0] if mirror else centers) + 0.0  # not -0.0


def unit_of_file(path: PathLike, columns: tuple[str, str] | None = None) -> str | None:
    """The unit that a file's header says of x, or of y alone; None if it says none. `InputError` as `read_columns`."""
    names = read_columns(Path(path), columns, most=MAX_LENSES).names
    return _units(Path(path), names, None)[0] if any(_units_in(Path(path), names)) else None


def _units_in(path: Path, names: tuple[str, str] | None) -> list[str | None]:
    with errors_name_file(path):
        return [unit_of_name(name) for name in names or ()]


def other_reading(centers: np.ndarray, half: np.ndarray) -> str:
    """A question, after `; `, where centres that are not on a plate of half the size `half` would be otherwise."""
    reach, positive = np.abs(centers).max(axis=0), (centers >= 0).all()
    if positive and (reach <= 2 * half).all():
        return '; are they counted from a corner (`centers_origin = "corner"`)?'
    # Of micrometres some lens is in the outer half of the plate.
    if (reach / 1000 <= half).all() and (reach / 1000 > half / 2).any():
        return '; are they micrometres (`centers_unit = "um"`)?'
    if positive and (reach / 1000 <= 2 * half).all() and (reach / 1000 > half).any():
        return '; are they micrometres from a corner (`centers_unit = "um"`, `centers_origin = "corner"`)?'
    return ""


def write_centers(path: PathLike, centers: Float[np.ndarray, "lens 2"], provenance: Provenance | None = None) -> None:
    """Writes lens centres, mm, as the CSV file that the key `array.centers_file` names.

    Raises `InputError` as `check_output`, for `.csv`.
    """
    rows = [",".join(map(str, row)) for row in centers.tolist()]
    write_text(path, "\n".join([CENTERS_HEADER, *rows]) + "\n", [".csv"])
    write_sidecar(path, provenance)


def _units(path: Path, names: tuple[str, str] | None, unit: str | None) -> list[str]:
    """The units of x and y: those of the header, and where it says none, the given one, the other's, or mm."""
    found = _units_in(path, names)
    said = [each for each in found if each]
    header = ",".join(names or ())
    if unit and set(said) - {unit}:
        raise InputError(f"{path}: the unit must be that of the header {header:.120}, got {unit}.")
    if PIXELS in said and len(set(said)) > 1:
        raise InputError(f"{path}: both columns must be in pixels, or none, got {header:.120}.")
    return [each or unit or next(iter(said), "mm") for each in found or (None, None)]


def _mirrored(rows: Any) -> Any:
    """x against -x, of what may not be a list of points: that is found later."""
    if not isinstance(rows, list):
        return rows
    numbers = lambda row: isinstance(row, list) and row and type(row[0]) in (int, float)
    return [[-row[0], *row[1:]] if numbers(row) else row for row in rows]


def _numbers(pair: Any) -> tuple[float, float]:
    """Two numbers; of what is none, which is refused later, any."""
    if isinstance(pair, list) and len(pair) == 2 and all(type(x) in (int, float) and 0 < x < 1e9 for x in pair):
        return float(pair[0]), float(pair[1])
    return 1.0, 1.0
