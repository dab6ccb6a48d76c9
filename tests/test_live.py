"""Captures that become volumes while they come: which first, which again, and what a run after this finds."""

import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import tifffile

from gs_jax import Grid, InputError
from gs_jax.base import machine, progress as module
from gs_jax.base.errors import InputError as InputError
from gs_jax.base.progress import QUIET, VERBOSE, CancellableProgress, Cancelled, Progress, verbosity
from gs_jax.base.workers import Workers
from gs_jax.cli.recordings import _State
from gs_jax.io.captures import read_capture
from gs_jax.io.volume_series import JOURNAL, VolumeSeries, check_replaceable, read_series
from gs_jax.io.watched_folder import WatchedFolder
from gs_jax.reconstruction import recording as live

from .test_cli import RECONSTRUCT
from .test_recording import FRAMES, OPTIONS, command, expected, files, level, save, volumes

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
        (WATCH[0], "capture.tif", *WATCH[2:]): "capture.tif must be a folder to be watched, got a file",
        (WATCH[0], "none", *WATCH[2:]): "none must be a folder to be watched, got none",
    }.items():
        status, out, err = run(*arguments)
        assert (status, out) == (2, "") and words in err and err.count("\n") == 1
    monkeypatch.setitem(sys.modules, "watchfiles", None)
    status, _, err = run(*WATCH)
    assert status == 2 and "pip install 'gs-jax[live]'" in err and err.count("\n") == 1
    assert not os.path.exists("v.zarr")


# Jobs that other processes do: the same results, whoever does them and whoever dies.


pytestmark = pytest.mark.integration


distributed = pytest.importorskip("distributed", reason="needs pip install 'gs-jax[cluster]'")


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


def squares(path: Path):
    """Notes who makes it; the job 7 ends its worker the first time."""
    with open(path / "made", "a") as file:
        file.write(f"{os.getpid()}\n")

    def square(number):
        if number == 7 and not (path / "killed").exists():
            (path / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 5:
            raise InputError("found five.")
        return number**2, os.getpid()

    return square


def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(two, tmp_path):
    found, refused = {}, []
    for number, result in two.mapper(partial(squares, tmp_path))(range(40)):
        try:
            found[number] = result()
        except InputError as error:
            refused.append(str(error))
    assert {number: square for number, (square, _) in found.items()} == {n: n**2 for n in range(40) if n != 5}
    assert refused == ["found five."] and (tmp_path / "killed").exists()
    # Each worker makes the function once: two, and the one that came for another.
    made = (tmp_path / "made").read_text().split()
    assert len(made) == len(set(made)) <= 3 and {str(process) for _, process in found.values()} <= set(made)
    assert str(os.getpid()) not in made


def settings():
    import jax

    return lambda _: (str(jax.numpy.zeros(()).dtype), os.getcwd(), os.environ["NPROC"])


def test_workers_share_the_cores_and_have_this_process_settings(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ((_, result),) = two.mapper(settings)([0])
    dtype, where, threads = result()
    assert (dtype, where) == ("float64", str(tmp_path)) and 2 * int(threads) <= max(2, os.cpu_count() or 1)


def test_no_more_is_taken_than_is_needed(two):
    """However long the recording is."""
    taken = []

    def items():
        for number in range(30):
            taken.append(number)
            yield number

    for done, (_, result) in enumerate(two.mapper(settings)(items())):
        assert result() and len(taken) - done <= 5


def test_in_this_process_jobs_are_done_one_by_one():
    done = []
    with Workers() as workers:
        for number, result in workers.mapper(lambda: done.append)([1, 2]):
            assert len(done) == number - 1
            result()
    assert done == [1, 2] and not Workers().remote


def test_nothing_of_dask_is_imported_unless_it_is_asked_for(folder):
    save("rec.tif", FRAMES[:1].repeat(2, 0))
    code = (
        f"import sys; sys.argv = ['gs-jax', *{command('rec.tif')!r}]\n"
        "from gs_jax.__main__ import main\n"
        "try:\n    main()\nfinally:\n    assert not {'dask', 'distributed', 'trackpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr


def test_what_cannot_work_is_one_line(folder, run, monkeypatch):
    save("rec.tif")
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        monkeypatch.setattr("gs_jax.base.workers._ANSWER", 0.5)
        for options, words in (
            (
                ("--scheduler", address),
                f"--scheduler: no Dask scheduler is reachable at {address}",
            ),
            (("--scheduler", "nowhere"), "--scheduler: no Dask scheduler is reachable at nowhere"),
            (("--scheduler", address, "--workers", "2"), "--workers must not be given together with --scheduler"),
        ):
            status, _, err = run(*command("rec.tif", *options))
            assert status == 2 and words in err and err.count("\n") == 1
    status, _, err = run(*command("capture.tif", "--workers", "2"))
    assert status == 2 and "--workers or --scheduler must be used with a recording" in err
    monkeypatch.setitem(sys.modules, "distributed", None)
    status, _, err = run(*command("rec.tif", "--workers", "2"))
    assert (status, err) == (
        2,
        "gs-jax: distributed is not installed; it comes with pip install 'gs-jax[cluster]'.\n",
    )
    assert not (folder / "v.zarr").exists()


def started(*options):
    """The command as a process, when a few frames of it are written; and its workers."""
    arguments = [sys.executable, "-m", "gs_jax", *command("rec.tif", *options)]
    process = psutil.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    journal, deadline = Path("v.zarr") / JOURNAL, time.monotonic() + 200
    while not (journal.exists() and journal.read_bytes().count(b"\n") > 3) and time.monotonic() < deadline:
        time.sleep(0.01)
    children = process.children(recursive=True)
    return process, [each for each in children if "spawn_main" in " ".join(each.cmdline())]


def numbers():
    """Of the frames in the journal, in its order."""
    return [json.loads(line)["frame"] for line in (Path("v.zarr") / JOURNAL).read_text().splitlines()[1:]]


def test_a_recording_by_workers_one_of_which_is_killed(folder):
    """The same bytes as by one process, each frame once."""
    frames = np.random.default_rng(1).integers(101, 130, (60, 96, 80)).astype(np.uint16)
    frames[50, 40, 40] = 65535
    save("rec.tif", frames)
    process, workers = started("--workers", "2", "--suppress", "clusters", "--points", "p.csv")
    workers[0].kill()
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0 and "60 frames in" in out and "Traceback" not in err, err
    assert "1 frame: pixels filled from neighbours" in out and sorted(numbers()) == list(range(60))
    by_two, points = files(folder / "v.zarr"), (folder / "p.csv").read_bytes()
    arguments = command("rec.tif", "--suppress", "clusters", "--points", "p.csv", "--force")
    subprocess.run([sys.executable, "-m", "gs_jax", *arguments], check=True, capture_output=True)
    by_one = files(folder / "v.zarr")
    for each in (by_two, by_one):
        each.pop(JOURNAL)
        # It says by which command, and what is shown is as bright as the first volume that was done.
        each.pop("zarr.json")
    assert by_two == by_one and points == (folder / "p.csv").read_bytes()


def test_ctrl_c_stops_all_and_the_rest_is_made_by_others(folder, run, monkeypatch):
    # Enough to be interrupted: a frame takes some milliseconds.
    count = 900
    frames = np.random.default_rng(2).integers(100, 3000, (count, 96, 80)).astype(np.uint16)
    save("rec.tif", frames)
    process, workers = started("--workers", "2")
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err, err
    assert err.endswith("gs-jax: interrupted; v.zarr has what is done, and --resume goes on from it\n")
    assert not psutil.wait_procs(workers, timeout=20)[1]
    before = numbers()
    # What it says that it has is there.
    assert len(before) >= 3 and volumes()[before].any((1, 2, 3)).all()
    monkeypatch.setattr("gs_jax.base.workers._ANSWER", 60)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        arguments = command("rec.tif", "--resume", "--scheduler", cluster.scheduler_address)
        status, out, _ = run(*arguments)
    assert status == 0 and f"{count - len(before)} frames in" in out and sorted(numbers()) == list(range(count))
    assert volumes().any((1, 2, 3)).all()


# How far long work is, on a terminal and in a pipe.


@pytest.fixture(autouse=True)
def _lines_come_as_a_user_gets_them(monkeypatch):
    monkeypatch.setattr(module, "_EVERY", 10.0)
    monkeypatch.setattr(module, "_MEASURED", 3.0)


@pytest.fixture
def clock(monkeypatch):
    """Four seconds pass each time that it is read."""
    times = map(float, range(0, 10_000, 4))
    monkeypatch.setattr(module.time, "monotonic", lambda: next(times))


def test_a_pipe_gets_a_line_now_and_then(clock, capsys):
    with Progress() as progress:
        assert list(progress.track(range(8), "Imaging")) == list(range(8))
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines() == [
        "gs-jax: Imaging: 3 of 8, 12 s, about 20 s left",
        "gs-jax: Imaging: 6 of 8, 24 s, about 8 s left",
    ]


def test_work_of_unknown_length_has_no_forecast(clock, capsys):
    with Progress() as progress:
        assert list(progress.track(iter("abc"), "Reading")) == ["a", "b", "c"]
    assert capsys.readouterr().err == "gs-jax: Reading: 3, 12 s\n"


def test_short_work_and_what_is_not_entered_are_silent(capsys):
    with Progress() as progress, progress.step("Writing"):
        pass
    assert list(Progress().track(range(3), "Imaging")) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar_with_count_and_time_left(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Progress() as progress:
        list(progress.track(range(5), "Imaging"))
    err = capsys.readouterr().err
    assert "Imaging" in err and "5/5" in err and "left:" in err


def test_how_much_is_shown(clock, capsys):
    for shown, said in ((QUIET, ""), (VERBOSE, "gs-jax: Reading: 2, 12 s\n")):
        token = verbosity.set(shown)
        with Progress() as progress:
            list(progress.track(iter("ab"), "Reading"))
        verbosity.reset(token)
        assert capsys.readouterr().err == said


def test_work_over_a_minute_is_announced(clock, capsys, monkeypatch):
    monkeypatch.setattr(module, "peak_memory", lambda: 2.9 * 2**30)
    for count, quarter, said in ((20, "", "80 s in all"), (600, "--voxel-um 80", "40 min in all")):
        with Progress() as progress:
            list(progress.track(range(count), "Iterating", quarter=quarter))
        wanted = f"gs-jax: Iterating: about {said}, 2.9 GiB of memory" + (
            f"; {quarter}: about 10 min" if quarter else ""
        )
        assert capsys.readouterr().err.splitlines()[0] == wanted


@pytest.mark.parametrize("status", ["Name:\tpython\nThreads:\t4\n", None])
def test_memory_where_proc_does_not_tell_it(status, monkeypatch, tmp_path):
    """Without `VmHWM`, and without `/proc`."""
    file = tmp_path / "status"
    if status:
        file.write_text(status, encoding="utf-8")
    monkeypatch.setattr(machine, "Path", lambda _: file)
    assert math.isnan(machine.status_mib("VmRSS"))
    now = psutil.Process().memory_info().rss
    # The kernel counts pages of threads late; the process that started this one may have had more.
    assert 0.9 * now < machine.peak_memory() < 100 * now


def test_what_compiles_or_waits_once_is_not_taken_for_usual(monkeypatch, capsys):
    """As of a recording: the first frame compiles for 20 s, the second waits a second for the first to be written."""
    times = iter([0.0, 20.0, 21.0, *(21.0 + 0.1 * n for n in range(1, 5000))])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(times))
    monkeypatch.setattr(module, "peak_memory", lambda: 2**30)
    with Progress() as progress:
        list(progress.track(range(800), "Reconstructing"))
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if "in all" in line]
    assert said == ["gs-jax: Reconstructing: about 80 s in all, 1 GiB of memory"]
    # After the line for the first frame, which knows no better.
    assert all(int(left) <= 80 for left in re.findall(r"about (\d+) s left", "\n".join(lines[1:])))


def test_another_thread_sees_it_and_ends_it(monkeypatch, capsys):
    """The innermost piece of work; after a part, or before the next piece."""
    times = map(float, range(0, 100, 2))
    monkeypatch.setattr(module.time, "monotonic", lambda: next(times))
    seen, ends = [], False
    progress = CancellableProgress(lambda: ends)
    assert progress.state == ("", 0, None)
    with pytest.raises(Cancelled), progress.step("Reconstructing"):
        seen.append(progress.state)
        for number in progress.track(range(5), "Iterating"):
            seen.append(progress.state)
            ends = number == 2
    assert seen == [
        ("Reconstructing", 0, None),
        ("Iterating: 0 of 5", 0, 5),
        ("Iterating: 1 of 5", 1, 5),
        ("Iterating: 2 of 5, about 6 s left", 2, 5),
    ]
    assert progress.state == ("", 0, None) and capsys.readouterr().err == ""
    with pytest.raises(Cancelled), progress.step("Writing"):
        seen.append("not reached")
    assert "not reached" not in seen


def test_the_terminal_announces_it_too(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(module, "_LONG", 0.0)
    monkeypatch.setattr(module, "_MEASURED", 0.0)
    with Progress() as progress:
        list(progress.track(range(3), "Imaging"))
    assert "Imaging: about" in capsys.readouterr().err


@pytest.mark.integration
@pytest.mark.parametrize("method", ["list-rl", "admm"])
def test_the_memory_that_is_announced_is_what_is_taken(folder, method):
    """By the kernel's count at the end, within a factor of two; and the voxels named are twice as wide."""
    arguments = ["gs-jax", *RECONSTRUCT, "--method", method, "--steps", "4", "--voxel-um", "50", "-o", "v.ome.tif"]
    code = (
        "import sys; from gs_jax.base import progress, machine; from gs_jax.__main__ import main\n"
        f"progress._LONG = progress._MEASURED = 0; sys.argv = {arguments!r}\n"
        "try:\n    main()\nfinally:\n    print(machine.peak_memory() / 2**30)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    line = next(line for line in done.stderr.splitlines() if "Iterating: about" in line)
    announced = float(re.findall(r"([\d.]+) GiB of memory; --voxel-um 100: about", line)[0])
    taken = float(done.stdout.splitlines()[-1])
    assert taken / 2 <= announced <= 2 * taken and taken > 0.1
