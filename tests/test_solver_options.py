"""The script about the solvers' defaults, on a small capture."""

import numpy as np
import pytest

from experiments.fig9_benchmark import Scene
from experiments.solver_options import cases, glow, run
from gs_jax.base.progress import Progress
from gs_jax.training.examples import Kind, example


@pytest.mark.slow
def test_every_case_at_toy_size():
    e = example(0, 0, Kind(64, 0.06, 0.25, 3, binning=4))
    scene = Scene(e.image, e.imager, e.grid, e.truth)
    found = run(scene, progress=Progress())
    assert set(found) == set(cases(scene)) and len(found) == 11
    assert all(np.isfinite([r["psnr_db"], r["empty_db"]]).all() for r in found.values())


def test_the_glow_is_as_bright_as_it_says():
    image = np.random.default_rng(0).uniform(1, 3, (60, 50))
    added = glow(image)
    assert added.max() == pytest.approx(2 * (image.mean() - np.percentile(image, 1)), rel=0.01) and added.min() > 0
