"""What speaks for points, and designs of which none is to be trusted."""

import dataclasses

import numpy as np
import pytest

from gs_jax import Grid, Sensor, geomscope
from gs_jax.detection import evidence
from gs_jax.detection.consistency import signal
from gs_jax.detection.evidence import point_evidence
from gs_jax.detection.locate import searched_voxels
from gs_jax.optics.lens_types import MIN_SHARPNESS, sharpness
from gs_jax.optics.psf_core import apparent_depths

from .test_locate import capture_of, find, many, small

DEPTHS = Grid([18.0, 22.0], (3, 3), 1.0)


def test_sharpness_tells_the_design_in_focus_from_the_printed_one():
    """By our tracer's cores: a fifth to a half of the light, and a hundredth."""
    assert 0.15 < sharpness(geomscope(sensor_distance_mm=5.8).imager(), DEPTHS) < 0.5
    assert sharpness(geomscope(sensor_distance_mm=4.0).imager(), DEPTHS) < 0.02 < MIN_SHARPNESS


def test_places_are_counted_where_cores_are_looked_for(monkeypatch):
    """As many as `find_points` searches, between the apparent depths; and a signal is not smoothed again."""
    imager = dataclasses.replace(geomscope().imager(), sensor=Sensor((64, 64), 0.05))
    grid, count, seen = Grid([18.0, 22.0], (5, 5), 0.04), evidence.count_of, []
    monkeypatch.setattr(evidence, "count_of", lambda voxels: seen.append(voxels) or count(voxels))
    monkeypatch.setattr(evidence, "signal", None)
    light = signal(np.random.default_rng(0).normal(size=(64, 64)))
    point_evidence(np.array([[0.1, 0.2, 20.0, 1.0]]), light, imager, grid)
    (voxels,) = seen
    searched = searched_voxels(imager, grid.at(apparent_depths(imager, grid.depths)))
    np.testing.assert_allclose(voxels.depths, searched.depths, rtol=1e-6)
    assert abs(float(voxels.depths[1] - searched_voxels(imager, grid).depths[1])) > 0.01


@pytest.mark.integration
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
