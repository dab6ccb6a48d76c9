"""Captures that become volumes while they come: which first, which again, and what a run after this finds."""

import json
import os
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from gs_jax import Grid, InputError
from gs_jax.cli.recordings import _State
from gs_jax.io.captures import read_capture
from gs_jax.io.ngff import JOURNAL, VolumeSeries, check_replaceable, read_series
from gs_jax.io.recordings import WatchedFolder
from gs_jax.reconstruction import recording as live

from .test_recording import FRAMES, OPTIONS, expected, level, volumes

pytest.importorskip("watchfiles", reason="no watchfiles: pip install 'gs-jax[live]'")

GRID = Grid([18.0, 20.0], (3, 4), 0.05)
# Longer than any event of a busy machine takes, seconds.
_LONGEST = 30


def image_of(number: int) -> np.ndarray:
    return np.full((3, 4), number, np.float32)


class Camera:
    """Writes captures into a folder, and tells `reconstruct_live` of them step by step."""

    def __init__(self, path: Path, *steps: Any):
        self.folder, self.steps, self.read = path / "run", list(steps), []
        self.folder.mkdir(exist_ok=True)

    def changes(self, timeout: float) -> Any:
        assert timeout < live.SETTLED + 1
        step: Any = self.steps.pop(0) if self.steps else None
        if step is None or callable(step):
            return step and step()
        for number in step:
            np.save(self.folder / f"f{number}.npy", image_of(number))
        return [f"f{number}.npy" for number in step]

    def run(self, series: VolumeSeries, **calls) -> None:
        def read(frame):
            self.read.append(series.names[frame])
            return read_capture(self.folder / series.names[frame])

        make = lambda image, _: (np.stack([image, 2 * image]), {"mean": float(image.mean())}, None)
        live.reconstruct_live(series, self.folder, self.changes, read, make, **calls)


def series_in(path: Path, **options) -> VolumeSeries:
    return VolumeSeries(path / "v.zarr", None, GRID, **options)


def test_the_newest_is_made_first_and_frames_are_in_the_order_in_which_they_came(tmp_path):
    series, done = series_in(tmp_path), []
    camera = Camera(tmp_path, [1, 2, 3], [4], [], [], [])
    camera.run(series, on_done=done.append)
    assert camera.read == ["f3.npy", "f4.npy", "f2.npy", "f1.npy"] and series.names == [
        f"f{n}.npy" for n in (1, 2, 3, 4)
    ]
    np.testing.assert_array_equal(level(tmp_path / "v.zarr")[:, 0, 0, 0], [1, 2, 3, 4])
    assert [each.frame for each in done] == [2, 3, 1, 0] and [each.waiting for each in done] == [2, 2, 1, 0]
    assert all(0 <= each.delay < _LONGEST for each in done)
    assert [(frame, note["mean"]) for frame, note in series.notes()] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    store = read_series(tmp_path / "v.zarr")
    assert store is not None and store.levels[0].shape == (4, 2, 3, 4)


def test_a_capture_that_is_being_written_is_read_again(tmp_path):
    series, failures = series_in(tmp_path), []
    path = tmp_path / "run" / "f1.npy"

    def half():
        np.save(path, image_of(1))
        whole.append(path.read_bytes())
        path.write_bytes(whole[0][:-20])
        return ["f1.npy"]

    def rest():
        path.write_bytes(whole[0])
        return ["f1.npy"]

    whole = []
    Camera(tmp_path, half, [], rest).run(series, on_failure=lambda *failed: failures.append(failed))
    assert series.finished == {0} and not failures and not series.failed


def test_a_bad_capture_is_given_up_and_made_when_it_is_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "SETTLED", 0.05)
    series, failures = series_in(tmp_path), []

    def bad():
        (tmp_path / "run" / "f1.npy").write_bytes(b"no capture")
        return ["f1.npy"]

    pause = lambda: time.sleep(0.06) or []
    camera = Camera(tmp_path, bad, [2], pause, [], [], [1])
    camera.run(series, on_failure=lambda *failed: failures.append(failed))
    ((frame, reason),) = failures
    assert frame == 0 and "f1.npy: not a whole and valid .npy" in reason
    assert series.finished == {0, 1} and not series.failed
    lines = [json.loads(line) for line in (tmp_path / "v.zarr" / JOURNAL).read_text().splitlines()]
    assert [("error" in line, line["frame"]) for line in lines[1:] if "name" not in line] == [
        (False, 1),
        (True, 0),
        (False, 0),
    ]


def test_a_capture_that_is_written_again_replaces_its_volume(tmp_path):
    """As one whose program first makes a file of the full size, and then fills it."""
    series = series_in(tmp_path)

    def again():
        np.save(tmp_path / "run" / "f1.npy", image_of(7))
        os.utime(tmp_path / "run" / "f1.npy", (1e9, 1e9))
        return ["f1.npy"]

    camera = Camera(tmp_path, [1], lambda: ["f1.npy"], again)
    camera.run(series)
    assert camera.read == ["f1.npy", "f1.npy"]
    np.testing.assert_array_equal(level(tmp_path / "v.zarr")[:, 0, 0, 0], [7])


@pytest.mark.parametrize("how", ["renamed over it", "later", "again and again"])
def test_a_name_that_is_overwritten_is_a_new_frame(tmp_path, how):
    """As by programs that always write the newest capture to one name."""
    series, path = series_in(tmp_path), tmp_path / "run" / "f1.npy"

    def overwritten(number, before):
        def step():
            written = path.with_name(".f.npy") if how == "renamed over it" else path
            np.save(written, image_of(number))
            written.replace(path)
            # A minute after the last one, or at once.
            at = before.get("at", time.time()) + (60 if how == "later" else 1e-3)
            os.utime(path, (at, at))
            before["at"] = at
            return ["f1.npy"]

        return step

    times = {}
    Camera(tmp_path, [1], *(overwritten(number, times) for number in (2, 3, 4))).run(series)
    # One that is written in place at once may be a file that is filled after it is made.
    expected = [2, 3, 4] if how == "again and again" else [1, 2, 3, 4]
    np.testing.assert_array_equal(level(tmp_path / "v.zarr")[:, 0, 0, 0], expected)
    assert series.names == ["f1.npy"] * len(expected)
    # A later run takes what is written while it lasts.
    resumed = series_in(tmp_path, resume=True)
    Camera(tmp_path, lambda: ["f1.npy"], overwritten(5, {"at": times["at"] + 60})).run(resumed)
    np.testing.assert_array_equal(level(tmp_path / "v.zarr")[:, 0, 0, 0], [*expected, 5])


def test_a_bad_capture_over_a_good_one_keeps_its_volume(tmp_path):
    series = series_in(tmp_path)

    def bad():
        (tmp_path / "run" / "f1.npy").write_bytes(b"no capture")
        os.utime(tmp_path / "run" / "f1.npy", (1e9, 1e9))
        return ["f1.npy"]

    Camera(tmp_path, [1], bad).run(series)
    assert series.finished == {0} and list(series.failed) == [0]
    series.add("f2.npy")
    assert _State(0).summary(series)[-1] == "1 capture has no volume; --resume makes it"


def test_resume_goes_on(tmp_path):
    Camera(tmp_path, [1, 2, 3]).run(series_in(tmp_path))
    with pytest.raises(InputError, match="v.zarr: has 1 frame of a watched folder; give --resume"):
        check_replaceable(tmp_path / "v.zarr")
    series = series_in(tmp_path, resume=True)
    assert series.names == ["f1.npy", "f2.npy", "f3.npy"] and series.finished == {2} and series.count == 3
    camera = Camera(tmp_path, lambda: ["f1.npy", "f2.npy", "f3.npy"], [5], [], [])
    camera.run(series)
    assert camera.read == ["f2.npy", "f5.npy", "f1.npy"]
    np.testing.assert_array_equal(level(tmp_path / "v.zarr")[:, 0, 0, 0], [1, 2, 3, 5])
    with pytest.raises(
        InputError, match="frames with --resume must be 'those of a watched folder', as before, got '4'"
    ):
        VolumeSeries(tmp_path / "v.zarr", 4, GRID, resume=True)


def test_an_error_of_the_disk_ends_it(tmp_path, monkeypatch):
    series = series_in(tmp_path)
    monkeypatch.setattr(VolumeSeries, "write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    quiet = lambda: time.sleep(0.05) or []
    with pytest.raises(OSError, match="No space left"):
        Camera(tmp_path, [1], quiet, quiet, quiet, *100 * [quiet]).run(series)


def test_a_folder_tells_what_comes(tmp_path):
    np.save(tmp_path / "f9.npy", image_of(9))
    np.save(tmp_path / "f10.npy", image_of(10))
    (tmp_path / "inside").mkdir()

    def told(name, last=_LONGEST):
        began, found = time.monotonic(), []
        while name not in found and time.monotonic() - began < last:
            found += watched.changes(0.1)
        return found

    with WatchedFolder(tmp_path) as watched:
        first = told("f10.npy")
        assert list(dict.fromkeys(first)) == ["f9.npy", "f10.npy"]
        (tmp_path / "notes.txt").write_text("no capture")
        np.save(tmp_path / "inside" / "f12.npy", image_of(12))
        np.save(tmp_path / ".f11.npy", image_of(11))
        (tmp_path / ".f11.npy").rename(tmp_path / "f11.npy")
        # A name may be told twice.
        assert "f11.npy" in (names := told("f11.npy")) and {*names} <= {"f9.npy", "f10.npy", "f11.npy"}
        # What is told from here on is of what is written from here on.
        while watched.changes(0.2):
            pass
        with open(tmp_path / "f11.npy", "ab") as file:
            file.write(b"more")
        assert "f11.npy" in told("f11.npy")
        # Captures that are deleted are not told.
        (tmp_path / "f9.npy").unlink()
        np.save(tmp_path / ".f13.npy", image_of(13))
        (tmp_path / ".f13.npy").rename(tmp_path / "f13.npy")
        assert "f13.npy" in (names := told("f13.npy")) and {*names} <= {"f11.npy", "f13.npy"}


WATCH = ("reconstruct", "run", "design.toml", *OPTIONS, "--watch", "-o", "v.zarr")


class Steps:
    """What `WatchedFolder.changes` returns in turn: names of captures that are written then, and Ctrl-C at the end."""

    def __init__(self, *steps):
        self.steps = list(steps)
        os.makedirs("run", exist_ok=True)

    def __call__(self, timeout):
        if not self.steps:
            raise KeyboardInterrupt
        names = self.steps.pop(0)
        for name in names:
            tifffile.imwrite(f"run/{name}", FRAMES[0, :9] if name == "f3.tif" else FRAMES[int(name[1])])
            # A minute ago, so that a bad one is not waited for.
            past = time.time() - 60
            os.utime(f"run/{name}", (past, past))
        return names


def watch(run, monkeypatch, steps, *arguments):
    monkeypatch.setattr(WatchedFolder, "changes", steps)
    return run(*WATCH, *arguments)


def test_the_command(folder, run, monkeypatch):
    """Two runs, each ended by Ctrl-C: volumes are those of a recording."""
    status, out, err = watch(run, monkeypatch, Steps(["f0.tif"], ["f1.tif", "f2.tif"]))
    assert status == 130 and "run: watched until Ctrl-C" in err
    assert err.splitlines()[-1] == "gs-jax: interrupted; v.zarr has what is done, and --resume goes on from it"
    assert "v.zarr: 2 frames of 3\n" in out and "v.zarr: 1 capture has no volume; --resume makes it\n" in out
    assert re.search(r"from a capture's last byte to its volume: \d\d s at the median, \d\d s in 95 %", out)
    status, _, err = watch(run, monkeypatch, Steps())
    assert status == 2 and "has 2 frames of a watched folder; give --resume" in err
    status, out, err = watch(run, monkeypatch, Steps(["f3.tif", "f4.tif"], [], []), "--resume")
    assert status == 130 and "gs-jax: frame 3 (f3.tif): " in err
    assert "v.zarr: 2 frames of 5; 2 were there" in out and "1 capture has no volume, 1 failed" in out
    made = volumes()
    assert not made[3].any()
    np.testing.assert_allclose(np.delete(made, 3, 0), np.delete(expected(), 3, 0), rtol=1e-5)


@pytest.mark.integration
def test_points_are_written_with_the_volumes(folder, run, monkeypatch):
    status, _, _ = watch(run, monkeypatch, Steps(["f0.tif"], [], []), "--points", "p.csv")
    assert status == 130 and (folder / "p.csv").read_text().startswith("x_mm,y_mm,z_mm,intensity,frame")


def test_wrong_input_is_one_line(folder, run, monkeypatch):
    os.mkdir("run")
    last = WATCH[:-1]
    for arguments, words in {
        (*last, "v.tif"): "-o must be VOLUME.zarr, which grows in time, with --watch, got v.tif",
        (*WATCH, "--workers", "2"): "--workers and --scheduler must not be given with --watch",
        (*WATCH, "--method", "surface", "--surface", "s.ply"): "--surface must be used with a single capture",
        (*WATCH, "--score"): "--score must be used with a single capture",
        (*WATCH, "--deviation", "d.tif"): "--deviation must be used with a single capture",
        (WATCH[0], "capture.tif", *WATCH[2:]): "capture.tif must be a folder to be watched, got a file",
        (WATCH[0], "none", *WATCH[2:]): "none must be a folder to be watched, got none",
    }.items():
        status, out, err = run(*arguments)
        assert (status, out) == (2, "") and words in err and err.count("\n") == 1
    monkeypatch.setitem(sys.modules, "watchfiles", None)
    status, _, err = run(*WATCH)
    assert status == 2 and "pip install 'gs-jax[live]'" in err and err.count("\n") == 1
    assert not os.path.exists("v.zarr")
