import sys

import jax
import numpy as np
import optax
import pytest
from click.testing import CliRunner

import gs_jax as gs
from gs_jax.apps import training_data
from gs_jax.apps.training import Recipe, init, read_checkpoint, slices_loss, train, write_checkpoint
from gs_jax.apps.training_data import (
    SPECS,
    CaptureSpec,
    Stack,
    _path,
    sample_paper_batch,
    sample_patches,
    simulate_stack,
    simulate_stacks,
)
from gs_jax.cli.reconstruct import reconstruct_command
from gs_jax.cli.train import train_command as command
from gs_jax.detection.unet import UNet, read_weights
from gs_jax.io.files import side_file

from .helpers import DESIGN


def toy(offsets=(0,), batch=lambda rng: sample_paper_batch(rng, 16)) -> Recipe:
    network = lambda key: UNet(offsets, (4, 8), standardized=False, key=key)
    return Recipe(network, lambda steps: optax.rmsprop(optax.cosine_decay_schedule(3e-3, steps)), batch, slices_loss)


def assert_equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.integration
def test_the_loss_falls_and_the_seed_decides():
    states = [train(toy(), init(toy(), steps=40, seed=seed)) for seed in (0, 0, 1)]
    assert_equal(states[0], states[1])
    assert not np.array_equal(states[0].losses, states[2].losses)
    for losses in (state.losses for state in states):
        assert np.isfinite(losses).all() and losses[-10:].mean() < 0.5 * losses[:5].mean()


@pytest.mark.integration
def test_an_interrupted_training_ends_as_if_it_were_not(tmp_path):
    """Bit for bit: weights, the optimizer's memory and losses, through a file."""
    whole = train(toy(), init(toy(), steps=8, seed=2))

    class Interrupt(Exception): ...

    def callback(state):
        if state.step == 5:
            write_checkpoint(tmp_path / "c", state)
            raise Interrupt

    with pytest.raises(Interrupt):
        train(toy(), init(toy(), steps=8, seed=2), callback=callback)
    state = read_checkpoint(tmp_path / "c", toy(), steps=8, seed=2)
    assert state.step == 5 and np.isnan(state.losses[5:]).all()
    assert_equal(train(toy(), state), whole)


def test_checkpoints_of_another_training_are_refused(tmp_path):
    path = tmp_path / "c"
    write_checkpoint(path, init(toy(), steps=8, seed=2))
    with pytest.raises(gs.InputError, match="seed of the training must be 3, as given, got 2"):
        read_checkpoint(path, toy(), steps=8, seed=3)
    for recipe, steps in ((toy(), 9), (toy((-1, 0, 1)), 8)):
        with pytest.raises(gs.InputError, match=f"checkpoint of this network and of {steps} steps"):
            read_checkpoint(path, recipe, steps=steps, seed=2)
    path.write_bytes(b"garbage")
    with pytest.raises(gs.InputError, match="not a whole and valid checkpoint"):
        read_checkpoint(path, toy(), steps=8, seed=2)


def test_the_papers_slices(monkeypatch):
    batch = sample_paper_batch(np.random.default_rng(0), 64)
    assert batch.slices.shape == (10, 1, 64, 64) and batch.truth.shape == (10, 64, 64)
    slices, truth = batch.slices[:, 0], batch.truth
    # Where nothing is drawn and nothing shines over, what is left is the noise of 5 %; the median is over such places.
    dark = slices[truth == 0]
    assert np.percentile(dark, 5) == pytest.approx(-1.64 * 0.05, abs=0.03)
    # A polygon is sharp in its slice, and shines over to the others.
    number = int(truth.sum((1, 2)).argmax())
    beside = slices[number - 1 if number else 1]
    shape = (truth[number] > 0) & (truth[number - 1 if number else 1] == 0)
    assert beside[shape].mean() > beside[truth[number] == 0].mean()
    assert 0 <= truth.min() and truth.max() <= 1
    monkeypatch.setattr(training_data, "draw_objects", lambda size, *_: np.zeros((size, size), np.float32))
    empty = sample_paper_batch(np.random.default_rng(0), 16)
    assert np.isfinite(empty.slices).all() and not empty.truth.any()


@pytest.mark.parametrize("kind", training_data._DRAW)
def test_every_kind_of_object_is_drawn(kind):
    plane = training_data.draw_objects(120, np.random.default_rng(3), 20, (kind,))
    assert plane.shape == (120, 120) and 0 < np.count_nonzero(plane) < plane.size
    assert plane.min() == 0 and plane.max() <= 10


def test_a_sheet_is_shared_out_to_the_planes():
    page = np.ones((60, 60), np.float32)
    sheets = [training_data.lay_on_sheet(page, np.random.default_rng(seed)) for seed in range(8)]
    for scene in sheets:
        np.testing.assert_allclose(scene.sum(0), page, rtol=1e-6)
        assert np.count_nonzero(scene.sum((1, 2))) >= 2
    # Straight ones cross all planes, curved ones may turn back before.
    assert sum((scene.sum((1, 2)) > 0).all() for scene in sheets) >= 2


def test_the_truth_lies_where_the_scene_does():
    scene = np.zeros((2, 8, 6), np.float32)
    scene[0, 2:4, 4:6] = 1
    found = training_data.resample_scene(scene, np.array([20.1, 30.0]), np.array([19.6, 20.0, 20.4]))
    expected = np.zeros((3, 4, 3))
    expected[1:, 1, 2] = 0.75, 0.25
    np.testing.assert_allclose(found, expected, atol=1e-6)


def ramp(planes=5, size=40) -> Stack:
    """A stack whose truth is its volume, different everywhere."""
    volume = np.arange(planes * size * size).reshape(planes, size, size) / (planes * size * size)
    return Stack(volume.astype(np.float16), volume.astype(np.float16))


def test_patches_keep_slices_and_truth_together():
    offsets = (-4, 0, 1)
    batch = sample_patches([ramp(), ramp()], offsets, np.random.default_rng(0), size=16, count=6)
    assert batch.slices.shape == (6, 3, 16, 16)
    np.testing.assert_array_equal(batch.slices[:, 1], batch.truth)
    # Depths are in order, the outermost repeated.
    assert (batch.slices[:, 0] <= batch.truth).all() and (batch.slices[:, 2] >= batch.truth).all()
    assert np.isfinite(batch.slices).all()
    dark = Stack(*np.zeros((2, 4, 20, 20), np.float16))
    assert not sample_patches([dark], (0,), np.random.default_rng(0), size=8, count=2).slices.any()


# Microscopes of few pixels.
TINY = (CaptureSpec(96, 0.045, 0.2, 5),)


@pytest.mark.integration
def test_a_simulated_stack_shows_its_scene():
    one, again, other = (simulate_stack(0, number, TINY) for number in (0, 0, 1))
    assert_equal(one, again)
    assert not np.array_equal(one.volume, other.volume)
    assert len(one.volume) == 5 and one.volume.shape == one.truth.shape
    for stack in (one, other):
        volume, truth = (np.asarray(each, np.float64).ravel() for each in stack)
        assert np.isfinite(volume).all() and truth.min() >= 0
        # The slope of the volume by the truth is one by construction; float16 keeps three digits.
        assert np.polyfit(truth, volume, 1)[0] == pytest.approx(1, abs=0.01)
    empty = simulate_stack(0, 15, TINY)
    assert not empty.truth.any() and np.asarray(empty.volume, np.float32).std() > 0


@pytest.mark.integration
def test_stacks_are_kept(tmp_path):
    folder = tmp_path / "stacks"
    made = simulate_stacks(folder, 2, 5, specs=TINY)
    for a, b in zip(simulate_stacks(folder, 2, 5, specs=TINY), made, strict=True):
        assert_equal(a, b)
    (second,) = folder.glob("5-1-*.npz")
    second.write_bytes(b"garbage")
    with pytest.raises(gs.InputError, match=second.name):
        simulate_stacks(folder, 2, 5, specs=TINY)


def test_stacks_of_other_specs_are_not_read(tmp_path, monkeypatch):
    """Nor of another seed, number or version of the package."""
    names = {_path(tmp_path, *key).name for key in ((5, 1, TINY), (5, 2, TINY), (6, 1, TINY), (5, 1, SPECS))}
    monkeypatch.setattr("gs_jax.base.caches._source", lambda: b"another version")
    assert len(names | {_path(tmp_path, 5, 1, TINY).name}) == 5
    # Of two specs in turn the second stack is of the same one as alone.
    two = _path(tmp_path, 5, 1, (*TINY, *SPECS)).name
    assert two == _path(tmp_path, 5, 1, TINY).name


@pytest.fixture
def toy_command(monkeypatch):
    module = sys.modules["gs_jax.cli.train"]
    monkeypatch.setattr("gs_jax.apps.training.paper_recipe", toy)
    monkeypatch.setattr(module, "_EVERY", 2)

    def invoke(*arguments):
        return CliRunner().invoke(command, ["--network", "paper", *map(str, arguments)])

    return invoke


@pytest.mark.integration
def test_trained_weights_reconstruct(toy_command, tmp_path, monkeypatch):
    """From `train` to the volume: `--weights` is the network of that file and no other."""
    result = toy_command("--steps", 3, "-o", tmp_path / "w.npz")
    assert result.exit_code == 0 and "3 steps" in result.output
    assert {each.name for each in tmp_path.iterdir()} == {"w.npz", "w.npz.json", "w.npz.checkpoint"}
    assert (tmp_path / "w.npz.json").read_text().count(".") >= 3 and read_weights(tmp_path / "w.npz").widths == (4, 8)
    (tmp_path / "design.toml").write_text(DESIGN)
    capture = np.random.default_rng(0).integers(0, 99, (96, 80)).astype(np.uint16)
    gs.write_capture(tmp_path / "capture.tif", capture)
    monkeypatch.chdir(tmp_path)
    options = ("--depths", "18:22:1", "--voxel-um", "50", "--suppress", "unet", "--weights", "w.npz", "-o", "v.tif")
    result = CliRunner().invoke(reconstruct_command, ["capture.tif", "design.toml", *options])
    assert result.exit_code == 0, result.output
    volume, grid = gs.read_volume("v.tif")
    plain = gs.reconstruct(capture, gs.read_design("design.toml").imager(), grid)
    expected = gs.suppress(plain, read_weights("w.npz"))
    np.testing.assert_allclose(volume, expected, rtol=1e-5, atol=1e-5 * expected.max())
    assert not np.allclose(volume, gs.suppress(plain))


@pytest.mark.integration
def test_the_command_goes_on_where_it_was_interrupted(toy_command, tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole.npz", tmp_path / "broken.npz"
    assert toy_command("--steps", 5, "-o", whole).exit_code == 0
    calls = []

    def batch(rng):
        calls.append(rng)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return sample_paper_batch(rng, 16)

    with monkeypatch.context() as patched:
        patched.setattr(sys.modules["gs_jax.apps.training"], "paper_recipe", lambda: toy(batch=batch))
        assert toy_command("--steps", 5, "-o", broken).exit_code == 1
    assert not broken.exists() and side_file(broken, ".checkpoint").exists()
    assert toy_command("--steps", 5, "--resume", "-o", broken).exit_code == 0
    assert_equal(read_weights(broken), read_weights(whole))
    assert side_file(broken, ".json").read_text() == side_file(whole, ".json").read_text()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("-o", "w.txt"), ".npz"),
        (("--resume", "-o", "w.npz"), "w.npz.checkpoint"),
        (("--network", "multislice", "--resume", "-o", "w.npz"), "w.npz.checkpoint"),
    ],
)
def test_wrong_arguments_write_nothing(toy_command, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    result = toy_command("--steps", 5, *arguments)
    assert isinstance(result.exception, gs.InputError) and message in str(result.exception)
    assert not list(tmp_path.iterdir())
