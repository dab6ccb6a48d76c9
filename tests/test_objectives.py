import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import uniform_filter

from experiments.fig3_resolution import fwhm as profile_width
from gs_jax import objectives
from gs_jax.codesign.parameters import candidate, evaluated, start_values
from gs_jax.codesign.terms import TERMS
from gs_jax.design.datasheets import datasheet
from gs_jax.design.start import geomscope
from gs_jax.microscope.geometry import Imager
from gs_jax.microscope.grid import Sensor
from gs_jax.microscope.layouts import max_gap, nearest_neighbour_distances
from gs_jax.objectives import Conditions
from gs_jax.objectives.quantities import _outermost_half
from gs_jax.optics.psf import diffraction_psf
from gs_jax.optics.raytrace import to_numpy

# Off the raster of places, where a hole has a kink.
CENTERS = ((-1.313, 0.437), (0.221, 0.119), (1.127, -0.741), (0.333, 1.416), (-0.629, -1.243))
SIZES = ("fwhm_um", "rms_width_um", "half_light_radius_um")


class Case(NamedTuple):
    imager: Imager
    at: Conditions

    def terms(self, *names):
        return map(np.asarray, some_terms(self, names))


@partial(jax.jit, static_argnames="names")
def some_terms(case, names):
    """Terms by name, as one program for cases of one structure, whatever their numbers."""
    return [TERMS[name].function(*case) for name in names]


@jax.jit
def everything(imager, at):
    """All terms at once: compiled once."""
    return {name: TERMS[name].function(imager, at) for name in TERMS}


def small_design(centers=CENTERS):
    design = geomscope()
    array = design.array.model_copy(update={"centers_mm": centers, "size_mm": (4.0, 4.0)})
    return design.model_copy(update={"array": array})


@pytest.fixture(scope="module")
def design():
    return geomscope()


@pytest.fixture(scope="module")
def focused(design):
    return Case(*candidate(*evaluated(design, depths_mm=(18.0, 23.0), circle_of_confusion=0.018), {}))


@pytest.fixture(scope="module")
def terms(focused):
    return everything(*focused)


@pytest.mark.integration
def test_the_papers_metrics_are_those_of_the_datasheet(design, focused, terms):
    """The same formulas by two ways: six digits are what a datasheet has."""
    sheet = datasheet(design, focused.at.depths.tolist(), circle_of_confusion=0.018)
    shown = {"lateral_resolution_um": "lateral_resolution_um", "axial_resolution_um": "axial_resolution_um"}
    shown |= {"occupancy": "occupancy", "coverage": "coverage"}
    for name, key in shown.items():
        np.testing.assert_allclose(terms[name], sheet[key], rtol=1e-5)
    np.testing.assert_allclose(terms["lenses_per_point"], sheet["lenses_per_point"][0], rtol=1e-5)
    object_blur = np.array(sheet["blur_um"]) / sheet["magnification"]
    np.testing.assert_allclose(terms["blur_um"], object_blur, rtol=1e-4)
    middle = datasheet(design, [20.5], circle_of_confusion=0.018)
    np.testing.assert_allclose(terms["depth_of_field_mm"], middle["depth_of_field_mm"][0], rtol=1e-5)


def test_focus_is_one_at_the_ends_and_zero_between(focused):
    host = to_numpy(focused.imager)
    f, (near, far) = host.array.focal_length, host.reduced_depth(np.array([18.0, 23.0]))
    middle = 2 * near * far / (near + far) - host.reduced_depth(0.0)
    distance = lambda z: 1 / (1 / f - 1 / host.reduced_depth(z))

    def offset(sensor_distance):
        return float(*eqx.tree_at(lambda c: c.imager.sensor_distance, focused, sensor_distance).terms("focus_offset"))

    np.testing.assert_allclose([offset(distance(z)) for z in (18.0, 23.0, middle)], [1, 1, 0], atol=1e-9)
    # Focus beyond infinity is only farther off.
    assert offset(0.9 * f) > 10


def alone(focused, sensor_distance, diameter):
    """One lens in the middle of the plate, which nothing clips."""
    where = lambda c: (c.imager.sensor_distance, c.imager.array.centers, c.imager.array.aperture_diameter)
    return eqx.tree_at(where, focused, (np.array(sensor_distance), np.zeros((1, 2)), np.array(diameter)))


def ideal(focused, sensor_distance, diameter):
    """A thin lens without aberrations or field."""
    where, is_none = lambda c: c.imager.array.thin_lens_focal_length, lambda x: x is None
    f = to_numpy(focused.imager).array.focal_length
    return eqx.tree_at(where, alone(focused, sensor_distance, diameter), f, is_leaf=is_none)


def test_width_of_an_ideal_lens_out_of_focus(focused):
    """A thin lens's patch is an even disc: variance along an axis radius^2 / 4. Beside it, the pixel and the Airy disc.

    80 % of its rays lie within the root of 0.8 of its radius; the quadrature has 8 rings, so a tenth of a ring's share.
    """
    lens = ideal(focused, 5.0, 1.0)
    blur, light = lens.terms("blur_um", "light_percent")
    radius, magnification = blur / 2, to_numpy(lens.imager).magnification(np.asarray(lens.at.depths))
    pixel, airy = 4.5 / magnification, 0.5145 * 0.52 * 5.0 / 0.5 / magnification
    expected = np.sqrt((radius**2 / 4 + pixel**2 / 12) * 8 * np.log(2) + airy**2)
    psf_width, per_light, encircled = lens.terms("psf_width_um", "width_per_light_um", "encircled_radius_um")
    np.testing.assert_allclose(psf_width, expected, rtol=1e-9)
    np.testing.assert_allclose(per_light, expected / light**0.25, rtol=1e-9)
    np.testing.assert_allclose(encircled, np.sqrt(0.8) * radius, rtol=0.03)
    # The even disc falls to a half at its edge, and half of its light is within the root of a half of its radius.
    width, rms, half = lens.terms(*SIZES)
    np.testing.assert_allclose(width, 2 * radius, rtol=0.03)
    np.testing.assert_allclose(rms, expected / np.sqrt(8 * np.log(2)), rtol=1e-9)
    np.testing.assert_allclose(half, np.sqrt(0.5) * radius, rtol=0.03)


@pytest.mark.parametrize(("pixel", "diameter"), [(0.1, 0.3), (20.0, 1.0)], ids=["Airy disc", "pixel"])
def test_sizes_of_a_perfect_image_are_those_of_closed_forms(focused, pixel, diameter):
    """In focus diffraction or the pixel alone makes the PSF; half of an Airy disc's light is within 0.535 lambda v / D.

    A Gaussian as wide as the Airy disc has half of its light within 1.177 sigma, 4 % less.
    """
    host = to_numpy(focused.imager)
    v = 1 / (1 / host.array.focal_length - 1 / host.reduced_depth(20.5))
    lens = ideal(focused, v, diameter)
    sensor = dataclasses.replace(lens.imager.sensor, pixel_pitch=pixel / 1000)
    at = dataclasses.replace(lens.at, depths=[20.5])
    scale = float(to_numpy(lens.imager).magnification(20.5))
    sizes = Case(dataclasses.replace(lens.imager, sensor=sensor), at).terms(*SIZES)
    width, rms, half = (float(size[0]) * scale for size in sizes)
    if pixel > 1:
        # Of a square pixel: its side, its standard deviation, and the radius of half of its area.
        expected = pixel, np.sqrt(pixel**2 / 12 + (0.437 * 0.52 * float(v)) ** 2), pixel * np.sqrt(0.5 / np.pi)
    else:
        airy = 0.52 * float(v) / diameter
        expected = 1.029 * airy, 1.029 * airy / np.sqrt(8 * np.log(2)), 0.535 * airy
    np.testing.assert_allclose((width, rms), expected[:2], rtol=0.01)
    assert half == pytest.approx(expected[2], rel=0.05)


def test_half_the_height_of_a_gaussian():
    radii, width = np.linspace(0, 5, 101), jax.jit(_outermost_half)
    assert float(width(radii, np.exp(-(radii**2) / 2))) == pytest.approx(2 * np.sqrt(2 * np.log(2)), rel=1e-3)
    # A ring brighter than half of the core counts.
    ring = np.exp(-(radii**2) / 2) + 0.8 * np.exp(-((radii - 4) ** 2) / 0.1)
    assert 8 < float(width(radii, ring)) < 9


@pytest.mark.integration
def test_the_width_at_half_height_is_that_of_diffraction(design):
    """Of the paper's lenses, whose core stands in wide stray light: RMS widths are ten times as wide."""
    imager, parts = design.imager(), 9
    depths, radius = np.array([18.0, 22.0]), float(objectives.clear_diameter(imager, [20.0])) / 2
    fine = dataclasses.replace(imager, sensor=Sensor((401, 401), imager.sensor.pixel_pitch / parts))
    for depth, width, rms in zip(
        depths, *(f(imager, depths) for f in (objectives.fwhm, objectives.rms_width)), strict=True
    ):
        image = np.asarray(diffraction_psf(fine, depth, size=401, radius=radius, samples=1))
        line = uniform_filter(image, parts)[200] * (np.abs(np.arange(401) - 200) < 100)
        places = fine.sensor.pixel_pitch * np.arange(401) / float(imager.magnification(depth))
        assert float(width) == pytest.approx(profile_width(places, line), rel=0.02) and rms > 8 * width
    by_distance = lambda v: jnp.sum(objectives.fwhm(dataclasses.replace(imager, sensor_distance=v), depths))
    width, slope = jax.jit(by_distance), jax.jit(jax.grad(by_distance))(5.3)
    assert float(slope) == pytest.approx(float(width(5.3 + 1e-5) - width(5.3 - 1e-5)) / 2e-5, rel=1e-3)


@pytest.mark.integration
def test_width_of_a_lens_in_focus_is_that_of_its_diffraction(focused):
    """A Gaussian of the same variance against the PSF's own width. Two pixels make the spot: it is no Gaussian, 15 %.

    A small lens (0.4 mm) has no aberrations to speak of on its axis: pixel and diffraction make the spot.
    """
    f, small = focused.imager.array.focal_length, 0.4
    v = 1 / (1 / f - 1 / focused.imager.reduced_depth(20.5))
    lens = alone(focused, v, small)
    spot = diffraction_psf(lens.imager, 20.5, size=31, radius=small / 2, samples=4)
    line = np.asarray(spot.sum(0))
    above = np.interp(line.max() / 2, line[:16], np.arange(16))
    width = 2 * (15 - above) * 4.5 / float(lens.imager.magnification(20.5))
    axis = dataclasses.replace(lens.imager, field_radius=0.01)
    middle = Case(axis, dataclasses.replace(lens.at, depths=jnp.array([20.5])))
    (found,) = middle.terms("psf_width_um")
    np.testing.assert_allclose(found[0], width, rtol=0.15)


@pytest.mark.integration
def test_manufacture(design, focused, terms):
    centers = np.array(design.array.centers_mm)
    np.testing.assert_allclose(terms["spacing_mm"], nearest_neighbour_distances(centers), rtol=1e-9)
    # Places are half a millimetre apart: a hole is missed by a quarter of it at most, and never overstated.
    hole, exact = float(terms["hole_mm"].max()), max_gap(centers, (20.0, 20.0))
    assert exact - 0.3 < hole <= exact * (1 + 1e-9)
    np.testing.assert_allclose(terms["sag_mm"], 2 - np.sqrt(3), rtol=1e-12)
    slope = np.degrees(np.arcsin(np.asarray(objectives.clear_diameter(*focused)) / 4))
    np.testing.assert_allclose(terms["edge_slope_deg"], slope, rtol=1e-9)
    np.testing.assert_allclose(terms["least_radius_mm"], 2, rtol=1e-12)


def test_manufacture_of_a_conic(focused):
    """Of an ellipse with the half axes a and b: its curvature along a profile, and R = b^2 / a at the vertex."""
    k, radius = -0.6, 2.0
    shaped = eqx.tree_at(lambda c: c.imager.array.conic_constant, focused, np.array(k))
    a, b = radius / (1 + k), radius / (1 + k) ** 0.5
    half = float(objectives.clear_diameter(*focused)) / 2
    edge_slope, sag, least = shaped.terms("edge_slope_deg", "sag_mm", "least_radius_mm")
    height = a * np.sqrt(1 - (half / b) ** 2)
    slope = np.degrees(np.arctan(a / b**2 * half / np.sqrt(1 - (half / b) ** 2)))
    np.testing.assert_allclose(edge_slope, slope, rtol=1e-12)
    rim = a * np.sqrt(1 - 1 / b**2)
    np.testing.assert_allclose(sag, a - rim, rtol=1e-12)
    # (a^2 sin^2 t + b^2 cos^2 t)^(3/2) / (a b) of the profile, with x = b sin t; across it the normal's length.
    t = np.arcsin(half / b)
    profile = ((a * np.sin(t)) ** 2 + (b * np.cos(t)) ** 2) ** 1.5 / (a * b)
    across = np.hypot(half, height * b**2 / a**2)
    np.testing.assert_allclose(least[[0, -1]], [radius, min(profile, across)], rtol=1e-9)


def test_manufacture_of_a_polynomial(focused):
    """`sag = r^2 / (2 R) + ...` by finite differences: slope at the rim, and curvature along the profile."""
    terms = (0.03, -0.01)
    shaped = eqx.tree_at(lambda c: c.imager.array.aspheric_terms, focused, np.array(terms))
    edge_slope, sag, least = shaped.terms("edge_slope_deg", "sag_mm", "least_radius_mm")
    height = lambda r: 2 - np.sqrt(4 - r**2) + terms[0] * r**4 + terms[1] * r**6
    np.testing.assert_allclose(sag, height(1.0), rtol=1e-12)
    half, step = float(objectives.clear_diameter(*focused)) / 2, 1e-4
    slope = (height(half + step) - height(half - step)) / (2 * step)
    np.testing.assert_allclose(edge_slope, np.degrees(np.arctan(slope)), rtol=1e-6)
    # At the middle of the radius, the 21st of 41 places.
    r = half / 2
    first, second = (height(r + step) - height(r - step)) / (2 * step), np.diff(height(r + step * np.arange(-1, 2)), 2)
    along, across = second[0] / step**2 / (1 + first**2) ** 1.5, first / r / (1 + first**2) ** 0.5
    np.testing.assert_allclose(least[20], 1 / max(along, across), rtol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_widths_have_gradients_by_the_shape(orientation):
    design = small_design()
    design = design.model_copy(update={"lens": design.lens.model_copy(update={"orientation": orientation})})
    parent = evaluated(design, depths_mm=(18.0, 23.0), depth_count=2, free={"aspheric_terms": (-0.1, 0.1)})
    names = ("conic_constant", "radius_of_curvature_mm", "sensor_distance_mm")
    values = {name: start_values(*parent)[name] for name in names} | {"aperture_diameter_mm": jnp.array(1.1)}
    values["aspheric_terms"] = jnp.array([0.01, -0.02])
    shown = ("psf_width_um", "edge_slope_deg", "sag_mm", "least_radius_mm", "wavefront_waves", "light_percent")
    terms = jax.jit(lambda values: [TERMS[name].function(*candidate(*parent, values=values)) for name in shown])
    check_grads(terms, (values | {"conic_constant": jnp.array(-0.5)},), order=1, eps=1e-6, atol=1e-5, rtol=1e-5)


def small_parent(depth_count):
    return evaluated(
        small_design(), depths_mm=(18.0, 23.0), depth_count=depth_count, free={"centers_mm": (-10.0, 10.0)}
    )


@pytest.mark.slow
def test_terms_have_gradients():
    """Finite differences of 1e-5 in float64 are good to 1e-6 of the curvature.

    Kinks are elsewhere: of a sphere, whose two curvatures are one, the larger has one.
    """
    parent = small_parent(2)
    start = {"sensor_distance_mm": 5.7, "aperture_diameter_mm": 1.1, "conic_constant": -0.2}
    values = start_values(*parent) | {name: jnp.array(value) for name, value in start.items()}
    check_grads(
        jax.jit(lambda values: everything(*candidate(*parent, values=values))), (values,), order=1, eps=1e-5, rtol=1e-3
    )


@pytest.mark.slow
def test_gradients_are_finite_where_lenses_coincide_and_rays_are_lost():
    """Two lenses in one place; a lens so steep that its rim reflects totally."""
    parent = small_parent(2)
    centers = parent[0].array.centers.at[1].set(parent[0].array.centers[0])
    steep = {"radius_of_curvature_mm": jnp.array(0.5), "aperture_diameter_mm": jnp.array(1.9), "centers_mm": centers}
    values = start_values(*parent) | steep
    sums = lambda values: {name: jnp.sum(x) for name, x in everything(*candidate(*parent, values=values)).items()}
    found, slopes = jax.jit(lambda values: (sums(values), jax.jacrev(sums)(values)))(values)
    finite = lambda name: all(np.isfinite(x).all() for x in (found[name], *slopes[name].values()))
    assert [name for name in TERMS if not finite(name)] == []


@pytest.mark.integration
def test_in_single_precision(focused):
    low = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    single, double = everything(*jax.tree.map(low, focused)), everything(*focused)
    assert all(x.dtype == jnp.float32 for x in single.values())
    # 1e-7 of relative rounding, and of the differences that a defocus or a web is of numbers ten times as large.
    for name in TERMS:
        np.testing.assert_allclose(single[name], double[name], rtol=2e-3, atol=1e-3, err_msg=name)
