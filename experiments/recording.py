"""A recording from the disk to OME-Zarr: frames per second, what each part costs alone, and memory over the frames."""

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
from gs_jax.designs.builtin import geomscope
from gs_jax.designs.design import Design, write_design
from gs_jax.io.captures import Wanted
from gs_jax.io.correction import prepare, read_frame
from gs_jax.io.recordings import opened_recording
from gs_jax.io.volume_series import JOURNAL, VolumeSeries
from gs_jax.reconstruction.pipeline import reconstructor, voxel_grid
from gs_jax.simulation.phantoms import random_points

from .common import Report, main, table

# Seconds between two looks at the process; frames whose parts are timed.
_EVERY, _TIMED = 0.2, 20
_SEED = 0


def coarse_design(pixels: int) -> Design:
    """The built-in microscope with a camera of so many pixels each way on the same sensor."""
    data = geomscope().model_dump()
    across = data["sensor"]["shape"][0] * data["sensor"]["pixel_pitch_um"]
    data["sensor"] |= {"shape": (pixels, pixels), "pixel_pitch_um": across / pixels}
    return Design.model_validate(data)


def write_recording(path: Path, design: Design, frames: int) -> None:
    """Points with shot noise, 12 bits, another frame each time."""
    rng = np.random.default_rng(_SEED)
    image = np.asarray(
        simulate(random_points(50, (8.0, 8.0), (18.0, 22.0), seed=_SEED), design.imager(), optics="near")
    )
    mean = 100 + 2000 * image / image.max()
    with tifffile.TiffWriter(path, bigtiff=True) as tiff:
        for _ in range(frames):
            tiff.write(rng.poisson(mean).clip(0, 4095).astype(np.uint16), photometric="minisblack", contiguous=True)


def parts(path: Path, design: Design, depths: list[float], folder: Path, frames: int) -> dict[str, float]:
    """Milliseconds a frame of reading, computing and writing, each alone; medians."""
    imager = design.imager()
    grid = voxel_grid(imager, depths)
    volume_of, series = reconstructor(imager, grid), VolumeSeries(folder / "parts.zarr", frames, grid)
    prepared, times = prepare(imager.sensor.shape), []
    with opened_recording(path) as recording:
        assert recording is not None
        for frame in range(frames):
            began = time.perf_counter()
            image = read_frame("a frame", recording.images(frame, Wanted()), prepared).image.astype(np.float32)
            read = time.perf_counter()
            volume = volume_of(image, Progress())
            made = time.perf_counter()
            series.write(frame, volume)
            times.append((read - began, made - read, time.perf_counter() - made))
    alone = 1000 * np.median(times[1:], axis=0)
    return dict(zip(("reading", "computing", "writing"), alone.tolist(), strict=True))


def run(frames: int = 500, pixels: int = 1024, depths: int = 13) -> dict:
    """Numbers of the command line as a process of its own, at this size."""
    design, places = coarse_design(pixels), np.linspace(18, 22, depths).round(6).tolist()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_design(folder / "design.toml", design)
        write_recording(folder / "recording.tif", design, frames)
        step = places[1] - places[0] if depths > 1 else 1
        arguments = ["reconstruct", "recording.tif", "design.toml", "--depths", f"18:22:{step}", "-o", "v.zarr"]
        began = time.monotonic()
        process = psutil.Popen([sys.executable, "-m", "gs_jax", *arguments], cwd=folder, stdout=subprocess.PIPE)
        journal, watched = folder / "v.zarr" / JOURNAL, []
        while process.poll() is None:
            done = journal.read_bytes().count(b"\n") - 1 if journal.exists() else 0
            if memory := process.memory_info().rss:  # of a process that is ending it is 0
                watched.append((time.monotonic() - began, done, memory / 2**20))
            time.sleep(_EVERY)
        said = process.stdout.read().decode() if process.stdout else ""
        alone = parts(folder / "recording.tif", design, places, folder, min(frames, _TIMED))
        written = sum(each.stat().st_size for each in (folder / "v.zarr").rglob("*") if each.is_file())
        shape = voxel_grid(design.imager(), places).volume_shape
    seconds = np.array([second for second, done, _ in watched if done > 0])
    counts = np.array([done for _, done, _ in watched if done > 0])
    rate = float((counts[-1] - counts[0]) / (seconds[-1] - seconds[0])) if len(counts) > 1 else np.nan
    return {
        "frames": frames,
        "pixels": pixels,
        "voxels_z_y_x": shape,
        "seconds": watched[-1][0],
        "frames_per_s": rate,
        "alone_ms": alone,
        "written_mib": written / 2**20,
        "said": said.splitlines(),
        "seconds_frames_mib": watched,
    }


def picture(found: dict) -> Figure:
    """Resident memory against frames written."""
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    _, done, memory = np.array(found["seconds_frames_mib"]).T
    axes.plot(done, memory)
    axes.set(xlabel="frames written", ylabel="resident memory, MiB", ylim=(0, 1.2 * memory.max()))
    return figure


def report(frames: int, pixels: int, progress: Progress) -> Report:
    with progress.step("Reconstructing"):
        found = run(frames, pixels)
    _, done, memory = np.array(found["seconds_frames_mib"]).T
    at = [(count, memory[np.searchsorted(done, count)]) for count in (frames // 10, frames // 2, frames - 1)]
    alone = found["alone_ms"]
    rows = [
        ("frames/s, all together", f"{found['frames_per_s']:.1f}"),
        ("s in all, start and compilation too", f"{found['seconds']:.1f}"),
        *((f"ms a frame, {name} alone", f"{value:.1f}") for name, value in alone.items()),
        ("frames/s, one after the other", f"{1000 / sum(alone.values()):.1f}"),
        ("MiB written", f"{found['written_mib']:.0f}"),
        *((f"MiB resident at frame {count}", f"{mib:.0f}") for count, mib in at),
    ]
    z, y, x = found["voxels_z_y_x"]
    title = f"{frames} frames of {pixels}^2 to {z} x {y} x {x} voxels"
    text = f"**{title}**\n\n|  |  |\n| --- | ---: |\n" + "".join(f"| {name} | {value} |\n" for name, value in rows)
    return Report(
        {"recording.json": found, "recording.md": text, "recording.png": picture(found)}, [table(("", ""), rows, title)]
    )


if __name__ == "__main__":
    main(report, {"--frames": {"type": int, "default": 500}, "--pixels": {"type": int, "default": 1024}})
