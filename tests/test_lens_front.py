"""The experiment on what light and a span of depths cost each kind of lens."""

import numpy as np
import pytest

from experiments.lens_front import KINDS, decibels, limits_of, run, shown, study_of
from gs_jax.base.progress import Progress
from gs_jax.design.start import geomscope


def test_light_is_that_of_the_middle():
    """Of a lens at `z + t/n` it falls with the square; at the ends of the span the same light within 2 %."""
    far, near = limits_of(0.2, (15.0, 30.0), geomscope())
    reduced = 1 / 1.43
    assert far == pytest.approx(0.2 * ((20.5 + reduced) / (30 + reduced)) ** 2)
    assert near == pytest.approx(1.02 * 0.2 * ((20.5 + reduced) / (15 + reduced)) ** 2)


def test_spheres_have_no_conic_constant_to_free():
    free = {name: study_of(kind, (18.0, 23.0), 1).free for name, kind in KINDS.items()}
    assert [("conic_constant" in each) for each in free.values()] == [False, True, True, True, True]


@pytest.mark.slow
def test_a_small_front_its_table_and_its_picture():
    names = ("curved side, conic", "curved side, conic, 2 foci")
    found = run([(15.0, 30.0)], (0.1,), names, 3, progress=Progress())
    one, two = (found[0]["fronts"][name][0] for name in names)
    assert two["searched_db"] < one["searched_db"] and not one["off_target"]
    assert np.shape(two["values"]["conic_constant"]) == (2,)
    report = shown(found)
    assert report.files["lens_front.md"].count("\n") == 3 and len(report.files["lens_front.png"].axes) == 1
    assert decibels(0.1) == pytest.approx(-20)
