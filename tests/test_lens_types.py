"""Images by lenses that differ, type by type."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import gs_jax as gs
from gs_jax.detection.background import DetectionImage
from gs_jax.detection.view_samples import LensType, detection_stats, sample_views, sample_views_by_type
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.optics.apertures import split_by_type
from gs_jax.optics.psf_core import type_weights
from gs_jax.simulation import random_points

from .test_full import grid, imager, volume
from .test_point_finder import small

# Radii of two types: f of 4.65 and 5.1 mm.
RADII = np.array([2.0, 2.2, 2.0, 2.2, 2.0, 2.2, 2.0, 2.2, 2.0])


def differing(scope: gs.Imager, radii=RADII, **numbers) -> gs.Imager:
    array = dataclasses.replace(scope.array, radius_of_curvature=jnp.asarray(radii, scope.sensor_distance.dtype))
    return eqx.tree_at(lambda i: i.array, scope, dataclasses.replace(array, **numbers))


@pytest.mark.integration
def test_the_image_is_the_sum_of_the_kinds():
    """And of types with the same numbers nothing but what one type is, up to the cores of a mean lens."""
    scope, voxels = imager(), grid(shape=(7, 6))
    x = volume(voxels.volume_shape)
    whole = gs.forward(x, scope, voxels, gs.psf_model(scope, voxels, "near"))
    # A number that changes nothing, but is another.
    almost = differing(scope, np.where(RADII > 2, 2.0 + 1e-9, 2.0))
    assert len(lenses_by_type(almost.array)) == 2
    parts = gs.forward(x, almost, voxels, gs.psf_model(almost, voxels, "near"))
    # One PSF is of the mean clear area of all lenses, the other of each type's own.
    np.testing.assert_allclose(parts.sum(), whole.sum(), rtol=0.02)
    np.testing.assert_allclose(parts, whole, atol=0.05 * float(whole.max()))


def test_a_sharp_lens_counts_more():
    """At 18 mm lenses of f = 4.65 mm are sharp at 5.75 mm, at 60 mm those of 5.1 mm; of equal lenses all count."""
    scope = imager(pixels=(960, 810), pitch=0.006)
    lenses = lenses_by_type(differing(scope).array)
    weights = type_weights(split_by_type(differing(scope), lenses), np.array([18.0, 45.0]), 0.03)
    assert weights[0, 0] > 1.2 > 0.8 > weights[1, 0] and weights[1, 1] > weights[0, 1]
    np.testing.assert_allclose(np.array([5, 4]) @ weights / 9, 1)


@pytest.mark.integration
def test_back_projection_adds_kinds_by_weight():
    scope, voxels = differing(imager()), grid(shape=(7, 6))
    image = np.asarray(gs.simulate(np.array([[0.2, -0.1, 20.0, 1.0]]), scope))
    assert gs.reconstruct(image, scope, voxels).shape == voxels.volume_shape
    flat = gs.reconstruct(np.ones_like(image), scope, voxels, gs.BackProjection(normalize=True))
    np.testing.assert_allclose(flat[flat > 0], 1, rtol=1e-5)
    by_rays = gs.reconstruct(image, scope, voxels, optics="pinhole")
    np.testing.assert_array_equal(by_rays, np.asarray(gs.backproject(image, imager(), voxels), np.float32))
    found = gs.reconstruct(image, scope, voxels, gs.RichardsonLucy(steps=2), optics="near")
    assert np.isfinite(found).all() and found.max() > 0
    # On the pixels of each type's own cores, as back-projection.
    for method in (gs.PinholeRichardsonLucy(steps=2), gs.Unrolled.pretrained()):
        found = gs.reconstruct(image, scope, voxels, method)
        assert np.isfinite(found).all() and found.max() > 0


@pytest.mark.integration
def test_points_of_lenses_with_several_apertures():
    """Ideal lenses, a third of them wider: the points that are there, and nothing else."""
    scope, voxels = small()
    array = dataclasses.replace(scope.array, aperture_diameter=jnp.where(jnp.arange(49) % 3 == 0, 1.1, 0.9))
    scope = eqx.tree_at(lambda i: i.array, scope, array)
    points = random_points(8, (4.0, 4.0), (19.2, 20.8), seed=2)
    image = gs.simulate(points, scope, optics="near", psf="geometric")
    found = gs.find_points(image, scope, voxels)
    apart = found[:, None, :3] - points[:, :3]
    # Half a pixel in the object laterally. 0.1 mm axially moves no spot by more than a third of a pixel.
    near = (np.hypot(apart[..., 0], apart[..., 1]) < 0.016) & (np.abs(apart[..., 2]) < 0.1)
    assert len(found) == len(points) and (near.sum(0) == 1).all() and (near.sum(1) == 1).all()
    evidence = detection_stats(found, image, scope, voxels)
    assert (evidence.lit >= 0.7 * evidence.lenses).all() and (evidence.lenses > 6).all()


def test_only_kinds_that_are_sharp_read_points():
    scope, _ = small()
    light = DetectionImage(*np.ones((2, *scope.sensor.shape), np.float32))
    ends, flat = np.array([19.0, 21.0]), np.ones(2)
    one, other = split_by_type(scope, (tuple(range(20)), tuple(range(20, 49))))
    types = [LensType(one, ends, flat, flat), LensType(other, ends, 1.01 * flat, np.array([1.0, 0.0]))]
    points = np.array([[0.1, 0.2, 19.2], [0.1, 0.2, 20.8]])
    seen, all_ = sample_views_by_type(points, light, types), sample_views(points, light, scope)
    assert seen.seen.sum(1).tolist()[0] == all_.seen.sum(1)[0] > seen.seen.sum(1)[1] > 0
    assert seen.lens_type is not None and set(seen.lens_type[1][seen.seen[1]]) == {0}
    second = sample_views(points, light, other, 1.01)
    np.testing.assert_allclose(
        seen.pixels[0][(seen.lens_type[0] == 1) & seen.seen[0]], second.pixels[0][second.seen[0]]
    )


@pytest.mark.slow
def test_the_image_is_that_of_rays():
    """Off by 0.20 of its norm, with the noise of the rays; of lenses that are alike by 0.18, taken as such by 0.77."""
    from experiments.ray_tracer import traced

    place = (np.argwhere(np.ones((5, 5))) - 2) * 1.3 + np.random.default_rng(0).uniform(-0.2, 0.2, (25, 2))
    array = gs.MicrolensArray(place, radius_of_curvature=np.array([2.0, 2.15])[np.arange(25) % 2])
    scope = gs.Imager(array, gs.Sensor((640, 640), 0.0135), 5.8, 3.0)
    points = np.array([[0.3, -0.4, 20.0, 1.0], [-1.2, 1.1, 24.0, 1.0], [1.4, 0.9, 17.0, 1.0]])
    image, true = gs.simulate(points, scope), traced(points, scope, 400_000)
    assert np.linalg.norm(image - true) < 0.25 * np.linalg.norm(true)
    np.testing.assert_allclose(image.sum(), true.sum(), rtol=0.01)
