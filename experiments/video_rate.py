"""Recordings from disk to OME-Zarr: frames per second with one and two workers, memory, killed runs, forecasts."""

import contextlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import tifffile
from matplotlib.figure import Figure

from gs_jax import simulate
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design, write_design
from gs_jax.design.start import geomscope
from gs_jax.io.camera import prepare, read_frame
from gs_jax.io.captures import Selection
from gs_jax.io.recordings import open_recording
from gs_jax.io.volume_series import JOURNAL, VolumeSeries
from gs_jax.reconstruction.pipeline import Reconstructor, voxel_grid
from gs_jax.simulation.phantoms import random_points

from .common import Report, main, table

# Seconds between two samples of the process; frames whose parts are timed.
_EVERY, _TIMED = 0.2, 20
_NEAR, _FAR, _DEPTHS = 18, 22, 13
_SEED, _DIFFERENT = 0, 100


def coarse_design(pixels: int) -> Design:
    """The built-in microscope with a camera of so many pixels in each direction on the same sensor."""
    data = geomscope().model_dump()
    across = data["sensor"]["shape"][0] * data["sensor"]["pixel_pitch_um"]
    data["sensor"] |= {"shape": (pixels, pixels), "pixel_pitch_um": across / pixels}
    return Design.model_validate(data)


def write_recording(path: Path, design: Design, frames: int) -> None:
    """Write frames of points with shot noise, 12 bits; a hundred different frames are repeated."""
    rng = np.random.default_rng(_SEED)
    image = np.asarray(
        simulate(random_points(50, (8.0, 8.0), (18.0, 22.0), seed=_SEED), design.imager(), optics="near")
    )
    mean = 100 + 2000 * image / image.max()
    images = [rng.poisson(mean).clip(0, 4095).astype(np.uint16) for _ in range(min(frames, _DIFFERENT))]
    with tifffile.TiffWriter(path, bigtiff=True) as tiff:
        for frame in range(frames):
            tiff.write(images[frame % _DIFFERENT], photometric="minisblack", contiguous=True)


def parts(path: Path, design: Design, depths: list[float], folder: Path, frames: int) -> dict[str, float]:
    """Median milliseconds per frame of reading, computing and writing, each alone."""
    imager = design.imager()
    grid = voxel_grid(imager, depths)
    volume_of, series = Reconstructor(imager, grid), VolumeSeries(folder / "parts.zarr", frames, grid)
    prepared, times = prepare(imager.sensor.shape), []
    with open_recording(path) as recording:
        assert recording is not None
        for frame in range(frames):
            began = time.perf_counter()
            image = read_frame("a frame", recording.images(frame, Selection()), prepared).image.astype(np.float32)
            read = time.perf_counter()
            volume = volume_of(image, Progress())
            made = time.perf_counter()
            series.write(frame, volume)
            times.append((read - began, made - read, time.perf_counter() - made))
    alone = 1000 * np.median(times[1:], axis=0)
    return dict(zip(("reading", "computing", "writing"), alone.tolist(), strict=True))


def watched(folder: Path, frames: int, output: str, *options: str, kill_at: int | None = None) -> dict:
    """Run the command line as a process; return the number of written frames and the memory over time.

    `kill_at`: kill it, with all of its workers, after so many frames.
    """
    arguments = ["reconstruct", f"{frames}.tif", "design.toml", *_depths(), "-o", output, *options]
    if "--resume" not in options:
        shutil.rmtree(folder / output, ignore_errors=True)
    began = time.monotonic()
    process = psutil.Popen([sys.executable, "-m", "gs_jax", *arguments, "-q"], cwd=folder, stdout=subprocess.PIPE)
    journal, looks = folder / output / JOURNAL, []
    while process.poll() is None:
        done = journal.read_bytes().count(b"\n") - 1 if journal.exists() else 0
        looks.append((time.monotonic() - began, done, _memory(process) / 2**20))
        if kill_at is not None and done >= kill_at:
            for each in (process, *process.children(recursive=True)):
                each.kill()
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


def _depths() -> tuple[str, str]:
    return "--depths", f"{_NEAR}:{_FAR}:{(_FAR - _NEAR) / (_DEPTHS - 1)}"


def _memory(process: psutil.Process) -> int:
    """Resident bytes of a process and its workers; 0 for one that is ending."""
    total = 0
    for each in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            total += each.memory_info().rss
    return total


def survival(folder: Path, frames: int) -> dict:
    """Whether a run by two workers that is killed and resumed leaves the same files as an uninterrupted run."""
    workers = ("--workers", "2")
    killed = watched(folder, frames, "killed.zarr", *workers, kill_at=frames // 3)
    left = (folder / "killed.zarr" / JOURNAL).read_bytes().count(b"\n") - 1
    watched(folder, frames, "killed.zarr", *workers, "--resume")
    watched(folder, frames, "whole.zarr")
    numbers = [json.loads(line)["frame"] for line in (folder / "killed.zarr" / JOURNAL).read_text().splitlines()[1:]]
    return {
        "frames": frames,
        "there_when_killed": left,
        "seconds_until_killed": killed["seconds"],
        "each_once": sorted(numbers) == list(range(frames)),
        "equal": _voxels(folder / "killed.zarr") == _voxels(folder / "whole.zarr"),
    }


def _voxels(path: Path) -> dict[str, bytes]:
    """Files of the volumes: the content of a store without its journal and metadata."""
    named = {str(each.relative_to(path)): each for each in path.rglob("*") if each.is_file()}
    return {name: each.read_bytes() for name, each in named.items() if name not in (JOURNAL, "zarr.json")}


def foretold(few: dict, many: dict) -> dict:
    """Forecast for many frames from a run of few: its seconds before the first frame, and its frames per second."""
    start = few["seconds"] - few["frames"] / few["frames_per_s"]
    seconds = start + many["frames"] / few["frames_per_s"]
    return {"start_s": start, "seconds": seconds, "measured": many["seconds"], "ratio": seconds / many["seconds"]}


def run(frames: int = 500, pixels: int = 1024, many: int = 1000, coarse: int = 512, few: int = 100) -> dict:
    """Measure frames per second at one size, and memory, survival and the forecast at a smaller one."""
    results: dict = {"cores": psutil.cpu_count(), "load_before": psutil.getloadavg()}
    places = np.linspace(_NEAR, _FAR, _DEPTHS).round(6).tolist()
    here, by = {"here": ()}, {f"{n} workers": ("--workers", str(n)) for n in (1, 2)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        design = coarse_design(pixels)
        write_design(folder / "design.toml", design)
        write_recording(folder / f"{frames}.tif", design, frames)
        results["rate"] = {key: watched(folder, frames, "v.zarr", *how) for key, how in (here | by).items()}
        results["alone_ms"] = parts(folder / f"{frames}.tif", design, places, folder, min(frames, _TIMED))
        results["written_mib"] = sum(len(each) for each in _voxels(folder / "v.zarr").values()) / 2**20
        results["voxels_z_y_x"] = voxel_grid(design.imager(), places).volume_shape
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        design = coarse_design(coarse)
        write_design(folder / "design.toml", design)
        for count in (few, many):
            write_recording(folder / f"{count}.tif", design, count)
        for key, how in (here | {"2 workers": by["2 workers"]}).items():
            short, long = (watched(folder, count, "v.zarr", *how) for count in (few, many))
            results[f"long, {key}"] = long | {"foretold": foretold(short, long)}
        results["survival"] = survival(folder, few)
    return results | {"frames": frames, "pixels": pixels, "coarse": coarse, "load_after": psutil.getloadavg()}


def picture(results: dict) -> Figure:
    """Plot resident memory against frames written."""
    figure = Figure(figsize=(7, 3.4), dpi=100, layout="constrained")
    axes = figure.subplots()
    most = 0
    for key, label in (("long, here", "one process"), ("long, 2 workers", "two workers and the scheduling process")):
        _, done, memory = np.array(results[key]["seconds_frames_mib"]).T
        running = done < results[key]["frames"]  # the rest is the end of the processes
        axes.plot(done[running], memory[running], label=label)
        most = max(most, memory.max())
    axes.set(xlabel="frames written", ylabel="resident memory, MiB", ylim=(0, 1.2 * most))
    axes.legend(fontsize=8)
    return figure


def grown(long: dict) -> tuple[float, float]:
    """Median memory in the second and in the last tenth of the frames, MiB."""
    _, done, memory = np.array(long["seconds_frames_mib"]).T
    tenth = long["frames"] / 10
    between = lambda low, high: float(np.median(memory[(done >= low * tenth) & (done <= high * tenth)]))
    return between(1, 2), between(9, 10)


def bars(results: dict) -> list[tuple[str, str, str]]:
    """Targets, measured values, and whether they are met."""
    rows = []
    for key in ("long, here", "long, 2 workers"):
        early, late = grown(results[key])
        what = f"memory flat over {results[key]['frames']} frames ({key.split(', ')[1]}; +5 % at most)"
        rows.append((what, f"{early:.0f} MiB, then {late:.0f}", "met" if late <= 1.05 * early else "missed"))
    survival = results["survival"]
    what = f"killed and resumed as uninterrupted ({survival['frames']} frames, 2 workers)"
    was = f"killed at {survival['there_when_killed']}; every byte of the volumes, each frame once"
    rows.append((what, was, "met" if survival["equal"] and survival["each_once"] else "missed"))
    for key in ("long, here", "long, 2 workers"):
        told = results[key]["foretold"]
        what = f"{results[key]['frames']} frames foretold from few ({key.split(', ')[1]}; within 25 %)"
        was = f"{told['seconds']:.0f} s, measured {told['measured']:.0f} s"
        rows.append((what, was, "met" if 0.75 <= told["ratio"] <= 1.25 else "missed"))
    return rows


def report(frames: int, pixels: int, many: int, coarse: int, progress: Progress) -> Report:
    with progress.step("Reconstructing"):
        results = run(frames, pixels, many, coarse)
    alone, rates = results["alone_ms"], results["rate"]
    rows = [
        *((f"frames/s, {key}", f"{rate['frames_per_s']:.1f}") for key, rate in rates.items()),
        *((f"s in all, start and compilation too, {key}", f"{rate['seconds']:.1f}") for key, rate in rates.items()),
        *((f"ms a frame, {name} alone", f"{value:.1f}") for name, value in alone.items()),
        ("MiB written", f"{results['written_mib']:.0f}"),
        ("load of the machine, before and after", f"{results['load_before'][0]:.1f}, {results['load_after'][0]:.1f}"),
    ]
    z, y, x = results["voxels_z_y_x"]
    title = f"{frames} frames of {pixels}^2 to {z} x {y} x {x} voxels"
    checks = bars(results)
    text = f"**{title}**\n\n|  |  |\n| --- | ---: |\n" + "".join(f"| {name} | {value} |\n" for name, value in rows)
    text += "\n| bar | found |  |\n| --- | --- | --- |\n" + "".join(f"| {' | '.join(row)} |\n" for row in checks)
    shown = [table(("", ""), rows, title), table(("bar", "found", ""), checks)]
    return Report({"video_rate.json": results, "video_rate.md": text, "video_rate.png": picture(results)}, shown)


if __name__ == "__main__":
    sizes = {"--frames": 500, "--pixels": 1024, "--many": 1000, "--coarse": 512}
    main(report, {name: {"type": int, "default": size} for name, size in sizes.items()})
