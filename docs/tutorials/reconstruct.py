# %% [markdown]
# # Reconstruct a capture
#
# A microscope, a scene, its capture with noise, and three reconstructions. Everything is simulated, so the
# truth is known; for a real capture `gs.read_design` and `gs.read_capture` replace the first four cells.

# %%
import jax
import numpy as np
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.simulation import letters

PIXELS = 1280  # of each side of the sensor, 9 um each

# %% [markdown]
# ## The microscope
#
# The paper's array and distances, cropped to the middle of its sensor, with pixels twice as wide.

# %%
paper = gs.geomscope().imager()
sensor = gs.Sensor((PIXELS, PIXELS), 0.009)
near = np.abs(np.asarray(paper.array.centers)).max(axis=1) < PIXELS * 0.009 / 2
array = gs.MicrolensArray(paper.array.centers[near], size=(PIXELS * 0.009,) * 2)
scope = gs.Imager(array, sensor, sensor_distance=5.8, field_radius=3.0)
print(f"{near.sum()} lenses, magnification {float(scope.magnification(20.0)):.2f} at 20 mm")

# %% [markdown]
# ## A capture
#
# Two letters at 18.5 and 21 mm. `simulate` images all light through every lens by exact rays; `expose` models the
# camera, with shot noise, read noise and quantisation.

# %%
left = letters("G", depth=18.5, height=1.2, pitch=0.02) + (-0.7, 0, 0, 0)
right = letters("S", depth=21.0, height=1.2, pitch=0.02) + (0.7, 0, 0, 0)
scene = np.concatenate([left, right])
light = gs.simulate(scene, scope)
capture = np.asarray(gs.expose(light, gs.Camera(), jax.random.key(0), peak_electrons=5000))
figure, axis = plt.subplots(figsize=(5, 5))
axis.imshow(capture, cmap="gray", extent=sensor.extent, vmax=np.percentile(capture, 99.8))
axis.set(title="capture", xlabel="x, mm", ylabel="y, mm")
plt.show()

# %% [markdown]
# ## Back-projection
#
# The paper's reconstruction: each voxel is the sum of the pixels to which its lenses image it. One pass, no iteration.
# An object that is sharp in one plane is a haze in the others.

# %%
grid = gs.Grid(np.arange(18.0, 22.01, 0.5), (71, 101), 0.03)
plain = gs.reconstruct(capture, scope, grid)
truth = np.asarray(gs.rasterize(scene, grid))


def planes(volumes):
    """Plot several volumes at the two depths of the letters."""
    figure, axes = plt.subplots(len(volumes), 2, figsize=(7, 2.6 * len(volumes)), layout="constrained", squeeze=False)
    for row, (name, volume) in zip(axes, volumes.items(), strict=True):
        for axis, index in zip(row, (1, 6), strict=True):
            low = np.percentile(volume[index], 50)
            axis.imshow(volume[index], cmap="magma", extent=grid.extent, vmin=low)
            axis.set_title(f"{name}, {float(grid.depths[index]):g} mm", fontsize=9)
    plt.show()


planes({"truth": truth, "back-projection": plain})

# %% [markdown]
# ## Removing the haze
#
# A network looks at a slice and its neighbours, and keeps objects in focus. Iterative methods fit the capture
# instead: Richardson-Lucy with the full model takes longer, and leaves less haze.

# %%
clean = gs.suppress(plain)
fitted = gs.reconstruct(capture, scope, grid, gs.RichardsonLucy(steps=15, accelerate=True))
planes({"network": clean, "Richardson-Lucy": fitted})

# %% [markdown]
# ## Quality
#
# An empty volume scores well if most of the scene is dark, so the table includes it. `forward_residual` needs no
# truth: it images the volume again and compares the image with the capture.

# %%
print(f"{'':18} PSNR, dB")
for name, volume in {"empty": 0 * plain, "back-projection": plain, "network": clean, "Richardson-Lucy": fitted}.items():
    print(f"{name:18} {gs.quality(volume, truth).psnr_db:8.1f}")
again = gs.forward_residual(fitted, capture, scope, grid)
print(f"unexplained: {100 * again.error:.0f} %, correlation {again.correlation:.3f}")

# %% [markdown]
# ## Files
#
# Fiji and napari open the volume to scale; see [viewers](../howto/viewers.md).

# %%
gs.write_volume("letters.ome.tif", fitted, grid)
volume, same = gs.read_volume("letters.ome.tif")
print(volume.shape, [round(float(z), 2) for z in same.depths])
