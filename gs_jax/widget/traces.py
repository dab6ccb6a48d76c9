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
from .layers import frames_of, measure_points

# Pixels by which the mouse may move during a click.
_CLICK = 4


class Traces(Container):
    """Dock widget: a click on a point, or in a volume over time, plots the trace of the region there.

    `napari_viewer`: the viewer with the layers.
    """

    def __init__(self, napari_viewer):
        self.viewer = napari_viewer

        def recordings(_):
            return [layer for layer in napari_viewer.layers if isinstance(layer, Image) and layer.ndim == 4]

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

    @property
    def _is_closed(self) -> bool:
        """Whether it is in no dock any more; napari and the viewer's callbacks keep it."""
        return not (self.native.isVisible() or self.native.parent())

    def click(self, viewer, event):
        """Callback of napari for the mouse: plots the trace of where it is pressed and released without a drag."""
        pressed = np.array(event.pos)
        yield
        while event.type == "mouse_move":
            yield
        if event.button == 1 and not self._is_closed and np.abs(event.pos - pressed).max() <= _CLICK:
            try:
                self._start(*self._clicked(event))
            except InputError as error:
                show_error(str(error))

    def _clicked(self, event) -> tuple[str, list[Any], int]:
        """A name, the places in the world that share voxels, and which of these was clicked."""
        view = {"view_direction": event.view_direction, "dims_displayed": event.dims_displayed}
        for layer in reversed(self.viewer.layers):
            if isinstance(layer, Points) and (at := layer.get_value(event.position, **view, world=True)) is not None:
                # Points of other frames share nothing.
                shown = (layer.data[:, :-3] == layer.data[at, :-3]).all(axis=1)
                places = [layer.data_to_world(point) for point in layer.data[shown]]
                return f"Point {at + 1} of {layer.name}", places, np.count_nonzero(shown[:at])
        if len(event.dims_displayed) > 2:
            raise input_error("click in 3-D", "on a point", "none there")
        return "Region", [event.position], 0

    def _start(self, name: str, places: list[Any], number: int) -> None:
        """Measure in another thread, unless all of it is known, and plot."""
        image: Any = self.recording.value
        if self.worker:
            self.worker.quit()
        if image is None:
            raise input_error("recording", "an open layer of volumes over time (t, z, y, x)", "none")
        volumes, now = image.data[0] if image.multiscale else image.data, self.viewer.dims.point
        voxels = np.array([image.world_to_data([*now[: -len(place)], *place])[1:] for place in places])
        inside = (np.abs(voxels - np.clip(voxels, 0, np.subtract(volumes.shape[1:], 1))) <= 1).all(axis=1)
        place = zip("zyx", image.data_to_world([0, *voxels[number]])[1:], strict=True)
        where = f"{', '.join(f'{axis} {at:.1f}' for axis, at in place)} {image.units[-1]:~}"
        if not inside[number]:
            raise input_error(name, f"within {image.name}", where)
        frames, near, column = frames_of(volumes.shape[0], image.source.path), voxels[inside], sum(inside[:number])
        # A layer may go, and its volumes are not kept here.
        measured = weakref.ref(volumes), frames, near
        time, label = image.translate[0] + image.scale[0] * np.array(frames), f"t, {image.units[0]:~}"

        def show(done: int) -> None:
            self.status.value = f"Frame {done} of {len(frames)}"
            if self._is_closed:
                self.worker.quit()

        def finish(signals: dict[str, np.ndarray] | str) -> None:
            self.status.value = ""
            if isinstance(signals, str):
                show_error(signals)
                return
            self._measured = *measured, signals
            self._draw(f"{name}\n{where}", time, label, {key: each[:, column] for key, each in signals.items()})

        if self._measured:
            before, *request, signals = self._measured
            if before() is volumes and request[0] == frames and np.array_equal(request[1], near):
                finish(signals)
                return
        self.worker = create_worker(_measure, volumes, frames, near, _start_thread=False)
        self.worker.yielded.connect(show)
        self.worker.returned.connect(finish)
        self.worker.start()

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
        """Mark the frame that the viewer shows."""
        for line in self._now:
            line.set_xdata(self.viewer.dims.point[-4:-3])
        self.canvas.draw_idle()


def _measure(volumes, frames, voxels):
    """`measure_points`, or what is wrong in words."""
    try:
        return (yield from measure_points(volumes, frames, voxels))
    except InputError as error:
        return str(error)
