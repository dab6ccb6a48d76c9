"""Jobs that other processes do: the same results, whoever does them and whoever dies."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import jax
import numpy as np
import psutil
import pytest

from gs_jax.apps.training import simulate_unrolled_examples
from gs_jax.apps.training_data import SCENES, simulate_stacks
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.base.workers import Workers
from gs_jax.codesign.pareto import as_json, trade_off
from gs_jax.codesign.search import run_study
from gs_jax.codesign.study import Study
from gs_jax.codesign.terms import TERMS, Term
from gs_jax.design.start import geomscope
from gs_jax.io.files import JOURNAL

from .test_pareto import STUDY
from .test_recording import FRAMES, command, files, save, volumes
from .test_training import TINY
from .test_unrolled import TINY as TINY_UNROLLED

pytestmark = pytest.mark.integration


distributed = pytest.importorskip("distributed", reason="needs pip install 'gs-jax[cluster]'")


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


def squares(path: Path):
    """Notes who makes it; the job 7 ends its worker the first time."""
    with open(path / "made", "a") as file:
        file.write(f"{os.getpid()}\n")

    def square(number):
        if number == 7 and not (path / "killed").exists():
            (path / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 5:
            raise InputError("found five.")
        return number**2, os.getpid()

    return square


def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(two, tmp_path):
    found, refused = {}, []
    for number, result in two.mapper(partial(squares, tmp_path))(range(40)):
        try:
            found[number] = result()
        except InputError as error:
            refused.append(str(error))
    assert {number: square for number, (square, _) in found.items()} == {n: n**2 for n in range(40) if n != 5}
    assert refused == ["found five."] and (tmp_path / "killed").exists()
    # Each worker makes the function once: two, and the one that came for another.
    made = (tmp_path / "made").read_text().split()
    assert len(made) == len(set(made)) <= 3 and {str(process) for _, process in found.values()} <= set(made)
    assert str(os.getpid()) not in made


def settings():
    import jax

    return lambda _: (str(jax.numpy.zeros(()).dtype), os.getcwd(), os.environ["NPROC"])


def test_workers_share_the_cores_and_have_this_process_settings(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ((_, result),) = two.mapper(settings)([0])
    dtype, where, threads = result()
    assert (dtype, where) == ("float64", str(tmp_path)) and 2 * int(threads) <= max(2, os.cpu_count() or 1)


def test_no_more_is_taken_than_is_needed(two):
    """However long the recording is."""
    taken = []

    def items():
        for number in range(30):
            taken.append(number)
            yield number

    for done, (_, result) in enumerate(two.mapper(settings)(items())):
        assert result() and len(taken) - done <= 5


def test_in_this_process_jobs_are_done_one_by_one():
    done = []
    with Workers() as workers:
        for number, result in workers.mapper(lambda: done.append)([1, 2]):
            assert len(done) == number - 1
            result()
    assert done == [1, 2] and not Workers().remote


def test_nothing_of_dask_is_imported_unless_it_is_asked_for(folder):
    save("rec.tif", FRAMES[:1].repeat(2, 0))
    code = (
        f"import sys; sys.argv = ['gs-jax', *{command('rec.tif')!r}]\n"
        "from gs_jax.__main__ import main\n"
        "try:\n    main()\nfinally:\n    assert not {'dask', 'distributed', 'trackpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr


def test_what_cannot_work_is_one_line(folder, run, monkeypatch):
    save("rec.tif")
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        monkeypatch.setattr("gs_jax.base.workers._ANSWER", 0.5)
        for options, words in (
            (
                ("--scheduler", address),
                f"--scheduler: no Dask scheduler is reachable at {address}",
            ),
            (("--scheduler", "nowhere"), "--scheduler: no Dask scheduler is reachable at nowhere"),
            (("--scheduler", address, "--workers", "2"), "--workers must not be given together with --scheduler"),
        ):
            status, _, err = run(*command("rec.tif", *options))
            assert status == 2 and words in err and err.count("\n") == 1
    status, _, err = run(*command("capture.tif", "--workers", "2"))
    assert status == 2 and "--workers or --scheduler must be used with a recording" in err
    monkeypatch.setitem(sys.modules, "distributed", None)
    status, _, err = run(*command("rec.tif", "--workers", "2"))
    assert (status, err) == (
        2,
        "gs-jax: distributed is not installed; it comes with pip install 'gs-jax[cluster]'.\n",
    )
    assert not (folder / "v.zarr").exists()


def started(*options):
    """The command as a process, when a few frames of it are written; and its workers."""
    arguments = [sys.executable, "-m", "gs_jax", *command("rec.tif", *options)]
    process = psutil.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    journal, deadline = Path("v.zarr") / JOURNAL, time.monotonic() + 200
    while not (journal.exists() and journal.read_bytes().count(b"\n") > 3) and time.monotonic() < deadline:
        time.sleep(0.01)
    children = process.children(recursive=True)
    return process, [each for each in children if "spawn_main" in " ".join(each.cmdline())]


def numbers():
    """Of the frames in the journal, in its order."""
    return [json.loads(line)["frame"] for line in (Path("v.zarr") / JOURNAL).read_text().splitlines()[1:]]


def test_a_recording_by_workers_one_of_which_is_killed(folder):
    """The same bytes as by one process, each frame once."""
    frames = np.random.default_rng(1).integers(101, 130, (60, 96, 80)).astype(np.uint16)
    frames[50, 40, 40] = 65535
    save("rec.tif", frames)
    process, workers = started("--workers", "2", "--suppress", "clusters", "--points", "p.csv")
    workers[0].kill()
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0 and "60 frames in" in out and "Traceback" not in err, err
    assert "1 frame: pixels filled from neighbours" in out and sorted(numbers()) == list(range(60))
    by_two, points = files(folder / "v.zarr"), (folder / "p.csv").read_bytes()
    arguments = command("rec.tif", "--suppress", "clusters", "--points", "p.csv", "--force")
    subprocess.run([sys.executable, "-m", "gs_jax", *arguments], check=True, capture_output=True)
    by_one = files(folder / "v.zarr")
    for each in (by_two, by_one):
        each.pop(JOURNAL)
        # It says by which command, and what is shown is as bright as the first volume that was done.
        each.pop("zarr.json")
    assert by_two == by_one and points == (folder / "p.csv").read_bytes()


def test_ctrl_c_stops_all_and_the_rest_is_made_by_others(folder, run, monkeypatch):
    # Enough to be interrupted: a frame takes some milliseconds.
    count = 900
    frames = np.random.default_rng(2).integers(100, 3000, (count, 96, 80)).astype(np.uint16)
    save("rec.tif", frames)
    process, workers = started("--workers", "2")
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err, err
    assert err.endswith("gs-jax: interrupted; v.zarr has what is done, and --resume goes on from it\n")
    assert not psutil.wait_procs(workers, timeout=20)[1]
    before = numbers()
    # What it says that it has is there.
    assert len(before) >= 3 and volumes()[before].any((1, 2, 3)).all()
    monkeypatch.setattr("gs_jax.base.workers._ANSWER", 60)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        arguments = command("rec.tif", "--resume", "--scheduler", cluster.scheduler_address)
        status, out, _ = run(*arguments)
    assert status == 0 and f"{count - len(before)} frames in" in out and sorted(numbers()) == list(range(count))
    assert volumes().any((1, 2, 3)).all()


# Searches and training data by several workers are those of one process.


START = geomscope(sensor_distance_mm=4.0).replace(aperture_diameter_mm=1.4)
SEVERAL = Study.model_validate(
    STUDY
    | {
        "free": {"sensor_distance_mm": [2.0, 6.5], "aperture_diameter_mm": [0.1, 1.5]},
        "terms": [{"name": "focus_offset", "at_most": 0.2}, {"name": "light_percent", "maximise": 0.001}],
        "stages": [{"solver": "levenberg-marquardt"}, {"solver": "bfgs", "free": ["aperture_diameter_mm"]}],
        "starts": 4,
        "pareto": [],
    }
)


def assert_same(found, wanted):
    """Threads may share out a sum in another way: rounding, and what a search makes of it."""
    assert found.design.model_dump().keys() == wanted.design.model_dump().keys()
    for name in ("steps", "ends"):
        for a, b in zip(getattr(found.log, name), getattr(wanted.log, name), strict=True):
            assert {key: a[key] for key in ("stage", "start")} == {key: b[key] for key in ("stage", "start")}
            assert a["cost"] == pytest.approx(b["cost"], rel=1e-9, abs=1e-12)
    for a, b in zip(found.after, wanted.after, strict=True):
        np.testing.assert_allclose(a[:2], b[:2], rtol=1e-9)


@pytest.fixture(scope="module")
def alone():
    return run_study(START, SEVERAL)


def test_starts_of_a_search(two, alone, tmp_path):
    assert_same(run_study(START, SEVERAL, workers=two, checkpoint=tmp_path / "c"), alone)


class Interrupted(Progress):
    """After so many parts."""

    left = 2

    @contextmanager
    def counter(self, description, total, *, quarter="", rate="", words=None):
        def advance():
            self.left -= 1
            if not self.left:
                raise KeyboardInterrupt

        yield advance


@pytest.mark.parametrize("first, then", [(True, False), (False, True), (True, True)])
def test_an_interrupted_search_goes_on_whoever_runs_it(two, alone, tmp_path, first, then):
    options = {"checkpoint": tmp_path / "c", "every": 0.0}
    with pytest.raises(KeyboardInterrupt):
        run_study(START, SEVERAL, progress=Interrupted(), workers=two if first else None, **options)
    assert_same(run_study(START, SEVERAL, resume=True, workers=two if then else None, **options), alone)


def test_points_of_a_front(two):
    limits = {"pareto": [{"name": "depth_of_field_mm", "at_least": [3.0, 6.0, 9.0, 12.0]}]}
    study, sizes = Study.model_validate(STUDY | limits), []
    start = geomscope().replace(aperture_diameter_mm=1.4)
    found = trade_off(start, study, workers=two, each=lambda front: sizes.append(len(front.points)))
    np.testing.assert_allclose(found.values, trade_off(start, study).values, rtol=1e-9)
    assert sizes == [1, 2, 3, 4] and len(as_json(found)["points"]) == 4


def test_terms_of_ones_own(two, monkeypatch):
    """A worker has not filled the table. One of ours that was replaced is the replacement there, too, but only then."""

    def found(name, target):
        only = {"free": {"sensor_distance_mm": [2.0, 6.5]}, "starts": 2, "stages": [{"solver": "levenberg-marquardt"}]}
        study = Study.model_validate(STUDY | only | {"pareto": [], "terms": [{"name": name, "equal": target}]})
        return run_study(geomscope(), study, workers=two).design.imaging.sensor_distance_mm

    times = 3
    own = Term("thrice the sensor's distance", lambda imager, at: times * imager.sensor_distance)
    with monkeypatch.context() as patch:
        for name in ("own_mm", "thickness_mm"):
            patch.setitem(TERMS, name, own)
            assert found(name, 15.0) == pytest.approx(5.0, abs=0.01)
    # With the plate, 1 mm. Equal is within 0.1 %.
    assert found("thickness_mm", 5.0) == pytest.approx(4.0, abs=0.01)


def test_training_data(two, tmp_path):
    made = simulate_stacks(tmp_path / "two", SCENES + 1, 5, specs=TINY, workers=two)
    for a, b in zip(made, simulate_stacks(tmp_path / "one", SCENES + 1, 5, specs=TINY), strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_allclose(x, y, rtol=2e-3, atol=2e-3 * np.abs(y).max())


def test_training_cases(two):
    made, alone = (
        simulate_unrolled_examples(SCENES + 1, 0, spec=TINY_UNROLLED, workers=workers) for workers in (two, None)
    )
    for a, b in zip(made, alone, strict=True):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5 * np.abs(y).max(initial=1e-30))
