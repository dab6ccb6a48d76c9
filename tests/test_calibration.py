"""Calibration: spots and their lenses, geometry from spots that we put somewhere, and from ray-traced captures."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from experiments.calibration import device, on_captures
from gs_jax import Imager, InputError, Sensor, read_design, write_capture, write_design
from gs_jax.__main__ import commands
from gs_jax.base.progress import Progress
from gs_jax.calibration.fit import NAMES, calibrate
from gs_jax.calibration.matching import match
from gs_jax.calibration.outcome import values_of
from gs_jax.calibration.spots import core_offsets, find_spots
from gs_jax.designs.builtin import geomscope
from gs_jax.io.provenance import read_provenance

from .helpers import needs

POINTS = np.array([[0.4, -0.3, 18.0], [-1.0, 0.2, 20.0], [0.3, 1.1, 22.0]])


def drawn(places, shape, seed=0, noise=2.0) -> np.ndarray:
    """Gaussian spots `(row, column)` on an offset, with noise, a hot pixel and a spot of nothing."""
    rng = np.random.default_rng(seed)
    image = rng.normal(100, noise, shape)
    side = np.arange(-8, 9)
    for number, (row, column) in enumerate([*places, rng.uniform(100, 200, 2)]):
        r, c = round(row), round(column)
        if min(r, c, shape[0] - 1 - r, shape[1] - 1 - c) > 8:
            along, across = (np.exp(-((side + at - place) ** 2) / 4.5) for at, place in ((r, row), (c, column)))
            image[r - 8 : r + 9, c - 8 : c + 9] += (300 - 2 * number) * np.outer(along, across)
    image[50, 60] += 2000
    return image


def spots_of(imager: Imager, point) -> np.ndarray:
    """Where exact rays put the cores of a point's spots, `(row, column)`, nearest lenses first; a tenth is missing."""
    beside = np.asarray(imager.centers) - point[:2]
    field = np.hypot(*beside.T)
    order = np.argsort(field)[: int(0.9 * len(field))]
    beside, field = beside[order], field[order]
    offset = core_offsets(imager, point[2:], field)[0]
    away = -beside / np.maximum(field, 1e-12)[:, None]
    landing = point[:2] + beside * float(imager.scale(point[2])) + offset[:, None] * away
    return np.asarray(imager.sensor.to_pixels(landing))[1:]


def captures(imager: Imager) -> list[np.ndarray]:
    return [drawn(spots_of(imager, point), imager.sensor.shape, seed) for seed, point in enumerate(POINTS)]


def test_spots_are_found_within_a_fiftieth_of_a_pixel():
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*2 * [np.linspace(250, 900, 6)], indexing="ij"), -1).reshape(-1, 2)
    places = places + rng.uniform(-0.5, 0.5, places.shape)
    found = find_spots(drawn(places, (1000, 1000)), 60)
    distance = np.linalg.norm(found[:, None] - places, axis=-1).min(0)
    assert distance.max() < 0.05 and np.sqrt((distance**2).mean()) < 0.02
    assert len(find_spots(np.random.default_rng(1).normal(100, 2, (300, 300)), 60)) == 0


def test_an_ideal_lens_puts_its_core_on_the_chief_ray():
    imager = device(0)[0]
    ideal = dataclasses.replace(imager, array=dataclasses.replace(imager.array, thin_lens_focal_length=4.65))
    focused = eqx.tree_at(lambda i: i.sensor_distance, ideal, jnp.asarray(1 / (1 / 4.65 - 1 / (20 + 1 / 1.43))))
    np.testing.assert_allclose(core_offsets(focused, np.array([20.0]), np.linspace(0, 2, 3)), 0, atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_a_pattern_is_matched_at_any_rotation_mirrored_or_not(seed):
    rng = np.random.default_rng(seed)
    centers = np.asarray(device(seed)[1].array.centers)
    c = centers @ (1, 1j)
    factor, shift = 1.29 * np.exp(1j * rng.uniform(-np.pi, np.pi)), complex(*rng.uniform(-3, 3, 2))
    near = np.argsort(np.abs(c - complex(*rng.uniform(-2, 2, 2))))[:20]
    p = factor * (c.conj() if seed % 2 else c)[near] + shift + rng.normal(0, 0.003, (20, 2)) @ (1, 1j)
    p[[3, 7, 11]] = rng.uniform(-4, 4, (3, 2)) @ (1, 1j)
    found = match(np.stack([p.real, p.imag], -1), centers, 1.27, 0.05)
    assert found.mirrored == bool(seed % 2) and found.is_clear and found.on_lenses >= 17
    assert abs(found.factor - factor) < 0.005 and abs(found.shift - shift) < 0.02


def test_chance_is_no_pattern():
    centers = np.asarray(device(0)[1].array.centers)
    spots = np.random.default_rng(0).uniform(-4, 4, (20, 2))
    assert not match(spots, centers, 1.28, 0.05).is_clear and not match(spots[:2], centers, 1.28, 0.05).is_clear


@pytest.mark.parametrize("seed", [0, 1])
def test_geometry_is_found_from_a_poor_start(seed):
    actual, design, mirrored = device(seed)
    found = calibrate(captures(actual), POINTS, design)
    true = values_of(found._replace(imager=actual))
    assert found.mirrored == mirrored and found.rms < 0.1
    for name in NAMES:
        off = values_of(found)[name] - true[name]
        off = (off + 180) % 360 - 180 if name == "rotation_deg" else off
        assert abs(off) < max(4 * found.deviations[name], 1e-6), name
    # Spots near to where they are due, though the image has others.
    assert len(found.residuals) > 20 and np.hypot(*found.residuals.T).max() < 1


def test_one_capture_does():
    actual, design, mirrored = device(0)
    found = calibrate(captures(actual)[1:2], POINTS[1:2], design)
    assert found.mirrored == mirrored
    np.testing.assert_allclose(found.imager.centers, actual.centers, atol=2e-3)
    assert abs(float(found.imager.sensor_distance - actual.sensor_distance)) < 4 * found.deviations[NAMES[0]]


def test_what_cannot_be_calibrated_is_refused_in_words():
    _, design, _ = device(0)
    blank = np.random.default_rng(0).normal(100, 2, design.sensor.shape)
    with pytest.raises(InputError, match="captures: found 0 of 0 bright spots on lenses at best"):
        calibrate([blank], POINTS[:1], design)
    with pytest.raises(InputError, match="positions: found 3 for 1 captures, allowed: one for each"):
        calibrate([blank], POINTS, design)
    with pytest.raises(InputError, match="positions: found the depth -20 mm, allowed: above 0"):
        calibrate([blank], np.array([[0.0, 0.0, -20.0]]), design)


def test_the_command(tmp_path):
    """With a small design, whose array is mirrored and turned in the captures."""
    actual, design, mirrored = device(2)
    # Wide enough for the whole plate: designs whose lenses cannot be seen are refused.
    wide = Sensor((2400, 2400), 0.006)
    actual, design = (dataclasses.replace(imager, sensor=wide) for imager in (actual, design))
    pairs = tuple(map(tuple, np.asarray(design.array.centers, float).tolist()))
    plain = geomscope(sensor_distance_mm=float(design.sensor_distance))
    tables = {
        "array": plain.array.model_copy(update={"centers_mm": pairs, "size_mm": (14.0, 14.0)}),
        "sensor": plain.sensor.model_copy(update={"pixel_pitch_um": 6.0, "shape": design.sensor.shape}),
        "imaging": plain.imaging.model_copy(update={"field_radius_mm": design.field_radius}),
    }
    write_design(tmp_path / "design.toml", plain.model_copy(update=tables))
    names = []
    for number, image in enumerate(captures(actual)):
        names.append(str(tmp_path / f"{number}.tif"))
        write_capture(names[-1], image.astype(np.float32))
    lines = [",".join(map(str, point)) for point in POINTS.tolist()]
    (tmp_path / "p.csv").write_text("\n".join(["x_mm,y_mm,z_mm", *lines]) + "\n")
    arguments = ["calibrate", str(tmp_path / "design.toml"), *names, "--positions", str(tmp_path / "p.csv"), "-o"]
    result = CliRunner().invoke(commands, [*arguments, str(tmp_path / "new.toml")], catch_exceptions=False)
    assert "pixels RMS" in result.stdout and ("mirrored" in result.stdout) == mirrored
    new = read_design(tmp_path / "new.toml").imager()
    np.testing.assert_allclose(new.centers, actual.centers, atol=2e-3)
    assert float(new.sensor_distance) == pytest.approx(float(actual.sensor_distance), abs=5e-3)
    assert "standard_deviations" in read_provenance(tmp_path / "new.toml") and (tmp_path / "new.png").exists()
    (tmp_path / "p.csv").write_text("x_mm,y_mm,z_mm\n0,0,20\n")
    wrong = CliRunner().invoke(commands, [*arguments, str(tmp_path / "other.toml")])
    assert isinstance(wrong.exception, InputError) and "p.csv: positions: found 1 for 3" in str(wrong.exception)


@pytest.mark.slow
def test_ray_traced_captures():
    found, whole = on_captures(needs("oracle/dev/P1.toml").parent, Progress())
    assert whole.rms < 0.3 and max(found["held_out_rms_pixels"].values()) < 0.3
    assert found["values"]["sensor_distance_mm"] == pytest.approx(5.85, abs=1e-3)
    assert found["points_f1"] == 1 and found["points_axial_um"] < 20
