"""Sheets fitted through the forward model: depth, focus, what is no sheet, and what is refused."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
import trimesh

import gs_jax as gs
from gs_jax.base.progress import Progress
from gs_jax.io.provenance import read_provenance
from gs_jax.io.volumes import read_surface, write_surface
from gs_jax.reconstruction.surface_fit import follow_sheets
from gs_jax.solvers.surface import first_sheets, interpolated
from gs_jax.widget.layers import reader

GRID = {"shape": (45, 45), "pitch": 0.08}
DEPTHS = np.arange(18.0, 22.1, 0.5)


bad: Any = gs.FISTA  # of the wrong type


def scope() -> gs.Imager:
    centers = gs.random_layout(36, (6.0, 6.0), seed=0)
    array = gs.MicrolensArray(centers, 2.0, 1.43, 1.0, 1.0)
    return gs.Imager(array, gs.Sensor((300, 300), 0.02), 5.8, 2.4)


def emitters(depth) -> np.ndarray:
    """A textured square; not on the grid's nodes."""
    side = np.arange(-1.3, 1.3, 0.03)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    light = 1 + np.sin(9 * x + 3 * y) * np.cos(8 * y)
    return np.column_stack([x, y, depth(x, y), light])


def capture(depth, electrons=1000) -> np.ndarray:
    image = np.asarray(gs.simulate(emitters(depth), scope(), optics="near", psf="geometric"))
    return np.random.default_rng(0).poisson(image * electrons / image.max()).astype(np.float32)


@pytest.fixture(scope="module")
def fit():
    return gs.fit_surface(capture(lambda x, y: 20 + 1.2 * x), scope(), gs.Grid(DEPTHS, **GRID), optics="near")


def test_the_depth_of_a_tilted_sheet_is_found(fit):
    grid = gs.Grid(DEPTHS, **GRID)
    inner = np.abs(np.asarray(grid.x)) < 1.1
    error = (fit.depth[0] - (20 + 1.2 * np.asarray(grid.x))[None])[np.ix_(inner, inner)]
    # A third of the planes' distance is 0.17 mm.
    assert np.nanstd(error) < 0.08 and abs(np.nanmean(error)) < 0.05 and np.isfinite(error).mean() > 0.7
    assert fit.error < fit.free_error and fit.warning is None
    assert np.isnan(fit.depth[0, 0, 0]) and (fit.depth_sd[np.isfinite(fit.depth)] > 0).all()


@pytest.mark.integration
def test_frames_start_from_the_one_before_unless_the_scene_is_another():
    """A sheet that moves away is followed; another one is not."""
    grid = gs.Grid(DEPTHS, **GRID)
    reconstructor, last = gs.Reconstructor(scope(), grid, gs.Surface(), "near"), None
    inner = np.abs(np.asarray(grid.x)) < 1.1
    started = []
    for slope, middle in ((1.2, 20.0), (1.2, 20.1), (1.2, 20.2), (-1.2, 19.5)):
        image = capture(lambda x, y, slope=slope, middle=middle: middle + slope * x)
        found, last = follow_sheets(reconstructor, image, last, Progress())
        error = (found.depth[0] - (middle + slope * np.asarray(grid.x))[None])[np.ix_(inner, inner)]
        assert np.nanstd(error) < 0.08 and abs(np.nanmean(error)) < 0.05 and found.warning is None
        started.append(bool(np.isfinite(found.further_error)))
        assert np.isnan(found.depth_sd).all() != started[-1]
    assert started == [True, False, False, True]


@pytest.mark.integration
def test_two_sheets_are_two_and_one_is_warned_of():
    scene = np.concatenate([emitters(lambda x, y: 18.8 + 0.2 * x), emitters(lambda x, y: 21.2 + 0.2 * y)])
    image = np.asarray(gs.simulate(scene, scope(), optics="near", psf="geometric"))
    image = np.random.default_rng(0).poisson(image * 3000 / image.max()).astype(np.float32)
    grid = gs.Grid(DEPTHS, **GRID)
    assert "try 2 sheets" in (gs.fit_surface(image, scope(), grid, optics="near").warning or "")
    two = gs.fit_surface(image, scope(), grid, gs.Surface(sheets=2), optics="near")
    x, y = (np.asarray(part) for part in (grid.x, grid.y))
    inner = np.ix_(np.abs(y) < 1.1, np.abs(x) < 1.1)
    for depth, true in zip(two.depth, (18.8 + 0.2 * x[None], 21.2 + 0.2 * y[:, None]), strict=True):
        error = (depth - true)[inner]
        assert np.nanstd(error) < 0.1 and abs(np.nanmean(error)) < 0.1 and np.isfinite(error).mean() > 0.8
    assert two.warning is None


def test_the_volume_is_the_sheet_on_the_planes(fit):
    lit = np.isfinite(fit.depth[0])
    mean = (fit.volume * DEPTHS[:, None, None]).sum(0)[lit] / fit.volume.sum(0)[lit]
    np.testing.assert_allclose(mean, fit.depth[0][lit], atol=1e-3)
    np.testing.assert_allclose(fit.volume.sum(0), fit.brightness[0], rtol=1e-3, atol=1e-6 * fit.brightness.max())


def test_files_hold_maps_in_um_and_a_mesh_in_mm(fit, tmp_path):
    grid, maps = gs.Grid(DEPTHS, **GRID), (fit.brightness, fit.depth, fit.depth_sd)
    write_surface(tmp_path / "maps.ome.tif", *maps, grid, below=17.5, provenance={"design": "made up"})
    with tifffile.TiffFile(tmp_path / "maps.ome.tif") as tiff:
        pixels = tiff.asarray()
        assert 'PhysicalSizeX="80.0"' in (tiff.ome_metadata or "") and 'Name="depth_um"' in (tiff.ome_metadata or "")
    np.testing.assert_allclose(pixels[1], 1000 * (fit.depth[0] - 17.5), rtol=1e-5)
    write_surface(tmp_path / "maps.ome.tif", *maps, grid)
    read = read_surface(tmp_path / "maps.ome.tif")
    for found, given in zip(read[:3], maps, strict=True):
        np.testing.assert_allclose(found, given, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(read.grid.x), np.asarray(grid.x), atol=1e-6)
    read_layers: Any = reader(str(tmp_path / "maps.ome.tif"))
    (depth, shown, kind), ((vertices, faces, light), _, other) = read_layers(str(tmp_path / "maps.ome.tif"))
    assert (kind, other) == ("image", "surface") and 0 <= light.min() < light.max() <= 1
    np.testing.assert_allclose(depth, 1000 * fit.depth[0], rtol=1e-5)
    np.testing.assert_allclose((vertices[:, 0] / 1000).min(), np.nanmin(fit.depth), atol=0.1)
    np.testing.assert_allclose([shown["translate"][1], vertices[0, 2] % 80], [-1760, 0], atol=1e-3)
    assert len(faces) > 500
    write_surface(tmp_path / "sheet.ply", *maps, grid, provenance={"design": "made up"})
    assert read_provenance(tmp_path / "sheet.ply")["design"] == "made up"
    mesh: Any = trimesh.load(tmp_path / "sheet.ply", process=False)
    slope = np.polyfit(mesh.vertices[:, 0], mesh.vertices[:, 2], 1)
    assert len(mesh.faces) > 500 and abs(slope[0] - 1.2) < 0.1


def test_files_without_sheets_are_refused(fit, tmp_path):
    gs.write_volume(tmp_path / "v.ome.tif", fit.volume, gs.Grid(DEPTHS, **GRID))
    with pytest.raises(gs.InputError, match="channels must be brightness, depth_um, sd_um"):
        read_surface(tmp_path / "v.ome.tif")
    tifffile.imwrite(tmp_path / "grey.tif", np.zeros((9, 9), np.uint16))
    with pytest.raises(gs.InputError, match="channels must be .*, got none \\(.*grey.tif"):
        read_surface(tmp_path / "grey.tif")


def test_the_sheet_of_a_dark_capture_is_dark():
    grid = gs.Grid(DEPTHS, **GRID)
    dark = gs.reconstruct(np.zeros((300, 300), np.float32), scope(), grid, gs.Surface(), optics="near")
    assert not dark.any()


@pytest.mark.integration
def test_the_sheet_of_a_single_plane_is_finite():
    image = np.asarray(gs.simulate(emitters(lambda x, y: 20 + 0 * x), scope(), optics="near", psf="geometric"))
    plane = gs.reconstruct(image, scope(), gs.Grid([20.0], **GRID), gs.Surface(), optics="near")
    assert plane.shape == (1, 45, 45) and np.isfinite(plane).all() and plane[0, 22, 22] > 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: gs.Surface(sheets=0), "sheets must be 1 or more, got 0"),
        (lambda: gs.Surface(smooth_depth=-1.0), "smooth_depth must be 0 or more, got -1"),
        (lambda: gs.Surface(steps=10_000), "steps must be 1 to 36, got 10000"),
        (lambda: gs.reconstruct(np.zeros((300, 300)), scope(), gs.Grid([20, 18], **GRID), gs.Surface()), "must ascend"),
        (lambda: gs.fit_surface(np.zeros((3, 3)), scope(), gs.Grid(DEPTHS, **GRID)), "must have the sensor's shape"),
        (lambda: gs.fit_surface(np.zeros((3, 3)), scope(), gs.Grid(DEPTHS, **GRID), bad()), "must be a Surface"),
    ],
)
def test_what_is_refused(make, words):
    with pytest.raises(gs.InputError, match=words):
        make()


def test_two_sheets_side_by_side_start_as_one_each():
    """Each has the light of its side, and hardly any of the other's."""
    volume = np.zeros((11, 20, 30), np.float32)
    for plane, side in ((2, slice(0, 15)), (8, slice(15, 30))):
        volume[plane - 1 : plane + 2, :, side] = np.array([0.5, 1.0, 0.5])[:, None, None]

    @jax.jit
    def start(volume):
        sheets = first_sheets(volume, jnp.zeros((8, 8), jnp.float32), 2)
        return interpolated(sheets.depth, (20, 30)), sheets.root**2

    depth, light = map(np.asarray, start(volume))
    np.testing.assert_allclose(depth[0, :, :10], 2, atol=0.1)
    np.testing.assert_allclose(depth[1, :, 20:], 8, atol=0.1)
    assert light[0, :, 20:].sum() < 0.01 * light[1, :, 20:].sum() and light[1, :, :10].sum() < 0.01 * light[0].sum()
