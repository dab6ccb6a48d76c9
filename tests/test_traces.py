"""Signals of regions: of volumes, of points, and demixed from captures."""

import tomllib

import numpy as np
import pytest
import tifffile
import zarr

import gs_jax as gs
from experiments import traces as experiment
from gs_jax.apps.trace_pictures import draw_traces
from gs_jax.base.errors import InputError
from gs_jax.io.ngff import VolumeSeries, read_series, series_grid
from gs_jax.io.traces import read_labels, read_traces, write_traces
from gs_jax.reconstruction.demixing import demix, image_regions, prepare_demixing
from gs_jax.reconstruction.traces import (
    RegionSignals,
    SummaryVolumes,
    emitters_of_regions,
    regions_of_points,
    relative_change,
    segment,
)

from .helpers import DESIGN

GRID = gs.Grid([19.0, 20.0, 21.0], (40, 48), 0.02, (0.1, -0.05))
# Voxels (z, y, x) of cells, and their signals in five frames; the light beside them is 2.
CELLS = [(1, 10, 12), (1, 10, 18), (2, 30, 36)]
LIGHT = np.array([[4.0, 6, 10], [4, 9, 15], [8, 6, 10], [4, 6, 20], [4, 6, 10]])


def blobs(light) -> np.ndarray:
    """Cells of three voxels' width in a volume."""
    z, y, x = np.indices(GRID.volume_shape)
    volume = np.full(GRID.volume_shape, 2.0)
    for value, (d, r, c) in zip(light, CELLS, strict=True):
        volume += value * (z == d) * np.exp(-((y - r) ** 2 + (x - c) ** 2) / (2 * 1.5**2))
    return volume.astype(np.float32)


@pytest.fixture
def recording(folder):
    """`v.zarr` with these cells, whose fourth frame failed."""
    series = VolumeSeries(folder / "v.zarr", len(LIGHT), GRID, interval=0.5)
    for frame, light in enumerate(LIGHT):
        if frame == 3:
            series.fail(frame, "a reason")
        else:
            series.write(frame, blobs(light))
    return folder / "v.zarr"


def test_the_grid_of_a_recording_is_read_as_it_was_written(recording):
    series = read_series(recording)
    assert series is not None
    grid = series_grid(series)
    np.testing.assert_allclose(grid.depths, GRID.depths)
    np.testing.assert_allclose(grid.origin, GRID.origin, atol=1e-7)
    assert (grid.shape, grid.pitch) == (GRID.shape, pytest.approx(GRID.pitch))


def test_mean_and_deviation_over_time():
    volumes = np.random.default_rng(0).normal(100, 3, (7, 2, 3, 4)).astype(np.float32)
    summary = SummaryVolumes(volumes.shape[1:])
    for volume in volumes:
        summary.add(volume)
    np.testing.assert_allclose(summary.mean, volumes.mean(0), rtol=1e-6)
    np.testing.assert_allclose(summary.deviation, volumes.std(0), rtol=1e-4)


def test_cells_that_touch_are_regions_of_their_own():
    labels = segment(blobs([10, 8, 9]))
    assert labels.max() == 3 and len({labels[cell] for cell in CELLS} - {0}) == 3
    assert (labels[0] == 0).all()
    with pytest.raises(InputError, match="no region stands out"):
        segment(np.ones(GRID.volume_shape, np.float32))


def test_regions_of_points_by_distance():
    """Each voxel within the half axes belongs to the nearest point, measured in units of them; by a literal loop."""
    points = GRID.to_mm(np.array(CELLS)) + np.array([0.003, -0.004, 0.2])
    radius = np.array([0.1, 0.1, 1.1])
    labels = regions_of_points(points, GRID, (0.1, 1.1))
    for voxel in np.ndindex(*GRID.volume_shape):
        away = np.linalg.norm((np.asarray(GRID.to_mm(np.array(voxel))) - points) / radius, axis=1)
        assert labels[voxel] == (away.argmin() + 1 if away.min() <= 1 else 0) or abs(away.min() - 1) < 1e-6
    # Smaller than a voxel: the nearest voxel alone.
    tiny = regions_of_points(points, GRID, (1e-4, 1e-4))
    assert np.bincount(tiny.ravel()).tolist() == [tiny.size - 3, 1, 1, 1]
    # Neighbouring planes count, whatever the rounding of their depths.
    fine = gs.Grid(np.arange(18, 22.1, 0.2), (5, 5), 0.02)
    for plane in range(1, len(fine.depths) - 1):
        labels = regions_of_points(np.asarray(fine.to_mm(np.array([[plane, 2, 2]]))), fine)
        assert np.flatnonzero(labels.any(axis=(1, 2))).tolist() == [plane - 1, plane, plane + 1]
    with pytest.raises(InputError, match="point 2 must be within the volume"):
        regions_of_points(points + [[0, 0, 0], [0, 0, 9], [0, 0, 0]], GRID, (0.1, 1.1))
    with pytest.raises(InputError, match="point 2 must have a voxel of its own"):
        regions_of_points(np.array([points[0], points[0] + 1e-6]), GRID, (1e-4, 1e-4))


def test_means_above_a_background_that_is_not_flat():
    """Each region on a pedestal of its own; its background is that of its planes, without the other regions."""
    labels = np.zeros(GRID.volume_shape, np.int32)
    most = np.iinfo(np.int32).max
    labels[1, 8:13, 9:15], labels[1, 8:13, 17:21], labels[2, 28:33, 34:39] = 7, 3, most
    volume = np.zeros(GRID.volume_shape, np.float32) + np.array([1.0, 2, 5], np.float32)[:, None, None]
    for number, value in ((7, 3.0), (3, 30.0), (most, 4.0)):
        volume[labels == number] += value
    signals = RegionSignals(labels)
    means, backgrounds = signals(volume)
    assert signals.numbers.tolist() == [3, 7, most] and signals.sizes.tolist() == [20, 30, 25]
    np.testing.assert_allclose(backgrounds, [2, 2, 5])
    np.testing.assert_allclose(means - backgrounds, [30, 3, 4])
    emitters = emitters_of_regions(labels, volume, backgrounds, GRID)
    assert [len(part) for part in emitters] == [20, 30, 25] and emitters[0][:, 3].sum() == pytest.approx(1)
    np.testing.assert_allclose(emitters[2][0, :3], GRID.to_mm(np.array([2, 28, 34])), rtol=1e-6)
    with pytest.raises(InputError, match="regions that fill the volume"):
        RegionSignals(np.ones(GRID.volume_shape, np.int32))


def test_pictures_have_gaps_and_hidden_regions():
    columns = {"region": [1, 2] * 3, "frame": [2, 2, 3, 3, 6, 6], "dff": np.arange(6.0)}
    columns |= dict.fromkeys(("x_mm", "y_mm"), np.zeros(6))
    columns = {name: np.asarray(values) for name, values in columns.items()} | {"time_s": np.repeat([1, 1.5, 3], 2)}
    image = np.zeros(GRID.shape, np.float32)
    labels = np.zeros(GRID.shape, np.int32)
    labels[3:6, 3:6] = 2
    heat = draw_traces(columns, image, labels, GRID).axes[1]
    (picture,) = heat.images
    values = np.asarray(picture.get_array())
    np.testing.assert_array_equal(values, [[0, 2, np.nan, 4], [1, 3, np.nan, 5]])
    np.testing.assert_allclose(heat.get_xlim(), (0.75, 3.25))
    np.testing.assert_allclose(heat.get_ylim(), (2, 0))


def test_relative_change():
    """The baseline is a percentile of all frames, or of those about each; unknown frames stay unknown."""
    signals = np.array([[1.0, 0], [2, 0], [np.nan, -1], [4, 2], [3, 0]])
    found = relative_change(signals, 0.0)
    np.testing.assert_allclose(found[:, 0], [0, 1, np.nan, 3, 2])
    assert np.isnan(found[:, 1]).all()
    found = relative_change(signals, 0.0, 3)
    np.testing.assert_allclose(found[:, 0], [0, 1, np.nan, 1, 0])
    assert not len(relative_change(np.zeros((0, 2))))


COLUMNS = {"region": np.array([1, 2]), "frame": np.array([0, 3])}
COLUMNS |= {name: np.array([0.5, np.nan]) for name in ("x_mm", "y_mm", "z_mm", "dff")}


@pytest.mark.parametrize("name", ["t.csv", "t.h5"])
def test_a_table_of_traces_is_read_as_it_was_written(folder, name, run):
    if name.endswith("h5"):
        pytest.importorskip("h5py")
    write_traces(name, COLUMNS, {"command": "gs-jax traces"})
    found = read_traces(name)
    assert list(found) == list(COLUMNS) or sorted(found) == sorted(COLUMNS)
    for key, values in COLUMNS.items():
        np.testing.assert_array_equal(found[key], values)
    status, out, _ = run("info", name)
    assert status == 0 and "gs-jax traces" in out


def test_other_tables_are_refused(folder):
    (folder / "t.csv").write_text("x_mm,y_mm\n1,2\n")
    with pytest.raises(InputError, match="t.csv: must be a table of `gs-jax traces`, got no column region"):
        read_traces("t.csv")
    header = "region,frame,x_mm,y_mm,z_mm,dff\n"
    for rows, message in (("", "with rows"), ("1,0,0,0,20,nan\n", "got no signal")):
        (folder / "t.csv").write_text(header + rows)
        with pytest.raises(InputError, match=f"t.csv: must be a table of `gs-jax traces`, {message}"):
            read_traces("t.csv")
    (folder / "t.csv").write_text("x_mm,y_mm\n1,2,3\n1\n")
    with pytest.raises(InputError, match="t.csv: not a whole and valid table of traces"):
        read_traces("t.csv")


def test_label_images(folder):
    labels = segment(blobs([10, 8, 9]))
    tifffile.imwrite("l.tif", labels.astype(np.uint16), photometric="minisblack")
    tifffile.imwrite("flat.tif", labels.max(0).astype(np.uint8))
    zarr.create_array("v.zarr/labels/cells/0", data=labels[None])
    np.testing.assert_array_equal(read_labels(folder / "l.tif", labels.shape), labels)
    np.testing.assert_array_equal(read_labels(folder / "v.zarr/labels/cells/0", labels.shape), labels)
    np.testing.assert_array_equal(
        read_labels(folder / "flat.tif", labels.shape), np.broadcast_to(labels.max(0), labels.shape)
    )
    wrong = {"shape": labels[:, 1:], "float": labels / 2, "negative": -labels, "dark": 0 * labels}
    words = {"shape": "of the volume's shape", "float": "whole numbers", "negative": "whole", "dark": "0 everywhere"}
    for name, values in wrong.items():
        tifffile.imwrite(
            f"{name}.tif", values.astype(np.float32 if name == "float" else np.int16), photometric="minisblack"
        )
        with pytest.raises(InputError, match=words[name]):
            read_labels(folder / f"{name}.tif", labels.shape)
    (folder / "l.png").write_bytes(b"")
    for path, message in (("l.png", "a TIFF or a Zarr folder"), ("none.tif", "cannot be read")):
        with pytest.raises(InputError, match=message):
            read_labels(folder / path, labels.shape)


# Two points that share pixels under all lenses, and one beside them.
BEADS = np.array([[0.05, 0.0, 20.0, 1.0], [0.1, 0.02, 21.0, 1.0], [-0.2, 0.1, 20.5, 1.0]])
# All that they emit, of which a lens gets a forty-thousandth.
TRUTH = 2e7 * np.array([[1.0, 4, 0], [3, 0, 2], [0, 1, 5], [2, 2, 2]])


SCOPE = gs.Design.model_validate(tomllib.loads(DESIGN)).imager()


@pytest.fixture(scope="module")
def images():
    return image_regions([bead[None] for bead in BEADS], SCOPE)


def frames_of(images, seed: int = 0, copies: int = 1) -> np.ndarray:
    """Captures of the beads with the noise of photons and of reading, on an offset that is not even."""
    rng, light = np.random.default_rng(seed), np.repeat(TRUTH, copies, axis=0)
    clean = (light @ images.images).reshape(-1, *images.shape) + 20 + np.linspace(0, 10, images.shape[1])
    return rng.poisson(clean) + rng.normal(0, 2, clean.shape)


def test_demixed_light_is_right_within_its_error(images):
    """What is there, and how far off it is said to be, where beads are lit; what is dark is never negative."""
    frames = frames_of(images, copies=40)
    system = prepare_demixing(images, frames[::20])
    light, error = map(np.array, zip(*(demix(frame, system) for frame in frames), strict=True))
    truth = np.repeat(TRUTH, 40, axis=0)
    lit = truth > 0
    assert (light >= 0).all() and np.abs(light - truth)[lit].max() < 0.1 * TRUTH.max()
    share = (light - truth)[lit] / error[lit]
    assert abs(share.mean()) < 0.25 and 0.7 < share.std() < 1.3


def test_pixels_and_regions_that_cannot_be_used(images, monkeypatch):
    def fail(_):
        raise np.linalg.LinAlgError("not positive definite")

    same = images._replace(images=images.images[[0, 1, 0]], numbers=np.array([7, 0, 4]))
    with pytest.raises(InputError, match="regions must cast different images, got 4 and 7 alike"):
        prepare_demixing(same, frames_of(images))
    # Alike beside the background alone: it is up to rounding whether the factorisation fails.
    with monkeypatch.context() as patch:
        patch.setattr("numpy.linalg.cholesky", fail)
        patch.setattr("gs_jax.reconstruction.demixing._LEAST", -1.0)
        with pytest.raises(InputError, match="regions must cast different images, got 4 and 7 alike"):
            prepare_demixing(same, frames_of(images))
        one = images._replace(images=images.images[:1], numbers=np.array([5]))
        with pytest.raises(InputError, match="region 5 must cast an image unlike the background"):
            prepare_demixing(one, frames_of(images))
    # The brightest pixels alone, where there are many.
    monkeypatch.setattr("gs_jax.reconstruction.demixing._MOST", 3 * 1500)
    few = image_regions([bead[None] for bead in BEADS], SCOPE)
    assert few.images.shape == (3, 1500)
    np.testing.assert_allclose(few.images, images.images[:, few.pixels], rtol=1e-5, atol=1e-9)
    assert few.images.sum() > images.images.sum() * 1500 / images.images.shape[1]
    with pytest.raises(InputError, match="region 9 must cast light on the sensor"):
        image_regions([BEADS[:1], BEADS[:1] * [1, 1, 1, 0]], SCOPE, numbers=np.array([3, 9]))


def test_traces_of_volumes(recording, run):
    """Segmented, and by the label image that this wrote; a frame that failed has no row."""
    status, out, err = run("traces", recording, "-o", "t.csv", "--baseline", "0")
    assert (status, err) == (0, "") and "3 regions in 4 frames, dF/F over the percentile 0 % of all frames" in out
    table = read_traces("t.csv")
    assert list(table) == "region frame time_s x_mm y_mm z_mm mean background dff".split()
    assert table["frame"].tolist() == [0] * 3 + [1] * 3 + [2] * 3 + [4] * 3
    np.testing.assert_allclose(table["time_s"], table["frame"] / 2)
    # Cells by their depth and x; F is proportional to the light.
    cell = np.lexsort((table["x_mm"][:3], table["z_mm"][:3]))
    np.testing.assert_allclose(table["z_mm"][:3][cell], [20, 20, 21], rtol=1e-6)
    dff, lit = table["dff"].reshape(4, 3)[:, cell], LIGHT[[0, 1, 2, 4]]
    np.testing.assert_allclose(dff, lit / lit.min(0) - 1, atol=0.12)
    assert (recording.parent / "t.csv.png").exists()
    status, _, err = run("traces", recording, "-o", "t2.csv", "--baseline", "0", "--regions", "t.csv.labels.tif")
    assert (status, err) == (0, "")
    np.testing.assert_array_equal(read_traces("t2.csv")["dff"], table["dff"])
    assert not (recording.parent / "t2.csv.labels.tif").exists()


def test_traces_of_particles(folder, run):
    """As `--track` writes them; a particle may be missing from a frame."""
    rows = ["x_mm,y_mm,z_mm,intensity,frame,particle", "0.1,0,20,4,0,0", "0.1,0,20,8,1,0", "0.3,0,21,5,1,1"]
    (folder / "p.csv").write_text("\n".join([*rows, "0.3,0.1,21,5,2,1\n"]))
    status, out, err = run("traces", "p.csv", "-o", "t.csv", "--baseline", "0")
    assert (status, err) == (0, "") and "2 regions in 3 frames" in out
    table = read_traces("t.csv")
    assert table["region"].tolist() == [0, 0, 1, 1] and table["frame"].tolist() == [0, 1, 1, 2]
    np.testing.assert_allclose(table["dff"], [0, 1, 0, 0])
    assert table["y_mm"].tolist() == [0, 0, 0, 0.1] and table["intensity"].tolist() == [4, 8, 5, 5]


@pytest.mark.integration
def test_traces_of_captures(folder, run, images):
    """Points without a volume, and the regions of a volume; the report has the table."""
    np.save("frames.npy", frames_of(images).astype(np.float32))
    gs.write_points("p.csv", BEADS)
    status, out, err = run("traces", "p.csv", "--demix", "frames.npy", "--design", "design.toml", "-o", "t.csv")
    assert status == 0 and "3 regions in 4 frames" in out and "demixed in 7680 of 7680 pixels" in out
    table = read_traces("t.csv")
    assert list(table)[-3:] == ["demixed", "demixed_se", "dff"]
    np.testing.assert_allclose(table["demixed"].reshape(4, 3), TRUTH, atol=0.12 * TRUTH.max())
    status, _, err = run("report", "design.toml", "--traces", "t.csv", "-o", "r.html")
    assert (status, err) == (0, "") and "3 regions in 4 frames." in (folder / "r.html").read_text()


def test_captures_of_a_channel_with_saturated_pixels_and_moving_particles(folder, run, images, monkeypatch):
    """The channel's light, a warning about frames and one about particles; the provenance has all files."""
    (folder / "green.toml").write_text(f"{DESIGN}\n[channels.GFP]\nwavelength_nm = 450.0\n")
    frames = np.clip(frames_of(images), 0, 4095).astype(np.uint16)
    frames[1:, :8, :8] = 65535
    stack = np.stack([np.zeros_like(frames), frames], axis=1)
    tifffile.imwrite("f.ome.tif", stack, metadata={"axes": "TCYX", "Channel": {"Name": ["DAPI", "GFP"]}}, ome=True)
    np.save("dark.npy", np.zeros((96, 80), np.float32))
    rows = [
        f"{x + 0.08 * t * (k == 1)},{y},{z},1,{t},{k + 4}" for t in range(4) for k, (x, y, z, _) in enumerate(BEADS)
    ]
    (folder / "p.csv").write_text("\n".join(["x_mm,y_mm,z_mm,intensity,frame,particle", *rows, ""]))
    seen = []
    monkeypatch.setattr(
        "gs_jax.reconstruction.demixing.image_regions",
        lambda regions, imager, *, numbers, progress: seen.append(imager) or images._replace(numbers=numbers),
    )
    words = ("p.csv", "--demix", "f.ome.tif", "--design", "green.toml", "--channel", "GFP", "--dark", "dark.npy")
    status, _, err = run("traces", *words, "-o", "t.csv")
    assert status == 0 and "in 3 frames, the first: f.ome.tif" in err and "saturated" in err, err
    assert "1 of 3 particles move by more than a pixel" in err and err.count("warning") == 2
    assert float(seen[0].wavelength) == pytest.approx(450e-6) and read_traces("t.csv")["demixed"].max() > 1e7
    _, out, _ = run("info", "t.csv")
    assert "input dark.npy" in out and "green.toml" in out


def test_traces_of_one_frame(folder, run):
    """It has no deviation, and the message says what to do."""
    VolumeSeries(folder / "v.zarr", 1, GRID).write(0, blobs(LIGHT[0]))
    status, _, err = run("traces", "v.zarr", "-o", "t.csv")
    assert status == 2 and "give --segment mean, --regions or --from-points" in err
    status, out, err = run("traces", "v.zarr", "-o", "t.csv", "--segment", "mean")
    assert (status, err) == (0, "") and "3 regions in 1 frame" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("v.zarr", "-o", "t.txt"), "suffix must be .csv, .h5"),
        (("capture.tif", "-o", "t.csv"), "must be VOLUME.zarr of a recording by gs-jax reconstruct, or POINTS.csv"),
        (("none.csv", "-o", "t.csv"), "none.csv: cannot be read"),
        (("p.csv", "-o", "t.csv"), "must have the columns frame and particle"),
        (("p.csv", "-o", "t.csv", "--segment", "mean"), "--segment must be used with VOLUME.zarr"),
        (("v.zarr", "-o", "t.csv", "--demix", "frames.npy"), "--demix must be used with --design"),
        (("v.zarr", "-o", "t.csv", "--design", "design.toml"), "--design must be used with --demix"),
        (("v.zarr", "-o", "t.csv", "--binning", "2"), "--binning must be used with --demix"),
        (("v.zarr", "-o", "t.csv", "--radius-um", "20,500"), "--radius-um must be used with --from-points"),
        (("v.zarr", "-o", "t.csv", "--radius-um", "20"), "must be XY,Z in um, got '20'"),
        (("v.zarr", "-o", "t.csv", "--baseline", "10,x"), "must be PERCENT or PERCENT,FRAMES"),
        (("v.zarr", "-o", "t.csv", "--from-points", "p.csv"), "point 1 must be within the volume"),
        (("v.zarr", "-o", "t.csv", "--from-points", "p.csv", "--segment", "mean"), "only one of --regions"),
        (("p.csv", "-o", "p.csv", "--force"), "the output must be another file than the inputs"),
        (
            ("p.csv", "-o", "t.csv", "--demix", "capture.tif", "--design", "design.toml"),
            "--demix must be a recording, got a single capture",
        ),
    ],
)
def test_wrong_input_is_one_line(recording, run, words, message):
    gs.write_points("p.csv", BEADS + [5.0, 0, 0, 0])
    np.save("frames.npy", np.zeros((3, 96, 80), np.float32))
    before = sorted(path.name for path in recording.parent.iterdir())
    status, out, err = run("traces", *words)
    assert (status, out, err.count("\n")) == (2, "", 1) and message in err, err
    assert sorted(path.name for path in recording.parent.iterdir()) == before


def test_what_a_person_made_stays(recording, run):
    (recording.parent / "t.csv").write_text("mine")
    status, _, err = run("traces", recording, "-o", "t.csv")
    assert status == 2 and "--force replaces it" in err and (recording.parent / "t.csv").read_text() == "mine"
    (recording.parent / "u.csv.labels.tif").write_text("mine")
    status, _, err = run("traces", recording, "-o", "u.csv")
    assert status == 2 and "--force replaces it" in err and not (recording.parent / "u.csv").exists()


@pytest.mark.integration
def test_beads_of_an_independent_ray_tracer():
    """Places are those that are found; a region's image is the model's."""
    small = {"lenses": 30, "pixels": 1600, "beads": 8, "frames": 8, "rays": 2000}
    numbers, _ = experiment.run(gs.geomscope(), 1.2, **small, progress=gs.Progress())
    assert (numbers["found"], numbers["false_points"]) == (8, 0)
    assert min(numbers["demixed"]) >= 0.98 and numbers["of_standard_error"] < 2
