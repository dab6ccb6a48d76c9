"""napari's widget, without a window: what it makes of a toy capture, how far it says it is, and what it says is wrong.

Drawing needs OpenGL, which Qt has not got without a screen; layers, fields and threads do not.
"""

import re
import sys
import threading
import time
import traceback
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gs_jax import Grid
from gs_jax.io.point_tables import write_points
from gs_jax.io.traces import read_traces
from gs_jax.io.volumes import read_volume, write_surface, write_volume
from gs_jax.solvers import base

from .helpers import DESIGN
from .test_recording import bead_frames
from .test_traces import CELLS, GRID, recording  # noqa: F401
from .test_widget_layers import tracks  # noqa: F401

MANIFEST = Path(__file__).parents[1] / "gs_jax" / "napari.yaml"
# What napari and its libraries use of each other is theirs to renew.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
# Of a test that hangs, seconds.
_LONGEST = 300


@pytest.fixture(scope="module")
def napari(tmp_path_factory):
    """napari and Qt, or skip and say what is missing."""
    with pytest.MonkeyPatch.context() as patch:
        # Python's own, PyQt ends the process after.
        patch.setattr(sys, "excepthook", lambda *found: traceback.print_exception(*found))
        patch.setenv("QT_QPA_PLATFORM", "offscreen")
        patch.setenv("NAPARI_CONFIG", str(tmp_path_factory.mktemp("napari") / "settings.yaml"))
        found = pytest.importorskip("napari", reason="no napari: pip install 'gs-jax[napari]'")
        widgets = pytest.importorskip(
            "qtpy.QtWidgets", reason="Qt does not start: apt-get install libegl1", exc_type=ImportError
        )
        kept = widgets.QApplication.instance() or widgets.QApplication([])
        yield found
        del kept


@pytest.fixture
def viewer(napari):
    from napari.components import ViewerModel

    return ViewerModel()


@pytest.fixture
def widget(viewer, folder):
    """The widget of a viewer, with the toy's design and depths."""
    from gs_jax.widget.widget import Reconstruct

    made = Reconstruct(viewer)
    made.design_file.value, made.depths.value, made.voxel.value = folder / "design.toml", "18:22:1", 50.0
    return made


def wait(what) -> None:
    """Lets Qt work until `what` is so."""
    from qtpy.QtWidgets import QApplication

    began = time.monotonic()
    while not what():
        QApplication.processEvents()
        assert time.monotonic() - began < _LONGEST
        time.sleep(0.001)


def until(widget, what=lambda: False) -> None:
    """Lets Qt work until the widget is done, or `what` is so."""
    wait(lambda: widget.run.enabled or what())


def errors() -> list[str]:
    """What napari has shown as wrong, and forgets now."""
    from napari.utils.notifications import notification_manager

    found = [note.message for note in notification_manager.records if str(note.severity) != "info"]
    notification_manager.records.clear()
    return found


def test_the_manifest_is_valid(napari):
    from npe2 import PluginManifest

    manifest = PluginManifest.from_file(MANIFEST)
    manifest.validate_imports()
    made = manifest.contributions
    assert [len(each or []) for each in (made.readers, made.widgets, made.sample_data)] == [1, 2, 1]


@pytest.mark.parametrize("name", ["v.ome.tif", "v.zarr"])
def test_napari_opens_files_to_scale(viewer, tmp_path, name):
    """Through the readers that napari finds by itself; a point is shown in the plane that it is next to."""
    from npe2 import PluginManager

    PluginManager.instance().discover()
    grid = Grid([18.0, 18.5, 19.0], (5, 4), 0.04, (1.0, -2.0))
    write_volume(tmp_path / name, np.random.default_rng(0).random(grid.volume_shape, np.float32), grid)
    write_points(tmp_path / "p.csv", np.array([[1.0, -2.0, 18.6, 1.0]]))
    (volume,) = viewer.open(tmp_path / name, plugin="gs-jax")
    (points,) = viewer.open(tmp_path / "p.csv", plugin="gs-jax")
    np.testing.assert_allclose(volume.extent.world, [[18000, -2080, 940], [19000, -1920, 1060]])
    assert {str(unit) for unit in viewer.layers.extent.units} == {"micrometer"}
    np.testing.assert_allclose(points.data_to_world(points.data[0]), [18600, -2000, 1000])
    for depth, shown in ((18000, 0), (18500, 1), (19000, 0)):
        viewer.dims.set_point(0, depth)
        assert len(points._view_data) == shown


@pytest.mark.parametrize("lit", [True, False])
def test_sheets_are_a_depth_map_and_a_surface_in_the_same_place(viewer, tmp_path, lit):
    """Also a dark sheet, which has no triangles."""
    from npe2 import PluginManager

    PluginManager.instance().discover()
    grid = Grid([18.0, 19.0], (5, 4), 0.04, (1.0, -2.0))
    depth = np.full((1, 5, 4), 18.5 if lit else np.nan, np.float32)
    write_surface(tmp_path / "s.ome.tif", np.ones_like(depth), depth, 0.01 * depth, grid)
    shown, surface = viewer.open(tmp_path / "s.ome.tif", plugin="gs-jax")
    assert (type(shown).__name__, type(surface).__name__) == ("Image", "Surface")
    np.testing.assert_allclose(shown.extent.world, [[-2080, 940], [-1920, 1060]])
    if lit:
        np.testing.assert_allclose(surface.extent.world, [[18500, -2080, 940], [18500, -1920, 1060]])
        assert len(surface.faces) == 2 * 4 * 3 and shown.data[2, 2] == 18500


def test_a_file_becomes_what_the_command_writes(widget, viewer, folder, run):
    widget.file.value = folder / "capture.tif"
    widget.run.clicked.emit(True)
    assert widget.cancel.enabled and not widget.run.enabled
    until(widget)
    assert errors() == []
    words = ("reconstruct", "capture.tif", "design.toml", "--depths", "18:22:1", "--voxel-um", "50", "-o", "v.tif")
    assert run(*words)[0] == 0
    volume, grid = read_volume(folder / "v.tif")
    (layer,) = viewer.layers
    assert layer.name == "capture.tif, backproject" and not widget.cancel.enabled
    np.testing.assert_allclose(layer.data, volume, rtol=1e-5)
    np.testing.assert_allclose(layer.scale, [1000, 50, 50])
    first = [18000, 1000 * float(grid.y[0]), 1000 * float(grid.x[0])]
    np.testing.assert_allclose(layer.translate, first)
    low, high = layer.contrast_limits
    assert volume.min() <= low < high <= volume.max()
    assert widget.status.value == "5 x 39 x 33 voxels (z, y, x), 50 um laterally, 5 depths from 18 to 22 mm"


def test_a_layer_becomes_points_in_the_same_place(widget, viewer):
    """The capture is put where the sensor is, so that all layers are in um, and the middle depth is shown."""
    (pixels,) = bead_frames([[0.1]])
    viewer.add_image(np.zeros((3, 96, 80)), name="a stack")
    viewer.layers.clear()
    capture = viewer.add_image(pixels, name="seen")
    widget.reset_choices()
    assert widget.layer.choices == (capture,) and widget.layer.value is capture
    widget.suppress.value, widget.points.value = "clusters", True
    widget.run.clicked.emit(True)
    until(widget)
    assert errors() == []
    _, volume, points = viewer.layers
    assert volume.name == "seen, clusters" and points.name == f"seen, {len(points.data)} points"
    np.testing.assert_allclose(capture.extent.world, [[-950, -790], [950, 790]])
    assert {str(unit) for unit in viewer.layers.extent.units} == {"micrometer"}
    assert viewer.dims.point[0] == 20000


@pytest.fixture
def fourth_step(widget, folder, monkeypatch):
    """A run that waits in its fourth step, in another thread, while this one is free: the threads of steps, and what
    lets it go on."""
    step, taken, goes_on = base._step_in_place, [], threading.Event()

    def slow(*arguments):
        taken.append(threading.current_thread())
        if len(taken) == 4:
            assert goes_on.wait(_LONGEST)
        return step(*arguments)

    monkeypatch.setattr(base, "_step_in_place", slow)
    widget.file.value, widget.method.value = folder / "capture.tif", "list-rl"
    widget.run.clicked.emit(True)
    until(widget, lambda: widget.status.value.startswith("Iterating: 3 of 20, about "))
    yield taken, goes_on
    goes_on.set()


def test_progress_is_shown_and_cancel_ends_between_two_steps(widget, viewer, fourth_step):
    taken, goes_on = fourth_step
    assert (widget.bar.native.value(), widget.bar.native.maximum()) == (3, 20)
    widget.cancel.clicked.emit(True)
    assert widget.status.value == "Stops after this step."
    goes_on.set()
    until(widget)
    assert widget.status.value == "Cancelled." and len(taken) == 4 and not viewer.layers and errors() == []
    assert threading.main_thread() not in taken
    widget.method.value = "backproject"
    widget.run.clicked.emit(True)
    until(widget)
    assert len(viewer.layers) == 1


def test_a_widget_that_is_closed_ends_its_work(widget, viewer, fourth_step):
    from napari.qt.threading import WorkerBase
    from qtpy.QtCore import QEvent
    from qtpy.QtWidgets import QApplication

    taken, goes_on = fourth_step
    widget.native.deleteLater()
    QApplication.sendPostedEvents(widget.native, QEvent.Type.DeferredDelete.value)
    goes_on.set()
    WorkerBase.await_workers(1000 * _LONGEST)
    QApplication.processEvents()
    assert len(taken) == 4 and not viewer.layers and errors() == []


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("design_file", "wrong.toml", "`lens.refractive_index` must be a number above 1, up to 5, .*got -1"),
        ("design_file", "none.toml", "none.toml: "),
        ("depths", "18:17:1", "Depths must have .* got '18:17:1'"),
        ("voxel", 0.01, "at most .* GiB of the free memory"),
        ("suppress", "unet", "--suppress unet must be used with --method backproject, got fista"),
        ("file", "small.npy", "image must be 96 x 80, .*small.npy"),
    ],
)
def test_what_is_wrong_is_one_line(widget, viewer, folder, field, value, message):
    (folder / "wrong.toml").write_text(DESIGN.replace("refractive_index = 1.43", "refractive_index = -1"))
    np.save(folder / "small.npy", np.zeros((5, 4), np.uint16))
    widget.file.value, widget.method.value = folder / "capture.tif", "fista" if field == "suppress" else "backproject"
    getattr(widget, field).value = value
    widget.run.clicked.emit(True)
    until(widget)
    (found,) = errors()
    assert "\n" not in found and not viewer.layers and widget.run.enabled
    assert re.search(message, found), found


def test_a_layer_that_is_no_capture_is_refused(widget, viewer):
    widget.run.clicked.emit(True)
    assert errors() == ["Capture must be a layer or a file, got none."]
    viewer.add_image(np.zeros((96, 80)), name="double")
    widget.reset_choices()
    widget.run.clicked.emit(True)
    until(widget)
    (found,) = errors()
    assert found.startswith("double: the layer must have 96 x 80 pixels (rows x columns")


def test_live_replaces_the_layers_of_the_newest_capture(widget, viewer, folder):
    frames = folder / "run"
    frames.mkdir()
    widget.folder.value, widget.suppress.value, widget.points.value = frames, "clusters", True
    widget.live.clicked.emit(True)
    assert widget.cancel.enabled and not widget.run.enabled and not widget.live.enabled
    rng = np.random.default_rng(0)
    pixels, made = rng.integers(90, 110, (96, 80)).astype(np.uint16), []
    for name in ("f1.npy", "f2.npy"):
        pixels[40 + 8 * len(made), 30:34] = 4000
        np.save(frames / f".{name}", pixels)
        (frames / f".{name}").rename(frames / name)
        until(widget, lambda name=name: any(each.name == f"{name}, clusters" for each in viewer.layers))
        volume, points = viewer.layers
        made.append((volume, points, np.array(volume.data)))
        assert points.name.startswith(f"{name}, ") and len(points.features) == len(points.data)
    assert made[0][:2] == made[1][:2] and not np.array_equal(made[0][2], made[1][2])
    assert re.match(r"f2.npy, \d+ ms after it was written", widget.status.value)
    # A bad capture is told of, and the next one is made.
    np.save(frames / "f3.npy", np.zeros((5, 4), np.uint16))
    until(widget, lambda: any("f3.npy" in each for each in errors()))
    np.save(frames / "f4.npy", pixels)
    until(widget, lambda: volume.name == "f4.npy, clusters")
    widget.cancel.clicked.emit(True)
    until(widget)
    assert widget.status.value == "Cancelled." and len(viewer.layers) == 2 and widget.live.enabled


def test_live_needs_a_folder(widget):
    widget.live.clicked.emit(True)
    assert errors() == ["The folder must be one into which a camera writes, got none."]


def click(viewer, *place, dragged: int = 0) -> None:
    """Press the mouse at a place in the world, and release it so many pixels beside."""
    from napari.utils.interactions import mouse_press_callbacks, mouse_release_callbacks

    view = {"position": place, "view_direction": None, "dims_displayed": list(viewer.dims.displayed)}
    event = SimpleNamespace(type="mouse_press", pos=(5, 5), button=1, modifiers=(), **view)
    mouse_press_callbacks(viewer, event)
    event.type, event.pos = "mouse_release", (5, 5 + dragged)
    mouse_release_callbacks(viewer, event)


@pytest.fixture
def traces(viewer, recording):  # noqa: F811
    """The widget of a viewer with a recording of cells in um."""
    from npe2 import PluginManager

    from gs_jax.widget.traces import Traces

    PluginManager.instance().discover()
    viewer.open(recording, plugin="gs-jax")
    made = Traces(viewer)
    made.native.show()
    yield made
    made.native.hide()


def plotted(traces, title: str) -> list[np.ndarray]:
    """Lines of the trace of this title when it is there: mean, background and dF/F over time."""
    wait(lambda: traces.figure.axes and traces.figure.axes[0].get_title().startswith(title))
    light, change = traces.figure.axes
    return [np.array(line.get_data()) for line in (*light.lines[:2], *change.lines[:1])]


def test_a_clicked_point_has_the_trace_that_the_command_writes(traces, viewer, folder, run):
    """Of a point among others, which the one beside it lies near, and of a place in the volume."""
    places = GRID.to_mm(np.array(CELLS)) + np.array([0.003, -0.004, 0.2])
    write_points(folder / "p.csv", np.column_stack([places, np.ones(3)]))
    write_points(folder / "one.csv", np.column_stack([places, np.ones(3)])[1:2])
    (points,) = viewer.open(folder / "p.csv", plugin="gs-jax")
    points.size = 60
    world = (0.0, *1000 * places[1, ::-1])
    viewer.dims.set_point((0, 1), (0.5, world[1]))
    for title, table in (("Point 2 of p.csv\nz 20200.0, y ", "p.csv"), ("Region\nz 20200.0, y ", "one.csv")):
        assert run("traces", "v.zarr", "--from-points", table, "-o", "t.csv", "--force")[0] == 0
        rows = read_traces("t.csv")
        click(viewer, *world, dragged=9)
        click(viewer, *world)
        lines = plotted(traces, title)
        for line, name in zip(lines, ("mean", "background", "dff"), strict=True):
            chosen = rows["region"] == (2 if table == "p.csv" else 1)
            np.testing.assert_allclose(line, [rows["time_s"][chosen], rows[name][chosen]], rtol=1e-6)
        points.visible = False
    assert traces.figure.axes[1].lines[1].get_xdata() == (0.5,)
    viewer.dims.set_point(0, 1.0)
    assert traces.figure.axes[1].lines[1].get_xdata() == (1.0,)
    # All points of a layer are measured at once.
    points.visible = True
    for number in (1, 3):
        worker = traces.worker
        viewer.dims.set_point(1, 1000 * places[number - 1, 2])
        click(viewer, 0.0, *1000 * places[number - 1, ::-1])
        plotted(traces, f"Point {number} of p.csv")
    assert traces.worker is worker and errors() == []
    # Without the recording there is no frame to mark.
    viewer.layers.clear()
    traces.canvas.draw()
    assert not traces.figure.axes[1].lines[1].get_visible()


def test_points_of_a_frame_and_volumes_without_a_scale(traces, viewer):
    """A layer of any program: its regions are in voxels, and points of other frames are in no way of it."""
    volumes = viewer.layers[0].data[:]
    viewer.layers.clear()
    viewer.add_image(volumes, name="plain")
    viewer.add_points([[0, *CELLS[0]], [1, *CELLS[0]], [1, *CELLS[1]]], name="cells", size=2)
    traces.reset_choices()
    viewer.dims.set_point((0, 1), (1, CELLS[0][0]))
    click(viewer, 1.0, *CELLS[0])
    (mean, *_), label = plotted(traces, "Point 2 of cells\nz 1.0, y 10.0, x 12.0 pixel"), "t, pixel"
    assert traces.figure.axes[1].get_xlabel() == label and mean[0].tolist() == [0, 1, 2, 3, 4]
    z, y, x = CELLS[0]
    inside = [
        *volumes[:, z, y - 1 : y + 2, x - 1 : x + 2].reshape(5, 9).T,
        volumes[:, z - 1, y, x],
        volumes[:, z + 1, y, x],
    ]
    np.testing.assert_allclose(mean[1], np.mean(inside, 0), rtol=1e-6)


def test_what_has_no_trace_is_one_line(traces, viewer):
    viewer.dims.set_point(1, 20000)
    click(viewer, 0.0, 20000.0, 9000.0, 0.0)
    assert errors() == ["Region must be within v.zarr, got z 20000.0, y 9000.0, x 0.0 µm."]
    viewer.dims.ndisplay = 3
    click(viewer, 0.0, 20000.0, 0.0, 100.0)
    assert errors() == ["click in 3-D must be on a point, got none there."]
    viewer.dims.ndisplay = 2
    place, far = [20000.0, 0.0, 100.0], [20000.0, 9000.0, 0.0]
    viewer.add_points([far, far, place, place], size=100, units=("um",) * 3, axis_labels=tuple("zyx"))
    click(viewer, 0.0, *place)
    found = []
    wait(lambda: found.extend(errors()) or found)
    assert re.fullmatch("point [34] must have a voxel of its own, got one that is nearer to another point.", *found)
    viewer.layers.clear()
    viewer.add_image(np.zeros((2, 2, 4, 4, 3), np.uint8), rgb=True)
    traces.reset_choices()
    click(viewer, 0.0, 20000.0, 0.0, 0.0)
    assert errors() == ["recording must be an open layer of volumes over time (t, z, y, x), got none."]
    traces.native.hide()
    click(viewer, 0.0, 20000.0, 0.0, 0.0)
    assert errors() == [] and traces.click not in viewer.mouse_drag_callbacks


def test_a_later_click_stops_a_measurement_unless_it_has_no_trace(traces, viewer, monkeypatch):
    """What comes late from the earlier one is ignored; what cannot be read is one line."""
    goes_on = threading.Event()

    def measure(*_):
        yield 1
        assert goes_on.wait(_LONGEST)
        raise OSError("the disk is gone")

    monkeypatch.setattr("gs_jax.widget.traces.measure_points", measure)
    viewer.dims.set_point(1, 20000)
    click(viewer, 0.0, 20000.0, 0.0, 100.0)
    wait(lambda: traces.status.value == "Frame 1 of 4")
    earlier = traces.worker
    click(viewer, 0.0, 20000.0, 9000.0, 0.0)
    assert len(errors()) == 1 and traces.worker is earlier and not earlier.abort_requested
    click(viewer, 0.0, 20000.0, 0.0, 120.0)
    assert traces.worker is not earlier and earlier.abort_requested
    earlier.yielded.emit(9)
    earlier.returned.emit("late")
    assert "9" not in traces.status.value and errors() == []
    goes_on.set()
    found = []
    wait(lambda: found.extend(errors()) or found)
    assert found == ["v.zarr: the disk is gone"]
    wait(lambda: not traces.status.value)


def test_tracks_lie_where_the_volume_is(viewer, tracks):  # noqa: F811
    from npe2 import PluginManager

    PluginManager.instance().discover()
    (layer,) = viewer.open(tracks, plugin="gs-jax")
    assert type(layer).__name__ == "Tracks" and [str(unit) for unit in layer.units] == ["second", *["micrometer"] * 3]
    np.testing.assert_allclose(layer.extent.world, [[0, 20000, -100, 0], [1.5, 20600, 0, 300]])
    assert layer.properties["duration_s"].tolist() == [0, 1.5, 1.5]
    layer.color_by = "speed_mm_s"
    assert np.isfinite(layer.track_colors).all()
