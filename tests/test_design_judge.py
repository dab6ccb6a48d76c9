"""The judge of designs: its scenes, its scores, and records that a second run goes on from."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import j1

from experiments.common import designs_by_name
from experiments.design_judge import (
    IMAGES,
    KINDS,
    Judge,
    Settings,
    contrast,
    difference,
    diffracted,
    finer,
    image_of,
    make_scene,
    report,
    shared,
)
from experiments.ray_tracer import traced
from gs_jax import Imager, MicrolensArray, Sensor, geomscope, rasterize
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.design.design import write_design
from gs_jax.io.files import write_json

IMAGER = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((200, 200), 0.02), 5.8, 3.0)


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_lie_on_the_grid_at_all_three_depths(kind):
    settings = Settings()
    scene = make_scene(kind, 1, settings)
    volume = np.asarray(rasterize(scene.emitters, settings.grid), float)
    assert volume.sum() == pytest.approx(scene.emitters[:, 3].sum(), rel=1e-3)
    assert (volume.reshape(3, -1).sum(1) > 0.2 * volume.sum()).all()
    assert not np.array_equal(scene.emitters, make_scene(kind, 2, settings).emitters)


def test_scenes_of_a_scale_are_those_of_another_span_with_shorter_lengths():
    small, large = Settings((3.0, 6.0), scale=0.5), Settings((6.0, 12.0))
    for part, other in zip(make_scene("letters", 0, small), make_scene("letters", 0, large), strict=True):
        np.testing.assert_allclose(part[:, :3], other[:, :3] / 2)
    np.testing.assert_allclose(small.grid.depths, large.grid.depths / 2, rtol=1e-6)
    volume = np.asarray(rasterize(make_scene("letters", 0, large).emitters, large.grid), float)
    bar = make_scene("letters", 0, large).bars[1]
    assert contrast(volume, bar / 2, small.grid) == pytest.approx(contrast(volume, bar, large.grid), rel=1e-3)


def test_the_contrast_of_bars_falls_with_blur():
    settings = Settings()
    scene = make_scene("letters", 0, settings)
    truth = np.asarray(rasterize(scene.emitters, settings.grid), float)
    sharp, soft = (contrast(gaussian_filter(truth, (0, s, s)), scene.bars[1], settings.grid) for s in (0, 1))
    # A Gaussian of 40 um leaves exp(-2 (pi 40 / 120)^2) of 120 um, and light leaves the ends of the bars.
    assert 0.8 < sharp < 1.1 and soft / sharp == pytest.approx(np.exp(-2 * (np.pi / 3) ** 2), abs=0.08)


def test_a_point_is_blurred_to_an_airy_disc():
    lens = MicrolensArray([[0.0, 0.0]], radius_of_curvature=2.0, aperture_diameter=0.3)
    scope = Imager(lens, Sensor((101, 101), 0.001), 5.8, 3.0)
    point = np.zeros((101, 101))
    point[50, 50] = 1
    image = diffracted(point, scope)
    x, y = np.meshgrid(0.001 * np.arange(-50, 51), 0.001 * np.arange(-50, 51))
    argument = np.pi * 0.3 * np.maximum(np.hypot(x, y), 1e-9) / (float(scope.wavelength) * 5.8)
    np.testing.assert_allclose(image / image.max(), (2 * j1(argument) / argument) ** 2, atol=2e-3)
    assert image.sum() == pytest.approx(1, rel=1e-3)


@pytest.mark.integration
def test_images_by_the_model_are_those_by_rays():
    """On one scale: electrons of the reference's brightest pixel set the exposure of all designs."""
    settings = Settings(rays=300, around=0, field=1.2, width=1.0)
    scene = make_scene("beads", 0, settings)
    by_rays, by_model = (image_of(scene, IMAGER, settings._replace(images=name)) for name in IMAGES)
    # A few rays, and the errors of the model (beads: 0.14 with many lenses).
    assert by_model.min() >= 0 and by_model.sum() == pytest.approx(by_rays.sum(), rel=0.02)
    assert np.linalg.norm(by_model - by_rays) < 0.2 * np.linalg.norm(by_rays)


def test_what_rays_do_not_know_is_refused():
    aspheric = dataclasses.replace(IMAGER, array=dataclasses.replace(IMAGER.array, aspheric_terms=[1e-3]))
    with pytest.raises(InputError, match="takes no emission band and no aspheric terms"):
        traced(np.array([[0.0, 0.0, 20.0, 1.0]]), aspheric, 10)


def test_differences_are_of_pairs():
    record = lambda factor: {"letters 0": {"500": {"unrolled": {"squares": [factor * x for x in range(1, 10)]}}}}
    more, low, high = difference(record(0.1), record(1.0), "letters", 500, "unrolled")
    assert (more, low, high) == pytest.approx((10, 10, 10))


@pytest.mark.parametrize(
    ("text", "got"), [('{"settings": {}, "scenes": {}, "found": {}}', "{}"), ("[1]", "no records"), ("{", "no records")]
)
def test_records_of_other_settings_are_refused(tmp_path, text, got):
    file = tmp_path / "records.json"
    file.write_text(text)
    with pytest.raises(InputError, match=f"must be of settings .*, got {got}"):
        Judge(file, Settings(), IMAGER)


def test_records_of_an_earlier_version_are_refused(tmp_path):
    settings = Settings(sensor=1.0)
    judge = Judge(tmp_path / "records.json", settings, IMAGER)
    judge.kept["found"] = {"geomscope 0": {"letters 0": {"3000": {}}}}
    write_json(judge.file, judge.kept)
    with pytest.raises(
        InputError, match="must have the model's error of each scene, got records of an earlier version"
    ):
        Judge(judge.file, settings, IMAGER)


@pytest.mark.parametrize(
    "wrong",
    [{"draws": 0}, {"rays": 0}, {"exposures": [3000, 0]}, {"scale": 0.0}, {"span": [0.0, 5.0]}, {"span": [18.0, 20.0]}],
)
def test_numbers_out_of_range_are_refused_before_anything_is_written(tmp_path, wrong):
    right = {
        "designs": [],
        "span": [18.0, 23.0],
        "scale": 1.0,
        "draws": 1,
        "exposures": [3000],
        "rays": 10,
        "width": 0.5,
        "images": "rays",
    }
    records = tmp_path / "new" / "records.json"
    with pytest.raises(InputError, match="--draws, --exposures and --rays must be 1 or more, and --span"):
        report(**(right | wrong), records=records, progress=Progress())
    assert not records.parent.exists()


def test_designs_of_one_name_are_refused(tmp_path):
    for name in ("one.toml", "two.toml"):
        write_design(tmp_path / name, geomscope())
    with pytest.raises(InputError, match="names of their own, got another geomscope"):
        designs_by_name([tmp_path / "one.toml", tmp_path / "two.toml"])


def test_finer_voxels_are_shared_by_those_of_the_grid():
    settings = Settings()
    scene, fine = make_scene("texture", 0, settings), finer(settings.grid, 0.5)
    found = shared(np.asarray(rasterize(scene.emitters, fine)), fine, settings.grid)
    wanted = np.asarray(rasterize(scene.emitters, settings.grid))
    assert found.sum() == pytest.approx(wanted.sum(), rel=1e-3)
    # Shared twice, the light is spread by half a voxel more.
    assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.98


@pytest.mark.integration
def test_emitters_that_share_rays_make_the_same_image():
    """Sums of squares of 8 pixels are the same to 3 % of their root mean square, the noise of 800,000 rays."""
    rng = np.random.default_rng(0)
    emitters = np.column_stack([rng.uniform(-0.2, 0.2, (4000, 2)), np.full(4000, 20.0), np.ones(4000)])
    own, shared = traced(emitters, IMAGER, 200), traced(emitters, IMAGER, 400, 0.1)
    squares = lambda image: image.reshape(25, 8, 25, 8).sum((1, 3))
    assert shared.sum() == pytest.approx(own.sum(), rel=2e-3)
    error = squares(shared) - squares(own)
    assert np.linalg.norm(error) < 0.03 * np.linalg.norm(squares(own))
