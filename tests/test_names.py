"""Names of files as data: their order, gaps in it, and names that are hard to write."""

import json
import os
import random
from pathlib import Path

import numpy as np
import pytest
import tifffile

from gs_jax.base.errors import InputWarning
from gs_jax.io.captures import Selection
from gs_jax.io.names import first_gap, natural_order, plain_text
from gs_jax.io.provenance import read_provenance
from gs_jax.io.recordings import open_recording, spot_names
from gs_jax.io.volume_series import JOURNAL
from gs_jax.io.volumes import read_volume, write_volume

from .test_files import GRID, VOLUME
from .test_recording import FRAMES, OPTIONS, volumes


@pytest.mark.parametrize(
    "names",
    [
        ["f2", "f9", "f10", "f100"],
        ["z9mm", "z10.25mm", "z10.5mm", "z10.75mm", "z11mm"],
        ["z_-200um", "z_-100um", "z_-20.5um", "z_0um", "z_100um"],
        ["z-200um", "z-100um", "z0um", "z+50um", "z100um"],
        ["-3", "-2.5", "0", "+1", "2"],
        ["z10,25", "z10,5", "z11"],
        ["z10p25mm", "z10p5mm", "z11mm"],
        ["z=0.25", "z=0.5", "z=1.0", "z=9.75", "z=10.0"],
        ["z500um", "z0.9mm", "z1mm", "z0.2cm"],
        # A hyphen that joins, a point between two counts, dates and versions.
        ["run-2", "run-9", "run-10"],
        ["run1.8", "run1.9", "run1.10", "run2.1"],
        ["2024-9-30_f1", "2024-11-3_f10", "2024-11-28_f2"],
        ["v1.2.9", "v1.2.10", "v1.10.1"],
        ["a/f2", "a/f10", "b/f1"],
        ["f", "f1", "f1b", "g"],
    ],
)
def test_numbers_in_names_are_numbers(names):
    names = [f"{name}.tif" for name in names]
    shuffled = random.Random(0).sample(names, len(names))
    assert natural_order(shuffled) == names
    assert natural_order(map(Path, shuffled)) == list(map(Path, names))


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        (["f001.tif", "f002.tif", "f004.tif"], ("f002.tif", "f004.tif")),
        (["f1", "f3", "f5", "f9"], ("f5", "f9")),
        (["f1", "f3", "f5"], None),
        (["t_100", "t_151", "t_199"], None),
        (["a1", "b2", "c4"], None),
        (["f1_c1", "f2_c2", "f4_c4"], None),
        (["f1", "f3"], None),
        (["f1", "f1", "f3"], None),
    ],
)
def test_gaps(names, gap):
    assert first_gap(names) == gap


def test_a_gap_in_a_recording_is_told_where_time_matters(folder, run):
    os.mkdir("frames")
    for number in (1, 2, 4):
        tifffile.imwrite(f"frames/f00{number}.tif", FRAMES[0, :9])
    command = ("reconstruct", "frames", "design.toml", *OPTIONS, "-o", "v.zarr")
    _, _, err = run(*command, "--frame-interval", "0.1")
    assert "gs-jax: frames: captures are missing between f002.tif and f004.tif" in err
    assert "are missing" not in run(*command)[2]


def test_psfs_that_a_shell_sorted_are_told(tmp_path, run, monkeypatch):
    paths = [tmp_path / name for name in ("z10.25.tif", "z11.tif", "z9.tif")]
    for path in paths:
        tifffile.imwrite(path, FRAMES[0, :9])
    with pytest.warns(InputWarning, match="by their numbers z9.tif is the first, and z11.tif the last"):
        assert spot_names(paths) == ["z10.25.tif", "z11.tif", "z9.tif"]
    # A folder, and an order that is no shell's, are as they are meant.
    assert spot_names([tmp_path]) == ["z9.tif", "z10.25.tif", "z11.tif"]
    assert spot_names(paths[::-1])[0] == "z9.tif"
    # The command prints order and depths.
    monkeypatch.chdir(tmp_path)
    os.mkdir("psfs")
    for name in ("z_-100um", "z_100um", "z_0um"):
        tifffile.imwrite(f"psfs/{name}.tif", np.eye(16, dtype=np.float32))
    tifffile.imwrite("a.tif", np.ones((16, 16), np.float32))
    command = ("deconvolve", "a.tif", "psfs", "--method", "richardson-lucy", "--steps", "1", "-o", "v.ome.tif")
    out = run(*command, "--depths", "10:12:1")[1]
    assert "PSFs: z_-100um.tif at 10 mm, z_0um.tif at 11 mm, z_100um.tif at 12 mm\n" in out
    assert "z_-100um.tif is plane 1, z_0um.tif is plane 2" in run(*command)[1]


@pytest.mark.parametrize("pattern", ["run[1]/*.tif", "run[1]/f[12].tif", "run[1]", "*/f?.tif", "run[1]/../run[1]/**"])
def test_brackets_in_the_name_of_a_folder(tmp_path, pattern):
    os.mkdir(tmp_path / "run[1]")
    for number in (1, 2):
        tifffile.imwrite(tmp_path / "run[1]" / f"f{number}.tif", FRAMES[number, :9])
    with open_recording(tmp_path / pattern) as recording:
        assert recording is not None and recording.names == ["f1.tif", "f2.tif"]
        np.testing.assert_array_equal(next(recording.images(1, Selection())), FRAMES[2, :9])


def test_text_of_names():
    assert plain_text(os.fsdecode(b"caf\xe9\x07 \xc2\xb5m\t")) == "caf\\xe9\\x07 µm\t"
    assert plain_text("\ud800\ufffe") == "\\ud800\\ufffe"


@pytest.mark.parametrize("name", [os.fsdecode(b"caf\xe9"), "bell\x07", "two\nlines"])
@pytest.mark.parametrize("suffix", [".ome.tif", ".zarr"])
def test_volumes_of_any_name(tmp_path, name, suffix):
    path = tmp_path / f"{name}{suffix}"
    write_volume(path, VOLUME, GRID, {"software": "test"})
    np.testing.assert_array_equal(read_volume(path)[0], VOLUME)


def test_a_recording_of_any_name(folder, run):
    """With a journal to resume from, points, provenance and messages."""
    os.mkdir("frames")
    names = [os.fsdecode(b"caf\xe9 1.tif"), "bell\x07 2.tif"]
    for name, frame in zip(names, FRAMES, strict=False):
        tifffile.imwrite(f"frames/{name}", frame)
    os.rename("design.toml", design := os.fsdecode(b"d\xe9sign.toml"))
    command = ("reconstruct", "frames", design, *OPTIONS, "-o", output := os.fsdecode(b"v\xe9.zarr"))
    points = os.fsdecode(b"p\xe9.csv")
    status, out, err = run(*command, "--suppress", "points", "--points", points)
    assert status == 0, err
    assert "2 frames in" in out and volumes(output).shape[0] == 2
    (journal := json.loads(Path(output, JOURNAL).read_text().splitlines()[0]))["request"]
    assert journal["frames"] == 2
    assert "d\\xe9sign.toml" in read_provenance(points)["command"]
    more = ("--suppress", "points", "--points", points, "--resume", "--force")
    status, out, _ = run(*command, *more)
    assert status == 0 and "all frames were there" in out
