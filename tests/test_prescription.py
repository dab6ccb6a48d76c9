import numpy as np

from experiments.prescription import LINES, contrast, encircled, picture


def test_a_gaussian_spot():
    """Closed forms: `1 - exp(-r^2 / 2 s^2)` of the light within r; contrast `exp(-2 (pi s k)^2)`.

    Samples of 2 um of a deviation of 12 um: the radius is good to a fraction of a sample.
    """
    axis, deviation = np.arange(-100, 101) * 0.002, 0.012
    spot = np.exp(-(axis[:, None] ** 2 + axis[None] ** 2) / (2 * deviation**2))
    for share in (0.5, 0.8):
        np.testing.assert_allclose(
            encircled(spot, 0.002, share), deviation * np.sqrt(-2 * np.log(1 - share)), atol=0.0005
        )
    np.testing.assert_allclose(contrast(spot, axis), np.exp(-2 * (np.pi * deviation * LINES) ** 2), rtol=1e-6)


def test_the_picture():
    record = {"depth_mm": 20.0, "fwhm_um": 30.0, "most_of_light_um": 50.0, "contrast_of_40_um_lines": 0.3}
    assert len(picture({"a": [record]}).axes) == 3
