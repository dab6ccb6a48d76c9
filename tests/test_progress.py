"""How far long work is, on a terminal and in a pipe."""

import math
import re
import subprocess
import sys

import psutil
import pytest

from gs_jax.base import machine, progress as module
from gs_jax.base.progress import QUIET, VERBOSE, CancellableProgress, Cancelled, Progress, verbosity

from .test_cli import RECONSTRUCT


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
    for level, said in ((QUIET, ""), (VERBOSE, "gs-jax: Reading: 2, 12 s\n")):
        token = verbosity.set(level)
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
