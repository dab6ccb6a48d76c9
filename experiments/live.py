"""Captures while a camera runs: frames per second, and the delay from a file to its volume, beside one reconstruction.

A camera writes frames of one size at several rates. The same frames as a recording, and reading, computing and writing
one after the other, are measured in the same run, because other work may load the machine.
"""

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import tifffile

from gs_jax.base.progress import Progress
from gs_jax.design.design import write_design
from gs_jax.io.volume_series import JOURNAL
from gs_jax.reconstruction.pipeline import voxel_grid

from .common import Report, main, table
from .video_rate import coarse_design, parts, watched, write_recording

_DEPTHS, _TIMED = np.linspace(18, 22, 13).round(6).tolist(), 40
# Seconds after the last frame in which the newest one becomes a volume.
_REST = 1.0


def camera(folder: Path, images: np.ndarray, rate: float) -> tuple[float, float]:
    """Write images as files at a rate; return when it began and ended."""
    began = time.time()
    for number, image in enumerate(images):
        time.sleep(max(0.0, began + number / rate - time.time()))
        hidden = folder / f".{number:06d}.tif"
        tifffile.imwrite(hidden, image)
        hidden.rename(folder / f"{number:06d}.tif")
    return began, time.time()


def live(folder: Path, images: np.ndarray, rate: float) -> dict:
    """Run the command while a camera writes; return rates, and delays by the times of the files of both.

    Of captures that waited until there was time, the delay is left out: it is that of the camera.
    """
    run, store = folder / f"run{rate:g}", folder / f"{rate:g}.zarr"
    run.mkdir()
    words = ["reconstruct", run, "design.toml", "--watch", "--depths", f"18:22:{4 / 12}", "-o", store]
    process = psutil.Popen([sys.executable, "-m", "gs_jax", *words], cwd=folder, stderr=subprocess.PIPE, text=True)
    while "watched until" not in (line := process.stderr.readline()):
        if not line:
            raise RuntimeError("the command ended before it watched")
    before = process.cpu_times()
    began, ended = camera(run, images, rate)
    after = process.cpu_times()
    time.sleep(_REST)
    process.send_signal(signal.SIGINT)
    process.communicate()
    lines = [json.loads(line) for line in (store / JOURNAL).read_text().splitlines()[1:]]
    names = {line["frame"]: line["name"] for line in lines if "name" in line}
    order = [line["frame"] for line in lines if "name" not in line]
    written = np.array([(store / f"0/c/{frame}/0/0/0").stat().st_mtime for frame in order])
    taken = np.array([(run / names[frame]).stat().st_mtime for frame in order])
    newest = np.array(order) >= np.maximum.accumulate(order)
    # The first frame makes the store.
    delays = 1000 * (written - taken)[newest][1:]
    count = float(np.sum(written <= ended))
    return {
        "camera_frames_per_s": len(images) / (ended - began),
        "volumes_per_s": count / (ended - began),
        "cpu_ms": 1000 * (after.user + after.system - before.user - before.system) / count,
        "newest": len(delays),
        "delay_ms": np.percentile(delays, (50, 95)).tolist(),
    }


def run(frames: int = 300, pixels: int = 1024, rates: tuple[float, ...] = (5, 16, 32, 64)) -> dict:
    """Measure the recording, one reconstruction before and after, and the folder at each rate of the camera."""
    load = [psutil.getloadavg()[0]]
    with tempfile.TemporaryDirectory() as name:
        folder, design = Path(name), coarse_design(pixels)
        write_design(folder / "design.toml", design)
        recording = folder / f"{frames}.tif"
        write_recording(recording, design, frames)
        images = tifffile.imread(recording)
        one = lambda: sum(parts(recording, design, _DEPTHS, folder, min(frames, _TIMED)).values())
        alone, found = [one()], []
        recorded = [watched(folder, frames, "r.zarr")["frames_per_s"]]
        for rate in rates:
            count = int(min(frames, max(20.0, 10 * rate)))
            found.append(live(folder, images[:count], rate))
            alone.append(one())
        recorded.append(watched(folder, frames, "r.zarr")["frames_per_s"])
        shape = voxel_grid(design.imager(), _DEPTHS).volume_shape
    load.append(psutil.getloadavg()[0])
    return {"one_ms": alone, "recorded_per_s": recorded, "live": found, "voxels": shape, "pixels": pixels, "load": load}


def report(frames: int, pixels: int, progress: Progress) -> Report:
    with progress.step("Watching"):
        results = run(frames, pixels)
    rows = []
    for number, each in enumerate(results["live"]):
        one = float(np.mean(results["one_ms"][number : number + 2]))
        middle, most = each["delay_ms"]
        rates = f"{each['camera_frames_per_s']:.1f}", f"{each['volumes_per_s']:.1f}"
        rows.append(
            (*rates, f"{each['cpu_ms']:.0f}", f"{one:.0f}", f"{middle:.0f}", f"{middle / one:.2f}", f"{most:.0f}")
        )
    z, y, x = results["voxels"]
    recorded = " and ".join(f"{each:.1f}" for each in results["recorded_per_s"])
    before, after = results["load"]
    title = (
        f"{results['pixels']}^2 to {z} x {y} x {x} voxels; as a recording {recorded} frames/s before and after; "
        f"load of the machine {before:.1f} and {after:.1f}"
    )
    columns = (
        "camera, frames/s",
        "volumes/s",
        "processor, ms a volume",
        "one, ms",
        "delay, ms",
        "delay over one",
        "95 %, ms",
    )
    lines = [columns, ("---:",) * len(columns), *rows]
    text = f"**{title}**\n\n" + "".join(f"| {' | '.join(row)} |\n" for row in lines)
    return Report({"live.json": results, "live.md": text}, [table(columns, rows, title)])


if __name__ == "__main__":
    main(report, {"--frames": {"type": int, "default": 300}, "--pixels": {"type": int, "default": 1024}})
