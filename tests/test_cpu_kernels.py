"""The kernels that numba compiles: the same numbers as XLA's, from any thread, and only where numba works."""

import ctypes
import mmap
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject
from gs_jax.linear.sparse_table import SparseTable
from gs_jax.projection.bilinear import Shapes, image_to_volume, rays_vjp, volume_to_image
from gs_jax.projection.convolution import Sizes, sum_of_convolutions
from gs_jax.projection.cpu import loading
from gs_jax.projection.rays import OUTSIDE, Envelope, RingLight
from gs_jax.projection.stray_light import Windows, add_products, angular_spectra, interpolate_windows

from .helpers import scene, trace_rays

numba = pytest.importorskip("numba")
NumbaError = pytest.importorskip("numba.core.errors").NumbaError
config, types = import_module("numba.core.config"), import_module("numba.types")
dispatch, ffi, rows, simd = (
    import_module(f"gs_jax.projection.cpu.{name}") for name in ("dispatch", "ffi", "rows", "simd")
)
ROOT = Path(__file__).parents[1]

# Voxels of all sizes, whose rays are 0.4 to 14 pixels apart: sixteen meet up to 32, 48, 64 or more pixels, and a pixel
# is reached by two, four or more. Volumes that are narrower than sixteen; rays off the sensor; a sensor of odd shape.
GRIDS = [((21, 17), 0.05), ((9, 8), 0.21), ((40, 33), 0.006), ((5, 3), 0.02), ((30, 70), 0.02), ((20, 50), 0.04)]
GRIDS += [((40, 66), 0.011)]
WEIGHTS = [Envelope(0.45), RingLight(0.0, 0.4), RingLight(0.3, 0.5)]


@cache
def problem(weight, grid=GRIDS[0], *, nearest=False, lenses=5):
    rng = np.random.default_rng(0)
    # Some at the edges, one so far away that nothing is seen through it.
    centers = np.append(rng.uniform(-0.3, 0.3, (lenses, 2)), [[0.2, 0.17], [9.0, 9.0]], axis=0)
    imager = Imager(MicrolensArray(centers), Sensor((96, 83), 0.0045), 5.8, 0.45)
    imager, grid = jax.tree.map(lambda a: np.asarray(a, np.float32), (imager, Grid([18.0, 20.0, 23.0], *grid)))
    parameters = rng.normal(size=(3, 7)).astype(np.float32) if isinstance(weight, RingLight) else None
    rays = trace_rays(
        imager, grid, nearest=nearest, dtype=jnp.float32, weight=weight, limit=weight.limit, parameters=parameters
    )
    image = rng.random(imager.sensor.shape).astype(np.float32)
    volume = rng.random(grid.volume_shape).astype(np.float32)
    return Shapes(imager.sensor.shape, grid.volume_shape), jax.tree.map(np.asarray, rays), image, volume


def doubled(tree):
    return jax.tree.map(lambda a: a.astype(np.float64) if a.dtype == np.float32 else a, tree)


@cache
def program(function, static, tree, arrays):
    """`function(static, *arrays)` of arrays of these shapes, compiled; by kernels unless some are float64."""
    lowered = jax.jit(function, static_argnums=0).lower(static, *tree.unflatten(arrays))
    calls = lowered.as_text().count(f"@{dispatch.TARGET}(")
    assert calls == (0 if any(array.dtype == jnp.float64 for array in arrays) else len(lowered.out_info))
    return lowered.compile()


def run(function, static, *arrays):
    leaves, tree = jax.tree.flatten(arrays)
    structures = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
    return jax.tree.map(np.asarray, program(function, static, tree, structures)(*arrays))


def all_three(shapes, rays, image, volume):
    """Back-projection, its adjoint and its gradient. Most of the time is XLA's compiler's, so they are one program."""
    volumes = image_to_volume(shapes, rays, image), image_to_volume(shapes, rays, None)
    gradients = rays_vjp(shapes, rays, image, volume), rays_vjp(shapes, rays, None, volume)
    return *volumes, volume_to_image(shapes, rays, volume), *gradients


def by_xla(shapes, rays, image, volume):
    """`all_three` without kernels, in float64: in float32 its derivatives cancel more.

    Of a larger volume and larger patches, in which the voxels that are added are dark: one program for all grids.
    """
    added = [(0, 0), *((0, room - n) for n, room in zip(volume.shape[1:], (80, 140), strict=True))]

    def pad(axis, size):
        more = [(0, 0), (0, 0), (0, size - axis.pixel.shape[-1])]
        pixel, fraction = (np.pad(a, more, mode="edge") for a in (axis.pixel, axis.fraction))
        return axis._replace(
            pixel=pixel, fraction=fraction, distance2=np.pad(axis.distance2, more, constant_values=OUTSIDE)
        )

    wide = rays._replace(y=pad(rays.y, 40), x=pad(rays.x, 70))
    shapes = shapes._replace(volume=(len(volume), 80, 140))
    results = run(all_three, shapes, *doubled((wide, image, np.pad(volume, added))))

    def crop(a, like):
        return a[tuple(map(slice, like.shape))] if np.ndim(a) == np.ndim(like) == 3 else a

    volumes, gradients = [crop(a, volume) for a in results[:2]], results[3:]
    return *volumes, results[2], *(jax.tree.map(crop, gradient, rays) for gradient in gradients)


def same(results, expected):
    for a, b in zip(jax.tree.leaves(results), jax.tree.leaves(expected), strict=True):
        assert doubled(a).dtype == b.dtype and a.shape == b.shape
        # Sums of both signs: rounding is relative to the largest.
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6 * np.abs(b).max())


# Angles around a lens: powers of two, and three times such.
ANGLES = (16, 24)


def maps_of_stray_light(windows, places, image, values, tables, x, y, constants, parts, z):
    read, added = interpolate_windows(windows, places, image), interpolate_windows.T(windows, places, values)
    spectra = [angular_spectra(n, table, x) for n, table in zip(ANGLES, tables, strict=True)]
    back = [angular_spectra.T(n, table, own) for n, table, own in zip(ANGLES, tables, y, strict=True)]
    sums, products = add_products((), constants, parts), add_products.T((), constants, z)[1]
    return read, added, *spectra, *back, sums, products


def test_maps_of_stray_light_are_those_of_xla():
    rng = np.random.default_rng(0)
    windows, lenses = Windows((61, 75), 19), 29  # no multiple of sixteen
    # Some end beyond the image.
    start = rng.integers(-4, 30, (lenses, 2)).astype(np.int32)
    image = rng.random(windows.shape)
    values = rng.random((windows.side, windows.side, lenses))
    matrices, tables, y = [], [], []
    for angles, fields in zip(ANGLES, (5, 4), strict=True):
        row, column, share = rng.integers(0, angles * fields, 400), rng.integers(0, 90, 400), rng.random(400)
        row[:60] = 7
        tables.append(SparseTable.of(0, row, column, share, (angles * fields, 90)))
        matrices.append(np.zeros((angles * fields, 90)))
        np.add.at(matrices[-1], (row, column), share)
        y.append(rng.random((angles + 2, fields, lenses)))
    x, excess = rng.random((90, lenses)), rng.random(lenses)
    table = rng.random((2, 3, 2, 10, 8)) * (rng.random((2, 3, 2, 10, 1)) > 0.7)
    parts = rng.random((6, 16, lenses)), rng.random((6, 5, lenses))
    constants = table, np.int32(1), excess
    arrays = (start, rng.random((lenses, 2))), image, values, tables, x, y, constants, parts, rng.random(parts[0].shape)
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, arrays)
    same(run(maps_of_stray_light, windows, *single), expected := run(maps_of_stray_light, windows, *doubled(single)))
    read, _, *spectra, _, _, sums, _ = expected
    for angles, matrix, found in zip(ANGLES, matrices, spectra, strict=True):
        spectrum = np.fft.rfft((matrix @ x).reshape(angles, -1, lenses), axis=0)
        np.testing.assert_allclose(found[::2], spectrum.real, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(found[1::2], spectrum.imag, rtol=1e-5, atol=1e-5)
    mean, change = np.split(table[1].transpose(0, 1, 3, 2).reshape(3, 16, 10), 2, -1)
    imaginary = mean @ parts[1][1::2] + change @ (excess * parts[1][1::2])
    np.testing.assert_allclose(sums[1::2] - parts[0][1::2], imaginary, rtol=1e-5, atol=1e-5)
    dark = ((start < 0) | (start + 20 > np.subtract(windows.shape, 16))).any(1)
    assert 0 < dark.sum() < lenses and not read[..., dark].any() and read[..., ~dark].all()


@pytest.mark.parametrize(
    ("weight", "grid"),
    [*((WEIGHTS[0], grid) for grid in GRIDS), (WEIGHTS[1], GRIDS[0]), (WEIGHTS[2], GRIDS[1])],
    ids=str,
)
def test_all_three_are_those_of_xla(weight, grid):
    shapes, rays, image, volume = problem(weight, grid)
    results = run(all_three, shapes, rays, image, volume)
    same(results, by_xla(shapes, rays, image, volume))
    back, light, forth, *_ = results
    assert back.any() and light.any() and forth.any()
    # They are adjoint, too.
    np.testing.assert_allclose(np.vdot(back, volume), np.vdot(forth, image), rtol=1e-5)


def test_the_nearest_pixel():
    arguments = problem(WEIGHTS[0], nearest=True)
    same(run(all_three, *arguments), by_xla(*arguments))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.bool_])
def test_pixels_of_other_types(dtype):
    shapes, rays, image, volume = problem(WEIGHTS[0])
    image = (200 * image).astype(dtype)
    same(run(all_three, shapes, rays, image, volume), by_xla(shapes, rays, image.astype(np.float32), volume))


class GuardedMemory:
    """Arrays between pages that no one may touch: after the end of the one half, before the begin of the other."""

    def __init__(self):
        self.maps = []

    def copy(self, array, at_end: bool) -> np.ndarray:
        page, size = mmap.PAGESIZE, max(array.nbytes, 1)
        inner = -(-size // page) * page
        memory = mmap.mmap(-1, inner + 2 * page)
        start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        for guard in (start, start + page + inner):
            assert ctypes.CDLL(None, use_errno=True).mprotect(ctypes.c_void_p(guard), page, 0) == 0
        offset = page + (inner - array.nbytes if at_end else 0)
        own = np.frombuffer(memory, array.dtype, array.size, offset).reshape(array.shape)
        own[...] = array
        self.maps.append((memory, own))
        return own


def run_guarded(kernel, results, *buffers, at_end: bool):
    """`dispatch._call` without XLA, part by part: whatever is read or written beyond an array ends the process."""
    memory, many = GuardedMemory(), isinstance(results, list | tuple)
    given = [np.asarray(dispatch._as_buffer(kernel, buffer)) for buffer in buffers]
    empty = [np.full(result.shape, np.nan, np.float32) for result in (results if many else [results])]
    arrays = [memory.copy(array, at_end) for array in (*given, *empty)]
    job = np.zeros(rows.BUFFERS + rows.PER_BUFFER * len(arrays), np.int64)
    job[rows.PARTS] = 5
    dispatch._register()
    job[rows.ALLOCATE], job[rows.FREE] = dispatch._table[[ffi.ALLOCATE, ffi.FREE]]
    kinds = {"bool": simd.BOOL, "uint8": simd.UINT8, "uint16": simd.UINT16}
    for number, array in enumerate(arrays):
        sizes = (*array.shape, 1, 1, 1)[:3]
        place = rows.BUFFERS + rows.PER_BUFFER * number
        job[place : place + rows.PER_BUFFER] = array.ctypes.data, kinds.get(array.dtype.name, 0), *sizes
    compiled = dispatch._compile(dispatch.KERNELS[kernel], numba.types.int64, 2)
    run = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(compiled.address)
    assert all(run(job.ctypes.data, part) == rows.DONE for part in range(5)), kernel
    found = [jnp.asarray(array.copy()) for array in arrays[len(given) :]]
    return found if many else found[0]


def wild(rays, seed):
    """Rays of no geometry: patches beyond the volume, pixels in any order, distances that are NaN."""
    rng = np.random.default_rng(seed)

    def axis(some):
        start = rng.integers(-3000, 3000, some.start.shape).astype(np.int32)
        low, high = ((-200, 300), (0, 80))[seed % 2]
        pixel = rng.integers(low, high, some.pixel.shape).astype(np.int32)
        if seed % 3 == 0:
            pixel.sort(-1)  # they rise, as behind the lenses
        distance2 = np.where(rng.random(some.distance2.shape) < 0.1, np.nan, some.distance2)
        return some._replace(start=start, pixel=pixel, distance2=distance2.astype(np.float32))

    return rays._replace(y=axis(rays.y), x=axis(rays.x))


def run_all_guarded():
    """Every kernel, over sizes that fill no vector, beside pages that end the process when they are touched."""
    rng = np.random.default_rng(0)
    some = lambda *shape: rng.random(shape).astype(np.float32)
    grids = (WEIGHTS[0], GRIDS[0]), (WEIGHTS[0], GRIDS[3]), (WEIGHTS[2], GRIDS[4])
    problems = [problem(weight, grid, lenses=2) for weight, grid in grids]
    for at_end in (True, False):
        vars(dispatch)["_call"] = partial(run_guarded, at_end=at_end)
        for seed, (shapes, rays, image, volume) in enumerate(problems):
            for own in (rays, *(wild(rays, 6 * seed + n) for n in range(6))):
                for pixels in (image, (255 * image).astype(np.uint8), None):
                    dispatch.gather(shapes, own, pixels)
                    dispatch.rays_vjp(shapes, (own, pixels), volume)
                dispatch.scatter(shapes, own, volume)
        for lenses in (1, 16, 35):
            windows = Windows((61, 75), 19)
            places = rng.integers(-50, 90, (lenses, 2)).astype(np.int32), some(lenses, 2)
            dispatch.read_windows(windows, places, some(*windows.shape))
            dispatch.add_windows(windows, places, some(19, 19, lenses))
            row, column, share = rng.integers(0, 72, 400), rng.integers(0, 90, 400), some(400)
            table = SparseTable.of(0, row, column, share, (72, 90))
            dispatch.to_spectra(24, table, some(90, lenses))
            dispatch.from_spectra(24, table, some(26, 3, lenses))
            constants, total = (some(2, 3, 2, 10, 8), np.int32(1), some(lenses)), some(6, 16, lenses)
            dispatch.add_products((), constants, (total, some(6, 5, lenses)))
            dispatch.products_back((), constants, total)
        for size, shape in ((9, (61, 75)), (41, (150, 333))):
            for whole in (False, True):
                change, (tall, wide) = size - 1 if whole else -size - 1, (n + size + 1 for n in shape)
                sizes = Sizes((tall + change, wide + change), (tall, wide), whole, symmetric=False)
                sharp = [some(*sizes.sharp) for _ in range(2)]
                dispatch.convolve(sizes, some(2, size, size), sharp)
                dispatch.correlate(sizes, some(2, size, size), some(*sizes.image))


@pytest.mark.skipif(sys.platform == "win32", reason="pages are protected by mprotect")
def test_no_kernel_reads_or_writes_beyond_an_array():
    """In a process of its own, which a fault ends."""
    code = "from tests.test_cpu_kernels import run_all_guarded; run_all_guarded(); print('whole')"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "whole"), done.stderr[-3000:]


def test_sizes_that_do_not_fit_are_refused():
    shapes, rays, image, volume = problem(WEIGHTS[0])
    entries = np.array([0, 1]), np.array([0, 9]), np.ones(2)
    table = SparseTable.of(0, *entries, (4, 10))
    for call in (
        lambda: dispatch.gather(shapes, rays, image[:-1]),
        lambda: dispatch.scatter(shapes, rays, volume[:, :-1]),
        lambda: dispatch.rays_vjp(shapes, (rays, image), volume[:2]),
        lambda: dispatch.gather(shapes._replace(volume=(3, 5, 5)), rays, image),
        lambda: dispatch.gather(shapes, rays._replace(parameters=rays.parameters[:2]), image),
        lambda: dispatch.to_spectra(4, table, np.ones((9, 16))),
        lambda: dispatch.from_spectra(5, table, np.ones((6, 1, 16))),
        lambda: dispatch.products_back((), (np.ones((1, 3, 1, 2, 8)), np.int32(0), np.ones(4)), np.ones((6, 9, 4))),
        lambda: dispatch.read_windows(Windows((61, 75), 19), (np.zeros((3, 2)), np.zeros((2, 2))), image),
    ):
        with pytest.raises(ValueError, match="must fit each other"):
            call()
    with pytest.raises(ValueError, match="entries must lie within 2 x 9"):
        SparseTable.of(0, *entries, (2, 9))


def test_a_job_of_many_images():
    """More buffers than a job had room for: 60 images, each with its kernel."""
    rng = np.random.default_rng(0)
    sharp, kernels = list(rng.random((60, 20, 21)).astype(np.float32)), rng.random((60, 3, 3)).astype(np.float32)
    convolve = jax.jit(sum_of_convolutions)
    found = convolve(sharp, kernels)
    one = [convolve([image], kernel[None]) for image, kernel in zip(sharp, kernels, strict=True)]
    np.testing.assert_allclose(found, sum(one[1:], one[0]), rtol=1e-5)


def test_memory_that_is_not_there_is_an_error():
    """Of the job, and of a kernel's scratch: the kernel then returns 0."""
    shapes, rays, image, _ = problem(WEIGHTS[0])
    gather = jax.jit(lambda image: image_to_volume(shapes, rays, image))
    expected = gather(image)
    nothing = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(lambda _: 0)
    address = ctypes.cast(nothing, ctypes.c_void_p).value
    for place in (ffi.ALLOCATE, ffi.FIRST_KERNEL + dispatch._number("gather")):
        before, dispatch._table[place] = dispatch._table[place], address
        try:
            with pytest.raises(Exception, match="no memory for a kernel"):
                gather(image).block_until_ready()
        finally:
            dispatch._table[place] = before
    np.testing.assert_array_equal(gather(image), expected)


def test_nothing_is_seen():
    shapes, rays, image, volume = problem(WEIGHTS[0])
    away = rays._replace(x=rays.x._replace(distance2=np.full_like(rays.x.distance2, 1e8)))
    assert not any(result.any() for result in jax.tree.leaves(run(all_three, shapes, away, image, volume)))


def test_programs_may_run_at_once():
    shapes, rays, image, volume = problem(WEIGHTS[0], GRIDS[4], lenses=40)
    gather = jax.jit(lambda image: image_to_volume(shapes, rays, image))
    both = jax.jit(lambda image: gather(image).sum() + volume_to_image(shapes, rays, volume).sum())
    expected, total = gather(image), both(image)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda number: (both if number % 3 == 0 else gather)(image), range(120)))
    for number, result in enumerate(results):
        # Bit by bit: threads do not change the order of a voxel's sum.
        np.testing.assert_array_equal(result, total if number % 3 == 0 else expected)


def test_float64_and_narrow_sensors_are_for_xla():
    imager, grid = scene()
    image = jnp.zeros(imager.sensor.shape)
    assert dispatch.TARGET not in backproject.lower(image, imager, grid).as_text()
    low = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32), tree)
    assert dispatch.TARGET not in backproject.lower(image, low(imager), low(grid), normalize=True).as_text()
    narrow = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((96, 12), 0.0045), 5.8, 0.45)
    assert dispatch.TARGET not in backproject.lower(jnp.zeros((96, 12), jnp.float32), low(narrow), low(grid)).as_text()


@pytest.fixture
def loading_anew():
    """Kernels are loaded anew, before and after."""
    caches = loading._load, loading._warn
    for function in caches:
        function.cache_clear()
    yield
    for function in caches:
        function.cache_clear()


def test_without_numba(monkeypatch, loading_anew):
    shapes, rays, image, volume = problem(WEIGHTS[0])
    expected = run(all_three, shapes, rays, image, volume)[0]
    loading._load.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)  # an import that fails
    assert loading.cpu_kernel("gather") is None
    gather = jax.jit(lambda image: image_to_volume(shapes, rays, image))
    assert dispatch.TARGET not in gather.lower(image).as_text()
    np.testing.assert_allclose(gather(image), expected, rtol=1e-5, atol=1e-5)


def test_a_numba_that_cannot_compile_the_kernels_gives_one_warning(monkeypatch, loading_anew):
    def fail(name):
        raise NumbaError(f"No implementation of function\nin {name}")

    monkeypatch.setattr(dispatch, "load", fail)
    with pytest.warns(RuntimeWarning, match="XLA is used instead") as warned:
        assert [loading.cpu_kernel(name) for name in dispatch.KERNELS] == [None] * len(dispatch.KERNELS)
    assert len(warned) == 1 and str(warned[0].message).endswith("NumbaError: No implementation of function")


def test_xla_refuses_a_handler_of_a_version_that_it_does_not_know(monkeypatch):
    monkeypatch.setattr(dispatch, "TARGET", "gs_jax_later")
    monkeypatch.setattr(dispatch, "VERSION", (0, 99))
    with pytest.raises(RuntimeError, match=r"0\.99"):
        dispatch._register.__wrapped__()


def comparisons():
    """Of all four kernels."""
    test_all_three_are_those_of_xla(WEIGHTS[0], GRIDS[0])
    test_all_three_are_those_of_xla(WEIGHTS[1], GRIDS[0])
    for dtype in (np.uint8, np.uint16, np.int32, np.bool_):
        test_pixels_of_other_types(dtype)


@pytest.mark.integration
def test_processors_without_avx512():
    """The same numbers in other ways; in a process of its own, for which numba compiles so."""
    if not simd.HAS_AVX512:
        pytest.skip("this processor has no AVX-512: the other tests run the kernels without it, and none with it")
    code = "import jax; jax.config.update('jax_enable_x64', True); from tests import test_cpu_kernels as t; "
    code += "assert not t.simd.HAS_AVX512; t.comparisons(); from tests import test_convolve as c; c.comparisons()"
    environment = os.environ | {"NUMBA_CPU_NAME": "generic"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_numba_and_warp_are_not_imported_before_they_are_needed():
    code = "import sys, gs_jax; gs_jax.backproject; gs_jax.reconstruct; print({'numba', 'warp'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "set()"


def fields(name):
    """Places of a structure's fields, in units of 8 bytes, from the header that comes with jaxlib."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    text = re.search(rf"struct XLA_FFI_{name} {{(.*?)\n}};", header, re.DOTALL)
    assert text
    code = re.sub(r"//.*", "", text[1])
    # Lengths of structures in structures.
    sizes = {"XLA_FFI_Args": 5, "XLA_FFI_Rets": 5, "XLA_FFI_Attrs": 6, "XLA_FFI_Api_Version": 3}
    places, place = {}, 0
    for kind, field, function in re.findall(r"([\w ]+?[ *]+)(\w+);|_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_(\w+)\)", code):
        places[field or function] = place
        place += sizes.get(kind.strip(), 1)
    return places


def test_the_layout_is_that_of_the_header():
    places = lambda structure, *names: tuple(fields(structure)[name] for name in names)
    assert places("CallFrame", "extension_start", "api") == (ffi.EXTENSION, ffi.API)
    assert places("CallFrame", "ctx", "args", "rets") == (ffi.CONTEXT, ffi.ARGUMENTS, ffi.RESULTS)
    assert sum(places("CallFrame", "attrs") + places("Attrs", "attrs")) == ffi.ATTRIBUTES
    for name, items in (("Args", "args"), ("Rets", "rets")):
        assert places(name, "size", items) == (ffi.COUNT, ffi.ITEMS)
    assert places("Buffer", "dtype", "data", "rank", "dims") == (2, 3, 4, 5)
    functions = places("Api", "Error_Destroy", "ThreadPool_Schedule", "ThreadPool_NumThreads")
    assert functions == (ffi.ERROR_DESTROY, ffi.SCHEDULE, ffi.THREADS)
    assert places("ThreadPool_Schedule_Args", "ctx", "task", "data") == (2, 3, 4)
    assert places("ThreadPool_NumThreads_Args", "num_threads") == places("Buffer", "data")
    assert places("Error_Destroy_Args", "error") == (2,)
    assert places("Metadata", "api_version") == (1,)


@pytest.mark.parametrize("damage", [lambda data: data[:60], lambda data: b"", lambda data: b"no index"])
def test_a_damaged_cache_of_numba_is_named_and_left_aside(tmp_path, monkeypatch, damage):
    """The smallest function stands for all kernels."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    function = lambda: dispatch._compile.__wrapped__(ffi.task, types.int64, 1).address
    assert function()
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(damage(index.read_bytes()))
    with pytest.warns(RuntimeWarning, match=f"cache is damaged.*delete {index.parent}"):
        assert function()
