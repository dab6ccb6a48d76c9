"""What speaks for points, and designs of which none is to be trusted."""

import numpy as np

from gs_jax import Grid, geomscope
from gs_jax.suppression.evidence import LEAST_SHARP, point_evidence, sharpness

from .test_locate import capture_of, find, many, small

DEPTHS = Grid([18.0, 22.0], (3, 3), 1.0)


def test_sharpness_tells_the_design_in_focus_from_the_printed_one():
    """By our tracer's cores: a fifth to a half of the light, and a hundredth."""
    assert 0.15 < sharpness(geomscope(sensor_distance_mm=5.8).imager(), DEPTHS) < 0.5
    assert sharpness(geomscope(sensor_distance_mm=4.0).imager(), DEPTHS) < 0.02 < LEAST_SHARP


def test_evidence_of_points_that_are_there():
    imager, grid = small()
    image = capture_of(many())
    points = find(image)
    found = point_evidence(points, image, imager, grid)
    assert all(len(part) == len(points) for part in found) and len(points)
    assert (found.lit >= 0.7 * found.lenses).all() and (found.lenses >= 3).all()
    assert (found.log10_false_alarms <= -1).all() and (found.signal_to_noise > 5).all()
    nowhere = points + np.array([0.31, 0.27, 0.4, 0.0])
    other = point_evidence(nowhere, image, imager, grid)
    assert np.median(other.log10_false_alarms) > -1 and np.median(other.signal_to_noise) < 5
    # What a file can hold.
    assert found.log10_false_alarms.min() >= -999
    none = point_evidence(np.zeros((0, 4)), image, imager, grid)
    assert all(len(part) == 0 for part in none)
