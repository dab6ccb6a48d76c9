# %% [markdown]
# # A recording
#
# A recording of drifting beads becomes a time series of volumes, and tracks. The command line processes recordings: it
# overlaps reading, computing and writing, and can resume; a script can call it, too.

# %%
import csv
import subprocess
import sys

import jax
import numpy as np
import tifffile
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.io.ngff import read_series
from gs_jax.simulation import random_points

PIXELS = 800  # of each side of the sensor, 9 um each
FRAMES = 6
BEADS = 8


def run(command):
    """Run a command with this Python's gs-jax, and print its output."""
    print("$", command)
    words = [sys.executable, "-m", *command.replace("gs-jax", "gs_jax", 1).split()]
    done = subprocess.run(words, capture_output=True, text=True)
    print(done.stdout if not done.returncode else done.stderr)


# %% [markdown]
# ## The frames
#
# The middle of the paper's microscope, and beads that move by 20 to 60 um per frame.

# %%
side = PIXELS * 0.009
paper = gs.geomscope()
centers = tuple(c for c in paper.array.centers_mm if max(map(abs, c)) < side / 2)
array = paper.array.model_copy(update={"centers_mm": centers, "size_mm": (side, side)})
sensor = paper.sensor.model_copy(update={"shape": (PIXELS, PIXELS), "pixel_pitch_um": 9.0})
design = paper.model_copy(update={"array": array, "sensor": sensor})
gs.write_design("scope.toml", design)
scope = design.imager()

beads = random_points(BEADS, (0.45 * side, 0.45 * side), (19.0, 21.0), seed=3)
drift = np.random.default_rng(0).normal(0, 0.04, (BEADS, 2))
frames = []
for frame in range(FRAMES):
    now = beads.copy()
    now[:, :2] += frame * drift
    light = gs.simulate(now, scope, optics="near", psf="geometric")
    frames.append(np.asarray(gs.expose(light, gs.Camera(), jax.random.key(frame), peak_electrons=10_000)))
tifffile.imwrite("recording.tif", np.stack(frames))

# %% [markdown]
# ## One command
#
# Planes 0.5 mm apart, 20 frames a second, points of every frame, and tracks of beads that move at most 200 um per
# frame.

# %%
run(
    "gs-jax reconstruct recording.tif scope.toml --depths 19:21:0.5 --voxel-um 60 --frame-interval 0.05 "
    "--suppress points --points beads.csv --track 200 -o volumes.zarr"
)

# %% [markdown]
# ## Tracks
#
# The table has a row for each point of each frame, with the column `particle`.

# %%
with open("beads.csv") as file:
    rows = list(csv.DictReader(file))
print(", ".join(rows[0]))
figure, axis = plt.subplots(figsize=(4.5, 4.2), layout="constrained")
for particle in sorted({row["particle"] for row in rows}):
    track = np.array([[float(row["x_mm"]), float(row["y_mm"])] for row in rows if row["particle"] == particle])
    axis.plot(*track.T, ".-")
axis.plot(*beads[:, :2].T, "k+", label="truth, first frame")
axis.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
axis.legend()
plt.show()

# %% [markdown]
# ## Files
#
# One OME-Zarr with the axes `(t, z, y, x)`, scaled in space and time; napari can open it while it is written.

# %%
series = read_series("volumes.zarr")
assert series
for level in series.levels:
    print(level.shape, level.dtype)
print(f"spacing: {series.scale[0]:g} s, {series.scale[1]:g} um in depth and {series.scale[2]:g} um laterally")

# %% [markdown]
# `gs-jax info volumes.zarr` shows which command made it, from which files.
#
# After an interruption the same command with `--resume` computes the missing frames only. See
# [workers](workers.py) for several processes.
