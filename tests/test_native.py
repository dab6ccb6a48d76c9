"""The kernels that numba compiles: the same numbers as XLA's, from any thread, and only where they are at hand."""

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from inspect import unwrap
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, backproject_adjoint
from gs_jax.projection import bilinear, convolution as convolve
from gs_jax.projection.bilinear import Shapes
from gs_jax.projection.convolution import Sizes
from gs_jax.projection.cpu import dispatch as native
from gs_jax.projection.rays import Envelope, RingLight, trace

from .helpers import scene

NumbaError = pytest.importorskip("numba.core.errors").NumbaError
bridge, shuffles = (import_module(f"gs_jax.projection.cpu.{name}") for name in ("ffi", "shuffles"))

# Voxels of all sizes, whose rays are 0.4 to 14 pixels apart: sixteen meet up to 32, 48, 64 or more pixels, and a pixel
# is reached by two, four or more. Volumes that are narrower than sixteen; rays off the sensor; a sensor of odd shape.
GRIDS = [((21, 17), 0.05), ((9, 8), 0.21), ((40, 33), 0.006), ((5, 3), 0.02), ((30, 70), 0.02), ((20, 50), 0.04)]
GRIDS += [((40, 66), 0.011)]
WEIGHTS = [Envelope(0.45), RingLight(0.0, 0.4), RingLight(0.3, 0.5)]


def problem(weight, grid=GRIDS[0], *, nearest=False, lenses=5, seed=0):
    rng = np.random.default_rng(seed)
    # Some at the edges, one so far away that nothing is seen through it.
    centers = np.append(rng.uniform(-0.3, 0.3, (lenses, 2)), [[0.2, 0.17], [9.0, 9.0]], axis=0)
    imager = Imager(MicrolensArray(centers), Sensor((96, 83), 0.0045), 5.8, 0.45)
    imager, grid = jax.tree.map(lambda a: a.astype(jnp.float32), (imager, Grid([18.0, 20.0, 23.0], *grid)))
    parameters = None
    if isinstance(weight, RingLight):
        parameters = jnp.asarray(rng.normal(size=(3, 7)), jnp.float32)
    options = dict(nearest=nearest, dtype=jnp.float32, limit=weight.limit, parameters=parameters)
    rays = jax.jit(partial(trace, **options))(imager, grid)
    image = jnp.asarray(rng.random(imager.sensor.shape), jnp.float32)
    volume = jnp.asarray(rng.random(grid.volume_shape), jnp.float32)
    return Shapes(imager.sensor.shape, grid.volume_shape, weight), rays, image, volume


def compared(*calls):
    """Each `(function, shapes, *arrays)` natively, and by XLA in float64: in float32 its derivatives cancel more.

    In one program each: most of the time is XLA's compiler's.
    """
    double = lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a
    given = [arrays for _, _, *arrays in calls]
    functions = [(function, shapes) for function, shapes, *_ in calls]

    def lowered(arrays, of=lambda function: function):
        run = lambda each: [of(f)(shapes, *one) for (f, shapes), one in zip(functions, each, strict=True)]
        return jax.jit(run).lower(arrays)

    ours, plain = lowered(given), lowered(jax.tree.map(double, given), unwrap)
    assert ours.as_text().count(f"@{native.TARGET}(") == len(calls)
    assert native.TARGET not in plain.as_text()
    found, expected = ours.compile()(given), plain.compile()(jax.tree.map(double, given))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert double(a).dtype == b.dtype
        # Sums of both signs: what rounding leaves is seen against the largest.
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6 * float(jnp.abs(b).max()))
    return expected


@pytest.mark.parametrize(
    ("weight", "grid"),
    [*((WEIGHTS[0], grid) for grid in GRIDS), (WEIGHTS[1], GRIDS[0]), (WEIGHTS[2], GRIDS[1])],
    ids=str,
)
def test_all_three_are_those_of_xla(weight, grid):
    shapes, rays, image, volume = problem(weight, grid)
    volumes_and_image = compared(
        (bilinear._gather, shapes, rays, image),
        (bilinear._gather, shapes, rays, None),
        (bilinear._scatter, shapes, rays, volume),
        (bilinear._rays_bar, shapes, rays, image, volume),
        (bilinear._rays_bar, shapes, rays, None, volume),
    )[:3]
    assert all(result.any() for result in volumes_and_image)


@pytest.mark.integration
def test_sums_of_convolutions_are_those_of_xla():
    """And the convolutions of one image: the fourth kernel, of which `test_convolve.py` knows more."""
    rng = np.random.default_rng(0)
    kernels, *sharp = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in [(2, 5, 5), *2 * [(46, 39)]])
    sizes = Sizes((40, 33), (46, 39), whole=False, symmetric=False)
    image = jnp.asarray(rng.normal(size=sizes.image), jnp.float32)
    compared((convolve._convolve, sizes, kernels, tuple(sharp)), (convolve._correlate, sizes, kernels, image))


def test_the_nearest_pixel():
    shapes, rays, image, volume = problem(WEIGHTS[0], nearest=True)
    compared((bilinear._gather, shapes, rays, image), (bilinear._scatter, shapes, rays, volume))


@pytest.mark.parametrize("dtype", [jnp.uint8, jnp.uint16, jnp.int32, jnp.bool_])
def test_pixels_of_other_types(dtype):
    shapes, rays, image, volume = problem(WEIGHTS[0])
    image = (200 * image).astype(dtype)
    compared((bilinear._gather, shapes, rays, image), (bilinear._rays_bar, shapes, rays, image, volume))


def test_nothing_is_seen():
    shapes, rays, image, volume = problem(WEIGHTS[0])
    away = rays._replace(x=rays.x._replace(distance2=jnp.full_like(rays.x.distance2, 1e8)))
    for result in (
        bilinear._gather(shapes, away, image),
        bilinear._scatter(shapes, away, volume),
        *jax.tree.leaves(bilinear._rays_bar(shapes, away, image, volume)),
    ):
        assert not result.any()


def test_adjoint():
    for weight in WEIGHTS:
        shapes, rays, image, volume = problem(weight)
        forth = jnp.vdot(bilinear._scatter(shapes, rays, volume), image)
        np.testing.assert_allclose(jnp.vdot(bilinear._gather(shapes, rays, image), volume), forth, rtol=1e-5)


@pytest.mark.integration
def test_derivatives_in_both_modes_and_batches():
    imager, grid = scene(jnp.float32)
    image = jax.random.uniform(jax.random.key(0), imager.sensor.shape, jnp.float32)
    back = lambda image, v: backproject(image, eqx.tree_at(lambda i: i.sensor_distance, imager, v), grid)
    v = imager.sensor_distance
    weight = jnp.cos(jnp.arange(np.prod(grid.volume_shape), dtype=jnp.float32)).reshape(grid.volume_shape)
    by_v = jax.grad(lambda v: jnp.vdot(weight, back(image, v)))(v)
    forward = jnp.vdot(weight, jax.jvp(lambda v: back(image, v), (v,), (jnp.ones_like(v),))[1])
    np.testing.assert_allclose(by_v, forward, rtol=1e-3)
    batch = jax.vmap(back, (0, None))(jnp.stack([image, 2 * image]), v)
    np.testing.assert_allclose(batch[1], 2 * batch[0], rtol=1e-6)
    (transposed,) = jax.linear_transpose(lambda image: back(image, v), image)(weight)
    np.testing.assert_allclose(transposed, backproject_adjoint(weight, imager, grid), rtol=1e-6, atol=1e-7)


def test_programs_may_run_at_once():
    shapes, rays, image, volume = problem(WEIGHTS[0], GRIDS[4], lenses=40)
    gather = jax.jit(lambda image: bilinear._gather(shapes, rays, image))
    both = jax.jit(lambda image: gather(image).sum() + bilinear._scatter(shapes, rays, volume).sum())
    expected, total = gather(image), both(image)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda number: (both if number % 3 == 0 else gather)(image), range(120)))
    for number, result in enumerate(found):
        # Bit by bit: the order of a voxel's sum is no matter of threads.
        np.testing.assert_array_equal(result, total if number % 3 == 0 else expected)


def test_float64_and_narrow_sensors_are_for_xla():
    imager, grid = scene()
    image = jnp.zeros(imager.sensor.shape)
    assert native.TARGET not in backproject.lower(image, imager, grid).as_text()
    narrow = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((96, 12), 0.0045), 5.8, 0.45)
    narrow, grid = jax.tree.map(lambda a: a.astype(jnp.float32), (narrow, grid))
    assert native.TARGET not in backproject.lower(jnp.zeros((96, 12), jnp.float32), narrow, grid).as_text()


@pytest.fixture
def loading():
    """Kernels are looked up anew, before and after."""
    caches = native._load, native._warn
    for function in caches:
        function.cache_clear()
    yield
    for function in caches:
        function.cache_clear()


def test_without_numba(monkeypatch, loading):
    shapes, rays, image, _ = problem(WEIGHTS[0])
    expected = bilinear._gather(shapes, rays, image)
    native._load.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)  # an import that fails
    assert native.kernel_number("gather") is None
    found = jax.jit(lambda image: bilinear._gather(shapes, rays, image))
    assert native.TARGET not in found.lower(image).as_text()
    np.testing.assert_allclose(found(image), expected, rtol=1e-5, atol=1e-5)


def test_a_numba_that_cannot_compile_the_kernels_is_told_once(monkeypatch, loading):
    def fail(name):
        raise NumbaError(f"No implementation of function\nin {name}")

    monkeypatch.setattr(bridge, "number", fail)
    with pytest.warns(RuntimeWarning, match="XLA is used instead") as said:
        assert [native.kernel_number(name) for name in bridge.KERNELS] == [None] * 4
    assert len(said) == 1 and str(said[0].message).endswith("NumbaError: No implementation of function")


def test_xla_refuses_a_handler_of_a_version_that_it_does_not_know(monkeypatch):
    monkeypatch.setattr(bridge, "TARGET", "gs_jax_later")
    monkeypatch.setattr(bridge, "VERSION", (0, 99))
    with pytest.raises(RuntimeError, match=r"0\.99"):
        bridge._register.__wrapped__()


def comparisons():
    """Of all four kernels."""
    test_all_three_are_those_of_xla(WEIGHTS[0], GRIDS[0])
    test_all_three_are_those_of_xla(WEIGHTS[1], GRIDS[0])
    for dtype in (jnp.uint8, jnp.uint16, jnp.int32, jnp.bool_):
        test_pixels_of_other_types(dtype)
    test_adjoint()
    test_sums_of_convolutions_are_those_of_xla()


@pytest.mark.integration
def test_processors_that_do_not_pick():
    """Without AVX-512 the same numbers, by other ways; in a process of its own, for which numba compiles so."""
    if not shuffles.PICKS:
        pytest.skip("this processor has no AVX-512: the other tests run the kernels without it, and none with it")
    code = "import jax; jax.config.update('jax_enable_x64', True); from tests import test_native as t; "
    code += "assert not t.shuffles.PICKS; t.comparisons()"
    environment, root = os.environ | {"NUMBA_CPU_NAME": "generic"}, Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_numba_is_not_imported_before_it_is_needed():
    code = "import sys, gs_jax; gs_jax.backproject; gs_jax.reconstruct; print('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def fields(name):
    """Places of a structure's fields, in units of 8 bytes, from the header that comes with jaxlib."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    text = re.search(rf"struct XLA_FFI_{name} {{(.*?)\n}};", header, re.DOTALL)
    assert text
    code = re.sub(r"//.*", "", text[1])
    # Structures in structures are as long as they are.
    sizes = {"XLA_FFI_Args": 5, "XLA_FFI_Rets": 5, "XLA_FFI_Attrs": 6, "XLA_FFI_Api_Version": 3}
    places, place = {}, 0
    for kind, field, function in re.findall(r"([\w ]+?[ *]+)(\w+);|_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_(\w+)\)", code):
        places[field or function] = place
        place += sizes.get(kind.strip(), 1)
    return places


def test_the_layout_is_that_of_the_header():
    frame = fields("CallFrame")
    assert (frame["extension_start"], frame["api"]) == (bridge._EXTENSION, bridge._API)
    assert (frame["ctx"], frame["args"], frame["rets"]) == (bridge._CONTEXT, bridge._ARGUMENTS, bridge._RESULTS)
    assert frame["attrs"] + fields("Attrs")["attrs"] == bridge._ATTRIBUTES
    for name, items in (("Args", "args"), ("Rets", "rets")):
        found = fields(name)
        assert (found["size"], found[items]) == (bridge._COUNT, bridge._ITEMS)
    buffer = fields("Buffer")
    assert [buffer[name] for name in ("dtype", "data", "rank", "dims")] == [2, 3, 4, 5]
    api = fields("Api")
    assert [api[name] for name in ("Error_Destroy", "ThreadPool_Schedule", "ThreadPool_NumThreads")] == [
        bridge._ERROR_DESTROY, bridge._SCHEDULE, bridge._THREADS,
    ]  # fmt: skip
    schedule = fields("ThreadPool_Schedule_Args")
    assert [schedule[name] for name in ("ctx", "task", "data")] == [2, 3, 4]
    assert fields("ThreadPool_NumThreads_Args")["num_threads"] == 3
    assert fields("Error_Destroy_Args")["error"] == 2
    assert fields("Metadata")["api_version"] == 1
