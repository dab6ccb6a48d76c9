# %% [markdown]
# # A mold
#
# From a layout of lenses to a file for a 3-D printer: a negative mold, into which the array is cast. The written file
# is read back and measured.

# %%
from matplotlib import pyplot as plt
from matplotlib.patches import Circle

import gs_jax as gs
from gs_jax.mold.export import make_mask
from gs_jax.mold.solids import MoldShape

LENSES = 40
CHORD = 0.001  # largest distance of a facet from the lens surface, mm

# %% [markdown]
# ## A layout
#
# Random, with a given mean distance of neighbours, and without gaps between the lenses.

# %%
side = 1.25 * LENSES**0.5
centers = gs.random_layout(LENSES, (side, side), pitch=1.15, diameter=2.0, seed=7)
design = gs.geomscope()
array = design.array.model_copy(update={"centers_mm": tuple(map(tuple, centers.tolist())), "size_mm": (side, side)})
pixels = round(side / 0.0045)
sensor = design.sensor.model_copy(update={"shape": (pixels, pixels)})
design = design.model_copy(update={"name": "mine", "array": array, "sensor": sensor})
gs.write_design("mine.toml", design)
figure, axis = plt.subplots(figsize=(3.6, 3.6), layout="constrained")
axis.scatter(*centers.T, s=8)
axis.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title=f"{LENSES} lenses")
plt.show()

# %% [markdown]
# ## The mold
#
# The report lists the checks before the file is written, and the measurements after.

# %%
report = gs.make_mold(design, "mold.stl", chord=CHORD)
for check in report["checks"]:
    print(f"[{check['level']}] {check['check']}: {check['text']}")
print(f"{report['file_bytes'] / 1e6:.1f} MB, {report['facets']} facets")

# %% [markdown]
# `make_mold` also writes a picture:

# %%
picture = plt.imread("mold.stl.png")
figure, axis = plt.subplots(figsize=(9, 9 * picture.shape[0] / picture.shape[1]), layout="constrained")
axis.imshow(picture)
axis.axis("off")
plt.show()

# %% [markdown]
# ## Shrinkage
#
# Facets are not the only error. A material that shrinks by 0.3 % makes smaller lenses, closer to each other; a larger
# mold compensates for this. `MoldShape` also sets the wall that holds the resin, the floor, and the draft that
# releases the cast.

# %%
larger = gs.make_mold(design, "larger.stl", chord=CHORD, shape=MoldShape(shrinkage=0.003))
print([round(b / a, 4) for a, b in zip(report["size_mm"], larger["size_mm"], strict=True)])

# %% [markdown]
# ## The mask
#
# Where lenses do not touch, a mask must block the light between them. Lenses cover all of this plate, so there is
# nothing to mask, and `mask_plan` says so; for smaller lenses it draws a mask, with the alignment marks of the mold.

# %%
try:
    make_mask(design.imager().array)
except gs.InputError as error:
    print(error)
lens = design.lens.model_copy(update={"aperture_diameter_mm": 0.8})
plan = make_mask(design.model_copy(update={"lens": lens}).imager().array)
figure, axis = plt.subplots(figsize=(4, 4), layout="constrained")
axis.fill(*plan.outline.T, color="0.3")
for x, y, diameter in plan.circles:
    axis.add_patch(Circle((x, y), diameter / 2, color="w"))
for ring in plan.openings:
    axis.fill(*ring.T, color="w")
axis.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title="white: transparent")
plt.show()
