"""The pictures and the text of the demonstration."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ..designs.design import Design
from ..layouts.cells import nearest_neighbour_distances
from ..metrics import Localization, Quality


class Views(NamedTuple):
    """A capture, and of each volume the planes at some depths (mm), the truth's first."""

    image: np.ndarray
    depths: list[float]
    volumes: dict[str, np.ndarray]


def views_picture(views: Views, design: Design) -> Figure:
    """The capture and its middle; and beside them a row for each volume, a column for each depth."""
    count = len(views.depths)
    figure = Figure(figsize=(3.1 * (count + 1) + 0.8, 2.9 * len(views.volumes)), dpi=110, layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.25, count))
    _captures(halves[0].subplots(2, 1), views.image, design)
    size = [n * design.sensor.pixel_pitch_um / 2000 for n in design.sensor.shape]
    sensor = (-size[1], size[1], size[0], -size[0])
    axes = halves[1].subplots(len(views.volumes), count, sharex=True, sharey=True, squeeze=False)
    for row, (name, volume) in zip(axes, views.volumes.items(), strict=True):
        for axis, depth, plane in zip(row, views.depths, volume, strict=True):
            # Back-projection has a pedestal, which is not an object.
            low = np.percentile(plane, 50)
            axis.imshow(plane, cmap="magma", extent=sensor, vmin=low, vmax=max(np.percentile(plane, 99.9), low + 1e-9))
            axis.set_title(f"{name}, {depth:g} mm", fontsize=9)
        row[0].set_ylabel("y, mm")
    for axis in axes[-1]:
        axis.set_xlabel("x, mm")
    return figure


def _captures(axes, image: np.ndarray, design: Design) -> None:
    pitch = design.sensor.pixel_pitch_um / 1000
    half = [n * pitch / 2 for n in image.shape]
    step = max(1, image.shape[0] // 1024)
    whole = image[::step, ::step]
    zoom = image[tuple(slice(n // 2 - 400, n // 2 + 400) for n in image.shape)]
    for axis, part, (y, x), title in (
        (axes[0], whole, half, "capture"),
        (axes[1], zoom, 2 * [400 * pitch], "its middle"),
    ):
        axis.imshow(part, cmap="gray", extent=(-x, x, y, -y), vmax=np.percentile(part, 99.8))
        axis.set(title=title, xlabel="x, mm", ylabel="y, mm")


def points_picture(found: np.ndarray, truth: np.ndarray, score: Localization) -> Figure:
    """True and found points in the plane, and the errors of the pairs."""
    figure = Figure(figsize=(10, 4.4), dpi=110, layout="constrained")
    plane, errors = figure.subplots(1, 2)
    plane.scatter(truth[:, 0], truth[:, 1], s=60, facecolors="none", edgecolors="0.4", label="true")
    drawn = plane.scatter(found[:, 0], found[:, 1], s=12, c=found[:, 2], cmap="viridis", label="found")
    plane.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    plane.invert_yaxis()
    plane.legend(loc="upper left", bbox_to_anchor=(0, 1.12), ncols=2, frameon=False)
    figure.colorbar(drawn, ax=plane, label="z, mm")
    gap = found[score.pairs[:, 0], :3] - truth[score.pairs[:, 1], :3]
    errors.scatter(1000 * np.hypot(gap[:, 0], gap[:, 1]), 1000 * gap[:, 2], s=12)
    errors.axhline(0, color="0.7", lw=0.8)
    errors.set(xlabel="lateral error, um", ylabel="axial error, um", title=f"{len(gap)} of {len(truth)} points")
    return figure


def report_text(
    design: Design,
    sentences: list[str],
    targets: list[dict[str, Any]],
    scores: dict[str, Quality],
    points: Localization,
    part: dict[str, Any],
    seconds: dict[str, float],
) -> str:
    """The summary, in Markdown."""
    distances = nearest_neighbour_distances(np.array(design.array.centers_mm))
    marks = {True: "yes", False: "NO", None: ""}
    span = lambda ends: " to ".join(dict.fromkeys("inf" if x is None else f"{x:.3g}" for x in ends))
    aim = lambda t: f"{t['kind'].replace('_', ' ')} {t['target']:g} {t['unit']}".rstrip()
    wanted = "\n".join(
        f"| {t['meaning']} | {aim(t)} | {span(t['before'])} | {span(t['after'])} | {marks[t['met_after']]} |"
        for t in targets
    )
    volumes = "\n".join(f"| {name} | {q.psnr_db:.1f} | {q.ssim:.3f} | {q.mse:.3g} |" for name, q in scores.items())
    checks = "\n".join(f"- {check['text']}" for check in part["checks"])
    times = "\n".join(f"| {what} | {time:.1f} |" for what, time in seconds.items())
    said = "\n".join(f"- {sentence}" for sentence in sentences)
    return f"""# gs-jax demo

## 1. The design

A lensless microscope of {len(distances)} random microlenses, pitch {distances.mean():.2f} mm, SD
{distances.std():.2f} mm: `design.toml`. All its numbers are in `metrics.json`. What they say:

{said}

## 2. A better prescription

From the paper's Table 1 as printed (`printed.toml`, out of focus), the study `study.toml` looks for a design that meets
the paper's targets by the paper's formulas: `optimized.toml` (numbers in `.json`, layout and history in `.png`).

| what | wanted | before | after | met |
|---|---|---|---|---|
{wanted}

![Layout, cost and terms](optimized.png)

The formulas count neither aberrations nor light. The rest of this demonstration uses `design.toml`.

## 3. Three words at three depths

One capture (`words.tif`) of words at 18, 20 and 22 mm, simulated with diffraction and noise on a finer grid than the
voxels, reconstructed in three ways. `words.ome.tif` is the stack after background suppression, to scale in Fiji and
napari.

![Capture, truth and reconstructions](words.png)

| seven planes, 17 to 23 mm | PSNR, dB | SSIM | MSE |
|---|---:|---:|---:|
{volumes}

Each volume is first multiplied by the number that fits it best. In a scene that is mostly dark an empty volume scores
well; compare with the first row.

## 4. Points

`points.tif` shows points at random between 18 and 22 mm (`points-truth.csv`). Found
(`points-found.csv`): precision {points.precision:.3f}, recall {points.recall:.3f}, F1 {points.f1:.3f}; RMS error
{1000 * points.lateral_rmse:.1f} um laterally, {1000 * points.axial_rmse:.0f} um axially.

![True and found points](points.png)

## 5. The mold

`mold.stl`: {part["facets"]:,} facets, {part["file_bytes"] / 1e6:.1f} MB, in mm; its numbers are in `mold.json`.

![The mold](mold.png)

{checks}

## Time

| step | seconds |
|---|---:|
{times}

The captures come from the package's own optics (exact rays and diffraction of a lens on its axis, the same for all
lenses and fields): a demonstration, not a proof of quality. What was measured on captures of an independent ray tracer
is in the documentation of the experiments.
"""
