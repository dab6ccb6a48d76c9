import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.signal import convolve2d

from gs_jax.solvers.convolution import Convolution

# Odd and even, larger and smaller than the image, one depth and several.
SIZES = [((3, 4, 7), (11, 16)), ((2, 12, 15), (9, 10))]


def system(psf_shape, image_shape, dtype=jnp.float64):
    psf = jax.random.uniform(jax.random.key(0), psf_shape, dtype)
    return psf, Convolution.of(psf, image_shape)


def scene_of(convolution, dtype=jnp.float64):
    return jax.random.normal(jax.random.key(1), convolution.scene_shape, dtype)


@pytest.mark.parametrize("sizes", SIZES)
def test_it_is_the_middle_of_scipys_convolution(sizes):
    """Linear: nothing comes round from the far side."""
    psf, convolution = system(*sizes)
    scene = scene_of(convolution)
    expected = 0
    for kernel, plane in zip(np.asarray(psf), np.asarray(scene), strict=True):
        whole = convolve2d(plane, kernel)
        middle = [slice(k // 2, k // 2 + n) for k, n in zip(kernel.shape, plane.shape, strict=True)]
        expected = expected + whole[*middle][convolution.window]
    np.testing.assert_allclose(convolution(scene), expected, atol=1e-12)


@pytest.mark.parametrize("sizes", SIZES)
def test_every_pixel_of_the_psf_counts(sizes):
    """The scene is large enough: in front of the image's corners, the whole PSF fits."""
    psf, convolution = system(*sizes)
    light = convolution.operator.T.mv(jnp.ones(convolution.image_shape))
    np.testing.assert_allclose(light.sum(), float(psf.sum()) * math.prod(convolution.image_shape), rtol=1e-12)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-12), (jnp.float32, 2e-6)])
def test_adjoint(sizes, dtype, tolerance):
    _, convolution = system(*sizes, dtype=dtype)
    A, scene = convolution.operator, scene_of(convolution, dtype)
    image = jax.random.normal(jax.random.key(2), convolution.image_shape, dtype)
    forth, back = jnp.vdot(A.mv(scene), image), jnp.vdot(scene, A.T.mv(image))
    # Relative to the norms: the product itself may be near zero.
    size = float(jnp.linalg.norm(A.mv(scene)) * jnp.linalg.norm(image))
    np.testing.assert_allclose(forth, back, atol=tolerance * size)


def test_gradients():
    psf, convolution = system((2, 4, 5), (6, 7))
    image_of = lambda psf, scene: Convolution.of(psf, (6, 7))(scene)
    # Bilinear: central differences of first order are exact but for rounding.
    check_grads(image_of, (psf, scene_of(convolution)), order=1, eps=1e-2, atol=1e-8, rtol=1e-8)


def test_a_wrong_psf_is_named():
    with pytest.raises(ValueError, match=r"\(depth, row, column\) and not empty, got \(0, 3, 3\)"):
        Convolution.of(jnp.zeros((0, 3, 3)), (5, 5))
