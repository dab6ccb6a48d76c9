"""How far long work is, on a terminal and in a pipe."""

import pytest

from gs_jax.base import progress as module
from gs_jax.base.progress import QUIET, VERBOSE, Progress, shown


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
        token = shown.set(level)
        with Progress() as progress:
            list(progress.track(iter("ab"), "Reading"))
        shown.reset(token)
        assert capsys.readouterr().err == said


def test_work_over_a_minute_is_announced(clock, capsys):
    with Progress() as progress:
        list(progress.track(range(20), "Iterating"))
    assert capsys.readouterr().err.splitlines()[0] == "gs-jax: Iterating: about 1 min in all"
