"""First steps on wide voxels and pixels, from which a reconstruction goes on with narrow ones."""

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import gs_jax as gs
from gs_jax import forward
from gs_jax.base.progress import Progress
from gs_jax.reconstruction import inverse_problem
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.solvers.base import Refinement

from .helpers import scene


def test_light_is_kept_and_a_slope_stays_one():
    refinement = Refinement.of((21, 17), (11, 9), 2, np.float64)
    wide, narrow = (np.arange(n) - (n - 1) / 2 for n in (9, 17))
    volume = np.broadcast_to(5 + 2 * wide, (2, 11, 9))
    # Half a wide voxel beyond the outer ones, values are those of these.
    expected = 5 + np.clip(narrow, -8, 8)
    np.testing.assert_allclose(refinement.values(volume), np.broadcast_to(expected, (2, 21, 17)), rtol=1e-12)
    spot = np.zeros((2, 11, 9))
    spot[1, 4, 6] = 3.0
    light = refinement.light(spot)
    np.testing.assert_allclose(light.sum((1, 2)), [0, 3], rtol=1e-12)
    np.testing.assert_array_equal(np.unravel_index(light.argmax(), light.shape), [1, 8, 12])


@pytest.fixture
def bright_square(monkeypatch):
    """A microscope with a grid that has wider voxels, a volume, and its image."""
    monkeypatch.setattr(inverse_problem, "_LEAST_VOXELS", 8)
    imager, grid = scene(voxels=(21, 17), pitch=0.14, depths=(18.0, 20.0))
    truth = np.zeros(grid.volume_shape)
    truth[1, 8:12, 6:10] = 1.0
    return imager, grid, truth, np.asarray(forward(truth, imager, grid))


@pytest.mark.parametrize(
    "name",
    [
        "richardson-lucy",
        *(pytest.param(name, marks=pytest.mark.integration) for name in ("list-rl", "fista", "unrolled")),
    ],
)
def test_it_goes_on_from_wide_voxels(bright_square, name):
    """The scene has its light and its place; a step on narrow voxels explains the image as well as the ones before."""
    imager, grid, truth, image = bright_square
    reconstructor = gs.Reconstructor(imager, grid, METHODS[name](20), "pinhole")
    (wide,) = reconstructor.wider
    assert wide.grid.volume_shape == (2, 11, 9) and wide.grid.pitch == 2 * grid.pitch
    assert wide.imager.sensor.shape == tuple(n // 2 for n in reconstructor.problem.imager.sensor.shape)
    volume = reconstructor(image)
    assert gs.quality(volume, truth).psnr_db > gs.quality(np.zeros_like(truth), truth).psnr_db + 3
    again = reconstructor(image)
    np.testing.assert_array_equal(volume, again)


def test_a_user_may_begin_on_the_grid_itself(bright_square):
    """`init` and `step` take no steps on wide voxels; `solve` takes those that the method has, and fewer after them."""
    imager, grid, _, image = bright_square
    reconstructor = gs.Reconstructor(imager, grid, METHODS["richardson-lucy"](20), "pinhole")
    state = reconstructor.step(reconstructor.init(image))
    assert state.solver.x.shape == grid.volume_shape
    totals = []

    class Log(Progress):
        def counter(self, description, total, **options):
            totals.append(total)
            return super().counter(description, total, **options)

    reconstructor.solve(image, Log())
    # Ten by each sieve, and as many more as predict what was held out; then some of those on the grid itself.
    assert totals[:2] == [10, 10] and totals[-1] == 15 and sum(totals[2:-1]) <= 30


def test_noise_decides_on_the_sieve(bright_square):
    """Single voxels need none, in dim captures too, and a smooth scene has one; another width is taken as it is."""
    imager, grid, truth, _ = bright_square
    points = np.zeros_like(truth)
    points[1, [5, 10, 15], [4, 8, 12]] = 1.0
    shown = lambda scene: np.asarray(forward(scene, imager, grid))
    dim = lambda image: np.random.default_rng(0).poisson(300 / image.max() * image).astype(np.float32)
    sieve_of = lambda reconstructor, image: reconstructor.solve(image, Progress()).sieve
    chosen = gs.Reconstructor(imager, grid, METHODS["richardson-lucy"](20), "pinhole")
    images = [shown(points), dim(shown(points)), shown(gaussian_filter(truth, (0, 3, 3)))]
    np.testing.assert_allclose([sieve_of(chosen, image) for image in images], [0, 0, 1.4], rtol=1e-6)
    given = gs.Reconstructor(imager, grid, gs.RichardsonLucy(20, sieve=0.6), "pinhole")
    assert float(sieve_of(given, images[0])) == pytest.approx(0.6)


def test_pixels_that_are_left_out_of_wide_ones_are_not_read(bright_square):
    imager, grid, _, image = bright_square
    reconstructor = gs.Reconstructor(imager, grid, METHODS["richardson-lucy"](4), "pinhole")
    kept = np.ones(reconstructor.problem.imager.sensor.shape)
    kept[:, 11:20] = 0
    side = reconstructor.problem.binning
    lit = image + 500.0 * np.kron(kept == 0, np.ones((side, side)))
    part = reconstructor.keeping(kept)
    (wide,) = part.wider
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(wide.kept)[0] == 0), np.arange(5, 10))
    assert not jax.tree.leaves(reconstructor.wider[0].kept)
    np.testing.assert_allclose(part(lit), part(image), rtol=1e-5, atol=1e-7)


def test_pixels_are_left_out_of_volumes_too_small_for_wide_ones():
    imager, grid = scene(voxels=(21, 17), pitch=0.14, depths=(18.0, 20.0))
    reconstructor = gs.Reconstructor(imager, grid, METHODS["richardson-lucy"](4), "pinhole")
    kept = np.ones(reconstructor.problem.imager.sensor.shape)
    kept[:, 11:20] = 0
    part = reconstructor.keeping(kept)
    assert not part.wider
    np.testing.assert_array_equal(part.problem.kept, kept)


def test_a_background_is_that_of_wide_pixels_on_these(bright_square):
    """A number and an image of narrow pixels are the same."""
    imager, grid, _, image = bright_square
    shape = gs.Reconstructor(imager, grid, METHODS["richardson-lucy"](4), "pinhole").problem.imager.sensor.shape
    by = lambda background: gs.RichardsonLucy(4, accelerate=True, background=background, min_sensitivity=0.3)
    volumes = [gs.Reconstructor(imager, grid, by(b), "pinhole")(image) for b in (5.0, np.full(shape, 5.0))]
    np.testing.assert_allclose(*volumes, rtol=1e-4, atol=1e-6)


def test_solvers_with_steps_of_their_own_take_them_alone(bright_square):
    class Own(gs.FISTA):
        def init(self, A, image):
            return super().init(A, image)

    imager, grid, _, image = bright_square
    assert not gs.Reconstructor(imager, grid, Own(4), "pinhole").wider
    assert not gs.Reconstructor(imager, grid, gs.FISTA(4), "pinhole", wide=False).wider
