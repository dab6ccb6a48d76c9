"""Recordings whose frames start from the volume of the one before."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest

import gs_jax as gs
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.plan import follow_volume

from .test_recording import command, save, volumes

STEPS = 16
GRID = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)


class Counted(Progress):
    """Counts the steps of iterations."""

    steps = 0

    @contextmanager
    def counter(self, description, total, **_):
        self.steps = 1

        def advance():
            # The step that ends an iteration early is not counted.
            self.steps = min(self.steps + 1, total)

        yield advance


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


def alone(image, method, steps):
    return gs.reconstruct(image, scope(), GRID, dataclasses.replace(method, steps=steps), optics="near")


@pytest.mark.integration
@pytest.mark.parametrize("name", ["list-rl", "richardson-lucy"])
def test_frames_that_follow_need_fewer_steps(name):
    """A bar that stays or moves by a voxel is better than by as many steps afresh, and after a jump as by half."""
    method, counted = METHODS[name](STEPS), Counted()
    reconstructor = gs.Reconstructor(scope(), GRID, method, "near")
    volume, last = follow_volume(reconstructor, bar(10)[1], None, counted)
    np.testing.assert_array_equal(volume, alone(bar(10)[1], method, STEPS))
    for place, share in ((10, 1), (11, 1), (28, 2)):
        truth, image = bar(place)
        volume, last = follow_volume(reconstructor, image, last, counted)
        found = gs.quality(volume, truth).psnr_db
        assert counted.steps < STEPS or place == 28
        afresh = alone(image, method, counted.steps // share)
        assert found > gs.quality(afresh, truth).psnr_db, (place, counted.steps)


@pytest.mark.integration
@pytest.mark.parametrize("level", [0.0, 3.0])
def test_what_follows_a_dark_frame_starts_afresh(level):
    """Without light, or with read noise alone, whose sum may be negative."""
    method, (_, image) = METHODS["richardson-lucy"](4), bar(10)
    reconstructor, last = gs.Reconstructor(scope(), GRID, method, "near"), None
    dark = np.random.default_rng(0).normal(0, level, image.shape).astype(np.float32)
    for frame in (image, dark, image):
        volume, last = follow_volume(reconstructor, frame, last, Progress())
        np.testing.assert_array_equal(volume, alone(frame, method, 4))


@pytest.mark.integration
def test_a_recording_takes_the_option(folder, run):
    frames = np.random.default_rng(0).integers(100, 3000, (1, 96, 80)).repeat(3, 0).astype(np.uint16)
    how = ("--method", "list-rl", "--steps", "8")
    run(*command(save("rec.tif", frames), *how))
    status, _, _ = run(*command("rec.tif", *how, "--warm-start", output="w.zarr"))
    cold, warm = volumes(), volumes("w.zarr")
    assert status == 0 and (warm[0] == cold[0]).all()
    assert (warm[1] != cold[1]).any() and (warm[2] > 0).any()
