"""Tables of a design file, with the type, range and meaning of each key."""

from typing import Annotated, Literal

from pydantic import Field, Tag

from ..geometry import LONGEST, SHORTEST
from ..io.toml import EACH, NAME, ONE, Table, number_or_name, one_or_each
from ..lenses import Orientation
from ..materials import MATERIALS
from .centers import MAX_LENSES

# Descriptions are the allowed values, titles the meaning of a key. Error messages, comments in files, the schema for
# editors and the page of keys are made of them.
Length = Annotated[float, Field(ge=1e-6, le=1e4, description="a number of mm from 1e-6 to 1e4")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Pixels = Annotated[int, Field(ge=2, le=65536)]
Wavelength = Annotated[
    float, Field(ge=1e6 * SHORTEST, le=1e6 * LONGEST, description="a number of nanometres from 10 to 1e5")
]
# Not strict: a TOML array is a list, and a frozen model needs tuples.
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
# One number for all lenses, or one for each.
Lengths = Annotated[Annotated[Length, Tag(ONE)] | Annotated[tuple[Length, ...], _ForEach, Tag(EACH)], one_or_each]
Conics = Annotated[Annotated[Conic, Tag(ONE)] | Annotated[tuple[Conic, ...], _ForEach, Tag(EACH)], one_or_each]
_ONE_EACH = "or a list with one for each lens, in the order of the centres"
Material = Literal["air", "PDMS", "PMMA", "BK7", "fused silica", "water"]
_NAMES = ", ".join(f'"{name}"' for name in MATERIALS if name != "air")
Index = Annotated[
    Annotated[Material, Tag(NAME)] | Annotated[float, Field(ge=1, le=5), Tag(ONE)],
    number_or_name,
    Field(description=f"a number from 1 to 5, or one of {_NAMES}"),
]
LensIndex = Annotated[Annotated[Material, Tag(NAME)] | Annotated[float, Field(gt=1, le=5), Tag(ONE)], number_or_name]
_Line = Annotated[tuple[Wavelength, Annotated[float, Field(ge=0, le=1e30)]], Field(strict=False)]
Spectrum = Annotated[
    tuple[_Line, ...],
    Field(strict=False, max_length=100_000, description="[[nanometres, light], ...], the light in any unit"),
]
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

    `origin_mm` is the region's middle. At least one lens has to have an image on a region.
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

    A list has one number for each lens; columns of these names in the `centers_file` are read into it. At the radius
    r the curved side is `c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A4 r^4 + A6 r^6 + ...` below its vertex,
    with `c = 1/R` and all lengths in mm.
    """

    radius_of_curvature_mm: Lengths = Field(
        title="R of the curved side at its vertex, positive; a focal length f in air is R = f (n - 1)",
        description=f"a number of mm from 1e-6 to 1e4, {_ONE_EACH}",
    )
    refractive_index: LensIndex = Field(
        title="n of lenses and plate at the wavelength: PDMS 1.43, fused silica 1.46, acrylic 1.49, BK7 1.52",
        description=f"a number above 1, up to 5, or one of {_NAMES}",
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
    bandwidth_nm: float = Field(
        default=0.0,
        ge=0,
        le=1e4,
        title="full width of an even emission band about `wavelength_nm`, over which PSFs are means; 0 for none",
        description="a number of nanometres from 0 to 1e4",
    )
    spectrum_nm: Spectrum = Field(
        default=(),
        title="in place of `bandwidth_nm`: pairs of a wavelength and its light, between which it is linear; "
        "`spectrum_file` names a CSV file with the header `wavelength_nm,light` that is read in its place",
    )
    field_radius_mm: Length = Field(
        title="how far beside its axis, in the object, a lens still counts as seeing a point; sqrt(A_e / pi)"
    )


class LayerTable(Table):
    """A plane layer that light crosses."""

    name: str = Field(default="", title="what it is, for people", description="a string")
    thickness_mm: Length = Field(title="thickness")
    refractive_index: Index = Field(
        default=1.0,
        title="n at the wavelength; 1, air, by default",
        description=f"a number from 1 to 5, or one of {_NAMES}",
    )


LayerTables = Annotated[tuple[LayerTable, ...], Field(strict=False, description="a list of tables")]


class LayersTable(Table):
    """`[layers]`: filters and windows, in `[[layers.object]]` and `[[layers.sensor]]`.

    Each begins where the last ends. Those on the object's side tilt with the array. What is left of the sensor distance
    is air.
    """

    object: LayerTables = Field(
        default=(), title="layers on the object's side, from the array's front outward", description="a list of tables"
    )
    sensor: LayerTables = Field(
        default=(),
        title="layers on the sensor's side, from the sensor toward the array: the gap to the window, the window",
        description="a list of tables",
    )


class SampleTable(Table):
    """`[sample]`: the medium that holds the object, or `[samples.NAME]`."""

    refractive_index: Index = Field(
        title="n of the object's medium at the wavelength; 1, air, is no sample",
        description=f"a number from 1 to 5, or one of {_NAMES}",
    )
    surface_mm: float | None = Field(
        default=None,
        ge=0,
        le=1e4,
        title="depth at which the medium begins, from the array's front; without it the medium begins where layers end",
        description="a number of mm from 0 to 1e4",
    )
    layers: LayerTables = Field(
        default=(),
        title="cover slips and the like of this sample, from the array outward; they end where the medium begins",
        description="a list of tables",
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
