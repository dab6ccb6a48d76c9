import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.integrate import quad
from scipy.optimize import brentq, root_scalar
from scipy.special import j1

from gs_jax.optics import theory

F, DEPTH, PITCH = 2 / 0.43, 20.0, 1.23


def test_the_papers_numbers():
    """Table 1 and "Design of the microlens array", which take the pitch for the diameter; printed with two digits."""
    np.testing.assert_allclose(F, 4.65, rtol=1e-3)
    aperture = theory.numerical_aperture(F, PITCH)
    np.testing.assert_allclose(aperture, 0.13, rtol=0.02)
    lateral = theory.lateral_resolution(520e-6, aperture, 4.5e-3, 0.11)
    np.testing.assert_allclose(lateral, 0.040, rtol=0.03)
    np.testing.assert_allclose(theory.axial_resolution(lateral, 22.0, 3.0), 0.300, rtol=0.03)
    n_e = theory.lenses_per_point(200, 400.0, 3.0)
    np.testing.assert_allclose(n_e, 4.5 * np.pi, rtol=1e-12)
    np.testing.assert_allclose(theory.occupancy(20.0, 0.15), 0.45, rtol=1e-12)


def test_a_thin_lens_out_of_focus():
    """A point at 20 mm, the sensor at 4 mm: the figures that the printed design comes to."""
    np.testing.assert_allclose(theory.focus_distance(F, DEPTH), 6.06, atol=0.005)
    np.testing.assert_allclose(theory.focus_distance(F, DEPTH) - 4.0, 2.06, atol=0.005)
    np.testing.assert_allclose(theory.blur(F, PITCH, DEPTH, 4.0), 0.418, atol=0.001)
    np.testing.assert_allclose(theory.object_blur(F, PITCH, DEPTH, 4.0), 2.09, atol=0.005)


@pytest.mark.parametrize(
    ("circle_of_confusion", "exact", "approximate"), [(0.009, 0.97, 1.26), (0.018, 1.94, 2.53), (0.036, 3.9, 5.1)]
)
def test_what_circle_of_confusion_the_papers_5_mm_need(circle_of_confusion, exact, approximate):
    arguments = (F, theory.f_number(F, PITCH), DEPTH, circle_of_confusion)
    np.testing.assert_allclose(theory.depth_of_field(*arguments), exact, rtol=0.01)
    np.testing.assert_allclose(theory.approximate_depth_of_field(*arguments), approximate, rtol=0.01)


@pytest.mark.parametrize("circle_of_confusion", [0.009, 0.05])
def test_limits_are_where_the_blur_is_the_circle_of_confusion(circle_of_confusion):
    """Eq. 8 against a root of the blur, with the sensor where the depth is in focus."""
    v = float(theory.focus_distance(F, DEPTH))
    root = lambda low, high: float(brentq(excess, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]
    excess = lambda z: float(theory.blur(F, PITCH, z, v)) - circle_of_confusion
    arguments = (F, theory.f_number(F, PITCH), DEPTH, circle_of_confusion)
    np.testing.assert_allclose(theory.near_limit(*arguments), root(5.0, DEPTH), rtol=1e-12)
    np.testing.assert_allclose(theory.far_limit(*arguments), root(DEPTH, 200.0), rtol=1e-12)


def test_the_approximation_is_too_large_by_z_over_z_less_f():
    """In the limit of a small circle."""
    arguments = (F, theory.f_number(F, PITCH), DEPTH, 1e-6)
    ratio = theory.approximate_depth_of_field(*arguments) / theory.depth_of_field(*arguments)
    np.testing.assert_allclose(ratio, DEPTH / (DEPTH - F), rtol=1e-6)


def test_blur_by_two_marginal_rays():
    """Similar triangles behind the lens, for images behind the sensor and before it."""
    for z, v in [(20.0, 4.0), (20.0, 5.8), (30.0, 6.5)]:
        image = F * z / (z - F)
        edges = np.array([-1, 1]) * PITCH / 2 * (1 - v / image)
        np.testing.assert_allclose(theory.blur(F, PITCH, z, v), abs(np.diff(edges)[0]), rtol=1e-12)


def test_beyond_the_hyperfocal_distance():
    number, circle_of_confusion = theory.f_number(F, PITCH), 0.036
    hyperfocal = F**2 / (circle_of_confusion * number) + F
    far = lambda z: theory.far_limit(F, number, z, circle_of_confusion)
    assert jnp.isfinite(far(hyperfocal * 0.999)) and far(hyperfocal * 1.001) == jnp.inf
    assert theory.depth_of_field(F, number, hyperfocal * 1.001, circle_of_confusion) == jnp.inf
    # Focused there, everything from half of it on is sharp.
    near = theory.near_limit(F, number, hyperfocal, circle_of_confusion)
    np.testing.assert_allclose(near, hyperfocal / 2, rtol=1e-12)


def test_gradients_are_finite_where_values_are_not():
    for function, arguments in [
        (theory.far_limit, (F, 3.8, 500.0, 0.036)),
        (theory.depth_of_field, (F, 3.8, 500.0, 0.036)),
        (theory.approximate_depth_of_field, (F, 3.8, 500.0, 0.036)),
        (theory.focus_distance, (F, F)),
        (theory.depth_in_focus, (F, 4.0)),
        (theory.blur, (F, PITCH, DEPTH, float(theory.focus_distance(F, DEPTH)))),
    ]:
        gradients = jax.grad(function, argnums=range(len(arguments)))(*arguments)
        assert all(jnp.isfinite(g) for g in gradients), function


def test_the_spot_or_the_pixel_limits_the_resolution():
    exact = lambda spot: theory.lateral_resolution(2 * spot, 1.0, 4.5e-3, 0.2)
    np.testing.assert_allclose(exact(9e-3), theory.diffraction_limit(2 * 9e-3, 1.0, 0.2), rtol=1e-12)
    np.testing.assert_allclose(exact(1e-3), 4.5e-3 / 0.2, rtol=1e-12)


def test_the_airy_disc_is_as_wide_as_its_gaussian():
    """Half the peak of (2 J1(x) / x)^2, by SciPy's Bessel function."""
    half = root_scalar(lambda x: (2 * j1(x) / x) ** 2 - 0.5, bracket=(1.0, 2.0)).root
    width = 2 * half * 0.52e-3 * 5.0 / (np.pi * 1.2)
    np.testing.assert_allclose(theory.FWHM * theory.airy_sigma(0.52e-3, 5.0, 1.2), width, rtol=1e-3)


def test_the_contrast_of_a_round_aperture():
    """The overlap of two discs, by quadrature; nothing passes the cutoff, and the slope there is finite."""
    cutoff = float(theory.cutoff_frequency(0.52e-3, 5.0, 1.2))
    np.testing.assert_allclose(cutoff, 1.2 / (0.52e-3 * 5.0))
    for share in (0.0, 0.3, 0.8):
        overlap = 4 * quad(lambda x: np.sqrt(1 - x**2), share, 1)[0] / np.pi
        np.testing.assert_allclose(theory.ideal_mtf(share * cutoff, cutoff), overlap, rtol=1e-9, atol=1e-12)
    slope = jax.vmap(jax.grad(theory.ideal_mtf), (0, None))
    np.testing.assert_allclose(theory.ideal_mtf(jnp.array([1.0, 2.0]) * cutoff, cutoff), 0, atol=1e-8)
    assert jnp.isfinite(slope(jnp.array([0.0, 1.0, 2.0]) * cutoff, cutoff)).all()


def test_lenses_are_counted():
    x, y = np.meshgrid(np.arange(-9.5, 10), np.arange(-9.5, 10))
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    points = np.random.default_rng(0).uniform(-6, 6, (300, 2))
    count = theory.count_lenses(centers, points, 3.0)
    assert count[7] == sum(np.hypot(*(c - points[7])) <= 3 for c in centers)
    # 300 samples of a count that varies by a few lenses of 28.
    np.testing.assert_allclose(count.mean(), theory.lenses_per_point(400, 400.0, 3.0), rtol=0.01)


@pytest.mark.parametrize(("plate", "sensor"), [(20.0, 23.04), (20.0, 10.0), (4.0, 23.04)])
def test_field_of_view_by_search(plate, sensor):
    m, r = 0.2, 3.0
    c = np.linspace(-plate / 2, plate / 2, 2001)
    q = np.linspace(0, 20, 4001)[:, None]
    seen = ((np.abs(c - q) <= r) & (np.abs(c + m * (c - q)) <= sensor / 2)).any(axis=1)
    # Steps of the search.
    np.testing.assert_allclose(theory.field_of_view(plate, sensor, m, r), 2 * q[seen].max(), atol=0.04)


def test_gradients():
    number = theory.f_number(F, PITCH)
    cases = [
        (theory.f_number, (F, PITCH)),
        (theory.numerical_aperture, (F, PITCH)),
        (theory.diffraction_limit, (520e-6, 0.13, 0.2)),
        (theory.lateral_resolution, (520e-6, 0.13, 0.0045, 0.2)),
        (theory.lateral_resolution, (5200e-6, 0.13, 0.0045, 0.2)),
        (theory.axial_resolution, (0.02, DEPTH, 3.0)),
        (theory.focus_distance, (F, DEPTH)),
        (theory.depth_in_focus, (F, 5.8)),
        (theory.blur, (F, PITCH, DEPTH, 5.8)),
        (theory.object_blur, (F, PITCH, DEPTH, 6.5)),
        (theory.near_limit, (F, number, DEPTH, 0.02)),
        (theory.far_limit, (F, number, DEPTH, 0.02)),
        (theory.depth_of_field, (F, number, DEPTH, 0.02)),
        (theory.approximate_depth_of_field, (F, number, DEPTH, 0.02)),
        (theory.effective_area, (3.0,)),
        (lambda area, r: theory.lenses_per_point(200, area, r), (400.0, 3.0)),
        (theory.occupancy, (14.0, 0.2)),
        (theory.field_of_view, (20.0, 23.04, 0.2, 3.0)),
        (theory.field_of_view, (20.0, 13.0, 0.2, 3.0)),
    ]
    for function, arguments in cases:
        arguments = tuple(jnp.asarray(x) for x in arguments)
        check_grads(function, arguments, order=1, eps=1e-7, atol=1e-5, rtol=1e-5)


def test_everything_broadcasts():
    depths, circle_of_confusion = jnp.array([[18.0], [20.0]]), jnp.array([[0.009, 0.018, 0.036]])
    assert theory.depth_of_field(F, 3.8, depths, circle_of_confusion).shape == (2, 3)
    assert theory.blur(F, PITCH, depths, jnp.array([[4.0, 5.8]])).shape == (2, 2)
