import numpy as np
import pytest
from scipy import stats

from experiments.layout_gain import NAMES, PAIRS, apart, gain, gains, hexagonal, picture, rows, run, spread
from experiments.layout_scenes import METHODS, Study
from gs_jax.base.progress import Progress
from gs_jax.layouts import nearest_neighbour_distances

pytestmark = pytest.mark.integration

ROOMY = Study(plate=(5.0, 5.0), distance=1.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_controls_are_fair(seed):
    """As many lenses as the others, on the plate, no nearer to each other."""
    for centers in (hexagonal(ROOMY, seed, 23, 1.0), spread(ROOMY, seed, 23)):
        assert centers.shape == (23, 2) and np.abs(centers).max() <= 2.5
        assert nearest_neighbour_distances(centers).min() >= 1.0
    wider = nearest_neighbour_distances(spread(ROOMY, seed, 23)).min()
    # As wide as the plate allows: 23 lenses on 25 mm^2 have a pitch of 1.12 mm, and the plate's edge may waste some.
    assert 1.04 < wider < 1.2
    uneven = rows(ROOMY._replace(distance=0.8, candidates=3), seed, 23)
    assert uneven.shape == (3, 23, 2) and np.abs(uneven).max() <= 2.5
    assert min(nearest_neighbour_distances(centers).min() for centers in uneven) >= 0.8


def test_more_lenses_than_there_is_room_for():
    with pytest.raises(ValueError, match="There is room for .* not for 50"):
        hexagonal(ROOMY, 0, 50, 1.0)


def test_lenses_are_parted():
    centers = np.array([[0.0, 0.0], [0.5, 0.1], [-0.3, 0.4], [2.4, 2.4], [2.5, 2.5]])
    found = apart(centers, ROOMY)
    assert nearest_neighbour_distances(found).min() >= 1 and np.abs(found).max() <= 2.5


def test_the_interval_is_that_of_a_paired_t_test():
    rng = np.random.default_rng(0)
    others = rng.normal(size=(5, 30))
    ours = others + rng.normal(0.3, 0.2, (5, 30))
    found = gain(ours.tolist(), others.tolist())
    expected = stats.ttest_rel(ours.mean(1), others.mean(1)).confidence_interval(0.95)
    np.testing.assert_allclose(found["interval"], expected, rtol=1e-9)
    assert found["mean"] == pytest.approx(np.mean(ours - others))


def test_the_picture_and_the_gains():
    rng = np.random.default_rng(0)
    scores = lambda: {name: {f"{m}_psnr_db": rng.normal(size=4).tolist() for m in METHODS} for name in NAMES}
    row = lambda seed: {
        "seed": seed,
        "random_loss_db": [-8.0, -9.0],
        "ours_loss_db": -9.1,
        "rows_loss_db": [-8.9, -9.0],
        "hexagonal_loss_db": [-8.5, -8.6],
        "scores": scores(),
        "centers_mm": {name: [[0.0, 1.0]] for name in NAMES},
    }
    records = [row(0), row(1)]
    assert len(gains(records)) == len(PAIRS) * len(METHODS)
    assert len(picture({"study": Study()._asdict(), "seeds": records}).axes) == 1 + len(NAMES)


@pytest.mark.slow
def test_the_whole_experiment():
    """A tenth of everything."""
    study = Study(pixels=280, pixel=0.0225, candidates=4, scored_on=2, steps=3, held_out=2)
    with Progress() as progress:
        found = run(study, 2, progress=progress)
    assert found["occupancy"] == pytest.approx(5.2, abs=0.6)
    for row in found["seeds"]:
        assert min(row["least_distance_mm"].values()) >= study.distance
        assert all(value >= 1 for value in row["lenses_per_lit_pixel"].values())
        assert np.isfinite([row["scores"][name]["list_rl_psnr_db"] for name in NAMES]).all()
