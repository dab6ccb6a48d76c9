"""Recordings whose frames start from the volume of the one before."""

import numpy as np
import pytest

import gs_jax as gs
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.methods import METHODS
from gs_jax.reconstruction.warm_start import Followed, following_reconstructor

from .test_cli import folder, run
from .test_recording import command, save, volumes

__all__ = ["folder"]

GRID = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)


def scope():
    centers = gs.random_layout(16, (4.0, 4.0), seed=0)
    return gs.Imager(gs.MicrolensArray(centers), gs.Sensor((240, 240), 0.025), 5.8, 3.0)


def bar(place):
    """A bright bar at 20 mm, its column at `place` voxels, and the image of it."""
    volume = np.zeros(GRID.volume_shape, np.float32)
    volume[1, 12:28, place : place + 4] = 1
    image = np.asarray(gs.simulate(volume, scope(), GRID, optics="near", psf="geometric"))
    counts = np.random.default_rng(place).poisson(image * (2000 / image.max()))
    return volume, counts.astype(np.float32)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["list-rl", "richardson-lucy"])
def test_frames_that_follow_are_as_good(name):
    """A bar that stays, moves by a voxel or jumps; what follows a dark frame starts afresh."""
    method, options = METHODS[name](16), {"optics": "near", "progress": Progress()}
    assert isinstance(method, Followed)
    follow = following_reconstructor(scope(), GRID, method, **options)
    alone = lambda image: gs.reconstruct(image, scope(), GRID, method, optics="near")
    score = lambda found, truth: gs.quality(found, truth).psnr_db
    (first, image), (second, moved), (third, far) = bar(10), bar(11), bar(28)
    np.testing.assert_array_equal(follow(image, Progress()), alone(image))
    assert score(follow(image, Progress()), first) > score(alone(image), first) - 2
    assert score(follow(moved, Progress()), second) > score(alone(moved), second) - 2
    assert score(follow(far, Progress()), third) > score(alone(far), third) - 2
    assert not follow(np.zeros_like(far), Progress()).any()
    np.testing.assert_array_equal(follow(far, Progress()), alone(far))


@pytest.mark.integration
def test_a_recording_takes_the_option(folder, monkeypatch, capsys):
    frames = np.random.default_rng(0).integers(100, 3000, (1, 96, 80)).repeat(3, 0).astype(np.uint16)
    how = ("--method", "list-rl", "--steps", "8")
    run(monkeypatch, capsys, *command(save("rec.tif", frames), *how))
    status, _, _ = run(monkeypatch, capsys, *command("rec.tif", *how, "--warm-start", output="w.zarr"))
    cold, warm = volumes(), volumes("w.zarr")
    assert status == 0 and (warm[0] == cold[0]).all()
    # Of the same image it is what more steps would find.
    assert (warm[1] != cold[1]).any() and np.corrcoef(warm[2].ravel(), cold[2].ravel())[0, 1] > 0.7
