"""Volumes in tiles: as the whole where they meet, resumed as if nothing had happened, and by workers."""

import json
from typing import Any

import numpy as np
import pytest
import tifffile
import zarr
from scipy.ndimage import convolve

import gs_jax as gs
from gs_jax import Grid
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.base.workers import Workers
from gs_jax.io import ngff
from gs_jax.io.files import TILES
from gs_jax.io.ngff import JOURNAL, VolumeSeries, tile_unit
from gs_jax.io.volumes import read_volume
from gs_jax.reconstruction import deconvolution_tiles, tiles as tiles_module
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.plan import Plan
from gs_jax.reconstruction.tiles import Tiles, make_tiles, reconstruct_tiles

from .test_matrix import as_users_do, case_of

TILED = ("reconstruct", "bars.tif", "design.toml", "--depths", "18:22:2", "--voxel-um", "50", "--tiles", "16")
LUCY = ("--method", "list-rl", "--steps", "4", "--optics", "near")


@pytest.mark.parametrize("shape, side, margin", [((43, 43), 24, 4), ((85, 40), 16, 0), ((30, 31), 64, 4)])
def test_tiles_cover_the_grid_once(shape, side, margin):
    tiles = Tiles(Grid([20.0], shape, 0.1, (0.3, -0.2)), side, margin)
    count = np.zeros(shape, int)
    rows, columns = np.asarray(tiles.grid.y), np.asarray(tiles.grid.x)
    for number in range(tiles.count):
        window, part = tiles.window(number), tiles.window_grid(number)
        count[tiles.core(number)] += 1
        np.testing.assert_array_equal(count[window][tiles.inner(number)], count[tiles.core(number)])
        # The voxels of all windows are those of the grid, within it, and of one shape.
        np.testing.assert_allclose(part.y, rows[window[0]], atol=1e-6)
        np.testing.assert_allclose(part.x, columns[window[1]], atol=1e-6)
    assert (count == 1).all()
    assert np.prod(tiles.wider.shape) <= np.prod(np.array(tiles.shape) + 1)


@pytest.mark.parametrize(
    "name", ["backproject", *(pytest.param(n, marks=pytest.mark.integration) for n in ("list-rl", "fista", "admm"))]
)
def test_no_seam(tmp_path, name):
    """As many dB to a ray-traced truth as the whole, less a tenth at most; back-projection is the same."""
    with as_users_do("geomscope"):
        case = case_of("geomscope", "near")
        bars = case.grid.to_mm(np.argwhere(case.truth))
        image = case.capture(np.column_stack([bars, np.ones(len(bars))]))
        plan = Plan(case.imager, case.grid, METHODS[name](20), case.optics, False, "none", False, None)
        whole = plan.prepare(Progress())(image, Progress()).volume
        tiles = make_tiles(plan, 24)
        assert tiles.count == 4
        series = VolumeSeries(tmp_path / "v.zarr", tiles.count, case.grid, tile=tiles.side)
        reconstruct_tiles(plan, tiles, image, series, Workers(), Progress())
        found, grid = read_volume(tmp_path / "v.zarr")
        assert grid.volume_shape == case.grid.volume_shape
        if name == "backproject":
            np.testing.assert_allclose(found, whole, atol=1e-5 * whole.max())
        assert gs.quality(found, case.truth).psnr_db > gs.quality(whole, case.truth).psnr_db - 0.1


def bars(folder):
    image = np.random.default_rng(0).poisson(100.0, (96, 80)).astype(np.uint16)
    image[30:60, 20:24] += 400
    tifffile.imwrite(folder / "bars.tif", image)


@pytest.mark.integration
def test_interrupted_and_resumed(folder, run, monkeypatch):
    bars(folder)
    status, out, err = run(*TILED, *LUCY, "-o", "whole.zarr")
    assert (status, err) == (0, "") and "3 x 39 x 33 voxels" in out and "9 tiles of 16 x 16 voxels" in out
    assert not (folder / "whole.zarr" / TILES).exists()
    started, calls = tiles_module._started, []

    def interrupted(*arguments):
        calls.append(1)
        # In the first run, and then in the second.
        if len(calls) in (4, 15):
            raise KeyboardInterrupt
        return started(*arguments)

    monkeypatch.setattr(tiles_module, "_started", interrupted)
    for _ in range(2):
        status, _, err = run(*TILED, *LUCY, "-o", "v.zarr", "--resume")
        assert status == 130 and "--resume" in err
    lines = (folder / "v.zarr" / JOURNAL).read_text().splitlines()
    assert json.loads(lines[0])["frames"] == 9 and 1 <= len(lines) - 1 < 9
    status, _, err = run(*TILED, *LUCY, "-o", "v.zarr")
    assert status == 2 and "of 9 tiles of an interrupted run; give --resume" in err
    status, _, err = run(*TILED[:-1], "32", *LUCY, "-o", "v.zarr", "--resume")
    assert status == 2 and "tiles with --resume must be '16', as before, got '32'" in err
    assert run(*TILED, *LUCY, "-o", "v.zarr", "--resume")[0] == 0
    np.testing.assert_array_equal(read_volume("v.zarr")[0], read_volume("whole.zarr")[0])
    # What is there is not made again.
    calls.clear()
    assert run(*TILED, *LUCY, "-o", "v.zarr", "--resume")[0] == 0 and not calls


@pytest.mark.integration
def test_workers_make_the_same(folder, run):
    pytest.importorskip("distributed")
    bars(folder)
    for name, options in (("here.zarr", ()), ("there.zarr", ("--workers", "2"))):
        assert run(*TILED, *LUCY, "-o", name, *options)[0] == 0
    here, there = (read_volume(name)[0] for name in ("here.zarr", "there.zarr"))
    np.testing.assert_allclose(there, here, rtol=1e-3, atol=1e-4 * here.max())


def test_a_pyramid_of_tiles(folder, run, monkeypatch):
    """Each tile is a file of each level; levels are means, to the odd ends."""
    monkeypatch.setattr(ngff, "CHUNK", 16)
    bars(folder)
    assert run(*TILED, "-o", "v.zarr")[0] == 0
    group: Any = zarr.open_group("v.zarr", mode="r")
    levels = [group[name] for name in "012"]
    assert [level.shape for level in levels] == [(3, 39, 33), (3, 20, 17), (3, 10, 9)]
    assert [level.shards for level in levels] == [(3, 16, 16), (3, 8, 8), (3, 4, 4)]
    volume = read_volume("v.zarr")[0]
    np.testing.assert_allclose(levels[1][...], ngff.halve(volume), rtol=1e-6)
    run(*TILED[:-2], "-o", "whole.zarr")
    np.testing.assert_allclose(volume, read_volume("whole.zarr")[0], rtol=1e-5)


@pytest.mark.parametrize("method", ["admm", pytest.param("fista", marks=pytest.mark.integration)])
def test_deconvolution(folder, run, monkeypatch, method):
    """Points beside the tile cast light into it, and are left out."""
    rng, psf = np.random.default_rng(0), np.zeros((9, 9))
    psf[[1, 4, 7], [2, 7, 4]] = 1.0
    scene = np.zeros((40, 44))
    scene[rng.integers(0, 40, 30), rng.integers(0, 44, 30)] = 1.0
    tifffile.imwrite("c.tif", (3e3 * convolve(scene, psf, mode="constant")).astype(np.uint16))
    tifffile.imwrite("p.tif", (1e4 * psf).astype(np.uint16))
    how = ("deconvolve", "c.tif", "p.tif", "--depths", "20", "--voxel-um", "10", "--method", method)
    how += (*(("--tv", "1e-4") if method == "admm" else ()), "--steps", "60")
    assert run(*how, "-o", "whole.zarr")[0] == 0
    status, out, _ = run(*how, "--tiles", "16", "-o", "v.zarr")
    assert status == 0 and "9 tiles of 16 x 16 pixels" in out
    whole, found = (read_volume(name)[0] for name in ("whole.zarr", "v.zarr"))
    assert gs.quality(found, whole).psnr_db > 30
    monkeypatch.setattr(deconvolution_tiles, "run_solver", None)  # nothing is left to solve
    assert run(*how, "--tiles", "16", "-o", "v.zarr", "--resume")[0] == 0


@pytest.mark.parametrize(
    "options, words",
    [
        (("-o", "v.ome.tif"), "--tiles must be used with one capture and -o VOLUME.zarr, got v.ome.tif"),
        (("-o", "v.zarr", "--method", "unrolled"), "--tiles must be used with backproject, .*got Unrolled"),
        (("-o", "v.zarr", "--method", "surface"), "--tiles must be used with backproject, .*got Surface"),
        (("-o", "v.zarr", "--method", "fista", "--stop-at-noise"), "--stop-at-noise must not be given with --tiles"),
    ],
)
def test_refused(folder, run, options, words):
    bars(folder)
    status, _, err = run(*TILED, *options)
    assert status == 2
    with pytest.raises(InputError, match=words):
        raise InputError(err)


def test_the_largest_tiles_that_fit(monkeypatch):
    with as_users_do("geomscope"):
        case = case_of("geomscope", "near")
        grid = Grid(case.grid.depths, (16384, 16384), case.grid.pitch / 400)
        assert tile_unit(grid.shape) == 16
        plan = Plan(case.imager, grid, METHODS["list-rl"](20), "near", False, "none", False, None)
        monkeypatch.setattr(tiles_module, "available_memory", lambda: 4e9)
        sides = [make_tiles(plan, None, jobs).side for jobs in (1, 2, 4)]
    assert sides[0] == 4096 and sides == sorted(sides, reverse=True)
