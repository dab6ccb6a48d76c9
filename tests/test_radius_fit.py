"""The radius that predicts lenses best is nearer to that of the device, and a device as designed is left alone."""

import dataclasses

import numpy as np
import pytest

import gs_jax as gs
from gs_jax.reconstruction.methods import METHODS
from gs_jax.reconstruction.radius_fit import _least, _readout, _with_radii, fit_radius

GRID = gs.Grid([19.0, 20.0, 21.0], (41, 41), 0.1)


def scope(radius: float = 2.0) -> gs.Imager:
    array = gs.MicrolensArray(gs.random_layout(16, (4.0, 4.0), seed=0), radius, 1.43, 1.4, 1.0)
    return gs.Imager(array, gs.Sensor((200, 200), 0.02), 5.8, 2.0)


def captures(imager: gs.Imager) -> list[np.ndarray]:
    """Of short lines, far finer than voxels, with noise."""
    images = []
    for seed in range(1):
        rng = np.random.default_rng(seed)
        ends = np.column_stack([rng.uniform(-1.2, 1.0, (8, 2)), rng.uniform(19, 21, 8)])
        along = np.linspace(0, 0.6, 80)[:, None] * np.array([1.0, 0.3, 0.0])
        lines = (ends[:, None] + along).reshape(-1, 3)
        clean = np.asarray(gs.simulate(np.column_stack([lines, np.ones(len(lines))]), imager), np.float64)
        images.append(rng.poisson(clean * 2000 / clean.max()) + rng.normal(0, 2, clean.shape))
    return images


@pytest.mark.integration
@pytest.mark.parametrize("true, least, most", [(1.03, 1.01, 1.04), (1.0, 1.0, 1.0)])
def test_the_radius_comes_nearer_to_the_device(true, least, most):
    found = fit_radius(captures(scope(2 * true)), scope(), GRID, METHODS["list-rl"](20))
    assert least <= found.factor <= most
    np.testing.assert_allclose(found.imager.array.radius_of_curvature, 2 * found.factor, rtol=1e-6)
    assert dict(found.trials)[found.factor] == min(dict(found.trials).values()) or found.factor == 1


def test_no_capture_is_refused():
    with pytest.raises(gs.InputError, match="a capture or more"):
        fit_radius([], scope(), GRID, METHODS["list-rl"](10))


def test_all_lenses_change_by_one_factor():
    array = dataclasses.replace(scope().array, radius_of_curvature=np.linspace(1.5, 2.5, 16))
    typed = dataclasses.replace(scope(), array=array)
    np.testing.assert_allclose(_with_radii(typed, 1.1).array.radius_of_curvature, np.linspace(1.65, 2.75, 16), 1e-6)
    thin = dataclasses.replace(scope(), array=dataclasses.replace(scope().array, thin_lens_focal_length=4.0))
    np.testing.assert_allclose(_with_radii(thin, 0.9).array.focal_length, 3.6, rtol=1e-6)


@pytest.mark.parametrize("conic, least", [(0.0, 0.35), (-1.0, 0.0), (3.0, 0.7)])
def test_surfaces_still_reach_the_edge_of_their_apertures(conic, least):
    array = dataclasses.replace(scope().array, conic_constant=conic)
    assert _least(dataclasses.replace(scope(), array=array)) == pytest.approx(1.001 * least)


@pytest.mark.parametrize(
    "radius, pitch, shape, binning, margin", [(2.0, 0.1, (66, 66), 3, 0), (0.5, 0.01, (130, 130), 1, 25)]
)
def test_the_middle_keeps_its_place(radius, pitch, shape, binning, margin):
    one = dataclasses.replace(scope(), field_radius=radius)
    readout, margins = _readout(one, GRID.depths, pitch)
    part = readout.sensor(one.sensor)
    assert (part.shape, readout.binning, margins) == (shape, binning, (margin, margin))
    np.testing.assert_allclose(part.origin, 0, atol=0.02)
