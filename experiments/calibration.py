"""Calibration with ray-traced captures of single points, and with simulated random devices.

- Ray-traced captures of 15 points: fits with the default and with all parameters, and prediction errors at a depth that
  a fit did not use; `find_points` on 120 points with the calibrated and the nominal design; calibration from their
  capture alone, with a design that is rotated.
- Random devices, simulated with all light and noise; deviations are in standard deviations of the calibration.
- Mistakes: the residuals that a fit of sensor distance, rotation and shift leaves if something else is wrong, by the
  chief rays of the built-in design and sources at the four positions of `design/LAB.md`.

    python -m experiments.calibration [DATA] [--devices N] [--out DIR]

DATA holds `P1.toml` and `P1_i_*.tif`; without it its captures are left out. Writes `calibration.json`,
`calibration.md` and `calibration.png`; about half an hour on two cores.
"""

import json
import time
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, main, points_of, table
from gs_jax.apps.benchmark import markdown_table
from gs_jax.calibration.calibrated_design import plot_residuals
from gs_jax.calibration.fit import Calibration, self_calibrate, spot_residuals
from gs_jax.calibration.spot_model import OF_DEVICE
from gs_jax.microscope.geometry import chief_ray
from gs_jax.projection.point_sources import full_image_of_points
from gs_jax.reconstruction.pipeline import voxel_grid

NAMES = ("sensor_distance_mm", "rotation_deg", "shift_x_mm", "shift_y_mm", "tilt_x_deg", "tilt_y_deg")
DEPTHS = (18.0, 20.0, 22.0)
# A random device: lenses on a plate, in mm, and a sensor that sees about a third of them.
LENSES, PLATE, PIXELS, PIXEL, FIELD = 60, 11.0, 1536, 0.006, 2.5
# Rotation of the design in the calibration from a scene, and depths of the scene, mm.
TURN, SCENE = np.radians(2.0), [17.5, 22.5]
# Sources of the laboratory guide, and the distance from one within which lenses count, where something else is wrong;
# mm.
SOURCES = np.array([[0.0, 0.0, 18.0], [0.0, 0.0, 20.5], [3.0, 0.0, 20.5], [0.0, 0.0, 23.0]])
REACH = 6.0


def on_captures(data: Path, progress: gs.Progress) -> tuple[dict, Calibration]:
    """Calibrate from the ray-traced captures, whose geometry is known."""
    imager = gs.read_design(data / "P1.toml").imager()
    names = sorted(path.stem.removeprefix("P1_") for path in data.glob("P1_i_*.tif"))
    points = np.array([points_of(data, name)[0, :3] for name in names])
    images = [gs.read_capture(data / f"P1_{name}.tif", imager.sensor.shape) for name in names]
    begun = time.monotonic()
    whole = gs.calibrate(images, points, imager, progress=progress)
    seconds = time.monotonic() - begun
    every = gs.calibrate(images, points, imager, fit=OF_DEVICE, progress=progress)
    held_out = {}
    for depth in DEPTHS:
        others, these = np.flatnonzero(points[:, 2] != depth), np.flatnonzero(points[:, 2] == depth)
        fitted = gs.calibrate([images[k] for k in others], points[others], imager, progress=progress)
        away = spot_residuals(fitted, [images[k] for k in these], points[these])
        held_out[f"{depth:g} mm"] = float(np.sqrt((away**2).sum(1).mean()))
    scene, truth = gs.read_capture(data / "P1_d.tif", imager.sensor.shape), points_of(data, "d")
    scores = {}
    for name, geometry in (("calibrated", whole.imager), ("design", imager)):
        results = gs.find_points(scene, geometry, voxel_grid(geometry, SCENE), progress=progress)
        score = gs.localization(results, truth, axial=0.6)
        scores[name] = {"f1": score.f1, "axial_um": 1000 * score.axial_rmse}
    turned = eqx.tree_at(lambda i: i.rotation, imager, imager.rotation + TURN)
    alone = self_calibrate(scene, turned, voxel_grid(turned, SCENE), progress=progress)
    return {
        **_numbers(whole),
        "seconds": seconds,
        "everything_fitted": _numbers(every),
        "held_out_rms_pixels": held_out,
        "points": scores,
        "from_scene": _numbers(alone),
    }, whole


def _numbers(results: Calibration) -> dict:
    return {
        "values": results.values,
        "deviations": results.deviations,
        "rms_pixels": results.rms,
        "spots": len(results.residuals),
        "sources": len(results.sources.points),
    }


def device(seed: int) -> tuple[gs.Imager, gs.Imager, bool]:
    """Return a random true device, its nominal design, and whether it is mirrored."""
    rng = np.random.default_rng(seed)
    centers = np.asarray(gs.random_layout(LENSES, (PLATE, PLATE), diameter=None, seed=seed))
    sensor, mirrored = gs.Sensor((PIXELS, PIXELS), PIXEL), bool(rng.random() < 0.5)
    design = gs.Imager(gs.MicrolensArray(centers), sensor, rng.uniform(5.7, 5.9), FIELD)
    built = gs.MicrolensArray(centers * (1, -1) if mirrored else centers)
    rotation, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-2, 2, 2)
    tilt = np.tan(np.radians(rng.uniform(-1, 1, 2)))
    actual = gs.Imager(built, sensor, design.sensor_distance, FIELD, rotation=rotation, shift=shift, tilt=tilt)
    wrong = design.sensor_distance * rng.uniform(0.8, 1.2)
    return actual, eqx.tree_at(lambda i: i.sensor_distance, design, jnp.asarray(wrong)), mirrored


def true_values(imager: gs.Imager) -> dict[str, float]:
    """True values of the calibrated parameters."""
    assert imager.tilt is not None
    numbers = (imager.sensor_distance, np.degrees(imager.rotation), *imager.shift, *np.degrees(np.arctan(imager.tilt)))
    return dict(zip(NAMES, map(float, numbers), strict=True))


def on_device(seed: int, progress: gs.Progress) -> dict:
    """Calibrate a simulated device; return the deviations in their units and in standard deviations."""
    actual, design, mirrored = device(seed)
    rng = np.random.default_rng([seed, 1])
    points = np.column_stack([rng.uniform(-1.5, 1.5, (len(DEPTHS), 2)), DEPTHS])
    images = []
    for number, point in enumerate(points):
        light = full_image_of_points(np.append(point, 1.0)[None], actual, progress)
        key = jax.random.key(1000 * seed + number)
        images.append(np.asarray(gs.expose(light, gs.Camera(gain=1.0), key, peak_electrons=5000)))
    results = gs.calibrate(images, points, design, progress=progress)
    true = true_values(actual)
    off = {name: value - true[name] for name, value in results.values.items()}
    off["rotation_deg"] = (off["rotation_deg"] + 180) % 360 - 180
    in_sd = {name: off[name] / results.deviations[name] for name in NAMES}
    return {"mirrored": results.mirrored == mirrored, "off": off, "in_sd": in_sd, "rms_pixels": results.rms}


class Spots(NamedTuple):
    """Geometry that determines the spots of point sources, mm; the tilt is about y, in radians."""

    centers: np.ndarray
    places: np.ndarray
    plate: float
    tilt: float = 0.0


def spots_of(device: Spots, seen: np.ndarray, distance: float, rotation: float, *shift: float) -> np.ndarray:
    """Spots `(source, lens)` of the lenses `seen`, with the fitted geometry."""
    cos, sin = np.cos(rotation), np.sin(rotation)
    centers = device.centers @ np.array([[cos, sin], [-sin, cos]]) + shift
    v = distance + centers[:, :1] * np.tan(device.tilt)
    ends = [chief_ray(centers, source[:2], v / (source[2] + device.plate)) for source in device.places]
    return np.concatenate([end[lenses] for end, lenses in zip(ends, seen, strict=True)])


def moved(which: int | slice, axis: int, by: float) -> np.ndarray:
    """Source positions, some of them displaced along x, y or z, mm."""
    sources = SOURCES.copy()
    sources[which, axis] += by
    return sources


def mistakes() -> list[tuple[str, float, float]]:
    """Return for each mistake its name, the residual in pixels RMS, and the error of the sensor distance in um."""
    design = gs.geomscope()
    v, pixel = design.imaging.sensor_distance_mm, design.sensor.pixel_pitch_um / 1000
    plate = design.array.substrate_thickness_mm / design.refractive_index
    believed = Spots(np.array(design.array.centers_mm), SOURCES, plate)
    seen = np.hypot(*(believed.centers[None] - SOURCES[:, None, :2]).transpose(2, 0, 1)) < REACH
    rng = np.random.default_rng(0)
    wrong = {
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
        "two captures swapped": believed._replace(places=SOURCES[[3, 1, 2, 0]]),
    }
    rows = []
    for name, actual in wrong.items():
        true = spots_of(actual, seen, v, 0.0, 0.0, 0.0)
        fit = least_squares(lambda x, true=true: (spots_of(believed, seen, *x) - true).ravel() / pixel, [v, 0, 0, 0])
        rms = np.sqrt((fit.fun.reshape(-1, 2) ** 2).sum(1).mean())
        rows.append((name, float(rms), float(1000 * (fit.x[0] - v))))
    return rows


def run(data: Path | None, devices: int, *, progress: gs.Progress) -> tuple[dict, Calibration | None]:
    """Return the content of `calibration.json`, and the calibration from the captures."""
    captures, whole = on_captures(data, progress) if data else ({}, None)
    results = {seed: on_device(seed, progress) for seed in progress.track(range(devices), "Devices")}
    keys = ("mistake", "rms_pixels", "sensor_distance_um")
    wrong = [dict(zip(keys, row, strict=True)) for row in mistakes()]
    return {"captures": captures, "devices": results, "mistakes": wrong}, whole


def report(data: Path | None, devices: int, progress: gs.Progress) -> Report:
    results, whole = run(data, devices, progress=progress)
    columns = ("", "median deviation", "largest", "within 3 SD", "SD of the deviations, in SD")
    rows = []
    for name in NAMES if devices else ():
        off = np.abs([device["off"][name] for device in results["devices"].values()])
        in_sd = np.array([device["in_sd"][name] for device in results["devices"].values()])
        within = f"{np.mean(np.abs(in_sd) < 3):.0%}"
        rows.append([name, f"{np.median(off):.2g}", f"{off.max():.2g}", within, f"{in_sd.std():.2f}"])
    right = sum(device["mirrored"] for device in results["devices"].values())
    head = ("what is wrong", "pixels RMS", "sensor distance, off by um")
    wrong = [[name, f"{rms:.2g}", f"{off:.2g}"] for name, rms, off in map(dict.values, results["mistakes"])]
    text = f"# Calibration\n\n{markdown_table(columns, rows)}\n\nMirrored or not: {right} of {devices} right.\n\n"
    text += f"{markdown_table(head, wrong)}\n\n```\n{json.dumps(results['captures'], indent=2)}\n```\n"
    files: dict[str, dict | str | Figure] = {"calibration.json": results, "calibration.md": text}
    if whole:
        files["calibration.png"] = plot_residuals(whole)
    return Report(files, [table(columns, rows), table(head, wrong), text])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH, "--devices": {"type": int, "default": 50}})
