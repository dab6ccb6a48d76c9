"""Dock widget of napari that plots the trace of a clicked point, as `gs-jax traces` measures it.

`napari.yaml` names it. The work runs in another thread.
"""

import weakref
from typing import Any

import numpy as np
from magicgui.widgets import ComboBox, Container, Label
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg, NavigationToolbar2QT
from matplotlib.figure import Figure
from napari.layers import Image, Points
from napari.qt.threading import create_worker
from napari.utils.notifications import show_error, show_warning

from ..base.errors import InputError, input_error
from ..io.ngff import frames_of
from .layers import measure_points

# Pixels by which the mouse may move during a click.
_CLICK = 4


class Traces(Container):
    """Dock widget: a click on a point, or in a volume over time, plots the trace of the region there.

    `napari_viewer`: the viewer with the layers.
    """

    def __init__(self, napari_viewer):
        self.viewer = napari_viewer

        def recordings(_):
            images = [layer for layer in napari_viewer.layers if isinstance(layer, Image)]
            return [layer for layer in images if layer.ndim == 4 and not layer.rgb]

        tip = "An open layer of volumes over time (t, z, y, x)."
        self.recording = ComboBox(label="Recording", choices=recordings, tooltip=tip)
        self.status = Label(label=" ", value="Click on a point, or in the volume.")
        super().__init__(widgets=[self.recording, self.status])
        self.figure = Figure(figsize=(4, 4), layout="constrained")
        self.canvas = FigureCanvasQTAgg(self.figure)
        for plot in (self.canvas, NavigationToolbar2QT(self.canvas, self.native)):
            self.native.layout().addWidget(plot)
        self.worker: Any = None
        # Of the last measurement: the volumes, its frames and places, and the signals.
        self._measured: Any = None
        self._now: list[Any] = []
        napari_viewer.mouse_drag_callbacks.append(self.click)
        napari_viewer.dims.events.point.connect(self._show_now)

    def _is_open(self) -> bool:
        """Whether it is in a dock; the viewer's callbacks keep it after, and are removed when it is found closed."""
        found, callbacks = bool(self.native.isVisible() or self.native.parent()), self.viewer.mouse_drag_callbacks
        if not found and self.click in callbacks:
            callbacks.remove(self.click)
            self.viewer.dims.events.point.disconnect(self._show_now)
        return found

    def click(self, viewer, event):
        """Callback of napari for the mouse: plots the trace of where it is pressed and released without a drag."""
        pressed = np.array(event.pos)
        yield
        while event.type == "mouse_move":
            yield
        if event.button == 1 and self._is_open() and np.abs(event.pos - pressed).max() <= _CLICK:
            try:
                self._start(*self._clicked(event))
            except InputError as error:
                show_error(str(error))

    def _clicked(self, event) -> tuple[str, dict[int, Any], int]:
        """A name, the places in the world that share voxels, by number, and the number of the clicked one."""
        view = {"view_direction": event.view_direction, "dims_displayed": event.dims_displayed}
        for layer in reversed(self.viewer.layers):
            if isinstance(layer, Points) and (at := layer.get_value(event.position, **view, world=True)) is not None:
                # Points of other frames share nothing.
                shown = (layer.data[:, :-3] == layer.data[at, :-3]).all(axis=1)
                places = {int(n) + 1: layer.data_to_world(layer.data[n]) for n in np.flatnonzero(shown)}
                return f"Point {at + 1} of {layer.name}", places, at + 1
        if len(event.dims_displayed) > 2:
            raise input_error("click in 3-D", "on a point", "none there")
        return "Region", {1: event.position}, 1

    def _start(self, name: str, places: dict[int, Any], clicked: int) -> None:
        """Measure in another thread, unless all of it is known, and plot."""
        image: Any = self.recording.value
        if image is None:
            raise input_error("recording", "an open layer of volumes over time (t, z, y, x)", "none")
        volumes, now = image.data[0] if image.multiscale else image.data, self.viewer.dims.point
        voxels = np.array([image.world_to_data([*now[: -len(place)], *place])[1:] for place in places.values()])
        inside = (np.abs(voxels - np.clip(voxels, 0, np.subtract(volumes.shape[1:], 1))) <= 1).all(axis=1)
        at, numbers = list(places).index(clicked), np.array(list(places))
        place = zip("zyx", image.data_to_world([0, *voxels[at]])[1:], strict=True)
        where = f"{', '.join(f'{axis} {value:.1f}' for axis, value in place)} {image.units[-1]:~}"
        if not inside[at]:
            raise input_error(name, f"within {image.name}", where)
        frames, near, column = frames_of(volumes.shape[0], image.source.path), voxels[inside], sum(inside[:at])
        # A layer may go, and its volumes are not kept here.
        measured = weakref.ref(volumes), frames, near
        time, label = image.translate[0] + image.scale[0] * np.array(frames), f"t, {image.units[0]:~}"

        def show(done: int) -> None:
            if not self._is_open():
                worker.quit()
            # Signals of a worker may arrive after a later click made it quit.
            if not worker.abort_requested:
                self.status.value = f"Frame {done} of {len(frames)}"

        def finish(found: dict[str, np.ndarray] | str) -> None:
            if worker.abort_requested:
                return
            if isinstance(found, str):
                show_error(found)
                return
            draw(found)

        def clear() -> None:
            if not worker.abort_requested:
                self.status.value = ""

        def draw(signals: dict[str, np.ndarray]) -> None:
            self._measured = *measured, signals
            self._draw(f"{name}\n{where}", time, label, {key: each[:, column] for key, each in signals.items()})

        if self.worker:
            self.worker.quit()
        self.status.value = ""
        if self._measured:
            before, *request, signals = self._measured
            if before() is volumes and request[0] == frames and np.array_equal(request[1], near):
                draw(signals)
                return
        work: Any = _measure
        self.worker = worker = create_worker(
            work, image.name, volumes, frames, near, numbers[inside], _start_thread=False
        )
        worker.yielded.connect(show)
        worker.returned.connect(finish)
        worker.finished.connect(clear)
        worker.start()

    def _draw(self, title: str, time: np.ndarray, label: str, signals: dict[str, np.ndarray]) -> None:
        self.figure.clear()
        light, change = self.figure.subplots(2, 1, sharex=True)
        for name in ("mean", "background"):
            light.plot(time, signals[name], label=name)
        light.set_title(title, fontsize="medium")
        light.legend()
        change.plot(time, signals["dff"])
        change.set(xlabel=label, ylabel="dF/F")
        if not np.isfinite(signals["dff"]).any():
            show_warning(f"{title.splitlines()[0]}: the baseline is not above 0, and dF/F is nan")
        self._now = [axes.axvline(color="0.5", lw=1) for axes in (light, change)]
        self._show_now()

    def _show_now(self, _event=None) -> None:
        """Mark the frame that the viewer shows, if it has layers over time."""
        now = self.viewer.dims.point[-4:-3]
        for line in self._now:
            line.set_visible(bool(now))
            line.set_xdata(now or (0.0,))
        self.canvas.draw_idle()


def _measure(name, volumes, frames, voxels, numbers):
    """`measure_points` in the layer of this name, or what is wrong in words."""
    try:
        return (yield from measure_points(volumes, frames, voxels, numbers))
    except InputError as error:
        return str(error)
    except OSError as error:
        return f"{name}: {error.strerror or error}"
