"""Fine-tuning by captures alone: it predicts lenses better that it did not use, and is refused in words."""

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import gs_jax as gs
from gs_jax.apps.training import FineTuned, _split, fine_tune
from gs_jax.base.progress import Progress
from gs_jax.cli.train import train_command
from gs_jax.io.captures import write_capture
from gs_jax.reconstruction.networks import read_unrolled, write_unrolled
from gs_jax.reconstruction.radius_fit import RadiusFit, with_radii
from gs_jax.solvers.unrolled import initialize_unrolled

from .helpers import DESIGN
from .test_reconstruction import GRID, exposed, scope


@pytest.mark.integration
def test_lenses_that_were_left_out_are_predicted_better():
    psf, rng, images = gs.psf_model(scope(), GRID, "near"), np.random.default_rng(0), []
    for _ in range(3):
        truth = np.where(rng.random(GRID.volume_shape) < 0.01, 1.0, 0.0)
        images.append(exposed(np.asarray(gs.forward(truth, scope(), GRID, psf)), 500))
    better = []
    # Small and untrained, so that it is quick and has much to learn.
    start = initialize_unrolled(2, 1, 1, 4, key=jax.random.key(0))
    found = fine_tune(images, scope(), GRID, start, optics=psf, steps=10, on_better=better.append)
    losses = dict(found.held_out)
    assert len(found.losses) == 10 and np.isfinite(found.losses).all()
    assert min(losses.values()) < losses[0] and better
    # What is reported is of lenses that chose nothing.
    _, held_out, scored = _split(images, scope(), GRID, start, psf, 0, Progress())
    for one, other in zip(held_out, scored, strict=True):
        np.testing.assert_array_less(0, np.asarray(one.system.kept) + np.asarray(other.system.kept))
    assert found.after < found.before and not np.array_equal(found.networks.power, start.power)


def test_two_captures_are_too_few():
    with pytest.raises(gs.InputError, match="3 captures or more"):
        fine_tune([np.zeros((125, 125))] * 2, scope(), GRID, gs.Unrolled.pretrained())


@pytest.mark.integration
def test_the_command(tmp_path, monkeypatch):
    # Fewer trials than users have: each is a reconstruction of every capture.
    monkeypatch.setattr("gs_jax.reconstruction.radius_fit._TRIALS", 1)
    (tmp_path / "design.toml").write_text(DESIGN)
    (tmp_path / "run").mkdir()
    for number in range(3):
        image = np.random.default_rng(number).poisson(20, (96, 80)) + 7
        write_capture(tmp_path / "run" / f"{number}.tif", image.astype(np.uint16))
    where = ["--design", str(tmp_path / "design.toml"), "--depths", "19:21:1", "-o", str(tmp_path / "mine.npz")]
    write_unrolled(tmp_path / "w.npz", initialize_unrolled(2, 1, 1, 4, key=jax.random.key(0)))
    words = ["--from-captures", str(tmp_path / "run"), *where, "--steps", "1", "--weights", str(tmp_path / "w.npz")]
    done = CliRunner().invoke(train_command, words, catch_exceptions=False)
    assert done.exit_code == 0 and "3 captures, 1 steps" in done.output
    # Noise tells nothing of the radius.
    radii = [gs.read_design(tmp_path / f"{name}.toml").lens.radius_of_curvature_mm for name in ("mine", "design")]
    assert radii[0] == radii[1]
    assert read_unrolled(tmp_path / "mine.npz").first == 2


def test_the_design_with_the_fitted_radii_is_written_beside_the_weights(tmp_path, monkeypatch):
    (tmp_path / "my.toml").write_text(DESIGN)
    mine = gs.read_design(tmp_path / "my.toml")
    known = mine.imager()
    (tmp_path / "run").mkdir()
    command = ["--from-captures", str(tmp_path / "run"), "--design", str(tmp_path / "my.toml"), "--depths", "19:21:1"]
    command += ["-o", str(tmp_path / "tuned.npz")]
    factor, wavelengths = 1.02, []

    def fitted(images, imager, grid, networks, progress):
        wavelengths.append(round(1e6 * float(imager.wavelength)))
        return RadiusFit(with_radii(imager, factor), factor, [(1.0, 0.2), (1.02, 0.15)])

    def trained(images, imager, grid, networks, **how):
        assert float(imager.array.radius_of_curvature) == pytest.approx(factor * known.array.radius_of_curvature)
        return FineTuned(networks, [0.1], [(0, 0.1)], 0.04, 0.03)

    monkeypatch.setattr("gs_jax.reconstruction.radius_fit.fit_radius", fitted)
    monkeypatch.setattr("gs_jax.apps.training.fine_tune", trained)
    for number in range(2):
        write_capture(tmp_path / "run" / f"{number}.tif", np.full((96, 80), 7, np.uint16))
    few = CliRunner().invoke(train_command, command)
    assert isinstance(few.exception, gs.InputError) and "3 captures or more" in str(few.exception)
    write_capture(tmp_path / "run" / "2.tif", np.full((96, 80), 7, np.uint16))
    done = CliRunner().invoke(train_command, command, catch_exceptions=False)
    assert "tuned.toml: radii +2.0%, by an error of 15.0% of lenses left out (20.0% with the radii of" in done.output
    made = gs.read_design(tmp_path / "tuned.toml")
    assert made.lens.radius_of_curvature_mm == pytest.approx(1.02 * np.array(mine.lens.radius_of_curvature_mm))
    assert made.provenance["radius_factor"] == "1.02" and (made.array, made.imaging) == (mine.array, mine.imaging)
    again = CliRunner().invoke(train_command, command)
    assert isinstance(again.exception, gs.InputError) and "tuned.toml" in str(again.exception)
    same = CliRunner().invoke(train_command, [*command[:-1], str(tmp_path / "my.npz")])
    assert isinstance(same.exception, gs.InputError) and "-o must have another name" in str(same.exception)
    factor = 1.0
    done = CliRunner().invoke(train_command, [*command, "--force"], catch_exceptions=False)
    kept = gs.read_design(tmp_path / "tuned.toml")
    assert "tuned.toml: radii +0.0%" in done.output and kept.lens == mine.lens
    # Of another wavelength, in a gel: the captures' own, which the written design has too.
    gel = ["--wavelength-nm", "600", "--sample-index", "1.43", "--sample-at", "17"]
    CliRunner().invoke(train_command, [*command, *gel, "--force"], catch_exceptions=False)
    seen = gs.read_design(tmp_path / "tuned.toml")
    assert wavelengths[0] == mine.imaging.wavelength_nm and wavelengths[-1] == seen.imaging.wavelength_nm == 600
    assert seen.sample is not None and seen.sample.refractive_index == 1.43


@pytest.mark.parametrize(
    "words, said",
    [
        (["--depths", "18:22:1"], "--depths must be used with --from-captures"),
        (["--dark", "d.tif"], "--dark must be used with --from-captures"),
        (["--from-captures", "run", "--resume"], "got --resume"),
        (["--from-captures", "run"], "must be used with --design and --depths"),
        (["--from-captures", "run", "--network", "paper"], "got --network"),
        (["--from-captures", "run", "--design", "geomscope", "--depths", "20"], "must be a folder of captures"),
    ],
)
def test_wrong_input(words, said, tmp_path):
    done = CliRunner().invoke(train_command, [*words, "-o", str(tmp_path / "w.npz")])
    assert isinstance(done.exception, gs.InputError) and said in str(done.exception)
    assert not list(tmp_path.iterdir())
