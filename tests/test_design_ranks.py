"""The experiment that asks whether objectives rank designs as reconstructed scenes do."""

import numpy as np
import pytest
import scipy.sparse as sp

from experiments.design_ranks import STEPS, correlation, random_design, richardson_lucy


@pytest.mark.parametrize("seed", range(4))
def test_random_designs_are_in_focus_or_nearly(seed):
    imager = random_design(seed).imager()
    image = 1 / (1 / float(imager.array.focal_length) - 1 / float(imager.reduced_depth(20.5)))
    assert 0.75 < float(imager.reduced_sensor_distance) / image < 1.25


def test_richardson_lucy_finds_voxels_that_share_no_pixel():
    adjoint = sp.csr_matrix(np.kron(np.eye(3), np.full((1, 4), 0.25)).astype(np.float32))
    truth = np.array([[10.0], [40.0], [90.0]], np.float32)
    no_diffraction = np.ones((12, 1))
    assert richardson_lucy(adjoint, no_diffraction, adjoint.T @ truth, 0.0)[STEPS[-1]] == pytest.approx(truth, rel=1e-4)


def test_the_correlation_is_of_ranks():
    a = np.arange(12.0)
    assert correlation(a, np.exp(a))[0] == pytest.approx(1) and correlation(a, -(a**3))[0] == pytest.approx(-1)
