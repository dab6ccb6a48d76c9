"""Deconvolution by a measured point spread function, of images that SciPy convolved."""

import inspect

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import fftconvolve

from gs_jax import FISTA, InputError, RichardsonLucy
from gs_jax.__main__ import commands
from gs_jax.io.captures import read_capture, write_capture
from gs_jax.io.provenance import read_provenance
from gs_jax.reconstruction.deconvolution import deconvolve
from gs_jax.solvers.convolution import ConvolutionADMM

SOLVERS = [
    ConvolutionADMM(steps=80, sparsity=0.0, tv=1e-4),
    FISTA(80, sparsity=0.0),
    RichardsonLucy(80, accelerate=True),
]


def seen() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scene of three bars, the PSF of seven spots, and the image on an offset of 100."""
    rng = np.random.default_rng(0)
    scene, psf = np.zeros((60, 80)), np.zeros((41, 41))
    scene[20:40, 20:24], scene[20:40, 34:38], scene[10:14, 30:60] = 1, 2, 1.5
    psf[tuple(rng.integers(4, 37, (2, 7)))] = 1
    psf = fftconvolve(psf, np.outer(np.hanning(5), np.hanning(5)), mode="same").clip(0)
    return scene, psf, 100 + 1000 * fftconvolve(scene, psf / psf.sum(), mode="same").clip(0)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_a_scene_is_found_in_its_unit(solver):
    scene, psf, image = seen()
    found = deconvolve(image, 7 + 50 * psf, solver)
    assert found.shape == scene.shape and found.min() >= 0
    assert np.linalg.norm(found / 1000 - scene) < 0.35 * np.linalg.norm(scene)
    assert found.sum() / 1000 == pytest.approx(scene.sum(), rel=0.1)


def test_wrong_input_is_named_and_darkness_stays():
    _, psf, image = seen()
    with pytest.raises(InputError, match="psf must be the image of a point, got no light"):
        deconvolve(image, np.ones((5, 5)))
    with pytest.raises(InputError, match="psf: found 1 of 9 pixels NaN"):
        deconvolve(image, np.diag([1.0, np.nan, 1.0]))
    with pytest.raises(InputError, match="solver must be an object such as .*, got <class .*FISTA'>"):
        inspect.unwrap(deconvolve)(image, psf, FISTA)  # past the tests' check of annotations
    assert not deconvolve(np.zeros((20, 20)), psf).any()


def test_the_command(tmp_path):
    _, psf, image = seen()
    write_capture(tmp_path / "c.tif", image.astype(np.float32))
    write_capture(tmp_path / "psf.npy", psf.astype(np.float32))
    arguments = ["deconvolve", str(tmp_path / "c.tif"), str(tmp_path / "psf.npy"), "--steps", "5"]
    output = ["-o", str(tmp_path / "s.tif")]
    assert CliRunner().invoke(commands, arguments + output).exit_code == 0
    assert read_capture(tmp_path / "s.tif").shape == image.shape
    assert {"input c.tif", "input psf.npy"} < set(read_provenance(tmp_path / "s.tif"))
    wrong = CliRunner().invoke(commands, [*arguments, "--method", "fista", "--tv", "0.1", *output])
    assert isinstance(wrong.exception, InputError) and "--tv must be used with --method admm or richardson-lucy" in str(
        wrong.exception
    )
