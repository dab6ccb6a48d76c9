import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax import objectives
from gs_jax.base.errors import InputError
from gs_jax.codesign.parameters import NAMES, candidate, evaluated, new_design, start_values
from gs_jax.design.start import geomscope
from gs_jax.microscope.layouts import coverage
from gs_jax.optics.apertures import clear_diameter, pitch

MOVING = {"centers_mm": (-10.0, 10.0)}


@pytest.fixture(scope="module")
def design():
    return geomscope()


@pytest.fixture(scope="module")
def parent(design):
    return evaluated(design, depths_mm=(18.0, 23.0), circle_of_confusion=0.036)


@jax.jit
def quantities(imager, at):
    return objectives.clear_diameter(imager, at), objectives.coverage(imager, at), objectives.lenses_per_point(imager)


def test_without_values_it_is_the_parent(design, parent):
    (found, at), imager = candidate(*parent, values={}), design.imager()
    clear, covered, _ = quantities(found, at)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, imager)
    # Two exact computations of the same areas: from the Voronoi cells' edges, and lens by lens.
    np.testing.assert_allclose(clear, jax.jit(clear_diameter)(imager.array), rtol=1e-9)
    np.testing.assert_allclose(at.depths, [18, 19, 20, 21, 22, 23], rtol=1e-12)
    np.testing.assert_allclose(covered, coverage(np.array(design.array.centers_mm), (20.0, 20.0), diameter=2.0))


@pytest.mark.parametrize("moving", [False, True])
def test_a_pitch_scales_the_pattern_and_its_plate(design, moving):
    parent = evaluated(design, free=MOVING if moving else {})
    values = {"pitch_mm": 1.1 * start_values(*parent)["pitch_mm"], "aperture_diameter_mm": jnp.array(1.3)}
    found, at = candidate(*parent, values=values)
    scaled = new_design(design, *parent, values=values)
    np.testing.assert_allclose(found.array.plate, [22.0, 22.0], rtol=1e-12)
    np.testing.assert_allclose(pitch(found.array.centers)[0], values["pitch_mm"], rtol=1e-9)
    # The written design is rounded to 1e-4 mm.
    clear, _, lenses = quantities(found, at)
    np.testing.assert_allclose(clear, jax.jit(clear_diameter)(scaled.imager().array), rtol=1e-4)
    np.testing.assert_allclose(lenses, 200 * np.pi * 9 / 22**2, rtol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("moving", [False, True])
def test_everything_has_gradients(moving):
    small = geomscope().model_copy(
        update={"array": geomscope().array.model_copy(update={"centers_mm": ((-3.0, 1.0), (-2.1, 0.2), (0.1, 0.4))})}
    )
    parent = evaluated(small, free=MOVING if moving else {})
    values = {name: x for name, x in start_values(*parent).items() if moving or name != "centers_mm"}

    def what(values):
        found, at = candidate(*parent, values=values)
        density = objectives.coverage(found, at), objectives.lenses_per_point(found)
        return objectives.clear_diameter(found, at), density, found.array.size, found.magnification(at.depths)

    check_grads(jax.jit(what), (values,), order=1, eps=1e-5)


def test_a_new_design_holds_the_values(design, parent):
    values = start_values(*parent) | {"sensor_distance_mm": jnp.array(3.123456), "depth_span_mm": jnp.array(4.0)}
    found = new_design(design, *parent, values=values)
    assert found.imaging.sensor_distance_mm == 3.1235
    assert found.imaging.working_distance_mm == (18.5, 22.5)
    assert found.lens == design.lens and found.array == design.array
    conic = new_design(design, *parent, values=values | {"conic_constant": jnp.array(-0.87654321)}).lens.conic_constant
    assert conic == -0.8765432
    assert set(start_values(*parent)) == set(NAMES)


def test_aspheric_terms_of_a_lens_without_any(design):
    """Where they are free there are two of them, zero at first; a file holds them to seven digits."""
    parent = evaluated(design, free={"aspheric_terms": (-0.1, 0.1)})
    np.testing.assert_array_equal(start_values(*parent)["aspheric_terms"], [0, 0])
    values = {"aspheric_terms": jnp.array([0.012345, -0.0000123]), "pitch_mm": 1.1 * start_values(*parent)["pitch_mm"]}
    np.testing.assert_array_equal(candidate(*parent, values=values)[0].array.aspheric_terms, values["aspheric_terms"])
    found = new_design(design, *parent, values=values)
    assert found.lens.aspheric_terms == (0.012345, -0.0000123)
    again = evaluated(found, free={"aspheric_terms": (-0.1, 0.1)})
    np.testing.assert_array_equal(start_values(*again)["aspheric_terms"], [0.012345, -0.0000123])


def test_values_that_make_no_microscope(design, parent):
    with pytest.raises(InputError, match="`lens.aperture_diameter_mm`.*3.0"):
        new_design(
            design, *parent, values={"aperture_diameter_mm": jnp.array(3.0), "radius_of_curvature_mm": jnp.array(1.2)}
        )
