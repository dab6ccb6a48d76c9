"""The molded surface as heights on a grid, and as a list of lenses, for makers and optical programs. Lengths in mm.

There are two frames, both right-handed, with the design's x. That of the maker looks at the lenses: x to the right, y
up, z toward the viewer, 0 on the plate between the lenses. That of optical programs has z along the light, 0 at the
vertices, and y against the design's. Where the plano side faces the object, they differ by a shift along z alone.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ..base.errors import InputError, input_error
from ..lenses import MicrolensArray
from .lenslets import Lenslet, lenslet_height, lenslets_of, surface_height
from .solids import plate_thickness

# OpticStudio reads no smaller grids.
MIN_POINTS = 5
# Points that are computed at a time.
_BLOCK = 2**19
# Relative step of the difference that gives the cross derivative.
_STEP = 1e-4

MAKER = "seen from the side of the lenses: x to the right, y up, z toward the viewer, z = 0 on the plate between lenses"
OPTICAL = "z along the light, z = 0 at the vertices of the lenses"


@dataclass(frozen=True)
class HeightMap:
    """Heights above the plate between the lenses, at points `step` apart, centred on the plate, mm.

    Rows are ordered from the largest y to the smallest, in the frame of the maker, columns from the smallest x.

    Raises `InputError` if the plate is infinite, or `step` leaves fewer than `MIN_POINTS` points on a side.
    """

    array: MicrolensArray
    step: float

    def __post_init__(self):
        if self.array.size is None:
            raise InputError("`array.size_mm` must be finite, got an infinite plate.")
        if min(self.shape) < MIN_POINTS:
            most = min(self.array.plate) / (MIN_POINTS - 1)
            raise input_error("step of the grid", f"at most {1000 * most:.4g} um", f"{1000 * self.step:g} um")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        columns, rows = (math.floor(side / self.step * (1 + 1e-9)) + 1 for side in self.array.plate)
        return rows, columns

    @cached_property
    def lenslets(self) -> list[Lenslet]:
        """In the frame of the part, whose y runs along the rows."""
        return lenslets_of(self.array)

    @cached_property
    def top(self) -> float:
        """Height of the vertices, mm."""
        return lenslet_height(self.array)

    @cached_property
    def x(self) -> Float[np.ndarray, " column"]:
        """Of each column, mm."""
        return _centred(self.shape[1]) * self.step

    @cached_property
    def y(self) -> Float[np.ndarray, " row"]:
        """Of each row in the frame of the maker, mm."""
        return -_centred(self.shape[0]) * self.step

    def blocks(self) -> Iterator[slice]:
        """Rows that are computed at a time."""
        rows, columns = self.shape
        size = max(1, _BLOCK // columns)
        yield from (slice(first, min(first + size, rows)) for first in range(0, rows, size))

    def surface(self, rows: slice) -> tuple[Float[np.ndarray, "row column"], Int[np.ndarray, "row column"]]:
        """Heights of some rows, and the lenslet at each point, -1 on the plate and walls."""
        y, x = np.meshgrid(-self.y[rows], self.x, indexing="ij")
        height, owner = surface_height(self.lenslets, np.column_stack([x.ravel(), y.ravel()]))
        return height.reshape(x.shape), owner.reshape(x.shape)

    def derivatives(self, rows: slice, owner: Int[np.ndarray, "row column"]) -> Float[np.ndarray, "3 row column"]:
        """Derivatives of the heights by x, by y and by both, in the frame of the maker; 0 on the plate and walls."""
        y, x = np.meshgrid(self.y[rows], self.x, indexing="ij")
        found = np.zeros((3, *x.shape))
        for number in np.unique(owner[owner >= 0]).tolist():
            lenslet, its = self.lenslets[number], owner == number
            dx, dy = x[its] - lenslet.center[0], y[its] + lenslet.center[1]
            squared, around = dx**2 + dy**2, _STEP * lenslet.semi_aperture**2
            low, high = np.maximum(squared - around, 0), np.minimum(squared + around, lenslet.semi_aperture**2)
            slope = lenslet.sag_slope_over_r(squared)
            change = (lenslet.sag_slope_over_r(high) - lenslet.sag_slope_over_r(low)) / (high - low)
            found[:, its] = -slope * dx, -slope * dy, -2 * change * dx * dy
        return found


def _centred(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


# Columns of the list of lenses; those of a plate are empty in lenses and the other way round.
LENS_COLUMNS = (
    *("object_type", "comment", "x_mm", "y_mm", "z_mm", "refractive_index", "x_half_width_mm", "y_half_width_mm"),
    *("thickness_mm", "radius_1_mm", "conic_1", "clear_semi_diameter_1_mm", "edge_semi_diameter_1_mm"),
    *("radius_2_mm", "conic_2", "clear_semi_diameter_2_mm", "edge_semi_diameter_2_mm"),
)


def lens_table(array: MicrolensArray) -> tuple[list[str], list[dict[str, str | float]]]:
    """Columns and rows of a list of objects for non-sequential ray tracing, in the frame of optical programs.

    The first is the plate, the others are plano-convex lenses of the same material, which begin in its middle: the
    array is their union. Positions are those of front faces, radii and coefficients have the signs of OpticStudio.
    """
    thickness, top, index = plate_thickness(array), lenslet_height(array), float(array.refractive_index)
    is_front = array.orientation == "curved"
    side = 1.0 if is_front else -1.0  # of the centres of curvature, and of the plate, along z
    far, middle = thickness + top, thickness / 2 + top
    half_x, half_y = (each / 2 for each in array.plate)
    rows: list[dict[str, str | float]] = [
        {"object_type": "Rectangular Volume", "comment": "plate", "x_mm": 0.0, "y_mm": 0.0}
        | {"z_mm": top if is_front else -far, "refractive_index": index, "thickness_mm": thickness}
        | {"x_half_width_mm": half_x, "y_half_width_mm": half_y}
    ]
    lenslets = lenslets_of(array)
    names = [f"coefficient_r{order}_per_mm{order - 1}" for order in range(4, 4 + 2 * len(lenslets[0].terms), 2)]
    plane, curved = ("2", "1") if is_front else ("1", "2")
    for number, (lens, (x, y)) in enumerate(zip(lenslets, np.asarray(array.centers, float).tolist(), strict=True), 1):
        row: dict[str, str | float] = {"object_type": "Even Asphere Lens" if names else "Standard Lens"}
        row |= {"comment": f"lens {number}", "x_mm": x, "y_mm": -y, "z_mm": 0.0 if is_front else -middle}
        row |= {"refractive_index": index, "thickness_mm": middle}
        row |= {f"radius_{plane}_mm": 0.0, f"conic_{plane}": 0.0}
        row |= {f"radius_{curved}_mm": side * lens.radius, f"conic_{curved}": lens.conic}
        row |= {f"{what}_semi_diameter_{face}_mm": lens.semi_aperture for what in ("clear", "edge") for face in "12"}
        rows.append(row | dict(zip(names, (side * term for term in lens.terms), strict=True)))
    return [*LENS_COLUMNS, *names], rows
