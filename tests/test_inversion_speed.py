"""Times of models and methods, of one checkout or of two, at toy size."""

from contextlib import contextmanager

import jax
import numpy as np
import pytest

from experiments import inversion_speed, timed_calls
from experiments.fig9_benchmark import Scene
from gs_jax import Grid, InputError, Progress

from .test_matrix import cropped

pytestmark = pytest.mark.integration


def scene() -> Scene:
    imager = cropped("geomscope", lenses=12, shape=(300, 280)).imager()
    grid = Grid.over(imager.sensor, depths=[18.0, 20.0], pitch=0.08)
    truth = np.zeros(grid.volume_shape, np.float32)
    truth[:, 5:7, 4:9] = 1
    return Scene(np.random.default_rng(0).poisson(20, (300, 280)).astype(np.float32), imager, grid, truth)


def test_the_lines_of_both_checkouts(monkeypatch, tmp_path):
    asked = []

    @contextmanager
    def process(checkout, name, data):
        calls = timed_calls.calls_of(name, scene())
        measure = lambda: {key: timed_calls.measure(name, call, scene()) for key, call in calls.items()}
        yield lambda: asked.append(checkout) or measure()

    monkeypatch.setattr(inversion_speed, "process", process)
    results = inversion_speed.run(["near", "list-rl"], "", tmp_path, Progress())
    lines = ("near model: tables", "near model", "near model, adjoint", "list-rl")
    assert list(results) == [f"{line}, {which}" for line in lines for which in ("before", "now")]
    assert asked == [tmp_path, inversion_speed.HERE] * 2 * (1 + inversion_speed.ROUNDS)
    row = results["list-rl, now"]
    assert row.keys() == {"first_s", "clock_s", "processor_s", "faster", "memory_mib", "db"}
    assert row["faster"] == results["list-rl, before"]["clock_s"] / row["clock_s"]


def test_launches_are_counted():
    """Those of a processor's threads, in place of an accelerator's streams."""
    double = jax.jit(lambda x: jax.numpy.fft.fft(x).real * 2)
    assert timed_calls.launches(lambda: double(np.ones(8)).block_until_ready(), "/host:", "") > 0


def test_a_process_has_the_package_of_a_checkout(monkeypatch, tmp_path):
    (tmp_path / "gs_jax").mkdir()
    (tmp_path / "gs_jax/__init__.py").write_text("raise SystemExit('of the other checkout')")
    with inversion_speed.process(tmp_path, "near", "") as ask, pytest.raises(ValueError):
        ask()


def test_what_is_no_checkout_is_said(tmp_path):
    with pytest.raises(InputError, match="--beside must be a checkout"):
        inversion_speed.report(None, ["full"], tmp_path, Progress())
