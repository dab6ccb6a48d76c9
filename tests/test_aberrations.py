import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.optics import aberrations
from gs_jax.optics.aberrations import WavefrontCoefficients, seidel_of_array, wavefront
from gs_jax.optics.theory import focus_distance

R, F, N, DEPTH, WAVELENGTH = 2.0, 2 / 0.43, 1.43, 20.7, 520e-6
# One program each instead of one for each of their operations.
seidel = jax.jit(aberrations.seidel, static_argnames="plano_to_object")
balanced_rms, independent_rms, linear_rms, log_strehl, strehl, linear_field_radius = map(
    jax.jit,
    (
        aberrations.balanced_rms,
        aberrations.independent_rms,
        aberrations.linear_rms,
        aberrations.log_strehl,
        aberrations.strehl,
        aberrations.linear_field_radius,
    ),
)
ORIENTATIONS = pytest.mark.parametrize("plano", [True, False])


def lens(plano, **parts):
    """Of the same curvature, with a plate that counts for nothing."""
    given: dict[str, Any] = {"radius_of_curvature": R, "refractive_index": N} | parts
    return MicrolensArray([[0.0, 0.0]], orientation="plano" if plano else "curved", **given)


def fitted(plano, a, height, v):
    """Coefficients of `r^4, r^3 cos, r^2 cos^2, r^2` among others, from exact rays; the image is on the +x side."""
    r, angle = np.meshgrid(np.linspace(0.1, 1, 12), np.linspace(0, 2 * np.pi, 24, endpoint=False))
    x, y = (r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()
    square = x**2 + y**2
    terms = [square**2, x * square, x**2, square, x, x**3, x**2 * square, x**4, square**3]
    imager = Imager(lens(plano, substrate_thickness=0.0), Sensor((8, 8), 0.005), v, 3.0)
    error = -wavefront(imager, DEPTH, a * np.stack([x, y], axis=1), (-height, 0.0))
    return np.linalg.lstsq(np.stack(terms, axis=1), error, rcond=None)[0][:4]


@ORIENTATIONS
def test_third_order_agrees_with_exact_rays(plano):
    """Small aperture and field: the fifth order is (a/R)^2 = 4e-4 and the field's square, with factors of a few."""
    a, height, v = 0.04, 0.4, float(focus_distance(F, DEPTH))
    error = seidel(F, N, a, DEPTH, height, v, plano_to_object=plano)
    spherical, coma, astigmatism, curvature = fitted(plano, a, height, v)
    np.testing.assert_allclose(fitted(plano, a, 0.0, v)[0], error.spherical, rtol=0.01)
    np.testing.assert_allclose(spherical, error.spherical, rtol=0.02)
    np.testing.assert_allclose(coma, error.coma, rtol=0.01)
    np.testing.assert_allclose(astigmatism, error.astigmatism, rtol=0.01)
    np.testing.assert_allclose(curvature, error.field_curvature, rtol=0.01)
    assert abs(error.defocus) < 1e-15


def test_a_sensor_beside_the_image_adds_defocus():
    """Traced to a sphere about the sensor's place, not the image's."""
    a, v = 0.02, 5.5
    error = seidel(F, N, a, DEPTH, 0.0, v)
    np.testing.assert_allclose(fitted(True, a, 0.0, v)[3], error.defocus, rtol=0.001)


@pytest.mark.parametrize(("n", "plano", "expected"), [(1.5, True, 4.5), (1.5, False, 7 / 6)])
def test_the_textbooks_singlet(n, plano, expected):
    """Longitudinal spherical aberration of a distant point, in units of `a^2 / f`: 4.5 or 7/6 at index 1.5.

    Any book on optics; it is `4 W040 (f/a)^2` here.
    """
    error = seidel(10.0, n, 1.0, 1e9, 0.0, 10.0, plano_to_object=plano)
    np.testing.assert_allclose(4 * error.spherical * 10**2, expected / 10, rtol=1e-7)


@ORIENTATIONS
def test_shape_and_conjugate_factors(plano):
    """The same sums in the form of Born & Wolf, 5.5, and Mahajan: a polynomial in shape and conjugate factor."""
    a, height, v = 0.7, 1.5, float(focus_distance(F, DEPTH))
    q, p = (-1 if plano else 1), 1 - 2 * F / v
    angle, n = height / DEPTH, N
    closed = a**4 / (32 * n * (n - 1) * F**3)
    closed *= n**3 / (n - 1) + (3 * n + 2) * (n - 1) * p**2 + 4 * (n + 1) * p * q + (n + 2) / (n - 1) * q**2
    coma = a**3 * angle / (4 * n * F**2) * ((2 * n + 1) * p + (n + 1) / (n - 1) * q)
    error = seidel(F, N, a, DEPTH, height, v, plano_to_object=plano)
    np.testing.assert_allclose(error.spherical, closed, rtol=1e-12)
    np.testing.assert_allclose(error.coma, coma, rtol=1e-12)


# Of NumPy's numbers, with which nothing is compiled.
coefficients: Any = WavefrontCoefficients


def wave(rng):
    """A wavefront of all terms, waves or mm."""
    return coefficients(*(np.asarray(x) for x in rng.normal(size=5)))


def test_rms_over_the_pupil():
    """Against sums over a fine grid of the pupil; `balanced` is what a least-squares fit of tilt and defocus leaves."""
    axis = np.linspace(-1, 1, 801)
    x, y = (grid[np.hypot(*np.meshgrid(axis, axis)) <= 1] for grid in np.meshgrid(axis, axis))
    square = x**2 + y**2
    shapes = {"spherical": square**2, "coma": x * square, "astigmatism": x**2, "defocus": square}
    removed = np.stack([np.ones_like(x), x, square], axis=1)
    left_of = lambda w: w - removed @ np.linalg.lstsq(removed, w, rcond=None)[0]
    for name, shape in shapes.items():
        one = coefficients(*(np.array(float(term == name)) for term in WavefrontCoefficients.__dataclass_fields__))
        # A pupil of squares of 1/400 of its radius.
        left = shape if name == "defocus" else left_of(shape)
        np.testing.assert_allclose(getattr(balanced_rms(one), name), left.std(), rtol=2e-3)
    error = wave(np.random.default_rng(0))
    whole = sum(getattr(error, name) * shape for name, shape in shapes.items()) + error.field_curvature * square
    tilt = np.stack([np.ones_like(x), x], axis=1)
    without_tilt = whole - tilt @ np.linalg.lstsq(tilt, whole, rcond=None)[0]
    np.testing.assert_allclose(independent_rms(error), without_tilt.std(), rtol=2e-3)


def test_defocus_that_balances_spherical_aberration():
    """`W020 = -W040` leaves the balanced part alone, in both sums."""
    zero = np.array(0.0)
    error = coefficients(np.array(2.0), zero, zero, zero, np.array(-2.0))
    np.testing.assert_allclose([linear_rms(error), independent_rms(error)], 2 / (6 * math.sqrt(5)), rtol=1e-14)


def test_the_printed_sum_leaves_out_the_field():
    error = wave(np.random.default_rng(1))
    by_hand = abs(error.spherical) / (6 * math.sqrt(5)) + abs(error.coma) / (6 * math.sqrt(2))
    by_hand += abs(error.defocus + error.spherical) / (2 * math.sqrt(3))
    np.testing.assert_allclose(linear_rms(error), by_hand, rtol=1e-14)


def test_strehl_ratio():
    """Marechal: 0.8 at a fourteenth of a wave; the logarithm where the ratio underflows."""
    np.testing.assert_allclose(strehl(WAVELENGTH / 14, WAVELENGTH), 0.8176, atol=1e-4)
    assert strehl(10 * WAVELENGTH, WAVELENGTH) == 0
    np.testing.assert_allclose(log_strehl(10 * WAVELENGTH, WAVELENGTH), -400 * np.pi**2, rtol=1e-14)


def test_strehl_ratio_against_a_diffraction_integral():
    """The peak of the PSF of a weakly aberrated pupil: Eq. 9 is 1 % off at 0.1 waves."""
    axis = np.linspace(-1, 1, 401)
    x, y = (grid[np.hypot(*np.meshgrid(axis, axis)) <= 1] for grid in np.meshgrid(axis, axis))
    for peak in (0.5, 1.3):  # waves of balanced spherical aberration: 0.04 and 0.1 waves RMS
        phase = 2 * np.pi * peak * ((x**2 + y**2) ** 2 - x**2 - y**2)
        zero = np.array(0.0)
        error = coefficients(np.array(peak), zero, zero, zero, np.array(-peak))
        np.testing.assert_allclose(strehl(independent_rms(error), 1.0), abs(np.exp(1j * phase).mean()) ** 2, rtol=0.01)


@ORIENTATIONS
@pytest.mark.parametrize("v", [4.0, 5.5, 5.8, 6.3])
@pytest.mark.parametrize("pupil", [0.2, 0.8])
def test_the_strehl_ratio_halves_at_the_field_radius(plano, v, pupil):
    """In logarithms: at 0.8 mm the ratio itself underflows."""
    height = linear_field_radius(lens(plano), pupil, DEPTH, v, WAVELENGTH)
    at = lambda h: log_strehl(linear_rms(seidel(F, N, pupil, DEPTH, h, v, plano_to_object=plano)), WAVELENGTH)
    # Logarithms of up to 7000 in float64, and their difference.
    np.testing.assert_allclose(at(height) - at(0.0), -np.log(2), rtol=1e-9)


def test_a_lens_without_coma_has_no_limit_by_the_printed_sum():
    """A convex side at the conjugate where coma vanishes; found by a plain search."""
    coma = lambda z: seidel(F, N, 0.2, z, 1.0, 5.0, plano_to_object=False).coma
    low, high = 5.0, 1e3
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if coma(low) * coma(middle) > 0 else (low, middle)
    radius = lambda z: linear_field_radius(lens(False), 0.2, z, 5.0, WAVELENGTH)
    assert radius(low) > 1e3
    assert np.isfinite(jax.jit(jax.grad(lambda z: 1 / radius(z)))(low * 1.01))


@pytest.mark.integration
@ORIENTATIONS
def test_gradients(plano):
    """In waves, so that the tolerance means something."""

    def values(*x):
        error = jax.tree.map(lambda w: w / WAVELENGTH, seidel(*x, plano_to_object=plano))
        sums = linear_rms(error), independent_rms(error), log_strehl(linear_rms(error), 10.0)
        return jax.tree.leaves((error, balanced_rms(error), sums))

    arguments = tuple(jnp.array(x) for x in (F, N, 0.7, DEPTH, 1.2, 5.7))
    check_grads(jax.jit(values), arguments, order=1, eps=1e-5, atol=1e-5, rtol=1e-5)


@ORIENTATIONS
@pytest.mark.parametrize("v", [5.5, 6.3])
def test_gradients_of_the_field_radius(plano, v):
    arguments = tuple(np.array(x) for x in (0.7, DEPTH, v))
    # The wavelength is the smallest of the lengths: micrometres.
    check_grads(_radius_by_um, (np.array(0.52), lens(plano), *arguments), order=1, eps=1e-6, atol=1e-6, rtol=1e-6)


@jax.jit
def _radius_by_um(um, array, a, z, v):
    return linear_field_radius(array, a, z, v, um / 1000)


@ORIENTATIONS
@pytest.mark.parametrize("shape", [{"conic_constant": -1.3}, {"aspheric_terms": (0.02, 0.01)}], ids=str)
def test_a_surface_that_is_no_sphere_changes_spherical_aberration_alone(plano, shape):
    """The difference to the sphere of exact wavefronts, along a radius of a small pupil."""
    # As many points as `fitted` has.
    radii = np.linspace(0.02, 0.06, 288)[:, None] * np.array([[0.0, 1.0]])
    parts = {"thin": lens(plano, substrate_thickness=0.0), "shaped": lens(plano, substrate_thickness=0.0, **shape)}
    errors, thirds = {}, {}
    for name, array in parts.items():
        imager = Imager(array, Sensor((8, 8), 0.005), 5.0, 3.0)
        errors[name] = -np.asarray(wavefront(imager, DEPTH, radii, (0.2, 0.0)))
        thirds[name] = jax.tree.map(np.asarray, jax.jit(seidel_of_array)(array, 1.0, DEPTH, 0.2, 5.0))
    fourth = (errors["shaped"] - errors["thin"]) / radii[:, 1] ** 4
    change = jax.tree.map(lambda a, b: a - b, thirds["shaped"], thirds["thin"])
    # The next order is the sixth, (r / R)^2 = 1e-3 of the fourth with factors of a few.
    np.testing.assert_allclose(fourth, change.spherical, rtol=0.01)
    assert change.coma == change.astigmatism == change.field_curvature == change.defocus == 0


def test_gradients_where_an_error_is_zero():
    """On the axis, and for a perfect wavefront."""
    error = lambda f, n, a, z, h: seidel(f, n, a, z, h, 5.7)
    total = lambda *x: independent_rms(error(*x)) + linear_rms(error(*x))
    assert all(np.isfinite(g) for g in jax.jit(jax.grad(total, argnums=range(5)))(F, N, 0.7, DEPTH, 0.0))
    none = coefficients(*(np.zeros(()) for _ in range(5)))
    assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jit(jax.grad(independent_rms))(none)))


def test_broadcasting_and_float32():
    depths, heights = np.array([[18.0], [20.0]], np.float32), np.array([[0.0, 1.0, 2.0]], np.float32)
    error = seidel(F, N, 0.7, depths, heights, 5.8)
    # What does not depend on the field broadcasts later.
    assert error.coma.shape == (2, 3) and error.spherical.shape == (2, 1)
    assert independent_rms(error).shape == (2, 3) and independent_rms(error).dtype == jnp.float32
    exact = seidel(F, N, 0.7, depths.astype(np.float64), heights.astype(np.float64), 5.8)
    np.testing.assert_allclose(independent_rms(error), independent_rms(exact), rtol=1e-5)
