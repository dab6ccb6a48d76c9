import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import integrate

from gs_jax import Grid, Imager, MicrolensArray, Sensor
from gs_jax.microscope.geometry import envelope
from gs_jax.optics.raytrace import trace_lenslet

from .helpers import scene


def test_chief_ray_obeys_equations_1_and_3():
    imager = Imager(MicrolensArray([[1.5, -2.0]], substrate_thickness=1.0), Sensor((64, 64), 0.0045), 5.8, 3.0)
    reduced = 20 + 1 / 1.43
    q = np.array([0.3, 0.7])
    (((x, y),),) = np.asarray(jax.jit(Imager.project)(imager, np.array([[*q, 20.0]])))
    scale, magnification = (reduced + 5.8) / reduced, 5.8 / reduced
    np.testing.assert_allclose([x, y], scale * np.array([1.5, -2.0]) - magnification * q, rtol=1e-14)
    np.testing.assert_allclose(imager.scale(20.0), scale, rtol=1e-14)
    np.testing.assert_allclose(imager.magnification(20.0), magnification, rtol=1e-14)


def test_chief_ray_follows_snells_law_through_the_plate():
    """An exact ray through plano face, glass and vertex; the reduced thickness is its paraxial limit."""
    n, thickness, depth, v, lateral = 1.43, 1.0, 20.0, 5.8, 0.5
    imager = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((64, 64), 0.0045), v, 3.0)
    tilt = np.linspace(0, 0.1, 200_001)
    reaches = depth * np.tan(tilt) + thickness * np.tan(np.arcsin(np.sin(tilt) / n))
    exact = -v * np.tan(np.interp(lateral, reaches, tilt))  # at the vertex the surface is flat: the air angle again
    image = np.asarray(jax.jit(Imager.project)(imager, np.array([[lateral, 0.0, depth]])))[0, 0, 0]
    # Paraxial: the next term is (t/n - t/n^3) tan^3 / 2 of lateral, 6e-6 here.
    np.testing.assert_allclose(image, exact, rtol=1e-5)


def test_rotation_is_from_x_toward_y_and_before_the_shift():
    array, sensor = MicrolensArray([[2.0, 0.0]]), Sensor((64, 64), 0.0045)
    imager = Imager(array, sensor, 5.8, 3.0, rotation=np.pi / 2, shift=(0.1, -0.2))
    np.testing.assert_allclose(imager.centers, [[0.1, 1.8]], atol=1e-15)


def test_pixels_have_whole_numbers_at_their_centres():
    sensor = Sensor((5, 4), 0.0045)
    corner = np.array([-1.5 * 0.0045, -2 * 0.0045])  # x of column 0, y of row 0
    np.testing.assert_allclose(sensor.to_pixels(corner), [0, 0], atol=1e-12)
    points = np.random.default_rng(0).normal(size=(7, 2))
    there_and_back = jax.jit(lambda points: sensor.to_mm(sensor.to_pixels(points)))
    np.testing.assert_allclose(there_and_back(points), points, rtol=1e-12)


def test_grid_is_centred():
    grid = Grid([20.0], (4, 3), 0.1)
    np.testing.assert_allclose(grid.y, [-0.15, -0.05, 0.05, 0.15])
    np.testing.assert_allclose(grid.x, [-0.1, 0, 0.1], atol=1e-16)
    over = Grid.over(Sensor((5120, 2560), 0.0045), depths=[20.0], pitch=0.0415)
    assert over.shape == (555, 277)


def test_envelope_integrates_to_the_effective_area():
    """With the cosine out of the way (a distant point) the integral over the plane is pi R^2."""
    integral, _ = integrate.quad(lambda r: 2 * np.pi * r * float(envelope(r**2, 1e9, 3.0)), 0, 4, points=[2.8, 3.15])
    np.testing.assert_allclose(integral, np.pi * 9, rtol=1e-9)


def test_envelope_is_cos4_inside_and_half_at_the_field_radius():
    cos = np.cos(np.arctan(2.0 / 20.7))
    np.testing.assert_allclose(envelope(4.0, 20.7, 3.0), cos**4, rtol=1e-12)
    np.testing.assert_allclose(envelope(9.0, 20.7, 3.0), np.cos(np.arctan(3 / 20.7)) ** 4 / 2, rtol=1e-12)
    assert envelope(0.0, 20.7, 3.0) == 1
    assert envelope(1e8, 20.7, 3.0) == 0


@pytest.mark.integration
def test_geometry_has_gradients():
    imager, _ = scene()
    points = jnp.array([[0.1, 0.2, 19.0], [-0.3, 0.1, 22.0]])
    check_grads(jax.jit(lambda i, p: i.project(p)), (imager, points), order=2)
    check_grads(jax.jit(lambda d2, z: envelope(d2, z, 0.5)), (jnp.array([0.0, 0.2, 0.26]), jnp.array(20.0)), order=1)


def test_gradient_is_finite_on_the_axis_and_at_coincident_lenses():
    imager = Imager(MicrolensArray([[0.0, 0.0], [0.0, 0.0]]), Sensor((64, 64), 0.0045), 5.8, 3.0)
    total = lambda i: jnp.sum(i.project(np.array([[0.0, 0.0, 20.0]])) ** 2) + jnp.sum(envelope(0.0, i.scale(20.0), 3.0))
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(jax.jit(jax.grad(total))(imager)))


def test_focal_length_follows_the_radius_unless_given():
    np.testing.assert_allclose(MicrolensArray([[0.0, 0.0]]).focal_length, 2 / 0.43)
    np.testing.assert_allclose(MicrolensArray([[0.0, 0.0]], thin_lens_focal_length=4.0).focal_length, 4)


def test_a_grid_knows_where_its_voxels_are():
    grid = Grid([18.0, 20.0], (3, 5), 0.1, origin=(1.0, -2.0))
    assert grid.volume_shape == (2, 3, 5)
    np.testing.assert_allclose(grid.to_mm(np.array([[0, 0, 0], [1, 2, 4]])), [[0.8, -2.1, 18], [1.2, -1.9, 20]])
    np.testing.assert_allclose(grid.extent, (0.75, 1.25, -1.85, -2.15))
    one = grid.at(21.0)
    assert one.volume_shape == (1, 3, 5) and one.depths[0] == 21
    np.testing.assert_array_equal(one.origin, grid.origin)
    np.testing.assert_allclose(Sensor((3, 5), 0.1).extent, (-0.25, 0.25, 0.15, -0.15))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Sensor((1, 64), 0.0045), "2 or more"),
        (lambda: Sensor((64, 64), 0.0), "`pixel_pitch` must be positive, got 0.0"),
        (lambda: Imager(MicrolensArray([[0.0, 0.0]]), Sensor((4, 4), 1), 5.8, -1.0), "`field_radius`"),
        (
            lambda: Imager(MicrolensArray([[0.0, 0.0]]), Sensor((4, 4), 1), 5.8, 1.0, wavelength=520.0),
            "520 nm are 520e-6 mm",
        ),
        (
            lambda: Imager(MicrolensArray([[0.0, 0.0]]), Sensor((4, 4), 1), 5.8, 1.0, wavelength=0.52),
            "`wavelength`.*got 0.52",
        ),
        (lambda: Grid([20.0], (0, 3), 0.1), "two positive numbers of voxels"),
        (lambda: Grid([20.0], (3, 3), 0.0), "`pitch` must be positive"),
        (lambda: Grid(np.zeros(0), (3, 3), 0.1), "a depth at least"),
        (lambda: MicrolensArray(np.zeros((0, 2))), "a lens at least"),
        (lambda: one_lens(-5.8), "`sensor_distance` must be positive and finite, got -5.8"),
        (lambda: one_lens(np.nan), "`sensor_distance` must be positive and finite, got nan"),
        (lambda: one_lens(5.8, shift=(0.0, np.inf)), "`shift` must be finite, got inf"),
        (lambda: one_lens(5.8, tilt=(np.nan, 0.0)), "`tilt` must be finite, got nan"),
        (lambda: MicrolensArray([[0.0, np.nan]]), "`centers` must be finite, got nan"),
        (lambda: MicrolensArray([[0.0, 0.0]], refractive_index=0.9), "`refractive_index` must be 1 or more.*, got 0.9"),
        (lambda: MicrolensArray([[0.0, 0.0]], substrate_thickness=-1.0), "`substrate_thickness` must be .*, got -1"),
        (lambda: Grid([20.0, -18.0], (3, 3), 0.1), "`depths` must be positive and finite, got -18"),
        (lambda: Grid([np.nan], (3, 3), 0.1), "`depths` must be positive and finite, got nan"),
        (lambda: Grid([20.0], (3, 3), 0.1).at([18.0, np.inf]), "`depths` must be positive and finite, got inf"),
    ],
)
def test_wrong_shapes_and_numbers_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def one_lens(sensor_distance, **more):
    return Imager(MicrolensArray([[0.0, 0.0]]), Sensor((4, 4), 1), sensor_distance, 1.0, **more)


def test_numbers_that_are_traced_are_not_looked_at():
    """Objects are made in compiled code and in gradients."""
    depth = lambda v, z: one_lens(v).magnification(Grid(z[None], (3, 3), 0.1).depths)[0]
    value, slope = jax.jit(jax.value_and_grad(depth))(jnp.array(-5.8), jnp.array(20.0))
    np.testing.assert_allclose([value, slope], np.array([-5.8, 1]) / (20 + 1 / 1.43), rtol=1e-12)


def test_lenses_may_differ():
    array = MicrolensArray([[0.0, 0.0], [1.0, 0.0]], radius_of_curvature=[2.0, 2.2], conic_constant=-0.7)
    assert not array.alike and array.lens(1).alike
    second = array.lens(1)
    np.testing.assert_allclose([second.radius_of_curvature, second.conic_constant], [2.2, -0.7])
    np.testing.assert_array_equal(second.centers, [[1.0, 0.0]])
    trace_lenslet(imager_of(second), 20.0, np.zeros(2))
    with pytest.raises(ValueError, match=r"Lenses must be alike, got lenses that differ in radius_of_curvature"):
        trace_lenslet(imager_of(array), 20.0, np.zeros(2))


def test_numbers_of_each_lens_are_sorted_into_types():
    centers = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    array = MicrolensArray(centers, radius_of_curvature=[2.2, 2.0, 2.2])
    np.testing.assert_array_equal(array.radius_of_curvature, [2.2, 2.0])
    np.testing.assert_array_equal(array.types, [0, 1, 0])
    np.testing.assert_array_equal(array.of_lenses("radius_of_curvature"), [2.2, 2.0, 2.2])
    assert MicrolensArray(centers, radius_of_curvature=[2.0] * 3).alike
    traced = jax.jit(lambda radii: MicrolensArray(centers, radii).type_count + 0 * radii[0])
    assert traced(jnp.array([2.0, 2.0, 2.0])) == 3
    for types, wrong in ([[0, 2, 0], "all numbers from 0 to 1"], [[0, 1], "an integer for each of 3"]):
        with pytest.raises(ValueError, match=wrong):
            MicrolensArray(centers, radius_of_curvature=[2.0, 2.2], types=types)
    with pytest.raises(ValueError, match="`types` must be None with a number of each lens"):
        dataclasses.replace(array, radius_of_curvature=[2.0, 2.1, 2.2])


def imager_of(array):
    return Imager(array, Sensor((8, 8), 0.01), 5.8, 3.0)


def test_an_array_says_what_its_numbers_may_be():
    with pytest.raises(ValueError, match=r"`conic_constant` must be one number or \(2,\), got \(3,\)"):
        MicrolensArray([[0.0, 0.0], [1.0, 0.0]], conic_constant=[0.0, 0.0, 0.0])
