"""The script about the solvers' defaults: its glow."""

import numpy as np
import pytest

from experiments.solver_options import glow


def test_the_glow_is_as_bright_as_it_says():
    image = np.random.default_rng(0).uniform(1, 3, (60, 50))
    added = glow(image)
    assert added.max() == pytest.approx(2 * (image.mean() - np.percentile(image, 1)), rel=0.01) and added.min() > 0
