import pytest

from experiments.ray_traced_captures import run
from gs_jax.base.progress import Progress

from .helpers import needs

pytestmark = pytest.mark.integration


def test_every_one_of_120_ray_traced_points_is_a_peak():
    """Coarser than the experiment, which finds all: 0.03 mm voxels, 0.2 mm steps."""
    needs("geomscope/centers.csv")
    data = needs("oracle/dev/P1_d.tif").parent
    result, projection = run(data, singles=["a"], voxel_mm=0.03, step_mm=0.2, progress=Progress())
    assert projection.ndim == 2 and projection.max() > 0
    (single,) = result["single_points"]
    assert single["lateral_error_um"] <= 20 and abs(single["axial_error_um"]) <= 100
    many = result["many_points"]
    assert many["points_that_are_peaks"] >= 0.95 * many["points"]
    assert many["points_among_as_many_brightest_peaks"] >= 0.9 * many["points"]
    assert many["lateral_rmse_um"] <= 20  # half a voxel's diagonal is 21
