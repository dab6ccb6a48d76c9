"""The experiment that asks whether many foci pay."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.many_foci import gain, numbers_of, picture, run
from gs_jax import random_layout
from gs_jax.base.progress import Progress
from gs_jax.optics.lens_types import interleave

pytestmark = pytest.mark.integration


def test_neighbours_are_of_other_kinds():
    centers = np.asarray(random_layout(200, (17.1, 17.1), pitch=1.05, pitch_sd=0.08, seed=1))
    for kinds in (2, 3):
        which = interleave(centers, kinds)
        assert np.ptp(np.bincount(which)) <= 0.1 * len(centers)
        tree: Any = KDTree(centers)
        nearest = tree.query(centers, k=3)[1][:, 1:]
        # By chance 1/2 and 1/3 would be alike.
        assert (which[nearest] == which[:, None]).mean() < 0.8 / kinds


@pytest.mark.slow
def test_a_small_study_and_its_picture():
    spans = {"15 to 30 mm": ((15.0, 30.0), 2)}
    found = run(1, spans=spans, kinds=(1, 2), lenses=24, steps=2, progress=Progress())
    one, two = (found["found"]["15 to 30 mm"][k][0] for k in (1, 2))
    assert two["loss_db"] < one["loss_db"]
    assert len(numbers_of(one)["radius_of_curvature"]) == 1 and len(numbers_of(two)["radius_of_curvature"]) == 2
    assert len(picture(found).axes) == 1


def test_the_gain_is_of_pairs():
    found = gain([-30.0, -31.0, -32.0], [-31.0, -32.0, -33.0])
    assert found["mean"] == pytest.approx(1) and found["interval"] == pytest.approx([1, 1])
