"""The radius that predicts lenses best is nearer to that of the device, and a device as designed is left alone."""

import dataclasses

import numpy as np
import pytest

import gs_jax as gs
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.radius_fit import _bounds, _middle, fit_radius, with_radii

GRID = gs.Grid([19.0, 20.0, 21.0], (41, 41), 0.1)


def scope(radius: float = 2.0) -> gs.Imager:
    array = gs.MicrolensArray(gs.random_layout(16, (4.0, 4.0), seed=0), radius, 1.43, 1.4, 1.0)
    return gs.Imager(array, gs.Sensor((200, 200), 0.02), 5.8, 2.0)


def captures(imager: gs.Imager) -> list[np.ndarray]:
    """Of short lines, far finer than voxels, with noise."""
    images = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        ends = np.column_stack([rng.uniform(-1.2, 1.0, (8, 2)), rng.uniform(19, 21, 8)])
        along = np.linspace(0, 0.6, 80)[:, None] * np.array([1.0, 0.3, 0.0])
        lines = (ends[:, None] + along).reshape(-1, 3)
        clean = np.asarray(gs.simulate(np.column_stack([lines, np.ones(len(lines))]), imager), np.float64)
        images.append(rng.poisson(clean * 2000 / clean.max()) + rng.normal(0, 2, clean.shape))
    return images


# Nearer to the true factor than 1 is: the fit may be 1 to 2 % off.
@pytest.mark.integration
@pytest.mark.parametrize("true, least, most", [(1.03, 1.01, 1.04), (1.0, 1.0, 1.0)])
def test_the_radius_comes_nearer_to_the_device(true, least, most):
    found = fit_radius(captures(scope(2 * true)), scope(), GRID, METHODS["list-rl"](20))
    assert least <= found.factor <= most
    np.testing.assert_allclose(found.imager.array.radius_of_curvature, 2 * found.factor, rtol=1e-6)
    assert dict(found.trials)[found.factor] == min(dict(found.trials).values()) or found.factor == 1


def test_all_lenses_change_by_one_factor():
    array = dataclasses.replace(scope().array, radius_of_curvature=np.linspace(1.5, 2.5, 16))
    typed = dataclasses.replace(scope(), array=array)
    np.testing.assert_allclose(with_radii(typed, 1.1).array.radius_of_curvature, np.linspace(1.65, 2.75, 16), 1e-6)
    thin = dataclasses.replace(scope(), array=dataclasses.replace(scope().array, thin_lens_focal_length=4.0))
    np.testing.assert_allclose(with_radii(thin, 0.9).array.focal_length, 3.6, rtol=1e-6)


@pytest.mark.parametrize(
    "change, least, most",
    [
        ({"conic_constant": 3.0}, 0.94, 1.06),
        ({"aperture_diameter": 3.9}, 0.98, 1.06),
        ({"aspheric_terms": [-0.265]}, 0.94, 1.02),
        ({"aperture_diameter": 5.0}, 1.0, 1.0),
    ],
)
def test_surfaces_still_fall_outward_to_the_edges_of_their_apertures(change, least, most):
    one = dataclasses.replace(scope(), array=dataclasses.replace(scope().array, **change))
    np.testing.assert_allclose(_bounds(one), (least, most), atol=1e-9)


@pytest.mark.integration
def test_captures_without_light_are_not_counted():
    dark = np.zeros((200, 200))
    found = fit_radius([dark], scope(), GRID, METHODS["list-rl"](1), optics="near")
    assert found.factor == 1 and {error for _, error in found.trials} == {0.0}


@pytest.mark.parametrize(
    "images, method, said",
    [
        ([], "list-rl", "a capture or more"),
        ([np.zeros((200, 201))], "list-rl", "the sensor's shape"),
        ([np.zeros((200, 200))], "surface", "free voxels"),
    ],
)
def test_wrong_input(images, method, said):
    with pytest.raises(gs.InputError, match=said):
        fit_radius(images, scope(), GRID, METHODS[method](10))


@pytest.mark.parametrize("radius, pitch, binning, margin", [(2.0, 0.1, 3, 0), (0.5, 0.01, 1, 34)])
def test_the_middle_keeps_its_place(radius, pitch, binning, margin):
    """A marked pixel of an oblong sensor beside the axis is where the sensor of the middle says."""
    one = dataclasses.replace(scope(), field_radius=radius, sensor=gs.Sensor((200, 230), 0.02, (0.3, -0.2)))
    part, grid, cut, judged = _middle(one, GRID.depths, pitch)
    rows, columns = part.sensor.shape
    assert round(part.sensor.pixel_pitch / 0.02) == binning and grid.origin.tolist() == list(part.sensor.origin)
    assert judged.sum() == (rows - 2 * margin) * (columns - 2 * margin)
    image = np.zeros(one.sensor.shape, np.float32)
    image[107, 101] = 1
    found = np.asarray(part.sensor.to_mm(np.argwhere(cut(image))[0]))
    # Within a pixel of the middle.
    half = 0.01 * (binning - 1)
    np.testing.assert_allclose(found, one.sensor.to_mm(np.array([107, 101])), atol=half + 1e-6)
