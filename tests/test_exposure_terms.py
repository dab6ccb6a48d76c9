import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import j1

from gs_jax.codesign import linear_error
from gs_jax.codesign.linear_error import (
    lens_electrons,
    lit_density,
    lost_power,
    noise_density,
    transfer_power,
    volume_error,
)
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
    """A thin lens without aberrations, judged at one depth and on its axis alone."""
    imager = dataclasses.replace(c.imager, field_radius=1e-3)
    where = lambda i: (i.array.thin_lens_focal_length, i.sensor_distance, i.array.aperture_diameter)
    values = c.imager.array.focal_length, jnp.array(sensor_distance), jnp.array(diameter)
    imager = eqx.tree_at(where, imager, values, is_leaf=lambda x: x is None)
    return Case(imager, dataclasses.replace(c.at, depths=jnp.array([depth])))


def perfect(frequency, c):
    share = frequency * c.imager.wavelength * float(c.imager.reduced_sensor_distance) / float(clear_diameter(*c))
    share = np.minimum(share, 1)
    clear = 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
    return clear * np.sinc(frequency * c.imager.sensor.pixel_pitch)


@pytest.mark.parametrize("off", [0.0, 0.5])
def test_transfer_of_an_ideal_lens(off):
    """A patch out of focus is an even disc: 2 J1(x) / x. The mean over a field of 1 um is good to that over 4 mm."""
    c = case({})
    f, z = float(c.imager.array.focal_length), 20.0
    v = 1 / (1 / f - 1 / float(c.imager.reduced_depth(z))) + off
    c = ideal(c, z, v, 0.8)
    frequency = np.array([0.3, 3.0, 20.0, 60.0, 110.0])
    patch = 2 * np.pi * frequency * 0.4 * off / (v - off)
    expected = perfect(frequency, c) ** 2 * (np.where(patch, 2 * j1(patch) / np.where(patch, patch, 1), 1) ** 2)
    found = jax.jit(transfer_power)(*c, jnp.array(frequency))[0]
    # A fixed rule of 16 rings: to 1e-3 of the whole at ten periods across the patch.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3 if off else 0)


@pytest.mark.integration
def test_a_lens_and_a_plane_are_wieners_filter():
    """One plane under one lens: 1 / (1 + S H^2 L^2 M^2 w / n), over the object's frequencies."""
    c = case({}, centers=((0.0, 0.0),), exposure=300.0)
    c = c._replace(at=dataclasses.replace(c.at, depths=c.at.depths[:1]))
    nodes = (np.arange(4000) + 0.5) / 4000 * 12.5
    spectrum = linear_error._spectrum(nodes)
    power = transfer_power(*c, jnp.array(nodes / float(c.imager.magnification(c.at.depths)[0])))[0]
    signal = (
        spectrum * power * (lit_density(*c)[0] * c.imager.magnification(c.at.depths)[0]) ** 2 / noise_density(*c)[0]
    )
    expected = np.sum(nodes * spectrum / (1 + signal)) / np.sum(nodes * spectrum)
    # The lens is above the object, so that the envelope is 1; 16 nodes against 4000 are good to 2e-3.
    np.testing.assert_allclose(jax.jit(lost_power)(*c, jnp.zeros((1, 2)))[0], expected, rtol=3e-3)


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
        sharp = [s._replace(imager=dataclasses.replace(s.imager, field_radius=3.0)) for s in sharp]
        np.testing.assert_allclose(lens_electrons(*sharp[0]), 9 * lens_electrons(*sharp[1]), rtol=1e-12)
        found[exposure] = [float(jax.jit(volume_error)(*s)) for s in sharp]
        assert found[exposure][0] < found[exposure][1]
    assert found[1e5][0] < found[1e3][0]


@pytest.mark.integration
@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_gradients(orientation):
    """By everything that shapes a lens, and by the lenses' places, some of which are too far away to see the object."""
    free = {"aspheric_terms": (-0.1, 0.1), "centers_mm": (-9.0, 9.0)}
    judged = parent((*CENTERS, (-1.9, -1.9), (1.9, 1.9)), orientation=orientation, free=free, exposure=2e3)
    judged = dataclasses.replace(judged[0], field_radius=1.0), judged[1]
    names = ("conic_constant", "radius_of_curvature_mm", "sensor_distance_mm", "pitch_mm", "centers_mm")
    values = {name: start_values(*judged)[name] for name in names}
    values |= {"aperture_diameter_mm": jnp.array(0.7), "aspheric_terms": jnp.array([0.01, -0.02])}
    error = jax.jit(lambda values: volume_error(*candidate(*judged, values=values)))
    check_grads(error, (values,), order=1, eps=1e-6, atol=1e-5, rtol=1e-5)
