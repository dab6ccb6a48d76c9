import json
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax.base.errors import InputError
from gs_jax.detection.unet import (
    PRETRAINED,
    UNet,
    multislice_network,
    paper_network,
    pretrained,
    read_weights,
    standardize,
    suppress,
    write_weights,
)


def small(*, offsets=(-1, 0, 1), widths=(4, 6), standardized=True, dtype=np.float32) -> UNet:
    """A network with random weights everywhere, biases and the last layer too. NumPy's: they need not be compiled."""
    rng = np.random.default_rng(0)
    fill = lambda leaf: rng.normal(0, (2 / max(np.prod(leaf.shape[1:]), 20)) ** 0.5, leaf.shape).astype(dtype)
    return jax.tree.map(
        lambda leaf: jax.device_put(fill(leaf)),
        shapes(lambda key: UNet(offsets, widths, standardized=standardized, key=key)),
    )


def shapes(make) -> UNet:
    return eqx.filter_eval_shape(make, jr.key(0))


def stack(*shape, seed=0):
    return np.random.default_rng(seed).random(shape, np.float32)


def parameters(network) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(network))


def test_the_papers_network_has_its_five_levels():
    network = shapes(paper_network)
    assert network.widths == (16, 32, 64, 128, 256) and network.offsets == (0,) and not network.standardized
    # By hand: two 3 x 3 a level, and on the way up a 1 x 1 to half the channels before two of the doubled input.
    pairs = list(zip((1, 16, 32, 64, 128), network.widths, strict=True))
    down = sum(9 * a * b + b + 9 * b * b + b for a, b in pairs)
    up = sum(2 * a * a + a + 9 * 2 * a * a + a + 9 * a * a + a for a in (16, 32, 64, 128))
    assert parameters(network) == down + up + 17

    ours = shapes(multislice_network)
    assert ours.standardized and parameters(ours) < parameters(network) / 3


def test_standardized_volumes_have_no_pedestal_and_one_unit():
    above, unit = standardize(stack(3, 9, 30) + np.float32(5))
    assert above.std() == pytest.approx(unit, rel=1e-2)  # their means are near, not at, their medians
    np.testing.assert_allclose(np.median(above, axis=(1, 2)), 0, atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 3), (4, 17, 8), (0, 8, 8), (2, 0, 8)])
def test_any_shape_goes_in_and_comes_out(shape):
    volume = suppress(stack(*shape), small())
    assert volume.shape == shape and volume.dtype == np.float32
    assert np.isfinite(volume).all() and (volume >= 0).all()


def test_a_volume_with_nan_is_named():
    with pytest.raises(InputError, match="volume must be finite, got 9 of 18 voxels NaN"):
        suppress(stack(2, 3, 3) * np.array([1, np.nan], np.float32)[:, None, None], small())


@pytest.mark.parametrize("kind", [True, False])
def test_it_scales_with_the_volume(kind):
    """A pedestal changes nothing where volumes are standardised."""
    volume, network = stack(3, 20, 24), small(standardized=kind)
    # 8 is exact in binary; 1e-4 rounds the input, which float32 passes on to the output.
    np.testing.assert_array_equal(suppress(8 * volume, network), 8 * suppress(volume, network))
    scaled = suppress(np.float32(1e-4) * volume, network)
    np.testing.assert_allclose(scaled, 1e-4 * suppress(volume, network), rtol=1e-4, atol=1e-9)
    assert not suppress(0 * volume, network).any()
    if kind:
        np.testing.assert_allclose(suppress(volume + np.float32(2), network), suppress(volume, network), atol=1e-5)


@pytest.mark.parametrize("offsets", [(0,), (-2, 0, 1)])
def test_tiles_leave_no_seam(monkeypatch, offsets):
    """As one tile and as 3 x 4 of them."""
    network, volume = small(offsets=offsets), stack(2, 45, 62)
    whole = suppress(volume, network)
    jax.clear_caches()
    monkeypatch.setattr("gs_jax.detection.unet._CORE", 16)
    # The same sums: only the order of the convolution's terms may differ.
    np.testing.assert_allclose(suppress(volume, network), whole, atol=1e-5 * whole.max())


@pytest.mark.parametrize(
    "widths", [(3,), (6, 7, 8), *(pytest.param(w, marks=pytest.mark.integration) for w in ((3, 4), (2, 3, 3, 4)))]
)
def test_the_core_is_the_middle_of_the_whole(widths):
    """Each of its voxels is the same sum: nothing that the edges spoil is left."""
    network = small(widths=widths)
    margin, step = network.margin, network.multiple
    # The whole has to be of as many voxels as pools divide.
    spare = -margin % step
    tile = jnp.asarray(stack(3, 3 * step + 2 * margin + 2 * spare, 2 * step + 2 * margin + 2 * spare))
    part = tile[:, spare : tile.shape[1] - spare, spare : tile.shape[2] - spare]
    whole, edge = np.asarray(eqx.filter_jit(network)(tile)), margin + spare
    core = np.asarray(eqx.filter_jit(network.core)(part))
    assert core.shape == (3 * step, 2 * step)
    np.testing.assert_allclose(core, whole[edge:-edge, edge:-edge], atol=1e-6 * np.abs(whole).max())


@pytest.mark.parametrize("widths", [(3, 4), (6, 7, 8)])
def test_no_output_looks_further_than_the_margin(widths):
    """By the gradient of all outputs of the middle; and the margin is not needlessly wide."""
    network = small(widths=widths, offsets=(0,))
    margin, step = network.margin, network.multiple
    size = 4 * margin
    slices = stack(1, size, size)
    core = slice(size // 2, size // 2 + step)
    gradient = jax.jit(jax.grad(lambda slices: jnp.sum(network(slices)[core, core] ** 2)))(slices)[0]
    rows = np.flatnonzero(np.abs(gradient).sum(1))
    assert core.start - margin <= rows[0] and rows[-1] < core.stop + margin
    assert core.start - margin + 2 * step >= rows[0]


def test_it_moves_with_the_scene():
    """By as many voxels as the coarsest level's are wide."""
    network, size = small(), 120
    scene = np.zeros((3, size, size), np.float32)
    scene[:, 56:62, 50:58] = stack(3, 6, 8)
    step = network.multiple
    moved = suppress(np.roll(scene, (step, 2 * step), (1, 2)), network)
    expected = np.roll(suppress(scene, network), (step, 2 * step), (1, 2))
    np.testing.assert_allclose(moved, expected, atol=1e-5 * expected.max())


def test_edge_depths_are_repeated():
    """Three equal slices are as one."""
    network, plane = small(), stack(1, 12, 12)
    alone = suppress(plane, network)
    np.testing.assert_allclose(suppress(np.repeat(plane, 3, 0), network)[1], alone[0], rtol=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize("kind", [True, False])
def test_gradients(kind):
    """By central differences, and finite in the dark."""
    network = small(widths=(2, 3), standardized=kind, dtype=jnp.float64)
    slices = stack(3, 6, 8).astype(float)
    loss = jax.jit(lambda network, slices: jnp.sum(jnp.tanh(network(slices))))
    # Rectifiers and maxima have kinks; a step of 1e-6 stays on one side of them at this generic point.
    check_grads(loss, (network, slices), order=1, eps=1e-6, atol=1e-5, rtol=1e-5)
    gradient = jax.jit(jax.grad(loss))(network, 0 * slices)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("kind", [True, False])
def test_weights_come_back(tmp_path, kind):
    network = small(standardized=kind)
    write_weights(tmp_path / "w.npz", network)
    back = read_weights(tmp_path / "w.npz")
    assert jax.tree.structure(back) == jax.tree.structure(network)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(network), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_array_equal(a, np.asarray(b).astype(np.float16).astype(np.float32))


def _archive(path, about, **arrays):
    np.savez(path, about=np.array(json.dumps(about)), **arrays)


ABOUT = {"offsets": [0], "widths": [2], "standardized": True}
GARBAGE = {
    "text": lambda path: path.write_text("no weights"),
    "empty": lambda path: path.write_bytes(b""),
    "other arrays": lambda path: np.savez(path, a=np.zeros(3)),
    "no JSON": lambda path: np.savez(path, about=np.array("{")),
    "a list": lambda path: _archive(path, [1, 2]),
    "more keys": lambda path: _archive(path, ABOUT | {"code": "1"}),
    "no offset 0": lambda path: _archive(path, ABOUT | {"offsets": [1]}),
    "too wide": lambda path: _archive(path, ABOUT | {"widths": [10**6]}),
    "too deep": lambda path: _archive(path, ABOUT | {"widths": [1] * 100}),
    "text as widths": lambda path: _archive(path, ABOUT | {"widths": "16"}),
    "arrays missing": lambda path: _archive(path, ABOUT),
    "wrong shape": lambda path: _archive(path, ABOUT, **{f"array_{i}": np.zeros(1, np.float16) for i in range(3)}),
    "not finite": lambda path: _archive(
        path,
        ABOUT,
        array_0=np.full((2, 1, 3, 3), np.nan, np.float16),
        array_1=np.zeros((2, 2, 3, 3), np.float16),
        array_2=np.zeros((1, 2, 1, 1), np.float16),
    ),
    "objects": lambda path: np.savez(path, about=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_is_refused_in_one_line(tmp_path, kind):
    path = tmp_path / "w.npz"
    GARBAGE[kind](path)
    with pytest.raises(InputError, match="w.npz") as error:
        read_weights(path)
    assert "\n" not in str(error.value)


def test_a_file_that_would_fill_the_memory_is_refused(tmp_path):
    path = tmp_path / "w.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("about.npy", "w") as member:
        for _ in range(129):
            member.write(bytes(2**20))
    with pytest.raises(InputError, match=f"at most {2**27}"):
        read_weights(path)


def test_missing_and_unknown_weights_and_impossible_networks(tmp_path):
    with pytest.raises(InputError, match=r"none\.npz"):
        read_weights(tmp_path / "none.npz")
    with pytest.raises(InputError, match="one of paper, multislice"):
        pretrained("other")
    with pytest.raises(InputError, match=r"must be \.npz"):
        write_weights(tmp_path / "w.txt", small())
    for offsets, widths in (((1,), (2,)), ((0,), ())):
        with pytest.raises(ValueError, match="must have"):
            UNet(offsets, widths, standardized=True, key=jr.key(0))


@pytest.mark.parametrize("name", PRETRAINED)
def test_the_networks_that_come_with_the_package(name):
    """Their shapes are those of the functions that made them, and a lone sharp object stays where it was."""
    network = pretrained(name)
    make = {"paper": paper_network, "multislice": multislice_network}[name]
    assert jax.tree.structure(network) == jax.tree.structure(shapes(make))
    volume = np.zeros((3, 40, 40), np.float32)
    volume[1, 14:24, 12:20] = 1
    found = suppress(volume, network)
    assert found[1, 15:23, 13:19].mean() > 0.5 and found[1, :8].max() < 0.1
