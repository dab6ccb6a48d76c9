"""The matrix of features: what users do, over what users may combine. Each pair is right, or refused in one line.

A kind of lens, layer, method or format that is added to the package is added to `DEVICES` or `TASKS`.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gs_jax as gs
from experiments.common import design_file
from experiments.design_judge import diffracted
from experiments.ray_tracer import can_trace, traced
from gs_jax import Design, Grid, InputError
from gs_jax.apps.report import write_report
from gs_jax.apps.tolerances import tolerance
from gs_jax.base.errors import InputWarning
from gs_jax.base.progress import Progress
from gs_jax.base.workers import Workers
from gs_jax.calibration.fit import PATTERN_FITTED
from gs_jax.codesign.bound import volume_bound
from gs_jax.codesign.study import Study
from gs_jax.design.datasheets import datasheet
from gs_jax.design.tables import LENS_KEYS
from gs_jax.io.ngff import VolumeSeries
from gs_jax.microscope.layouts import nearest_neighbour_distances
from gs_jax.mold.export import float32_mesh
from gs_jax.mold.heights import write_heights
from gs_jax.mold.holder import HolderShape, make_rig
from gs_jax.mold.manufacturability import check_solid
from gs_jax.optics.raytrace import to_numpy
from gs_jax.reconstruction.demixing import demix, image_regions, prepare_demixing
from gs_jax.reconstruction.pipeline import METHODS, PIXELS_PER_VOXEL, voxel_grid
from gs_jax.reconstruction.plan import Plan, follow_volume
from gs_jax.reconstruction.radius_fit import fit_radius
from gs_jax.reconstruction.residual import CrossValidation
from gs_jax.reconstruction.tiles import make_tiles, reconstruct_tiles

from .helpers import shares_within
from .test_calibration import discs

SHIPPED = sorted(path.stem for path in (Path(__file__).parents[1] / "design").glob("*.toml"))
LENSES, PIXELS = 24, 600
# Of all devices alike, in field radii: what is compiled for one serves the others.
PIXEL_PITCH, PLATE = 13e-3 / 3, 9.2 / 3
# Rays from a point to each lens.
RAYS = 20_000


def cropped(name: str, *, lenses: int = LENSES, shape=(PIXELS, PIXELS), **tables) -> Design:
    """The lenses of a design nearest to the axis, at most these, and as much of its sensor as they cover."""
    design = gs.read_design(design_file(name))
    centers = np.array(design.array.centers_mm)
    data, field = design.model_dump(), design.imaging.field_radius_mm
    away = np.abs(centers).max(1)
    nearest = np.argsort(away, kind="stable")[: np.sum(away < PLATE * field / 2)][:lenses]
    data["sensor"] = {"shape": shape, "pixel_pitch_um": round(1000 * PIXEL_PITCH * field, 4)}
    data["array"] |= {"centers_mm": centers[nearest].tolist(), "size_mm": (round(PLATE * field, 6),) * 2}
    own = {key: data["lens"][key] for key in LENS_KEYS if isinstance(data["lens"][key], tuple)}
    data["lens"] |= {key: [values[lens] for lens in nearest] for key, values in own.items()}
    for table, values in tables.items():
        data[table] |= values
    return Design.model_validate(data)


def with_two_radii() -> Design:
    """Every second lens has a slightly longer focus, after the idea of multifocal arrays."""
    return cropped("geomscope", lens={"radius_of_curvature_mm": [2.0, 2.06] * (LENSES // 2)})


def turned_round() -> Design:
    """The curved side in front, in focus where the plano side was, with apertures for which spots are small again."""
    lens = {"aperture_diameter_mm": 1.2, "orientation": "curved"}
    return cropped("geomscope", lens=lens, imaging={"sensor_distance_mm": 5.3})


def combined() -> Design:
    """The curved side in front, two lens types, and a tilt at once."""
    lens = {"aperture_diameter_mm": 1.2, "orientation": "curved", "radius_of_curvature_mm": [2.0, 2.04] * (LENSES // 2)}
    tilt = {"tilt_deg": (0.6, -0.4)}
    return cropped("geomscope", lens=lens, imaging={"sensor_distance_mm": 5.3}, calibration=tilt)


def stack(surface: float, gap: float = 0.0) -> dict[str, Any]:
    """A filter, a gap and a window on the sensor, a gel behind a cover slip, and an emission band."""
    glass, slip = {"thickness_mm": 2.0, "refractive_index": "BK7"}, {"thickness_mm": 0.17, "refractive_index": 1.523}
    window = {"thickness_mm": 0.55, "refractive_index": 1.51}
    return {
        "layers": {
            "object": [{"thickness_mm": gap}, glass] if gap else [glass],
            "sensor": [{"thickness_mm": 0.6}, window],
        },
        "sample": {"refractive_index": 1.43, "surface_mm": surface, "layers": [slip]},
        "bandwidth_nm": 40.0,
    }


def layered() -> Design:
    """A filter, a window and a gel, in focus where the paper's device is."""
    return cropped("geomscope", imaging={"sensor_distance_mm": 6.12, "working_distance_mm": (18.0, 23.0)}).replace(
        **stack(17.5)
    )


def tilted_layered() -> Design:
    """The same, tilted, for light of one wavelength: the independent ray tracer takes it."""
    tables: dict[str, Any] = stack(17.5) | {"bandwidth_nm": 0.0}
    tables["layers"]["object"][0]["refractive_index"] = 1.52
    return layered().replace(**tables, tilt_deg=(1.0, -0.6))


def layered_combined() -> Design:
    """The same over a curved side, with two lens types and a tilt."""
    return combined().replace(sensor_distance_mm=5.64, working_distance_mm=(18.0, 23.0), **stack(17.5, gap=0.3))


def small_lenses() -> Design:
    """Lenses of 0.1 mm, 4 um high, in a device that is a twentieth as large."""
    design, scale = cropped("geomscope"), 0.05
    times = lambda values: tuple(tuple(round(scale * x, 4) for x in value) for value in values)
    return design.replace(
        radius_of_curvature_mm=scale * 2.0,
        aperture_diameter_mm=scale * 2.0,
        centers_mm=times(design.array.centers_mm),
        size_mm=times([design.array.size_mm])[0],
        substrate_thickness_mm=scale * 1.0,
        sensor_distance_mm=scale * 5.8,
        working_distance_mm=(0.9, 1.5),
        field_radius_mm=scale * 3.0,
        pixel_pitch_um=round(scale * design.sensor.pixel_pitch_um, 4),
    )


def with_samples() -> Design:
    """Samples by name, of which one is the default."""
    water = {"refractive_index": "water", "surface_mm": 17.5}
    return layered().replace(samples={"water": water, "gel": stack(17.5)["sample"]})


def mirrored() -> Design:
    design = cropped("geomscope")
    centers = [(-x, y) for x, y in design.array.centers_mm]
    return design.model_copy(update={"array": design.array.model_copy(update={"centers_mm": tuple(centers)})})


DEVICES: dict[str, Callable[[], Design]] = {
    **{name: partial(cropped, name, lenses=18 if "endoscope" in name else LENSES) for name in SHIPPED},
    "out of focus": lambda: cropped("geomscope-table1"),
    "steep": lambda: cropped("geomscope-targets"),
    "curved side": turned_round,
    "conic": lambda: cropped("geomscope", lens={"conic_constant": -0.6}),
    "aspheric": lambda: cropped("geomscope", lens={"conic_constant": -0.5, "aspheric_terms": [-1e-3, 2e-4]}),
    "two radii": with_two_radii,
    "curved, tilted, two radii": combined,
    "layers": layered,
    "curved, tilted, two radii, layers": layered_combined,
    "samples": with_samples,
    "small lenses": small_lenses,
    "tilted": lambda: cropped("geomscope", calibration={"tilt_deg": (1.0, -0.6)}),
    "turned": lambda: cropped("geomscope", calibration={"rotation_deg": 31.0, "shift_mm": (0.1, -0.2)}),
    "mirrored": mirrored,
    "region": lambda: cropped("geomscope", shape=(480, 520), sensor={"origin_mm": (0.27, -0.18)}),
    "binned": lambda: cropped("geomscope", shape=(300, 300), sensor={"pixel_pitch_um": 26.0}),
    "odd": lambda: cropped("geomscope", shape=(601, 577)),
    "one lens": lambda: cropped("geomscope", lenses=1, array={"size_mm": (2.0, 2.0)}),
    "float64": lambda: cropped("geomscope"),
    "tilted, layers": tilted_layered,
}
# Numbers of pixels without a common divisor, as many as a camera has: binned or not, all methods must cope.
LARGE = "3001 x 4093"
DEVICES[LARGE] = lambda: cropped("geomscope", shape=(3001, 4093), sensor={"pixel_pitch_um": 4.5})
# Pixels much finer than the core of a spot.
FINE = "2.6 um pixels"
DEVICES[FINE] = lambda: cropped("geomscope", shape=(3001, 4093), sensor={"pixel_pitch_um": 2.6})


class Case:
    """A device, and what is imaged with it, with all of the light or only near PSFs. What tasks share is made once."""

    def __init__(self, name: str, optics: str):
        self.name, self.optics, self.design = name, optics, DEVICES[name]()
        self.imager = self.design.imager()
        near, far = self.design.imaging.working_distance_mm
        middle = 20.0 if far > 10 else (near + far) / 2
        self.depths = [0.9 * middle, middle, 1.1 * middle]
        self.grid = voxel_grid(self.imager, self.depths, pixels=PIXELS_PER_VOXEL)

    @cached_property
    def sheet(self) -> dict[str, Any]:
        return datasheet(self.design, self.depths)

    @cached_property
    def points(self) -> np.ndarray:
        places = np.array([[0.33, -0.21], [-0.42, 0.13], [0.08, 0.37]]) * self.imager.field_radius / 3
        return np.column_stack([places + np.array(self.imager.sensor.origin), self.depths, [1.0, 0.9, 0.8]])

    @cached_property
    def truth(self) -> np.ndarray:
        """Three bars in the middle plane, as of a letter."""
        volume = np.zeros(self.grid.volume_shape, np.float32)
        row, column = (n // 2 for n in self.grid.shape)
        volume[1, row - 4 : row + 5, [column - 3, column + 3]] = 1
        volume[1, row - 1, column - 3 : column + 4] = 1
        return volume

    def capture(self, scene: np.ndarray, grid: Grid | None = None) -> np.ndarray:
        """A volume by our own model. Points by an independent tracer or, if it takes no such device, by `simulate`."""
        if grid is None and can_trace(self.imager):
            image = diffracted(traced(scene, self.imager, RAYS), self.imager).astype(np.float32)
        else:
            optics = "full" if grid is None else self.optics
            image = gs.simulate(scene, self.imager, grid, optics=optics, psf=None if optics == "full" else "geometric")
        return np.asarray(gs.expose(jnp.asarray(image), gs.Camera(), jax.random.key(0), peak_electrons=2e4))

    @cached_property
    def of_points(self) -> np.ndarray:
        return self.capture(self.points)

    @cached_property
    def of_truth(self) -> np.ndarray:
        return self.capture(self.truth, self.grid)

    @cached_property
    def validation(self) -> CrossValidation:
        method = METHODS["richardson-lucy"](10)
        return gs.cross_validated(self.of_truth, self.imager, self.grid, method, optics=self.optics)


case_of = cache(Case)


@contextlib.contextmanager
def as_users_do(name: str):
    """JAX with its defaults: float32 unless float64 is asked for, no strict rules."""
    with jax.enable_x64(name == "float64"), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def points(case: Case, _) -> None:
    found = gs.find_points(case.of_points, case.imager, case.grid)
    axial, lateral = (np.max(case.sheet[f"{axis}_resolution_um"]) / 1000 for axis in ("axial", "lateral"))
    score = gs.localization(found, case.points, lateral=lateral, axial=axial)
    assert score.f1 == 1, f"{len(found)} points found: {found}"


def inverted(method: str, case: Case, _) -> None:
    volume = gs.reconstruct(case.of_truth, case.imager, case.grid, METHODS[method](20), optics=case.optics)
    assert volume.dtype == np.float32 and np.isfinite(volume).all()
    if method == "backproject":  # of a camera with the other byte order
        foreign = case.of_truth.astype(case.of_truth.dtype.newbyteorder())
        again = gs.reconstruct(foreign, case.imager, case.grid, METHODS[method](20), optics=case.optics)
        np.testing.assert_array_equal(again, volume)
    empty, found = (gs.quality(some, case.truth).psnr_db for some in (np.zeros_like(case.truth), volume))
    # Back-projection has light of every plane in each: by the gain that fits it best it is little better than nothing.
    assert found > empty + (0.02 if method == "backproject" else 0.3)
    lit = case.truth[1] > 0
    assert volume[1][lit].mean() > 2 * volume[1][~lit].mean()


def scored(case: Case, _) -> None:
    found = case.validation
    assert found.noise < found.error < 0.95 and found.folds.shape == (4,)


def deviated(case: Case, _) -> None:
    """Of bright voxels 85 % or more are right within two deviations, also by the model that rendered them."""
    sd, method = case.validation.deviation, METHODS["richardson-lucy"](10)
    volume = gs.reconstruct(case.of_truth, case.imager, case.grid, method, optics=case.optics)
    assert sd.shape == volume.shape and sd.dtype == np.float32 and (sd[volume > 0] > 0).all()
    assert shares_within(volume, sd, case.truth, case.imager, case.grid)[1] > 0.85


def refocused(case: Case, _) -> None:
    """Of bars in one plane, ten steps show the radius to 3 %; all lenses change alike."""
    found = fit_radius([case.of_truth], case.imager, case.grid, METHODS["list-rl"](10), optics=case.optics)
    before, after = case.imager.array, found.imager.array
    np.testing.assert_allclose(after.radius_of_curvature, found.factor * before.radius_of_curvature, rtol=1e-6)
    assert abs(found.factor - 1) < 0.03 and len(found.trials) > 3


def followed(case: Case, _) -> None:
    """A frame that starts from the same frame's volume keeps its gain, but for a tenth: its steps end 2 % above."""
    empty = gs.quality(np.zeros_like(case.truth), case.truth).psnr_db
    for name in ("list-rl", "richardson-lucy"):
        reconstructor = gs.Reconstructor(case.imager, case.grid, METHODS[name](10), case.optics)
        volume, last = follow_volume(reconstructor, case.of_truth, None, Progress())
        following, _ = follow_volume(reconstructor, case.of_truth, last, Progress())
        first, second = (gs.quality(part, case.truth).psnr_db for part in (volume, following))
        assert second - empty > 0.9 * (first - empty) > 0.2, (name, first, second)


def tiled(case: Case, folder: Path) -> None:
    """In tiles a volume is as far above an empty one as in one piece, but for a tenth of a dB."""
    empty = gs.quality(np.zeros_like(case.truth), case.truth).psnr_db
    for name in ("backproject", "list-rl"):
        plan = Plan(case.imager, case.grid, METHODS[name](10), case.optics, False, "none", False, None)
        tiles = make_tiles(plan, max(case.grid.shape) // 2 + 1)
        series = VolumeSeries(folder / f"{name}.zarr", tiles.count, case.grid, tile=tiles.side)
        reconstruct_tiles(plan, tiles, case.of_truth, series, Workers(), Progress())
        whole, found = plan.prepare(Progress())(case.of_truth, Progress()).volume, gs.read_volume(series.path)[0]
        first, second = (gs.quality(part, case.truth).psnr_db for part in (whole, found))
        assert tiles.count > 1 and second > first - 0.1 and first > empty, (name, first, second)


def demixed(case: Case, _) -> None:
    """The light of points at their true places, from their capture by the independent tracer, but for one scale."""
    images = image_regions([np.append(point[:3], 1.0)[None] for point in case.points], case.imager)
    found = demix(case.of_points, prepare_demixing(images, [case.of_points]))
    scale = found.light / case.points[:, 3]
    np.testing.assert_allclose(scale, np.median(scale), rtol=0.1)
    assert (found.error < 0.1 * found.light).all()


def calibrate(case: Case, _) -> None:
    places = case.points[[0, 2], :3]
    images = [case.capture(np.append(place, 1.0)[None]) for place in places]
    listed = case.imager
    if case.name == "mirrored":
        array = dataclasses.replace(
            listed.array, centers=np.asarray(listed.array.centers) * np.array([-1, 1], np.float32)
        )
        listed = dataclasses.replace(listed, array=array)
    start = dataclasses.replace(listed, sensor_distance=1.01 * float(listed.sensor_distance))
    found = gs.calibrate(images, places, start, fit=("sensor_distance", "rotation", "shift"))
    assert found.mirrored == (case.name == "mirrored") and found.rms < 0.5
    # On the host, as in the other tasks: each of JAX's operations alone would be a program.
    ours, true = (np.asarray(to_numpy(i).project(case.points[:, :3])) for i in (found.imager, case.imager))
    # What lenses within the field radius see; a mirrored array has its lenses in the same order.
    beside = case.points[None, :, :2] - to_numpy(case.imager).centers[:, None]
    seen = np.linalg.norm(beside, axis=-1) < float(case.imager.field_radius)
    np.testing.assert_allclose(ours[seen], true[seen], atol=case.imager.sensor.pixel_pitch)


def pattern(case: Case, _) -> None:
    """Calibration by discs, as of a far white surface, of an array that is mirrored, turned, moved and smaller."""
    design, far = case.imager, np.array([[*case.imager.sensor.origin, 1e4]])
    host = to_numpy(design)
    array = dataclasses.replace(design.array, centers=0.98 * host.array.centers * [1, -1])
    move = 0.02 * host.field_radius * np.array([1, -0.6])
    turned = dataclasses.replace(design, array=array, rotation=host.rotation + 0.5, shift=host.shift + move)
    actual = to_numpy(turned)
    middles = np.asarray(actual.sensor.to_pixels(actual.project(far)[:, 0]))
    radius = 0.3 * float(nearest_neighbour_distances(np.asarray(array.centers)).mean()) / actual.sensor.pixel_pitch
    found = gs.calibrate([discs(actual.sensor.shape, middles, radius)], far, design, fit=PATTERN_FITTED, blurred=[0])
    assert found.mirrored
    np.testing.assert_allclose(to_numpy(found.imager).centers, actual.centers, atol=0.05 * actual.sensor.pixel_pitch)


def metrics(case: Case, _) -> None:
    magnification = to_numpy(case.imager).magnification(np.array(case.depths))
    np.testing.assert_allclose(case.sheet["magnification"], magnification, rtol=1e-5)
    for name in ("lateral_resolution_um", "axial_resolution_um", "occupancy", "lenses_per_point"):
        assert np.all(np.asarray(case.sheet[name]) > 0), name


def widths(case: Case, _) -> None:
    # The sheet's widths have five digits.
    light, found = map(np.asarray, light_and_width(case.imager, np.array(case.depths)))
    np.testing.assert_allclose(1000 * found, case.sheet["spot_width_um"] / (100 * light) ** 0.25, rtol=1e-4)


@eqx.filter_jit
def light_and_width(scope, depths):
    return gs.objectives.light(scope, depths), gs.objectives.width_per_light(scope, depths)


@eqx.filter_jit
def overlap(depths, scope):
    return jnp.sum(gs.objectives.occupancy(scope, depths))


def one_map(case: Case, _) -> None:
    """The rays of grids, axis by axis, are those of `Imager.views`: each spot is shared by four pixels."""
    voxels = Grid(case.grid.depths, (2, 3), 0.31 * case.imager.field_radius, case.grid.origin)
    places = np.stack(np.meshgrid(case.depths, voxels.y, voxels.x, indexing="ij"), -1).reshape(-1, 3)[:, ::-1]
    light = np.random.default_rng(0).random(voxels.volume_shape)
    host = to_numpy(case.imager)
    views = host.views_of_all(places)
    spots, weight = host.sensor.to_pixels(views.spot), np.asarray(host.brightness(views)) * light.ravel()
    low, image = np.floor(spots).astype(int), np.zeros(case.imager.sensor.shape)
    on = (low >= 0).all(-1) & (low + 1 < np.array(image.shape)).all(-1)
    for corner in np.ndindex(2, 2):
        share = np.prod(np.where(corner, spots - low, 1 - spots + low), -1)
        np.add.at(image, tuple((low[on] + corner).T), (share * weight)[on])
    # Rays that meet the last row or column exactly are none here. Coordinates are float32.
    found = gs.ImagingOperator(case.imager, voxels).mv(jnp.asarray(light, case.imager.sensor_distance.dtype))
    np.testing.assert_allclose(found, image, atol=2e-3 * image.max())


def from_imager(case: Case, _) -> None:
    given = case.design.model_copy(update={"provenance": {}})
    known = {"name": given.name, "working_distance_mm": given.imaging.working_distance_mm}
    if case.imager.band is None:
        assert Design.from_imager(case.imager, **known) == given
        return
    with pytest.raises(InputError, match="`band` must be None"):
        Design.from_imager(case.imager, **known)
    # Materials become indices: the imager is equal, and the design is not.
    imager = given.replace(bandwidth_nm=0.0).imager()
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-7), Design.from_imager(imager, **known).imager(), imager
    )


def tolerances(case: Case, _) -> None:
    outcome = tolerance(case.design, depths=case.depths, draws=16)
    assert np.isfinite(outcome.devices.log_width).all() and np.isfinite(outcome.devices.calibrated).all()


def optimise(case: Case, _) -> None:
    v = case.design.imaging.sensor_distance_mm
    study = Study.model_validate(
        {
            "depths_mm": (case.depths[0], case.depths[-1]),
            "depth_count": 2,
            "free": {"sensor_distance_mm": (0.8 * v, 1.2 * v)},
            "terms": ({"name": "thickness_mm", "minimise": v},),
            "stages": ({"solver": "lbfgsb", "steps": 1},),
        }
    )
    found = gs.run_study(case.design, study)
    assert found.design.imaging.sensor_distance_mm < v
    assert found.design.lens == case.design.lens and found.design.array == case.design.array
    # And without a study.
    loss = jax.tree_util.Partial(overlap, np.array(case.depths))
    limits = {"sensor_distance": (0.8 * v, 1.2 * v)}
    best = gs.optimize(loss, case.imager, free=gs.free("sensor_distance"), bounds=limits, steps=3)
    assert float(best.imager.sensor_distance) < v and float(best.value) < float(loss(case.imager))


def mold(case: Case, folder: Path) -> None:
    report = gs.make_mold(case.design, folder / "mold.stl")
    assert report["verification"]["lenses"] == len(case.design.array.centers_mm)
    assert write_heights(case.design, folder / "heights.dat", step=0.1)["deviation_nm"] < 1


def bounded(case: Case, _) -> None:
    gain = volume_bound(case.imager, case.grid.depths)
    assert 0 < gain.design < gain.most


def held(case: Case, folder: Path) -> None:
    rig = make_rig(case.design, HolderShape(flange=case.design.imaging.sensor_distance_mm, bore=60.0, bolts=80.0))
    for solid, volume in ((rig.holder, rig.holder_volume), (rig.target, rig.target_volume)):
        results = check_solid(float32_mesh(solid), volume, "part", handles=5)
        assert all(result.level == "ok" for result in results), results


def reported(case: Case, folder: Path) -> None:
    write_report(folder / "report.html", case.design, volume=case.truth, grid=case.grid, points=case.points)
    assert case.design.name in (folder / "report.html").read_text(encoding="utf-8")


TASKS: dict[str, Callable[[Case, Path], None]] = {
    "points": points,
    **{method: partial(inverted, method) for method in METHODS},
    "score": scored,
    "deviation": deviated,
    "radius": refocused,
    "follow": followed,
    "tiles": tiled,
    "demix": demixed,
    "bound": bounded,
    "calibrate": calibrate,
    "pattern": pattern,
    "metrics": metrics,
    "widths": widths,
    "map": one_map,
    "design": from_imager,
    "optimise": optimise,
    "tolerance": tolerances,
    "mold": mold,
    "holder": held,
    "report": reported,
}
# What is refused, and by which words.
REFUSED: dict[tuple[str, str], str] = {
    ("one lens", "points"): "3 or more lenses must agree on a point, got 1 lens",
    ("one lens", "score"): "2 or more lenses",
    ("one lens", "deviation"): "2 or more lenses",
    ("one lens", "radius"): "2 or more lenses",
    ("one lens", "calibrate"): "got 0 of 1 bright spots",
    ("one lens", "pattern"): "a pattern needs an array of 6 lenses or more, got 1",
    ("one lens", "tolerance"): "2 or more lenses must see .*, got 1",
    **{(name, "holder"): "must begin beyond the holder" for name in ("small lenses", "endoscope")},
    **{(name, "holder"): "must begin with 1 mm of air" for name in ("layers", "samples", "tilted, layers")},
    ("out of focus", "calibrate"): "of 20 bright spots on lenses",
}
# Whatever reads the cores of spots warns.
WARNED = {("out of focus", task) for task in ("points", "list-rl", "unrolled")}

# `make test` runs these for every device; a datasheet and a search for the structures of an imager, which compile them,
# a mold for each kind of lens, whatever else the device has, and each of the rest somewhere. `make integration` runs
# all others.
ALWAYS = ("design", "map")
ONCE = {
    "metrics": (
        *("geomscope", "geomscope-asphere", "geomscope-optimized", "out of focus", "steep", "curved side", "conic"),
        *("aspheric", "layers", "samples", "turned", "mirrored", "region", "binned", "odd", "one lens"),
        "curved, tilted, two radii, layers",
    ),
    "widths": ("geomscope", "curved, tilted, two radii, layers"),
    "optimise": (
        *("geomscope", "geomscope-asphere", "aspheric", "two radii", "layers", "tilted", "one lens"),
        "curved, tilted, two radii, layers",
    ),
    "mold": (
        *("geomscope", "geomscope-asphere", "steep", "aspheric", "two radii", "small lenses", "one lens"),
        "curved, tilted, two radii",
    ),
    "holder": ("geomscope", "curved side", "endoscope", "layers", "small lenses"),
    "points": ("geomscope-asphere", "one lens"),
    "backproject": ("endoscope",),
    "list-rl": ("curved, tilted, two radii, layers",),
    "richardson-lucy": ("turned",),
    "fista": ("geomscope-optimized",),
    "admm": ("region",),
    "surface": ("odd",),
    "unrolled": ("geomscope",),
    "calibrate": ("geomscope",),
    "pattern": ("mirrored",),
    "report": ("geomscope-optimized",),
}

# A score and a radius are reconstructions of pixels that are masked the same way for every lens, and frames that follow
# are starts of solvers that all devices have: so on the richest devices.
ON_THE_RICHEST = ("score", "deviation", "radius", "follow", "tiles", "demix", "bound")
RICHEST = ("geomscope", "curved, tilted, two radii, layers", "one lens")
# Devices that differ from others in their files alone, or in size.
FEW = ("samples", "small lenses")


def pairs():
    for device in (name for name in DEVICES if name not in (LARGE, FINE)):
        for task in TASKS:
            few = device in FEW and task not in (*ALWAYS, "metrics", "widths", "optimise", "mold")
            # One lens sees no depth: of the wide voxels that tiles start from, ten steps keep 2 dB.
            alone = (device, task) == ("one lens", "tiles")
            if few or alone or task in ON_THE_RICHEST and device not in RICHEST:
                continue
            marks = () if task in ALWAYS or device in ONCE.get(task, ()) else pytest.mark.integration
            yield pytest.param(device, task, "near", marks=marks, id=f"{device}-{task}")
    for task in ("points", "backproject", "list-rl", "richardson-lucy", "map"):
        yield pytest.param(LARGE, task, "near", marks=pytest.mark.integration, id=f"{LARGE}-{task}")
    yield pytest.param(FINE, "points", "near", marks=pytest.mark.integration, id=f"{FINE}-points")
    # The designs with sharp spots, with all of the light.
    for device in ("geomscope-asphere", "geomscope-optimized"):
        for task in ("points", *METHODS):
            yield pytest.param(device, task, "full", marks=pytest.mark.integration, id=f"{device}-{task}-full")


@pytest.mark.parametrize("device, task, optics", list(pairs()))
def test_it_is_right_or_refused(device, task, optics, tmp_path):
    with as_users_do(device):
        case, words = case_of(device, optics), REFUSED.get((device, task))
        if (device, task) in WARNED:
            with pytest.warns(InputWarning, match="out of focus"), contextlib.suppress(AssertionError):
                TASKS[task](case, tmp_path)
        elif words:
            with pytest.raises(InputError, match=words):
                TASKS[task](case, tmp_path)
        else:
            TASKS[task](case, tmp_path)
