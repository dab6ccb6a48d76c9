import numpy as np
import pytest

from experiments.optics_check import SHAPES, breakdown, compare, curves, run, spots, summary
from gs_jax import Imager, Layers, MicrolensArray, Sample, Sensor

from .helpers import needs

LENS = {"refractive_index": 1.5, "substrate_thickness": 0.7}
# A filter, a window before the sensor, and a cover slip on water.
LAYERS = {
    "filters": Layers([0.4, 2.0], [1.0, 1.52]),
    "windows": Layers([0.6, 0.55], [1.0, 1.51]),
    "sample": Sample(1.33, 15.0, Layers([0.17], [1.523])),
}
# Lens, sensor distance, layers, depth, radius of the pupil, and the tolerance of its widths: Optiland meets an asphere
# by Newton's steps.
DEVICES = {
    "sphere": ({"radius_of_curvature": 2.2}, 4.9, {}, 17.0, 0.8, 1e-9),
    **{name: (lens, 4.2, {}, 17.0, 0.8, 1e-8) for name, lens in SHAPES.items()},
    "layers, plano": ({"orientation": "plano"}, 4.2, LAYERS, 18.0, 0.6, 1e-8),
    "layers, curved": ({"orientation": "curved"}, 4.2, LAYERS, 18.0, 0.6, 1e-8),
}


@pytest.mark.integration
@pytest.mark.parametrize("field", [0.0, 3.0])
@pytest.mark.parametrize("name", DEVICES)
def test_optiland_has_the_same_rays(name, field):
    """Identical formulas but for rounding: 1e-14 of 25 mm, and 1e-9 mm in the search for the entry point."""
    pytest.importorskip("optiland")
    lens, distance, layers, depth, radius, tolerance = DEVICES[name]
    array = MicrolensArray([[0.0, 0.0]], **LENS, **lens)
    row = compare(Imager(array, Sensor((3, 3), 0.0045), distance, 3.0, **layers), depth, field, radius=radius)
    assert row["landing_difference_nm"] < 1e-3 and row["path_difference_waves"] < 1e-6
    np.testing.assert_allclose(row["spot_rms_um"], row["spot_rms_optiland_um"], rtol=tolerance)
    np.testing.assert_allclose(row["wavefront_rms_waves"], row["wavefront_rms_optiland_waves"], rtol=100 * tolerance)


@pytest.mark.integration
def test_strehl_ratio_beside_huygens_sum_over_optilands_rays():
    pytest.importorskip("optiland")
    result = run(fields=(0.0, 2.0), depths=(20.0,))
    for row in result["field"] + result["depth"]:
        # The sum has no obliquity: slopes of 0.2 change amplitudes by 2 to 4 %.
        np.testing.assert_allclose(row["strehl"], row["strehl_optiland"], rtol=0.05)
    assert len(curves(result).axes) == 4


@pytest.mark.integration
@pytest.mark.parametrize(("design", "place", "size_tolerance"), [("P1", "core_px", 0.15), ("P2", "centroid_px", 0.02)])
def test_ray_traced_spots_are_where_we_say_and_as_large(design, place, size_tolerance):
    """In focus the core, out of focus the whole disc: much of a halo is below a count of the camera."""
    needs("geomscope/centers.csv")
    data = needs(f"oracle/dev/{design}_a.tif").parent
    found = summary(spots(data, "a", design, reach=1.6))
    assert found["spots"] >= 3
    # Shot noise: tenths of a pixel at most.
    assert found[f"rays_to_{place}"][1] < 0.3
    np.testing.assert_allclose(found["rays_half_light_ratio"], 1, atol=size_tolerance)
    assert found["light_over_area_and_envelope_relative_sd"] < 0.03


@pytest.mark.integration
def test_equation_9_breaks_down():
    small, large = breakdown(radii=(0.4, 0.65))
    # Up to 0.1 waves it leaves out 2 %; at 0.3 it is not even the right size.
    assert small["wavefront_rms_waves"] < 0.1 and abs(small["equation_9"] / small["strehl"] - 1) < 0.02
    assert large["wavefront_rms_waves"] > 0.25 and large["equation_9"] < 0.5 * large["strehl"]
