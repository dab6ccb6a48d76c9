"""Real captures through diffusers, by our ADMM, scico and LenslessPiCam, side by side.

Volume: DiffuserCam's resolution target, at an angle, and 36 measured PSFs, the problem of scico's example
`diffusercam_tv_admm` (Balke et al., J. Open Source Softw. 7, 4722, 2022). Plane: DiffuserCam's hand at a quarter of its
size, the problem of `diffusercam.py`; LenslessPiCam 1.0.8 has this one alone, as its convolution keeps the images of
planes apart instead of summing them. Each code runs in a process of its own, one after the other, and the objective of
each step's scene is computed for all by the same lines of NumPy.

    python experiments/peers_deconvolution.py DATA [--scico PYTHON] [--lensless PYTHON] [--out DIR]

DATA holds the folders `diffusercam` and `diffusercam3d`; PYTHON are those of environments with the peers. Writes
`peers_deconvolution.json` and `.png`; about ten minutes on two cores.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import tifffile
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from experiments.diffusercam import TV, read
from gs_jax.base.machine import describe
from gs_jax.base.progress import Progress

# Planes of the stack that the example takes, and the weights of its priors.
PLANES, EXAMPLE_TV, EXAMPLE_L1 = slice(1, 37), 3e-3, 1e-2
# Objective to which time is measured, of the volume.
LEVEL = 4.45
STEPS = {"volume": {"gs_jax": 60, "scico": 25}, "plane": {"gs_jax": 100, "scico": 100, "LenslessPiCam": 100}}
SHOWN = (4, 11, 18, 25, 32)


def volume(folder: Path, factor: int = 1) -> dict[str, np.ndarray | float]:
    """The example's problem: capture and stack less their minimum over their maximum, each PSF of unit norm.

    With a factor, every so many planes, and pixels averaged over squares.
    """
    image, stack = (tifffile.imread(folder / f"{name}.tif").astype(np.float32) for name in ("capture", "psf_stack"))
    image, stack = ((a - a.min()) / (a.max() - a.min()) for a in (image, stack))
    image, stack = (_averaged(a, factor) for a in (image, stack[PLANES][::factor]))
    stack /= np.linalg.norm(stack, axis=(1, 2), keepdims=True)
    return {"image": image, "stack": stack, "tv": EXAMPLE_TV, "l1": EXAMPLE_L1, "signed": True}


def plane(folder: Path, factor: int = 4) -> dict[str, np.ndarray | float]:
    psf, image = read(folder, factor)
    return {"image": image, "stack": psf[None], "tv": TV, "l1": 0.0, "signed": False}


def _averaged(a: np.ndarray, factor: int) -> np.ndarray:
    rows, columns = (n // factor for n in a.shape[-2:])
    a = a[..., : rows * factor, : columns * factor]
    return a.reshape(*a.shape[:-2], rows, factor, columns, factor).mean((-3, -1))


def run(problem: dict, pythons: dict[str, str], steps: dict[str, int], progress: Progress) -> dict[str, dict]:
    """Run each code, or a method of it, on a problem; results by the names in `steps`, as the runs write them."""
    script = str(Path(__file__).with_name("peers_deconvolution_runs.py"))
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, **problem)
        for code in [code for code in steps if code.split()[0] in pythons]:
            python = pythons[code.split()[0]]
            with progress.step(code):
                command = [python, script, code, str(given), str(found), str(steps[code])]
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    raise RuntimeError(f"{code}: {done.stderr[-2000:]}")
                with np.load(found) as arrays:
                    results[code] = {name: arrays[name] for name in arrays.files}
    return results


def first_below(values: np.ndarray, level: float) -> int | None:
    """Index of the first value that is no larger than a level."""
    (below,) = np.nonzero(values <= level)
    return int(below[0]) if below.size else None


def rows_of(results: dict[str, dict], level: float | None) -> list[dict]:
    rows = []
    for code, result in results.items():
        objectives, seconds = result["objectives"], result["seconds"]
        row = {
            "code": code,
            "steps": len(objectives),
            "s_a_step": float(np.median(np.diff(seconds, prepend=0))),
            "processor_s_a_step": float(np.median(np.diff(result["processor_seconds"], prepend=0))),
            "least": float(objectives.min()),
            "last": float(objectives[-1]),
            "rises": int((np.diff(objectives) > 1e-6 * objectives[:-1]).sum()),
            "peak_mib": float(result["peak_mib"]),
        }
        if level is not None:
            for name, values in (("", objectives), ("printed_", result["printed"])):
                at = first_below(values, level)
                row[f"{name}seconds_to_level"] = None if at is None else float(seconds[at])
            row["least_printed"] = float(np.min(result["printed"]))
        rows.append(row)
    return rows


def picture(of_volume: dict[str, dict], of_plane: dict[str, dict]) -> Figure:
    """Planes side by side, a code in each row, and the objectives against time."""
    codes = list(of_plane)
    shown = [plane for plane in SHOWN if plane < len(of_volume[codes[0]]["planes"])]
    figure = Figure(figsize=(2.3 * (len(shown) + 1), 2.0 * len(codes) + 3), dpi=90, layout="constrained")
    top, bottom = (figure.subfigures(2, 1, height_ratios=[2.0 * len(codes), 3.0], squeeze=False)).flat
    axes = top.subplots(len(codes), len(shown) + 1, squeeze=False)
    for row, (code, result) in zip(axes, of_volume.items(), strict=False):
        planes = result["planes"]
        for axis, number in zip(row, shown, strict=False):
            axis.imshow(planes[number], cmap="gray", vmin=0, vmax=np.percentile(planes[shown], 99.7))
            axis.set_title(f"{code}, plane {number + PLANES.start}", fontsize=8)
    for row, (code, result) in zip(axes, of_plane.items(), strict=True):
        hand = result["planes"][0]
        row[-1].imshow(hand, cmap="gray", vmin=0, vmax=np.percentile(hand, 99.9))
        row[-1].set_title(f"{code}, hand", fontsize=8)
    for axis in [axis for row in axes[len(of_volume) :] for axis in row[:-1]]:
        axis.set_axis_off()
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    for axis, results, name in zip(bottom.subplots(1, 2), (of_volume, of_plane), ("volume", "hand"), strict=True):
        for code, result in results.items():
            axis.plot(result["seconds"], result["objectives"], label=code)
        axis.set(xlabel="time, s", ylabel="objective of the scene", title=name, yscale="log")
        axis.legend()
    return figure


def report(data: Path, scico: str | None, lensless: str | None, progress: Progress) -> Report:
    pythons = {"gs_jax": sys.executable, "scico": scico, "LenslessPiCam": lensless}
    given = {code: python for code, python in pythons.items() if python}
    of_volume = run(volume(data / "diffusercam3d"), given, STEPS["volume"], progress)
    of_plane = run(plane(data / "diffusercam"), given, STEPS["plane"], progress)
    rows = {"volume": rows_of(of_volume, LEVEL), "plane": rows_of(of_plane, None)}
    shown = []
    for name, results in rows.items():
        columns = list(results[0])
        cells = [[_cell(row[column]) for column in columns] for row in results]
        shown.append(table(columns, cells, title=name))
    traces = {code: {k: result[k] for k in ("seconds", "objectives", "printed")} for code, result in of_volume.items()}
    files = {"machine": describe(), "level": LEVEL, "rows": rows, "volume": traces}
    return Report({"peers_deconvolution.json": files, "peers_deconvolution.png": picture(of_volume, of_plane)}, shown)


def _cell(value) -> str:
    return "never" if value is None else value if isinstance(value, str) else f"{value:.4g}"


if __name__ == "__main__":
    interpreter = {"help": "Python of an environment with this peer."}
    main(report, {"data": {"type": Path}, "--scico": interpreter, "--lensless": interpreter})
