import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
import tifffile

import gs_jax as gs
from gs_jax.__main__ import main
from gs_jax.base.arrays import flat_warning
from gs_jax.cli.options import parse_depths
from gs_jax.io.provenance import SCORE, read_provenance
from gs_jax.io.volumes import read_deviation
from gs_jax.widget.layers import reader

from .helpers import DESIGN, needs

RECONSTRUCT = ("reconstruct", "capture.tif", "design.toml", "--depths", "18:22:0.5")


@pytest.mark.parametrize("name", ["volume.ome.tif", "volume.zarr"])
def test_reconstruct(folder, run, name):
    status, out, err = run(*RECONSTRUCT, "--voxel-um", "50", "-o", name)
    assert (status, err) == (0, "")
    assert "9 x 39 x 33 voxels (z, y, x), 50 um laterally, 9 depths from 18 to 22 mm" in out
    volume, grid = gs.read_volume(folder / name)
    assert volume.shape == (9, 39, 33) and grid.pitch == pytest.approx(0.05)
    np.testing.assert_allclose(grid.depths, np.arange(18, 22.1, 0.5))
    assert volume.max() > 7  # several lenses see the middle
    assert sorted(p.name for p in folder.iterdir()) == ["capture.tif", "design.toml", name]


@pytest.mark.integration
def test_the_papers_clusters(folder, run):
    """The brightest voxels of connected groups, here of one point seen by four lenses; in the volume and as a table."""
    image = np.full((96, 80), 16, np.uint16)
    scope = gs.read_design(folder / "design.toml").imager()
    for row, column in np.asarray(scope.sensor.to_pixels(scope.project(np.array([[0.0, 0.0, 20.0]]))))[:, 0]:
        image[round(row) - 1 : round(row) + 2, round(column) - 1 : round(column) + 2] = 1000
    tifffile.imwrite(folder / "capture.tif", image)
    options = ("--voxel-um", "50", "--suppress", "clusters", "-o", "v.tif", "--points", "p.csv")
    status, out, err = run(*RECONSTRUCT, *options)
    found = gs.read_points(folder / "p.csv")
    assert (status, err) == (0, "") and out.endswith("p.csv: 1 point\n")
    # A voxel off at most; of four lenses within 0.45 mm the parallax over these depths is less than a spot.
    assert np.abs(found[0, :2]).max() < 0.051
    volume, _ = gs.read_volume(folder / "v.tif")
    assert volume.sum() == pytest.approx(found[:, 3].sum(), rel=1e-5)


@pytest.mark.integration
def test_points_of_a_capture(folder, run):
    design = DESIGN.replace("[96, 80]", "[480, 400]").replace("_um = 20.0", "_um = 4.5")
    (folder / "design.toml").write_text(design)
    (folder / "points.csv").write_text("x_mm,y_mm,z_mm,intensity\n0.02,-0.01,20,1\n")
    run("simulate", "points.csv", "design.toml", "-o", "capture.tif")
    options = "--depths 19:21:0.25 --voxel-um 20 --suppress points -o v.tif --points p.csv".split()
    status, out, err = run("reconstruct", "capture.tif", "design.toml", *options)
    assert (status, err) == (0, "") and out.endswith("p.csv: 1 point\n")
    found = gs.read_points(folder / "p.csv")[0]
    # Four lenses within 0.45 mm: a pixel of parallax is 0.7 mm of depth, and a third of one is left.
    assert np.hypot(found[0] - 0.02, found[1] + 0.01) < 0.003 and abs(found[2] - 20) < 0.25
    volume, grid = gs.read_volume(folder / "v.tif")
    assert volume.sum() == pytest.approx(found[3], rel=1e-5)


@pytest.mark.integration
def test_a_surface_has_maps_beside_its_volume(folder, run):
    tifffile.imwrite(folder / "capture.tif", np.full((96, 80), 7, np.uint16) + np.eye(96, 80, dtype=np.uint16))
    options = "18:22:1 --voxel-um 50 --method surface --surface m.ome.tif -o v.tif -q".split()
    status, out, _ = run(*RECONSTRUCT[:4], *options)
    assert status == 0 and "m.ome.tif: sheets leave" in out and ", one more " in out
    brightness, depth, _ = tifffile.imread(folder / "m.ome.tif")
    volume, _ = gs.read_volume(folder / "v.tif")
    np.testing.assert_allclose(volume.sum(0), brightness, rtol=1e-3, atol=1e-6 * brightness.max())
    assert (np.nan_to_num(depth, nan=2e4) >= 18_000).all() and (np.nan_to_num(depth, nan=2e4) <= 22_000).all()


@pytest.mark.integration
def test_a_score_is_told_and_kept(folder, run):
    """In the file's provenance, from which a report reads it."""
    image = np.random.default_rng(0).integers(7, 90, (96, 80)).astype(np.uint16)
    tifffile.imwrite(folder / "capture.tif", image)
    options = "20 --voxel-um 50 --score --deviation sd.tif -o v.tif -q".split()
    status, out, _ = run(*RECONSTRUCT[:4], *options)
    assert status == 0 and "v.tif: it predicts lenses that were left out" in out
    assert read_provenance(folder / "v.tif")[SCORE] in out
    # In a file of its own, which a report takes, and napari shows as a layer.
    assert "sd.tif: standard deviations are " in out
    (volume, grid), deviation = gs.read_volume(folder / "v.tif"), gs.read_volume(folder / "sd.tif")[0]
    np.testing.assert_array_equal(read_deviation(folder / "sd.tif", grid), deviation)
    assert deviation.shape == volume.shape and (deviation > 0).any()
    read = reader(path := str(folder / "sd.tif"))
    assert read is not None
    ((shown, options, _),) = read(path)
    np.testing.assert_array_equal(shown, deviation)
    assert options["colormap"] == "viridis" and options["name"] == "sd.tif"
    status, _, err = run("report", "design.toml", "v.tif", "--deviation", "v.tif", "-o", "r.html")
    assert (
        status == 2
        and "must be the standard deviations of gs-jax reconstruct --deviation, got another volume (v.tif)" in err
    )


def test_a_result_that_shows_nothing_is_said(folder, run):
    """Also one that is not finite, before it is written."""
    tifffile.imwrite(folder / "capture.tif", np.zeros((96, 80), np.uint16))
    status, _, err = run(*RECONSTRUCT[:4], "20", "-o", "v.tif")
    assert (
        status == 0 and err.count("\n") == 1 and "warning: the result shows nothing, all of its voxels are zero" in err
    )
    with pytest.raises(gs.InputError, match="result must be finite, got 1 of 8 voxels"):
        flat_warning(np.array([*range(7), np.nan]))
    assert flat_warning(np.full(3, 2.5)) == "the result shows nothing, all of its voxels are 2.5"
    assert flat_warning(np.arange(3.0)) is None


def test_one_depth_and_the_default_voxel(folder, run):
    """The default voxel is a pixel as seen at the middle depth."""
    status, out, _ = run(*RECONSTRUCT[:4], "20", "-o", "v.tif")
    assert status == 0 and f"{20 * (20 + 1 / 1.43) / 5.8:.1f} um" in out and "at 20 mm" in out


@pytest.mark.parametrize(("text", "count"), [("18:18.3:0.1", 4), ("18:18.25:0.1", 3), ("20:20:1", 1)])
def test_depths_include_the_stop_only_when_it_falls_on_the_step(text, count):
    assert len(parse_depths(text)) == count


@pytest.mark.integration
def test_simulate_points(folder, run):
    (folder / "points.csv").write_text("x_mm,y_mm,z_mm,intensity\n0.02,-0.01,20,1\n0.1,0.05,21.5,2\n")
    command = ("simulate", "points.csv", "design.toml", "-o", "c.tif")
    status, out, err = run(*command)
    assert (status, err) == (0, "") and out.startswith("c.tif: 96 x 80 pixels, uint16, from 1")
    first = gs.read_capture(folder / "c.tif", (96, 80))
    assert abs(int(first.max()) - 1016) < 150  # 10,000 electrons, 10 a count, an offset of 16
    run(*command)
    np.testing.assert_array_equal(gs.read_capture(folder / "c.tif"), first)
    run(*command, "--seed", "1")
    assert (gs.read_capture(folder / "c.tif") != first).any()


@pytest.mark.integration
@pytest.mark.parametrize("optics", [(), ("--optics", "near", "--psf", "gaussian")], ids=["full", "near"])
def test_simulate_a_volume_and_reconstruct_it(optics, folder, run):
    grid = gs.Grid([19.0, 20.0, 21.0], (9, 9), 0.05)
    voxels = np.zeros((3, 9, 9), np.float32)
    voxels[1, 6, 3] = 1
    gs.write_volume(folder / "scene.zarr", voxels, grid)
    simulate = ("simulate", "scene.zarr", "design.toml", *optics, "--no-noise", "-o", "capture.tif")
    status, out, _ = run(*simulate)
    assert status == 0 and "float32, from " in out
    options = ("--depths", "20:20:1", "--voxel-um", "50", "-o", "v.tif")
    run("reconstruct", "capture.tif", "design.toml", *options)
    volume, found = gs.read_volume(folder / "v.tif")
    _, row, column = np.unravel_index(int(volume.argmax()), volume.shape)
    assert abs(float(found.y[row]) - 0.1) < 0.06 and abs(float(found.x[column]) + 0.05) < 0.06  # a voxel


def test_layout(folder, run):
    arguments = ("layout", "--count", 200, "--size-mm", 20, 20, "--pitch-mm", 1.23, "--seed", 3, "-o", "c.csv")
    status, out, _ = run(*arguments)
    assert status == 0
    pitch, spread = map(float, re.search(r"pitch ([\d.]+) mm, SD ([\d.]+) mm, 100.0 %", out).groups())  # pyright: ignore[reportOptionalMemberAccess]
    assert abs(pitch - 1.23) <= 0.02 and abs(spread - 0.09) <= 0.02
    lines = (folder / "c.csv").read_text().splitlines()
    assert lines[0] == "x_mm,y_mm" and len(lines) == 201
    assert np.abs(np.loadtxt(lines[1:], delimiter=",")).max() <= 10


def test_info(run):
    status, out, _ = run("info")
    assert status == 0
    for name in ("gs-jax", "python", "jax", "devices", "memory"):
        assert re.search(rf"^{name} +\S", out, re.MULTILINE)


# A command line, and the words of its one line of error.
BASE = "reconstruct capture.tif design.toml"
FULL = f"{BASE} --depths 18:22:0.5 -o v.tif"
LAYOUT, SIMULATE = "layout --size-mm 20 20 --pitch-mm 1.2", "simulate missing.csv design.toml -o c.tif"
WRONG_ARGUMENTS = [
    ("recontruct", "recontruct"),
    ("reconstruct", "CAPTURE"),
    ("reconstruct capture.tif", "DESIGN"),
    (f"{BASE} -o v.tif", "--depths"),
    (f"{BASE} --depths 18:22:0.5", "--output"),
    (f"{FULL} --colour", "--colour"),
    (f"{FULL} surplus", "surplus"),
    (f"{FULL} -o v.jpg", "suffix must be .tif"),
    (f"{FULL} -o nowhere/v.tif", "nowhere"),
    *((f"{FULL} --voxel-um {text}", f"must be 0.01 to 1e+06 um, got '{text}'") for text in ("0", "nan", "fine")),
    (f"{FULL} --voxel-um 0.1", "--voxel-um, --depths: the volume must take at most"),
    (f"{FULL} --method magic", "'magic' is not"),
    *(
        (f"{BASE} --depths {depths or repr('')} -o v.tif", f"got {depths!r}")
        for depths in ("", "18:22", "18:22:0", "18:22:-1", "22:18:1", "-5:5:1", "a:b:c", "18:nan:1",
                       "18:inf:1", "18:22:1e-9", "18:22:1:1", "18,22,1")
    ),
    (f"{BASE} --depths 0:5:1 -o v.tif", "from the array, got 0"),
    ("metrics design.toml --depths 20:22", "must be START:STOP:STEP"),
    ("metrics design.toml --depths 20,abc", "or a list such as 10,40, or one depth, got '20,abc'"),
    ("metrics design.toml --depths 20,19", "must be depths in ascending order, got '20,19'"),
    ("metrics design.toml --depths -1,19", "must be depths of 1e-06 mm or more, got '-1,19'"),
    ("metrics design.toml --json sheet.txt", "sheet.txt"),
    (f"{FULL} --method admm --suppress unet", "--method backproject, got admm"),
    (f"{FULL} --suppress cluster", "'cluster' is not one of 'none', 'points', 'clusters'"),
    (f"{FULL} --weights w.npz", "--method unrolled or --suppress unet, got --method backproject"),
    (f"{FULL} --optics near --suppress points", "--optics must be full with --suppress points, got near"),
    (f"{FULL} --suppress unet --weights missing.npz", "missing.npz"),
    (f"{FULL} --suppress unet --weights design.toml", "design.toml: not a whole"),
    (f"{FULL} --points p.txt", "suffix must be .csv, got '.txt' (p.txt)"),
    ("reconstruct missing.tif design.toml --depths 18 -o v.tif", "missing.tif"),
    ("reconstruct capture.tif missing.toml --depths 18 -o v.tif", "missing.toml"),
    ("reconstruct design.toml design.toml --depths 18 -o v.tif", "CAPTURE comes first"),
    ("reconstruct capture.tif capture.tif --depths 18 -o v.tif", "capture.tif"),
    # Captures.
    (f"{FULL} --roi 10,4,60,80", "--roi .*rows 10 to 69 and columns 4 to 83.*96 x 80"),
    (f"{FULL} --roi 10,4,60,60", "capture.tif.*60 x 60.*96 x 80.*--roi"),
    (f"{FULL} --roi 1,2,3", "must be ROW,COLUMN,ROWS,COLUMNS"),
    (f"{FULL} --binning 2", "capture.tif.*48 x 40.*96 x 80.*--binning"),
    (f"{FULL} --bayer RGGB", "--bayer RGGB.*red, green, blue, got none"),
    (f"{FULL} --bayer RGBG", "--bayer"),
    (f"{FULL} --channel red", "capture.tif.*greyscale.*--bayer"),
    (f"{FULL} --page 2", "capture.tif.*--page 2.*1 pages"),
    *((f"{FULL} --page {text}", f"must be a page, 1 or more, or mean, got '{text}'") for text in ("0", "x")),
    (f"{FULL} --dark missing.tif", "missing.tif.*No such file"),
    (f"{FULL} --flat design.toml", "'.toml'.*design.toml"),
    (f"{FULL} --bad-pixels design.toml", "'.toml'.*design.toml"),
    (f"{FULL} --dark capture.tif --offset 16", "--offset.*--dark"),
    (f"{FULL} --method surface --surface v.tif", "v.tif: outputs must be different files"),
    # Lengths in another unit.
    (f"{BASE} --depths 12000:15000:250 -o v.tif", "did you mean [12, 15, 0.25] mm ([12000, 15000, 250] um)?"),
    ("metrics geomscope --depths 18000", "'--depths': did you mean 18 mm (18000 um)?"),
    ("deconvolve a.tif p.tif --depths 18e6 -o v.tif", "'--depths': did you mean 18 mm"),
    (f"{FULL} --voxel-um 0.06", "'--voxel-um': did you mean 60 um (0.06 mm)?"),
    (f"{LAYOUT} --count 20 --size-mm 6000 6000 -o c.csv", "'--size-mm': did you mean 6 mm (6000 um)?"),
    ("metrics geomscope --sample-index 1.3 --sample-at 9000", "'--sample-at': did you mean 9 mm (9000 um)?"),
    # Other commands.
    (f"{LAYOUT} --count 0 -o c.csv", "--count"),
    (f"{LAYOUT} --count 200 --size-mm 20 -1 -o c.csv", "got '-1'"),
    (f"{LAYOUT} --count 200 --pitch-mm 9 -o c.csv", "`pitch` must"),
    (f"{LAYOUT} --count 200 -o c.txt", "c.txt"),
    (f"{LAYOUT} --count 9 -o c.csv", "`count` must be"),
    ("demo --out design.toml", "design.toml"),
    ("simulate points.csv -o c.tif", "DESIGN"),
    (SIMULATE, "missing.csv"),
    ("simulate capture.tif design.toml -o c.tif", "capture.tif"),
    ("simulate design.toml design.toml -o c.tif", "got a design: SCENE comes first"),
    (f"{SIMULATE} -o c.jpg", "got '.jpg'; JPEG is lossy"),
    (f"{SIMULATE} -o c.png --no-noise", ".tif, .tiff or .npy with --no-noise"),
    (f"{SIMULATE} --psf round", "'round' is not"),
    (f"{SIMULATE} --gain 0", "must be 0.001 to 1e+06 electrons, got '0'"),
    # Options that would do nothing.
    *(
        (f"{FULL} --method {method} {option}", f"{option.split()[0]} must be used with list-rl, ")
        for method in ("backproject", "unrolled", "surface")
        for option in ("--steps 9", "--stop-at-noise")
    ),
    *(
        (f"{SIMULATE} --no-noise {option} 1", f"{option} must be used with")
        for option in ("--seed", "--peak-electrons", "--gain", "--offset", "--read-noise", "--full-well", "--bits")
    ),
    (f"{FULL} --score --suppress clusters", "--score must be used with --suppress none"),
    (f"{FULL} --deviation d.tif --method surface", "--deviation must be used with .* methods of free voxels"),
    (f"{FULL} --deviation v.tif", "v.tif: outputs must be different files"),
    (f"{FULL} --deviation d.csv", "d.csv"),
    (f"{BASE} --depths 20 --tiles auto --deviation d.tif -o v.zarr", "--deviation must not be given with --tiles"),
    ("report design.toml --deviation d.tif -o r.html", "--deviation must be used with VOLUME"),
    ("heights design.toml --step-um 10 -o l.csv", "--step-um must be used with heights"),
    ("mold design.toml --positive --draft-deg 1 -o m.stl", "--draft-deg must be used without"),
    ("report design.toml --dark d.tif -o r.html", "--dark must be used with --capture"),
    ("explore design.toml --terms t.py", "--terms must be used with --study"),
    ("info design.toml --designs", "--designs must be used without a FILE"),
    ("new-design --centers c.csv --seed 1 -o n.toml", "--seed must be used without --centers"),
    ("train --network paper --workers 2 -o w.npz", "--workers must be used with multislice"),
    ("train --wavelength-nm 600 -o w.npz", "--wavelength-nm must be used with --from-captures"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), WRONG_ARGUMENTS)
def test_wrong_arguments_give_one_line_and_status_2(folder, run, arguments, words):
    status, out, err = run(*shlex.split(arguments))
    assert (status, out) == (2, "") and len(err) < 400
    assert re.fullmatch(r"gs-jax: [^\n]+\n", err)
    assert all(part in err for part in words.split(".*")), err
    assert sorted(p.name for p in folder.iterdir()) == ["capture.tif", "design.toml"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("design.toml", DESIGN.replace("5.8", '"5.8"'), "imaging.sensor_distance_mm"),
        ("design.toml", DESIGN.replace("[96, 80]", "[96, 81]"), "capture.tif"),
        ("capture.tif", "not an image", "capture.tif"),
        ("capture.tif", "", "capture.tif"),
        ("points.csv", "x,y,z\n1,2,3\n", "got 'x,y,z'"),
        (
            "points.csv",
            "x_mm,y_mm,z_mm,intensity\n0,0,-20,1\n",
            "point 1, z_mm must be above 0, got -20.0",
        ),
        ("points.csv", "x_mm,y_mm,z_mm,intensity\n0,0,20,nan\n", "'nan'"),
        ("scene.ome.tif", None, "gs-jax: voxels must not be negative, got -1 (scene.ome.tif).\n"),
    ],
)
def test_wrong_files_give_one_line_and_status_2(folder, run, name, content, words):
    gs.write_volume(folder / "scene.ome.tif", np.full((1, 3, 3), -1, np.float32), gs.Grid([20.0], (3, 3), 0.05))
    if content is not None:
        (folder / name).write_text(content)
    simulates = name in ("points.csv", "scene.ome.tif")
    command = ("simulate", name, "design.toml") if simulates else RECONSTRUCT
    status, out, err = run(*command, "-o", "made.tif")
    assert (status, out) == (2, "") and not (folder / "made.tif").exists()
    assert re.fullmatch(r"gs-jax: [^\n]+\n", err) and words in err and (name in err or not simulates)


def test_an_internal_fault_is_not_swallowed(folder, monkeypatch):
    def fault(*_, **__):
        raise ValueError("not the user's")

    monkeypatch.setattr("gs_jax.io.camera.read_corrected", fault)
    monkeypatch.setattr(sys, "argv", ["gs-jax", *RECONSTRUCT, "-o", "v.tif"])
    with pytest.raises(ValueError, match="not the user's"):
        main()


def test_interrupt_leaves_nothing_half_written(folder, run, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("gs_jax.reconstruction.plan.Reconstructor", interrupt)
    status, _, err = run(*RECONSTRUCT, "-o", "v.tif")
    assert (status, err.strip()) == (130, "gs-jax: interrupted")
    assert not (folder / "v.tif").exists()


@pytest.mark.integration
def test_as_a_process(folder):
    """The real thing: quiet in a pipe, status 2 and one line for a wrong design."""
    command = [sys.executable, "-m", "gs_jax", *RECONSTRUCT, "-o", "v.ome.tif"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    # A slow machine may say how far it is.
    assert re.fullmatch(r"(gs-jax: .* \d+ s.*\n)*", done.stderr) and done.stdout.startswith("v.ome.tif: 9 x ")
    (folder / "design.toml").write_text("name = 3")
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@pytest.mark.integration
def test_a_ray_traced_capture_to_a_volume_to_scale(tmp_path, run):
    """The first milestone: the point within 20 um laterally and 100 um axially, in a file to scale."""
    capture, design = needs("oracle/dev/P1_a.tif"), needs("oracle/dev/P1.toml")
    output = tmp_path / "v.ome.tif"
    arguments = ("--depths", "19.5:20.5:0.05", "--voxel-um", "20", "-o", output)
    status, _, err = run("reconstruct", capture, design, *arguments)
    # On a busy machine it says how far it is.
    assert status == 0 and all(line.startswith("gs-jax: ") for line in err.splitlines())
    with tifffile.TiffFile(output) as file:
        assert file.is_ome and file.series[0].axes == "ZYX" and file.series[0].dtype == np.float32
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]  # pyright: ignore[reportArgumentType]
    assert pixels["PhysicalSizeX"] == pytest.approx(20) and pixels["PhysicalSizeXUnit"] in ("µm", "\u03bcm")
    assert pixels["PhysicalSizeZ"] == pytest.approx(50)
    volume, grid = gs.read_volume(output)
    z, y, x = np.unravel_index(int(volume.argmax()), volume.shape)
    assert abs(float(grid.depths[z]) - 20) <= 0.1
    assert np.hypot(float(grid.x[x]), float(grid.y[y])) <= 0.02


@pytest.mark.slow
def test_demo(tmp_path, run):
    status, out, err = run("demo", "--out", tmp_path / "demo")
    assert (status, err) == (0, "") and "report.md" in out and "report.html" in out
    made = {p.name for p in (tmp_path / "demo").iterdir()}
    assert made >= {"design.toml", "optimized.toml", "words.tif", "words.ome.tif", "points-found.csv", "mold.stl"}
    page = (tmp_path / "demo" / "report.html").read_text()
    assert 1e6 < len(page) < 15e6 and str(tmp_path) not in page
    assert len(gs.read_points(tmp_path / "demo" / "points-found.csv")) == pytest.approx(60, abs=2)
    report = (tmp_path / "demo" / "report.md").read_text()
    assert all(name in made for name in re.findall(r"!\[.*\]\((.*)\)", report)) and "NO" not in report
    volume, grid = gs.read_volume(tmp_path / "demo" / "words.ome.tif")
    # Each word is brightest on its own plane: at 18, 20 and 22 mm.
    for depth, (x, y) in ((18, (-4, -5)), (20, (0, 0)), (22, (4, 5))):
        near = np.ix_(abs(np.asarray(grid.y) - y) < 1.5, abs(np.asarray(grid.x) - x) < 4)
        sharpness = [np.square(plane[near]).mean() for plane in volume]
        assert abs(float(grid.depths[int(np.argmax(sharpness))]) - depth) <= 0.5
