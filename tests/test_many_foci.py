"""Kinds of lenses in the error of the best linear estimate, and the experiment that asks whether many foci pay."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from experiments.many_foci import base_imager, gain, interleaved, loss_of, microscopes, picture, run
from gs_jax import random_layout
from gs_jax.base.progress import Progress
from gs_jax.codesign.linear_error import lost_power

CENTERS = np.asarray(random_layout(24, (6.0, 6.0), pitch=1.05, pitch_sd=0.08, seed=0))
DEPTHS = (18.0, 23.0)


def test_neighbours_are_of_other_kinds():
    centers = np.asarray(random_layout(200, (17.1, 17.1), pitch=1.05, pitch_sd=0.08, seed=1))
    for kinds in (2, 3):
        which = interleaved(centers, kinds)
        assert np.ptp(np.bincount(which)) <= 0.1 * len(centers)
        tree: Any = KDTree(centers)
        nearest = tree.query(centers, k=3)[1][:, 1:]
        # By chance 1/2 and 1/3 would be alike.
        assert (which[nearest] == which[:, None]).mean() < 0.8 / kinds


def test_lenses_that_are_alike_are_one_kind_however_they_are_counted():
    base, which = base_imager(CENTERS), interleaved(CENTERS, 2)
    numbers = jnp.array([2.95, 1.34, 0.8, 0.0])
    place = jnp.array([[0.1, -0.2]])
    together = lost_power(microscopes(numbers, base, [CENTERS], DEPTHS), place)
    apart = lost_power(microscopes(numbers, base, [CENTERS[which == k] for k in range(2)], DEPTHS), place)
    np.testing.assert_allclose(apart, together, rtol=1e-9)


def test_gradients_by_the_spread_of_the_radii():
    base, which = base_imager(CENTERS), interleaved(CENTERS, 2)
    loss = loss_of([CENTERS[which == k] for k in range(2)], base, DEPTHS)
    check_grads(lambda x: loss(x)[0], (jnp.array([0.24, 0.17, 0.3, 0.2]),), order=1, modes=["rev"], eps=1e-6, rtol=1e-5)


def test_a_small_study_and_its_picture():
    found = run(1, spans={"18 to 23 mm": DEPTHS}, kinds=(1, 2), lenses=24, progress=Progress())
    one, two = (found["found"]["18 to 23 mm"][k][0]["loss_db"] for k in (1, 2))
    assert two <= one + 1e-6
    assert len(picture(found).axes) == 1


def test_the_gain_is_of_pairs():
    found = gain([-30.0, -31.0, -32.0], [-31.0, -32.0, -33.0])
    assert found["mean"] == pytest.approx(1) and found["interval"] == pytest.approx([1, 1])
