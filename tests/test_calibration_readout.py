"""Calibration from a part of the sensor is calibration of the whole."""

import equinox as eqx
import numpy as np
import pytest

from experiments.calibration import device
from gs_jax.calibration.fit import calibrate
from gs_jax.calibration.outcome import picture
from gs_jax.io.camera import Readout

from .test_calibration import POINTS, captures


@pytest.mark.integration
@pytest.mark.parametrize("binning", [1, 2])
def test_a_region_calibrates_the_whole(binning):
    actual, design, _ = device(0)
    row, column, rows, columns = 100, 50, 1200, 1400
    region = Readout(roi=(row, column, rows, columns), binning=binning).sensor(design.sensor)
    images = [
        image[row : row + rows, column : column + columns]
        .reshape(rows // binning, binning, columns // binning, binning)
        .mean((1, 3))
        for image in captures(actual)
    ]
    found = calibrate(images, POINTS, eqx.tree_at(lambda i: i.sensor, design, region))
    np.testing.assert_allclose(found.imager.centers, actual.centers, atol=4e-3)
    assert float(found.imager.sensor_distance) == pytest.approx(float(actual.sensor_distance), abs=1e-2)
    left, right, bottom, top = region.extent
    axes = picture(found).axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == (pytest.approx((left, right)), pytest.approx((bottom, top)))
