import re
import subprocess
import sys
from pathlib import Path

import pytest

from .helpers import design_and_capture

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[1]


def test_the_readmes_python_runs_as_printed(tmp_path):
    """Beside a design and a capture, which is all that the README presumes; here of a small microscope."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    design_and_capture(tmp_path)
    checks = (
        "assert volume.shape == clean.shape == grid.volume_shape and estimate.shape == (3, *grid.shape)",
        "assert len(points) == 5 and jnp.isfinite(estimate).all()",
        "assert jnp.abs(gradient.array.centers).max() > 0 and gradient.sensor_distance != 0",
    )
    subprocess.run([sys.executable, "-c", "\n".join([*blocks, *checks])], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()
