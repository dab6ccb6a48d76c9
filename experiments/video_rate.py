"""Recordings from disk to OME-Zarr, and captures while a camera runs: frames per second, delays, memory, killed runs.

A recording is reconstructed by the command line as one process and with workers; memory, a run that is killed and
resumed, and the time forecast from few frames are measured at a smaller size. Then a camera writes the same frames as
files at several rates, and `--watch` reconstructs them: the delay is from a capture's file to its volume's, beside
reading, computing and writing one frame, one after the other.

    python -m experiments.video_rate [--frames 500] [--pixels 1024] [--many 1000] [--coarse 512] [--out DIR]
"""

import contextlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil
import tifffile

from experiments.common import Report, main, table
from gs_jax import Design, Progress, Reconstructor, geomscope, simulate, write_design
from gs_jax.apps.benchmark import markdown_table
from gs_jax.io.camera import prepare, read_frame
from gs_jax.io.captures import Selection
from gs_jax.io.ngff import JOURNAL, VolumeSeries
from gs_jax.io.recordings import open_recording
from gs_jax.reconstruction.pipeline import voxel_grid
from gs_jax.simulation import random_points

# Seconds between two samples of the process; frames whose parts are timed.
_EVERY, _TIMED = 0.2, 20
_NEAR, _FAR, _DEPTHS = 18, 22, 13
_SEED, _DIFFERENT = 0, 100
# Rates of the camera, frames/s, its frames, and the seconds after the last in which the newest becomes a volume.
RATES, _CAMERA, _REST = (5, 16, 32, 64), 300, 1.0
_RATE = ("--depths", f"{_NEAR}:{_FAR}:{(_FAR - _NEAR) / (_DEPTHS - 1)}")
LIVE = {
    "camera_frames_per_s": ("camera, frames/s", ".1f"),
    "volumes_per_s": ("volumes/s", ".1f"),
    "cpu_ms": ("processor, ms a volume", ".0f"),
    "one_ms": ("one, ms", ".0f"),
    "delay_ms": ("delay, ms", ".0f"),
    "delay_over_one": ("delay over one", ".2f"),
    "delay_95_ms": ("95 %, ms", ".0f"),
}


def coarse_design(pixels: int) -> Design:
    """The built-in microscope with a camera of so many pixels in each direction on the same sensor."""
    design = geomscope()
    across = design.sensor.shape[0] * design.sensor.pixel_pitch_um
    return design.replace(shape=(pixels, pixels), pixel_pitch_um=across / pixels)


def write_recording(path: Path, design: Design, frames: int) -> None:
    """Write frames of points with shot noise, 12 bits; a hundred different frames are repeated."""
    rng = np.random.default_rng(_SEED)
    points = random_points(50, (8.0, 8.0), (18.0, 22.0), seed=_SEED)
    image = np.asarray(simulate(points, design.imager(), optics="near"))
    mean = 100 + 2000 * image / image.max()
    images = [rng.poisson(mean).clip(0, 4095).astype(np.uint16) for _ in range(min(frames, _DIFFERENT))]
    with tifffile.TiffWriter(path, bigtiff=True) as tiff:
        for frame in range(frames):
            tiff.write(images[frame % _DIFFERENT], photometric="minisblack", contiguous=True)


def depths() -> list[float]:
    """Depths of the volumes, mm."""
    return np.linspace(_NEAR, _FAR, _DEPTHS).round(6).tolist()


def parts(path: Path, design: Design, folder: Path, frames: int) -> dict[str, float]:
    """Median milliseconds per frame of reading, computing and writing, each alone."""
    imager = design.imager()
    grid = voxel_grid(imager, depths())
    volume_of, series = Reconstructor(imager, grid), VolumeSeries(folder / "parts.zarr", frames, grid)
    prepared, times = prepare(imager.sensor.shape), []
    with open_recording(path) as recording:
        assert recording is not None
        for frame in range(frames):
            began = time.perf_counter()
            image = read_frame("a frame", recording.images(frame, Selection()), prepared).image.astype(np.float32)
            read = time.perf_counter()
            volume = volume_of(image, Progress())
            computed = time.perf_counter()
            series.write(frame, volume)
            times.append((read - began, computed - read, time.perf_counter() - computed))
    alone = 1000 * np.median(times[1:], axis=0)
    return dict(zip(("reading", "computing", "writing"), alone.tolist(), strict=True))


def watched(folder: Path, frames: int, output: str, *options: str, kill_at: int | None = None) -> dict:
    """Run the command line as a process; return the number of written frames and the memory over time.

    `kill_at`: kill it, with all of its workers, after so many frames.
    """
    arguments = ["reconstruct", f"{frames}.tif", "design.toml", *_RATE, "-o", output, *options]
    if "--resume" not in options:
        shutil.rmtree(folder / output, ignore_errors=True)
    began = time.monotonic()
    process = psutil.Popen([sys.executable, "-m", "gs_jax", *arguments, "-q"], cwd=folder, stdout=subprocess.PIPE)
    journal, looks = folder / output / JOURNAL, []
    while process.poll() is None:
        done = journal.read_bytes().count(b"\n") - 1 if journal.exists() else 0
        looks.append((time.monotonic() - began, done, _memory(process) / 2**20))
        if kill_at is not None and done >= kill_at:
            for running in (process, *process.children(recursive=True)):
                running.kill()
            process.wait()
        time.sleep(_EVERY)
    seconds, counts, memory = np.array([look for look in looks if look[2]]).T
    some = (counts > 0) & (counts < frames)
    line = np.polyfit(seconds[some], counts[some], 1) if some.sum() > 2 else (np.nan, np.nan)
    return {
        "frames": frames,
        "seconds": time.monotonic() - began,
        "frames_per_s": float(line[0]),
        "seconds_frames_mib": list(zip(seconds.tolist(), counts.tolist(), memory.tolist(), strict=True)),
    }


def _memory(process: psutil.Process) -> int:
    """Resident bytes of a process and its workers; 0 for one that is ending."""
    total = 0
    for running in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            total += running.memory_info().rss
    return total


def survival(folder: Path, frames: int) -> dict:
    """Whether a run by two workers that is killed and resumed leaves the same files as an uninterrupted run."""
    workers = ("--workers", "2")
    watched(folder, frames, "killed.zarr", *workers, kill_at=frames // 3)
    written = (folder / "killed.zarr" / JOURNAL).read_bytes().count(b"\n") - 1
    watched(folder, frames, "killed.zarr", *workers, "--resume")
    watched(folder, frames, "whole.zarr")
    numbers = [json.loads(line)["frame"] for line in (folder / "killed.zarr" / JOURNAL).read_text().splitlines()[1:]]
    equal = _voxels(folder / "killed.zarr") == _voxels(folder / "whole.zarr")
    return {"there_when_killed": written, "each_once": sorted(numbers) == list(range(frames)), "equal": equal}


def _voxels(path: Path) -> dict[str, bytes]:
    """Files of the volumes: the content of a store without its journal and metadata."""
    named = {str(file.relative_to(path)): file for file in path.rglob("*") if file.is_file()}
    return {name: file.read_bytes() for name, file in named.items() if name not in (JOURNAL, "zarr.json")}


def forecast(few: dict, many: dict) -> float:
    """Seconds for many frames, from the seconds before the first frame and the frames per second of a run of few."""
    return few["seconds"] + (many["frames"] - few["frames"]) / few["frames_per_s"]


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
    words = ["reconstruct", run, "design.toml", "--watch", *_RATE, "-o", store]
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
    middle, most = np.percentile(1000 * (written - taken)[newest][1:], (50, 95)).tolist()
    count = float(np.sum(written <= ended))
    return {
        "camera_frames_per_s": len(images) / (ended - began),
        "volumes_per_s": count / (ended - began),
        "cpu_ms": 1000 * (after.user + after.system - before.user - before.system) / count,
        "delay_ms": middle,
        "delay_95_ms": most,
    }


def run(frames: int, pixels: int, many: int, coarse: int, few: int = 100, rates: Sequence[float] = RATES) -> dict:
    """Measure frames per second and live delays at one size, and memory, survival and the forecast at a smaller one."""
    results: dict = {"cores": psutil.cpu_count(), "load_before": psutil.getloadavg()}
    with tempfile.TemporaryDirectory() as name:
        folder, design = Path(name), coarse_design(pixels)
        recording = folder / f"{frames}.tif"
        write_design(folder / "design.toml", design)
        write_recording(recording, design, frames)
        runs = {"one process": (), "1 worker": ("--workers", "1"), "2 workers": ("--workers", "2")}
        results["rate"] = {key: watched(folder, frames, "v.zarr", *options) for key, options in runs.items()}
        results["voxels_z_y_x"] = voxel_grid(design.imager(), depths()).volume_shape
        results["alone_ms"] = alone = [parts(recording, design, folder, min(frames, _TIMED))]
        images, results["live"] = tifffile.imread(recording, key=range(min(frames, _CAMERA))), []
        for rate in rates:
            row = live(folder, images[: int(max(20, 10 * rate))], rate)
            alone.append(parts(recording, design, folder, min(frames, _TIMED)))
            one = float(np.mean([sum(times.values()) for times in alone[-2:]]))
            results["live"].append(row | {"one_ms": one, "delay_over_one": row["delay_ms"] / one})
    with tempfile.TemporaryDirectory() as name:
        folder, design = Path(name), coarse_design(coarse)
        write_design(folder / "design.toml", design)
        for count in (few, many):
            write_recording(folder / f"{count}.tif", design, count)
        results["long"] = {}
        for key in ("one process", "2 workers"):
            short, long = (watched(folder, count, "v.zarr", *runs[key]) for count in (few, many))
            results["long"][key] = long | {"forecast_s": forecast(short, long)}
        results["survival"] = survival(folder, few)
    return results | {"load_after": psutil.getloadavg()}


def growth(long: dict) -> tuple[float, float]:
    """Median memory in the second and in the last tenth of the frames, MiB."""
    _, done, memory = np.array(long["seconds_frames_mib"]).T
    tenth = long["frames"] / 10
    between = lambda low, high: float(np.median(memory[(done >= low * tenth) & (done <= high * tenth)]))
    return between(1, 2), between(9, 10)


def summary(results: dict) -> list[tuple[str, str]]:
    """What was measured, in words."""
    rows = [(f"{key}: frames/s", f"{row['frames_per_s']:.1f}") for key, row in results["rate"].items()]
    rows += [(f"{key}: s in all", f"{row['seconds']:.1f}") for key, row in results["rate"].items()]
    rows += [(f"{name} alone, ms a frame", f"{value:.1f}") for name, value in results["alone_ms"][0].items()]
    for key, row in results["long"].items():
        early, late = growth(row)
        rows.append((f"{row['frames']} frames, {key}: memory, MiB", f"{early:.0f}, then {late:.0f}"))
        rows.append((f"{row['frames']} frames, {key}: s", f"forecast {row['forecast_s']:.0f}, {row['seconds']:.0f}"))
    survived = results["survival"]
    equal = "equal" if survived["equal"] and survived["each_once"] else "DIFFERENT"
    rows.append((f"killed at frame {survived['there_when_killed']} and resumed", f"{equal} volumes, each frame once"))
    load = [f"{results[key][0]:.1f}" for key in ("load_before", "load_after")]
    return [*rows, ("load of the machine", " and ".join(load))]


def report(frames: int, pixels: int, many: int, coarse: int, progress: Progress) -> Report:
    with progress.step("Reconstructing"):
        results = run(frames, pixels, many, coarse)
    rows, columns = summary(results), tuple(title for title, _ in LIVE.values())
    delays = [[format(row[key], form) for key, (_, form) in LIVE.items()] for row in results["live"]]
    title = "{} frames of {}^2 to {} x {} x {} voxels".format(frames, pixels, *results["voxels_z_y_x"])
    text = f"**{title}**\n\n{markdown_table(('', ''), rows)}\n\n{markdown_table(columns, delays)}\n"
    files = {"video_rate.json": results, "video_rate.md": text}
    return Report(files, [table(("", ""), rows, title), table(columns, delays)])


if __name__ == "__main__":
    sizes = {"--frames": 500, "--pixels": 1024, "--many": 1000, "--coarse": 512}
    main(report, {name: {"type": int, "default": size} for name, size in sizes.items()})
