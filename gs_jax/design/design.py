"""Design files: a microscope as TOML. Keys carry their units; `Design.imager` gives the geometry in mm and radians."""

import difflib
import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from pydantic import Field, ValidationError, model_validator

from ..base.errors import InputError, InputWarning
from ..base.typing import PathLike
from ..io.files import write_text
from ..io.toml import Table, one_line, read_toml
from ..microscope.geometry import LONGEST, SHORTEST, Imager
from ..microscope.grid import Sensor
from ..microscope.lenses import MicrolensArray
from ..microscope.media import Sample, index_of
from .conversion import (
    emission_band,
    format_path,
    layers_of,
    sample_of,
    sample_table,
    sharp_depths,
    tables_of,
)
from .tables import (
    LENS_KEYS,
    ArrayTable,
    CalibrationTable,
    CentersTable,
    ChannelTable,
    ImagingTable,
    LayersTable,
    LensTable,
    SampleTable,
    SensorTable,
    inline_files,
)
from .validation import check_whole, doubts, of_each, slips


def _table(title: str, **default: Any) -> Any:
    return Field(title=title, description="a table", **default)


class Design(Table):
    """A microscope, with the tables and keys of its file.

    *Host.*

    Examples
    --------
    >>> import gs_jax as gs
    >>> design = gs.geomscope()
    >>> design.imaging.sensor_distance_mm, design.lens.refractive_index, len(design.array.centers_mm)
    (5.8, 1.43, 200)
    >>> scope = design.imager()  # in mm and radians
    """

    name: str = Field(title="name in reports", description="a string")
    sensor: SensorTable = _table("the camera")
    lens: LensTable = _table("plano-convex microlenses, alike or not")
    array: ArrayTable = _table("the plate, and where its lenses are")
    imaging: ImagingTable = _table("where the sensor and the object are, and the light")
    layers: LayersTable = _table("filters and windows in the light's path", default=LayersTable())
    sample: SampleTable | None = _table("the medium that holds the object by default; air without it", default=None)
    samples: dict[str, SampleTable] = Field(
        default={},
        title="samples by name, each a table like `[sample]`, for `--sample NAME`; one is needed without `[sample]`",
        description="a table of tables",
    )
    channels: dict[str, ChannelTable] = Field(
        default={},
        title="channels of captures by name, each with its `wavelength_nm`, for `--channel NAME` or several such names",
        description="a table of tables",
    )
    calibration: CalibrationTable = _table(
        "the array as found on the sensor; `gs-jax calibrate` writes it", default=CalibrationTable()
    )
    provenance: dict[str, Any] = _table("where the file comes from; free-form", default={})

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
        of_types = f" of {count} types" if count > 1 else ""
        return "\n".join(
            [
                f"Design {self.name!r}",
                f"  {len(array.centers_mm)} lenses{of_types}, {focal}{_shape(lens)}, n = {self.refractive_index:g}, "
                f"D = {span_of(lens.aperture_diameter_mm)} mm, on {array.size_mm[0]:g} x {array.size_mm[1]:g} mm, "
                f"{array.substrate_thickness_mm:g} mm thick",
                f"  sensor of {sensor.shape[0]} x {sensor.shape[1]} pixels of {sensor.pixel_pitch_um:g} um "
                f"at v = {imaging.sensor_distance_mm:g} mm",
                f"  objects at z = {imaging.working_distance_mm[0]:g} to {imaging.working_distance_mm[1]:g} mm, "
                f"{imaging.wavelength_nm:g} nm, field radius {imaging.field_radius_mm:g} mm",
                *format_path(self),
            ]
        )

    __str__ = __repr__

    @property
    def refractive_index(self) -> float:
        """Index of lenses and plate at the design's wavelength."""
        return index_of(self.lens.refractive_index, self.imaging.wavelength_nm)

    def imager(self, sample: str | Sample | None = None, wavelength_nm: float | None = None) -> Imager:
        """The geometry of this design: mm and radians.

        Parameters
        ----------
        sample
            What holds the object: the name of one of `[samples]`, "air" or "none" for air, or a `Sample`. By default
            that of `[sample]`; without one air, but where the design has `[samples]` a name is needed.
        wavelength_nm
            Of the light, if it is another than the design's, nm. Indices of materials follow; the design's emission
            band does not count.

        Raises
        ------
        InputError
            If there is no such sample, one of several is needed, or the wavelength is beyond the range of designs or
            of a material.

        Examples
        --------
        >>> import gs_jax as gs
        >>> gel = gs.Sample(1.43, surface=19.0)
        >>> scope = gs.geomscope().imager(gel, wavelength_nm=590.0)
        >>> print(round(float(scope.reduced_depth(21.0)), 3))  # 19 mm of air, 2 mm of gel, 1 mm of plate
        21.098
        """
        lens, imaging, calibration = self.lens, self.imaging, self.calibration
        wavelength = imaging.wavelength_nm if wavelength_nm is None else wavelength_nm
        if not 1e6 * SHORTEST <= wavelength <= 1e6 * LONGEST:
            allowed = f"a number of nanometres from {1e6 * SHORTEST:g} to {1e6 * LONGEST:g}"
            raise InputError(f"`wavelength_nm` must be {allowed}, got {wavelength}.")
        array = MicrolensArray(
            np.array(self.array.centers_mm),
            radius_of_curvature=_one_if_alike(lens.radius_of_curvature_mm),
            refractive_index=index_of(lens.refractive_index, wavelength),
            aperture_diameter=_one_if_alike(lens.aperture_diameter_mm),
            substrate_thickness=self.array.substrate_thickness_mm,
            thin_lens_focal_length=lens.focal_length_mm,
            size=self.array.size_mm,
            orientation=lens.orientation,
            conic_constant=_one_if_alike(lens.conic_constant),
            aspheric_terms=lens.aspheric_terms,
        )
        medium = sample if isinstance(sample, Sample) else sample_table(self, sample)
        try:
            return Imager(
                array,
                Sensor(self.sensor.shape, self.sensor.pixel_pitch_um / 1000, self.sensor.origin_mm or (0.0, 0.0)),
                sensor_distance=imaging.sensor_distance_mm,
                field_radius=imaging.field_radius_mm,
                wavelength=wavelength / 1e6,
                rotation=math.radians(calibration.rotation_deg),
                shift=calibration.shift_mm,
                tilt=np.tan(np.radians(calibration.tilt_deg)) if any(calibration.tilt_deg) else None,
                filters=layers_of(self.layers.object, wavelength),
                windows=layers_of(self.layers.sensor, wavelength),
                sample=medium if isinstance(medium, Sample) else sample_of(medium, wavelength),
                band=emission_band(self, medium) if wavelength_nm is None else None,
            )
        except ValueError as error:  # of a `Sample` that is given: the rest is checked
            raise InputError(str(error)) from error

    @classmethod
    def from_imager(
        cls, imager: Imager, *, name: str, working_distance_mm: tuple[float, float] | None = None
    ) -> "Design":
        """The design of an imager; its `imager()` is equal, but for rounding of angles.

        Parameters
        ----------
        imager
            On a plate of finite size, its numbers within the range of design files.
        name
            What reports call the design.
        working_distance_mm
            Nearest and farthest object. By default what is sharp by Eq. 8 with a circle of confusion of two pixels.

        Raises
        ------
        InputError
            If the imager makes no design, or has no depth in focus and no working distance is given.

        Examples
        --------
        >>> import gs_jax as gs
        >>> scope = gs.geomscope().imager()
        >>> mine = gs.Design.from_imager(scope, name="mine", working_distance_mm=(18.0, 30.0))
        >>> mine.imaging == gs.geomscope().imaging
        True
        """
        data: dict[str, Any] = {"name": name} | tables_of(imager)
        data["imaging"]["working_distance_mm"] = working_distance_mm or sharp_depths(imager)
        return _validated(data)

    def replace(self, **values: Any) -> "Design":
        """The design with some keys of its tables replaced, checked as a file is.

        Parameters
        ----------
        **values
            By key, without the name of its table: `centers_mm`, `sensor_distance_mm`, `shape`, ... Lists may be arrays.
            `layers`, `sample`, `samples`, `channels` and `provenance` are replaced as a whole.

        Raises
        ------
        InputError
            If there is no such key, or the whole makes no microscope.

        Examples
        --------
        >>> import gs_jax as gs
        >>> gs.geomscope().replace(sensor_distance_mm=6.0).imaging.sensor_distance_mm
        6.0
        """
        data, tables = self.model_dump(), {key: table for table in _TABLES for key in _fields(table)}
        for key, value in values.items():
            value = value.tolist() if hasattr(value, "tolist") else value
            if key in tables:
                data[tables[key]][key] = value
            elif key in _WHOLE:
                data[key] = value
            else:
                nearest = difflib.get_close_matches(key, tables, n=3) or sorted(tables)
                raise InputError(f"keys must be those of a design file, such as {', '.join(nearest)}, got {key}.")
        return _validated(data)


# Whose keys all differ, and what is replaced as a whole.
_TABLES = ("sensor", "lens", "array", "imaging", "calibration")
_WHOLE = ("name", "layers", "sample", "samples", "channels", "provenance")


def _fields(table: str):
    annotation = Design.model_fields[table].annotation
    assert isinstance(annotation, type) and issubclass(annotation, Table)
    return annotation.model_fields


def _validated(data: dict[str, Any]) -> Design:
    try:
        return Design.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{one_line(error, Design, {})}.") from error


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


def read_design(path: PathLike) -> Design:
    """The design in a TOML file. A `centers_file`, relative to it, is read in place of `centers_mm`.

    *File.*

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
    data = read_toml(path)
    inline_files(Path(path), data)
    return checked_design(path, data)


def checked_design(path: PathLike, data: dict[str, Any]) -> Design:
    """The design of the tables that the file `path` has, or will have; it raises and warns as `read_design`."""
    try:
        design = Design.model_validate(data)
    except ValidationError as error:
        # A slip of a unit is why lenses are beside the sensor, and comes first.
        problems = [*slips(data), one_line(error, Design, {"array": list(CentersTable.model_fields)})]
        raise InputError(f"{' '.join(problems)} ({path}).") from error
    for question in doubts(data, design):
        warnings.warn(f"{path}: {question}", InputWarning, stacklevel=3)
    return design


def write_design(path: PathLike, design: Design) -> None:
    """Writes a design as TOML, its centres inside, whole or not at all; what is read back is equal.

    *File.*

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
