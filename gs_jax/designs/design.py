"""Design files: what a microscope is, as TOML.

A key carries its unit, and this module is where units end: `Design.imager` gives the geometry in mm and radians.
"""

import math
import os
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
from jaxtyping import Float
from pydantic import Field, ValidationError, model_validator

from ..base.errors import InputError, short_repr
from ..geometry import LONGEST, SHORTEST, Imager, MicrolensArray, Sensor
from ..io.disk import read_table, read_text, write_text
from ..io.provenance import Provenance, write_sidecar
from ..io.tables import Table, one_line

CENTERS_HEADER = "x_mm,y_mm"
MAX_LENSES = 100_000
MIN_SPACING_MM = 1e-3

# Every description is what the error message says is allowed.
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
    """`[sensor]`: the camera."""

    pixel_pitch_um: float = Field(ge=1e-3, le=1e4, description="a number of micrometres from 1e-3 to 1e4")
    shape: Shape


class LensTable(Table):
    """`[lens]`: one plano-convex microlens. `focal_length_mm` overrides the radius, for a thin-lens study."""

    radius_of_curvature_mm: Length
    refractive_index: float = Field(gt=1, le=5, description="a number above 1, up to 5")
    aperture_diameter_mm: Length
    focal_length_mm: Length | None = None


class ArrayTable(Table):
    """`[array]`: the plate and where its lenses are. `centers_file` is replaced by its content on reading."""

    size_mm: Size
    substrate_thickness_mm: float = Field(ge=0, le=1e4, description="a number of mm from 0 to 1e4")
    centers_mm: Centers


class ImagingTable(Table):
    """`[imaging]`: where the sensor and the object are."""

    sensor_distance_mm: Length
    working_distance_mm: Range
    wavelength_nm: Wavelength
    field_radius_mm: Length


class CalibrationTable(Table):
    """`[calibration]`: the array as found on the sensor, rotated about its centre (+x toward +y), then shifted."""

    rotation_deg: float = Field(default=0.0, ge=-360, le=360, description="a number of degrees from -360 to 360")
    shift_mm: Point = (0.0, 0.0)


class Design(Table):
    """A microscope, with the tables and keys of its file."""

    name: str = Field(description="a string")
    sensor: SensorTable = Field(description="a table")
    lens: LensTable = Field(description="a table")
    array: ArrayTable = Field(description="a table")
    imaging: ImagingTable = Field(description="a table")
    calibration: CalibrationTable = Field(default=CalibrationTable(), description="a table")
    provenance: dict[str, Any] = Field(default={}, description="a table")

    @model_validator(mode="after")
    def _fits_together(self) -> "Design":
        for check in (_check_numbers, _check_plate, _check_spacing, _check_reach):
            check(self)
        return self

    def __repr__(self) -> str:
        sensor, lens, array, imaging = self.sensor, self.lens, self.array, self.imaging
        focal = (
            f"f = {lens.focal_length_mm:g} mm" if lens.focal_length_mm else f"R = {lens.radius_of_curvature_mm:g} mm"
        )
        return "\n".join(
            [
                f"Design {self.name!r}",
                f"  {len(array.centers_mm)} lenses, {focal}, n = {lens.refractive_index:g}, "
                f"D = {lens.aperture_diameter_mm:g} mm, on {array.size_mm[0]:g} x {array.size_mm[1]:g} mm, "
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
            radius_of_curvature=lens.radius_of_curvature_mm,
            refractive_index=lens.refractive_index,
            aperture_diameter=lens.aperture_diameter_mm,
            substrate_thickness=self.array.substrate_thickness_mm,
            thin_lens_focal_length=lens.focal_length_mm,
            size=self.array.size_mm,
        )
        return Imager(
            array,
            Sensor(self.sensor.shape, self.sensor.pixel_pitch_um / 1000),
            sensor_distance=imaging.sensor_distance_mm,
            field_radius=imaging.field_radius_mm,
            wavelength=imaging.wavelength_nm * 1e-6,
            rotation=math.radians(calibration.rotation_deg),
            shift=calibration.shift_mm,
        )


def read_design(path: str | os.PathLike[str]) -> Design:
    """The design in a TOML file. A `centers_file`, relative to it, is read in place of `centers_mm`.

    Raises
    ------
    InputError
        If the file, or its centres' file, cannot be read, or a key is missing, extra, of the wrong type or out
        of its range, or the whole makes no microscope.
    """
    text = read_text(path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {str(error):.200}.") from error
    _inline_centers(Path(path), data)
    try:
        return Design.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{path}: {one_line(error, Design, {'array': ['centers_file']})}.") from error


def write_design(path: str | os.PathLike[str], design: Design) -> None:
    """Writes a design as TOML, its centres inside, whole or not at all; what is read back is equal.

    Raises
    ------
    InputError
        As `check_output`, for `.toml`.
    """
    write_text(path, design_text(design), [".toml"])


def design_text(design: Design) -> str:
    """A design as TOML, its centres inside."""
    return _PAIR.sub(r"[\1, \2]", tomli_w.dumps(design.model_dump(exclude_defaults=True)))


def write_centers(
    path: str | os.PathLike[str], centers: Float[np.ndarray, "lens 2"], provenance: Provenance | None = None
) -> None:
    """Writes lens centres, mm, as the CSV file that the key `array.centers_file` names.

    Raises
    ------
    InputError
        As `check_output`, for `.csv`.
    """
    rows = [",".join(map(str, row)) for row in centers.tolist()]
    write_text(path, "\n".join([CENTERS_HEADER, *rows]) + "\n", [".csv"])
    write_sidecar(path, provenance)


# An array of two numbers on one line, as people write it. `tomli_w` has no line end within a string.
_PAIR = re.compile(r"""\[\n\s+([^\[\],\n"']+),\n\s+([^\[\],\n"']+),\n\s*\]""")


def _inline_centers(path: Path, data: dict[str, Any]) -> None:
    array = data.get("array")
    if not isinstance(array, dict) or "centers_file" not in array:
        return
    name = array.pop("centers_file")
    if "centers_mm" in array:
        raise InputError(f"{path}: found both `array.centers_file` and `array.centers_mm`, allowed: one of them.")
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: `array.centers_file`: found {short_repr(name)}, allowed: the name of a CSV file.")
    try:
        rows = read_table(path.parent / name, CENTERS_HEADER, MAX_LENSES)
    except InputError as error:
        raise InputError(f"{path}: `array.centers_file`: {error}") from error
    array["centers_mm"] = rows.tolist()


# What only the whole design shows. One problem at a time; each message names its key.


def _check_numbers(design: Design) -> None:
    near, far = design.imaging.working_distance_mm
    if not near < far:
        raise ValueError(f"`imaging.working_distance_mm`: found [{near}, {far}], allowed: near below far, in mm")
    aperture, sphere = design.lens.aperture_diameter_mm, 2 * design.lens.radius_of_curvature_mm
    if aperture > sphere:
        limit = f"at most {sphere} mm, twice `lens.radius_of_curvature_mm`"
        raise ValueError(f"`lens.aperture_diameter_mm`: found {aperture}, allowed: {limit}")


def _check_plate(design: Design) -> None:
    centers = np.array(design.array.centers_mm)
    half = np.array(design.array.size_mm) / 2
    outside = (np.abs(centers) > half + 1e-9).any(axis=1)
    if outside.any():
        allowed = f"within the plate `array.size_mm`, |x| up to {half[0]} mm and |y| up to {half[1]} mm"
        raise ValueError(f"{_lens(design, int(np.argmax(outside)))}, allowed: {allowed}")


def _check_spacing(design: Design) -> None:
    if pair := _close_pair(np.array(design.array.centers_mm)):
        found = f"{_lens(design, pair[0])} and lens {pair[1] + 1} less than {MIN_SPACING_MM} mm from it"
        raise ValueError(f"{found}, allowed: lenses at least that far apart")


def _close_pair(centers: np.ndarray) -> tuple[int, int] | None:
    # Two in one cell of half the spacing are too close. Without them few are close to any along x.
    _, cells = np.unique(np.floor(centers / (MIN_SPACING_MM / 2)), axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    together = np.flatnonzero(np.diff(cells.ravel()[order]) == 0)
    if together.size:
        return int(order[together[0]]), int(order[together[0] + 1])
    along, least, pairs = np.argsort(centers[:, 0], kind="stable"), MIN_SPACING_MM * (1 - 1e-9), []
    for step in range(1, len(centers)):
        apart = centers[along[step:]] - centers[along[:-step]]
        if apart[:, 0].min() > least:
            break
        near = np.flatnonzero(np.hypot(*apart.T) <= least)
        pairs += [tuple(sorted(map(int, pair))) for pair in zip(along[near], along[near + step], strict=True)]
    return min(pairs, default=None)


def _check_reach(design: Design) -> None:
    """Each lens has a sub-image on the sensor: the disc `v/z' field_radius` about its vertex, at the nearest depth."""
    imaging, calibration = design.imaging, design.calibration
    angle = math.radians(calibration.rotation_deg)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centers = np.array(design.array.centers_mm) @ rotation.T + calibration.shift_mm
    half = np.array(design.sensor.shape)[::-1] * design.sensor.pixel_pitch_um / 2000
    distance = np.hypot(*np.maximum(np.abs(centers) - half, 0).T)
    plate = design.array.substrate_thickness_mm / design.lens.refractive_index
    radius = imaging.sensor_distance_mm / (imaging.working_distance_mm[0] + plate) * imaging.field_radius_mm
    if (distance > radius).any():
        index = int(np.argmax(distance > radius))
        allowed = f"up to {radius:.4g} mm, the radius of its image of the field"
        raise ValueError(f"{_lens(design, index)}, {distance[index]:.4g} mm beside the sensor, allowed: {allowed}")


def _lens(design: Design, index: int) -> str:
    return f"`array.centers_mm`: found lens {index + 1} at {list(design.array.centers_mm[index])} mm"
