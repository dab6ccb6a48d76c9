"""The forms for GPUs and TPUs, run on a CPU: the same numbers as the CPU's, and programs without conditionals."""

import re
import sys
from collections.abc import Callable
from functools import cache, partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax.test_util import check_grads

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, backproject_adjoint, forward, psf_model
from gs_jax.linear.linear_map import compiled_for_cpu
from gs_jax.optics.field_varying import field_varying_psf
from gs_jax.projection import cuda, tiles
from gs_jax.projection.bilinear import image_to_volume, rays_vjp, volume_to_image
from gs_jax.projection.rays import Envelope, RingLight, Shapes
from gs_jax.projection.stray_light import Windows, interpolate_windows

from . import test_full
from .helpers import scene, trace_rays
from .test_matrix import cropped

ENVELOPE, RING = Envelope(0.45), RingLight(0.3, 0.5)


@pytest.fixture(autouse=True)
def _on_a_processor():
    """Also where there is a GPU, which has the one form only."""
    with jax.default_device(jax.devices("cpu")[0]):
        yield


def lowered(form, function: Callable, *arguments):
    """A new program: those that were made before are kept."""
    with compiled_for_cpu(form):
        return jax.jit(lambda *arguments: function(*arguments)).lower(*arguments)


def same(function: Callable, *arguments, tolerance=1e-12, form="accelerated") -> Any:
    """The results, for which both forms must agree relative to the largest number of each array."""
    programs = [lowered(form, function, *arguments) for form in (form, "xla")]
    assert programs[0].as_text() != programs[1].as_text()
    results, expected = (program.compile()(*arguments) for program in programs)
    for a, b in zip(jax.tree.leaves(results), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())
    return results


def problem(weight, voxels, pitch, *, pixels=(96, 83), lenses=7, nearest=False, dtype=jnp.float64, tilt=None):
    rng = np.random.default_rng(0)
    # Some at the sensor's edge, one so far off that nothing is seen through it.
    centers = np.concatenate([[[0.02, 0.01], [9.0, 9.0]], rng.uniform(-0.3, 0.3, (40, 2))])[:lenses]
    imager = Imager(MicrolensArray(centers), Sensor(pixels, 0.0045), 5.8, 0.45, tilt=tilt)
    imager, grid = jax.tree.map(lambda a: np.asarray(a, dtype), (imager, Grid([18.0, 23.0], voxels, pitch)))
    parameters = rng.normal(size=(2, 7)).astype(dtype) if isinstance(weight, RingLight) else None
    rays = trace_rays(
        imager, grid, nearest=nearest, dtype=dtype, weight=weight, limit=weight.limit, parameters=parameters
    )
    image, volume = (rng.random(shape).astype(dtype) for shape in (pixels, grid.volume_shape))
    return Shapes(pixels, grid.volume_shape), rays, image, volume


def both_ways(shapes, rays, image, volume):
    return (
        image_to_volume(shapes, rays, image),
        image_to_volume(shapes, rays, (255 * image).astype(jnp.uint8)),
        image_to_volume(shapes, rays, None),
        volume_to_image(shapes, rays, volume),
    )


further = partial(pytest.param, marks=pytest.mark.integration)
TILTED = (ENVELOPE, (40, 66), 0.03, {"tilt": (0.05, -0.03)})
FEW = (ENVELOPE, (5, 3), 0.02, {"lenses": 1, "pixels": (13, 40)})
CASES = [
    TILTED,
    (RingLight(0.0, 0.4), (40, 33), 0.006, {"lenses": 40}),  # two to three rays on a pixel
    further(RING, (9, 8), 0.21, {}),  # 11 to 15 pixels apart
    further(ENVELOPE, (40, 33), 0.001, {"nearest": True}),  # up to 18 on a pixel
    further(*FEW),
    further(ENVELOPE, (21, 17), 0.05, {"dtype": jnp.float32}),
]


@pytest.mark.parametrize(("weight", "voxels", "pitch", "options"), CASES, ids=str)
def test_both_forms_give_the_same(weight, voxels, pitch, options, monkeypatch):
    monkeypatch.setattr(tiles, "_BAND", 2 * 3 * 32**2)  # several bands of the image
    shapes, *arrays = problem(weight, voxels, pitch, **options)
    single = options.get("dtype") == jnp.float32
    volume, *_, image = same(partial(both_ways, shapes), *arrays, tolerance=2e-6 if single else 1e-12)
    assert volume.any() and image.any()


@pytest.mark.parametrize(("weight", "voxels", "pitch", "options"), [TILTED, further(*FEW)], ids=str)
def test_a_scatter_add_gives_the_same(weight, voxels, pitch, options, monkeypatch):
    monkeypatch.setattr(cuda, "SCATTERS", True)
    shapes, rays, _, volume = problem(weight, voxels, pitch, **options)
    assert same(partial(volume_to_image, shapes), rays, volume, form="cuda").any()


@pytest.mark.integration
@pytest.mark.parametrize(("weight", "voxels", "pitch", "options"), [getattr(c, "values", c) for c in CASES], ids=str)
def test_kernels_of_warp_give_the_same(weight, voxels, pitch, options):
    """Compiled for the processor."""
    pytest.importorskip("warp")
    shapes, *arrays = problem(weight, voxels, pitch, **options | {"dtype": jnp.float32})
    volume, *_, image = same(partial(both_ways, shapes), *arrays, tolerance=2e-6, form="cuda")
    assert volume.any() and image.any()


@pytest.mark.integration
def test_kernels_of_warp_have_derivatives_and_batches():
    pytest.importorskip("warp")
    shapes, rays, image, volume = problem(ENVELOPE, (21, 17), 0.05, dtype=jnp.float32)

    def derivatives(rays, image, volume):
        back = partial(image_to_volume, shapes, rays)
        square = lambda image: jnp.vdot(back(image), back(image)) + jnp.vdot(back(image), volume)
        slope, change = jax.jvp(jax.grad(square), (image,), (jnp.sin(image),))
        batch = jax.vmap(back)((jnp.stack([image, 0.5 * image]) * 65535).astype(jnp.uint16))
        return slope, change, batch

    same(derivatives, rays, image, volume, tolerance=2e-6, form="cuda")


@pytest.mark.integration
def test_kernels_of_warp_in_the_full_model():
    pytest.importorskip("warp")
    imager, grid = test_full.imager(jnp.float32), test_full.grid(jnp.float32)
    optics = field_varying_psf(imager, grid.depths)
    volume, image = (
        np.random.default_rng(0).random(shape, np.float32) for shape in (grid.volume_shape, imager.sensor.shape)
    )

    def both(volume, image):
        made, transpose = jax.vjp(lambda volume: forward(volume, imager, grid, optics), volume)
        return made, transpose(image)

    same(both, volume, image, tolerance=1e-5, form="cuda")


@pytest.mark.parametrize(
    ("has_warp", "scatters", "dtype", "forms"),
    [
        (True, True, np.float32, ("warp", "warp")),
        (True, True, np.float64, ("gather", "add_to_pixels")),
        (False, True, np.float32, ("gather", "add_to_pixels")),
        (False, False, np.float32, ("gather", "scatter")),
    ],
)
def test_which_form_gpus_run(has_warp, scatters, dtype, forms, monkeypatch):
    named = lambda **names: SimpleNamespace(**{key: lambda *_, name=name: name for key, name in names.items()})
    monkeypatch.setattr(cuda, "_load", lambda: named(gather="warp", scatter="warp") if has_warp else None)
    monkeypatch.setattr(cuda, "tiles", named(gather="gather", scatter="scatter", add_to_pixels="add_to_pixels"))
    monkeypatch.setattr(cuda, "SCATTERS", scatters)
    rays = SimpleNamespace(parameters=np.zeros((2, 1), dtype))
    assert (cuda.gather((), rays, None), cuda.scatter((), rays, None)) == forms


def test_a_warp_that_does_not_fit_gives_one_warning(tmp_path, monkeypatch):
    (tmp_path / "warp.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("warp", "gs_jax.projection.warp_kernels"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delattr(sys.modules["gs_jax.projection"], "warp_kernels", raising=False)
    load = cache(cuda._load.__wrapped__)
    with pytest.warns(RuntimeWarning, match="XLA is used instead, which is slower: AttributeError") as warned:
        assert load() is load() is None
    assert len(warned) == 1


@pytest.mark.parametrize("weight", [ENVELOPE, further(RING)], ids=str)
def test_both_forms_give_the_same_gradient(weight):
    """Each lens by itself, more of them than are computed at once. The slope of `cos^4` loses three digits."""
    shapes, *arrays = problem(weight, (21, 17), 0.05, lenses=20)
    gradient = lambda *arrays: (rays_vjp(shapes, *arrays), rays_vjp(shapes, arrays[0], None, arrays[2]))
    same(gradient, *arrays, tolerance=1e-11)


def test_windows_are_added_alike():
    windows, count = Windows((61, 75), 19), 30
    rng = np.random.default_rng(0)
    # Some end beyond the image.
    places = rng.integers(-4, 30, (count, 2)).astype(np.int32), rng.random((count, 2))
    spots = rng.random((windows.side, windows.side, count))
    assert same(partial(interpolate_windows.T, windows), places, spots).any()


@pytest.mark.integration
def test_adjoint_derivatives_and_batches():
    imager, grid = scene(voxels=(6, 5), pitch=0.15)
    image, volume = (
        jax.random.uniform(jax.random.key(n), shape) for n, shape in enumerate((imager.sensor.shape, grid.volume_shape))
    )
    smooth = jnp.sin(jnp.arange(image.size) / 300).reshape(image.shape)
    v = imager.sensor_distance
    at = lambda v: eqx.tree_at(lambda i: i.sensor_distance, imager, v)
    with compiled_for_cpu("accelerated"):
        back = jax.jit(lambda image, v: backproject(image, at(v), grid))
        forth = jax.jit(lambda volume, v: backproject_adjoint(volume, at(v), grid))
        np.testing.assert_allclose(jnp.vdot(back(image, v), volume), jnp.vdot(image, forth(volume, v)), rtol=1e-12)
        # Interpolations have kinks: steps that are small beside a pixel.
        check_grads(back, (smooth, v), 1, eps=1e-6, atol=1e-5, rtol=1e-5)
        check_grads(lambda *both: jnp.vdot(smooth, forth(*both)), (volume, v), 1, eps=1e-6, atol=1e-5, rtol=1e-5)
        batch = jax.jit(jax.vmap(back))(jnp.stack([image, 2 * image]), jnp.stack([0.9 * v, v]))
    np.testing.assert_allclose(batch[1], 2 * backproject(image, imager, grid), rtol=1e-12)


TWO_TYPES_TILTED = {"lens": {"radius_of_curvature_mm": [2.0, 2.06] * 6}, "calibration": {"tilt_deg": (0.6, -0.4)}}


@pytest.mark.integration
@pytest.mark.parametrize(("fidelity", "tables"), [("full", {}), ("near", TWO_TYPES_TILTED)])
def test_the_forward_model_is_the_same(fidelity, tables):
    imager = cropped("geomscope", lenses=12, shape=(300, 280), **tables).imager()
    grid = Grid.over(imager.sensor, depths=[18.0, 20.0], pitch=0.08)
    optics = psf_model(imager, grid, fidelity)
    volume, image = np.random.default_rng(0).random(grid.volume_shape), np.ones(imager.sensor.shape)

    def both(volume, image):
        made, transpose = jax.vjp(lambda volume: forward(volume, imager, grid, optics), volume)
        return made, transpose(image), backproject(made, imager, grid)

    same(both, jnp.asarray(volume), jnp.asarray(image))


def exported(function: Callable, *arguments) -> tuple[int, int]:
    """Loops of the StableHLO program for NVIDIA's GPUs, and those whose number of steps is traced.

    Conditions would go to the host.
    """
    with patch.object(cuda, "_load", lambda: None):
        # A new function, which is lowered anew.
        program = jax.jit(lambda *arguments: function(*arguments))
        text = export.export(program, platforms=["cuda"])(*arguments).mlir_module()
    for operation in ("stablehlo.case", "stablehlo.if", *["stablehlo.scatter"] * (not cuda.SCATTERS)):
        assert operation not in text
    traced = re.findall(r"cond {[^}]*stablehlo.compare +LT, %iterArg\w*, %iterArg", text)
    return text.count("stablehlo.while"), len(traced)


@pytest.mark.parametrize(("scatters", "adjoint"), [(False, (3, 1)), (True, (2, 1))])
def test_projections_for_cuda_have_at_most_one_loop_with_a_traced_number_of_steps(scatters, adjoint, monkeypatch):
    monkeypatch.setattr(cuda, "SCATTERS", scatters)
    imager, grid = scene(jnp.float32)
    image, volume = (np.zeros(shape, np.float32) for shape in (imager.sensor.shape, grid.volume_shape))
    # A form for CPUs changes nothing. Other loops are over groups of depths, bands of the image and groups of lenses.
    with compiled_for_cpu("xla"):
        assert exported(backproject, image, imager, grid) == (2, 1)
    assert exported(backproject_adjoint, volume, imager, grid) == adjoint
    slope = lambda v: jnp.vdot(backproject(image, eqx.tree_at(lambda i: i.sensor_distance, imager, v), grid), volume)
    assert exported(jax.grad(slope), imager.sensor_distance) == (3, 0)


@pytest.mark.integration
def test_the_full_model_for_cuda_has_one_such_loop_for_each_size_of_pixels():
    """Rings are scanned: the inner ones on the sensor's pixels, the outer ones on pixels twice as large."""
    imager, grid = test_full.imager(jnp.float32), test_full.grid(jnp.float32)
    optics = field_varying_psf(imager, grid.depths)
    image, volume = (jnp.zeros(shape, jnp.float32) for shape in (imager.sensor.shape, grid.volume_shape))
    # Images are added to in bands, or at once by scatter-adds.
    loops = (7, 2) if cuda.SCATTERS else (9, 2)
    assert exported(forward, volume, imager, grid, optics) == loops
    adjoint = lambda image, *model: jax.linear_transpose(lambda volume: forward(volume, *model), volume)(image)
    assert exported(adjoint, image, imager, grid, optics) == (9, 2)
