"""Particles that are known: the same one in every frame, also after it was not seen."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest
import tifffile

from gs_jax.base.errors import InputError
from gs_jax.detection.linking import MEMORY, link_particles
from gs_jax.io.point_tables import read_points

from .test_recording import bead_frames, command

needs_trackpy = pytest.mark.skipif(not find_spec("trackpy"), reason="needs pip install 'gs-jax[track]'")


def walks(frames=60, particles=30):
    """Drifting particles with jitter, in another order in each frame, each now and then not seen; their numbers."""
    rng = np.random.default_rng(0)
    # A grid of 0.5 mm: they stay apart.
    at = 0.5 * np.array([(i % 6, i // 6, 40.0) for i in range(particles)]) + rng.uniform(-0.05, 0.05, (particles, 3))
    drift = rng.normal(0, 0.003, (particles, 3))
    unseen = np.zeros(particles, int)
    for _ in range(frames):
        at = at + drift + rng.normal(0, 0.005, at.shape)
        gone = (rng.random(particles) < 0.1) & (unseen < MEMORY)
        unseen = np.where(gone, unseen + 1, 0)
        shown = rng.permutation(np.flatnonzero(~gone))
        yield at[shown], shown


@needs_trackpy
def test_particles_are_those_that_moved():
    places, numbers = zip(*walks(), strict=True)
    assert any(len(shown) < 30 for shown in numbers)
    found = list(link_particles(iter(places), 0.1))
    # One name for each, and each name for one.
    pairs = {pair for pair in zip(np.concatenate(found), np.concatenate(numbers), strict=True)}
    assert len(pairs) == 30 == len({name for name, _ in pairs}) == len({number for _, number in pairs})


@needs_trackpy
def test_who_is_gone_for_long_is_somebody_else():
    here, nobody = np.array([[0.0, 0, 20]]), np.zeros((0, 3))
    for gone, same in ((MEMORY, True), (MEMORY + 1, False)):
        first, *_, last = link_particles([here, *[nobody] * gone, here], 0.1)
        assert (first == last) is same
    assert list(link_particles([nobody, nobody], 0.1)) == [[], []] and list(link_particles([], 0.1)) == []


@needs_trackpy
def test_crowds_are_refused():
    crowd = np.random.default_rng(0).uniform(0, 0.1, (200, 3))
    with pytest.raises(InputError, match="--track: too many particles are within 1000 um"):
        list(link_particles([crowd, crowd], 1.0))


@needs_trackpy
def test_beads_of_a_recording(folder, run):
    """Two that move, of which one is dark in a frame, and frames of which one cannot be read."""
    (folder / "frames").mkdir()
    for frame, image in enumerate(bead_frames([(-0.3 + 0.05 * t, 0.3)[: 1 if t == 2 else 2] for t in range(5)])):
        tifffile.imwrite(f"frames/{frame}.tif", image[:50] if frame == 3 else image)
    how = ("--suppress", "clusters", "--points", "p.csv", "--track", "120", "--depths", "20")
    status, out, err = run(*command("frames", *how))
    assert status == 1 and "p.csv: 7 points of 2 particles" in out, (out, err)
    header, *rows = (folder / "p.csv").read_text().splitlines()
    assert header == "x_mm,y_mm,z_mm,intensity,frame,particle"
    found = np.array([row.split(",") for row in rows], float)
    moving, still = (found[found[:, 5] == particle] for particle in found[np.argsort(found[:2, 0]), 5])
    assert moving[:, 4].tolist() == [0, 1, 2, 4] and still[:, 4].tolist() == [0, 1, 4]
    assert np.ptp(moving[:, 0]) == pytest.approx(0.2, abs=0.06) and np.ptp(still[:, 0]) < 0.06
    assert read_points(folder / "p.csv").shape == (7, 4)


def test_what_cannot_be_tracked_is_one_line(folder, run, monkeypatch):
    tifffile.imwrite("rec.tif", np.full((2, 96, 80), 16, np.uint16), photometric="minisblack")
    status, _, err = run(*command("rec.tif", "--track", "100"))
    assert status == 2 and "--track must be used with --points POINTS.csv, which has the particles." in err
    status, _, err = run(*command("capture.tif", "--track", "100", "--points", "p.csv"))
    assert status == 2 and "--track must be used with a recording" in err
    monkeypatch.setitem(sys.modules, "trackpy", None)
    status, _, err = run(*command("rec.tif", "--track", "100", "--points", "p.csv"))
    assert (status, err) == (2, "gs-jax: trackpy is not installed; it comes with pip install 'gs-jax[track]'.\n")
    assert not (folder / "v.zarr").exists()
