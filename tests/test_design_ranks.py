"""The experiment that asks whether objectives rank designs as reconstructed scenes do."""

import numpy as np
import pytest
import scipy.sparse as sp

from experiments.common import design_file
from experiments.design_ranks import STEPS, correlation, random_design, report, richardson_lucy
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress


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


def test_richardson_lucy_undoes_diffraction():
    """A point, of which an image of a third of its frequencies is left."""
    truth = np.zeros((256, 1), np.float32)
    truth[100] = 1000
    frequency = np.hypot(np.fft.fftfreq(16)[:, None], np.fft.rfftfreq(16))
    transfer = np.maximum(1 - 3 * frequency, 0)
    image = np.fft.irfft2(np.fft.rfft2(truth.reshape(16, 16)) * transfer, (16, 16)).reshape(-1, 1).astype(np.float32)
    known, unknown = (
        richardson_lucy(sp.csr_matrix(np.eye(256, dtype=np.float32)), each, np.maximum(image, 0), 1.0)[STEPS[-1]]
        for each in (transfer, np.ones_like(transfer))
    )
    assert known[100] > 2 * unknown[100] and known.argmax() == 100


def test_records_of_other_images_are_refused(tmp_path):
    file = tmp_path / "records.json"
    file.write_text('{"bright": {}, "found": {}}')
    with pytest.raises(InputError, match="must be of images by rays and diffraction, got none"):
        report([], file, Progress())


def test_a_design_with_the_name_of_another_is_refused(tmp_path):
    with pytest.raises(InputError, match="names of their own, got another geomscope-asphere"):
        report([design_file("geomscope-asphere")], tmp_path / "records.json", Progress())


def test_the_correlation_is_of_ranks():
    a = np.arange(12.0)
    assert correlation(a, np.exp(a))[0] == pytest.approx(1) and correlation(a, -(a**3))[0] == pytest.approx(-1)
