"""The bound on linear estimates against closed forms, and designs against the bound."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax.base.errors import InputError
from gs_jax.codesign.bound import EXPOSURES, _unexplained, bound_sheet, format_bound, lost_by_any
from gs_jax.codesign.linear_error import FILL, Scene, _spectrum, directions, scene_of
from gs_jax.design.design import read_design
from gs_jax.design.start import geomscope
from gs_jax.objectives import Conditions

SCOPE = geomscope().imager()
lost = jax.jit(lambda plate, at: lost_by_any(eqx.tree_at(lambda i: i.array.size, SCOPE, plate), at))


@pytest.mark.parametrize("detail", [0.04, 0.016])
def test_of_one_plane_is_wieners_error_with_the_light_of_the_plates_solid_angle(detail):
    plate, depth = 6.0, 20.0 - float(SCOPE.reduced_depth(0.0))
    found = lost(jnp.full(2, plate), Conditions([depth], exposure=3.0, detail=detail))[0]
    # From above the middles of the nine squares: solid angles of the four rectangles beside each.
    angle = lambda a, b: np.arctan(a * b / (20 * np.sqrt(a**2 + b**2 + 20**2)))
    ends = [(plate / 2 - q, plate / 2 + q) for q in (-plate / 3, 0, plate / 3)]
    expected = []
    v = np.linspace(0, 0.5 / detail, 4001)
    spectrum = np.asarray(_spectrum(jnp.asarray(v), detail))
    for x in ends:
        for y in ends:
            solid = sum(angle(a, b) for a in x for b in y)
            ratio = spectrum * 3.0 * 400 * solid / (FILL * 0.04**2)
            expected.append(np.sum(v * spectrum / (1 + ratio)) / np.sum(v * spectrum))
    np.testing.assert_allclose(found, np.mean(expected), rtol=1e-3)


def test_without_light_nothing_is_gained():
    np.testing.assert_allclose(lost(jnp.full(2, 6.0), Conditions([18.0], exposure=1e-9)), 1, atol=1e-6)


def test_of_a_few_planes_under_a_small_plate():
    """Without the fall of light the sum over a rectangle is a product of two sincs."""
    plate, exposure = np.array([0.8, 0.5]), 1e5
    at = Conditions([18.0, 18.5, 21.0], exposure=exposure)
    found = lost(jnp.asarray(plate), at)
    scene, z = jax.jit(scene_of)(SCOPE, at), np.asarray(SCOPE.reduced_depth(at.depths))
    magnification, expected = np.asarray(SCOPE.magnification(at.depths)), np.zeros(3)
    between = magnification[:, None] - magnification
    for way in np.asarray(directions(float)).T:
        for f, spectrum, share in zip(scene.frequency, scene.spectrum.T, scene.share.T, strict=True):
            root = np.sqrt(spectrum) / z
            light = exposure * 400 * np.prod(plate) / (FILL * 0.04**2 * 3)
            views = light * np.prod([np.sinc(f * between * side * w) for side, w in zip(plate, way, strict=True)], 0)
            expected += np.diag(np.linalg.inv(np.eye(3) + root[:, None] * views * root)) * share / 4
    # The light falls by 0.1 % from above the plate's middle to its edge.
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("seen", [0.25, 0.6])
def test_of_many_planes_without_noise_is_the_share_of_frequencies_beyond_the_plates_angle(seen):
    """The band `f step width` of each period along the axis, step the distance of planes in vergence."""
    planes, strips = 256, 1024
    scene = Scene(jnp.ones(1), jnp.ones((planes, 1)), jnp.ones((planes, 1)))
    place = (np.arange(strips) + 0.5) / strips - 0.5
    turns = 2 * np.pi * seen * place[:, None] * np.arange(planes)
    amplitude = np.sqrt(1e3 / seen / strips)
    found = jax.jit(_unexplained)(scene, jnp.full((1, strips, planes, 1), amplitude), jnp.asarray(turns[None]))
    # The band's edges are wide: 0.025 more is found, the product of the logarithms of light and planes over the planes.
    assert np.mean(found) == pytest.approx(1 - seen, abs=0.03)


def test_more_light_and_a_larger_plate_bound_less():
    at = Conditions([18.0, 18.5, 21.0])
    gains = [
        [np.mean(lost(jnp.array(plate), dataclasses.replace(at, exposure=exposure))) for exposure in (1e1, 1e3, 1e5)]
        for plate in ([0.8, 0.5], [0.8, 1.5], [3.0, 1.5])
    ]
    assert (np.diff(gains, axis=0) < 0).all() and (np.diff(gains, axis=1) < 0).all()


@pytest.mark.integration
@pytest.mark.parametrize("name", ["geomscope", "geomscope-asphere", "geomscope-optimized", "endoscope"])
def test_no_design_exceeds_it(name):
    design = read_design(f"design/{name}.toml")
    sheet = bound_sheet(design.imager(), np.linspace(*design.imaging.working_distance_mm, 7))
    own, most = np.array(sheet["design_db"]), np.array(sheet["most_db"])
    assert (0 < own).all() and (own < most).all()
    assert (np.diff(own) > 0).all() and (np.diff(most) > 0).all()


def test_finer_voxels_take_more_strips(monkeypatch):
    imager, depths = SCOPE, np.array([18.0, 23.0])
    with pytest.raises(InputError, match=r"needs voxels of at least 0\.\d+ um .*, got 0\.01 um"):
        bound_sheet(imager, Conditions(depths, detail=1e-5))
    found = []
    monkeypatch.setattr(
        "gs_jax.codesign.bound._at_exposures", lambda imager, at, exposures, strips: found.append(strips)
    )
    for detail in (0.04, 0.005):
        with pytest.raises(AttributeError):
            bound_sheet(imager, Conditions(depths, detail=detail))
    assert found == [1024, 4096]


def test_a_detail_is_that_of_the_bound(run):
    status, _, err = run("metrics", "geomscope", "--detail-um", 20)
    assert status == 2 and "--detail-um must be used with --bound." in err


@pytest.mark.integration
def test_the_command_says_a_designs_share(tmp_path, run):
    status, out, _ = run("metrics", "endoscope", "--bound", "--detail-um", 16, "--json", tmp_path / "sheet.json")
    sheet = json.loads((tmp_path / "sheet.json").read_text())["bound"]
    assert status == 0 and format_bound(sheet, 7) in out
    assert sheet["exposure"] == list(EXPOSURES) and sheet["detail_um"] == 16
    shares = [round(100 * own / most) for own, most in zip(sheet["design_db"], sheet["most_db"], strict=True)]
    assert "the design has {} / {} / {} % of that".format(*shares) in out
