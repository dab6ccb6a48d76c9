"""Deconvolution of real captures by measured PSFs: time, memory and objective, ours, scico's and LenslessPiCam's.

Volume: the problem of scico's example `diffusercam_tv_admm` (Balke et al., J. Open Source Softw. 7, 4722, 2022), in
which LenslessPiCam 1.0.8 takes no part, as its convolution keeps the images of planes apart. Plane: DiffuserCam's hand,
at a quarter of its size and in full, less the mean of the PSF's dark corner, as in Waller Lab's tutorial.

Each code and method runs in a process of its own, the codes in turn; steps on the plane in several rounds, with ratios
of the same round. The objective of each step's scene is computed for all by the same lines of NumPy.

    python -m experiments.peers DATA [--scico PYTHON] [--lensless PYTHON] [--rounds 3] [--out DIR]

DATA holds the folders `diffusercam` and `diffusercam3d`; PYTHON are those of environments with the peers. Writes
`peers.json` and `peers.md`; about fifteen minutes on two cores.
"""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile

from experiments.common import Report, main, tables_report
from gs_jax import Progress
from gs_jax.base.machine import describe

# Planes of the stack that the example takes, the weights of its priors, and the steps of each code.
PLANES, EXAMPLE_TV, EXAMPLE_L1 = slice(1, 37), 3e-3, 1e-2
OF_VOLUME = {"gs_jax": 60, "scico": 25}
METHODS = {"Richardson-Lucy": ("gs_jax",), "FISTA": ("gs_jax", "scico", "LenslessPiCam")}
METHODS["ADMM"] = METHODS["FISTA"]
# Weight of the plane's total variation; reductions of its sides, and steps.
TV, STEPS = 1e-4, {4: 60, 1: 12}
VOLUME_COLUMNS = ("code", "steps", "s a step", "processor, s", "objective", "least printed", "rises", "memory, MiB")
STEP_COLUMNS = ("pixels", "method", "code", "ms a step", "over ours", "processor, ms", "memory, MiB", "objective")


def volume(folder: Path) -> dict[str, np.ndarray | float]:
    """The example's problem: capture and stack less their minimum over their maximum, each PSF of unit norm."""
    image, stack = (tifffile.imread(folder / f"{name}.tif").astype(np.float32) for name in ("capture", "psf_stack"))
    image, stack = ((a - a.min()) / (a.max() - a.min()) for a in (image, stack))
    stack = stack[PLANES] / np.linalg.norm(stack[PLANES], axis=(1, 2), keepdims=True)
    return {"image": image, "stack": stack, "tv": EXAMPLE_TV, "l1": EXAMPLE_L1, "signed": True}


def plane(folder: Path, factor: int, tv: float) -> dict[str, np.ndarray | float]:
    """The hand, averaged over squares; PSF and image of unit norm."""
    raw = [tifffile.imread(folder / f"{name}.tif").astype(np.float32) for name in ("psf_sample", "rawdata_hand_sample")]
    dark = raw[0][5:15, 5:15].mean()
    rows, columns = (n // factor for n in raw[0].shape)
    small = [(a - dark).reshape(rows, factor, columns, factor).mean((1, 3)) for a in raw]
    psf, image = (a / np.linalg.norm(a) for a in small)
    return {"image": image, "stack": psf[None], "tv": tv, "l1": 0.0, "signed": False}


def run(problem: dict, pythons: dict[str, str], steps: dict[str, int], progress: Progress) -> dict[str, dict]:
    """Run each code, or a method of it, on a problem; results by the names in `steps`, as `peers_runs.py` has them."""
    script, results = str(Path(__file__).with_name("peers_runs.py")), {}
    with tempfile.TemporaryDirectory() as folder:
        given, output = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, **problem)
        for code in [code for code in steps if code.split()[0] in pythons]:
            with progress.step(code):
                command = [pythons[code.split()[0]], script, code, str(given), str(output), str(steps[code])]
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    raise RuntimeError(f"{code}: {done.stderr[-2000:]}")
                with np.load(output) as arrays:
                    results[code] = {name: arrays[name] for name in arrays.files}
    return results


def volume_rows(results: dict[str, dict]) -> list[dict]:
    """Steps, time, memory and objective of each code; `rises` counts the steps after which the objective is higher."""
    return [
        {
            "code": code,
            "steps": len(objectives := result["objectives"]),
            "seconds_a_step": _median_step(result["seconds"]),
            "processor_seconds_a_step": _median_step(result["processor_seconds"]),
            "objective": float(objectives.min()),
            "least_printed": float(np.min(result["printed"])),
            "rises": int((np.diff(objectives) > 1e-6 * objectives[:-1]).sum()),
            "peak_mib": float(result["peak_mib"]),
        }
        for code, result in results.items()
    ]


def step_rows(rounds: Sequence[dict[str, dict]]) -> list[dict]:
    """Medians of the steps of each code and method, and over rounds; ratios to ours within a round."""
    rows = []
    for name in rounds[0]:
        code, method = name.split(maxsplit=1)
        results = [results[name] for results in rounds]
        seconds = [_median_step(result["seconds"]) for result in results]
        ours = [_median_step(results[f"gs_jax {method}"]["seconds"]) for results in rounds]
        rows.append(
            {
                "method": method,
                "code": code,
                "versions": str(results[0]["versions"]),
                "seconds_a_step": float(np.median(seconds)),
                "rounds_seconds_a_step": seconds,
                "over_ours": float(np.median(np.divide(seconds, ours))),
                "processor_seconds_a_step": float(np.median([_median_step(r["processor_seconds"]) for r in results])),
                "peak_mib": float(np.median([r["peak_mib"] for r in results])),
                "objective": float(results[0]["objectives"][-1]),
            }
        )
    return rows


def _median_step(sums: np.ndarray) -> float:
    return float(np.median(np.diff(sums, prepend=0)))


def on_plane(data: Path, factor: int, pythons: dict[str, str], rounds: int, progress: Progress) -> list[dict]:
    """Time the steps of each method on the hand at a size."""
    records: list[dict[str, dict]] = [{} for _ in range(rounds)]
    for results in records:
        for method, codes in METHODS.items():
            problem = plane(data, factor, TV if method == "ADMM" else 0.0)
            results |= run(problem, pythons, {f"{code} {method}": STEPS[factor] for code in codes}, progress)
    return step_rows(records)


def report(data: Path, scico: str | None, lensless: str | None, rounds: int, progress: Progress) -> Report:
    all_pythons = {"gs_jax": sys.executable, "scico": scico, "LenslessPiCam": lensless}
    pythons = {code: python for code, python in all_pythons.items() if python}
    of_volume = volume_rows(run(volume(data / "diffusercam3d"), pythons, OF_VOLUME, progress))
    of_plane = {
        f"{1200 // factor} x {1600 // factor}": on_plane(data / "diffusercam", factor, pythons, rounds, progress)
        for factor in STEPS
    }
    cells = [[value if isinstance(value, str) else f"{value:.4g}" for value in row.values()] for row in of_volume]
    ms = lambda row, name: f"{1000 * row[name]:.3g}"
    steps = [
        [pixels, row["method"], row["code"], ms(row, "seconds_a_step"), f"{row['over_ours']:.2f}"]
        + [ms(row, "processor_seconds_a_step"), f"{row['peak_mib']:.0f}", f"{row['objective']:.3g}"]
        for pixels, rows in of_plane.items()
        for row in rows
    ]
    numbers = {"machine": describe(), "volume": of_volume, "plane": of_plane}
    return tables_report("peers", numbers, (VOLUME_COLUMNS, cells), (STEP_COLUMNS, steps))


if __name__ == "__main__":
    interpreter = {"help": "Python of an environment with this peer."}
    arguments = {"data": {"type": Path}, "--scico": interpreter, "--lensless": interpreter}
    main(report, arguments | {"--rounds": {"type": int, "default": 3, "help": "Rounds [3]."}})
