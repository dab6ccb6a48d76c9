"""What a calibration found, for people and for files: a table, a picture, and the design."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import ValidationError
from rich.table import Table

from ..base.errors import InputError
from ..designs.design import CalibrationTable, Design
from ..io.provenance import Provenance
from ..io.tables import one_line
from .fit import NAMES, Calibration

# Length of the longest arrow in a picture, in sides of the sensor.
_LONGEST = 0.08


def values_of(found: Calibration) -> dict[str, float]:
    """What was fitted, by `NAMES`."""
    imager = found.imager
    x, y = np.asarray(imager.shift, np.float64).tolist()
    return dict(zip(NAMES, (float(imager.sensor_distance), math.degrees(float(imager.rotation)), x, y), strict=True))


def calibrated(design: Design, found: Calibration, provenance: Provenance | None = None) -> Design:
    """The design with what was found, which it says in its provenance, too; `InputError` if it is none."""
    values = {name: float(f"{value:.9g}") for name, value in values_of(found).items()}
    shift = (values["shift_x_mm"], values["shift_y_mm"])
    array = design.array
    if found.mirrored:
        array = array.model_copy(update={"centers_mm": tuple((x, -y) for x, y in array.centers_mm)})
    said: dict[str, Any] = {
        **(provenance or {}),
        "calibrated_rms_pixels": round(found.rms, 4),
        "calibrated_spots": len(found.residuals),
        "calibrated_captures": len(np.unique(found.spots.captures)),
        "mirrored": found.mirrored,
        "standard_deviations": {name: float(f"{sd:.3g}") for name, sd in found.deviations.items()},
    }
    new = design.model_copy(
        update={
            "array": array,
            "imaging": design.imaging.model_copy(update={"sensor_distance_mm": values["sensor_distance_mm"]}),
            "calibration": CalibrationTable(rotation_deg=values["rotation_deg"], shift_mm=shift),
            "provenance": {**design.provenance, **said},
        }
    )
    try:
        return Design.model_validate(new.model_dump())
    except ValidationError as error:
        raise InputError(f"calibrated design: {one_line(error, Design, {})}.") from error


def table(design: Design, found: Calibration) -> Table:
    """What was, and what was found."""
    made = Table("", "design", "found", "SD", box=None, pad_edge=False)
    rotation, shift = design.calibration.rotation_deg, design.calibration.shift_mm
    before = (design.imaging.sensor_distance_mm, rotation, *shift)
    for (name, value), old in zip(values_of(found).items(), before, strict=True):
        made.add_row(name, f"{old:.6g}", f"{value:.6g}", f"{found.deviations[name]:.2g}")
    return made


def picture(found: Calibration) -> Figure:
    """Residuals of all spots where they are on the sensor, and their distances."""
    sensor, places = found.imager.sensor, found.spots.places
    distance = np.hypot(*found.residuals.T)
    rows, columns = sensor.shape
    figure = Figure(figsize=(9, 4), dpi=100, layout="constrained")
    arrows, counts = figure.subplots(1, 2, width_ratios=(1, 1))
    half = np.array([columns, rows]) * sensor.pixel_pitch / 2
    scale = max(float(distance.max()), 1e-12) / (_LONGEST * 2 * half.max())
    colours = found.spots.captures
    arrows.quiver(*places.T, *found.residuals.T, colours, angles="xy", scale_units="xy", scale=scale)
    arrows.set(xlim=sensor.extent[:2], ylim=sensor.extent[2:], aspect="equal", xlabel="x, mm", ylabel="y, mm")
    arrows.set_title(f"residuals, longest {distance.max():.2f} pixels; colour: capture", fontsize=9)
    counts.hist(distance, bins=30)
    counts.set(xlabel="distance, pixels", ylabel="spots")
    counts.set_title(f"{len(distance)} spots, {found.rms:.3f} pixels RMS", fontsize=9)
    return figure
