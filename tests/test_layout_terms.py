import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax.codesign import terms
from gs_jax.codesign.parameters import candidate, evaluated, start_values
from gs_jax.codesign.terms import TERMS
from gs_jax.design.design import Design
from gs_jax.design.tables import ArrayTable, ImagingTable, LensTable, SensorTable
from gs_jax.geometry import field_limit
from gs_jax.layouts import hexagonal_layout

CENTERS = ((-0.313, 0.437), (0.221, 0.119), (0.427, -0.341), (0.333, 0.416), (-0.429, -0.243))
SLOW = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("localization_um", "reconstruction_error", "scene_error")
]
NAMES = ["ghosts", "lens_shortage", "spectral_flatness", "condition_number", *SLOW]


def small_design(centers, side, field_radius, pixel, shape=(96, 80)):
    return Design(
        name="small",
        sensor=SensorTable(pixel_pitch_um=pixel, shape=shape),
        lens=LensTable(radius_of_curvature_mm=2.0, refractive_index=1.43, aperture_diameter_mm=0.4),
        array=ArrayTable(size_mm=(side, side), substrate_thickness_mm=1.0, centers_mm=tuple(map(tuple, centers))),
        imaging=ImagingTable(
            sensor_distance_mm=5.8, working_distance_mm=(18.0, 23.0), wavelength_nm=520.0, field_radius_mm=field_radius
        ),
    )


@pytest.fixture(scope="module")
def parent():
    """Five lenses on a plate of 1.2 mm, a sensor of 96 x 80 pixels."""
    return evaluated(small_design(CENTERS, 1.2, 0.5, 20.0), depth_count=3, free={"centers_mm": (-10.0, 10.0)})


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_values_and_gradients_are_finite(parent, name):
    """Also where two lenses coincide; their gradients are checked where they are written."""
    term = TERMS[name]
    values = start_values(*parent)
    values["centers_mm"] = values["centers_mm"].at[1].set(values["centers_mm"][0])

    def total(values):
        found = candidate(*parent, values=values)
        return jnp.sum(term.function(*found, jax.random.key(0)) if term.random else term.function(*found))

    value, slopes = jax.jit(jax.value_and_grad(total))(values)
    assert np.isfinite(value) and all(np.isfinite(slope).all() for slope in slopes.values())
    assert np.abs(slopes["centers_mm"]).max() > 0


@pytest.mark.parametrize("distance", [5.8, 14.0])
def test_scenes_are_imaged_whole(monkeypatch, distance):
    """However far the sensor may move: all images of a scene's corners by the lenses that see them."""
    design, found = small_design(CENTERS, 1.2, 0.05, 2.0, (800, 600)), {}
    monkeypatch.setattr(terms, "reconstruction_loss", lambda *_, **options: found.update(options) or jnp.ones(()))
    free = {"sensor_distance_mm": (2.0, distance)}
    far = candidate(*evaluated(design, free=free), {"sensor_distance_mm": jnp.array(distance)})
    TERMS["reconstruction_error"].function(*far, jax.random.key(0))
    (rows, columns), grid = found["window"], found["grid"]
    reach, corner = field_limit(0.05), np.array([grid.x[-1], grid.y[-1]])
    # The lens that is farthest from the corner, away from the scene's middle.
    image = corner + reach + float(far[0].magnification(far[1].depths).max()) * reach
    assert (image <= np.array([columns, rows]) * 0.002 / 2 + 1e-9).all()
    # And no more: a window costs time.
    assert (image >= np.array([columns, rows]) * 0.002 / 2 * 0.97).all()


@pytest.mark.slow
def test_points_are_located_to_a_small_part_of_a_pixel(parent):
    """Spots of one pixel, 20 um, of 1000 photons a lens through five lenses: 20 / sqrt(5000) um by the lenses' share of
    light, over the magnification of a quarter; read noise and a point's depth cost more, a few times."""
    found = np.asarray(TERMS["localization_um"].function(*candidate(*parent, values={}), jax.random.key(0)))
    least = 20 / np.sqrt(5000) / 0.3
    assert (least < found[:2]).all() and (found[:2] < 20 * least).all() and found[2] < 1000


@pytest.mark.integration
def test_spectrum_of_random_lenses_and_of_a_lattice():
    """Random: exponential powers, a flatness of exp(-Euler's constant) = 0.56; a lattice has power in few places."""
    rng = np.random.default_rng(0)
    flat, condition = (TERMS[name].function for name in ("spectral_flatness", "condition_number"))
    keys = jax.random.split(jax.random.key(1), 8)

    def found(centers):
        judged = candidate(*evaluated(small_design(centers.tolist(), 12.0, 4.0, 200.0), depth_count=2), {})
        return np.mean([(flat(*judged, key), condition(*judged, key)) for key in keys], axis=0)

    random = found(rng.uniform(-6, 6, (150, 2)))
    lattice = found(hexagonal_layout((12.0, 12.0), pitch=1.0))
    assert random[0] == pytest.approx(np.exp(-np.euler_gamma), abs=0.05)
    assert lattice[0] < 0.5 * random[0] and lattice[1] > random[1]
