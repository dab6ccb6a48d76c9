# %% [markdown]
# # Your own device, from a pinhole to a volume
#
# For your own array and camera the vendor's data are approximate, and the position of the array over the sensor is
# unknown. Captures of a pinhole at known positions determine both. The [laboratory guide](../../design/LAB.md) shows
# the same with commands, and what to do about problems.

# %%
import dataclasses

import jax
import numpy as np
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.simulation import random_points

PIXELS = 1200  # of each side of the sensor, 7 um each
POINTS = 25

# %% [markdown]
# ## What is known
#
# Lens centres from a list, focal length, pixel pitch, and a sensor at about the distance of the thin-lens formula.

# %%
side = PIXELS * 0.007
centers = gs.random_layout(round(0.75 * side**2), (side, side), pitch=1.1, seed=4)
array = gs.MicrolensArray(centers, radius_of_curvature=2.0, size=(side, side))
listed = gs.Imager(array, gs.Sensor((PIXELS, PIXELS), 0.007), sensor_distance=5.6, field_radius=2.5)
print(f"{len(centers)} lenses of f = {float(array.focal_length):.2f} mm")

# %% [markdown]
# ## The true device
#
# The device as it was glued: turned by almost 5 degrees, shifted, tilted, and 0.2 mm farther away. This cell stands in
# for the camera; the calibration does not use its values.

# %%
glued = dataclasses.replace(listed, sensor_distance=5.8, rotation=0.083, shift=(0.12, -0.21), tilt=(0.004, 0.007))
camera, keys = gs.Camera(), iter(jax.random.split(jax.random.key(0), 10))


def photograph(points):
    """Capture some points with the true device."""
    light = gs.simulate(np.asarray(points), glued)
    return np.asarray(gs.expose(light, camera, next(keys), peak_electrons=20_000))


# %% [markdown]
# ## A pinhole
#
# One capture each at three depths on the axis, and one beside it, with the positions in the frame of the sensor.

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
# `calibrate` matches spots to lenses at any rotation, then fits the geometry. Standard deviations give the uncertainty
# of each parameter, the residuals show whether the model is right: below 0.1 pixel is good.

# %%
found = gs.calibrate(captures, places, listed)
for name, value in found.values.items():
    print(f"{name:22} {value:9.4f}  +- {found.deviations[name]:.4f}")
print(f"residuals: {found.rms:.3f} pixels RMS")

# %% [markdown]
# ## A volume
#
# A scene that the calibration has not seen, reconstructed with the listed and with the calibrated geometry.

# %%
scene = random_points(POINTS, (0.5 * side, 0.5 * side), (18.5, 22.5), seed=2)
capture = photograph(scene)
grid = gs.Grid.over(listed.sensor, depths=np.arange(18.0, 23.01, 0.25), pitch=0.04)
blind = gs.localization(gs.find_points(capture, listed, grid), scene)
points = gs.find_points(capture, found.imager, grid)
score = gs.localization(points, scene)
print(f"as listed: {len(blind.pairs)} of {len(scene)} points, F1 {blind.f1:.2f}")
print(f"calibrated: {len(score.pairs)} of {len(scene)} points, F1 {score.f1:.2f}")
print(f"errors: {1000 * score.lateral_rmse:.1f} um laterally, {1000 * score.axial_rmse:.0f} um axially")

# %%
volume = gs.reconstruct(capture, found.imager, grid)
gs.show(volume, grid, points=points)
