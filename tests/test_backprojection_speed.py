import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax import backproject

pytest.importorskip("numba")

from experiments.backprojection_speed import CONTESTANTS, IN_STUDY, Job, memory, run, write
from experiments.kernels import count_pairs, lens_patches, numpy_patches, paper_loop, plain

from .helpers import backproject_loop, scene


@pytest.mark.parametrize("kernel", [paper_loop, lens_patches, numpy_patches])
def test_the_kernels_compute_the_same_sum(kernel):
    """Rotated lenses, some rays off the sensor, voxels coarse and fine."""
    for case in (dict(), dict(voxels=(40, 33), pitch=0.006), dict(voxels=(9, 8), pitch=0.21)):
        imager, grid = scene(jnp.float32, **case)
        image = jax.random.uniform(jax.random.key(0), imager.sensor.shape, jnp.float32)
        expected = np.asarray(backproject(image, imager, grid))
        found = kernel(np.asarray(image), plain(imager, grid))
        np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())


def test_pairs_are_counted():
    imager, grid = scene()
    one = np.ones(imager.sensor.shape)
