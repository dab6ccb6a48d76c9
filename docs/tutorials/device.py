# %% [markdown]
# # Your own device, from a pinhole to a volume
#
# An array and a camera of one's own: what the vendor says is about right, and how the array sits over the sensor is
# not known at all. Captures of a pinhole at known places tell. The page for the [lab](../../design/LAB.md) has the same
# with commands, and what to do when it goes wrong.

# %%
import dataclasses

import jax
import numpy as np
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.simulation.phantoms import random_points

PIXELS = 1200  # of each side of the sensor, 7 um each
POINTS = 25

# %% [markdown]
# ## What is known
#
# Lens centres from a list, focal length, pixel pitch, and a sensor that is about where the thin lens formula wants it.

# %%
side = PIXELS * 0.007
centers = gs.random_layout(round(0.75 * side**2), (side, side), pitch=1.1, seed=4)
array = gs.MicrolensArray(centers, radius_of_curvature=2.0, size=(side, side))
listed = gs.Imager(array, gs.Sensor((PIXELS, PIXELS), 0.007), sensor_distance=5.6, field_radius=2.5)
print(f"{len(centers)} lenses of f = {float(array.focal_length):.2f} mm")

# %% [markdown]
# ## What is true
#
# The device as it was glued: turned by almost 5 degrees, shifted, tilted, and 0.2 mm farther away. Nobody knows this
# cell; it makes the captures that a camera would.

# %%
glued = dataclasses.replace(listed, sensor_distance=5.8, rotation=0.083, shift=(0.12, -0.21), tilt=(0.004, 0.007))
camera, keys = gs.Camera(), iter(jax.random.split(jax.random.key(0), 10))


def photograph(points):
    """What the camera delivers of some points."""
    light = gs.simulate(np.asarray(points), glued)
    return np.asarray(gs.expose(light, camera, next(keys), peak_electrons=20_000))


# %% [markdown]
# ## A pinhole
#
# At three depths on the axis, and once beside it, one capture each. Where it was, in the sensor's frame, is written
# down.

# %%
places = np.array([[0.0, 0.0, 18.0], [0.0, 0.0, 20.5], [1.5, 0.0, 20.5], [0.0, 0.0, 23.0]])
captures = [photograph([[*place, 1.0]]) for place in places]
figure, axes = plt.subplots(1, len(places), figsize=(10, 2.8), layout="constrained")
for axis, capture, place in zip(axes, captures, places, strict=True):
    axis.imshow(capture, cmap="gray", extent=listed.sensor.extent, vmax=np.percentile(capture, 99.9))
    axis.set_title(f"{place[0]:g}, {place[1]:g}, {place[2]:g} mm", fontsize=9)
plt.show()

# %% [markdown]
# ## Calibrate
#
# The spots are matched to the lenses at any rotation, then everything is fitted to them. Standard deviations say how
# well each number is known; what is left of the spots says if the model is right: below 0.1 pixel is good.

# %%
found = gs.calibrate(captures, places, listed)
for name, value in found.values.items():
    print(f"{name:22} {value:9.4f}  +- {found.deviations[name]:.4f}")
print(f"residuals: {found.rms:.3f} pixels RMS")

# %% [markdown]
# ## A volume
#
# A scene that the calibration has not seen, reconstructed as the device was listed, and as it was found.

# %%
scene = random_points(POINTS, (0.5 * side, 0.5 * side), (18.5, 22.5), seed=2)
capture = photograph(scene)
grid = gs.Grid.over(listed.sensor, depths=np.arange(18.0, 23.01, 0.25), pitch=0.04)
blind = gs.localization(gs.find_points(capture, listed, grid), scene)
points = gs.find_points(capture, found.imager, grid)
score = gs.localization(points, scene)
print(f"as listed: {len(blind.pairs)} of {len(scene)} points, F1 {blind.f1:.2f}")
print(f"as found: {len(score.pairs)} of {len(scene)} points, F1 {score.f1:.2f}")
print(f"errors: {1000 * score.lateral_rmse:.1f} um laterally, {1000 * score.axial_rmse:.0f} um axially")

# %%
volume = gs.reconstruct(capture, found.imager, grid)
gs.show(volume, grid, points=points)
