"""The experiment that asks whether objectives rank designs as reconstructed scenes do."""

import numpy as np
import pytest

from experiments.design_ranks import BETTER, SPECIFICATIONS, correlation, random_design, report, shown
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress


@pytest.mark.parametrize("title", SPECIFICATIONS)
def test_random_designs_are_in_focus_or_nearly(title):
    specification = SPECIFICATIONS[title]
    for seed in range(3):
        imager = random_design(specification, seed).imager()
        images = 1 / (
            1 / np.unique(imager.array.focal_length) - 1 / float(imager.reduced_depth(np.mean(specification.span)))
        )
        assert np.abs(float(imager.reduced_sensor_distance) / images - 1).min() < 0.15


def test_too_few_designs_are_refused(tmp_path):
    with pytest.raises(InputError, match="--seeds must be 3 or more, got 2"):
        report(2, tmp_path / "records", Progress())
    assert not (tmp_path / "records").exists()


def test_the_correlation_is_of_ranks():
    a = np.arange(12.0)
    assert correlation(a, np.exp(a))[0] == pytest.approx(1) and correlation(a, -(a**3))[0] == pytest.approx(-1)


def test_designs_of_each_specification_count_relative_to_its_start():
    """A term that ranks as one method does, with an offset for each specification, and against the other."""
    rng, by_name = np.random.default_rng(0), {}
    for offset, title in enumerate(SPECIFICATIONS):
        for number, value in enumerate(rng.normal(size=5)):
            terms = dict.fromkeys(BETTER, value + 100 * offset)
            name = f"random {number}" if number else "start"
            by_name[f"{title}, {name}"] = {"richardson-lucy": value, "unrolled": -value, "terms": terms, "lenses": 100}
    lines = [line for line in shown(by_name).files["design_ranks.md"].splitlines() if line.startswith("| `")]
    assert len(lines) == len(BETTER)
    for line in lines:
        ours, each, theirs, against = (cell.strip() for cell in line.strip("|").split("|")[1:])
        assert ours.startswith("1.00") and each == "1.00 / 1.00 / 1.00"
        assert theirs.startswith("-1.00") and against == "-1.00 / -1.00 / -1.00"
