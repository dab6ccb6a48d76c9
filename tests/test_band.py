"""Emission bands: their wavelengths, and PSFs that are means over them."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import gs_jax as gs
from gs_jax import InputError
from gs_jax.design.datasheets import datasheet, format_band
from gs_jax.optics.psf import psf_of_depth
from gs_jax.optics.pupil import emission_lines
from gs_jax.projection.point_sources import full_image_of_points


def design(**values) -> gs.Design:
    """Three lenses of PMMA on a small sensor, behind a filter of BK7, in water."""
    filters = {"object": [{"thickness_mm": 2.0, "refractive_index": "BK7"}]}
    layers = [{"thickness_mm": 0.17, "refractive_index": "BK7"}]
    water = {"refractive_index": "water", "surface_mm": 17.0, "layers": layers}
    whole = {
        "centers_mm": [[0.0, 0.0], [1.2, 0.1], [-0.3, 1.1]],
        "size_mm": [4.0, 4.0],
        "shape": [301, 301],
        "pixel_pitch_um": 18.0,
        "refractive_index": "PMMA",
        "radius_of_curvature_mm": 2.3,
        "aperture_diameter_mm": 1.0,
        "working_distance_mm": [18.0, 22.0],
    }
    return gs.geomscope().replace(layers=filters, sample=water, **(whole | values))


def test_an_even_band_has_its_mean_and_variance():
    band: Any = design(bandwidth_nm=40.0).imager().band
    weights, wavelengths = np.asarray(band.weights), 1e6 * np.asarray(band.wavelengths)
    assert weights.sum() == pytest.approx(1)
    assert weights @ wavelengths == pytest.approx(520.0)
    assert weights @ (wavelengths - 520) ** 2 == pytest.approx(40**2 / 12)
    # Normal dispersion everywhere: shorter waves have larger indices.
    for shifts in (band.lens, band.filters[:, 0], band.sample, band.cover[:, 0]):
        assert shifts[0] > 0 > shifts[-1]


def test_a_spectrum_of_a_file(tmp_path):
    gs.write_design(tmp_path / "plain.toml", design())
    wavelength = np.arange(500.0, 561.0, 2.0)
    light = np.exp(-(((wavelength - 515) / 12) ** 2))
    rows = "\n".join(f"{a},{b}" for a, b in zip(wavelength, light, strict=True))
    (tmp_path / "gfp.csv").write_text(f"wavelength_nm,light\n{rows}\n")
    text = (tmp_path / "plain.toml").read_text().replace("[imaging]", '[imaging]\nspectrum_file = "gfp.csv"')
    (tmp_path / "mine.toml").write_text(text)
    band: Any = gs.read_design(tmp_path / "mine.toml").imager().band
    mean = (wavelength * light).sum() / light.sum()
    assert float(1e6 * band.weights @ band.wavelengths) == pytest.approx(mean, abs=0.2)
    np.testing.assert_allclose(band.weights, 0.2, atol=0.01)
    gs.write_design(tmp_path / "again.toml", gs.read_design(tmp_path / "mine.toml"))
    assert gs.read_design(tmp_path / "again.toml") == gs.read_design(tmp_path / "mine.toml")


@pytest.mark.integration
def test_psfs_are_means_over_the_wavelengths():
    scope = design(bandwidth_nm=60.0).imager()
    lines = emission_lines(scope)
    mine = psf_of_depth(scope, [20.0], "gaussian")(20.0)
    size = mine.shape[0] // 2
    each = [psf_of_depth(one, [20.0], "gaussian")(20.0) for _, one in lines]
    middle = [psf[psf.shape[0] // 2 - 3 : psf.shape[0] // 2 + 4, psf.shape[0] // 2] for psf in each]
    mean = sum(float(weight) * np.asarray(part) for (weight, _), part in zip(lines, middle, strict=True))
    np.testing.assert_allclose(mine[size - 3 : size + 4, size], mean, rtol=1e-3)
    point = np.array([[0.2, -0.1, 20.0, 1.0]])
    whole = full_image_of_points(point, scope)
    parts = [float(weight) * np.asarray(full_image_of_points(point, one)) for weight, one in lines]
    np.testing.assert_allclose(whole.sum(), np.sum(parts), rtol=0.02)
    assert np.corrcoef(whole.ravel(), np.sum(parts, 0).ravel())[0, 1] > 0.99


def test_lines_are_imagers_at_their_wavelengths():
    mine = design(bandwidth_nm=40.0)
    for (_, one), wavelength in zip(emission_lines(mine.imager()), (504.508, 520.0, 535.492), strict=True):
        own = mine.imager(wavelength_nm=wavelength)
        for a, b in zip(*map(jnp.ravel, (one.reduced_depth(20.0), own.reduced_depth(20.0))), strict=True):
            assert float(a) == pytest.approx(float(b), rel=1e-6)
        assert float(one.array.focal_length) == pytest.approx(float(own.array.focal_length), rel=1e-6)
        assert one.band is None and own.band is None
    ((weight, same),) = emission_lines(scope := mine.imager(wavelength_nm=500.0))
    assert weight == 1 and same is scope


def test_a_datasheet_says_what_the_band_changes():
    sheet = datasheet(design(bandwidth_nm=60.0), [20.0])
    focus = sheet["band_focus_distance_mm"]
    assert len(focus) == 3 and focus[0] < focus[1] < focus[2]
    assert "nm, the image moves by" in format_band(sheet)
    assert "band_nm" not in datasheet(design(), [20.0])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"bandwidth_nm": 600.0}, "below `imaging.wavelength_nm`"),
        ({"bandwidth_nm": 40.0, "spectrum_nm": [[500.0, 1.0], [540.0, 1.0]]}, "only one of"),
        ({"spectrum_nm": [[520.0, 1.0]]}, "two or more"),
        ({"spectrum_nm": [[600.0, 1.0], [640.0, 1.0]]}, "within 600 to 640 nm"),
        ({"bandwidth_nm": 300.0}, "wavelength"),
    ],
)
def test_bands_that_cannot_be(values, words):
    with pytest.raises(InputError, match=words):
        design(**values).imager()


def test_a_design_is_not_made_of_an_imager_with_a_band():
    with pytest.raises(InputError, match="`band` must be None"):
        gs.Design.from_imager(design(bandwidth_nm=40.0).imager(), name="mine", working_distance_mm=(18.0, 22.0))
    plain = dataclasses.replace(design(bandwidth_nm=40.0).imager(), band=None)
    assert gs.Design.from_imager(plain, name="mine", working_distance_mm=(18.0, 22.0)).imaging.bandwidth_nm == 0
