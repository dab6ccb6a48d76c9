from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.optimize import fminbound

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.microscope.geometry import chief_ray
from gs_jax.optics.aberrations import best_focus, wavefront, wavefront_rms
from gs_jax.optics.pupil import pupil_quadrature, solid_angle, transmittance
from gs_jax.optics.raytrace import refract, to_numpy, trace_lenslet

WAVELENGTH = 520e-6
FIELDS = [(0.0, 0.0), (1.0, -0.4), (0.0, 3.0)]
SHAPES: list[dict] = [
    {},
    {"conic_constant": -2.0},
    {"orientation": "curved"},
    {"orientation": "curved", "conic_constant": -0.7, "aspheric_terms": (0.01, -0.002)},
]


def lenslet(v=5.8, dtype=jnp.float64, **lens):
    imager = Imager(MicrolensArray([[0.0, 0.0]], **lens), Sensor((64, 64), 0.0045), v, 3.0)
    return jax.tree.map(lambda leaf: jax.device_put(np.array(leaf, dtype)), imager)


def some_points(radius=0.9, count=40):
    rng = np.random.default_rng(0)
    angle, length = rng.uniform(0, 2 * np.pi, count), radius * np.sqrt(rng.uniform(0, 1, count))
    return np.column_stack([length * np.cos(angle), length * np.sin(angle)])


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("lens", SHAPES, ids=str)
@pytest.mark.parametrize(("depth", "thickness"), [(20.0, 1.0), (3.0, 2.5)])
def test_fermat_and_snell(field, lens, depth, thickness):
    """The path through a point of the lens is least over the plane, and has Snell's slopes at the curved side."""
    imager = lenslet(substrate_thickness=thickness, **lens)
    points = np.vstack([[0, 0], some_points()])
    rays = trace_lenslet(imager, depth, points, field)
    shape = lens.get("conic_constant", 0.0), np.array(lens.get("aspheric_terms", (0.0, 0.0)))
    scene = np.array(field), depth, thickness, *shape
    total, slope = total_and_slope(points, rays.landing, scene, flipped=lens.get("orientation") == "curved")
    assert np.all(rays.valid)
    # Fermat at the curved side: the path does not change when the point moves on it.
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    # Paths of 30 mm in float64.
    np.testing.assert_allclose(rays.path, total - total[0], atol=1e-13)


@partial(jax.jit, static_argnames="flipped")
def total_and_slope(points, ends, scene, *, flipped):
    """The least paths over the plane, and their slopes by the points of the curved side."""

    def least(point, end):
        """Newton's steps on Fermat's principle at the plane."""
        along = lambda a: path(a, point, end, scene, flipped)
        newton = lambda _, a: a - jnp.linalg.solve(jax.hessian(along)(a), jax.grad(along)(a))
        return jax.lax.fori_loop(0, 8, newton, point)

    def of_ray(point, end):
        on_plane = least(point, end)
        return jax.value_and_grad(path, 1)(on_plane, point, end, scene, flipped)

    return jax.vmap(of_ray)(points, ends)


def path(on_plane, point, end, scene, flipped):
    """From the object to the sensor; z from the vertex."""
    field, depth, thickness, conic_constant, terms = scene
    n, v = 1.43, 5.8
    leg = lambda a, b: jnp.sqrt(jnp.sum((a - b) ** 2))
    sag = falls(jnp.sum(point**2), conic_constant, terms)
    surface, plane = jnp.append(point, sag if flipped else -sag), jnp.append(on_plane, thickness * (2 * flipped - 1))
    first, second = (surface, plane) if flipped else (plane, surface)
    start = jnp.append(field, -depth if flipped else -thickness - depth)
    last = jnp.append(end, thickness + v if flipped else v)
    return leg(start, first) + n * leg(first, second) + leg(second, last)


def falls(squared, conic_constant, terms):
    """The surface below its vertex, as ISO 10110-12 has it; R is 2 mm."""
    c, r = 0.5, jnp.sqrt(squared + 1e-300)
    conic = c * r**2 / (1 + jnp.sqrt(1 - (1 + conic_constant) * c**2 * r**2))
    return conic + terms[0] * r**4 + terms[1] * r**6


@pytest.mark.integration
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("lens", [*SHAPES, {"thin_lens_focal_length": 4.65}], ids=str)
def test_rays_without_a_compiler_are_the_same(field, lens):
    """Beyond the surface too; and the solid angle is what the Jacobian of the slope by the point says."""
    imager, points = lenslet(**lens), 2.2 * some_points()
    wanted, (x, y) = trace_lenslet(imager, 20.0, points, field), field
    host = refract(to_numpy(imager), 20.0, points.T, np.array([[x], [y]]))
    assert all(isinstance(part, np.ndarray) for part in jax.tree.leaves(host)) and host.valid.any()
    np.testing.assert_array_equal(host.valid, wanted.valid)
    for found, ours in ((host.landing, wanted.landing), (host.tangent, wanted.tangent)):
        np.testing.assert_allclose(found.T, ours, rtol=1e-12, atol=1e-14)

    def slope(point):
        return refract(imager, jnp.asarray(20.0), point, jnp.asarray(field)).slope

    angle = solid_angle(to_numpy(imager), host)
    jacobian = jnp.linalg.det(jax.vmap(jax.jacfwd(slope))(jnp.asarray(points)))
    expected = jnp.abs(jacobian) * (1 + jnp.sum(jax.vmap(slope)(jnp.asarray(points)) ** 2, -1)) ** -1.5
    np.testing.assert_allclose(angle[host.valid], expected[host.valid], rtol=1e-9)


def test_light_is_counted_on_either_side():
    """On the axis both faces pass `1 - ((n - 1) / (n + 1))^2`, and a piece of the lens takes `dA / (4 pi z'^2)`."""
    for orientation, reduced in (("plano", 20 + 1 / 1.43), ("curved", 20.0)):
        imager = to_numpy(lenslet(orientation=orientation))
        ray = refract(imager, 20.0, np.zeros((2, 1)), np.zeros((2, 1)))
        np.testing.assert_allclose(transmittance(imager, ray), (1 - (0.43 / 2.43) ** 2) ** 2, rtol=1e-12)
        np.testing.assert_allclose(solid_angle(imager, ray), reduced**-2.0, rtol=1e-12)


@pytest.mark.parametrize("lens", SHAPES, ids=str)
def test_paraxial_rays_follow_the_shared_geometry(lens):
    imager = lenslet(**lens)
    field, points = 1e-4 * np.array([3.0, -2.0]), 1e-4 * some_points()
    landing = trace_lenslet(imager, 20.0, points, field).landing
    host = to_numpy(imager)
    reduced = host.reduced_depth(20.0)
    vergence = 1 / host.array.focal_length - 1 / reduced
    v = 5.8 + (1 / 1.43 if lens.get("orientation") == "curved" else 0)
    expected = chief_ray(np.zeros((1, 2)), field[None], v / reduced) + points * (1 - v * vergence)
    # What is left out is of the third order in the slopes: 1e-12.
    np.testing.assert_allclose(landing, expected, atol=1e-11)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("lens", [*SHAPES, {"thin_lens_focal_length": 4.65}], ids=str)
def test_the_paths_slope_is_the_rays(field, lens):
    """Hamilton: moving the sensor and its point changes the path by the direction cosines."""
    slope, derivative = slopes(lenslet(**lens), np.array(field))
    np.testing.assert_allclose(derivative, slope, rtol=1e-10)


@jax.jit
def slopes(imager, field):
    """Of the path of a ray less that of the chief ray: as the ray's direction has it, and by differentiation."""
    points = np.array([[0.3, -0.5], [0.0, 0.0]])

    def path_less_projection(v):
        rays = trace_lenslet(eqx.tree_at(lambda i: i.sensor_distance, imager, v), 20.0, points, field)
        secants = jnp.sqrt(1 + jnp.sum(rays.tangent**2, 1))
        return rays.path[0], secants[0] - secants[1]

    (_, slope), (derivative, _) = jax.jvp(path_less_projection, (imager.sensor_distance,), (jnp.array(1.0),))
    return slope, derivative


def test_an_ideal_lens_has_two_spheres():
    """In focus no wavefront; beside it the difference of two spheres."""
    f, z = 4.65, 20.0 + 1 / 1.43
    image = 1 / (1 / f - 1 / z)
    points = some_points()
    field = np.array([1.0, -2.0])
    in_focus = wavefront(lenslet(image, thin_lens_focal_length=f), 20.0, points, field)
    np.testing.assert_allclose(in_focus, 0, atol=1e-14)

    v = 5.0
    bundle = np.append(-field / z * image, image)
    sphere = np.append(-field / z * v, v)
    surface = np.column_stack([points, np.zeros(len(points))])
    direction = (bundle - surface) / np.linalg.norm(bundle - surface, axis=1, keepdims=True)
    from_center = surface - sphere
    # From the lens along the ray to the sphere through the vertex about the end of the chief ray.
    b = (from_center * direction).sum(1)
    to_sphere = -b - np.sqrt(b**2 - (from_center**2).sum(1) + (sphere**2).sum())
    expected = np.linalg.norm(bundle) - np.linalg.norm(bundle - surface, axis=1) + to_sphere
    moved = wavefront(lenslet(v, thin_lens_focal_length=f), 20.0, points, field)
    np.testing.assert_allclose(moved, expected, atol=1e-13)


def test_an_ideal_lens_collimates_from_its_focus():
    rays = trace_lenslet(lenslet(thin_lens_focal_length=4.65), 4.65 - 1 / 1.43, some_points(), (0.5, 0.0))
    np.testing.assert_allclose(rays.tangent, np.broadcast_to([-0.5 / 4.65, 0], (40, 2)), atol=1e-14)


@pytest.mark.integration
@pytest.mark.parametrize("v", [4.0, 5.8])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("lens", SHAPES, ids=str)
def test_float32_keeps_a_wavefront_of_30_waves_to_a_thousandth(v, field, lens):
    points = some_points(0.65)
    exact = wavefront(lenslet(v, **lens), 20.0, points, field)
    low = wavefront(lenslet(v, jnp.float32, **lens), 20.0, points, field)
    assert low.dtype == jnp.float32
    # Differences of paths, not paths: 25 mm in float32 alone would be wrong by 2e-3 waves in each of its sums.
    np.testing.assert_allclose(low, exact, rtol=0, atol=5e-4 * WAVELENGTH)


def test_best_focus_of_a_thin_lens_is_the_image():
    v = best_focus(lenslet(thin_lens_focal_length=4.65), 20.0, radius=0.3)
    np.testing.assert_allclose(v, 1 / (1 / 4.65 - 1 / (20 + 1 / 1.43)), rtol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("lens", SHAPES, ids=str)
def test_best_focus_is_the_least_wavefront_error(field, lens):
    error = jax.jit(lambda v: wavefront_rms(lenslet(v, **lens), 20.0, field=field, radius=0.65))
    least = fminbound(lambda v: float(error(v)), 3.5, 6.5, xtol=1e-9)
    # A minimum is flat: half the digits. With the error off the axis, the Gauss-Newton steps end at 1e-5.
    np.testing.assert_allclose(best_focus(lenslet(4.0, **lens), 20.0, field=field, radius=0.65), least, rtol=1e-5)


def test_disc_averages():
    points, weights = pupil_quadrature(0.7)
    x, y = points.T
    np.testing.assert_allclose(weights.sum(), 1, rtol=1e-14)
    # <x^2> = r^2/4, <x^4 y^2> = r^6/64 over a disc.
    np.testing.assert_allclose(jnp.sum(weights * x**2), 0.7**2 / 4, rtol=1e-13)
    np.testing.assert_allclose(jnp.sum(weights * x**4 * y**2), 0.7**6 / 64, rtol=1e-13)


@pytest.mark.integration
def test_no_ray_through_what_is_no_lens():
    """Beside the sphere, or where the light is reflected totally: no value, and gradients that are finite."""
    points = np.array([[2.5, 0.0], [2.0, 0.0], [1.9, 0.0], [0.5, 0.0]])
    rays = trace_lenslet(lenslet(), 20.0, points)
    assert rays.valid.tolist() == [False, False, False, True]
    assert np.isnan(wavefront(lenslet(), 20.0, points)).tolist() == [True, True, True, False]
    total = lambda imager, points: jnp.sum(trace_lenslet(imager, 20.0, points).path)
    gradients = jax.jit(jax.grad(total, (0, 1)))(lenslet(), jnp.asarray(points))
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


def test_a_perfect_wavefront_has_a_gradient():
    """An ideal lens in focus; the error is the root of zero."""
    perfect = lenslet(8.0, thin_lens_focal_length=4.0, substrate_thickness=0.0)
    value, gradient = jax.jit(jax.value_and_grad(lambda imager: wavefront_rms(imager, 8.0)))(perfect)
    assert value < 1e-12 and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.integration
@pytest.mark.parametrize("lens", [*SHAPES, {"thin_lens_focal_length": 4.65}], ids=str)
@pytest.mark.parametrize("modes", [["fwd"], ["rev"]])
def test_gradients(lens, modes):
    points = jnp.asarray(some_points(0.8, 3)).at[0].set(0)
    values = jax.jit(lambda *arguments: (*trace_lenslet(*arguments)[:3], wavefront(*arguments)))
    # At the vertex and on the axis too; steps of 1e-5 of a smooth function leave 1e-9.
    for field in (jnp.zeros(2), jnp.array([1.0, 2.0])):
        arguments = (lenslet(**lens), jnp.array(20.0), points, field)
        check_grads(values, arguments, order=1, modes=modes, eps=1e-5, atol=1e-7, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("modes", [["fwd"], ["rev"]])
def test_gradients_of_the_best_focus(modes):
    focus = jax.jit(lambda imager, depth, radius: best_focus(imager, depth, radius=radius))
    check_grads(
        focus, (lenslet(), jnp.array(20.0), jnp.array(0.65)), order=1, modes=modes, eps=1e-5, atol=1e-6, rtol=1e-6
    )
