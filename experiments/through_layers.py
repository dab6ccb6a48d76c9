"""Ray-traced captures through a filter, a window and a cover slip into a gel, with the layers and without.

Another group's tracer made the captures with the authors' lenses: the gel (PDMS) begins at 19.67 mm and holds 100
points, or three planes of words. The geometry is the device's own; "layers ignored" is the same in air, focused where
the layers focus it. Columns are as in `experiments/true_image.py` and `experiments/fig9_benchmark.py`: the model's
image, binned by 4, against the capture; points that `find_points` detects; PSNR of the words above an empty volume, on
planes 0.8 mm apart: 0.56 mm of reduced depth, as planes 0.5 mm apart are in `experiments/fig9_benchmark.py`.

    python -m experiments.through_layers DATA [--out DIR] [--methods richardson-lucy,unrolled]

DATA holds `L_points.tif`, `L_words.tif`, their truth, `*.json`, and, in `../../geomscope`, the lens centres. Writes
`layers.json` and `layers.md`; about fifteen minutes on two cores.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np

from experiments.common import Report, main, table
from experiments.true_image import BLACK, GAIN, scores, strokes
from gs_jax import (
    Grid,
    Imager,
    Layers,
    MicrolensArray,
    Sample,
    Sensor,
    find_points,
    forward,
    localization,
    make_psf_model,
    quality,
    rasterize,
    read_capture,
    reconstruct,
)
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.projection.point_sources import full_image_of_points
from gs_jax.reconstruction.methods import METHODS
from gs_jax.reconstruction.pipeline import PIXELS_PER_VOXEL, voxel_grid

# Fine voxels of the strokes, mm; planes of a reconstruction from word to word; steps of iterative methods.
_FINE, _PLANES, STEPS = 0.012, 2, 20


def scope_of(data: Path, truth: dict) -> Imager:
    """The device of a capture, with the layers and the sample that its truth lists."""
    device, layers = truth["device"], truth["layers"]
    centers = np.loadtxt(data / "../../geomscope/centers.csv", delimiter=",", skiprows=1)
    array = MicrolensArray(
        centers,
        radius_of_curvature=device["R"],
        refractive_index=device["n"],
        aperture_diameter=2 * device["a"],
        substrate_thickness=device["t"],
        size=(20.0, 20.0),
    )
    sensor = Sensor((device["N"], device["N"]), device["px"])
    scope = Imager(array, sensor, device["v"], 3.0)
    (filter_layer, _, cover) = layers["obj"]
    return dataclasses.replace(
        scope,
        filters=Layers(*np.transpose([filter_layer])),
        windows=Layers(*np.transpose(layers["img"])),
        sample=Sample(layers["medium"], truth["sample_begins_mm"], Layers(*np.transpose([cover]))),
    )


def without_layers(scope: Imager) -> Imager:
    """The device in air, its sensor where the windows make it appear."""
    distance = scope.reduced_sensor_distance - scope.array.reduced_thickness_back
    return dataclasses.replace(scope, sensor_distance=distance, filters=None, windows=None, sample=None)


def on_points(data: Path, progress: Progress) -> dict:
    """Detections with the layers and without, and the model's image."""
    truth = json.loads((data / "L_points.json").read_text())
    points, scope = np.array(truth["points_mm"]), scope_of(data, truth)
    image = read_capture(data / "L_points.tif", scope.sensor.shape)
    results = {}
    for name, each, near in (("with layers", scope, 19.8), ("layers ignored", without_layers(scope), 16.0)):
        grid = Grid.over(each.sensor, depths=np.linspace(near, 24.1, 9), pitch=0.04)
        found = find_points(image, each, grid, progress=progress)
        beside = np.hypot(*(found[:, None, :2] - points[None, :, :2]).transpose(2, 0, 1))
        off = found[:, 2] - points[beside.argmin(1), 2]
        score = localization(found, points)
        results[name] = {
            "points": len(found),
            "f1": score.f1,
            "lateral_rmse_um": 1000 * float(np.sqrt((beside.min(1) ** 2).mean())),
            "axial_rmse_um": 1000 * float(np.sqrt((off**2).mean())),
            "axial_bias_um": 1000 * float(off.mean()),
        }
    light = full_image_of_points(points, scope, progress)
    return results | {"model": scores(light, electrons(image))}


def on_words(data: Path, methods: list[str], progress: Progress) -> dict:
    """The model's image of the words, and the volumes of some methods."""
    truth = json.loads((data / "L_words.json").read_text())
    scope = scope_of(data, truth)
    image = read_capture(data / "L_words.tif", scope.sensor.shape)
    emitters = np.concatenate([strokes(plane) for plane in truth["planes"]])
    z = np.unique(emitters[:, 2])
    count = 2 * int(np.ceil(np.abs(emitters[:, :2]).max() / _FINE + 1)) + 1
    fine = Grid(z, (count, count), _FINE)
    results = {}
    for name, each in (("with layers", scope), ("layers ignored", without_layers(scope))):
        model = forward(rasterize(emitters, fine), each, fine, make_psf_model(each, z, progress=progress))
        results[name] = {"model": scores(np.asarray(model), electrons(image))}
        depths = np.interp(np.arange(_PLANES * (len(z) - 1) + 1) / _PLANES, np.arange(len(z)), z)
        grid = voxel_grid(each, depths.tolist(), pixels=PIXELS_PER_VOXEL)
        target = np.asarray(rasterize(emitters, grid), np.float32)
        empty = quality(np.zeros_like(target), target).psnr_db
        for method in methods:
            volume = reconstruct(image, each, grid, METHODS[method](STEPS), progress=progress)
            results[name][method] = quality(volume, target).psnr_db - empty
    return results


def electrons(image: np.ndarray) -> np.ndarray:
    return GAIN * (image.astype(np.float64) - BLACK)


def report(data: Path, methods: str, progress: Progress) -> Report:
    points, words = on_points(data, progress), on_words(data, methods.split(","), progress)
    cases = ("with layers", "layers ignored")
    columns = ("", *cases)
    row = lambda label, values: [label, *values]
    rows = [
        row("points found, of 100", [str(points[case]["points"]) for case in cases]),
        row("F1", [f"{points[case]['f1']:.2f}" for case in cases]),
        row("lateral RMS, um", [f"{points[case]['lateral_rmse_um']:.1f}" for case in cases]),
        row("axial RMS, um", [f"{points[case]['axial_rmse_um']:.0f}" for case in cases]),
        row("axial bias, um", [f"{points[case]['axial_bias_um']:.0f}" for case in cases]),
        row("words, model: correlation, binned 4", [f"{_model(words, case, 'bin_4'):.3f}" for case in cases]),
        row("words, model: light", [f"{words[case]['model']['light']:.3f}" for case in cases]),
        *(row(f"words, {m}: dB above empty", [f"{words[c][m]:.1f}" for c in cases]) for m in methods.split(",")),
    ]
    text = "# Captures through layers\n\n" + markdown_table(columns, rows) + "\n"
    return Report({"layers.json": {"points": points, "words": words}, "layers.md": text}, [table(columns, rows)])


def _model(words: dict, case: str, binned: str) -> float:
    return words[case]["model"][binned]["correlation"]


if __name__ == "__main__":
    main(report, {"data": {"type": Path}, "--methods": {"default": "backproject,richardson-lucy,unrolled"}})
