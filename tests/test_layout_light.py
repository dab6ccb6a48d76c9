import pytest

from experiments.layout_light import LENSES, layouts, run
from gs_jax.base.progress import Progress

pytestmark = pytest.mark.integration


def test_all_layouts_have_as_many_lenses():
    assert {centers.shape for centers in layouts().values()} == {(LENSES, 2)}


@pytest.mark.slow
def test_run_at_toy_size():
    found = run(["square", "hexagonal"], scenes=1, steps=2, progress=Progress())
    assert all(len(gains) == 1 for level in found["gain_db"].values() for gains in level.values())
    assert abs(found["rank_correlation"]) == 1
