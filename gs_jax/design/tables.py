"""Tables of a design file, with the type, range and meaning of each key; and the files that stand in place of keys."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, Tag, ValidationError

from ..base.errors import InputError, errors_name_file
from ..base.typing import PathLike
from ..io.names import PIXELS, in_mm, unit_of_name
from ..io.point_tables import read_columns, write_rows
from ..io.provenance import Provenance
from ..io.toml import EACH, NAME, ONE, Table, number_or_name, one_line, one_or_each
from ..microscope.lenses import Orientation
from ..microscope.media import MATERIALS

CENTERS_HEADER = "x_mm,y_mm"
MAX_LENSES, _MAX_LINES = 100_000, 100_000
# Keys of `[lens]` that may have a number for each lens, and columns of these names in the file of the centres.
LENS_KEYS = ("radius_of_curvature_mm", "aperture_diameter_mm", "conic_constant")


# Descriptions are the allowed values, titles the meaning of a key: error messages, comments in files, the schema for
# editors and the page of keys are made of them.
def _within(unit: str, least: str, most: str) -> Any:
    """A range of numbers of a unit, and its description."""
    return Field(ge=float(least), le=float(most), description=f"a number of {unit} from {least} to {most}")


def _allowed(description: str, **more: Any) -> Any:
    # Not strict: a TOML array is a list, and a frozen model needs tuples.
    return Field(strict=False, description=description, **more)


Length = Annotated[float, _within("mm", "1e-6", "1e4")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Pixels = Annotated[int, Field(ge=2, le=65536)]
Wavelength = Annotated[float, _within("nanometres", "10", "1e5")]
Slope = Annotated[float, Field(ge=-10, le=10)]
_POINT = _allowed("[x, y] in mm, up to 1e4")
Point = Annotated[tuple[Coordinate, Coordinate], _POINT]
Size = Annotated[tuple[Length, Length], _allowed("[x, y] in mm from 1e-6 to 1e4")]
Range = Annotated[tuple[Length, Length], _allowed("[near, far] in mm, near below far")]
Shape = Annotated[tuple[Pixels, Pixels], _allowed("[rows, columns], whole numbers from 2 to 65536")]
Tilt = Annotated[tuple[Slope, Slope], _allowed("[x, y] in degrees, each from -10 to 10")]
Terms = Annotated[
    tuple[Annotated[float, Field(ge=-1e12, le=1e12)], ...],
    _allowed("up to 6 numbers from -1e12 to 1e12", max_length=6),
]
_Line = Annotated[tuple[Wavelength, Annotated[float, Field(ge=0, le=1e30)]], Field(strict=False)]
Spectrum = Annotated[
    tuple[_Line, ...], _allowed("[[nanometres, light], ...], the light in any unit", max_length=_MAX_LINES)
]
Centers = Annotated[
    tuple[Point, ...],
    _allowed(f"[x, y] in mm, of 1 to {MAX_LENSES} lenses, or `centers_file`", min_length=1, max_length=MAX_LENSES),
]
Material = Literal["air", "PDMS", "PMMA", "polystyrene", "BK7", "fused silica", "water"]
_NAMES = ", ".join(f'"{name}"' for name in MATERIALS if name != "air")
Index = Annotated[
    Annotated[Material, Tag(NAME)] | Annotated[float, Field(ge=1, le=5), Tag(ONE)],
    number_or_name,
    Field(description=f"a number from 1 to 5, or one of {_NAMES}"),
]
LensIndex = Annotated[
    Annotated[Material, Tag(NAME)] | Annotated[float, Field(gt=1, le=5), Tag(ONE)],
    number_or_name,
    Field(description=f"a number above 1, up to 5, or one of {_NAMES}"),
]
Conic = Annotated[float, Field(ge=-100, le=100)]
# One number for all lenses, or one for each.
_ForEach = Field(strict=False, min_length=1, max_length=MAX_LENSES)
_ONE_EACH = "or a list with one for each lens, in the order of the centres"
Lengths = Annotated[
    Annotated[Length, Tag(ONE)] | Annotated[tuple[Length, ...], _ForEach, Tag(EACH)],
    one_or_each,
    Field(description=f"a number of mm from 1e-6 to 1e4, {_ONE_EACH}"),
]
Conics = Annotated[
    Annotated[Conic, Tag(ONE)] | Annotated[tuple[Conic, ...], _ForEach, Tag(EACH)],
    one_or_each,
    Field(description=f"a number from -100 to 100, {_ONE_EACH}"),
]


class SensorTable(Table):
    """`[sensor]`: the camera. With `origin_mm` it is a region of a larger one, whose centre is the frame's origin.

    `origin_mm` is the region's middle. At least one lens has to have an image on a region.
    """

    pixel_pitch_um: Annotated[float, _within("micrometres", "1e-3", "1e4")] = Field(
        title="distance of neighbouring pixels' centres; pixels are square"
    )
    shape: Shape = Field(title="size of the image in pixels: rows (y) first, then columns (x)")
    origin_mm: Annotated[tuple[Coordinate, Coordinate] | None, _POINT] = Field(
        default=None, title="middle of a region of a larger sensor, whose centre stays the frame's origin"
    )


class LensTable(Table):
    """`[lens]`: plano-convex microlenses. `focal_length_mm` overrides the radius, for a thin-lens study.

    A list has one number for each lens; columns of these names in the `centers_file` are read into it. At the radius
    r the curved side is `c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A4 r^4 + A6 r^6 + ...` below its vertex,
    with `c = 1/R` and all lengths in mm.
    """

    radius_of_curvature_mm: Lengths = Field(
        title="R of the curved side at its vertex, positive; a focal length f in air is R = f (n - 1)"
    )
    refractive_index: LensIndex = Field(
        title="n of lenses and plate at the wavelength: PDMS 1.43, fused silica 1.46, acrylic 1.49, BK7 1.52"
    )
    aperture_diameter_mm: Lengths = Field(title="D of each lens, before neighbours clip it; at most 2 R of a sphere")
    orientation: Orientation = Field(
        default="plano", title="side of the lenses that faces the object", description='"plano" or "curved"'
    )
    conic_constant: Conics = Field(
        default=0.0, title="k of the curved side: 0 of a sphere, -1 of a paraboloid, between these of an ellipsoid"
    )
    aspheric_terms: Terms = Field(
        default=(),
        title="[A4, A6, ...] of the curved side, for millimetres; a lens must fall all the way from its vertex",
    )
    focal_length_mm: Annotated[float | None, _within("mm", "1e-6", "1e4")] = Field(
        default=None,
        title="f of an ideal thin lens, in place of the sphere that the radius describes; leave it out for real lenses",
    )


class ArrayTable(Table):
    """`[array]`: the plate and where its lenses are. `centers_file` is replaced by its content on reading."""

    size_mm: Size = Field(title="width (x) and height (y) of the plate, with its middle at [0, 0]")
    substrate_thickness_mm: Annotated[float, _within("mm", "0", "1e4")] = Field(
        title="t of the plate, from its plano face to the lens vertices"
    )
    centers_mm: Centers = Field(
        title="lens vertices from the plate's middle: +x right (increasing column), +y down (increasing row)"
    )


class ImagingTable(Table):
    """`[imaging]`: where the sensor and the object are."""

    sensor_distance_mm: Length = Field(
        title="v from the array's back to the sensor, positive: from the lens vertices, or the plano face behind them"
    )
    working_distance_mm: Range = Field(
        title="nearest and farthest object: depths z from the array's front, plano face or lens vertices, positive"
    )
    wavelength_nm: Wavelength = Field(title="wavelength of the light that is detected, in air")
    bandwidth_nm: Annotated[float, _within("nanometres", "0", "1e4")] = Field(
        default=0.0,
        title="full width of an even emission band about `wavelength_nm`, over which PSFs are means; 0 for none",
    )
    spectrum_nm: Spectrum = Field(
        default=(),
        title="in place of `bandwidth_nm`: pairs of a wavelength and its light, between which it is linear; "
        "`spectrum_file` names a CSV file with the header `wavelength_nm,light` that is read in its place",
    )
    field_radius_mm: Length = Field(
        title="radius of back-projection, in the object, sqrt(A_e / pi): a voxel sums the lenses so near"
    )


class LayerTable(Table):
    """A plane layer that light crosses."""

    name: str = Field(default="", title="what it is, for people", description="a string")
    thickness_mm: Length = Field(title="thickness")
    refractive_index: Index = Field(default=1.0, title="n at the wavelength; 1, air, by default")


LayerTables = Annotated[tuple[LayerTable, ...], _allowed("a list of tables")]


class LayersTable(Table):
    """`[layers]`: filters and windows, in `[[layers.object]]` and `[[layers.sensor]]`.

    Each begins where the last ends. Those on the object's side tilt with the array. What is left of the sensor distance
    is air.
    """

    object: LayerTables = Field(default=(), title="layers on the object's side, from the array's front outward")
    sensor: LayerTables = Field(
        default=(),
        title="layers on the sensor's side, from the sensor toward the array: the gap to the window, the window",
    )


class SampleTable(Table):
    """`[sample]`: the medium that holds the object, or `[samples.NAME]`."""

    refractive_index: Index = Field(title="n of the object's medium at the wavelength; 1, air, is no sample")
    surface_mm: Annotated[float | None, _within("mm", "0", "1e4")] = Field(
        default=None,
        title="depth at which the medium begins, from the array's front; without it the medium begins where layers end",
    )
    layers: LayerTables = Field(
        default=(),
        title="cover slips and the like of this sample, from the array outward; they end where the medium begins",
    )


class ChannelTable(Table):
    """`[channels.NAME]`: a channel of captures."""

    wavelength_nm: Wavelength = Field(title="wavelength of the light in the channel, in air")


class CalibrationTable(Table):
    """`[calibration]`: the array as found on the sensor, rotated about its centre (+x toward +y), shifted, then tilted.

    The tilt is by how much the array's plane rises toward the object along +x and +y.
    """

    rotation_deg: Annotated[float, _within("degrees", "-360", "360")] = Field(
        default=0.0,
        title="turn of the array about its middle, from +x toward +y: clockwise in the image as it is shown",
    )
    shift_mm: Point = Field(
        default=(0.0, 0.0), title="where the array's middle is, from the sensor's, once it is turned"
    )
    tilt_deg: Tilt = Field(
        default=(0.0, 0.0), title="by how much the array's plane rises toward the object along +x and +y"
    )


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


class CentersFile:
    """A table of lens centres, in any form that `read_columns` takes.

    `unit` is that of x in the header, or of y alone, None without any; `lens` has further columns by `LENS_KEYS`.
    Raises `InputError` as `read_columns`, or if the header names an unknown unit.
    """

    def __init__(self, path: PathLike, columns: tuple[str, str] | None = None):
        self.path = Path(path)
        self._numbers, names, further = read_columns(self.path, columns, most=MAX_LENSES, also=LENS_KEYS)
        self.lens = {name: numbers.tolist() for name, numbers in further.items()}
        self._header = ",".join(names or ())
        with errors_name_file(path):
            self._units = [unit_of_name(name) for name in names] if names else [None, None]
        self.unit = next((unit for unit in self._units if unit), None)

    def centers(
        self,
        *,
        unit: str | None = None,
        origin: str | None = None,
        mirror: bool = False,
        size: tuple[float, float] | None,
        shape: tuple[float, float],
        pixel_pitch: float,
    ) -> Float[np.ndarray, "lens 2"]:
        """Lens centres in the plate's frame, mm.

        Parameters
        ----------
        unit, origin, mirror
            As the keys of `CentersTable`.
        size
            `(x, y)` of the plate, mm; None: its middle is that of the lenses.
        shape, pixel_pitch
            Of the sensor: `(rows, columns)`, and mm.

        Raises
        ------
        InputError
            If the unit is not that of the header.
        """
        declared = {own for own in self._units if own}
        if unit and declared - {unit}:
            raise InputError(f"{self.path}: the unit must be that of the header {self._header:.120}, got {unit}.")
        if PIXELS in declared and len(declared) > 1:
            raise InputError(f"{self.path}: both columns must be in pixels, or none, got {self._header:.120}.")
        units = [own or unit or self.unit or "mm" for own in self._units]
        in_pixels = units == [PIXELS] * 2
        if in_pixels:
            centers = self._numbers / (1 / pixel_pitch)
        else:
            centers = np.stack(list(map(in_mm, self._numbers.T, units)), 1)
        if (origin or ("corner" if in_pixels else "center")) == "corner":
            if in_pixels:
                middle = np.array([(n - 1) / 2 * pixel_pitch for n in shape[::-1]])
            else:
                middle = np.array(size) / 2 if size else (centers.min(axis=0) + centers.max(axis=0)) / 2
            centers = centers - middle
        return (centers * [-1.0, 1.0] if mirror else centers) + 0.0  # not -0.0


def inline_files(path: Path, data: dict[str, Any]) -> None:
    """Replace, in the tables of the design file `path`, the keys that name files by their content.

    These are `imaging.spectrum_file`, and the keys of `CentersTable`, for which `array.centers_mm` stands; columns of
    the file of centres that are called as keys of `[lens]` become these keys.

    Raises `InputError` if one of these keys is wrong, a file is, or what is in a file is also in the design.
    """
    _inline_centers(path, data)
    imaging = data.get("imaging")
    if not isinstance(imaging, dict) or "spectrum_file" not in imaging:
        return
    name = imaging.pop("spectrum_file")
    if not isinstance(name, str) or "spectrum_nm" in imaging:
        raise InputError(f"`imaging.spectrum_file` must be a file's name, without `imaging.spectrum_nm` ({path}).")
    try:
        rows = read_columns(path.parent / name, ("wavelength_nm", "light"), most=_MAX_LINES)
    except InputError as error:
        raise InputError(f"`imaging.spectrum_file`: {error} ({path})") from error
    imaging["spectrum_nm"] = rows.numbers.tolist()


def _inline_centers(path: Path, data: dict[str, Any]) -> None:
    array = data.get("array")
    if not isinstance(array, dict):
        return
    given = {key: array.pop(key) for key in CentersTable.model_fields if key in array}
    try:
        keys = _Centers.model_validate({"array": given}).array
    except ValidationError as error:
        raise InputError(f"{one_line(error, _Centers, {})} ({path}).") from error
    if keys.centers_file is None:
        if other := next((key for key in given if key not in ("mirror", "centers_file")), None):
            raise InputError(f"{path}: `array.{other}` needs `array.centers_file`.")
        if keys.mirror and isinstance(rows := array.get("centers_mm"), list):
            # Rows that are no points are refused later.
            array["centers_mm"] = [[-row[0], *row[1:]] if _is_row(row) else row for row in rows]
        return
    if "centers_mm" in array:
        raise InputError(f"{path}: only one of `array.centers_file` and `array.centers_mm` may be given.")
    sensor = data.get("sensor")
    sensor = sensor if isinstance(sensor, dict) else {}
    try:
        file = CentersFile(path.parent / keys.centers_file, keys.centers_columns)
        centers = file.centers(
            unit=keys.centers_unit,
            origin=keys.centers_origin,
            mirror=keys.mirror,
            size=_pair(array.get("size_mm")),
            shape=_pair(sensor.get("shape")),
            pixel_pitch=_pair([sensor.get("pixel_pitch_um")] * 2)[0] / 1000,
        )
    except InputError as error:
        raise InputError(f"{path}: `array.centers_file`: {error}") from error
    array["centers_mm"] = centers.tolist()
    if not file.lens or not isinstance(lens := data.setdefault("lens", {}), dict):
        return
    if both := next((name for name in file.lens if name in lens), None):
        raise InputError(f"{path}: only one of `lens.{both}` and that column of `array.centers_file` may be given.")
    lens |= file.lens


def _is_row(row: Any) -> bool:
    return isinstance(row, list) and bool(row) and type(row[0]) in (int, float)


def _pair(pair: Any) -> tuple[float, float]:
    """The pair as floats; (1, 1) for invalid input, which validation rejects later."""
    if isinstance(pair, list) and len(pair) == 2 and all(type(x) in (int, float) and 0 < x < 1e9 for x in pair):
        return float(pair[0]), float(pair[1])
    return 1.0, 1.0


def write_centers(path: PathLike, centers: Float[np.ndarray, "lens 2"], provenance: Provenance | None = None) -> None:
    """Write lens centres, mm, as the CSV file that the key `array.centers_file` names.

    Raises `InputError` as `check_output`, for `.csv`.
    """
    write_rows(path, [CENTERS_HEADER], centers.tolist(), provenance)
