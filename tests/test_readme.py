import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_readmes_python_runs_as_printed():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    checks = "assert volume.shape == estimate.shape == (3, 577, 577)\nassert jnp.isfinite(estimate).all()"
    subprocess.run([sys.executable, "-c", "\n".join([*blocks, checks])], cwd=ROOT, check=True)
