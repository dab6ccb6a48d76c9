"""Scores of volumes and points, against scikit-image's own and against brute force."""

from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gs_jax.metrics import localization, quality


def matched_by_brute_force(found, truth, lateral, axial):
    """The most pairs, and of these the least cost, over every possible matching."""
    possible = lambda i, j: (
        np.hypot(*(found[i, :2] - truth[j, :2])) <= lateral and abs(found[i, 2] - truth[j, 2]) <= axial
    )
    cost = lambda i, j: float((((found[i, :3] - truth[j, :3]) / (lateral, lateral, axial)) ** 2).sum())
    for count in range(min(len(found), len(truth)), 0, -1):
        costs = [
            sum(cost(i, j) for i, j in zip(some, others, strict=True))
            for some in combinations(range(len(found)), count)
            for others in permutations(range(len(truth)), count)
            if all(possible(i, j) for i, j in zip(some, others, strict=True))
        ]
        if costs:
            return count, min(costs)
    return 0, 0.0


@given(st.integers(0, 5), st.integers(0, 5), st.integers(0, 10**6))
def test_the_matching_is_the_best_of_all(found, truth, seed):
    """In a box of two limits each way, where most points have several to choose from."""
    rng = np.random.default_rng(seed)
    box = np.array([0.2, 0.2, 0.8])
    a, b = (rng.random((n, 3)) * box for n in (found, truth))
    score = localization(a, b)
    count, cost = matched_by_brute_force(a, b, 0.1, 0.4)
    assert len(score.pairs) == count
    error = (a[score.pairs[:, 0]] - b[score.pairs[:, 1]]) / (0.1, 0.1, 0.4)
    assert (error**2).sum() == pytest.approx(cost, abs=1e-12)
    assert len(set(score.pairs[:, 0])) == len(set(score.pairs[:, 1])) == count


@given(st.integers(0, 30), st.integers(0, 30), st.integers(0, 10**6))
def test_found_and_true_may_be_exchanged(found, truth, seed):
    rng = np.random.default_rng(seed)
    a, b = (rng.random((n, 4)) * (0.5, 0.5, 2, 1) for n in (found, truth))
    one, other = localization(a, b), localization(b, a)
    assert (one.precision, one.recall) == (other.recall, other.precision)
    assert one.f1 == other.f1 or one.f1 == pytest.approx(other.f1)
    np.testing.assert_allclose(one[3:5], other[3:5], rtol=1e-9)


def test_scores_of_points_by_hand():
    truth = np.array([[0.0, 0.0, 20.0], [1.0, 0.0, 20.0], [2.0, 0.0, 20.0]])
    found = np.array([[0.03, 0.04, 20.3], [1.0, 0.0, 20.5], [2.0, 0.0, 20.0], [5.0, 0.0, 20.0]])
    score = localization(found, truth)  # the second is too far in depth, the fourth is nobody's
    assert score.precision == 2 / 4 and score.recall == 2 / 3 and score.f1 == pytest.approx(4 / 7)
    assert score.lateral_rmse == pytest.approx(0.05 / 2**0.5) and score.axial_rmse == pytest.approx(0.3 / 2**0.5)
    assert score.pairs.tolist() == [[0, 0], [2, 2]]
    assert localization(found, truth, axial=0.6).recall == 1


@pytest.mark.parametrize(("found", "truth", "scores"), [(0, 0, (1, 1, 1)), (0, 3, (0, 0, 0)), (3, 0, (0, 0, 0))])
def test_scores_without_points(found, truth, scores):
    score = localization(np.ones((found, 4)), np.ones((truth, 4)))
    assert score[:3] == scores
    assert np.isnan(score.lateral_rmse) and np.isnan(score.axial_rmse)
    assert score.pairs.shape == (0, 2)


def test_one_of_two_at_the_same_place_counts():
    score = localization(np.array([[0.0, 0.0, 20.0]] * 2), np.array([[0.0, 0.0, 20.0]]))
    assert score.precision == 0.5 and score.recall == 1 and score.lateral_rmse == 0


def test_scores_of_a_volume_are_scikit_images_after_the_gain():
    rng = np.random.default_rng(0)
    truth = rng.random((3, 16, 20))
    estimate = 7 * truth + rng.normal(size=truth.shape)
    score = quality(estimate, truth)
    fitted = np.linalg.lstsq(estimate.reshape(-1, 1), truth.ravel(), rcond=None)[0][0]
    assert score.gain == pytest.approx(fitted, rel=1e-10)
    top = truth.max()
    assert score.psnr_db == pytest.approx(peak_signal_noise_ratio(truth, fitted * estimate, data_range=top), rel=1e-10)
    similar = [structural_similarity(fitted * e, t, data_range=top) for e, t in zip(estimate, truth, strict=True)]
    assert score.ssim == pytest.approx(np.mean(similar), rel=1e-10)
    assert score.mse == pytest.approx(((fitted * estimate - truth) ** 2).mean(), rel=1e-10)


def test_the_gain_of_the_estimate_does_not_matter():
    rng = np.random.default_rng(1)
    truth, estimate = rng.random((2, 2, 9, 9))
    np.testing.assert_allclose(quality(estimate, truth)[:3], quality(1e-20 * estimate, truth)[:3], rtol=1e-9)


def test_a_perfect_volume_one_of_zeros_and_a_negative_one():
    truth = np.zeros((2, 8, 8))
    truth[1, 3, 4] = 2
    assert quality(3 * truth, truth)[:3] == (np.inf, 1, 0)
    floor = quality(np.zeros_like(truth), truth)
    assert floor.gain == 0 and floor.mse == pytest.approx(4 / truth.size)
    assert floor.psnr_db == pytest.approx(10 * np.log10(truth.size))
    # What is dark where the truth is bright is best left out.
    assert quality(-truth, truth) == floor


@pytest.mark.parametrize(
    ("estimate", "truth", "words"),
    [
        (np.ones((1, 8, 8)), np.ones((2, 8, 8)), r"truth's shape \(2, 8, 8\), got \(1, 8, 8\)"),
        (np.ones((1, 8, 8)), np.zeros((1, 8, 8)), "positive somewhere, got 0.0"),
    ],
)
def test_wrong_volumes_are_named(estimate, truth, words):
    with pytest.raises(ValueError, match=words):
        quality(estimate, truth)
