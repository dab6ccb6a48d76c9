"""Ray-traced captures through a filter, a window and a cover slip into a gel, with the layers and without.

Another group's tracer made the captures: three of single points in air calibrate the device, with the filter and the
window or with air in their place ("layers ignored"). Then nothing is fitted anew: with the layers, the gel and its
cover slip are added as they are; without them, the object is in air. Columns are as in `experiments/true_image.py` and
`experiments/fig9_benchmark.py`; words are on planes 0.8 mm apart, 0.56 mm of reduced depth.

    python -m experiments.through_layers DATA [--out DIR] [--methods richardson-lucy,unrolled]

DATA holds `L_cal_*.tif`, `L_points.tif`, `L_words.tif`, their truth, `*.json`, and, in `../../geomscope`, the lens
centres. Writes `layers.json` and `layers.md`; about fifteen minutes on two cores.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np

import gs_jax as gs
from experiments.common import Report, main, names_of, tables_report
from experiments.true_image import electrons, scores, words as emitters_of_words
from gs_jax.projection.point_sources import full_image_of_points
from gs_jax.reconstruction.pipeline import METHODS, PIXELS_PER_VOXEL, voxel_grid

# Fine voxels of the strokes, mm; planes of a reconstruction from word to word; steps of iterative methods.
_FINE, _PLANES, STEPS = 0.012, 2, 20
CASES = ("with layers", "layers ignored")


def scope_of(data: Path, truth: dict) -> gs.Imager:
    """The device of a capture, with the layers and the sample that its truth lists."""
    device, layers = truth["device"], truth["layers"]
    centers = np.loadtxt(data / "../../geomscope/centers.csv", delimiter=",", skiprows=1)
    array = gs.MicrolensArray(
        centers,
        radius_of_curvature=device["R"],
        refractive_index=device["n"],
        aperture_diameter=2 * device["a"],
        substrate_thickness=device["t"],
        size=(20.0, 20.0),
    )
    sensor = gs.Sensor((device["N"], device["N"]), device["px"])
    scope = gs.Imager(array, sensor, device["v"], 3.0)
    (filter_layer, _, cover) = layers["obj"]
    return dataclasses.replace(
        scope,
        filters=gs.Layers(*np.transpose([filter_layer])),
        windows=gs.Layers(*np.transpose(layers["img"])),
        sample=gs.Sample(layers["medium"], truth["sample_begins_mm"], gs.Layers(*np.transpose([cover]))),
    )


def calibrated(data: Path, progress: gs.Progress) -> tuple[dict[str, gs.Imager], dict]:
    """The device as three captures in air give it, with the layers and without; and what the two fits say."""
    in_air = sorted(data.glob("L_cal_*.json"))
    points = np.array([json.loads(path.read_text())["points_mm"][0][:3] for path in in_air])
    scope = scope_of(data, json.loads((data / "L_points.json").read_text()))
    images = [gs.read_capture(path.with_suffix(".tif"), scope.sensor.shape) for path in in_air]
    devices, results = {}, {}
    without = dataclasses.replace(scope, filters=None, windows=None, sample=None)
    for name, start, sample in ((CASES[0], scope, scope.sample), (CASES[1], without, None)):
        result = gs.calibrate(images, points, dataclasses.replace(start, sample=None), progress=progress)
        devices[name] = dataclasses.replace(result.imager, sample=sample)
        results[name] = {"rms_px": result.rms, "values": result.values, "deviations": result.deviations}
    return devices, results


def on_points(data: Path, devices: dict[str, gs.Imager], progress: gs.Progress) -> dict:
    """Detections by each device, and the image by the model of the first."""
    points = np.array(json.loads((data / "L_points.json").read_text())["points_mm"])
    scope = devices[CASES[0]]
    image = gs.read_capture(data / "L_points.tif", scope.sensor.shape)
    results = {}
    for (name, device), near in zip(devices.items(), (19.8, 16.0), strict=True):
        grid = gs.Grid.over(device.sensor, depths=np.linspace(near, 24.1, 9), pitch=0.04)
        found = gs.find_points(image, device, grid, progress=progress)
        beside = np.hypot(*(found[:, None, :2] - points[None, :, :2]).transpose(2, 0, 1))
        off = found[:, 2] - points[beside.argmin(1), 2]
        score = gs.localization(found, points)
        results[name] = {
            "points": len(found),
            "f1": score.f1,
            "lateral_rmse_um": 1000 * float(np.sqrt((beside.min(1) ** 2).mean())),
            "axial_rmse_um": 1000 * float(np.sqrt((off**2).mean())),
            "axial_bias_um": 1000 * float(off.mean()),
            "axial_spread_um": 1000 * float(off.std()),
        }
    light = full_image_of_points(points, scope, progress)
    return results | {"model": scores(light, electrons(image))}


def on_words(data: Path, devices: dict[str, gs.Imager], methods: list[str], progress: gs.Progress) -> dict:
    """Each device's image of the words, and the volumes of some methods."""
    image = gs.read_capture(data / "L_words.tif", devices[CASES[0]].sensor.shape)
    emitters = emitters_of_words(data / "L_words.json")
    z = np.unique(emitters[:, 2])
    count = 2 * int(np.ceil(np.abs(emitters[:, :2]).max() / _FINE + 1)) + 1
    fine = gs.Grid(z, (count, count), _FINE)
    results = {}
    for name, device in devices.items():
        model = gs.forward(gs.rasterize(emitters, fine), device, fine, gs.psf_model(device, fine, progress=progress))
        results[name] = {"model": scores(np.asarray(model), electrons(image))}
        depths = np.interp(np.arange(_PLANES * (len(z) - 1) + 1) / _PLANES, np.arange(len(z)), z)
        grid = voxel_grid(device, depths.tolist(), pixels=PIXELS_PER_VOXEL)
        target = np.asarray(gs.rasterize(emitters, grid), np.float32)
        empty = gs.quality(np.zeros_like(target), target).psnr_db
        for method in methods:
            volume = gs.reconstruct(image, device, grid, METHODS[method](STEPS), progress=progress)
            results[name][method] = gs.quality(volume, target).psnr_db - empty
    return results


def report(data: Path, methods: list[str], progress: gs.Progress) -> Report:
    devices, fits = calibrated(data, progress)
    points = on_points(data, devices, progress)
    words = on_words(data, devices, methods, progress)
    cases, columns = CASES, ("", *CASES)
    row = lambda label, values: [label, *values]
    with_error = lambda fit, name: f"{fit['values'][name]:.4f} +- {fit['deviations'][name]:.4f}"
    rows = [
        row("calibration in air: residual, pixels RMS", [f"{fits[case]['rms_px']:.3f}" for case in cases]),
        *(row(name, [with_error(fits[case], name) for case in cases]) for name in fits[CASES[0]]["values"]),
        row("points found, of 100", [str(points[case]["points"]) for case in cases]),
        row("F1", [f"{points[case]['f1']:.2f}" for case in cases]),
        row("lateral RMS, um", [f"{points[case]['lateral_rmse_um']:.1f}" for case in cases]),
        row("axial RMS, um", [f"{points[case]['axial_rmse_um']:.0f}" for case in cases]),
        row("axial bias, um", [f"{points[case]['axial_bias_um']:.0f}" for case in cases]),
        row("axial spread about the bias, um", [f"{points[case]['axial_spread_um']:.0f}" for case in cases]),
        row(
            "words, model: correlation, binned 4",
            [f"{words[case]['model']['bin_4']['correlation']:.3f}" for case in cases],
        ),
        row("words, model: light", [f"{words[case]['model']['light']:.3f}" for case in cases]),
        *(row(f"words, {m}: dB above empty", [f"{words[c][m]:.1f}" for c in cases]) for m in methods),
    ]
    numbers = {"calibration": fits, "points": points, "words": words}
    return tables_report("layers", numbers, (columns, rows), title="Captures through layers")


if __name__ == "__main__":
    methods = {"type": names_of(METHODS), "default": ["backproject", "richardson-lucy", "unrolled"]}
    main(report, {"data": {"type": Path}, "--methods": methods})
