import dataclasses
import inspect
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import j1

from experiments.ray_tracer import bundles
from gs_jax.codesign import linear_error
from gs_jax.codesign.linear_error import lost_power, spots_of_types, volume_error
from gs_jax.codesign.parameters import candidate, evaluated, start_values
from gs_jax.design.start import geomscope
from gs_jax.microscope.geometry import Imager
from gs_jax.objectives import Conditions, clear_diameter

CENTERS = ((-1.313, 0.437), (0.221, 0.119), (1.127, -0.741), (0.333, 1.416), (-0.629, -1.243))


def parent(centers=CENTERS, orientation="plano", **options):
    design = geomscope()
    array = design.array.model_copy(update={"centers_mm": centers, "size_mm": (4.0, 4.0)})
    lens = design.lens.model_copy(update={"orientation": orientation})
    design = design.model_copy(update={"array": array, "lens": lens})
    return evaluated(design, depths_mm=(18.0, 23.0), depth_count=2, **options)


class Case(NamedTuple):
    imager: Imager
    at: Conditions


def case(values, **options):
    return Case(*candidate(*parent(**options), values))


def ideal(c, depth, sensor_distance, diameter):
    """A thin lens without aberrations, judged at one depth."""
    where = lambda i: (i.array.thin_lens_focal_length, i.sensor_distance, i.array.aperture_diameter)
    values = c.imager.array.focal_length, jnp.array(sensor_distance), jnp.array(diameter)
    imager = eqx.tree_at(where, c.imager, values, is_leaf=lambda x: x is None)
    return Case(imager, dataclasses.replace(c.at, depths=jnp.array([depth])))


def perfect(frequency, c):
    share = frequency * c.imager.wavelength * float(c.imager.reduced_sensor_distance) / float(clear_diameter(*c))
    share = np.minimum(share, 1)
    clear = 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
    return clear * np.sinc(frequency * c.imager.sensor.pixel_pitch)


@pytest.mark.parametrize("off", [0.0, 0.5])
def test_transfer_of_an_ideal_lens(off):
    """A patch out of focus is an even disc: 2 J1(x) / x."""
    c = case({})
    f, z = float(c.imager.array.focal_length), 20.0
    v = 1 / (1 / f - 1 / float(c.imager.reduced_depth(z))) + off
    c = ideal(c, z, v, 0.8)
    frequency = np.array([0.3, 3.0, 20.0, 60.0, 110.0])
    patch = 2 * np.pi * frequency * 0.4 * off / (v - off)
    expected = perfect(frequency, c) ** 2 * (np.where(patch, 2 * j1(patch) / np.where(patch, patch, 1), 1) ** 2)
    found = spots_of_types(*c, jnp.zeros(1), jnp.array(frequency)).power[0, 0]
    # A fixed rule of rings: to 1e-3 of the whole at ten periods across the patch.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3 if off else 0)


@pytest.mark.integration
@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_light_and_blur_far_from_the_axis(orientation):
    """By the rays of an independent tracer, with Fresnel losses, up to 31 degrees."""
    values = {"aperture_diameter_mm": jnp.array(0.9)}
    c, frequency, tangents = (
        case(values, centers=((0.0, 0.0),), orientation=orientation),
        [1.0, 4.0, 12.0],
        [0, 0.3, 0.6],
    )
    found = spots_of_types(*c, jnp.array(tangents, float), jnp.array(frequency))
    depth = float(c.at.depths[0])
    places = np.array([[t * float(c.imager.reduced_depth(depth)), 0, depth] for t in tangents])
    landed = bundles(places, c.imager, 40_000)[0][:, 0]
    light, place = landed[..., 2], landed[..., :2] @ np.asarray(linear_error.directions(float))
    electrons = 1e4 * 4 * np.pi * 20.0**2 * light.sum(1)
    np.testing.assert_allclose(found.electrons[0], electrons, rtol=2e-3)
    for k, f in enumerate(frequency):
        waves = np.abs(np.einsum("pr,prw->pw", light, np.exp(2j * np.pi * f * place))) / light.sum(1)[:, None]
        np.testing.assert_allclose(found.power[0, :, k], (waves**2).mean(1) * perfect(f, c) ** 2, atol=5e-3)


@pytest.mark.integration
def test_rays_are_enough_for_wide_spots(monkeypatch):
    """At 45 degrees and the finest frequencies, noise of the quadrature is no signal: as by twice as many rings."""
    c, amplitudes = case({}, centers=((0.0, 0.0),)), []
    for rings in (linear_error._RINGS, 80):
        monkeypatch.setattr(linear_error, "_RINGS", rings)
        spots = jax.jit(lambda *c: inspect.unwrap(spots_of_types)(*c, jnp.ones(1), jnp.linspace(20.0, 45.0, 26)))(*c)
        amplitudes.append(np.sqrt(spots.power))
    # Of 20 rings it is 0.023.
    assert np.sqrt(np.mean((amplitudes[0] - amplitudes[1]) ** 2)) < 0.01


@pytest.mark.integration
def test_the_order_of_depths_and_the_place_of_the_array_do_not_matter():
    c = case({})
    error = jax.jit(lambda imager, depths: volume_error(imager, dataclasses.replace(c.at, depths=depths)))
    wanted = float(error(c.imager, c.at.depths))
    assert float(error(c.imager, c.at.depths[::-1])) == pytest.approx(wanted, rel=1e-9)
    turned = dataclasses.replace(c.imager, rotation=np.pi / 2)
    assert float(error(turned, c.at.depths)) == pytest.approx(wanted, rel=1e-9)
    shifted = dataclasses.replace(
        turned, shift=(0.7, -0.4), sensor=dataclasses.replace(c.imager.sensor, origin=(0.7, -0.4))
    )
    assert float(error(shifted, c.at.depths)) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.integration
def test_a_lens_and_a_plane_are_wieners_filter():
    """One plane under one lens: 1 / (1 + S H^2 L^2 M^2 / n), over the object's frequencies."""
    c = case({}, centers=((0.0, 0.0),), exposure=300.0)
    c = c._replace(at=dataclasses.replace(c.at, depths=c.at.depths[:1]))
    magnification = float(c.imager.magnification(c.at.depths)[0])
    nodes = (np.arange(4000) + 0.5) / 4000 * 12.5
    spectrum = linear_error._spectrum(nodes, 0.04)
    spots = spots_of_types(*c, jnp.zeros(1), jnp.array(nodes / magnification))
    # Of 3 % of emitters of 40 um: under the lens, and of the plate's 16 mm^2 spread over the sensor.
    whole = float(spots.electrons[0, 0]) / 0.04**2
    over = 16 / np.prod(np.array(c.imager.sensor.shape) * float(c.imager.sensor.pixel_pitch))
    noise = 0.03 * whole * (1 / magnification**2 + over) + (2 / float(c.imager.sensor.pixel_pitch)) ** 2
    signal = spectrum * spots.power[0, 0] * (whole / magnification) ** 2 / noise
    expected = np.sum(nodes * spectrum / (1 + signal)) / np.sum(nodes * spectrum)
    # The lens is above the object; 16 nodes against 4000 are good to 2e-3.
    np.testing.assert_allclose(jax.jit(lost_power)(*c, jnp.zeros((1, 2)))[0], expected, rtol=3e-3)


@pytest.mark.integration
def test_lenses_beyond_the_field_radius_count():
    """To the plate's edge, whatever the field radius is, as long as their images are on the sensor."""
    ring = 3.5 * np.stack([np.cos(np.arange(12)), np.sin(np.arange(12))], -1)
    c = case({}, centers=(*CENTERS, *map(tuple, ring.tolist())))
    c = c._replace(imager=eqx.tree_at(lambda i: i.array.size, c.imager, jnp.array([8.0, 8.0])))
    lost = jax.jit(lambda imager: lost_power(imager, c.at, jnp.zeros((1, 2))))
    near, far = (np.asarray(lost(dataclasses.replace(c.imager, field_radius=r))) for r in (1.0, 4.0))
    np.testing.assert_array_equal(near, far)
    cropped = [
        dataclasses.replace(c.imager, sensor=dataclasses.replace(c.imager.sensor, shape=(n, n))) for n in (2400, 1200)
    ]
    whole, middle = (np.asarray(lost(imager)) for imager in cropped)
    assert (middle > 1.05 * whole).all()


@pytest.mark.integration
def test_planes_that_no_parallax_tells_apart():
    """By a single lens two planes of the same sharpness are half of each other, however bright: what is found of each
    is the half that the sum tells; of 40 lenses apart far more."""
    rng = np.random.default_rng(0)
    losses = []
    for centers in ([(0.0, 0.0)], rng.uniform(-2, 2, (40, 2)).tolist()):
        c = case({"aperture_diameter_mm": jnp.array(0.3)}, centers=tuple(map(tuple, centers)), exposure=1e9)
        losses.append(np.asarray(jax.jit(lost_power)(*c, jnp.zeros((1, 2)))))
    assert losses[0].mean() == pytest.approx(0.5, abs=0.02)
    assert losses[1].max() < 0.1


@pytest.mark.integration
def test_a_pinhole_pays_at_equal_exposure():
    """Of a lens in focus without aberrations, a third of the diameter has a ninth of the light."""
    found = {}
    for exposure in (1e3, 1e5):
        c = case({}, exposure=exposure)
        f = float(c.imager.array.focal_length)
        v = 1 / (1 / f - 1 / float(c.imager.reduced_depth(20.0)))
        sharp = [ideal(c, 20.0, v, d) for d in (0.9, 0.3)]
        light = [float(spots_of_types(*s, jnp.zeros(1), jnp.zeros(1)).electrons[0, 0]) for s in sharp]
        # The rim of the wider lens is farther from the object.
        assert light[0] == pytest.approx(9 * light[1], rel=1e-3)
        found[exposure] = [float(jax.jit(volume_error)(*s)) for s in sharp]
        assert found[exposure][0] < found[exposure][1]
    assert found[1e5][0] < found[1e3][0]


@pytest.mark.integration
@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_gradients(orientation):
    """By everything that shapes a lens, and by the lenses' places, some of which image the object beside the sensor."""
    free = {"aspheric_terms": (-0.1, 0.1), "centers_mm": (-9.0, 9.0)}
    judged = parent((*CENTERS, (-1.9, -1.9), (1.9, 1.9)), orientation=orientation, free=free, exposure=2e3)
    sensor = dataclasses.replace(judged[0].sensor, shape=(800, 900))
    judged = dataclasses.replace(judged[0], sensor=sensor), judged[1]
    names = ("conic_constant", "radius_of_curvature_mm", "sensor_distance_mm", "pitch_mm", "centers_mm")
    values = {name: start_values(*judged)[name] for name in names}
    values |= {"aperture_diameter_mm": jnp.array(0.7), "aspheric_terms": jnp.array([0.01, -0.02])}
    error = jax.jit(lambda values: volume_error(*candidate(*judged, values=values)))
    check_grads(error, (values,), order=1, eps=1e-6, atol=1e-5, rtol=1e-5)
    # A lens above one of the objects.
    values["centers_mm"] = values["centers_mm"].at[0].set(0.0)
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(jax.jit(jax.grad(error))(values)))
