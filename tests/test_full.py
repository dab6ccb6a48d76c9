"""All of the light: where it goes, in tables; and the image of a volume and of points."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.design_judge import diffracted
from experiments.ray_tracer import traced
from gs_jax import (
    Grid,
    Imager,
    ImagingOperator,
    InputError,
    MicrolensArray,
    Sensor,
    forward,
    psf_model,
    reconstruct,
)
from gs_jax.design.design import read_design
from gs_jax.detection.point_finder import find_points
from gs_jax.microscope.geometry import falloff
from gs_jax.optics import field_varying
from gs_jax.optics.apertures import clear_area
from gs_jax.optics.field_varying import FieldVaryingPsf, field_varying_psf, make_polar_grid, to_pixels_table
from gs_jax.optics.psf_core import (
    core_magnification,
    render_harmonics,
    render_kernel,
    ring_edges,
    ring_window,
    sample_profile,
)
from gs_jax.optics.pupil import aperture_profile, sample_pupil, trace_light
from gs_jax.optics.raytrace import to_numpy, trace_lenslet
from gs_jax.projection import field_varying_model
from gs_jax.projection.field_varying_model import wider_voxels, window_sides
from gs_jax.projection.point_sources import full_image_of_points, full_imager_of_points
from gs_jax.solvers.richardson_lucy import RichardsonLucy

DEPTHS = (18.0, 21.0)


def imager(dtype=float, *, pixels=(96, 81), pitch=0.06, lenses=9) -> Imager:
    """Lenses on a slightly disordered square, in front of a small sensor with large pixels."""
    side = round(math.sqrt(lenses))
    place = (np.argwhere(np.ones((side, side))) - (side - 1) / 2) * 1.3
    centers = place + np.random.default_rng(0).uniform(-0.2, 0.2, place.shape)
    made = Imager(MicrolensArray(centers), Sensor(pixels, pitch), 5.75, 1.5, rotation=0.1, shift=(0.05, -0.03))
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf, dtype)), made)


def grid(dtype=float, shape=(13, 12)) -> Grid:
    made = Grid(DEPTHS, shape, 0.4, (0.2, -0.1))
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf, dtype)), made)


def volume(shape, dtype=float) -> np.ndarray:
    return np.random.default_rng(0).random(shape).astype(dtype)


def traced_light(scope: Imager, point) -> float:
    """What of a point's light reaches the sensor, by rays through each lens's own aperture."""
    centers, radius = np.asarray(scope.centers), float(scope.array.aperture_diameter) / 2
    side = (np.arange(101) - 50) / 50 * radius
    pupil = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    total = 0.0
    for center in centers:
        offsets = np.delete(centers, (centers == center).all(1), 0) - center
        beyond = (pupil @ offsets.T > (offsets**2).sum(1) / 2).any(1) | (np.hypot(*pupil.T) > radius)
        field = point[:2] - center
        rays = trace_lenslet(scope, point[2], pupil, field)
        light = np.where(rays.valid & ~beyond, trace_light(to_numpy(scope), point[2], pupil.T, field[:, None])[1], 0)
        pixels = np.asarray(scope.sensor.to_pixels(np.asarray(rays.landing) + center))
        seen = ((pixels > -0.5) & (pixels < np.array(scope.sensor.shape) - 0.5)).all(1)
        total += light[seen].sum() * (side[1] - side[0]) ** 2
    return total


@pytest.mark.integration
@pytest.mark.parametrize("point", [(0.2, -0.1, 18.0), (2.0, 1.0, 21.0)])
def test_it_holds_the_light_that_rays_bring(point):
    """To 5 %: an aperture that neighbours cut counts as round, with the mean lens's openness and its own area."""
    scope = imager(pitch=0.1)
    found = full_image_of_points(np.array([[*point, 2.0]]), scope)
    np.testing.assert_allclose(found.sum(), 2 * traced_light(scope, point), rtol=0.05)
    one = Grid([point[2]], (1, 1), 0.1, point[:2])
    image = forward(jnp.full((1, 1, 1), 2.0), scope, one, field_varying_psf(scope, one.depths))
    np.testing.assert_allclose(image.sum(), found.sum(), rtol=0.05)


def test_windows_hold_the_image_of_the_whole_sensor(monkeypatch):
    """Of plain and of oriented rings on both kinds of pixels, in lenses that are partly beyond the sensor, too."""
    scope, voxels = imager(), grid()
    monkeypatch.setattr(field_varying_model, "_FEW", math.inf)
    table, rng = field_varying_psf(scope, voxels.depths), np.random.default_rng(0)
    monkeypatch.setattr(field_varying_model, "_WINDOWS", 4)
    assert min(sides := window_sides(scope, voxels, table)) > 0
    waves = [rng.normal(size=(2, 1, 4, *kernels.shape[-2:])) for kernels in (table.kernels, table.wide_kernels)]
    whole = dataclasses.replace(table, harmonics=waves[0], wide_harmonics=waves[1])

    @jax.jit
    def results(x, optics):
        """The image, the gradient by the sensor's distance, and the adjoint's volume of it."""

        def image(distance, x):
            return forward(x, eqx.tree_at(lambda i: i.sensor_distance, scope, distance), voxels, optics)

        y, back = jax.vjp(image, scope.sensor_distance, x)
        return y, *back(y)

    x = volume(voxels.volume_shape)
    wanted, found = (results(x, dataclasses.replace(whole, windows=windows)) for windows in ((0, 0), sides))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10 * np.abs(other).max())
    np.testing.assert_allclose(jnp.vdot(found[2], x), jnp.vdot(found[0], found[0]), rtol=1e-12)
    wider = dataclasses.replace(voxels, shape=tuple(n + 2 for n in voxels.shape))
    with pytest.raises(InputError, match="optics must be of the grid's (width|extent)"):
        forward(volume(wider.volume_shape), scope, wider, psf_model(scope, voxels, "full"))
    # Images that do not fit into their windows are no images.
    assert np.isnan(forward(x, scope, voxels, dataclasses.replace(table, windows=(16, 16)))).any()


ALSO = pytest.mark.integration


def alone(name: str, sensor: Sensor) -> Imager:
    """One lens of a shipped design."""
    lens = read_design(Path(__file__).parents[1] / "design" / f"{name}.toml").imager()
    array = dataclasses.replace(lens.array, centers=jnp.zeros((1, 2)), size=(2.0, 2.0))
    return dataclasses.replace(lens, array=array, sensor=sensor)


@pytest.mark.integration
def test_sharp_spots_of_voxels_are_those_of_points():
    """At any place within a pixel, up to 1.6 field radii. Points have 28 rings, to a tenth of a pixel: 0.15 is left.

    Six rings of which one is on the sensor's pixels, with the blur by shared light, leave 0.30.
    """
    scope = alone("geomscope-optimized", Sensor((121, 401), 0.0045, (-0.44, 0.0)))
    grid = Grid([20.0], (1, 33), 0.1371, (2.4, 0.01))
    image = np.asarray(forward(jnp.ones(grid.volume_shape), scope, grid, field_varying_psf(scope, grid.depths)))
    points = full_image_of_points(np.array([[x, 0.01, 20.0, 1.0] for x in np.asarray(grid.x)]), scope)
    assert np.linalg.norm(image - points) < 0.2 * np.linalg.norm(points)


@pytest.mark.parametrize("pitch", [pytest.param(0.0045, marks=ALSO), 0.018, pytest.param(0.052, marks=ALSO)])
def test_a_lens_that_is_sharp_has_no_halo(pitch):
    """Whatever the pixels: what cores do not explain of sharp spots would be sharpened by the halo's filter."""
    scope = alone("geomscope-asphere", Sensor((41, 41), pitch, (-0.148, 0.0)))
    one = Grid([20.0], (1, 1), 0.1, (1.0, 0.0))
    image = np.asarray(forward(jnp.ones((1, 1, 1)), scope, one, field_varying_psf(scope, one.depths)))
    # All in a few pixels, and nothing that is negative.
    row, column = np.unravel_index(image.argmax(), image.shape)
    reach = max(round(0.02 / pitch), 1)
    core = image[row - reach : row + reach + 1, column - reach : column + reach + 1].sum()
    assert core > 0.95 * image.sum() and image.min() > -0.02 * image.max()


@pytest.mark.integration
def test_fewer_rings_hold_the_same_light():
    scope, voxels = imager(), grid()
    x = volume(voxels.volume_shape)
    wanted: tuple[dict[str, Any], ...] = ({}, {"rings": (1.0, 2.5)})
    six, two = (forward(x, scope, voxels, field_varying_psf(scope, voxels.depths, **o)) for o in wanted)
    np.testing.assert_allclose(two.sum(), six.sum(), rtol=0.02)
    places = np.meshgrid(voxels.depths, voxels.y, voxels.x, indexing="ij")
    points = full_image_of_points(np.stack([*places[::-1], x], -1).reshape(-1, 4), scope)
    binned = lambda image: np.asarray(image)[:, :80].reshape(24, 4, 20, 4).sum((1, 3))
    alike = lambda a, b: np.corrcoef(np.ravel(a), np.ravel(b))[0, 1]
    # Two rings place cores less well: they differ within a few of these pixels.
    assert alike(six, points) > max(alike(two, points), 0.95) and alike(binned(two), binned(six)) > 0.99


def test_unknown_fidelities_and_rings_that_are_none_are_refused():
    with pytest.raises(InputError, match="fidelity must be one of full, near, pinhole, got 'exact'"):
        psf_model(imager(), grid(), "exact")
    for rings in ((), (1.0,), (1.0, 1.0), (2.0, 1.0), (0.0, 1.0)):
        with pytest.raises(InputError, match="rings must be two or more radii that ascend, got"):
            field_varying_psf(imager(), DEPTHS, rings=rings)


def test_points_are_voxels_that_lie_anywhere():
    scope = imager(pixels=(200, 200), pitch=0.03)
    point = np.array([[0.2, -0.1, 20.0, 1.0]])
    one = Grid([20.0], (1, 1), 0.1, point[0, :2])
    image = np.asarray(forward(jnp.ones((1, 1, 1)), scope, one, field_varying_psf(scope, one.depths)))
    image_of = full_imager_of_points(point, scope)
    found = image_of(point)
    np.testing.assert_array_equal(image_of(point), found)
    binned = lambda image: image.reshape(50, 4, 50, 4).sum((1, 3))
    assert np.corrcoef(binned(found).ravel(), binned(image).ravel())[0, 1] > 0.98


def test_pixels_have_the_light_of_each_ring_of_nodes():
    """About the axis nodes are closer to each other than the pixels."""
    nodes = make_polar_grid(imager(), np.array(DEPTHS))
    to_pixels = to_pixels_table(nodes).rows
    light = np.bincount(np.asarray(to_pixels.place) % nodes.radii, np.asarray(to_pixels.share)) / nodes.angles
    # The last rings are cut.
    np.testing.assert_allclose(light[:-3], 1, rtol=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize("field", [0.0, 0.8, 2.0])
@pytest.mark.parametrize(
    ("name", "tilt"), [("geomscope", None), ("geomscope-asphere", None), ("geomscope-asphere", (0.01, -0.006))]
)
def test_one_lens_loses_no_light(name, tilt, field):
    """Nodes that are near no pixel lost 13 % of the light on the axis, and 7 % at 0.6 mm."""
    scope = alone(name, Sensor((200, 200), 0.02))
    point = np.array([field, 0.3 * field, 20.0])
    light = traced_light(scope, point)
    scope = dataclasses.replace(scope, tilt=tilt)
    one = Grid([20.0], (1, 1), 0.1, point[:2])
    image = forward(jnp.ones((1, 1, 1)), scope, one, field_varying_psf(scope, one.depths))
    np.testing.assert_allclose(image.sum(), light, rtol=0.01)


def test_what_leaves_a_lens_is_what_its_solid_angle_holds():
    """Far away and without reflection, the clear disc over the sphere; a little less with Fresnel's few percent."""
    ideal = imager()
    thin = eqx.tree_at(lambda i: i.array.thin_lens_focal_length, ideal, jnp.asarray(4.65), is_leaf=lambda x: x is None)
    lone = [dataclasses.replace(i, array=dataclasses.replace(i.array, centers=np.zeros((1, 2)))) for i in (thin, ideal)]
    for scope, least in zip(lone, (0.999, 0.9), strict=True):
        rays = sample_pupil(scope, 200.0, np.zeros(1), aperture_profile(scope.array), 4096)
        part = rays.light.sum() / (np.pi / (4 * np.pi * float(scope.reduced_depth(200.0)) ** 2))
        assert least < part < 1.001
    # Normal incidence: each face passes 4 n / (n + 1)^2.
    (light,) = trace_light(to_numpy(lone[1]), 200.0, np.zeros((2, 1)), np.zeros((2, 1)))[1]
    light = light * 4 * np.pi * lone[1].reduced_depth(200.0) ** 2
    np.testing.assert_allclose(light, (4 * 1.43 / 2.43**2) ** 2, rtol=1e-6)


def test_zones_are_the_lenses_apertures():
    array = imager(lenses=25).array
    found = aperture_profile(array)
    areas = np.asarray(clear_area(array))
    step = found.radius[1] - found.radius[0]
    np.testing.assert_allclose((2 * np.pi * found.radius * found.open).sum() * step, areas.mean(), rtol=2e-3)
    # By regression, what a larger area adds is that area.
    np.testing.assert_allclose((2 * np.pi * found.radius * found.by_area).sum() * step, 1, rtol=0.02)
    np.testing.assert_array_equal(aperture_profile(array, by_area=False).open, found.open)
    alone = aperture_profile(MicrolensArray([[0.0, 0.0]]))
    assert (alone.open == 1).all() and (alone.by_area == 0).all()


@pytest.mark.integration
def test_tables_are_kept_for_the_same_microscope(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scope = imager(pixels=(24, 24), pitch=0.2)
    first = field_varying_psf(scope, [20.0])
    assert field_varying_psf(imager(pixels=(24, 24), pitch=0.2), [20.0]) is first
    farther = eqx.tree_at(lambda i: i.sensor_distance, scope, scope.sensor_distance + 1e-6)
    for other in (
        field_varying_psf(scope, [20.1]),
        field_varying_psf(farther, [20.0]),
        field_varying_psf(scope, [20.0], extent=2.0),
    ):
        assert other is not first
    # And for the next process: four files.
    vars(field_varying._tables)["cache_clear"]()
    monkeypatch.setattr(field_varying, "_trace_tables", lambda *arguments: pytest.fail("traced again"))
    assert eqx.tree_equal(field_varying_psf(scope, [20.0]), first)
    assert len(list(tmp_path.rglob("*.npz"))) == 4


def test_rings_add_up_to_the_falloff():
    scope = imager()
    rings = ring_edges(scope)
    distance2 = np.linspace(0, 20, 200)
    total = jax.jit(lambda distance2: sum(ring_window(distance2, *ring) for ring in rings))(distance2)
    np.testing.assert_allclose(total, falloff(distance2, rings[-1][1]), atol=1e-12)


def test_a_kernel_keeps_its_light_and_is_symmetric():
    # Ten pixels in sixteenths.
    profile = np.exp(-np.arange(160) / 32)
    profile /= profile.sum()
    for size, parts in ((23, 1), (111, 5), (13, 0.5)):
        kernel = render_kernel(profile, size, parts)
        np.testing.assert_allclose(kernel.sum(), 1, rtol=1e-3)
        for same in (kernel[::-1], kernel[:, ::-1], kernel.T):
            np.testing.assert_allclose(kernel, same, atol=1e-15)
    radius = np.hypot(*sample_profile(profile, 20_000).T)
    assert abs(np.mean(radius < 2) - profile[:32].sum()) < 0.01


def test_harmonics_are_the_waves_of_a_spot():
    """Of a Gaussian times 1 + a r cos t + b r^2 cos 2t, turned by any angle: with the cosine and the sine of each."""
    middle = (np.arange(320) + 0.5) / 16
    profile = middle * np.exp(-(middle**2) / 18)
    profile /= profile.sum()
    kernel, waves = (
        render_kernel(profile, 41),
        render_harmonics(profile, np.stack([0.15 * middle, 0.02 * middle**2]) * profile, 41),
    )
    y, x = np.mgrid[-20:21, -20:21]
    for turn in (0.0, 0.7, 2.0):
        spot = kernel + sum(
            factor * wave
            for factor, wave in zip(
                [np.cos(turn), np.sin(turn), np.cos(2 * turn), np.sin(2 * turn)], waves, strict=True
            )
        )
        radius, angle = np.hypot(x, y), np.arctan2(y, x) - turn
        wanted = kernel * (1 + 0.15 * radius * np.cos(angle) + 0.02 * radius**2 * np.cos(2 * angle))
        assert np.linalg.norm(spot - wanted) < 0.05 * np.linalg.norm(wanted)
    np.testing.assert_allclose(waves.sum((1, 2)), 0, atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "tilt", "at", "sensor", "symmetric"),
    [
        ("geomscope-asphere", None, 3.3, (-0.45, -0.25), 0.138),
        ("geomscope-optimized", (0.01, -0.006), 4.5, (-1.2, -0.5), 0.171),
    ],
)
def test_sharp_spots_have_coma(name, tilt, at, sensor, symmetric):
    """Beyond the field radius, on 4 x 4 pixels, against rays: voxels leave up to 0.61 of what symmetric cores do."""
    scope = dataclasses.replace(alone(name, Sensor((160, 400), 0.0045, sensor)), tilt=tilt)
    grid = Grid([20.5], (1, 9), 0.15, (at, 1.8))
    image = np.asarray(forward(jnp.ones(grid.volume_shape), scope, grid, field_varying_psf(scope, grid.depths)))
    points = np.array([[x, 1.8, 20.5, 1.0] for x in np.asarray(grid.x)])
    rays = diffracted(traced(points, scope, 10_000), scope)

    def error(image):
        ours, wanted = (each.reshape(40, 4, 100, 4).sum((1, 3)) for each in (image, rays))
        return np.linalg.norm(ours * np.vdot(ours, wanted) / np.vdot(ours, ours) - wanted) / np.linalg.norm(wanted)

    assert error(image) < 0.65 * symmetric
    assert error(full_image_of_points(points, scope)) < 0.65 * symmetric


def test_a_lens_without_aberrations_has_its_cores_on_the_chief_rays():
    scope = imager(pitch=0.01)
    thin = eqx.tree_at(lambda i: i.array.thin_lens_focal_length, scope, jnp.asarray(4.6), is_leaf=lambda x: x is None)
    # Out of focus the spot is an even disc, whose middle is found to a tenth of a pixel.
    depths = np.array([18.0, 20.0, 24.0])
    np.testing.assert_allclose(core_magnification(thin, depths), thin.magnification(depths), rtol=4e-3)
    many = np.linspace(18, 22, 30)
    np.testing.assert_allclose(core_magnification(scope, many)[::29], core_magnification(scope, many[::29]), rtol=1e-7)


def test_the_core_of_a_sharp_spot_with_coma_is_near_the_middle_of_its_light():
    scope = read_design(Path(__file__).parents[1] / "design" / "geomscope-asphere.toml").imager()
    fields, aperture = np.linspace(0, float(scope.field_radius), 17), aperture_profile(scope.array, by_area=False)
    depths = np.array([18.5, 20.5, 22.5])
    for depth, found in zip(depths, core_magnification(scope, depths), strict=True):
        rays = sample_pupil(scope, depth, fields, aperture, 8192)
        weight = rays.light * fields[:, None]
        middle = -(weight * rays.landing[..., 0] * fields[:, None]).sum() / (weight * fields[:, None] ** 2).sum()
        # It is 0.1 to 0.3 % larger, and 0.4 to 0.8 % where spots are brightest: 0.1 mm in depth.
        np.testing.assert_allclose(found, middle, rtol=3.5e-3)


@pytest.mark.integration
@pytest.mark.parametrize("fidelity", ["full", "near", "pinhole"])
def test_every_fidelity_reconstructs(fidelity):
    """A bright voxel is the brightest, whatever the PSF model."""
    scope, voxels = imager(pixels=(160, 160), pitch=0.03), Grid([18.0, 20.0, 22.0], (21, 21), 0.12)
    truth = np.zeros(voxels.volume_shape, np.float32)
    truth[1, 8, 13] = 1
    place = voxels.to_mm(np.array([[1, 8, 13]]))
    image = full_image_of_points(np.column_stack([place, [1e6]]), scope)
    volume = reconstruct(image, scope, voxels, RichardsonLucy(steps=10), optics=fidelity)
    at = np.unravel_index(volume.argmax(), volume.shape)
    assert np.abs(np.array(at[1:]) - (8, 13)).max() <= 1 and np.isfinite(volume).all()
    kind = {"pinhole": type(None), "near": jax.Array, "full": FieldVaryingPsf}[fidelity]
    assert isinstance(psf_model(scope, voxels, fidelity).parts[0], kind)


def test_a_model_of_other_planes_pixels_or_objects_is_refused():
    scope, voxels = imager(), grid()
    x, near = volume(voxels.volume_shape), psf_model(scope, voxels, "pinhole")
    nearer = eqx.tree_at(lambda m: m.extent, near, jnp.asarray(1.0))
    wide = dataclasses.replace(scope, sensor=dataclasses.replace(scope.sensor, pixel_pitch=0.5))
    for model, seen_by, wrong in [
        (near, voxels, None),
        (near, voxels.at([18.0, 21.5]), r"grid's depths, \[18.0, 21.5\] mm, got \[18.0, 21.0\] mm"),
        (near, voxels.at([18.0]), "grid's depths"),
        (nearer, voxels, "grid's extent, 5 mm, got tables of 1 mm"),
        ("full", voxels, "optics must be a PSF model .*, got 'full'"),
    ]:
        if wrong is None:
            of_rays = np.asarray(forward(x, scope, seen_by))
            # Different programs round differently, relative to the brightest pixel.
            tolerance = 1e-14 * of_rays.max()
            np.testing.assert_allclose(forward(x, scope, seen_by, model), of_rays, rtol=0, atol=tolerance)
            # Model and grid are known also where the volume is traced.
            traced_volume = jax.jit(lambda x: forward(x, scope, voxels, near))(x)
            np.testing.assert_allclose(traced_volume, of_rays, rtol=0, atol=tolerance)
            continue
        with pytest.raises(InputError, match=wrong):
            forward(x, scope, seen_by, model)
    for user in (
        lambda: ImagingOperator(wide, voxels, near),
        lambda: reconstruct(np.ones(scope.sensor.shape), wide, voxels, RichardsonLucy(2), optics=near),
        lambda: reconstruct(np.ones(scope.sensor.shape), wide, voxels, optics=near),
    ):
        with pytest.raises(InputError, match="sensor's pixels of 500 um, got"):
            user()


@pytest.mark.integration
def test_intensities_are_what_points_send_out():
    scope = imager(pixels=(600, 600), pitch=0.009, lenses=25)
    truth = np.array([[0.3, 0.2, 19.5, 1.0], [-0.4, -0.5, 20.4, 2.0]])
    image = full_image_of_points(truth, scope)
    found = find_points(image, scope, Grid([19.0, 21.0], (61, 61), 0.05))
    found = found[np.argsort(found[:, 3])]
    np.testing.assert_allclose(found[:, 3], truth[:, 3], rtol=0.1)
    # A pixel is 0.43 mm axially here.
    np.testing.assert_allclose(found[:, 2], truth[:, 2], atol=0.15)


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("shape", [(20, 31), (9, 8)])
def test_wider_voxels_keep_light_place_and_width(shape, factor):
    """Keys' cubic keeps moments up to the second: outer rings are as wide as with the volume's own voxels."""
    grid = Grid([20.0], shape, 0.1, (0.4, -0.3))
    volume = np.random.default_rng(0).random(grid.volume_shape)
    wider, light = jax.jit(wider_voxels, static_argnums=2)(grid, volume, factor)
    assert wider.pitch == pytest.approx(factor * grid.pitch) and wider.volume_shape == light.shape
    places = jax.jit(lambda *grids: {name: [getattr(each, name) for each in grids] for name in "xy"})(grid, wider)
    places = jax.tree.map(np.asarray, places)
    for axis, place in ((2, "x"), (1, "y")):
        sums = [np.asarray(some).sum((0, 3 - axis)) for some in (volume, light)]
        for power in range(3):
            fine, coarse = (
                np.vdot(part, (each - np.asarray(grid.origin)[2 - axis]) ** power)
                for part, each in zip(sums, places[place], strict=True)
            )
            assert coarse == pytest.approx(fine, rel=1e-6, abs=1e-6)
