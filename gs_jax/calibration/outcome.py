"""What a calibration found, for people and for files: a table, a picture, and the design."""

from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib.figure import Figure
from pydantic import ValidationError
from rich.table import Table

from ..base.errors import InputError
from ..design.centers import LENS_KEYS
from ..design.design import Design
from ..design.tables import CalibrationTable
from ..design.validation import reach
from ..io.provenance import Provenance
from ..io.toml import one_line
from ..lenses import EACH, MicrolensArray
from .fit import Calibration

# Length of the longest arrow in a picture, in sides of the sensor.
_LONGEST = 0.08


def calibrated(design: Design, found: Calibration, provenance: Provenance | None = None) -> Design:
    """The design with what was found, which it says in its provenance, too; `InputError` if it is none.

    Lenses whose images fall beside the sensor, now that it is known where they are, are left out.
    """
    imager = found.imager
    one = lambda value: float(f"{float(value):.9g}")

    def pair(values) -> tuple[float, float]:
        x, y = np.asarray(values, np.float64)
        return one(x), one(y)

    centers = np.asarray(imager.array.centers, np.float64)
    # A plate that is larger than thought, or lenses found beyond it.
    size = np.maximum(design.array.size_mm, 2 * np.abs(centers).max(0) * (1 + 1e-9))
    pairs = tuple(map(pair, centers))
    array = design.array.model_copy(update={"centers_mm": pairs, "size_mm": pair(size)})
    tilt = (0.0, 0.0) if imager.tilt is None else np.degrees(np.arctan(imager.tilt))
    places = CalibrationTable(
        rotation_deg=one(np.degrees(imager.rotation)), shift_mm=pair(imager.shift), tilt_deg=pair(tilt)
    )
    said: dict[str, Any] = {
        **(provenance or {}),
        "calibrated_rms_pixels": round(found.rms, 4),
        "calibrated_spots": len(found.residuals),
        "calibrated_captures": len(np.unique(found.sources.captures[found.spots.sources])),
        "mirrored": found.mirrored,
        "calibrated_values": {name: float(f"{value:.9g}") for name, value in found.values.items()},
        "standard_deviations": {name: float(f"{sd:.3g}") for name, sd in found.deviations.items()},
    }
    lens = design.lens.model_copy(update=_of_each_lens(imager.array))
    new = design.model_copy(
        update={
            "lens": lens,
            "array": array,
            "imaging": design.imaging.model_copy(update={"sensor_distance_mm": one(imager.sensor_distance)}),
            "calibration": places,
            "provenance": {**design.provenance, **said},
        }
    )
    distance, radius = reach(new)
    if new.sensor.origin_mm is None and (distance > radius).any():
        on = np.flatnonzero(distance <= radius)
        kept = {key: tuple(values[k] for k in on) for key, values in _of_each_lens(imager.array).items()}
        array = array.model_copy(update={"centers_mm": tuple(pairs[k] for k in on)})
        new = new.model_copy(update={"array": array, "lens": lens.model_copy(update=kept)})
        new.provenance["lenses_beside_the_sensor"] = len(pairs) - len(on)
    try:
        return Design.model_validate(new.model_dump())
    except ValidationError as error:
        raise InputError(f"calibrated design: {one_line(error, Design, {})}.") from error


def _of_each_lens(array: MicrolensArray) -> dict[str, tuple[float, ...]]:
    """Values of the keys of `[lens]` that are lists, by the fewest decimals that give the array's numbers."""
    numbers = {key: np.asarray(getattr(array, name)) for key, name in zip(LENS_KEYS, EACH, strict=True)}
    return {key: tuple(float(str(one)) for one in value) for key, value in numbers.items() if value.ndim}


def table(design: Design, found: Calibration) -> Table:
    """What was, and what was found."""
    made = Table("", "design", "found", "SD", box=None, pad_edge=False)
    places = design.calibration
    before = {
        "sensor_distance_mm": design.imaging.sensor_distance_mm,
        "rotation_deg": places.rotation_deg,
        **dict(zip(("shift_x_mm", "shift_y_mm"), places.shift_mm, strict=True)),
        **dict(zip(("tilt_x_deg", "tilt_y_deg"), places.tilt_deg, strict=True)),
        "scale": 1.0,
        "depth_offset_mm": 0.0,
    }
    for name, value in found.values.items():
        made.add_row(name, f"{before[name]:.6g}", f"{value:.6g}", f"{found.deviations[name]:.2g}")
    return made


def scales(found: Calibration) -> Float64[np.ndarray, "source 3"]:
    """Depth, mm, and scale `s_z` of the lenses' pattern (Eq. 1), as the spots of each source and as the fit have it.

    Sources with fewer than four spots are left out. What aberrations do is taken off.
    """
    centers, rows = np.asarray(found.imager.centers, np.float64), []
    for source in np.unique(found.spots.sources):
        mine = found.spots.sources == source
        beside = centers[found.spots.lenses[mine]]
        beside = beside - beside.mean(0)
        if len(beside) >= 4:
            fitted = float(found.imager.scale(float(found.sources.points[source, 2])))
            off = found.residuals[mine] * found.imager.sensor.pixel_pitch
            rows.append((found.sources.points[source, 2], fitted - (beside * off).sum() / (beside**2).sum(), fitted))
    return np.array(rows, np.float64).reshape(-1, 3)


def picture(found: Calibration) -> Figure:
    """Residuals of all spots where they are on the sensor, their distances, and the pattern's scale by depth."""
    sensor, places = found.imager.sensor, found.spots.places
    distance = np.hypot(*found.residuals.T)
    rows, columns = sensor.shape
    figure = Figure(figsize=(12, 4), dpi=100, layout="constrained")
    arrows, counts, lines = figure.subplots(1, 3)
    half = np.array([columns, rows]) * sensor.pixel_pitch / 2
    scale = max(float(distance.max()), 1e-12) / (_LONGEST * 2 * half.max())
    colours = found.sources.captures[found.spots.sources]
    arrows.quiver(*places.T, *found.residuals.T, colours, angles="xy", scale_units="xy", scale=scale)
    arrows.set(xlim=sensor.extent[:2], ylim=sensor.extent[2:], aspect="equal", xlabel="x, mm", ylabel="y, mm")
    arrows.set_title(f"residuals, longest {distance.max():.2f} pixels; colour: capture", fontsize=9)
    counts.hist(distance, bins=30)
    counts.set(xlabel="distance, pixels", ylabel="spots")
    counts.set_title(f"{len(distance)} spots, {found.rms:.3f} pixels RMS", fontsize=9)
    depth, seen, fitted = scales(found).T
    inverse = 1 / (depth + float(found.imager.reduced_depth(0.0)))
    order = np.argsort(inverse)
    lines.plot(inverse[order], fitted[order], color="0.6", label="1 + v/z'")
    lines.plot(inverse, seen, ".", label="spots of a source")
    lines.set(xlabel="1/z', 1/mm", ylabel="scale of the pattern, s_z")
    worst = float(np.abs(seen - fitted).max()) if len(seen) else 0.0
    lines.set_title(f"s_z by depth (Eq. 1), off by up to {worst:.1e}", fontsize=9)
    lines.legend(fontsize=8)
    return figure
