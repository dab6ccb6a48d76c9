"""Fig. 9 (B-D) on images that no model of ours rendered: does background suppression bring back-projection close?

`gs-jax benchmark` compares times and, on simulated particles, quality. Here every method reconstructs ray-traced
captures (exact refraction, aberrations, clipped lenses, noise), their pixels summed by 4 x 4: 120 points between 18
and 22 mm, and letters in three planes. The truth, and the points that a method finds, are as wide as the microscope
resolves (Eq. 5: a voxel); zeros are the floor. Every iterative method takes 30 steps; a step of ADMM holds ten of its
conjugate gradients, and its time is what it is. Points are the peaks of a volume, by the benchmark's one rule.

    python -m experiments.fig9_benchmark DATA [--out DIR]

DATA holds `P1.toml`, `P1_d.tif`, `P1_h.tif` and their truth. Writes `captures.json`, `captures.md` and `captures.png`;
about ten minutes on two cores.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32
from matplotlib.figure import Figure
from rich.console import Console
from scipy.ndimage import gaussian_filter

from gs_jax import Grid, Imager, Sensor
from gs_jax.aperture import clear_diameter
from gs_jax.benchmark import paper_clusters
from gs_jax.benchmark_report import table
from gs_jax.benchmark_scenes import FWHM, peaks, spots
from gs_jax.designs import read_design
from gs_jax.disk import make_folder, write_json, write_text
from gs_jax.errors import InputError
from gs_jax.files import read_capture
from gs_jax.locate import find_points
from gs_jax.measure import timed
from gs_jax.methods import reconstruct
from gs_jax.metrics import localization, quality
from gs_jax.phantoms import rasterize
from gs_jax.progress import Progress
from gs_jax.psf import geometric_psf
from gs_jax.unet import pretrained, suppress

BIN = 4
OFFSET = 16  # of the camera, counts
STEPS = {"list-rl": 30, "richardson-lucy": 30, "fista": 30, "admm": 30}
PSF_PIXELS = 21
DEPTHS = {"d": np.arange(17.6, 22.41, 0.6), "h": np.arange(18.0, 22.01, 1.0)}


class Scene(NamedTuple):
    image: Float32[np.ndarray, "row column"]
    imager: Imager
    grid: Grid
    truth: Float32[np.ndarray, "depth y x"]
    points: np.ndarray | None  # (x, y, z, flux), if the scene is points


def read(data: Path, name: str, factor: int = BIN) -> Scene:
    """A capture with `factor^2` pixels summed, a grid of one pixel's width in the object, and the truth on it."""
    design = read_design(data / "P1.toml").imager()
    counts = read_capture(data / f"P1_{name}.tif", design.sensor.shape).astype(np.float32) - OFFSET
    rows, columns = (n // factor for n in counts.shape)
    image = counts[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor).sum((1, 3))
    sensor = Sensor((rows, columns), design.sensor.pixel_pitch * factor)
    imager = eqx.tree_at(lambda i: i.sensor, design, sensor)
    pitch = sensor.pixel_pitch / float(imager.magnification(20.0))
    grid = Grid.over(sensor, depths=DEPTHS[name], pitch=pitch)
    imager, grid = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (imager, grid))
    if name == "d":
        points = np.array(json.loads((data / "d.json").read_text())["points_x_y_z_flux"])
        return Scene(image, imager, grid, spots(points, grid, pitch / FWHM), points)
    emitters = np.load(data / "h_emitters.npz")["emitters"]
    truth = np.asarray(rasterize(emitters, grid), np.float32)
    # The emitters stand 0.2 mm apart.
    return Scene(image, imager, grid, gaussian_filter(truth, (0, 0.1 / pitch, 0.1 / pitch)), None)


def methods(s: Scene, steps: dict[str, int], progress: Progress) -> dict[str, Callable[[], Any]]:
    """Every method, as a call without arguments."""
    radius = clear_diameter(s.imager.array) / 2
    psf = jnp.stack([geometric_psf(s.imager, z, size=PSF_PIXELS, radius=radius) for z in s.grid.depths])
    image = jnp.asarray(s.image)
    solve = lambda name: jax.block_until_ready(
        reconstruct(image, s.imager, s.grid, psf, method=name, steps=steps.get(name, 1))
    )

    volume = lambda points: spots(points, s.grid, float(s.grid.pitch) / FWHM)
    return {
        "zeros": lambda: np.zeros_like(s.truth),
        "backproject": lambda: solve("backproject"),
        "backproject + cluster": lambda: volume(find_points(s.image, s.imager, s.grid, progress=progress)),
        "backproject + paper's clusters": lambda: volume(paper_clusters(np.asarray(solve("backproject")), s.grid)),
        "backproject + unet": lambda: suppress(np.asarray(solve("backproject")), pretrained()),
    } | {name: (lambda name=name: solve(name)) for name in steps}


def run(
    data: Path, scenes: Sequence[str] = ("d", "h"), *, factor=BIN, steps: dict[str, int] = STEPS, progress: Progress
) -> tuple[dict, dict[str, np.ndarray]]:
    """What `captures.json` holds, and maxima over the depths by title."""
    rows, left_out, pictures = [], [], {}
    for name in scenes:
        s = read(data, name, factor)
        pictures[f"{name}: truth"] = s.truth.max(0)
        for method, call in progress.track(methods(s, steps, progress).items(), f"Scene {name}"):
            try:
                seconds, volume = timed(call)
            except InputError as error:  # weights that are not there
                left_out.append({"scene": name, "method": method, "reason": str(error)})
                continue
            volume = np.asarray(volume)
            q = quality(volume, s.truth)
            f1 = None
            if s.points is not None:
                f1 = localization(peaks(volume, s.grid), s.points, axial=0.6).f1
            scores = {"psnr_db": q.psnr_db, "ssim": q.ssim, "mse": q.mse, "f1": f1}
            rows.append({"scene": name, "method": method, "steps": steps.get(method), "seconds": seconds} | scores)
            pictures[f"{name}: {method}"] = volume.max(0)
    return {"rows": rows, "left_out": left_out}, pictures


def markdown(found: dict) -> str:
    head = ("scene", "method", "steps", "s, with compilation", "PSNR, dB", "SSIM", "MSE", "F1")
    pretty = lambda value, form: "-" if value is None else format(value, form)
    forms = {"steps": "d", "seconds": ".1f", "psnr_db": ".2f", "ssim": ".3f", "mse": ".2e", "f1": ".2f"}
    rows = [[r["scene"], r["method"], *(pretty(r[key], form) for key, form in forms.items())] for r in found["rows"]]
    return table(head, rows) + "\n"


def picture(pictures: dict[str, np.ndarray], half_mm: float) -> Figure:
    """Maxima over the depths, each up to its 99.9th percentile."""
    columns = 4
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(12, 3.1 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(pictures) :]:
        axis.set_axis_off()
    for axis, (title, image) in zip(axes.flat, pictures.items(), strict=False):
        top = np.percentile(image, 99.9)
        axis.imshow(image, cmap="magma", vmin=0, vmax=top or None, extent=(-half_mm, half_mm, half_mm, -half_mm))
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
    figure.supxlabel("x, mm", fontsize=9)
    figure.supylabel("y, mm", fontsize=9)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/fig9"))
    arguments = parser.parse_args()
    out = make_folder(arguments.out)
    with Progress() as progress:
        found, pictures = run(arguments.data, progress=progress)
    write_json(out / "captures.json", found)
    write_text(out / "captures.md", markdown(found), [".md"])
    picture(pictures, 5120 * 0.0045 / 2).savefig(out / "captures.png", dpi=80)
    Console().print(markdown(found))


if __name__ == "__main__":
    main()
