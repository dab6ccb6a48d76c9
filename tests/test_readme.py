import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import tifffile

ROOT = Path(__file__).parents[1]


def test_the_readmes_python_runs_as_printed(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    # Beside a design and a capture, which is all that the README presumes. Not one pixel is lit evenly, so that the
    # gradient is that of something.
    (tmp_path / "design").symlink_to(ROOT / "design")
    rng = np.random.default_rng(0)
    tifffile.imwrite(tmp_path / "capture.tif", rng.integers(0, 200, (5120, 5120)).astype(np.uint16))
    checks = (
        "assert volume.shape == clean.shape == (17, 577, 577) and estimate.shape == (3, 577, 577)",
        "assert points.shape[1] == 4 and jnp.isfinite(estimate).all()",
        "assert jnp.abs(gradient.array.centers).max() > 0 and gradient.sensor_distance != 0",
    )
    subprocess.run([sys.executable, "-c", "\n".join([*blocks, *checks])], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()
