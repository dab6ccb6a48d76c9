"""Searches and training data by several workers are those of one process."""

from contextlib import contextmanager

import jax
import numpy as np
import pytest

from gs_jax.apps.training import simulate_unrolled_examples
from gs_jax.apps.training_data import SCENES, simulate_stacks
from gs_jax.base.progress import Progress
from gs_jax.codesign.pareto import as_json, trade_off
from gs_jax.codesign.search import run_study
from gs_jax.codesign.study import Study
from gs_jax.codesign.terms import TERMS, Term
from gs_jax.design.start import geomscope

from .test_live import two
from .test_pareto import STUDY
from .test_training import TINY
from .test_unrolled import TINY as TINY_UNROLLED

pytestmark = pytest.mark.integration

__all__ = ["two"]

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
