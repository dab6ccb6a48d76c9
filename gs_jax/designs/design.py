"""Design files: what a microscope is, as TOML.

A key carries its unit, and this module is where units end: `Design.imager` gives the geometry in mm and radians.
"""

import math
import os
import re
import tomllib
import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
from pydantic import Field, Tag, ValidationError, model_validator

from ..base.errors import InputError, InputWarning
from ..geometry import LONGEST, SHORTEST, Imager, Sensor
from ..io.disk import read_text, write_text
from ..io.tables import EACH, ONE, Table, one_line, one_or_each
from ..lenses import MicrolensArray, Orientation
from .centers import LENS_KEYS, MAX_LENSES, CentersTable, inline_centers
from .checks import check_whole, of_each
from .plausible import doubts, slips

# Every description is what the error message says is allowed, every title what the key means: comments in files, the
# schema for editors and the page of keys are made of both.
Length = Annotated[float, Field(ge=1e-6, le=1e4, description="a number of mm from 1e-6 to 1e4")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Pixels = Annotated[int, Field(ge=2, le=65536)]
Wavelength = Annotated[
    float, Field(ge=1e6 * SHORTEST, le=1e6 * LONGEST, description="a number of nanometres from 10 to 1e5")
]
# Strict as everything else, but a TOML array is a list and a frozen model wants tuples.
Point = Annotated[tuple[Coordinate, Coordinate], Field(strict=False, description="[x, y] in mm, up to 1e4")]
Size = Annotated[tuple[Length, Length], Field(strict=False, description="[x, y] in mm from 1e-6 to 1e4")]
Range = Annotated[tuple[Length, Length], Field(strict=False, description="[near, far] in mm, near below far")]
Shape = Annotated[
    tuple[Pixels, Pixels], Field(strict=False, description="[rows, columns], whole numbers from 2 to 65536")
]
Terms = Annotated[
    tuple[Annotated[float, Field(ge=-1e12, le=1e12)], ...],
    Field(strict=False, max_length=6, description="up to 6 numbers from -1e12 to 1e12"),
]
Conic = Annotated[float, Field(ge=-100, le=100)]
_ForEach = Field(strict=False, min_length=1, max_length=MAX_LENSES)
# Of all lenses, or of each.
Lengths = Annotated[Annotated[Length, Tag(ONE)] | Annotated[tuple[Length, ...], _ForEach, Tag(EACH)], one_or_each]
Conics = Annotated[Annotated[Conic, Tag(ONE)] | Annotated[tuple[Conic, ...], _ForEach, Tag(EACH)], one_or_each]
_ONE_EACH = "or a list with one for each lens, in the order of the centres"
Slope = Annotated[float, Field(ge=-10, le=10)]
Tilt = Annotated[tuple[Slope, Slope], Field(strict=False, description="[x, y] in degrees, each from -10 to 10")]
Centers = Annotated[
    tuple[Point, ...],
    Field(
        strict=False,
        min_length=1,
        max_length=MAX_LENSES,
        description=f"[x, y] in mm, of 1 to {MAX_LENSES} lenses, or `centers_file`",
    ),
]


class SensorTable(Table):
    """`[sensor]`: the camera. With `origin_mm` it is a region of a larger one, whose centre is the frame's origin.

    The key is the region's middle. Lenses need not reach a region, but one of them.
    """

    pixel_pitch_um: float = Field(
        ge=1e-3,
        le=1e4,
        title="distance of neighbouring pixels' centres; pixels are square",
        description="a number of micrometres from 1e-3 to 1e4",
    )
    shape: Shape = Field(title="size of the image in pixels: rows (y) first, then columns (x)")
    origin_mm: Point | None = Field(
        default=None,
        title="middle of a region of a larger sensor, whose centre stays the frame's origin",
        description="[x, y] in mm, up to 1e4",
    )


class LensTable(Table):
    """`[lens]`: plano-convex microlenses. `focal_length_mm` overrides the radius, for a thin-lens study.

    What may be a list is a number of each lens; columns of these names in the `centers_file` are read into it.
    At the radius r the curved side is `c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A4 r^4 + A6 r^6 + ...` below its
    vertex, with `c = 1/R` and all lengths in mm.
    """

    radius_of_curvature_mm: Lengths = Field(
        title="R of the curved side at its vertex, positive; a focal length f in air is R = f (n - 1)",
        description=f"a number of mm from 1e-6 to 1e4, {_ONE_EACH}",
    )
    refractive_index: float = Field(
        gt=1,
        le=5,
        title="n of lenses and plate at the wavelength: PDMS 1.43, fused silica 1.46, acrylic 1.49, BK7 1.52",
        description="a number above 1, up to 5",
    )
    aperture_diameter_mm: Lengths = Field(
        title="D of each lens, before neighbours clip it; at most 2 R of a sphere",
        description=f"a number of mm from 1e-6 to 1e4, {_ONE_EACH}",
    )
    orientation: Orientation = Field(
        default="plano", title="side of the lenses that faces the object", description='"plano" or "curved"'
    )
    conic_constant: Conics = Field(
        default=0.0,
        title="k of the curved side: 0 of a sphere, -1 of a paraboloid, between these of an ellipsoid",
        description=f"a number from -100 to 100, {_ONE_EACH}",
    )
    aspheric_terms: Terms = Field(
        default=(),
        title="[A4, A6, ...] of the curved side, for millimetres; a lens must fall all the way from its vertex",
    )
    focal_length_mm: Length | None = Field(
        default=None,
        title="f of an ideal thin lens, in place of the sphere that the radius describes; leave it out for real lenses",
        description="a number of mm from 1e-6 to 1e4",
    )


class ArrayTable(Table):
    """`[array]`: the plate and where its lenses are. `centers_file` is replaced by its content on reading."""

    size_mm: Size = Field(title="width (x) and height (y) of the plate, with its middle at [0, 0]")
    substrate_thickness_mm: float = Field(
        ge=0,
        le=1e4,
        title="t of the plate, from its plano face to the lens vertices",
        description="a number of mm from 0 to 1e4",
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
    field_radius_mm: Length = Field(
        title="how far beside its axis, in the object, a lens still counts as seeing a point; sqrt(A_e / pi)"
    )


class CalibrationTable(Table):
    """`[calibration]`: the array as found on the sensor, rotated about its centre (+x toward +y), shifted, then tilted.

    The tilt is by how much the array's plane rises toward the object along +x and +y.
    """

    rotation_deg: float = Field(
        default=0.0,
        ge=-360,
        le=360,
        title="turn of the array about its middle, from +x toward +y: clockwise in the image as it is shown",
        description="a number of degrees from -360 to 360",
    )
    shift_mm: Point = Field(
        default=(0.0, 0.0), title="where the array's middle is, from the sensor's, once it is turned"
    )
    tilt_deg: Tilt = Field(
        default=(0.0, 0.0), title="by how much the array's plane rises toward the object along +x and +y"
    )


class Design(Table):
    """A microscope, with the tables and keys of its file.

    Examples
    --------
    >>> import gs_jax as gs
    >>> design = gs.geomscope()
    >>> design.imaging.sensor_distance_mm, design.lens.refractive_index, len(design.array.centers_mm)
    (5.8, 1.43, 200)
    >>> scope = design.imager()  # in mm and radians
    """

    name: str = Field(title="what reports call it", description="a string")
    sensor: SensorTable = Field(title="the camera", description="a table")
    lens: LensTable = Field(title="plano-convex microlenses, alike or not", description="a table")
    array: ArrayTable = Field(title="the plate, and where its lenses are", description="a table")
    imaging: ImagingTable = Field(title="where the sensor and the object are, and the light", description="a table")
    calibration: CalibrationTable = Field(
        default=CalibrationTable(),
        title="the array as found on the sensor; `gs-jax calibrate` writes it",
        description="a table",
    )
    provenance: dict[str, Any] = Field(
        default={}, title="where the file comes from; anything may stand here", description="a table"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "Design":
        check_whole(self)
        return self

    def __repr__(self) -> str:
        sensor, lens, array, imaging = self.sensor, self.lens, self.array, self.imaging
        focal = (
            f"f = {lens.focal_length_mm:g} mm"
            if lens.focal_length_mm
            else f"R = {span_of(lens.radius_of_curvature_mm)} mm"
        )
        count = len(set(zip(*(of_each(self, key) for key in LENS_KEYS), strict=True)))
        of_kinds = f" of {count} kinds" if count > 1 else ""
        return "\n".join(
            [
                f"Design {self.name!r}",
                f"  {len(array.centers_mm)} lenses{of_kinds}, {focal}{_shape(lens)}, n = {lens.refractive_index:g}, "
                f"D = {span_of(lens.aperture_diameter_mm)} mm, on {array.size_mm[0]:g} x {array.size_mm[1]:g} mm, "
                f"{array.substrate_thickness_mm:g} mm thick",
                f"  sensor of {sensor.shape[0]} x {sensor.shape[1]} pixels of {sensor.pixel_pitch_um:g} um "
                f"at v = {imaging.sensor_distance_mm:g} mm",
                f"  objects at z = {imaging.working_distance_mm[0]:g} to {imaging.working_distance_mm[1]:g} mm, "
                f"{imaging.wavelength_nm:g} nm, field radius {imaging.field_radius_mm:g} mm",
            ]
        )

    __str__ = __repr__

    def imager(self) -> Imager:
        """The geometry of this design: mm and radians."""
        lens, imaging, calibration = self.lens, self.imaging, self.calibration
        array = MicrolensArray(
            np.array(self.array.centers_mm),
            radius_of_curvature=_one_if_alike(lens.radius_of_curvature_mm),
            refractive_index=lens.refractive_index,
            aperture_diameter=_one_if_alike(lens.aperture_diameter_mm),
            substrate_thickness=self.array.substrate_thickness_mm,
            thin_lens_focal_length=lens.focal_length_mm,
            size=self.array.size_mm,
            orientation=lens.orientation,
            conic_constant=_one_if_alike(lens.conic_constant),
            aspheric_terms=lens.aspheric_terms,
        )
        return Imager(
            array,
            Sensor(self.sensor.shape, self.sensor.pixel_pitch_um / 1000, self.sensor.origin_mm or (0.0, 0.0)),
            sensor_distance=imaging.sensor_distance_mm,
            field_radius=imaging.field_radius_mm,
            wavelength=imaging.wavelength_nm * 1e-6,
            rotation=math.radians(calibration.rotation_deg),
            shift=calibration.shift_mm,
            tilt=np.tan(np.radians(calibration.tilt_deg)) if any(calibration.tilt_deg) else None,
        )


def _one_if_alike(numbers: float | tuple[float, ...]) -> float | tuple[float, ...]:
    return numbers[0] if isinstance(numbers, tuple) and len(set(numbers)) == 1 else numbers


def span_of(numbers: float | tuple[float, ...]) -> str:
    """A number, or the least and the greatest of the lenses', to read."""
    ends = (min(numbers), max(numbers)) if isinstance(numbers, tuple) else (numbers, numbers)
    low, high = (f"{end:g}" for end in ends)
    return low if low == high else f"{low} to {high}"


def _shape(lens: LensTable) -> str:
    """What is not a sphere with its plano side to the object, in words."""
    conic = f", k = {span_of(lens.conic_constant)}" if lens.conic_constant else ""
    terms = f", {len(lens.aspheric_terms)} aspheric terms" if lens.aspheric_terms else ""
    return conic + terms + (", curved side to the object" if lens.orientation == "curved" else "")


def read_design(path: str | os.PathLike[str]) -> Design:
    """The design in a TOML file. A `centers_file`, relative to it, is read in place of `centers_mm`.

    Raises
    ------
    InputError
        If the file, or its centres' file, cannot be read, or a key is missing, extra, of the wrong type or out
        of its range, or the whole makes no microscope.

    Warns
    -----
    InputWarning
        For each number that is possible but hardly meant, such as a sensor distance of 5800 mm.

    Examples
    --------
    >>> import gs_jax as gs
    >>> gs.write_design("mine.toml", gs.geomscope())
    >>> scope = gs.read_design("mine.toml").imager()
    """
    text = read_text(path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {str(error):.200}.") from error
    inline_centers(Path(path), data)
    return checked_design(path, data)


def checked_design(path: str | os.PathLike[str], data: dict[str, Any]) -> Design:
    """The design of the tables that the file `path` has, or will have; it raises and warns as `read_design`."""
    try:
        design = Design.model_validate(data)
    except ValidationError as error:
        # A slip of a unit is why lenses are beside the sensor, and comes first.
        problems = [*slips(data), one_line(error, Design, {"array": list(CentersTable.model_fields)})]
        end = "" if problems[-1].endswith("?") else "."
        raise InputError(f"{path}: {' '.join(problems)}{end}") from error
    for question in doubts(data):
        warnings.warn(f"{path}: {question}", InputWarning, stacklevel=3)
    return design


def write_design(path: str | os.PathLike[str], design: Design) -> None:
    """Writes a design as TOML, its centres inside, whole or not at all; what is read back is equal.

    Raises
    ------
    InputError
        As `check_output`, for `.toml`.

    Examples
    --------
    >>> import gs_jax as gs
    >>> gs.write_design("mine.toml", gs.geomscope())
    >>> gs.read_design("mine.toml") == gs.geomscope()
    True
    """
    write_text(path, design_text(design), [".toml"])


def design_text(design: Design) -> str:
    """A design as TOML, its centres inside."""
    return as_toml(design.model_dump(exclude_defaults=True))


def as_toml(data: dict[str, Any]) -> str:
    """TOML, points in a line each."""
    return _PAIR.sub(r"[\1, \2]", tomli_w.dumps(data))


# An array of two numbers on one line, as people write it. `tomli_w` has no line end within a string.
_PAIR = re.compile(r"""\[\n\s+([^\[\],\n"']+),\n\s+([^\[\],\n"']+),\n\s*\]""")
