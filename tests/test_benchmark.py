import csv
import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from gs_jax.apps import benchmark
from gs_jax.apps.benchmark import METHODS, Scene, find_peaks, make_microscope, particle_width, render_points
from gs_jax.projection.operators import ImagingOperator

from .helpers import scene

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def result():
    """In this process: starting one for each method takes seconds."""

    class Here:
        def __init__(self, *_, **__): ...
        def __enter__(self):
            return self

        def __exit__(self, *_): ...
        def submit(self, function, *arguments):
            value = function(*arguments)
            return type("Done", (), {"result": lambda _: value})()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "ProcessPoolExecutor", Here)
        patch.setattr(benchmark, "_REPEATS", 2)
        names = ("backproject", "backproject + clusters", "richardson-lucy", "richardson-lucy, dense", "admm, dense")
        return benchmark.run((16,), methods=names, seeds=(0,))


def test_records_and_files(result, tmp_path):
    records, skipped = result
    assert len(records) == 6 and not skipped and {r["pairs"] for r in records} == {16.0**4}
    assert all(set(record) == set(benchmark.COLUMNS) for record in records)
    benchmark.write(records, [{"method": "m", "pairs": 1.0, "reason": "too slow"}], tmp_path)
    assert json.loads((tmp_path / "benchmark.json").read_text()) == {"records": records}
    with (tmp_path / "benchmark.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(records)
    text = (tmp_path / "benchmark.md").read_text()
    assert text.startswith("Every solver takes 30 steps, converged or not.")
    assert "| richardson-lucy, dense |" in text and "| m | 1.0e+00 | too slow |" in text
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000
    # Dense and matrix-free Richardson-Lucy of one image: the same iteration, in float32.
    psnr = {record["method"]: record["psnr_db"] for record in records}
    assert abs(psnr["richardson-lucy, dense"] - psnr["richardson-lucy"]) < 0.01


def test_objective_of_least_squares(result):
    """Of an empty volume it is 1 by definition; other methods do not minimise it."""
    reached = {record["method"]: record["objective"] for record in result[0]}
    assert 0 < reached.pop("admm, dense") < 0.1 and set(reached.values()) == {None}
    imager, grid, psf = make_microscope(16)
    image, empty = np.arange(256, dtype=np.float32).reshape(16, 16), np.zeros(grid.volume_shape, np.float32)
    operator, solver = ImagingOperator(imager, grid, psf), benchmark.ADMM()
    assert benchmark.relative_objective(empty, image, operator, solver) == pytest.approx(1)


def test_scores_of_nothing_and_of_the_truth():
    imager, grid, _ = make_microscope(16)
    particles, width = np.array([[0.0, 0, 20, 1]]), particle_width(imager)
    s = Scene(np.zeros((16, 16), np.float32), particles, render_points(particles, grid, width))
    floor, best = (benchmark.score(volume, s, grid, width) for volume in (np.zeros_like(s.truth), s.truth))
    assert floor["f1"] == 0 and floor["mse"] == pytest.approx((s.truth**2).mean())
    assert best["f1"] == 1 and best["psnr_db"] == math.inf


def test_rendered_points_and_their_peaks():
    _, grid = scene(voxels=(30, 24), pitch=0.1)
    points = np.array([[0.35, -0.45, 20.0, 2.0], [-0.55, 0.85, 18.1, 1.0]])
    volume = render_points(points, grid, 0.12)
    peaks = find_peaks(volume + 7, grid)  # above any background
    np.testing.assert_allclose(peaks[:, :3], [[0.35, -0.45, 20.0], [-0.55, 0.85, 18.0]], atol=1e-6)  # float32
    # The sum of a Gaussian's samples is its integral when they lie closer than its standard deviation, to 1e-5 here.
    np.testing.assert_allclose(volume[1].sum() * 0.01, 2 * 2 * np.pi * 0.12**2, rtol=1e-5)
    assert find_peaks(np.zeros_like(volume), grid).shape == (0, 4)
    weak = render_points(np.array([[0.35, 0.6, 20.0, 0.7]]), grid, 0.12)
    assert len(find_peaks(volume + weak, grid)) == 3  # 0.35 of the largest
    assert len(find_peaks(volume + 0.8 * weak, grid)) == 2  # 0.28
    between = render_points(np.array([[0.4, -0.4, 20.0, 1.0]]), grid, 0.12)
    assert len(find_peaks(between, grid)) == 1  # not each of four equal voxels


def test_exponents_are_those_of_the_papers_range():
    records = [{"method": "m", "pairs": p, "seconds": p**0.5} for p in (1e6, 1e8, 1e9)]
    beyond = {"method": "m", "pairs": 1e12, "seconds": 1.0}
    assert benchmark.time_exponents([*records, beyond])["m"] == pytest.approx(0.5)


def test_too_large_or_too_slow_methods_are_skipped():
    reason = benchmark.skip_reason("richardson-lucy, dense", 2000, None, 60.0)
    assert reason is not None and "GiB, more than" in reason
    last = {"seconds": 10.0, "pairs": 1e6}
    slow = "would take 100 s an image, more than 60 s"
    assert benchmark.skip_reason("backproject", 100, last, 60.0) == slow
    assert benchmark.skip_reason("backproject", 100, last, 200.0) is None
    assert set(METHODS) > {"backproject", "list-rl", "admm, dense"}


def test_command(result, tmp_path, monkeypatch):
    from gs_jax.cli.presentation import benchmark_command

    monkeypatch.setattr(benchmark, "run", lambda callback, progress: result)
    output = CliRunner().invoke(benchmark_command, ["--out", str(tmp_path / "new")])
    assert output.exit_code == 0 and "benchmark.json" in output.output
    written = json.loads((tmp_path / "new" / "benchmark.json").read_text())
    assert len(written["records"]) == len(result[0]) and written["provenance"]["command"].startswith("gs-jax")
