import re
import subprocess
import sys
from pathlib import Path

import pytest

from .helpers import design_and_capture

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[1]


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def test_readme_is_short_and_its_python_runs(tmp_path):
    """With a small microscope in place of the built-in one."""
    (block,) = blocks("README.md")
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 500
    design_and_capture(tmp_path)
    small = block.replace("gs.geomscope()", 'gs.read_design("design/geomscope.toml")')
    assert small != block
    check = "assert volume.shape == grid.volume_shape"
    subprocess.run([sys.executable, "-c", f"{small}\n{check}"], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()


def test_python_page_runs(tmp_path):
    """In a folder with a design and a capture, here of a small microscope."""
    printed = blocks("docs/howto/python.md")
    assert len(printed) == 3
    design_and_capture(tmp_path)
    checks = (
        "assert volume.shape == clean.shape == grid.volume_shape and estimate.shape == (3, *grid.shape)",
        "assert len(points) == 5 and jnp.isfinite(estimate).all()",
        "assert jnp.abs(gradient.array.centers).max() > 0 and gradient.sensor_distance != 0",
    )
    subprocess.run([sys.executable, "-c", "\n".join([*printed, *checks])], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()
