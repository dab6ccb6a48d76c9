"""Plane layers: exact rays against literal refraction at every face, and the numbers that follow."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import gs_jax as gs
from gs_jax.microscope.lenses import Orientation
from gs_jax.optics import aberrations
from gs_jax.optics.pupil import solid_angle, transmittance
from gs_jax.optics.raytrace import refract, to_numpy, trace_lenslet

FILTER, WINDOW = gs.Layers([2.0], [1.52]), gs.Layers([0.6, 0.55], [1.0, 1.51])
SAMPLES = {
    "air": None,
    "gel": gs.Sample(1.43, surface=19.0, layers=gs.Layers([0.17], [1.523])),
    "immersed": gs.Sample(1.33),
}
FIELD = (1.3, -2.1)
# Of each trace, so that one program serves all of a structure.
POINTS = 56


def layered(orientation: Orientation = "plano", sample="gel", **numbers) -> gs.Imager:
    lens = {"radius_of_curvature": 2.0, "refractive_index": 1.43, "substrate_thickness": 1.0}
    array = gs.MicrolensArray([[0.0, 0.0]], **lens, orientation=orientation, **numbers)
    filters = gs.Layers([0.3, 2.0], [1.0, 1.52]) if orientation == "curved" else FILTER
    scope = gs.Imager(array, gs.Sensor((600, 600), 0.0045), sensor_distance=6.0, field_radius=3.6)
    return dataclasses.replace(scope, filters=filters, windows=WINDOW, sample=SAMPLES[sample])


def media(scope, depth):
    """Faces from the object to the sensor: index before each, and its height above the vertex; "lens" is the curve."""
    front, below = [], -float(scope.sensor_distance)
    n, t = float(scope.array.refractive_index), float(scope.array.substrate_thickness)
    top = t if scope.array.orientation == "plano" else 0.0
    at = top
    for thickness, index in scope.filters.slabs:
        at += float(thickness)
        front.append((float(index), at))
    medium = 1.0
    if scope.sample is not None:
        medium = float(scope.sample.refractive_index)
        if scope.sample.surface is not None:
            front.append((1.0, top + float(scope.sample.surface - scope.sample.layers.total)))
            front.append((float(scope.sample.layers.refractive_index[0]), top + float(scope.sample.surface)))
    faces = [(index, height) for index, height in front[::-1]]
    if scope.array.orientation == "plano":
        faces += [(n, t), (1.0, "lens")]
    else:
        faces += [(n, "lens"), (1.0, -t)]
        below -= t
    faces += [(1.51, below + 0.6 + 0.55), (1.0, below + 0.6)]
    return medium, top + depth, faces, below


@pytest.mark.parametrize("orientation", ["plano", "curved"])
@pytest.mark.parametrize("sample", SAMPLES)
def test_rays_are_those_of_snells_law_at_every_face(orientation, sample):
    if orientation == "curved" and sample == "immersed":
        sample = "gel"
    scope = to_numpy(layered(orientation, sample))
    grid = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 8), np.linspace(-0.6, 0.6, 7)), 0).reshape(2, -1)
    depth, field = 21.5, np.array(FIELD)[:, None]
    ray = refract(scope, depth, grid, field)
    medium, z, faces, below = media(scope, depth)
    sine = ray.slope / np.sqrt(1 + (ray.slope**2).sum(0))
    direction = np.concatenate([sine / medium, -np.sqrt(1 - (sine**2).sum(0) / medium**2)[None]])
    place = np.concatenate([field + 0 * grid, np.full((1, grid.shape[1]), z)])
    n_in, light, path = medium, 1.0, 0.0
    for n_out, height in faces:
        place, gone = intersect(scope, place, direction, height)
        path = path + n_in * gone
        normal = up(scope, place, height)
        cosine = -(direction * normal).sum(0)
        direction, cosine_out = bend(direction, normal, cosine, n_in / n_out)
        s = ((n_in * cosine - n_out * cosine_out) / (n_in * cosine + n_out * cosine_out)) ** 2
        p = ((n_out * cosine - n_in * cosine_out) / (n_out * cosine + n_in * cosine_out)) ** 2
        light = light * (1 - (s + p) / 2)
        if height == "lens":
            np.testing.assert_allclose(place[:2], grid, atol=1e-9)
        n_in = n_out
    place, gone = intersect(scope, place, direction, below)
    path = path + gone
    assert ray.valid.all()
    np.testing.assert_allclose(ray.landing, place[:2], atol=1e-9)
    np.testing.assert_allclose(transmittance(scope, ray), light, rtol=1e-9)
    ours = trace_lenslet(layered(orientation, sample), depth, grid.T, FIELD)
    middle = len(path) // 2
    np.testing.assert_allclose(ours.path - ours.path[middle], path - path[middle], atol=1e-9)
    # The solid angle in the medium, by differences.
    step = 1e-5
    moved = [refract(scope, depth, grid + step * np.eye(2)[:, k : k + 1], field) for k in range(2)]
    sines = [one.slope / np.sqrt(1 + (one.slope**2).sum(0)) / medium for one in (*moved, ray)]
    a, b = ((one - sines[2]) / step for one in sines[:2])
    area = abs(a[0] * b[1] - a[1] * b[0]) / np.sqrt(1 - (sines[2] ** 2).sum(0))
    np.testing.assert_allclose(solid_angle(scope, ray), area, rtol=1e-3)


def intersect(scope, place, direction, height):
    """Where rays meet a face, and how far they went."""
    if height != "lens":
        gone = (height - place[2]) / direction[2]
        return place + gone * direction, gone
    radius, sign = 2.0, 1 if scope.array.orientation == "plano" else -1
    # A cap that is highest at the vertex: with the plane in front its centre is above, nearer the object.
    center = np.array([0.0, 0.0, sign * radius])[:, None]
    away = place - center
    along, square = (away * direction).sum(0), (away**2).sum(0) - radius**2
    roots = [-along - np.sqrt(along**2 - square), -along + np.sqrt(along**2 - square)]
    gone = roots[1] if sign > 0 else roots[0]
    return place + gone * direction, gone


def up(scope, place, height):
    if height != "lens":
        return np.array([0.0, 0.0, 1.0])[:, None]
    sign = 1 if scope.array.orientation == "plano" else -1
    center = np.array([0.0, 0.0, sign * 2.0])[:, None]
    return -sign * (place - center) / 2.0


def bend(direction, normal, cosine, ratio):
    out = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * direction + (ratio * cosine - out) * normal, out


@pytest.mark.parametrize("sample", SAMPLES)
def test_rays_near_the_axis_go_by_reduced_distances(sample):
    scope = layered(sample=sample)
    near, host = np.resize(1e-3 * np.array([[0.0, 0.0], [0.3, 0.1]]), (POINTS, 2)), to_numpy(scope)
    landing = np.asarray(trace_lenslet(scope, 21.0, near, (2e-3, -1e-3)).landing)
    np.testing.assert_allclose(landing[0], -host.magnification(21.0) * np.array([2e-3, -1e-3]), rtol=1e-6)
    assert float(host.depth_of(host.reduced_depth(21.0))) == pytest.approx(21.0)
    assert float(host.sensor_distance_of(host.reduced_sensor_distance)) == pytest.approx(6.0)


@pytest.mark.parametrize(
    "sample", ["gel", *(pytest.param(name, marks=pytest.mark.integration) for name in ("air", "immersed"))]
)
def test_the_best_focus_is_that_of_reduced_distances(sample):
    scope = layered(sample=sample)
    focus, scope = float(aberrations.best_focus(scope, 21.0, radius=0.05)), to_numpy(scope)
    vergence = 1 / scope.array.focal_length - 1 / scope.reduced_depth(21.0)
    assert float(scope.sensor_distance_of(1 / vergence)) == pytest.approx(focus, rel=1e-3)


def test_layers_of_index_one_are_air():
    # As many layers as of "gel".
    layers = {"filters": gs.Layers([2.0], [1.0]), "windows": gs.Layers([0.6, 0.55], [1.0, 1.0])}
    air = dataclasses.replace(layered(), **layers, sample=gs.Sample(1.0, 19.0, gs.Layers([0.17], [1.0])))
    without = dataclasses.replace(air, filters=None, windows=None, sample=None)
    points = np.resize(np.array([[0.1, 0.2], [-0.5, 0.4]]), (POINTS, 2))
    for one, other in zip(*(trace_lenslet(each, 21.0, points, FIELD) for each in (air, without)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    field, hosts = np.array(FIELD)[:, None], [to_numpy(each) for each in (air, without)]
    light = [solid_angle(host, refract(host, 21.0, points.T, field)) for host in hosts]
    np.testing.assert_allclose(*light, rtol=1e-12)


@pytest.mark.integration
def test_derivatives_by_thickness_index_and_gap():
    grid = gs.Grid([20.5, 22.0], (9, 9), 0.2)
    scope, cover = layered(), gs.Layers([0.17], [1.523])
    values = np.random.default_rng(0).random(grid.volume_shape)

    def of(numbers):
        filters, window, index, surface = numbers
        sample = gs.Sample(index, surface, cover)
        return dataclasses.replace(
            scope, filters=gs.Layers(filters, [1.52]), windows=gs.Layers([0.6, 0.55], window), sample=sample
        )

    def spots(numbers):
        rays = trace_lenslet(of(numbers), 21.0, np.array([[0.0, 0.0], [0.4, -0.2]]), FIELD)
        return rays.landing, 1e3 * rays.path

    def wavefront(numbers):
        return 1e3 * aberrations.wavefront_rms(of(numbers), 21.0, radius=0.4)

    start = jnp.array([2.0]), jnp.array([1.05, 1.51]), jnp.array(1.43), jnp.array(19.0)
    check_grads(spots, (start,), order=1, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)
    check_grads(wavefront, (start,), order=1, modes=("rev",), atol=1e-4, rtol=1e-4)
    image = lambda numbers: jnp.vdot(pattern, gs.forward(values, of(numbers), grid))
    rows, columns = np.ogrid[:600, :600]
    pattern = np.sin(rows / 40) * np.cos(columns / 50)
    check_grads(image, (start,), order=1, modes=("rev",), eps=1e-5, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: gs.Layers([1.0], [1.5, 1.6]), r"must be \(layer,\)"),
        (lambda: gs.Layers([-1.0], [1.5]), "`thickness` must be finite and not negative, got -1.0"),
        (lambda: gs.Layers([1.0], [0.5]), "`refractive_index` must be 1 or more"),
        (lambda: gs.Sample(0.9), "`refractive_index` must be 1 or more"),
        (lambda: gs.Sample(1.3, surface=-2.0), "`surface` must be finite and not negative"),
    ],
)
def test_layers_that_cannot_be(make, words):
    with pytest.raises(ValueError, match=words):
        make()
