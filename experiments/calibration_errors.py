"""Residuals that a fit of sensor distance, rotation and shift leaves if something else is wrong.

Uses only the chief rays of the built-in design, without images: lenses within 6 mm of a source at the four positions
of `design/LAB.md`.

    python -m experiments.calibration_errors [--out DIR]

Writes `calibration_errors.json` and `calibration_errors.md`; takes a second.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from experiments.common import Report, main, table
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.design.start import geomscope
from gs_jax.geometry import chief_ray

PLACES = np.array([[0.0, 0.0, 18.0], [0.0, 0.0, 20.5], [3.0, 0.0, 20.5], [0.0, 0.0, 23.0]])
REACH = 6.0


class Device(NamedTuple):
    """Geometry that determines the spots of point sources, mm; the tilt is about y, in radians."""

    centers: np.ndarray
    places: np.ndarray
    plate: float
    tilt: float = 0.0


def spots(device: Device, seen: np.ndarray, distance: float, rotation: float, *shift: float) -> np.ndarray:
    """Spots `(source, lens)` of the lenses `seen`, with the fitted geometry."""
    cos, sin = np.cos(rotation), np.sin(rotation)
    centers = device.centers @ np.array([[cos, sin], [-sin, cos]]) + shift
    v = distance + centers[:, :1] * np.tan(device.tilt)
    ends = [chief_ray(centers, place[:2], v / (place[2] + device.plate)) for place in device.places]
    return np.concatenate([end[lenses] for end, lenses in zip(ends, seen, strict=True)])


def moved(which: int | slice, axis: int, by: float) -> np.ndarray:
    """Source positions, some of them displaced along x, y or z, mm."""
    places = PLACES.copy()
    places[which, axis] += by
    return places


def run() -> list[tuple[str, float, float]]:
    """Return for each mistake its name, the residual in pixels RMS, and the error of the sensor distance in um."""
    design = geomscope()
    v, pixel = design.imaging.sensor_distance_mm, design.sensor.pixel_pitch_um / 1000
    plate = design.array.substrate_thickness_mm / design.refractive_index
    believed = Device(np.array(design.array.centers_mm), PLACES, plate)
    seen = np.hypot(*(believed.centers[None] - PLACES[:, None, :2]).transpose(2, 0, 1)) < REACH
    rng = np.random.default_rng(0)
    mistakes = {
        "nothing": believed,
        "one depth, 50 um": believed._replace(places=moved(0, 2, 0.05)),
        "all depths, 200 um": believed._replace(places=moved(slice(None), 2, 0.2)),
        "one place, 20 um sideways": believed._replace(places=moved(2, 0, 0.02)),
        "thickness, a fifth": believed._replace(plate=1.2 * plate),
        "tilt, 0.1 degrees": believed._replace(tilt=np.radians(0.1)),
        "tilt, 0.5 degrees": believed._replace(tilt=np.radians(0.5)),
        "each centre, 1 um": believed._replace(centers=rng.normal(believed.centers, 0.001)),
        "each centre, 3 um": believed._replace(centers=rng.normal(believed.centers, 0.003)),
        "all centres, 0.2 %": believed._replace(centers=1.002 * believed.centers),
        "two captures swapped": believed._replace(places=PLACES[[3, 1, 2, 0]]),
    }
    rows = []
    for name, device in mistakes.items():
        true = spots(device, seen, v, 0.0, 0.0, 0.0)
        fit = least_squares(lambda x, true=true: (spots(believed, seen, *x) - true).ravel() / pixel, [v, 0, 0, 0])
        rms = np.sqrt((fit.fun.reshape(-1, 2) ** 2).sum(1).mean())
        rows.append((name, float(rms), float(1000 * (fit.x[0] - v))))
    return rows


def report(progress: Progress) -> Report:
    head = ("what is wrong", "pixels RMS", "sensor distance, off by um")
    with progress.step("Fitting"):
        rows = run()
    shown = [(name, f"{rms:.2g}", f"{off:.2g}") for name, rms, off in rows]
    records = [dict(zip(("mistake", "rms_pixels", "sensor_distance_um"), row, strict=True)) for row in rows]
    files = {"calibration_errors.json": records, "calibration_errors.md": markdown_table(head, shown)}
    return Report(files, [table(head, shown)])


if __name__ == "__main__":
    main(report)
