"""Recordings: frames from wherever they lie to one OME-Zarr, which survives whatever ends a run."""

import dataclasses
import json
import os
import random
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import tifffile
import zarr

import gs_jax as gs
from gs_jax.base import machine
from gs_jax.base.errors import InputWarning
from gs_jax.io import ngff
from gs_jax.io.captures import Selection
from gs_jax.io.files import JOURNAL
from gs_jax.io.names import first_gap, natural_order, plain_text
from gs_jax.io.ngff import VolumeSeries, halve
from gs_jax.io.provenance import read_provenance
from gs_jax.io.recordings import open_recording, spot_names
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.plan import follow_volume
from gs_jax.reconstruction.recording import PREFETCH, reconstruct_frames
from gs_jax.widget.layers import reader

from .test_files import GRID, VOLUME

FRAMES = np.random.default_rng(0).integers(100, 3000, (5, 96, 80)).astype(np.uint16)
OPTIONS = ("--depths", "18:22:1", "--voxel-um", "50")
WARM = ("--warm-start", "--method")


def save(name, frames=FRAMES):
    """A recording of this name: pages, a folder or a pattern of files, or Zarr."""
    if name.endswith(".zarr"):
        zarr.create_array(name, data=frames)
    elif name.endswith(".tif") and "*" not in name:
        tifffile.imwrite(name, frames, photometric="minisblack")
    elif name.endswith(".npy"):
        np.save(name, frames)
    else:
        os.mkdir("frames")
        for number, frame in enumerate(frames):
            # The ninth comes before the tenth.
            tifffile.imwrite(f"frames/f{number + 8}.tif", frame)
    return name


def command(name, *options, output="v.zarr"):
    return ("reconstruct", name, "design.toml", *OPTIONS, "-o", output, *options)


def bead_frames(places):
    """Frames of beads at these x in each, 20 mm deep."""
    scope = gs.read_design("design.toml").imager()
    frames = np.full((len(places), 96, 80), 16, np.uint16)
    for frame, x in ((frame, x) for frame, row in zip(frames, places, strict=True) for x in row):
        spots = np.asarray(scope.sensor.to_pixels(scope.project(np.array([[x, 0, 20.0]]))))[:, 0]
        for row, column in spots.round().astype(int):
            frame[row - 1 : row + 2, column - 1 : column + 2] = 1000
    return frames


def beside_progress(err):
    """What was said but for how far it is, which a busy machine says."""
    return [line for line in err.splitlines() if not line.startswith("gs-jax: Reconstructing: ")]


def level(path="v.zarr", name="0") -> Any:
    """An array of a store, as any reader of Zarr has it."""
    return zarr.open_group(path, mode="r")[name]


def volumes(path="v.zarr") -> np.ndarray:
    return level(path)[...]


def files(path):
    return {str(each.relative_to(path)): each.read_bytes() for each in sorted(path.rglob("*")) if each.is_file()}


def expected(frames=FRAMES, **options):
    grid = gs.Grid.over(gs.read_design("design.toml").imager().sensor, depths=np.arange(18.0, 22.5), pitch=0.05)
    imager = gs.read_design("design.toml").imager()
    return np.stack([gs.reconstruct(frame.astype(np.float32), imager, grid, **options) for frame in frames])


@pytest.mark.integration
@pytest.mark.parametrize("name", ["rec.tif", "rec.npy", "frames", "frames/f*.tif", "rec.zarr"])
def test_every_frame_is_reconstructed_as_alone(folder, run, name):
    status, out, err = run(*command(save(name)))
    assert (status, beside_progress(err)) == (0, [])
    assert "5 x 5 x 39 x 33 voxels (t, z, y, x), 50 um laterally, 5 depths from 18 to 22 mm" in out
    assert "frames/s" in out
    # Of one type and compiled in one way: float32 rounding is the same.
    np.testing.assert_allclose(volumes(), expected(), rtol=1e-5)
    assert read_provenance("v.zarr")[f"input {os.path.basename(name)}"].startswith("5 frames")
    # Without an interval, time has no unit.
    (image,) = json.loads((folder / "v.zarr" / "zarr.json").read_text())["attributes"]["ome"]["multiscales"]
    assert image["axes"][0] == {"name": "t", "type": "time"}
    assert image["datasets"][0]["coordinateTransformations"][0]["scale"][0] == 1


@pytest.mark.integration
def test_the_same_as_page_by_page(folder, run):
    """With a correction, which is read once, and an iterative method."""
    save("rec.tif")
    tifffile.imwrite("dark.tif", np.full((96, 80), 90, np.uint16))
    how = ("--method", "richardson-lucy", "--steps", "2", "--dark", "dark.tif")
    status, out, _ = run(*command("rec.tif", *how))
    assert status == 0 and "5 frames: dark frame dark.tif taken off, median 90" in out
    run(*command("rec.tif", *how, "--page", "4", output="page.zarr"))
    np.testing.assert_allclose(volumes()[3], volumes("page.zarr"), rtol=1e-4, atol=1e-4 * volumes().max())
    assert "dark.tif" in read_provenance("v.zarr")["correction"]


@pytest.mark.integration
def test_a_network_is_checked_on_the_first_frame(folder, run):
    status, out, err = run(*command(save("rec.tif", FRAMES[:2]), "--suppress", "unet"))
    assert (status, beside_progress(err)) == (0, []) and out.count("v.zarr: frame 0 imaged again is") == 1


def test_what_viewers_are_told(folder, run, monkeypatch):
    """Time first, to scale; planes as chunks; a pyramid where a plane is larger than a chunk."""
    monkeypatch.setattr(ngff, "CHUNK", 16)
    monkeypatch.setattr(ngff, "CHUNK", 16)
    run(*command(save("rec.tif"), "--frame-interval", "0.05"))
    attributes = json.loads((folder / "v.zarr" / "zarr.json").read_text())["attributes"]["ome"]
    (image,) = attributes["multiscales"]
    assert attributes["version"] == "0.5" and image["axes"] == [
        {"name": "t", "type": "time", "unit": "second"},
        *({"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"),
    ]
    levels = [level(name=each["path"]) for each in image["datasets"]]
    assert [level.shape for level in levels] == [(5, 5, 39, 33), (5, 5, 20, 17), (5, 5, 10, 9)]
    assert [level.chunks for level in levels] == [(1, 1, 16, 16), (1, 1, 16, 16), (1, 1, 10, 9)]
    # A frame is a file.
    assert [level.shards for level in levels] == [(1, 5, 48, 48), (1, 5, 32, 32), (1, 5, 10, 9)]
    assert len(list((folder / "v.zarr" / "0" / "c").rglob("*"))) == 5 * 4
    transforms = [each["coordinateTransformations"] for each in image["datasets"]]
    assert [scale["scale"] for scale, _ in transforms] == [[0.05, 1000, 50 * n, 50 * n] for n in (1, 2, 4)]
    # Of wider voxels, the first centre lies further in.
    assert [place["translation"] for _, place in transforms] == [
        [0, 18000, -950, -800],
        [0, 18000, -925, -775],
        [0, 18000, -875, -725],
    ]
    whole = volumes()
    np.testing.assert_allclose(levels[1][2, 1, 3, 4], whole[2, 1, 6:8, 8:10].mean(), rtol=1e-6)
    find = reader("v.zarr")
    assert find is not None
    ((layer, options, kind),) = find("v.zarr")
    assert kind == "image" and options["multiscale"] and [each.shape for each in layer] == [n.shape for n in levels]
    assert options["scale"] == [0.05, 1000, 50, 50] and options["translate"] == [0, 18000, -950, -800]
    assert options["axis_labels"] == ("t", "z", "y", "x") and options["units"] == ("s", "um", "um", "um")
    window = attributes["omero"]["channels"][0]["window"]
    assert window["min"] <= window["start"] < window["end"] <= window["max"] == whole[0].max()


def test_odd_ends_are_means_of_what_is_there():
    volume = np.arange(15, dtype=np.float32).reshape(1, 3, 5)
    np.testing.assert_allclose(halve(volume), [[[3, 5, 6.5], [10.5, 12.5, 14]]])


@pytest.mark.integration
def test_killed_and_resumed_is_as_if_nothing_had_happened(folder, run):
    frames = np.random.default_rng(1).integers(100, 3000, (60, 96, 80)).astype(np.uint16)
    save("rec.tif", frames)
    arguments = [sys.executable, "-m", "gs_jax", *command("rec.tif")]
    process = subprocess.Popen(arguments, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    journal = folder / "v.zarr" / JOURNAL
    deadline = time.monotonic() + 100
    while not (journal.exists() and journal.read_bytes().count(b"\n") > 2) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    whole = expected(frames)
    before = [json.loads(line)["frame"] for line in journal.read_text().splitlines()[1:]]
    # It opens, and has what it says that it has.
    assert len(before) >= 2
    np.testing.assert_allclose(volumes()[before], whole[before], rtol=1e-5)
    with journal.open("a") as file:
        file.write('{"frame": 59, "do')  # cut off within a line
    status, out, _ = run(*command("rec.tif"), "--resume")
    assert status == 0 and f"; {len(before)} were there" in out
    run(*command("rec.tif", output="w.zarr"))
    resumed, uninterrupted = files(folder / "v.zarr"), files(folder / "w.zarr")
    for each in (resumed, uninterrupted):
        attributes = json.loads(each.pop("zarr.json"))["attributes"]
        assert attributes["ome"]["multiscales"][0]["datasets"] and each.pop(JOURNAL).count(b"\n") == 61
    assert resumed.keys() == uninterrupted.keys()
    # What was killed computed the geometry in float32, the tests do in float64.
    np.testing.assert_allclose(volumes(), volumes("w.zarr"), rtol=1e-4)


@pytest.mark.integration
def test_bad_frames_are_named_and_made_when_they_are_good(folder, run):
    save("frames")
    good = (folder / "frames" / "f10.tif").read_bytes()
    (folder / "frames" / "f10.tif").write_bytes(good[:3000])
    tifffile.imwrite("frames/f8.tif", FRAMES[0, :50])
    (folder / "frames" / "notes.txt").touch()
    status, out, err = run(*command("frames"))
    assert status == 1 and "3 frames in" in out
    assert "gs-jax: frame 0 (f8.tif): " in err and "got 50 x 80 pixels" in err
    assert "gs-jax: frame 2 (f10.tif): " in err and "not a whole and valid TIFF" in err
    assert err.endswith("gs-jax: v.zarr: 2 of 5 frames failed and are empty: 0, 2; --resume tries them again\n")
    whole = expected()
    np.testing.assert_allclose(volumes()[[1, 3, 4]], whole[[1, 3, 4]], rtol=1e-5)
    assert not volumes()[[0, 2]].any()
    (folder / "frames" / "f10.tif").write_bytes(good)
    status, out, err = run(*command("frames"), "--resume")
    assert status == 1 and "1 frames in" in out and err.count("frame 0") == 1 and "1 of 5 frames failed" in err
    tifffile.imwrite("frames/f8.tif", FRAMES[0])
    assert run(*command("frames"), "--resume")[0] == 0
    np.testing.assert_allclose(volumes(), whole, rtol=1e-5)


def test_where_no_frame_is_good_nothing_is_written(folder, run):
    status, _, err = run(*command(save("rec.tif", FRAMES[:, :50])))
    assert status == 2 and "got 50 x 80 pixels" in err and not (folder / "v.zarr").exists()


@pytest.mark.integration
def test_an_unfinished_recording_is_not_lost(folder, run):
    save("frames")
    (folder / "frames" / "f10.tif").write_bytes(b"II*\0")
    run(*command("frames"))
    before = files(folder / "v.zarr")
    for options, words in (
        ((), "has 4 of 5 frames of an interrupted recording; give --resume"),
        (("--resume", "--optics", "pinhole"), "optics with --resume must be 'full', as before, got 'pinhole'"),
        (("--resume", "--frame-interval", "2"), "frame_interval with --resume must be none"),
    ):
        status, _, err = run(*command("frames"), *options)
        assert status == 2 and words in err
    tifffile.imwrite("frames/f99.tif", FRAMES[0])
    status, _, err = run(*command("frames"), "--resume")
    assert status == 2 and "names of frames" in err
    assert files(folder / "v.zarr") == before
    os.unlink("frames/f10.tif")
    status, _, err = run(*command("frames"), "--force")
    assert (status, err) == (0, "gs-jax: replaced v.zarr\n") and volumes().shape[0] == 5
    # What is finished is a result as others are.
    status, _, err = run(*command("frames"))
    assert (status, err) == (0, "gs-jax: replaced v.zarr\n")


@pytest.mark.integration
def test_points_of_all_frames_in_one_table(folder, run):
    save("rec.tif", bead_frames([[0.0], [], [0.2]]))
    how = ("--suppress", "clusters", "--points", "p.csv")
    assert run(*command("rec.tif", *how))[0] == 0
    header, *rows = (folder / "p.csv").read_text().splitlines()
    assert header == "x_mm,y_mm,z_mm,intensity,frame"
    found = np.array([row.split(",") for row in rows], float)
    assert set(found[:, 4]) == {0, 2}
    x = [found[found[:, 4] == frame][0, 0] for frame in (0, 2)]
    assert np.abs(np.array(x) - (0, 0.2)).max() < 0.051
    assert read_provenance("p.csv")["input rec.tif"].startswith("3 frames")
    # A frame alone has the same points.
    run(*command("rec.tif", *how[:2], "--page", "3", "--points", "q.csv", output="w.zarr"))
    alone = np.loadtxt(folder / "q.csv", delimiter=",", skiprows=1, ndmin=2)
    np.testing.assert_allclose(alone, found[found[:, 4] == 2, :4], rtol=1e-6)


@pytest.mark.integration
def test_an_accelerator_gets_counts_ahead(folder, run, monkeypatch):
    """The processor, in place of one."""
    copied = []

    def copy(device, counts):
        copied.append(machine.copy_to(device, counts))
        return copied[-1]

    monkeypatch.setattr("gs_jax.cli.recordings.accelerator", lambda: jax.devices()[0])
    monkeypatch.setattr("gs_jax.cli.recordings.copy_to", copy)
    frames = FRAMES // 100 + 100
    frames[2, 40, 40] = 65535  # filled from neighbours, and then no integer
    status, *_ = run(*command(save("rec.tif", frames)))
    assert status == 0 and [image.dtype.name for image in copied] == ["uint16"] * 4
    assert {image.sharding.memory_kind for image in copied} == {jax.devices()[0].default_memory().kind}
    kept = [0, 1, 3, 4]
    # Compiled for another type.
    np.testing.assert_allclose(volumes()[kept], expected(frames[kept]), rtol=1e-4)


def test_it_is_compiled_once(folder, run):
    """Also where a frame is repaired, and thus of another type."""
    frames = FRAMES // 100 + 100
    frames[2, 40, 40] = 65535
    save("rec.tif", frames)
    jitted: Any = gs.backproject
    compiled = jitted._cache_size()
    status, out, _ = run(*command("rec.tif", "--voxel-um", "61"))
    assert status == 0 and "1 frame: pixels filled from neighbours" in out
    assert jitted._cache_size() == compiled + 1


@pytest.mark.parametrize(
    "name, options, words",
    [
        ("rec.tif", ("-o", "v.ome.tif"), "rec.tif must be one image, got 5 pages: choose one by --page 1 to 5"),
        ("frames", ("-o", "v.ome.tif"), "-o must be VOLUME.zarr, which has a time axis, for 5 frames, got v.ome.tif"),
        ("empty", (), "empty: no captures; their files end in .tif"),
        ("no*.tif", (), "no*.tif: no captures"),
        ("capture.tif", ("--resume",), "--resume must be used with a recording, got a single capture capture.tif"),
        ("capture.tif", ("--frame-interval", "1"), "--frame-interval must be used with a recording"),
        ("capture.tif", (*WARM, "list-rl"), "--warm-start must be used with a recording"),
        ("rec.tif", (*WARM, "fista"), "--warm-start must be used with list-rl or richardson-lucy, got --method fista"),
        ("rec.tif", (*WARM, "list-rl", "--workers", "2"), "--warm-start must be used without --workers"),
        ("flat.zarr", (), "array must be (t, y, x), with axes of 1 alone between t and y, got 96 x 80"),
        ("deep.zarr", (), "got 5 x 3 x 96 x 80"),
        ("double.zarr", (), "got float64"),
        ("none.zarr", (), "none.zarr"),
        ("rec.zarr", ("-o", "rec.zarr"), "rec.zarr: cannot be written"),
    ],
)
def test_what_is_no_recording_is_said(folder, run, name, options, words):
    os.mkdir("empty")
    for each in ("frames", "rec.tif", "rec.zarr"):
        save(each)
    save("flat.zarr", FRAMES[0])
    save("deep.zarr", np.stack([FRAMES] * 3, 1))
    save("double.zarr", FRAMES.astype(float))
    status, _, err = run(*command(name, *options))
    assert status == 2 and words in err and len(err) < 400
    assert not any((folder / each).exists() for each in ("v.zarr", "v.ome.tif"))


def test_memory_is_bounded_and_work_overlaps(tmp_path):
    """However slow the disk is, few frames are read and none of many volumes waits."""
    alive, most, lock = 0, 0, threading.Lock()

    def count(by):
        nonlocal alive, most
        with lock:
            alive += by
            most = max(most, alive)

    class Slow(VolumeSeries):
        def write(self, frame, volume, note=None):
            time.sleep(0.01)
            super().write(frame, volume, note)
            count(-1)

    def read(frame):
        count(1)
        return frame

    grid = gs.Grid([20.0], (4, 4), 0.1)
    series = Slow(tmp_path / "v.zarr", 30, grid)
    reconstruct_frames(series, read, lambda frame, _: (np.full((1, 4, 4), frame + 1, np.float32), {}, None))
    assert volumes(tmp_path / "v.zarr")[:, 0, 0, 0].tolist() == list(range(1, 31))
    # Those being read ahead, one more to be asked for, one made and one being written.
    assert most <= PREFETCH + 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_whatever_ends_it_finished_frames_are_kept(tmp_path, error):
    grid = gs.Grid([20.0], (4, 4), 0.1)

    def make(frame, _):
        if frame == 6:
            raise error
        return np.full((1, 4, 4), frame + 1, np.float32), {}, None

    with pytest.raises(error if isinstance(error, type) else OSError):
        reconstruct_frames(VolumeSeries(tmp_path / "v.zarr", 9, grid), lambda frame: frame, make)
    series = VolumeSeries(tmp_path / "v.zarr", 9, grid, resume=True)
    assert series.finished >= set(range(5)) and series.unfinished[-3:] == [6, 7, 8]
    with pytest.raises(gs.InputError, match="with --resume must be"):
        VolumeSeries(tmp_path / "v.zarr", 8, grid, resume=True)


def test_a_full_disk_names_the_store(tmp_path):
    class Full:
        def __setitem__(self, *_):
            raise OSError(28, "No space left on device")

    grid = gs.Grid([20.0], (4, 4), 0.1)
    series = VolumeSeries(tmp_path / "v.zarr", 2, grid)
    series.write(0, np.zeros(grid.volume_shape, np.float32))
    series._levels = [Full()]
    with pytest.raises(OSError, match="No space left") as caught:
        series.write(1, np.zeros(grid.volume_shape, np.float32))
    assert caught.value.filename == str(tmp_path / "v.zarr")


@pytest.mark.slow
def test_memory_is_flat(folder):
    """Peak resident memory of 60 frames beside 10."""
    code = (
        "import sys; sys.argv = ['gs-jax', *sys.argv[1:]]\n"
        "from gs_jax.__main__ import main\n"
        "from gs_jax.base.machine import peak_memory\n"
        "try:\n    main()\nfinally:\n    print(peak_memory())"
    )
    peaks = []
    for count in (10, 60):
        save(f"{count}.tif", np.tile(FRAMES, (count // 5, 1, 1)))
        arguments = (*command(f"{count}.tif", "--voxel-um", "10", output=f"{count}.zarr"),)
        done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
        peaks.append(float(done.stdout.splitlines()[-1]))
    # 50 more volumes are 6 MiB each.
    assert peaks[1] - peaks[0] < 60 * 2**20


DEVICES = """
import sys
import numpy as np, jax
from gs_jax import Grid, read_design, reconstruct
from gs_jax.projection.backprojection import backproject_on_all_devices
from gs_jax.reconstruction.pipeline import BackProjection

imager = read_design("design.toml").imager()
image = np.random.default_rng(0).uniform(0, 100, imager.sensor.shape).astype(np.float32)
methods = BackProjection(), BackProjection(interpolation="nearest", normalize=True)
for count, method in ((1, methods[0]), (7, methods[1]), (50, methods[0])):
    grid = Grid.over(imager.sensor, depths=np.linspace(18, 22, count), pitch=0.05)
    np.save(f"{sys.argv[1]}-{count}.npy", reconstruct(image, imager, grid, method))
if jax.device_count() > 1:
    volume = backproject_on_all_devices(image, imager, grid.at(grid.depths[:7]))
    assert len(volume.sharding.device_set) == jax.device_count()
print(jax.device_count())
"""


def on_devices(devices: int, *arguments) -> str:
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.integration
def test_depths_on_three_devices(folder):
    """Also where two have none, where they have other numbers, and where there are several rounds."""
    for devices in (1, 3):
        assert on_devices(devices, "-c", DEVICES, str(devices)).strip() == str(devices)
    for count in (1, 7, 50):
        one, three = (np.load(folder / f"{devices}-{count}.npy") for devices in (1, 3))
        # Float32: a program of other shapes rounds otherwise.
        np.testing.assert_allclose(three, one, rtol=1e-5, atol=1e-5 * one.max())


# Names of files as data: their order, gaps in it, and names that are hard to write.


@pytest.mark.parametrize(
    "names",
    [
        ["f2", "f9", "f10", "f100"],
        ["z9mm", "z10.25mm", "z10.5mm", "z10.75mm", "z11mm"],
        ["z_-200um", "z_-100um", "z_-20.5um", "z_0um", "z_100um"],
        ["z-200um", "z-100um", "z0um", "z+50um", "z100um"],
        ["-3", "-2.5", "0", "+1", "2"],
        ["z10,25", "z10,5", "z11"],
        ["z10p25mm", "z10p5mm", "z11mm"],
        ["z=0.25", "z=0.5", "z=1.0", "z=9.75", "z=10.0"],
        ["z500um", "z0.9mm", "z1mm", "z0.2cm"],
        # A hyphen that joins, a point between two counts, dates and versions.
        ["run-2", "run-9", "run-10"],
        ["run1.8", "run1.9", "run1.10", "run2.1"],
        ["2024-9-30_f1", "2024-11-3_f10", "2024-11-28_f2"],
        ["v1.2.9", "v1.2.10", "v1.10.1"],
        ["a/f2", "a/f10", "b/f1"],
        ["f", "f1", "f1b", "g"],
    ],
)
def test_numbers_in_names_are_numbers(names):
    names = [f"{name}.tif" for name in names]
    shuffled = random.Random(0).sample(names, len(names))
    assert natural_order(shuffled) == names
    assert natural_order(map(Path, shuffled)) == list(map(Path, names))


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        (["f001.tif", "f002.tif", "f004.tif"], ("f002.tif", "f004.tif")),
        (["f1", "f3", "f5", "f9"], ("f5", "f9")),
        (["f1", "f3", "f5"], None),
        (["t_100", "t_151", "t_199"], None),
        (["a1", "b2", "c4"], None),
        (["f1_c1", "f2_c2", "f4_c4"], None),
        (["f1", "f3"], None),
        (["f1", "f1", "f3"], None),
    ],
)
def test_gaps(names, gap):
    assert first_gap(names) == gap


def test_a_gap_in_a_recording_is_told_where_time_matters(folder, run):
    os.mkdir("frames")
    for number in (1, 2, 4):
        tifffile.imwrite(f"frames/f00{number}.tif", FRAMES[0, :9])
    command = ("reconstruct", "frames", "design.toml", *OPTIONS, "-o", "v.zarr")
    _, _, err = run(*command, "--frame-interval", "0.1")
    assert "gs-jax: frames: captures are missing between f002.tif and f004.tif" in err
    assert "are missing" not in run(*command)[2]


def test_psfs_that_a_shell_sorted_are_told(tmp_path, run, monkeypatch):
    paths = [tmp_path / name for name in ("z10.25.tif", "z11.tif", "z9.tif")]
    for path in paths:
        tifffile.imwrite(path, FRAMES[0, :9])
    with pytest.warns(InputWarning, match="by their numbers z9.tif is the first, and z11.tif the last"):
        assert spot_names(paths) == ["z10.25.tif", "z11.tif", "z9.tif"]
    # A folder, and an order that is no shell's, are as they are meant.
    assert spot_names([tmp_path]) == ["z9.tif", "z10.25.tif", "z11.tif"]
    assert spot_names(paths[::-1])[0] == "z9.tif"
    # The command prints order and depths.
    monkeypatch.chdir(tmp_path)
    os.mkdir("psfs")
    for name in ("z_-100um", "z_100um", "z_0um"):
        tifffile.imwrite(f"psfs/{name}.tif", np.eye(16, dtype=np.float32))
    tifffile.imwrite("a.tif", np.ones((16, 16), np.float32))
    command = ("deconvolve", "a.tif", "psfs", "--method", "richardson-lucy", "--steps", "1", "-o", "v.ome.tif")
    out = run(*command, "--depths", "10:12:1")[1]
    assert "PSFs: z_-100um.tif at 10 mm, z_0um.tif at 11 mm, z_100um.tif at 12 mm\n" in out
    assert "z_-100um.tif is plane 1, z_0um.tif is plane 2" in run(*command)[1]


@pytest.mark.parametrize("pattern", ["run[1]/*.tif", "run[1]/f[12].tif", "run[1]", "*/f?.tif", "run[1]/../run[1]/**"])
def test_brackets_in_the_name_of_a_folder(tmp_path, pattern):
    os.mkdir(tmp_path / "run[1]")
    for number in (1, 2):
        tifffile.imwrite(tmp_path / "run[1]" / f"f{number}.tif", FRAMES[number, :9])
    with open_recording(tmp_path / pattern) as recording:
        assert recording is not None and recording.names == ["f1.tif", "f2.tif"]
        np.testing.assert_array_equal(next(recording.images(1, Selection())), FRAMES[2, :9])


def test_text_of_names():
    assert plain_text(os.fsdecode(b"caf\xe9\x07 \xc2\xb5m\t")) == "caf\\xe9\\x07 µm\t"
    assert plain_text("\ud800\ufffe") == "\\ud800\\ufffe"


@pytest.mark.parametrize("name", [os.fsdecode(b"caf\xe9"), "bell\x07", "two\nlines"])
@pytest.mark.parametrize("suffix", [".ome.tif", ".zarr"])
def test_volumes_of_any_name(tmp_path, name, suffix):
    path = tmp_path / f"{name}{suffix}"
    gs.write_volume(path, VOLUME, GRID, {"software": "test"})
    np.testing.assert_array_equal(gs.read_volume(path)[0], VOLUME)


def test_a_recording_of_any_name(folder, run):
    """With a journal to resume from, points, provenance and messages."""
    os.mkdir("frames")
    names = [os.fsdecode(b"caf\xe9 1.tif"), "bell\x07 2.tif"]
    for name, frame in zip(names, FRAMES, strict=False):
        tifffile.imwrite(f"frames/{name}", frame)
    os.rename("design.toml", design := os.fsdecode(b"d\xe9sign.toml"))
    command = ("reconstruct", "frames", design, *OPTIONS, "-o", output := os.fsdecode(b"v\xe9.zarr"))
    points = os.fsdecode(b"p\xe9.csv")
    status, out, err = run(*command, "--suppress", "points", "--points", points)
    assert status == 0, err
    assert "2 frames in" in out and volumes(output).shape[0] == 2
    (journal := json.loads(Path(output, JOURNAL).read_text().splitlines()[0]))["request"]
    assert journal["frames"] == 2
    assert "d\\xe9sign.toml" in read_provenance(points)["command"]
    more = ("--suppress", "points", "--points", points, "--resume", "--force")
    status, out, _ = run(*command, *more)
    assert status == 0 and "all frames were there" in out


# Recordings whose frames start from the volume of the one before.


STEPS = 16
WARM_GRID = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)


class Counted(gs.Progress):
    """Counts the steps of iterations."""

    steps = 0

    @contextmanager
    def counter(self, description, total, **_):
        self.steps = 1

        def advance():
            # The step that ends an iteration early is not counted.
            self.steps = min(self.steps + 1, total)

        yield advance


def scope():
    centers = gs.random_layout(16, (4.0, 4.0), seed=0)
    return gs.Imager(gs.MicrolensArray(centers), gs.Sensor((240, 240), 0.025), 5.8, 3.0)


def bar(place):
    """A bright bar at 20 mm, its column at `place` voxels, and the image of it."""
    volume = np.zeros(WARM_GRID.volume_shape, np.float32)
    volume[1, 12:28, place : place + 4] = 1
    image = np.asarray(gs.simulate(volume, scope(), WARM_GRID, optics="near", psf="geometric"))
    counts = np.random.default_rng(place).poisson(image * (2000 / image.max()))
    return volume, counts.astype(np.float32)


def alone(image, method, steps):
    return gs.reconstruct(image, scope(), WARM_GRID, dataclasses.replace(method, steps=steps), optics="near")


@pytest.mark.integration
@pytest.mark.parametrize("name", ["list-rl", "richardson-lucy"])
def test_frames_that_follow_need_fewer_steps(name):
    """A bar that stays or moves by a voxel is better than by as many steps afresh, and after a jump as by half."""
    method, counted = METHODS[name](STEPS), Counted()
    reconstructor = gs.Reconstructor(scope(), WARM_GRID, method, "near")
    volume, last = follow_volume(reconstructor, bar(10)[1], None, counted)
    np.testing.assert_array_equal(volume, alone(bar(10)[1], method, STEPS))
    for place, share in ((10, 1), (11, 1), (28, 2)):
        truth, image = bar(place)
        volume, last = follow_volume(reconstructor, image, last, counted)
        found = gs.quality(volume, truth).psnr_db
        assert counted.steps < STEPS or place == 28
        afresh = alone(image, method, counted.steps // share)
        assert found > gs.quality(afresh, truth).psnr_db, (place, counted.steps)


@pytest.mark.integration
@pytest.mark.parametrize("level", [0.0, 3.0])
def test_what_follows_a_dark_frame_starts_afresh(level):
    """Without light, or with read noise alone, whose sum may be negative."""
    method, (_, image) = METHODS["richardson-lucy"](4), bar(10)
    reconstructor, last = gs.Reconstructor(scope(), WARM_GRID, method, "near"), None
    dark = np.random.default_rng(0).normal(0, level, image.shape).astype(np.float32)
    for frame in (image, dark, image):
        volume, last = follow_volume(reconstructor, frame, last, gs.Progress())
        np.testing.assert_array_equal(volume, alone(frame, method, 4))


@pytest.mark.integration
def test_a_recording_takes_the_option(folder, run):
    frames = np.random.default_rng(0).integers(100, 3000, (1, 96, 80)).repeat(3, 0).astype(np.uint16)
    how = ("--method", "list-rl", "--steps", "8")
    run(*command(save("rec.tif", frames), *how))
    status, _, _ = run(*command("rec.tif", *how, "--warm-start", output="w.zarr"))
    cold, warm = volumes(), volumes("w.zarr")
    assert status == 0 and (warm[0] == cold[0]).all()
    assert (warm[1] != cold[1]).any() and (warm[2] > 0).any()
