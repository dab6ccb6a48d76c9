# %% [markdown]
# # GPU and cluster
#
# The same program runs on one core, on all cores of a machine, on a GPU, and on many machines, without changes to
# the script.

# %%
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import zarr
from matplotlib import pyplot as plt

import gs_jax as gs

PIXELS = (400, 800, 1600)  # of each side of the sensor
FRAMES = 4

# %% [markdown]
# ## Devices
#
# `pip install '.[gpu]'` installs JAX for NVIDIA GPUs, best [on Python 3.12 or newer](../install.md#gpu). JAX uses
# a GPU if it finds one. `JAX_PLATFORMS=cpu` in the environment keeps it on the processor. This page was built on:

# %%
print(jax.devices())

# %% [markdown]
# ## On one device
#
# The first call compiles; later calls with the same shapes do not. JAX returns before the computation ends, so timings
# have to wait for the result.

# %%
seconds = {}
for pixels in PIXELS:
    side = pixels * 0.009
    array = gs.MicrolensArray(gs.random_layout(max(4, round(side**2 / 2)), (side, side), diameter=None))
    scope = gs.Imager(array, gs.Sensor((pixels, pixels), 0.009), sensor_distance=5.8, field_radius=3.0)
    grid = gs.Grid.over(scope.sensor, depths=np.linspace(18, 22, 9), pitch=0.04)
    image = jnp.asarray(np.random.default_rng(0).random((pixels, pixels)), jnp.float32)
    gs.backproject(image, scope, grid).block_until_ready()
    began = time.perf_counter()
    gs.backproject(image, scope, grid).block_until_ready()
    seconds[pixels] = time.perf_counter() - began
    voxels = np.prod(grid.volume_shape)
    print(f"{pixels:5} x {pixels:<5} {voxels:9} voxels {1000 * seconds[pixels]:7.0f} ms")
figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
axis.plot(list(seconds), [1000 * each for each in seconds.values()], "o-")
axis.set(xlabel="pixels along a side", ylabel="back-projection, ms")
plt.show()

# %% [markdown]
# The cost is proportional to the area: twice the field takes four times as long. A process with several GPUs
# distributes the depths over all of them.
#
# ## In several processes
#
# Frames of a recording, starts of a search, points of a Pareto front and training scenes are independent jobs.
# `--workers 2` distributes them over two processes, by [Dask](https://distributed.dask.org)
# (`pip install '.[cluster]'`), with the same results as one process.

# %%
side = 400 * 0.018
paper = gs.geomscope()
centers = tuple(c for c in paper.array.centers_mm if max(map(abs, c)) < side / 2)
array = paper.array.model_copy(update={"centers_mm": centers, "size_mm": (side, side)})
sensor = paper.sensor.model_copy(update={"shape": (400, 400), "pixel_pitch_um": 18.0})
gs.write_design("scope.toml", paper.model_copy(update={"array": array, "sensor": sensor}))
np.save("recording.npy", np.random.default_rng(0).integers(16, 400, (FRAMES, 400, 400)).astype(np.uint16))
common = [sys.executable, "-m", "gs_jax", "reconstruct", "recording.npy", "scope.toml", "--depths", "19:21:1"]
for output, more in {"one.zarr": [], "two.zarr": ["--workers", "2"]}.items():
    began = time.perf_counter()
    options = ["--voxel-um", "80", "-q", "-o", output, *more]
    done = subprocess.run([*common, *options], capture_output=True, text=True, check=True)
    print(done.stdout, f"total with start: {time.perf_counter() - began:.0f} s", sep="")

# %%
one, two = (np.asarray(zarr.open_group(name, mode="r")["0"]) for name in ("one.zarr", "two.zarr"))
print(one.shape, "equal" if np.array_equal(one, two) else "different")

# %% [markdown]
# Most of this time is the start of processes, imports and compilation: a few small frames do not need several workers.
# [The page on clusters](../../design/CLUSTER.md) has a cost model, and a script for SLURM.
