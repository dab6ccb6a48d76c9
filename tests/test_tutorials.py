"""The tutorials of the site run to their ends, at toy size: what they show, the site's build runs at full size."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
# Constants at the top of each, and what they are here.
TOY = {
    "reconstruct": {"PIXELS": "320"},
    "compare": {"HALF": "2.5", "POINTS": "6"},
    "objective": {"STEPS": "3"},
    "device": {"PIXELS": "700", "POINTS": "4"},
    "mold": {"LENSES": "6", "CHORD": "0.005"},
    "recording": {"PIXELS": "400", "FRAMES": "2", "BEADS": "3"},
    "workers": {"PIXELS": "(200,)", "FRAMES": "2"},
}
SLOW = {"reconstruct", "compare", "device", "recording", "workers"}


def test_every_tutorial_is_tried():
    assert {path.stem for path in FOLDER.glob("*.py")} == set(TOY)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in TOY])
def test_a_tutorial_runs(name, tmp_path):
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    for constant, value in TOY[name].items():
        text, count = re.subn(rf"^{constant} = [^#\n]+", f"{constant} = {value}  ", text, flags=re.MULTILINE)
        assert count == 1, constant
    script = tmp_path / f"{name}.py"
    script.write_text(f'import matplotlib\nmatplotlib.use("agg")\n{text}', encoding="utf-8")
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert not done.returncode, done.stderr
