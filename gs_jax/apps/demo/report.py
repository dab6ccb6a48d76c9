"""The pictures and the text of the demonstration."""

from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ...design.design import Design
from ...geometry import Sensor
from ...layouts.cells import nearest_neighbour_distances
from ...metrics import Localization, Quality

# What the page says of its parts.
NOTES = {
    "page": "What gs-jax demo made, on captures that it simulated; report.md has the scores, the optimised design and "
    "the times.",
    "capture": "words.tif: three words at 18, 20 and 22 mm, simulated with noise.",
    "volume": "words.ome.tif: back-projection, then the network that suppresses the background.",
    "points": "points-found.csv: found in points.tif, another capture.",
}


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
    sensor = design.imager().sensor
    _captures(halves[0].subplots(2, 1), views.image, sensor)
    axes = halves[1].subplots(len(views.volumes), count, sharex=True, sharey=True, squeeze=False)
    for row, (name, volume) in zip(axes, views.volumes.items(), strict=True):
        for axis, depth, plane in zip(row, views.depths, volume, strict=True):
            # Back-projection has a pedestal, which is not an object.
            low = np.percentile(plane, 50)
            axis.imshow(
                plane, cmap="magma", extent=sensor.extent, vmin=low, vmax=max(np.percentile(plane, 99.9), low + 1e-9)
            )
            axis.set_title(f"{name}, {depth:g} mm", fontsize=9)
        row[0].set_ylabel("y, mm")
    for axis in axes[-1]:
        axis.set_xlabel("x, mm")
    return figure


def _captures(axes, image: np.ndarray, sensor: Sensor) -> None:
    step = max(1, image.shape[0] // 1024)
    zoom = image[tuple(slice(n // 2 - 400, n // 2 + 400) for n in image.shape)]
    middle = Sensor(zoom.shape, sensor.pixel_pitch)
    shown = ((image[::step, ::step], sensor, "capture"), (zoom, middle, "its middle"))
    for axis, (part, seen, title) in zip(axes, shown, strict=True):
        axis.imshow(part, cmap="gray", extent=seen.extent, vmax=np.percentile(part, 99.8))
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
    rows = lambda cells: "\n".join(f"| {' | '.join(row)} |" for row in cells)
    return template("report.md").format(
        lenses=len(distances),
        pitch=distances.mean(),
        pitch_sd=distances.std(),
        points=points,
        lateral_um=1000 * points.lateral_rmse,
        axial_um=1000 * points.axial_rmse,
        part=part,
        megabytes=part["file_bytes"] / 1e6,
        said="\n".join(f"- {sentence}" for sentence in sentences),
        checks="\n".join(f"- {check['text']}" for check in part["checks"]),
        wanted=rows(
            [t["meaning"], aim(t), span(t["before"]), span(t["after"]), marks[t["met_after"]]] for t in targets
        ),
        volumes=rows([name, f"{q.psnr_db:.1f}", f"{q.ssim:.3f}", f"{q.mse:.3g}"] for name, q in scores.items()),
        times=rows([what, f"{time:.1f}"] for what, time in seconds.items()),
    )


def template(name: str) -> str:
    """The text of a file that lies beside this one."""
    return (resources.files("gs_jax") / "apps" / "demo" / name).read_text("utf-8")
