"""Formulas of a lens, and the paper's quantities of an imager, against independent results."""

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq, root_scalar
from scipy.special import j1

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.objectives import Conditions
from gs_jax.optics import theory
from gs_jax.optics.raytrace import to_numpy

from .helpers import quantities

F, DEPTH, PITCH = 2 / 0.43, 20.0, 1.23
NUMBERS = {"f": F, "number": F / PITCH, "z": DEPTH, "confusion": 0.02, "v": 5.8, "diameter": PITCH}


@jax.jit
def _formulas(numbers):
    lens = [numbers[name] for name in ("f", "number", "z", "confusion")]
    return {
        "near": theory.near_limit(*lens),
        "far": theory.far_limit(*lens),
        "span": theory.depth_of_field(*lens),
        "approximate": theory.approximate_depth_of_field(*lens),
        "image": theory.focus_distance(numbers["f"], numbers["z"]),
        "in_focus": theory.depth_in_focus(numbers["f"], numbers["v"]),
        "blur": theory.blur(numbers["f"], numbers["diameter"], numbers["z"], numbers["v"]),
    }


def numbers_of(changes):
    return {name: np.array(number) for name, number in (NUMBERS | changes).items()}


def formulas(**changes):
    return {name: float(value) for name, value in _formulas(numbers_of(changes)).items()}


@jax.jit
def slopes(numbers):
    return jax.jacfwd(_formulas)(numbers)


def test_a_thin_lens_out_of_focus():
    """A point at 20 mm, the sensor at 4 mm: the figures that the printed design comes to."""
    found = formulas(v=4.0)
    np.testing.assert_allclose([F, found["image"]], [4.65, 6.06], atol=0.005)
    np.testing.assert_allclose(found["blur"], 0.418, atol=0.001)


@pytest.mark.parametrize(
    ("circle_of_confusion", "exact", "approximate"), [(0.009, 0.97, 1.26), (0.018, 1.94, 2.53), (0.036, 3.9, 5.1)]
)
def test_what_circle_of_confusion_the_papers_5_mm_need(circle_of_confusion, exact, approximate):
    found = formulas(confusion=circle_of_confusion)
    np.testing.assert_allclose([found["span"], found["approximate"]], [exact, approximate], rtol=0.01)


@pytest.mark.parametrize("circle_of_confusion", [0.009, 0.05])
def test_limits_are_where_the_blur_is_the_circle_of_confusion(circle_of_confusion):
    """Eq. 8 against a root of the blur, with the sensor where the depth is in focus."""
    found = formulas(confusion=circle_of_confusion)
    excess = lambda z: formulas(z=z, v=found["image"])["blur"] - circle_of_confusion
    root = lambda low, high: float(brentq(excess, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose([found["near"], found["far"]], [root(5.0, DEPTH), root(DEPTH, 200.0)], rtol=1e-12)


def test_the_approximation_is_too_large_by_z_over_z_less_f():
    """In the limit of a small circle."""
    found = formulas(confusion=1e-6)
    np.testing.assert_allclose(found["approximate"] / found["span"], DEPTH / (DEPTH - F), rtol=1e-6)


def test_blur_by_two_marginal_rays():
    """Similar triangles behind the lens, for images behind the sensor and before it."""
    for z, v in [(20.0, 4.0), (20.0, 5.8), (30.0, 6.5)]:
        edges = np.array([-1, 1]) * PITCH / 2 * (1 - v / (F * z / (z - F)))
        np.testing.assert_allclose(formulas(z=z, v=v)["blur"], abs(np.diff(edges)[0]), rtol=1e-12)


def test_beyond_the_hyperfocal_distance():
    hyperfocal = F**2 / (0.036 * F / PITCH) + F
    near, at, beyond = (formulas(confusion=0.036, z=share * hyperfocal) for share in (0.999, 1.0, 1.001))
    assert np.isfinite(near["far"]) and beyond["far"] == beyond["span"] == np.inf
    # Focused there, everything from half of it on is sharp.
    np.testing.assert_allclose(at["near"], hyperfocal / 2, rtol=1e-12)


def test_gradients():
    """Of finite differences; and finite where values are not, and where the blur has a kink."""
    found = slopes(numbers_of({}))
    for name, number in NUMBERS.items():
        step = 1e-6 * number
        ahead, behind = formulas(**{name: number + step}), formulas(**{name: number - step})
        for value in ahead:
            numeric = (ahead[value] - behind[value]) / (2 * step)
            np.testing.assert_allclose(found[value][name], numeric, rtol=1e-5, atol=1e-7, err_msg=value)
    kink = formulas()["image"]
    for changes in ({"z": 500.0, "confusion": 0.036}, {"z": F}, {"v": 4.0}, {"v": kink}):
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(slopes(numbers_of(changes)))), changes


@jax.jit
def diffraction(share):
    """Contrast at shares of the cutoff, its slopes, the cutoff, and the width of the Airy disc's Gaussian."""
    cutoff = theory.cutoff_frequency(0.52e-3, 5.0, 1.2)
    contrast = jax.vmap(jax.value_and_grad(lambda share: theory.ideal_mtf(share * cutoff, cutoff)))
    return *contrast(share), cutoff, theory.FWHM * theory.airy_sigma(0.52e-3, 5.0, 1.2)


def test_the_airy_disc_and_the_contrast_of_a_round_aperture():
    """Half the peak of (2 J1(x) / x)^2, by SciPy's Bessel function; the overlap of two discs, by quadrature. Nothing
    passes the cutoff, and the slope there is finite."""
    shares = np.array([0.0, 0.3, 0.8, 1.0, 2.0])
    contrast, slope, cutoff, width = map(np.asarray, diffraction(shares))
    half = root_scalar(lambda x: (2 * j1(x) / x) ** 2 - 0.5, bracket=(1.0, 2.0)).root
    np.testing.assert_allclose(width, 2 * half * 0.52e-3 * 5.0 / (np.pi * 1.2), rtol=1e-3)
    np.testing.assert_allclose(cutoff, 1.2 / (0.52e-3 * 5.0))
    overlap = [4 * quad(lambda x: np.sqrt(1 - x**2), min(share, 1), 1)[0] / np.pi for share in shares]
    np.testing.assert_allclose(contrast, overlap, rtol=1e-9, atol=1e-8)
    assert np.isfinite(slope).all()


def papers(plate=20.0, pixels=5120, pixel=0.0045, count=200) -> Imager:
    """The paper's lens, without the plate's thickness."""
    centers = np.zeros((count, 2))
    array = MicrolensArray(centers, refractive_index=1.43, substrate_thickness=0.0, size=(plate, plate))
    return Imager(array, Sensor((pixels, pixels), pixel), 4.0, 3.0, wavelength=520e-6)


NAMES = ("numerical_aperture", "lateral_resolution", "axial_resolution", "lenses_per_point", "occupancy", "blur")


def test_the_papers_numbers():
    """Table 1 and "Design of the microlens array", which take the pitch for the diameter; printed with two digits."""
    depths = np.array([4.0 / 0.11, 22.0, 20.0])
    found = {k: np.asarray(v) for k, v in quantities(papers(), Conditions(depths, clear_diameter=PITCH), NAMES).items()}
    np.testing.assert_allclose(found["numerical_aperture"], 0.13, rtol=0.02)
    np.testing.assert_allclose(found["lateral_resolution"][0], 0.040, rtol=0.03)
    np.testing.assert_allclose(found["axial_resolution"], found["lateral_resolution"] * depths / 3.0, rtol=1e-12)
    np.testing.assert_allclose(found["lenses_per_point"], 4.5 * np.pi, rtol=1e-12)
    np.testing.assert_allclose(found["occupancy"], 4.5 * np.pi * (4.0 / depths) ** 2, rtol=1e-12)
    np.testing.assert_allclose(found["blur"][2], 2.09, atol=0.005)
    # A narrow lens is limited by diffraction.
    narrow = quantities(papers(), Conditions(depths, clear_diameter=0.1), NAMES)["lateral_resolution"]
    np.testing.assert_allclose(narrow, 520e-6 * F / 0.1 * depths / 4.0, rtol=1e-12)


def test_lenses_are_counted():
    """300 samples of a count that varies by a few lenses of 28."""
    x, y = np.meshgrid(np.arange(-9.5, 10), np.arange(-9.5, 10))
    points = np.random.default_rng(0).uniform(-6, 6, (300, 2))
    away = np.hypot(x.ravel() - points[:, :1], y.ravel() - points[:, 1:])
    expected = quantities(papers(count=400), np.array([20.0]), ("lenses_per_point",))["lenses_per_point"]
    np.testing.assert_allclose((away <= 3).sum(1).mean(), expected, rtol=0.01)


@pytest.mark.parametrize(("plate", "sensor"), [(20.0, 23.04), (20.0, 10.0), (4.0, 23.04)])
def test_field_of_view_by_search(plate, sensor):
    imager = papers(plate, 100, sensor / 100)
    m, r = float(to_numpy(imager).magnification(20.0)), 3.0
    c = np.linspace(-plate / 2, plate / 2, 2001)
    q = np.linspace(0, 20, 4001)[:, None]
    seen = ((np.abs(c - q) <= r) & (np.abs(c + m * (c - q)) <= sensor / 2)).any(axis=1)
    found = quantities(imager, np.array([20.0]), ("field_of_view",))["field_of_view"]
    # Steps of the search.
    np.testing.assert_allclose(found, 2 * q[seen].max(), atol=0.04)
