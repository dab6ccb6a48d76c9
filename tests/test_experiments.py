"""The command line that the experiments share."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.table import Table

from experiments import peers, table1
from experiments.common import Report, main, table, write
from gs_jax.base.progress import Progress

pytestmark = pytest.mark.integration

SCRIPTS = [
    path.stem
    for path in sorted(Path(table1.__file__).parent.glob("*.py"))
    if "main(report" in path.read_text() and path.stem != "common"
]


def small(progress, data: Path | None = None, rounds: int = 3) -> Report:
    with progress.step("Working"):
        figure = Figure(figsize=(2, 1), dpi=50)
        numbers = {"data": str(data), "rounds": rounds, "array": np.arange(2), "nothing": np.nan}
    return Report({"a.json": numbers, "a.md": "# A\n", "a.png": figure}, [table("xy", [("1", "2")]), "the end"])


def test_an_experiment_writes_its_files_and_prints_its_tables(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["small", "here", "--rounds", "5", "--out", str(tmp_path / "new" / "folder")])
    main(small, {"data": {"type": Path, "nargs": "?"}, "--rounds": {"type": int}})
    found = json.loads((tmp_path / "new" / "folder" / "a.json").read_text())
    assert found == {"data": "here", "rounds": 5, "array": [0, 1], "nothing": None}
    assert (tmp_path / "new" / "folder" / "a.md").read_text() == "# A\n"
    assert (tmp_path / "new" / "folder" / "a.png").read_bytes()[16:24] == bytes([0, 0, 0, 100, 0, 0, 0, 50])
    assert "the end" in capsys.readouterr().out


def test_files_go_below_out_by_the_name_of_the_script(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["table1"])
    main(table1.report)
    assert {path.name for path in (tmp_path / "out" / "table1").iterdir()} == {"table1.json", "table1.md"}
    assert all(isinstance(each, Table) for each in table1.report(Progress()).shown)


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    (tmp_path / "a.json").write_text("old")
    with pytest.raises(TypeError):
        write(tmp_path, Report({"a.json": {"a": object()}}))
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"] and (tmp_path / "a.json").read_text() == "old"


def test_ratios_of_steps_are_of_the_same_round():
    """The machine is twice as slow in the second round, and three times in the third."""
    step = {"processor_seconds": [1.0], "peak_mib": 1.0, "objectives": [3.0, 2.0], "versions": "a 1"}
    codes = {"gs_jax FISTA": 1.0, "peer FISTA": 0.5}
    rounds = [
        {name: step | {"seconds": np.cumsum(3 * [load * seconds])} for name, seconds in codes.items()}
        for load in (1.0, 2.0, 3.0)
    ]
    ours, theirs = peers.step_rows(rounds)
    assert (ours["seconds_a_step"], ours["over_ours"]) == (2.0, 1.0)
    assert (theirs["code"], theirs["method"], theirs["seconds_a_step"]) == ("peer", "FISTA", 1.0)
    assert (theirs["over_ours"], theirs["objective"]) == (0.5, 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_explains_itself(script):
    done = subprocess.run([sys.executable, "-m", f"experiments.{script}", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "--out" in done.stdout, done.stderr
