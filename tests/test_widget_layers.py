"""What napari's widget makes of captures, without napari."""

import re
import sys
from threading import Thread

import numpy as np
import pytest

from gs_jax.base.errors import InputError
from gs_jax.base.progress import CancellableProgress, Cancelled
from gs_jax.detection.particles import tracks_table
from gs_jax.io.point_tables import write_points, write_rows
from gs_jax.io.volumes import read_volume
from gs_jax.reconstruction.traces import RegionSignals, regions_of_points, relative_change
from gs_jax.widget.layers import Newest, measure_points, newest_captures, prepare_layers, reader

from .test_traces import CELLS, GRID, LIGHT, blobs


def test_the_newest_result_is_never_lost():
    """Put by one thread while another takes: what was put last is taken, and nothing twice or out of order."""
    newest, last, taken = Newest(), 20_000, []
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        thread = Thread(target=lambda: [newest.put(number) for number in range(1, last + 1)])
        thread.start()
        while thread.is_alive():
            taken.append(newest.take())
    finally:
        sys.setswitchinterval(interval)
    found = [number for number in (*taken, newest.take()) if number is not None]
    assert found[-1] == last and found == sorted(set(found)) and newest.take() is None


def test_a_capture_becomes_what_the_command_writes(folder, run):
    progress = CancellableProgress(lambda: False)
    make = prepare_layers(folder / "design.toml", "18:22:1", 50.0, "backproject", "none", False, progress)
    result = make("seen", folder / "capture.tif")
    ((volume, described, _),) = result.layers
    assert described["name"] == "seen, backproject"
    assert result.status == "5 x 39 x 33 voxels (z, y, x), 50 um laterally, 5 depths from 18 to 22 mm"
    words = ("reconstruct", "capture.tif", "design.toml", "--depths", "18:22:1", "--voxel-um", "50", "-o", "v.tif")
    assert run(*words)[0] == 0
    # Float32 sums in another order.
    np.testing.assert_allclose(volume, read_volume(folder / "v.tif")[0], rtol=1e-5)


@pytest.mark.integration
def test_deviations_are_a_layer(folder):
    progress = CancellableProgress(lambda: False)
    image = np.random.default_rng(0).integers(7, 90, (96, 80)).astype(np.uint16)
    make = prepare_layers(folder / "design.toml", "20", 50.0, "backproject", "none", False, progress, deviation=True)
    (deviation, described, _), (volume, _, _) = make("seen", image).layers
    assert described["name"] == "seen, standard deviation" and described["colormap"] == "viridis"
    assert deviation.shape == volume.shape and (deviation[volume > 0] > 0).all()
    with pytest.raises(InputError, match="Deviation must be used with --suppress none"):
        prepare_layers(folder / "design.toml", "20", 50.0, "backproject", "points", False, progress, deviation=True)


def test_the_newest_capture_of_a_folder_is_made_until_the_user_cancels(tmp_path, folder):
    pytest.importorskip("watchfiles", reason="no watchfiles: pip install 'gs-jax[live]'")
    frames, cancelled = tmp_path / "run", []
    frames.mkdir()
    progress = CancellableProgress(lambda: bool(cancelled))
    make = prepare_layers(folder / "design.toml", "18:22:1", 50.0, "backproject", "none", False, progress)
    results = newest_captures(frames, make, progress)
    for name in ("f1.tif", "f2.tif"):
        (frames / name).write_bytes((folder / "capture.tif").read_bytes())
        result = next(results)
        assert re.match(rf"{name}, \d+ ms after it was written", result.status)
        assert result.layers[0][1]["name"] == f"{name}, backproject"
    cancelled.append(True)
    with pytest.raises(Cancelled):
        next(results)


@pytest.fixture
def tracks(tmp_path):
    """A table of tracks, of a particle that moves and one that is seen once, and their points beside it."""
    frames, particles = np.array([0, 0, 3]), np.array([4, 2, 4])
    points = np.array([[0.0, 0.0, 20.0, 1.0], [0.2, -0.1, 20.5, 1.0], [0.3, 0.0, 20.6, 1.0]])
    write_points(tmp_path / "p.csv", points, {"frame": frames, "particle": particles})
    table = tracks_table(frames, particles, points[:, :3], 0.5)
    write_rows(tmp_path / "p.csv.tracks.csv", table, zip(*table.values(), strict=True), None)
    return tmp_path / "p.csv.tracks.csv"


def test_tracks_are_lines_in_um_with_durations_and_speeds(tracks):
    read = reader(str(tracks))
    assert read is not None
    ((vertices, described, kind),) = read(str(tracks))
    assert kind == "tracks" and described["scale"] == (0.5, 1, 1, 1) and described["units"] == ("s", "um", "um", "um")
    expected = [[4, 0, 20000, 0, 0], [2, 0, 20500, -100, 200], [4, 3, 20600, 0, 300]]
    np.testing.assert_allclose(vertices, expected)
    assert described["features"]["duration_s"].tolist() == [1.5, 0, 1.5]
    np.testing.assert_allclose(
        described["features"]["speed_mm_s"], [np.hypot(0.3, 0.6) / 1.5, 0, np.hypot(0.3, 0.6) / 1.5]
    )


def test_tracks_that_a_spreadsheet_saved(tracks):
    """With a byte order mark, and sorted otherwise."""
    read = reader(str(tracks))
    assert read is not None
    ((vertices, described, _),) = read(str(tracks))
    header, *rows = tracks.read_text().splitlines()
    tracks.write_text("\n".join([header, *rows[::-1], ""]), encoding="utf-8-sig")
    ((again, same, _),) = read(str(tracks))
    np.testing.assert_array_equal(again, vertices)
    for name, values in described["features"].items():
        np.testing.assert_array_equal(same["features"][name], values)


def test_tracks_without_their_points_are_one_line(tracks):
    read, beside = reader(str(tracks)), tracks.with_name("p.csv")
    assert read is not None
    write_points(beside, np.ones((2, 4)), {"particle": np.array([4, 4])})
    with pytest.raises(InputError, match="p.csv: must be a table of points by .*--track`, got no column frame"):
        read(str(tracks))
    write_points(beside, np.ones((2, 4)), {"frame": np.array([0, 1]), "particle": np.array([4, 4])})
    with pytest.raises(InputError, match="tracks.csv: must have the particles of p.csv"):
        read(str(tracks))
    beside.unlink()
    with pytest.raises(InputError, match="p.csv: cannot be read"):
        read(str(tracks))
    for name in ("t.csv", ".tracks.csv"):
        tracks = tracks.rename(tracks.with_name(name))
        with pytest.raises(InputError, match=f"table of tracks must be named POINTS.csv.tracks.csv, got '{name}'"):
            read(str(tracks))
    tracks = tracks.rename(tracks.with_name("p.csv.tracks.csv"))
    tracks.write_text(tracks.read_text().replace("last_frame", "last"))
    with pytest.raises(InputError, match="tracks.csv: must be a table of tracks, got no column last_frame"):
        read(str(tracks))


def test_points_in_voxels_are_measured_as_those_in_mm():
    volumes, frames = np.stack([blobs(light) for light in LIGHT]), [0, 2, 4]
    places = np.array(CELLS) + np.array([0.2, -0.1, 0.3])
    steps = measure_points(volumes, frames, places)
    assert [next(steps) for _ in frames] == [1, 2, 3]
    with pytest.raises(StopIteration) as stop:
        next(steps)
    points = GRID.to_mm(np.array(CELLS)) + np.array([0.3 * 0.02, -0.1 * 0.02, 0.2])
    regions = RegionSignals(regions_of_points(points, GRID))
    means, backgrounds = map(np.array, zip(*(regions(volumes[frame]) for frame in frames), strict=True))
    expected = {"mean": means, "background": backgrounds, "dff": relative_change(means - backgrounds)}
    for name, values in stop.value.value.items():
        np.testing.assert_array_equal(values, expected[name])
