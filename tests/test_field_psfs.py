"""PSFs measured over the field: the operator, the low-rank fit against sums of single PSFs, and the command."""

import csv

import jax
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from jax.test_util import check_grads
from scipy.signal import convolve2d

from gs_jax import FISTA, ConvolutionADMM, InputError, solve, write_capture
from gs_jax.__main__ import commands
from gs_jax.linear.measured_psf import FieldConvolutionOperator
from gs_jax.reconstruction.deconvolution import deconvolve, run_deconvolution
from gs_jax.reconstruction.field_fit import fit_field

SHAPE = (48, 56)
# Sources on a grid, mm; the array images 1 mm as 6 pixels, upside down.
GRID = np.array([(x, y) for y in (-2.0, 0.0, 2.0) for x in (-2.0, 0.0, 2.0)])
SCALE = -6.0
MIDDLE = np.array(SHAPE) // 2


def spots_at(row: float, column: float) -> np.ndarray:
    """Image of a source that a mask without aberrations images at this distance from the middle: three spots.

    They are wider and dimmer away from the axis, and one moves on its own.
    """
    y, x = np.indices(SHAPE)
    image = np.zeros(SHAPE)
    width = 0.9 + 0.04 * np.hypot(row, column)
    for down, across in ((-6, -5), (5, 7 + 0.1 * column), (4, -8)):
        at = MIDDLE + (row + down, column + across)
        image += np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * width**2)) / width**2
    return image


def measured() -> tuple[np.ndarray, np.ndarray]:
    psfs = [20 + 1000 * spots_at(SCALE * y, SCALE * x) for x, y in GRID]
    return np.array(psfs), np.column_stack([GRID, np.full(len(GRID), 12.0)])


def test_the_operator_is_the_sum_of_weighted_convolutions_with_an_exact_adjoint():
    rng = np.random.default_rng(0)
    kernels, weights = rng.normal(size=(2, 3, 5, 6)), rng.normal(size=(2, 3, 15, 15))
    scene, image = rng.normal(size=(2, 15, 15)), rng.normal(size=(9, 10))

    @jax.jit
    def both(kernels, weights, scene, image):
        A = FieldConvolutionOperator(kernels, weights, (9, 10))
        assert A.scene_shape == scene.shape
        return A.mv(scene), A.T.mv(image)

    with pytest.raises(InputError, match="must be used with a ConvolutionOperator, got FieldConvolutionOperator"):
        solve(FieldConvolutionOperator(kernels, weights, (9, 10)), image, ConvolutionADMM(steps=1))
    forth, back = map(np.asarray, both(kernels, weights, scene, image))
    np.testing.assert_allclose(np.vdot(forth, image), np.vdot(scene, back), rtol=1e-12)

    light = weights * scene[:, None]
    pairs = [(light[index], kernels[index]) for index in np.ndindex(2, 3)]
    expected = sum((convolve2d(*pair) for pair in pairs), np.zeros((19, 20)))
    # The kernel's middle is its row 2 and column 3; the window starts at the scene's row 3 and column 2.
    np.testing.assert_allclose(forth, expected[3 + 2 :, 2 + 3 :][:9, :10], atol=1e-12)

    def norm(kernels, weights, scene):
        return (FieldConvolutionOperator(kernels, weights, (9, 10)).mv(scene) ** 2).sum()

    check_grads(jax.jit(norm), (kernels, weights, scene), order=1, modes=["rev"], eps=1e-5, rtol=1e-6)


def test_a_place_beside_a_line_counts_among_those_left_out():
    """Three equal PSFs on a line and another beside it: the three are predicted exactly, the fourth by the nearest."""
    places = np.array([(-2.0, 0.0), (0.0, 0.0), (2.0, 0.0), (0.0, 2.0)])
    y, x = np.indices(SHAPE) - MIDDLE[:, None, None]
    spot = lambda width: np.exp(-(x**2 + y**2) / (2 * width**2)) / width**2
    moved = [np.roll(spot(3.0 if at[1] else 1.5), SCALE * at[::-1].astype(int), (0, 1)) for at in places]
    fit = fit_field(np.array(moved), np.column_stack([places, np.full(4, 12.0)]), SHAPE, max_error=1e-3)
    narrow, wide = spot(1.5), spot(3.0)
    apart = np.linalg.norm(wide - narrow) / np.sqrt(3 * (narrow**2).sum() + (wide**2).sum())
    assert fit.left_out_error == pytest.approx(apart, rel=0.02) and apart > 0.3


def test_a_source_between_the_measured_places_is_predicted():
    fit, image_of = fit_field(*measured(), SHAPE), jax.jit(FieldConvolutionOperator.mv)
    assert fit.error <= 0.05 and 2 <= fit.rank <= 6 and fit.place_error < 1
    for row, column in ((-6, 5), (3, -9), (0, 0)):
        corner = np.array([part.start for part in fit.operator.window])
        scene, truth = np.zeros(fit.operator.scene_shape, np.float32), spots_at(row, column)
        scene[0, *(corner + MIDDLE + (row, column))] = 1.0
        image, truth = (np.asarray(a) / float(np.sum(a)) for a in (image_of(fit.operator, scene), truth))
        middle = np.roll(spots_at(0, 0), (row, column), (0, 1)) / spots_at(0, 0).sum()
        error, of_one = (np.linalg.norm(a - truth) / np.linalg.norm(truth) for a in (image, middle))
        assert error < 0.15, (row, column, error)
        assert error < max(of_one, 0.15)


def test_deconvolution_with_the_field_is_sharper_than_with_one_psf():
    psfs, places = measured()
    points = [(-11, 10), (9, -12), (10, 12), (-2, 3)]
    image = 5 + 1000 * np.sum([spots_at(*point) for point in points], axis=0)
    fit = fit_field(psfs, places, SHAPE)
    solver = FISTA(150, sparsity=1e-4)
    volumes = [deconvolve(image, psf, solver)[0] for psf in (fit.operator, psfs[4][None])]
    share = [sum(v[near].sum() for near in _near(points)) / v.sum() for v in volumes]
    assert share[0] > 0.8 and share[0] > share[1] + 0.05, share


def _near(points):
    for row, column in points:
        yield slice(MIDDLE[0] + row - 1, MIDDLE[0] + row + 2), slice(MIDDLE[1] + column - 1, MIDDLE[1] + column + 2)


WRONG = {
    "count": (GRID[:5], "places must be one for each PSF, 9 in all, got 5."),
    "few": (np.column_stack([GRID, [1, 1, 1] + 6 * [2]]), "places at z = 1 mm must be 4 or more, got 3."),
    "line": (GRID * (1, 0), "places must be not all on one line, got 9 on a line or at the same place."),
    "unknown": (np.column_stack([GRID, 9 * [3]]) * np.where(np.arange(9) == 2, np.nan, 1)[:, None], "known in x and y"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_places_are_named(case):
    places, words = WRONG[case]
    whole = np.full((len(places), 3), np.nan)
    whole[:, : places.shape[1]] = places
    with pytest.raises(InputError) as caught:
        fit_field(measured()[0], whole, SHAPE)
    assert words in str(caught.value)


def test_the_command_takes_places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    psfs, places = measured()
    tifffile.imwrite("psfs.tif", psfs.astype(np.uint16), photometric="minisblack")
    write_capture("c.tif", (100 + 500 * spots_at(-6, 8)).astype(np.float32))
    with open("places.csv", "w", newline="") as file:
        csv.writer(file).writerows([("x_mm", "y_mm", "z_mm"), *places.tolist()])
    arguments = "deconvolve c.tif psfs.tif --psf-places places.csv --method fista --steps 60 -o v.ome.tif".split()
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert "components explain 9 PSFs" in result.stdout and "at 12 mm" in result.stdout
    plane = np.squeeze(tifffile.imread("v.ome.tif"))
    assert np.abs(np.subtract(np.unravel_index(plane.argmax(), SHAPE), MIDDLE + (-6, 8))).max() <= 1


REFUSED = {
    "depths": ("x_mm,y_mm,z_mm", 12, ["--depths", "3"], "whose z_mm are the depths"),
    "tv_z": ("x_mm,y_mm,z_mm", 12, ["--tv-z", "0"], "--tv-z must not be given with --psf-places, got both."),
    "order": ("x_mm,y_mm,capture", 1, [], "lines must be in the order of the PSFs, one for each"),
    "unknown": ("x_mm,y_mm,z_mm", "", ["--voxel-um", "9", "-o", "v.zarr"], "OME-Zarr needs --depths and --voxel-um"),
    "zero": ("x_mm,y_mm,z_mm", 0, ["--voxel-um", "9"], "z_mm must be positive with --voxel-um, got 0 (places.csv)."),
}


@pytest.mark.parametrize("case", REFUSED)
def test_places_that_the_volume_cannot_have_are_refused_before_files_are_read(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    header, last, options, words = REFUSED[case]
    lines = [header.split(","), *([x, y, last] for x, y in GRID)]
    with open("places.csv", "w", newline="") as file:
        csv.writer(file).writerows(lines)
    arguments = ["deconvolve", "none.tif", "none.tif", "--psf-places", "places.csv", "-o", "v.ome.tif", *options]
    wrong = CliRunner().invoke(commands, arguments).exception
    assert isinstance(wrong, InputError) and words in str(wrong)


def test_solvers_that_the_field_does_not_allow_are_refused():
    fit = fit_field(*measured(), SHAPE)
    for solver in (ConvolutionADMM(tv_z=0.0), ConvolutionADMM(nonnegative=False)):
        with pytest.raises(InputError, match="solver must be with tv_z=1 and nonnegative=True"):
            deconvolve(np.ones(SHAPE), fit.operator, solver)


@pytest.mark.integration
def test_the_smoothness_is_chosen_also_with_psfs_over_the_field():
    psfs, places = measured()
    operator = fit_field(psfs, places, SHAPE).operator
    image = spots_at(-7, 5) + spots_at(-6, 5)
    result = run_deconvolution(image, operator, choose=True)
    assert result.smoothness and 1e-6 <= result.smoothness.tv <= 1e-2
    assert result.residual < 0.1
    row, column = np.unravel_index(result.scene[0].argmax(), SHAPE)
    assert abs(row - (MIDDLE[0] - 6.5)) < 1.5 and abs(column - (MIDDLE[1] + 5)) < 1.5
