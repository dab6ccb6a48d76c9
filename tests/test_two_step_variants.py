"""The experiment about variants of the network of seven slices: what each of them is trained on and gives."""

import jax
import numpy as np
import pytest

from experiments.two_step_variants import COUNT, SIZE, Gated, Stack, batch, channels, cleaned
from gs_jax.detection.unet import multislice_network

pytestmark = pytest.mark.integration


def stack() -> Stack:
    rng = np.random.default_rng(0)
    return Stack(*rng.random((3, 5, SIZE + 8, SIZE + 16)).astype(np.float32))


def test_every_variant_sees_the_same_pieces():
    plain, wide = (batch([stack()], spread, np.random.default_rng(1)) for spread in (False, True))
    assert plain.slices.shape == (COUNT, 7, SIZE, SIZE) and wide.slices.shape == (COUNT, 8, SIZE, SIZE)
    np.testing.assert_array_equal(plain.slices, wide.slices[:, :7])
    np.testing.assert_array_equal(plain.truth, wide.truth)


def test_slices_beyond_the_ends_are_the_last_ones():
    one, whole = stack(), (slice(None), slice(None))
    seen = channels(one, 4, whole, True)
    np.testing.assert_array_equal(seen, [*one.volume[[1, 2, 3, 4, 4, 4, 4]], one.spread[4]])


def test_a_gate_weighs_the_slice_that_is_wanted():
    one, network = stack(), Gated(multislice_network(jax.random.key(0)))
    found = cleaned(network, one, False)
    assert found.shape == one.volume.shape
    assert (found >= 0).all() and (found <= 2 * np.maximum(one.volume, 0) + 1e-6).all()
