"""Effect of the solvers' defaults on three words of a ray-traced capture.

- Three planes, 30 plain steps of Richardson-Lucy: the full model alone.
- Background: the capture as it is, and with a wide glow that no voxel emits, by list-RL with and without the fitted
  background.
- Edges: the near model, whose light is a sixth of the capture's, with and without damping of rarely seen voxels.
- Unrolled: with and without its conjugate gradients.

    python -m experiments.solver_options DATA [--out DIR]

DATA holds `P1.toml`, `P1_h.tif` and `h.json`. Writes `options.json` and `options.md`; about twenty minutes on two
cores.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments.common import Report, main, table
from experiments.fig9_benchmark import SCENES, Scene
from gs_jax import PinholeRichardsonLucy, RichardsonLucy, Unrolled, quality, reconstruct
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import METHODS, Method

STEPS = 20
# Glow: standard deviation relative to the sensor's width, and peak relative to the capture's mean above its offset.
_WIDE, _BRIGHT = 0.25, 2.0
_MIDDLE = (0.2, 0.7)


def glow(image: np.ndarray) -> np.ndarray:
    """A Gaussian over the sensor, in the unit of the capture."""
    rows, columns = (
        np.exp(-((np.linspace(0, 1, n) - m) ** 2) / (2 * _WIDE**2)) for n, m in zip(image.shape, _MIDDLE, strict=True)
    )
    return _BRIGHT * float(image.mean() - np.percentile(image, 1)) * np.outer(rows, columns)


def cases(s: Scene) -> dict[str, tuple[Scene, Method, str]]:
    """Scene, method and optics of each case, by name."""
    planes = s.truth.any((1, 2))
    few = s._replace(grid=s.grid.at(np.asarray(s.grid.depths)[planes]), truth=s.truth[planes])
    bright = s._replace(image=s.image + glow(s.image).astype(np.float32))
    results: dict[str, tuple[Scene, Method, str]] = {
        "three planes, Richardson-Lucy, 30 plain steps": (few, RichardsonLucy(steps=30), "full")
    }
    default: PinholeRichardsonLucy = METHODS["list-rl"](25)  # pyright: ignore[reportAssignmentType]
    for name, scene in (("as it is", s), ("under a glow", bright)):
        results[f"{name}, list-RL, 25 steps"] = scene, default, "full"
        results[f"{name}, list-RL, 25 steps, no fitted background"] = (
            scene,
            dataclasses.replace(default, background_knots=0),
            "full",
        )
    for name in ("list-rl", "richardson-lucy"):
        method = METHODS[name](STEPS)
        results[f"near, {name}"] = s, method, "near"
        results[f"near, {name}, rims not held back"] = s, dataclasses.replace(method, min_sensitivity=0.0), "near"  # pyright: ignore[reportArgumentType]
    networks = Unrolled.pretrained()
    results["unrolled"] = s, networks, "full"
    without = dataclasses.replace(networks, last=0, steps=networks.steps - networks.last)
    results["unrolled, no conjugate gradients"] = s, without, "full"
    return results


def run(s: Scene, *, progress: Progress) -> dict:
    """Return by name the PSNR and that of an empty volume, dB, and how many lenses see the brightest voxel."""
    results = {}
    for name, (each, method, optics) in progress.track(cases(s).items(), "Options"):
        volume = reconstruct(each.image, each.imager, each.grid, method, optics=optics, progress=progress)
        results[name] = {
            "psnr_db": quality(volume, each.truth).psnr_db,
            "empty_db": quality(np.zeros_like(each.truth), each.truth).psnr_db,
            "lenses_of_the_brightest": _lenses(volume, each),
        }
    return results


def _lenses(volume: np.ndarray, s: Scene) -> int:
    """Number of lenses that see the brightest voxel."""
    _, row, column = np.unravel_index(int(volume.argmax()), volume.shape)
    place = np.array([float(s.grid.x[column]), float(s.grid.y[row])])
    distance = np.linalg.norm(np.asarray(s.imager.centers) - place, axis=1)
    return int((distance < float(s.imager.field_radius)).sum())


def report(data: Path, progress: Progress) -> Report:
    results = run(SCENES["letters"](data), progress=progress)
    columns = ("", "PSNR, dB", "empty, dB", "lenses that see the brightest voxel")
    rows = [
        [name, f"{r['psnr_db']:.1f}", f"{r['empty_db']:.1f}", str(r["lenses_of_the_brightest"])]
        for name, r in results.items()
    ]
    text = markdown_table(columns, rows) + "\n"
    return Report({"options.json": results, "options.md": text}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"data": {"type": Path}})
