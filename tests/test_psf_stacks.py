"""Volumes from measured stacks of PSFs: kinds of files over methods, a real capture, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
import zarr
from click.testing import CliRunner
from scipy.signal import fftconvolve

from gs_jax import ConvolutionADMM, ConvolutionOperator, InputError, read_volume, solve, write_capture
from gs_jax.__main__ import commands
from gs_jax.io.provenance import read_provenance
from gs_jax.reconstruction.deconvolution import SOLVERS, deconvolve

from .helpers import needs

SHAPE, PLANES = (40, 48), 3


def spots() -> np.ndarray:
    """Four spots a plane, which move apart with depth, on an offset."""
    stack = np.full((PLANES, 25, 27), 7, np.uint16)
    for plane, reach in enumerate((6, 8, 11)):
        for row, column in ((-1, -1), (-1, 0.4), (0.7, 1), (1, -0.5)):
            stack[plane, 12 + round(row * reach), 13 + round(column * reach)] = 1007
    return stack


def capture() -> np.ndarray:
    """A bar in the middle plane alone."""
    scene = np.zeros(SHAPE)
    scene[18:22, 20:30] = 1
    return (100 + 500 * fftconvolve(scene, spots()[1] - 7.0, mode="same") / 1000).round().astype(np.uint16)


def save(folder, kind: str) -> list[str]:
    """The stack in a kind of files; returns the arguments."""
    stack = spots()
    if kind == "pages":
        tifffile.imwrite(folder / "psf.tif", stack, photometric="minisblack")
        return ["psf.tif"]
    if kind == "npy":
        np.save(folder / "psf.npy", stack)
        return ["psf.npy"]
    if kind == "zarr":
        array = zarr.create_array(store=folder / "psf.zarr", shape=stack.shape, dtype=stack.dtype)
        array[...] = stack
        return ["psf.zarr"]
    (folder / "psf").mkdir()
    names = [f"psf/z{plane + 8}.png" for plane in range(PLANES)]  # z10 is after z9
    for name, plane in zip(names, stack, strict=True):
        write_capture(folder / name, plane)
    return {"folder": ["psf"], "pattern": ["psf/*.png"], "files": names}[kind]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_capture("c.tif", capture())
    return tmp_path


def deconvolved(*arguments: str, output: str = "v.ome.tif"):
    return CliRunner().invoke(commands, ["deconvolve", "c.tif", *arguments, "-o", output], catch_exceptions=True)


KINDS = ("npy", "zarr", "folder", "pattern", "files")


@pytest.mark.parametrize(
    ("kind", "method"), [*(("pages", method) for method in SOLVERS), *((kind, "fista") for kind in KINDS)]
)
def test_each_method_and_each_kind_of_stack(folder, kind, method):
    result = deconvolved(*save(folder, kind), "--method", method, "--steps", "30", "--depths", "10:12:1")
    assert not result.exception, result.exception
    assert "3 depths from 10 to 12 mm, 40 x 48 pixels" in result.stdout
    volume = tifffile.imread("v.ome.tif")
    assert volume.shape == (PLANES, *SHAPE)
    light = volume.sum((1, 2))
    assert light.argmax() == 1 and light[1] > 0.6 * light.sum()
    assert volume[1, 18:22, 20:30].sum() > 0.5 * light[1]


def test_the_volume_has_the_lengths_that_are_known(folder):
    psf = [*save(folder, "pages"), "--method", "fista", "--steps", "30"]
    assert not deconvolved(*psf, output="plain.npy").exception
    assert np.load("plain.npy").shape == (PLANES, *SHAPE)
    for output in ("v.ome.tif", "v.zarr"):
        assert not deconvolved(*psf, "--depths", "10:12:1", "--voxel-um", "25", output=output).exception
        _, grid = read_volume(output)
        assert grid.shape == SHAPE and grid.pitch == 0.025 and list(grid.depths) == [10, 11, 12]
        assert "input psf.tif" in read_provenance(output)
    assert not deconvolved(*psf, "--psf-page", "mean", "--binning", "2", output="plane.tif").exception
    assert tifffile.imread("plane.tif").shape == (20, 24)


def test_planes_may_be_uneven_and_psfs_of_unlike_size(folder):
    first, second, third = spots()
    psfs = [np.pad(first, ((4, 4), (0, 0)), constant_values=7), second[2:-2, 1:-1], third]
    names = [f"p{number}.tif" for number in range(PLANES)]
    for name, psf in zip(names, psfs, strict=True):
        write_capture(name, psf)
    unlike = ("--method", "fista", "--steps", "30", "--depths", "10,12.5,40")
    result = deconvolved(*names, *unlike)
    assert not result.exception and "3 depths from 10 to 40 mm, 40 x 48 pixels" in result.stdout
    assert not deconvolved(*save(folder, "pages"), *unlike, output="same.ome.tif").exception
    # The scene is larger, and its FFTs round otherwise.
    volume, same = tifffile.imread("v.ome.tif"), tifffile.imread("same.ome.tif")
    np.testing.assert_allclose(volume, same, atol=0.02 * same.max())


@pytest.mark.parametrize("grey", [True, False])
def test_a_channel_of_a_capture_goes_with_a_grey_psf(folder, grey):
    colours = np.stack([capture(), capture() // 2, capture() // 4], -1)
    tifffile.imwrite("c.tif", colours, photometric="rgb")
    psf = spots()[1]
    tifffile.imwrite("psf.tif", psf if grey else np.stack([psf // 9, psf, psf // 9], -1), photometric=None)
    result = deconvolved("psf.tif", "--channel", "green", "--method", "fista", "--steps", "2", output="v.tif")
    assert not result.exception, result.exception
    assert f"{'c.tif' if grey else '2 captures'}: green of a colour image" in result.stdout
    green = tifffile.imread("v.tif")
    write_capture("c.tif", capture() // 2)
    write_capture("psf.tif", psf)
    assert not deconvolved("psf.tif", "--method", "fista", "--steps", "2", output="v.tif").exception
    np.testing.assert_array_equal(green, tifffile.imread("v.tif"))


def test_a_psf_that_is_cut_by_its_edge_gets_a_warning(folder):
    write_capture("psf.tif", spots()[1])
    fista = ("psf.tif", "--method", "fista", "--steps", "2")
    assert "is cut" not in deconvolved(*fista).stderr
    write_capture("psf.tif", spots()[1][4:, :22])
    result = deconvolved(*fista)
    assert not result.exception and "gs-jax: warning: the PSF is cut at the top and right" in result.stderr


WRONG = {
    "depths": (("psf.tif", "--depths", "10:13:1"), "--depths must be one for each PSF, 3 in all, got 4 depths."),
    "zarr": (("psf.tif", "--depths", "10:12:1"), "OME-Zarr needs --depths and --voxel-um, got not both"),
    "large": (("large.tif",), "psf must be at most the image's 40 x 48 pixels, got 50 x 20."),
    "uneven": (
        ("psf.tif", "--depths", "10,11,40", "--voxel-um", "9"),
        "depths must be in even steps for OME-Zarr, got uneven ones; use .ome.tif (v.zarr).",
    ),
    "jpeg": (("psf.jpg",), "got '.jpg'; JPEG is lossy, and its values are not linear in light: save captures as TIFF"),
    "mat": (("psf.mat",), "got '.mat'; convert it: numpy.save('a.npy', scipy.io.loadmat('a.mat')['NAME']"),
    "wiener": (("psf.tif", "--method", "wiener"), "wiener must be used with one PSF, for one plane, got 3; admm takes"),
    "dark": (("dark.npy",), "got no light above the darkest percent in plane 2."),
    "weight": (("psf.tif", "--method", "fista", "--tv-z", "2"), "--tv-z must be used with admm, got --method fista."),
    "page": (("psf.tif", "--psf-page", "4"), "must be 1 to 3, or mean, got --page 4 of 3 pages"),
    "refined, wiener": (
        ("psf.tif", "--method", "wiener", "--refine-psf"),
        "--refine-psf must not be given with",
    ),
    "refined, places": (("psf.tif", "--psf-places", "p.csv", "--refine-psf"), "must be used without --psf-places, got"),
    "refined, tiles": (
        ("psf.tif", "--tiles", "auto", "--refine-psf"),
        "must be used without --tiles, got",
    ),
    "nothing": (("none.tif",), "none.tif: cannot be read: No such file or directory."),
}


@pytest.mark.parametrize("psf", ["psf", "psf/*.npy"])
def test_no_file_of_a_stack_is_replaced(folder, psf):
    (folder / "psf").mkdir()
    np.save("psf/z9.npy", spots()[1])
    before = (folder / "psf/z9.npy").read_bytes()
    result = deconvolved(psf, "--steps", "2", output="psf/z9.npy")
    assert isinstance(result.exception, InputError) and "the output must be another file" in str(result.exception)
    assert (folder / "psf/z9.npy").read_bytes() == before


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_refused_in_one_line(folder, case):
    save(folder, "pages")
    write_capture("large.tif", np.eye(50, 20, dtype=np.float32))
    for name in ("psf.jpg", "psf.mat"):
        (folder / name).write_bytes(b"?")
    np.save("dark.npy", np.stack([spots()[0], spots()[0] * 0]))
    arguments, words = WRONG[case]
    before = sorted(path.name for path in folder.iterdir())
    result = deconvolved(*arguments, output="v.zarr" if case in ("zarr", "uneven", "refined, tiles") else "v.ome.tif")
    assert isinstance(result.exception, InputError) and words in str(result.exception)
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_volume_that_does_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setattr("gs_jax.reconstruction.deconvolution.available_memory", lambda: 10**5)
    with pytest.raises(InputError, match=r"free memory, got 3 x 64 x 75 voxels, .* --binning 2 takes a quarter"):
        deconvolve(capture(), spots())


@pytest.mark.integration
def test_the_operator_is_batched():
    A = ConvolutionOperator(jnp.asarray(spots(), float), SHAPE)
    scenes = jnp.asarray(np.random.default_rng(0).random((2, *A.scene_shape)))
    images = jax.jit(jax.vmap(A.mv))(scenes)
    np.testing.assert_allclose(images[1], A.mv(scenes[1]), rtol=1e-12)
    back = jax.jit(jax.vmap(A.T.mv))(images)
    np.testing.assert_allclose(jnp.vdot(images, images), jnp.vdot(back, scenes), rtol=1e-12)


def test_a_real_capture_is_explained():
    """A part of the stack, binned: costs never rise, and fall to a twentieth."""
    stack = tifffile.imread(needs("diffusercam3d/psf_stack.tif"))[4:44:8].astype(np.float32)
    image = tifffile.imread(needs("diffusercam3d/capture.tif")).astype(np.float32)
    coarse = lambda a: a[..., :270, :320].reshape(*a.shape[:-2], 45, 6, 64, 5).mean((-3, -1))
    A = ConvolutionOperator(coarse(stack) / 1e4)
    light = jnp.asarray(coarse(image) - image.min())
    run = lambda image: solve(A, image, ConvolutionADMM(steps=60, tv=1e-4, sparsity=0.0, tv_z=0.0))
    solution = run(light / light.max())
    assert np.all(np.diff(solution.stats["costs"]) <= 0)
    assert solution.stats["costs"][-1] < 0.05 * solution.stats["costs"][0]
