# %% [markdown]
# # Your own objective in an optimisation
#
# Everything that the package computes of a microscope is differentiable, so what you want of it can be written down as
# a function and searched for, beside the terms that are there.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.codesign.objectives import TERMS, Term
from gs_jax.codesign.outcome import as_records
from gs_jax.codesign.study import Study
from gs_jax.designs.sheet import microscope_of
from gs_jax.designs.spots import psf_width

STEPS = 200

# Searches end within a billionth of the minimum in double precision.
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A term
#
# A function of a `Microscope` (depths, magnification, spots, ...) that gives a number or one for each depth. Here: how
# much the magnification changes over the depths, in percent. A stack whose planes are all of one scale is easier to
# read. The name ends in the unit that the function returns.


# %%
def scale_change(microscope):
    """Largest over smallest magnification, above one, percent."""
    m = microscope.magnification
    return 100 * (jnp.max(m) / jnp.min(m) - 1)


TERMS["scale_change_percent"] = Term("change of the magnification over the depths", scale_change)

# %% [markdown]
# ## A study
#
# What is free, between which bounds, what is wanted, and how it is searched for: the tables of a
# [study file](../../design/README.md#studies), which may as well be a dictionary. A term has a target (`at_most`,
# `at_least`, `equal`) or a direction (`minimise`, `maximise`, with the value that counts as one).

# %%
study = Study.model_validate(
    {
        "name": "even-scale",
        "depths_mm": [18.0, 23.0],
        "confusion_um": 36.0,
        "free": {
            "sensor_distance_mm": [2.0, 6.0],
            "radius_of_curvature_mm": [1.0, 3.0],
            "aperture_diameter_mm": [0.2, 2.0],
            "depth_span_mm": [1.0, 5.0],
        },
        "terms": [
            {"name": "psf_width_um", "minimise": 100.0},
            {"name": "scale_change_percent", "at_most": 15.0, "weight": 30.0},
            {"name": "depth_span_mm", "at_least": 2.0, "weight": 30.0},
            {"name": "light_percent", "at_least": 0.05, "weight": 30.0},
        ],
        "stages": [{"solver": "levenberg-marquardt", "steps": STEPS}],
    }
)
outcome = gs.optimize(gs.geomscope(sensor_distance_mm=4.0), study)
for row in as_records(outcome):
    target = row["kind"].replace("_", " ") + (f" {row['target']:g} {row['unit']}" if row["target"] else "")
    print(f"{row['meaning']:50} {target:22} {row['before'][1]:8.3g} -> {row['after'][1]:6.3g}")
print(outcome.design)

# %% [markdown]
# ## The way there

# %%
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot([entry["cost"] for entry in outcome.log.steps])
axis.set(xlabel="step", ylabel="cost", yscale="log")
plt.show()

# %% [markdown]
# ## Without a study
#
# The gradient of anything is one line away, and any optimiser of `optax` or `optimistix` will do. How wide is the spot
# of the paper's microscope, averaged over four depths, and which way is the sensor to move?


# %%
start = microscope_of(gs.geomscope(sensor_distance_mm=4.0), [18.0, 19.0, 20.0, 21.0])


@jax.jit
@jax.value_and_grad
def width(distance):
    """Mean width of the spot in the object by exact rays, um."""
    return 1000 * psf_width(eqx.tree_at(lambda m: m.imager.sensor_distance, start, distance)).mean()


distances = jnp.linspace(4.0, 6.5, 26)
values, slopes = zip(*(width(v) for v in distances), strict=True)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].plot(distances, values)
axes[0].set(xlabel="sensor distance, mm", ylabel="width, um")
axes[1].plot(distances, slopes)
axes[1].axhline(0, color="0.7")
axes[1].set(xlabel="sensor distance, mm", ylabel="its slope, um / mm")
plt.show()

# %% [markdown]
# A dozen steps of gradient descent find the least width.

# %%
distance = jnp.array(4.0)
for _ in range(12):
    distance = distance - 4e-4 * width(distance)[1]
print(f"v = {float(distance):.2f} mm: {float(width(distance)[0]):.0f} um")
