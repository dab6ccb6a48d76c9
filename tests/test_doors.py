"""What enters the library: arrays of any byte order, files, which execute nothing, and variables of JAX."""

import json
import os
import pickle
import subprocess
import sys

import equinox as eqx
import jax
import numpy as np
import pytest
from jax import disable_jit

import gs_jax as gs
from gs_jax.base.errors import InputError
from gs_jax.interop import as_scipy
from gs_jax.io.recordings import open_recording
from gs_jax.optics.aberrations import wavefront_rms
from gs_jax.projection.bilinear import image_to_volume
from gs_jax.projection.point_sources import forward_points, make_stamps
from gs_jax.projection.rays import Shapes

from .helpers import trace_rays

SCOPE = gs.Imager(gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]]), gs.Sensor((64, 64), 0.06), 5.8, 3.0)
GRID = gs.Grid.over(SCOPE.sensor, depths=[18.0, 22.0], pitch=0.4)
RANDOM = np.random.default_rng(0)
IMAGE = RANDOM.integers(0, 60_000, SCOPE.sensor.shape).astype(np.uint16)
VOLUME = RANDOM.random(GRID.volume_shape).astype(np.float32)
POINTS = np.array([[0.2, -0.1, 20.0, 1.0], [0.5, 0.3, 19.0, 2.0]])
SPOT = RANDOM.random((9, 9)).astype(np.float32)
STACK = np.stack([SPOT, SPOT])
A, B = gs.ImagingOperator(SCOPE, GRID), gs.BackprojectionOperator(SCOPE, GRID)
C = gs.ConvolutionOperator(STACK, SCOPE.sensor.shape)
STEPS = gs.RichardsonLucy(steps=1)

# By name: what is given, and the function that takes it.
CALLS = {
    "backproject": (IMAGE, lambda image: gs.backproject(image, SCOPE, GRID)),
    "backproject float32": (IMAGE.astype(np.float32), lambda image: gs.backproject(image, SCOPE, GRID)),
    "backproject_adjoint": (VOLUME, lambda volume: gs.backproject_adjoint(volume, SCOPE, GRID)),
    "forward": (VOLUME, lambda volume: gs.forward(volume, SCOPE, GRID)),
    "forward, its PSFs": (STACK, lambda psf: gs.forward(VOLUME, SCOPE, GRID, psf)),
    "ImagingOperator": (VOLUME, A.mv),
    "ImagingOperator.T": (IMAGE.astype(np.float64), A.T.mv),
    "BackprojectionOperator": (IMAGE, B.mv),
    "ConvolutionOperator": (STACK, lambda psf: gs.ConvolutionOperator(psf).spectra),
    "ConvolutionOperator.mv": (np.ones(C.scene_shape), C.mv),
    "ConvolutionOperator.T": (IMAGE.astype(np.float32), C.T.mv),
    "as_scipy": (VOLUME.ravel(), lambda volume: as_scipy(A).matvec(volume)),
    "solve": (IMAGE, lambda image: gs.solve(A, image, STEPS).value),
    "reconstruct": (IMAGE, lambda image: gs.reconstruct(image, SCOPE, GRID)),
    "reconstruct, steps": (IMAGE, lambda image: gs.reconstruct(image, SCOPE, GRID, STEPS, optics="pinhole")),
    "reconstruct, its PSFs": (STACK, lambda psf: gs.reconstruct(IMAGE, SCOPE, GRID, STEPS, optics=psf)),
    "deconvolve": (IMAGE, lambda image: gs.deconvolve(image, SPOT, gs.FISTA(steps=1))),
    "deconvolve, its PSFs": (SPOT, lambda psf: gs.deconvolve(IMAGE, psf, gs.FISTA(steps=1))),
    "find_points": (IMAGE, lambda image: gs.find_points(image, SCOPE, GRID)),
    "suppress": (VOLUME, gs.suppress),
    "forward_residual": (IMAGE, lambda image: gs.forward_residual(VOLUME, image, SCOPE, GRID, optics="pinhole").error),
    "quality": (VOLUME, lambda volume: gs.quality(volume, VOLUME[::-1])),
    "rasterize": (POINTS, lambda points: gs.rasterize(points, GRID)),
    "simulate": (POINTS, lambda points: gs.simulate(points, SCOPE, optics="near", psf="geometric")),
    "expose": (IMAGE / 1.0, lambda image: gs.expose(image, gs.Camera(), jax.random.key(0), peak_electrons=100.0)),
    "magnification": (GRID.depths, lambda depths: SCOPE.magnification(depths)),
    "wavefront_rms": (np.array(20.0), lambda depth: wavefront_rms(SCOPE, depth)),
    "Grid": (np.array([18.0, 20.0]), lambda depths: gs.Grid(depths, (3, 3), 0.1).depths),
    "MicrolensArray": (np.array([[1.0, 20.0]]), lambda centers: gs.MicrolensArray(centers).centers),
}


# Those that compile more than they compute.
SLOW = ("reconstruct, steps", "reconstruct, its PSFs", "find_points", "suppress", "forward_residual", "simulate")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.integration if name in SLOW else ()) for name in CALLS]
)
def test_either_byte_order(name):
    """As files and cameras give them; before a compiled function has seen the native type, and after."""
    array, call = CALLS[name]
    array = np.asarray(array)
    foreign = array.astype(array.dtype.newbyteorder())
    assert not foreign.dtype.isnative
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        first, native, after = call(foreign), call(array), call(foreign)
    for found in (first, after):
        assert jax.tree.structure(found) == jax.tree.structure(native)
        for ours, expected in zip(jax.tree.leaves(found), jax.tree.leaves(native), strict=True):
            np.testing.assert_array_equal(ours, expected)


class Payload:
    """Unpickling it runs `print`."""

    def __reduce__(self):
        return print, ("executed",)


@pytest.mark.parametrize("where", ["filters", "compressor"])
@pytest.mark.parametrize("dtype", ["|O", "<f4"])
def test_a_zarr_of_pickles_is_refused(where, dtype, tmp_path, capsys):
    pytest.importorskip("zarr")
    image = tmp_path / "image.zarr"
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    transforms = [{"type": "scale", "scale": [100, 50, 50]}, {"type": "translation", "translation": [18_000, 0, 0]}]
    datasets = [{"path": "0", "coordinateTransformations": transforms}]
    codec = {"id": "pickle", "protocol": 5}
    array = {"zarr_format": 2, "shape": [1, 8, 8], "chunks": [1, 8, 8], "dtype": dtype, "fill_value": 0, "order": "C"}
    array |= {"filters": None, "compressor": None} | {where: [codec] if where == "filters" else codec}
    (image / "0").mkdir(parents=True)
    (image / ".zgroup").write_text('{"zarr_format": 2}')
    (image / ".zattrs").write_text(
        json.dumps({"multiscales": [{"version": "0.4", "axes": axes, "datasets": datasets}]})
    )
    (image / "0" / ".zarray").write_text(json.dumps(array))
    (image / "0" / "0.0.0").write_bytes(pickle.dumps(Payload()))
    with pytest.raises(InputError, match="image.zarr"):
        gs.read_volume(image)
    with pytest.raises(InputError, match="image.zarr"), open_recording(image, axes="tz") as recording:
        assert recording
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize("platform", ["cuda", pytest.param("nonsense", marks=pytest.mark.integration)])
def test_a_platform_that_jax_does_not_have(platform):
    """JAX itself fails by a bare AssertionError, or by several lines."""
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("JAX has a GPU here")
    command, environment = [sys.executable, "-m", "gs_jax", "info"], os.environ | {"JAX_PLATFORMS": platform}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("gs-jax: JAX_PLATFORMS must be ") and done.stderr.endswith(f"got {platform}.\n")
    assert done.stderr.count("\n") == 1


def test_points_without_a_processor_among_the_devices(monkeypatch):
    """As with `JAX_PLATFORMS=cuda`, which leaves the processor out."""
    asked, devices = [], jax.devices

    def without_processor(platform=None):
        asked.append(platform)
        if platform == "cpu":
            raise RuntimeError("Unknown backend cpu")
        return devices()

    stamps = make_stamps(np.array([20.0]), np.ones((1, 15, 15)))
    expected = forward_points(POINTS, SCOPE, stamps)
    monkeypatch.setattr(jax, "devices", without_processor)
    np.testing.assert_array_equal(forward_points(POINTS, SCOPE, stamps), expected)
    assert "cpu" in asked


def test_without_compilation():
    """`JAX_DISABLE_JIT`: a primitive that calls itself would never end."""
    rays = trace_rays(SCOPE, GRID, nearest=False, dtype=np.dtype(np.float64))
    shapes = Shapes(SCOPE.sensor.shape, GRID.volume_shape)
    with disable_jit():
        volume = image_to_volume(shapes, rays, IMAGE)
    np.testing.assert_allclose(volume, gs.backproject(IMAGE, SCOPE, GRID), rtol=1e-5, atol=1e-5 * np.max(volume))


@pytest.mark.integration
def test_a_call_without_compilation():
    """All of it, one operation after the other."""
    with jax.numpy_dtype_promotion("standard"):
        expected = gs.backproject(IMAGE, SCOPE, GRID)
        with disable_jit():
            volume = gs.backproject(IMAGE, SCOPE, GRID)
    np.testing.assert_allclose(volume, expected, rtol=1e-5, atol=1e-5 * float(expected.max()))


def test_a_nan_that_was_put_into_a_module_is_named():
    """`eqx.tree_at` makes modules without their checks; NaNs would end as dark images."""
    lost = eqx.tree_at(lambda i: i.array.centers, SCOPE, SCOPE.array.centers.at[1, 0].set(np.nan))
    nowhere = eqx.tree_at(lambda g: g.depths, GRID, GRID.depths.at[0].set(np.nan))
    for call in (
        lambda: gs.backproject(IMAGE, lost, GRID),
        lambda: gs.forward(np.ones(GRID.volume_shape), lost, GRID),
    ):
        with pytest.raises(gs.InputError, match=r"Imager.array.centers must be numbers, got 1 NaN"):
            call()
    with pytest.raises(gs.InputError, match=r"Grid.depths must be numbers, got 1 NaN"):
        gs.backproject_adjoint(np.ones(GRID.volume_shape), SCOPE, nowhere)
