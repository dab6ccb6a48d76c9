import csv
import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from gs_jax.apps import benchmark_report as report, method_benchmark as compare
from gs_jax.apps.benchmark_scenes import Case, bench, peaks, scores, spots
from gs_jax.apps.method_benchmark import METHODS, obstacle, run, slopes

from .helpers import scene

pytestmark = pytest.mark.integration

KEYS = {"method", "pairs", "seconds", "compile_seconds", "peak_mib", "psnr_db", "ssim", "mse", "f1", "seed"}
# Of the solvers of least squares a number.
KEYS |= {"objective"}


@pytest.fixture(scope="module")
def found():
    """In this process: starting one for each method takes seconds."""

    class Here:
        def __init__(self, *_, **__): ...
        def __enter__(self):
            return self

        def __exit__(self, *_): ...
        def submit(self, function, *arguments):
            result = function(*arguments)
            return type("Done", (), {"result": lambda _: result})()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "ProcessPoolExecutor", Here)
        patch.setattr(compare, "_REPEATS", 2)
        names = ("backproject", "backproject + clusters", "richardson-lucy", "richardson-lucy, dense", "admm, dense")
        return run((16,), methods=names, seeds=(0,))


def test_records_and_files(found, tmp_path):
    records, left_out = found
    assert len(records) == 6 and not left_out
    assert all(set(record) == KEYS for record in records)
    assert {r["pairs"] for r in records} == {16.0**4}
    report.write(records, [{"method": "m", "pairs": 1.0, "reason": "too slow"}], tmp_path)
    assert json.loads((tmp_path / "benchmark.json").read_text()) == {"records": records}
    with (tmp_path / "benchmark.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(records)
    text = (tmp_path / "benchmark.md").read_text()
    assert text.startswith("Every solver takes 30 steps, converged or not.")
    assert "| richardson-lucy, dense |" in text and "| m | 1.0e+00 | too slow |" in text
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000


def test_the_matrix_is_the_operator(found):
    """Dense and matrix-free Richardson-Lucy of one image: the same iteration, in float32."""
    psnr = {record["method"]: record["psnr_db"] for record in found[0]}
    assert abs(psnr["richardson-lucy, dense"] - psnr["richardson-lucy"]) < 0.01


def test_what_least_squares_reached_is_told(found):
    """Of an empty volume it is 1 by definition; that of other methods is not what they minimise."""
    reached = {record["method"]: record["objective"] for record in found[0]}
    assert 0 < reached.pop("admm, dense") < 0.1 and set(reached.values()) == {None}
    at = bench(16)
    image = np.arange(256, dtype=np.float32).reshape(16, 16)
    volume = np.zeros(at.grid.volume_shape, np.float32)
    assert compare.objective(volume, image, at, compare.ADMM()) == pytest.approx(1)


def test_the_floor_scores_as_zeros_do():
    at = bench(16)
    particles = np.array([[0.0, 0, 20, 1]])
    c = Case(np.zeros((16, 16), np.float32), particles, spots(particles, at.grid, at.width))
    floor, best = scores(np.zeros_like(c.truth), c, at), scores(c.truth, c, at)
    assert floor["f1"] == 0 and floor["mse"] == pytest.approx((c.truth**2).mean())
    assert best["f1"] == 1 and best["psnr_db"] == math.inf


def test_spots_and_their_peaks():
    _, grid = scene(voxels=(30, 24), pitch=0.1)
    points = np.array([[0.35, -0.45, 20.0, 2.0], [-0.55, 0.85, 18.1, 1.0]])
    volume = spots(points, grid, 0.12)
    found = peaks(volume + 7, grid)  # above any background
    np.testing.assert_allclose(found[:, :3], [[0.35, -0.45, 20.0], [-0.55, 0.85, 18.0]], atol=1e-6)  # float32
    # The sum of a Gaussian's samples is its integral when they lie closer than its standard deviation, to 1e-5 here.
    np.testing.assert_allclose(volume[1].sum() * 0.01, 2 * 2 * np.pi * 0.12**2, rtol=1e-5)
    assert peaks(np.zeros_like(volume), grid).shape == (0, 4)
    weak = spots(np.array([[0.35, 0.6, 20.0, 0.7]]), grid, 0.12)
    assert len(peaks(volume + weak, grid)) == 3  # 0.35 of the largest
    assert len(peaks(volume + 0.8 * weak, grid)) == 2  # 0.28
    between = spots(np.array([[0.4, -0.4, 20.0, 1.0]]), grid, 0.12)
    assert len(peaks(between, grid)) == 1  # not each of four equal voxels


def test_slopes_are_those_of_the_papers_range():
    records = [{"method": "m", "pairs": p, "seconds": p**0.5} for p in (1e6, 1e8, 1e9)]
    beyond = {"method": "m", "pairs": 1e12, "seconds": 1.0}
    assert slopes([*records, beyond])["m"] == pytest.approx(0.5)


def test_what_is_too_large_or_too_slow_is_left_out_in_words():
    reason = obstacle("richardson-lucy, dense", 2000, None, 60.0)
    assert reason is not None and "GiB, allowed:" in reason
    last = {"seconds": 10.0, "pairs": 1e6}
    assert obstacle("backproject", 100, last, 60.0) == "would take 100 s an image, allowed: 60 s"
    assert obstacle("backproject", 100, last, 200.0) is None
    assert set(METHODS) > {"backproject", "list-rl", "admm, dense"}


def test_command(found, tmp_path, monkeypatch):
    from gs_jax.cli.designs import info_command as info
    from gs_jax.cli.presentation import benchmark_command as command

    monkeypatch.setattr("gs_jax.apps.method_benchmark.run", lambda each, progress: found)
    result = CliRunner().invoke(command, ["--out", str(tmp_path / "new")])
    assert result.exit_code == 0 and "benchmark.json" in result.output
    written = tmp_path / "new" / "benchmark.json"
    assert len(json.loads(written.read_text())["records"]) == len(found[0])
    assert CliRunner().invoke(info, [str(written)]).output.splitlines()[1].split()[:2] == ["command", "gs-jax"]
