import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax.codesign.objectives import TERMS
from gs_jax.codesign.parameters import candidate, parent_of, start_values
from gs_jax.designs import ArrayTable, Design, ImagingTable, LensTable, SensorTable

CENTERS = ((-0.313, 0.437), (0.221, 0.119), (0.427, -0.341), (0.333, 0.416), (-0.429, -0.243))
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("localization_um", "reconstruction_error")]
NAMES = ["ghosts", "lens_shortage", *SLOW]


@pytest.fixture(scope="module")
def parent():
    """Five lenses on a plate of 1.2 mm, a sensor of 96 x 80 pixels."""
    design = Design(
        name="small",
        sensor=SensorTable(pixel_pitch_um=20.0, shape=(96, 80)),
        lens=LensTable(radius_of_curvature_mm=2.0, refractive_index=1.43, aperture_diameter_mm=0.4),
        array=ArrayTable(size_mm=(1.2, 1.2), substrate_thickness_mm=1.0, centers_mm=CENTERS),
        imaging=ImagingTable(
            sensor_distance_mm=5.8, working_distance_mm=(18.0, 23.0), wavelength_nm=520.0, field_radius_mm=0.5
        ),
    )
    return parent_of(design, depth_count=3, lenses_move=True)


@pytest.mark.parametrize("name", NAMES)
def test_values_and_gradients_are_finite(parent, name):
    """Also where two lenses coincide; their gradients are checked where they are written."""
    term = TERMS[name]
    values = start_values(parent)
    values["centers_mm"] = values["centers_mm"].at[1].set(values["centers_mm"][0])

    def total(values):
        found = candidate(parent, values)
        return jnp.sum(term.function(found, jax.random.key(0)) if term.random else term.function(found))

    value, slopes = jax.jit(jax.value_and_grad(total))(values)
    assert np.isfinite(value) and all(np.isfinite(slope).all() for slope in slopes.values())
    assert np.abs(slopes["centers_mm"]).max() > 0
