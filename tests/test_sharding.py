"""Several devices of a process, which of a processor are made: the same as one."""

import os
import subprocess
import sys

import numpy as np
import pytest

from .test_cli import folder
from .test_recording import FRAMES, command, save, volumes

pytestmark = pytest.mark.integration

__all__ = ["folder"]

_CODE = """
import sys
import numpy as np, jax
from gs_jax import Grid, read_design, reconstruct
from gs_jax.reconstruction.pipeline import backproject_on_all_devices
from gs_jax.reconstruction.methods import BackProjection

imager = read_design("design.toml").imager()
image = np.random.default_rng(0).uniform(0, 100, imager.sensor.shape).astype(np.float32)
methods = BackProjection(), BackProjection(interpolation="nearest", normalize=True)
for count, method in ((1, methods[0]), (7, methods[1]), (50, methods[0])):
    grid = Grid.over(imager.sensor, depths=np.linspace(18, 22, count), pitch=0.05)
    np.save(f"{sys.argv[1]}-{count}.npy", reconstruct(image, imager, grid, method))
if jax.device_count() > 1:
    volume = backproject_on_all_devices(image, imager, grid.at(grid.depths[:7]))
    assert len(volume.sharding.device_set) == jax.device_count()
print(jax.device_count())
"""


def on(devices: int, *arguments) -> str:
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_depths_on_three_devices(folder):
    """Also where two have none, where they have other numbers, and where there are several rounds."""
    for devices in (1, 3):
        assert on(devices, "-c", _CODE, str(devices)).strip() == str(devices)
    for count in (1, 7, 50):
        one, three = (np.load(folder / f"{devices}-{count}.npy") for devices in (1, 3))
        # Float32: a program of other shapes rounds otherwise.
        np.testing.assert_allclose(three, one, rtol=1e-5, atol=1e-5 * one.max())


def test_a_recording_on_two_devices(folder):
    save("rec.tif", FRAMES[:2])
    for devices in (1, 2):
        on(devices, "-m", "gs_jax", *command("rec.tif", output=f"{devices}.zarr"))
    one, two = volumes("1.zarr"), volumes("2.zarr")
    np.testing.assert_allclose(two, one, rtol=1e-5, atol=1e-5 * one.max())
