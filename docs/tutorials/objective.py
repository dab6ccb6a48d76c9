# %% [markdown]
# # Your own objective in an optimisation
#
# All quantities that the package computes for a microscope are differentiable, so a study can optimise functions of
# your own beside the built-in terms.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from matplotlib import pyplot as plt

import gs_jax as gs
from gs_jax.codesign.search_report import as_records
from gs_jax.codesign.study import Study
from gs_jax.codesign.terms import TERMS, Term

STEPS = 200

# Double precision, so that searches converge.
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A term
#
# A term is a function of an imager and its conditions (`at.depths`) that returns one number, or one per depth. This one
# is the change of the magnification over the depths, in percent: a stack whose planes have equal scale is easier to
# read. The name of a term ends in its unit.


# %%
def scale_change(imager, at):
    """Largest over smallest magnification, minus one, in percent."""
    m = imager.magnification(at.depths)
    return 100 * (jnp.max(m) / jnp.min(m) - 1)


TERMS["scale_change_percent"] = Term("change of the magnification over the depths", scale_change)

# %% [markdown]
# ## A study
#
# A study holds the free parameters with their bounds, the terms, and the solvers. It has the tables of a
# [study file](../../design/README.md#studies), here as a dictionary. A term has a target (`at_most`,
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
outcome = gs.run_study(gs.geomscope(sensor_distance_mm=4.0), study)
for row in as_records(outcome):
    target = row["kind"].replace("_", " ") + (f" {row['target']:g} {row['unit']}" if row["target"] else "")
    print(f"{row['meaning']:50} {target:22} {row['before'][1]:8.3g} -> {row['after'][1]:6.3g}")
print(outcome.design)

# %% [markdown]
# ## Convergence

# %%
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot([entry["cost"] for entry in outcome.log.steps])
axis.set(xlabel="step", ylabel="cost", yscale="log")
plt.show()

# %% [markdown]
# ## Without a study
#
# `gs.optimize` takes any function of an imager, and solvers of `optimistix` and `optax`. Here it minimises the width of
# the spots over four depths plus a penalty on the thickness, over sensor distance and lens shape.

# %%
scope, depths = gs.geomscope(sensor_distance_mm=4.0).imager(), jnp.linspace(18.0, 21.0, 4)


def loss(scope):
    """Width of the spots in the object by exact rays, mm: RMS over depths, plus a twentieth of the sensor distance."""
    return jnp.sqrt(jnp.mean(gs.objectives.spot_width(scope, depths) ** 2)) + 0.05 * scope.sensor_distance


found = gs.optimize(
    loss,
    scope,
    free=gs.free("sensor_distance", "radius_of_curvature", "aperture_diameter"),
    bounds={"sensor_distance": (3.0, 7.0), "radius_of_curvature": (1.0, 3.0), "aperture_diameter": (0.5, 2.0)},
    solver=optx.BFGS(1e-6, 1e-6),
    steps=STEPS,
)
for name, imager in (("before", scope), ("after", found.imager)):
    widest = 1000 * gs.objectives.spot_width(imager, depths).max()
    print(f"{name:6} v = {float(imager.sensor_distance):.2f} mm, widest spot {float(widest):.0f} um")
print("converged:", found.result == optx.RESULTS.successful, "after", found.stats["num_steps"], "steps")
gs.Design.from_imager(found.imager, name="mine", working_distance_mm=(18.0, 21.0))

# %% [markdown]
# The gradient of any such function takes one line, here of the width of the spot with respect to the sensor distance.


# %%
@jax.jit
@jax.value_and_grad
def width(distance):
    """Mean width of the spot in the object in micrometres, and its derivative."""
    return 1000 * gs.objectives.spot_width(eqx.tree_at(lambda i: i.sensor_distance, scope, distance), depths).mean()


distances = jnp.linspace(4.0, 6.5, 26)
values, slopes = zip(*(width(v) for v in distances), strict=True)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].plot(distances, values)
axes[0].set(xlabel="sensor distance, mm", ylabel="width, um")
axes[1].plot(distances, slopes)
axes[1].axhline(0, color="0.7")
axes[1].set(xlabel="sensor distance, mm", ylabel="slope, um / mm")
plt.show()
