# %% [markdown]
# # Design and compare two microscopes
#
# The paper's microscope has large lenses. An optimisation made them a sixth as wide: the spot is several times sharper,
# with a 27th of the light. Which design is better depends on the scene and the exposure.

# %%
import jax
import numpy as np
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.design.datasheets import datasheet
from gs_jax.simulation import random_points

HALF = 5.0  # half width of the plate and the sensor, mm
POINTS = 40

# %% [markdown]
# ## Two designs
#
# `geomscope` is the paper's design; the other has the lens parameters of `geomscope-optimized`
# (`gs-jax metrics geomscope-optimized` lists the rest). Both are cropped to the middle of their plate, for speed.


# %%
def middle(design, half=HALF):
    """Crop a design and its sensor to the middle."""
    centers = tuple(c for c in design.array.centers_mm if max(map(abs, c)) < half)
    pixels = round(2 * half / 0.009)
    array = design.array.model_copy(update={"centers_mm": centers, "size_mm": (2 * half, 2 * half)})
    sensor = design.sensor.model_copy(update={"shape": (pixels, pixels), "pixel_pitch_um": 9.0})
    return design.model_copy(update={"array": array, "sensor": sensor})


paper = middle(gs.geomscope())
lens = paper.lens.model_copy(update={"radius_of_curvature_mm": 1.408, "aperture_diameter_mm": 0.335})
imaging = paper.imaging.model_copy(update={"sensor_distance_mm": 3.799})
small = paper.model_copy(update={"name": "small lenses", "lens": lens, "imaging": imaging})
print(small)

# %% [markdown]
# ## Equations and exact rays
#
# A datasheet has the paper's Eqs. 1 to 11 and, by exact rays, the RMS width of a point's image in the object. The
# formula for resolution (Eq. 5) ignores aberrations, and ranks the two designs the wrong way round.

# %%
depths = [18.0, 19.0, 20.0, 21.0, 22.0, 23.0]
sheets = {design.name: datasheet(design, depths) for design in (paper, small)}
figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name, sheet in sheets.items():
    axes[0].plot(depths, sheet["lateral_resolution_um"], label=name)
    axes[1].plot(depths, sheet["rms_width_um"], label=name)
axes[0].set(title="Eq. 5", xlabel="depth, mm", ylabel="lateral resolution, um")
axes[1].set(title="exact rays", xlabel="depth, mm", ylabel="RMS width of a point, um", ylim=(0, None))
axes[1].legend()
plt.show()

# %% [markdown]
# ## The same points through both
#
# Both expose for the same time, so the small lenses collect less light.

# %%
truth = random_points(POINTS, (1.2 * HALF, 1.2 * HALF), (18.5, 22.5), seed=1)
figure, axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
peak = None
for axis, design in zip(axes, (paper, small), strict=True):
    scope = design.imager()
    light = gs.simulate(truth, scope)
    peak = peak or light.max() / 20_000
    image = np.asarray(gs.expose(light, gs.Camera(), jax.random.key(0), peak_electrons=float(light.max() / peak)))
    grid = gs.Grid.over(scope.sensor, depths=np.arange(18.0, 23.01, 0.5), pitch=0.05)
    score = gs.localization(gs.find_points(image, scope, grid), truth)
    print(
        f"{design.name}: brightest pixel {image.max()} counts; F1 {score.f1:.2f}, "
        f"{1000 * score.lateral_rmse:.1f} um laterally, {1000 * score.axial_rmse:.0f} um axially"
    )
    axis.imshow(image[:400, :400], cmap="gray", vmax=np.percentile(image, 99.9))
    axis.set_title(f"{design.name}: a corner of the capture")
plt.show()

# %% [markdown]
# Points are easy: both designs find them, and the paper's lenses localise them better, because they have more light and
# magnify more. Sharp spots pay for extended scenes: volumes at several exposures, by these two and by conics, are in
# the [experiments](../../experiments/results/codesign.md#co-design-the-lens). To search for a design of your own, see
# [the next tutorial](objective.py).
