"""Results of a calibration for files and people: the calibrated design, a table and a figure."""

from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.table import Table

from ..base.errors import errors_name_file
from ..design.conversion import default_sample, format_medium, layers_of, sample_table, sample_tables
from ..design.design import Design
from ..design.tables import LENS_KEYS
from ..design.validation import reach
from ..io.provenance import Provenance
from ..microscope.geometry import Imager
from ..microscope.lenses import EACH, MicrolensArray
from ..microscope.media import index_of
from .fit import Calibration

# Length of the longest arrow in the figure, in sides of the sensor.
_LONGEST = 0.08
# Width of an arrow, in widths of the drawing; captures that a legend names; share of the colours that show on white.
_ARROW, _MOST_NAMED, _DARKEST = 0.004, 12, 0.9
# Least half range of its axis of scales.
_LEAST_RANGE = 1e-3


def apply_calibration(
    design: Design, result: Calibration, provenance: Provenance | None = None, *, sample: str | None = None
) -> Design:
    """The design with the calibrated values, which its provenance lists, too; `InputError` if it is not valid.

    Lenses that turn out to be imaged beside the sensor are left out. What was fitted of a sample goes into the one of
    `[samples]` that `sample` names, or into `[sample]`.
    """
    imager = result.imager
    if not {"sample_at_mm", "sample_index"}.isdisjoint(result.values):
        design = with_sample(design, imager, sample)

    def rounded(value) -> float:
        return float(f"{float(value):.9g}")

    def pair(values) -> tuple[float, float]:
        x, y = np.asarray(values, np.float64)
        return rounded(x), rounded(y)

    centers = np.asarray(imager.array.centers, np.float64)
    tilt = (0.0, 0.0) if imager.tilt is None else np.degrees(np.arctan(imager.tilt))
    pose = {
        "rotation_deg": rounded(np.degrees(imager.rotation)),
        "shift_mm": pair(imager.shift),
        "tilt_deg": pair(tilt),
    }
    numbers = {"centers_mm": np.array([pair(center) for center in centers]), **_lens_lists(imager.array)}
    distance = {"sensor_distance_mm": rounded(imager.sensor_distance)}
    record: dict[str, Any] = {
        **(provenance or {}),
        "calibrated_rms_pixels": round(result.rms, 4),
        "calibrated_spots": len(result.residuals),
        "calibrated_captures": len(np.unique(result.sources.captures[result.spots.sources])),
        "calibrated_in": format_medium(imager),
        "mirrored": result.mirrored,
        "calibrated_values": {name: rounded(value) for name, value in result.values.items()},
        "standard_deviations": {name: float(f"{sd:.3g}") for name, sd in result.deviations.items()},
    }
    tables = {"array": {"centers_mm": numbers["centers_mm"]}, "imaging": distance, "calibration": pose}
    placed = {name: getattr(design, name).model_copy(update=values) for name, values in tables.items()}
    away, radius = reach(design.model_copy(update=placed))
    if design.sensor.origin_mm is None and (away > radius).any():
        numbers = {key: values[away <= radius] for key, values in numbers.items()}
        record["lenses_beside_the_sensor"] = int((away > radius).sum())
    # The plate may be larger than designed, or lenses found beyond it.
    size = pair(np.maximum(design.array.size_mm, 2 * np.abs(centers).max(0) * (1 + 1e-9)))
    with errors_name_file("calibrated design"):
        return design.replace(**numbers, **distance, **pose, size_mm=size, provenance={**design.provenance, **record})


def with_sample(design: Design, imager: Imager, name: str | None) -> Design:
    """The design with the sample of an imager as `[sample]`, or as the one of `[samples]` with this name.

    What is named in the design, materials and layers, keeps its name where it has the same numbers. A fit of the
    surface may have made the device's layers behind the gap of air the sample's, with which they move.
    """
    sample, wavelength = imager.sample, 1e6 * float(imager.wavelength)
    before = default_sample(design) if name is None else sample_table(design, name)
    assert sample is not None
    table = sample_tables(sample)
    if np.isclose(index_of(before.refractive_index, wavelength), float(sample.refractive_index), rtol=1e-6):
        table["refractive_index"] = before.refractive_index
    first, second = layers_of(before.layers[::-1], wavelength), sample.layers
    if first is not None and second is not None and len(first.thickness) == len(second.thickness):
        if np.allclose(np.array(first.slabs), np.array(second.slabs), rtol=1e-6):
            table["layers"] = before.model_dump()["layers"]
    kept = design.layers.object[: 0 if imager.filters is None else len(imager.filters.thickness)]
    layers = design.layers.model_copy(update={"object": kept})
    if name in design.samples:
        return design.replace(layers=layers, samples={**design.samples, name: table})
    return design.replace(layers=layers, sample=table)


def _lens_lists(array: MicrolensArray) -> dict[str, np.ndarray]:
    """Keys of `[lens]` with a number for each lens, by the fewest decimals that give the array's numbers."""
    own = [(key, name) for key, name in zip(LENS_KEYS, EACH, strict=True) if getattr(array, name).ndim]
    return {key: np.array([float(str(value)) for value in np.asarray(array.of_lenses(name))]) for key, name in own}


def summary_table(design: Design, result: Calibration, start: Imager) -> Table:
    """Designed and calibrated values, with standard errors; `start` is the imager that the calibration was given."""
    table = Table("", "design", "found", "SD", box=None, pad_edge=False)
    pose = design.calibration
    before = {"sensor_distance_mm": design.imaging.sensor_distance_mm, "rotation_deg": pose.rotation_deg}
    before |= zip(("shift_x_mm", "shift_y_mm"), pose.shift_mm, strict=True)
    before |= zip(("tilt_x_deg", "tilt_y_deg"), pose.tilt_deg, strict=True)
    before |= {"scale": 1.0, "depth_offset_mm": 0.0}
    if start.sample is not None:
        before |= {"sample_at_mm": float(start.sample_surface)}
        before |= {"sample_index": float(start.sample.refractive_index)}
    for name, value in result.values.items():
        table.add_row(name, f"{before[name]:.6g}", f"{value:.6g}", f"{result.deviations[name]:.2g}")
    return table


def pattern_scales(result: Calibration) -> Float64[np.ndarray, "source 3"]:
    """Depth, mm, and scale `s_z` of the lenses' pattern (Eq. 1), observed and fitted, of each source.

    Sources with fewer than four spots are left out. Predicted aberrations are subtracted.
    """
    centers, rows = np.asarray(result.imager.centers, np.float64), []
    for source in np.unique(result.spots.sources):
        mine = result.spots.sources == source
        beside = centers[result.spots.lenses[mine]]
        beside = beside - beside.mean(0)
        if len(beside) >= 4:
            depth = float(result.sources.points[source, 2])
            fitted = float(result.imager.scale(depth))
            off = result.residuals[mine] * result.imager.sensor.pixel_pitch
            rows.append((depth, fitted - (beside * off).sum() / (beside**2).sum(), fitted))
    return np.array(rows, np.float64).reshape(-1, 3)


def _round_down(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(max(length, 1e-12)))
    return float(f"{max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)) * power:.1g}")


def plot_residuals(result: Calibration) -> Figure:
    """Residuals of all spots on the sensor, a histogram of their lengths, and the pattern's scale by depth."""
    figure = Figure(figsize=(14, 5), dpi=100, layout="constrained")
    arrows, counts, lines = figure.subplots(1, 3)
    _draw_arrows(arrows, result)
    distance = np.hypot(*result.residuals.T)
    counts.hist(distance, bins=30)
    counts.set(xlabel="length of the residual, pixels", ylabel="number of spots")
    counts.set_title(f"{len(distance)} spots, {result.rms:.3f} pixels RMS")
    depth, seen, fitted = pattern_scales(result).T
    inverse = 1 / np.asarray(result.imager.reduced_depth(depth))
    order = np.argsort(inverse)
    lines.plot(inverse[order], fitted[order], color="0.6", label="1 + v/z'")
    lines.plot(inverse, seen, ".", label="spots of a source")
    lines.set(xlabel="1 / reduced depth z', 1/mm", ylabel="scale of the lenses' pattern, s_z")
    lines.locator_params(axis="x", nbins=4)
    # Of a single depth no digits that rounding leaves.
    low, high = lines.get_ylim()
    lines.set_ylim(min(low, (low + high) / 2 - _LEAST_RANGE), max(high, (low + high) / 2 + _LEAST_RANGE))
    worst = float(np.abs(seen - fitted).max()) if len(seen) else 0.0
    lines.set_title(f"scale by depth (Eq. 1), off by up to {worst:.1e}")
    lines.legend(fontsize=9)
    return figure


def _draw_arrows(axes, result: Calibration) -> None:
    """Residuals on the sensor, in the colors of their captures."""
    sensor, longest = result.imager.sensor, max(float(np.hypot(*result.residuals.T).max()), 1e-12)
    numbers, index = np.unique(result.sources.captures[result.spots.sources], return_inverse=True)
    colors = colormaps["viridis"](np.linspace(0, _DARKEST, len(numbers)))
    drawn = axes.quiver(
        *result.spots.positions.T,
        *result.residuals.T,
        color=colors[index],
        angles="xy",
        scale_units="xy",
        scale=longest / (_LONGEST * max(sensor.shape) * sensor.pixel_pitch),
        width=_ARROW,
    )
    length = _round_down(longest)
    axes.quiverkey(drawn, 0.03, 1.04, length, f"{length:g} pixels", labelpos="E", color="k")
    axes.set(xlim=sensor.extent[:2], ylim=sensor.extent[2:], aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_title("predicted less observed spots, on the sensor", pad=22)
    if 1 < len(numbers) <= _MOST_NAMED:
        named = zip(numbers, colors, strict=True)
        handles = [Line2D([], [], color=color, label=f"capture {number + 1}") for number, color in named]
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
