"""What a design promises, Eqs. 1-11 over its working distance, and what is wrong with it, in words."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.table import Table

from ..base.errors import InputError, short_repr
from ..geometry import Imager
from ..layouts.cells import check_positive, coverage, nearest_neighbour_distances
from ..optics import aberrations, theory
from .design import Design

# Depths of a datasheet whose caller names none.
_DEPTHS = 7


class Performance(eqx.Module):
    """The paper's metrics of a microscope, one entry a depth, in mm; the near and far limits are depths `z`."""

    magnification: Float[Array, " depth"]
    scale: Float[Array, " depth"]
    lateral_resolution: Float[Array, " depth"]
    axial_resolution: Float[Array, " depth"]
    depth_of_field: Float[Array, " depth"]
    near_limit: Float[Array, " depth"]
    far_limit: Float[Array, " depth"]
    lenses_per_point: Float[Array, ""]
    occupancy: Float[Array, " depth"]
    wavefront_rms: Float[Array, " depth"]
    strehl_on_axis: Float[Array, " depth"]
    focus_distance: Float[Array, " depth"]
    blur: Float[Array, " depth"]


@jax.jit
def performance(
    imager: Imager,
    depths: Float[Array, " depth"],
    *,
    diameter: Float[Array, ""] | float,
    field_radius: Float[Array, ""] | float,
    confusion: Float[Array, ""] | float,
) -> Performance:
    """Eqs. 1-11 for a microscope at these depths; differentiable in everything.

    Parameters
    ----------
    imager
        The microscope, on a plate of finite size. Its own `field_radius` decides shapes and cannot be traced.
    depths
        From the plate, mm.
    diameter
        Of the clear aperture, mm: `gs_jax.optics.aperture.clear_diameter(imager.array)`.
    field_radius
        `sqrt(A_e / pi)`, mm.
    confusion
        Diameter of the circle of confusion, mm.

    Returns
    -------
    Performance
        The Strehl ratio is that of the sensor where it is, by Eqs. 9 and 10 as printed.

    Raises
    ------
    ValueError
        If the plate is infinite: it has no density of lenses.
    """
    array, v = imager.array, imager.sensor_distance
    plate_area = math.prod(array.size)
    if not math.isfinite(plate_area):
        raise ValueError(f"`imager.array.size` must be finite, got {array.size}.")
    f, reduced, m = array.focal_length, imager.reduced_depth(depths), imager.magnification(depths)
    front = imager.reduced_depth(0.0)
    f_number, aperture = theory.f_number(f, diameter), theory.numerical_aperture(f, diameter)
    lateral = theory.lateral_resolution(imager.wavelength, aperture, imager.sensor.pixel_pitch, m)
    n_e = theory.lenses_per_point(float(array.centers.shape[0]), plate_area, field_radius)
    rms = aberrations.linear_rms(aberrations.of_array(array, diameter / 2, reduced, 0.0, v))
    return Performance(
        magnification=m,
        scale=imager.scale(depths),
        lateral_resolution=lateral,
        axial_resolution=theory.axial_resolution(lateral, reduced, field_radius),
        depth_of_field=theory.depth_of_field(f, f_number, reduced, confusion),
        near_limit=theory.near_limit(f, f_number, reduced, confusion) - front,
        far_limit=theory.far_limit(f, f_number, reduced, confusion) - front,
        lenses_per_point=n_e,
        occupancy=theory.occupancy(n_e, m),
        wavefront_rms=rms,
        strehl_on_axis=aberrations.strehl(rms, imager.wavelength),
        focus_distance=theory.focus_distance(f, reduced),
        blur=theory.blur(f, diameter, reduced, v),
    )


def datasheet(
    design: Design, depths: Sequence[float] | None = None, *, confusion: float | None = None
) -> dict[str, Any]:
    """The metrics of a design as numbers for a JSON file, with units in the names.

    Parameters
    ----------
    design
        The microscope. Its clear aperture is what the lenses' discs cover of the plate, divided by their number.
    depths
        From the plate, mm; by default seven over the working distance.
    confusion
        Diameter of the circle of confusion on the sensor, mm; by default two pixels (paper, "Depth of field").

    Returns
    -------
    dict
        Lists with one entry a depth, and scalars. `None` stands for infinity.

    Raises
    ------
    InputError
        If a depth or the confusion is not positive and finite, or there is no depth.
    """
    depths = _checked(design, depths)
    confusion = confusion_of(design, confusion)
    centers, size = np.array(design.array.centers_mm), design.array.size_mm
    covered = coverage(centers, size, diameter=design.lens.aperture_diameter_mm)
    diameter = math.sqrt(4 / math.pi * covered * math.prod(size) / len(centers))
    imager, imaging = design.imager(), design.imaging
    metrics = performance(
        imager,
        jnp.asarray(depths, float),
        diameter=diameter,
        field_radius=imaging.field_radius_mm,
        confusion=confusion,
    )
    distances = nearest_neighbour_distances(centers)
    f = float(imager.array.focal_length)
    return {
        "depth_mm": depths,
        "magnification": _rounded(metrics.magnification),
        "scale": _rounded(metrics.scale),
        "lateral_resolution_um": _rounded(metrics.lateral_resolution * 1000),
        "axial_resolution_um": _rounded(metrics.axial_resolution * 1000),
        "depth_of_field_mm": _rounded(metrics.depth_of_field),
        "near_limit_mm": _rounded(metrics.near_limit),
        "far_limit_mm": _rounded(metrics.far_limit),
        "lenses_per_point": _rounded(jnp.broadcast_to(metrics.lenses_per_point, len(depths))),
        "occupancy": _rounded(metrics.occupancy),
        "strehl_on_axis": _rounded(metrics.strehl_on_axis),
        "focus_distance_mm": _rounded(metrics.focus_distance),
        "blur_um": _rounded(metrics.blur * 1000),
        "f_number": _round(f / diameter),
        "numerical_aperture": _round(diameter / (2 * f)),
        "focal_length_mm": _round(f),
        "pitch_mm": _round(float(distances.mean())),
        "pitch_sd_mm": _round(float(distances.std())) if len(centers) > 1 else 0.0,
        "field_radius_mm": imaging.field_radius_mm,
        "coverage": _round(covered),
    }


def tables(sheet: dict[str, Any]) -> list[Table]:
    """A datasheet to read: what an image in focus shows, and how far out of focus it is. Both fit 80 columns."""
    return [_table(title, columns, sheet) for title, columns in _TABLES.items()]


def summary(design: Design, sheet: dict[str, Any]) -> str:
    """The lens and the array in one line."""
    return (
        f"{design.name}: f = {_plain(sheet['focal_length_mm'])} mm, F/{_plain(sheet['f_number'])}, "
        f"NA {_plain(sheet['numerical_aperture'])}, pitch {_plain(sheet['pitch_mm'])} mm "
        f"(SD {_plain(sheet['pitch_sd_mm'])} mm), field radius {_plain(sheet['field_radius_mm'])} mm, "
        f"{100 * sheet['coverage']:.1f} % of the plate covered"
    )


_TABLES = {
    "In focus, without aberrations (Eqs. 1-8, 11)": {
        "depth_mm": "depth\nmm",
        "magnification": "magnifi-\ncation",
        "scale": "scale",
        "lateral_resolution_um": "lateral\nresol. um",
        "axial_resolution_um": "axial\nresol. um",
        "lenses_per_point": "lenses\na point",
        "occupancy": "occu-\npancy",
    },
    "Focus: depth of field of a sensor at the image; blur and Strehl ratio of the sensor where it is (Eqs. 7-10)": {
        "depth_mm": "depth\nmm",
        "focus_distance_mm": "image at\nmm",
        "depth_of_field_mm": "depth of\nfield mm",
        "near_limit_mm": "near\nmm",
        "far_limit_mm": "far\nmm",
        "blur_um": "blur\num",
        "strehl_on_axis": "Strehl\nratio",
    },
}


def _table(title: str, columns: dict[str, str], sheet: dict[str, Any]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for header in columns.values():
        table.add_column(header, justify="right")
    for row in zip(*(sheet[key] for key in columns), strict=True):
        table.add_row(*map(_plain, row))
    return table


def _plain(value: float | None) -> str:
    return "inf" if value is None else f"{value:.4g}"


def _round(value: float) -> float | None:
    """Six digits, more than any of the formulas is worth."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _rounded(values: Float[Array, " depth"]) -> list[float | None]:
    return [_round(value) for value in values.tolist()]


def _checked(design: Design, depths: Sequence[float] | None) -> list[float]:
    if depths is None:
        return np.linspace(*design.imaging.working_distance_mm, _DEPTHS).tolist()
    found = [float(depth) for depth in depths]
    if not found or not all(0 < depth < math.inf for depth in found):
        raise InputError(f"`depths` must be one or more positive lengths, mm, got {short_repr(found)}.")
    return found


def confusion_of(design: Design, confusion: float | None) -> float:
    """The circle of confusion asked for, by default two pixels, mm; `InputError` unless positive and finite."""
    if confusion is None:
        return 2 * design.sensor.pixel_pitch_um / 1000
    check_positive("confusion", confusion)
    return confusion
