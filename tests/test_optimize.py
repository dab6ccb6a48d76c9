"""The commands, apart from the list of commands."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from gs_jax.base.errors import InputError
from gs_jax.cli.designs import optimize_command as optimize, pareto_command as pareto
from gs_jax.codesign import terms
from gs_jax.design.design import read_design, write_design
from gs_jax.design.start import geomscope
from gs_jax.io.provenance import read_provenance

STUDY = """
design = "table1.toml"
depths_mm = [18.0, 23.0]
depth_count = 2
[free]
sensor_distance_mm = [2.0, 6.0]
[[terms]]
name = "thickness_mm"
minimise = 5.0
[[terms]]
name = "lateral_resolution_um"
at_most = 40.0
weight = 30.0
[[stages]]
solver = "levenberg-marquardt"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_design(tmp_path / "table1.toml", geomscope(sensor_distance_mm=4.0))
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def run(command, *arguments):
    return CliRunner().invoke(command, arguments, catch_exceptions=False)


OWN = """
from gs_jax.codesign.terms import Term
TERMS = {"own_mm": Term("the sensor's distance", lambda imager, at: imager.sensor_distance)}
"""


@pytest.fixture
def own_terms():
    """A file of terms; what it adds is taken away at the end."""
    before = terms.TERMS.copy()
    Path("own.py").write_text(OWN)
    yield
    terms.TERMS.clear()
    terms.TERMS.update(before)


def test_optimize(folder, own_terms):
    """The thinnest with that resolution: v = 4.5 um / 40 um of the farthest z', by hand, within the margin of 0.5 %."""
    (folder / "study.toml").write_text(
        STUDY.replace("[[stages]]", '[[terms]]\nname = "own_mm"\nat_most = 9.0\n[[stages]]')
    )
    result = run(optimize, "table1.toml", "--study", "study.toml", "--terms", "own.py", "-o", "new.toml")
    assert result.exit_code == 0 and "thickness_mm" in result.output and "from geomscope in" in result.output
    distance = read_design("new.toml").imaging.sensor_distance_mm
    assert 1 <= distance / (4.5 / 40 * (23 + 1 / 1.43)) < 1.01
    numbers = json.loads((folder / "new.toml.json").read_text())
    assert numbers["terms"][1]["met_after"] is True
    # The distance goes as one over the resolution: its derivative by that limit, by hand.
    resolution, own = numbers["limits"]
    assert resolution["slope"] == pytest.approx(-distance / 40, rel=0.01) and own["slope"] == 0
    shown = read_design("new.toml").provenance["limits"]
    assert shown == {
        "lateral_resolution_um <= 40": f"{resolution['slope']:+.3g} mm per um",
        "own_mm <= 9": "does not bind",
    }
    assert "goal per" in result.output and "the first design that meets all targets" in result.output
    assert "input own.py" in read_provenance(folder / "new.toml")
    assert (folder / "new.toml.png").exists() and not (folder / "new.toml.checkpoint").exists()


def test_nothing_is_written_on_wrong_input(folder):
    before = set(folder.iterdir())
    with pytest.raises(InputError, match="got no checkpoint new.toml.checkpoint"):
        run(optimize, "table1.toml", "--study", "study.toml", "-o", "new.toml", "--resume")
    with pytest.raises(InputError, match="got '.json'"):
        run(optimize, "table1.toml", "--study", "study.toml", "-o", "new.json")
    with pytest.raises(InputError, match="`pareto` must be .*study.toml"):
        run(pareto, "study.toml", "--out", "new")
    (folder / "study.toml").write_text(STUDY.replace("[free]", "[free]\ndepth_span_mm = [1.0, 99.0]"))
    with pytest.raises(InputError, match="`free.depth_span_mm` .*study.toml"):
        run(optimize, "table1.toml", "--study", "study.toml", "-o", "new.toml")
    assert set(folder.iterdir()) == before
