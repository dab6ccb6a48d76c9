"""The parts of the full model, timed."""

import numpy as np
import pytest

from experiments.model_profile import run


@pytest.mark.integration
def test_parts_have_times_and_work():
    rows = run(480, np.array([20.0]), rounds=1)
    assert {"model", "model: adjoint", "cores", "stray light", "- products over the radius"} <= {
        r["name"] for r in rows
    }
    assert all(row["clock"] > 0 and row["memory"] >= 0 for row in rows)
