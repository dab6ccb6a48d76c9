"""Dock widget of napari that reconstructs a capture as `gs-jax reconstruct` does.

`napari.yaml` names it. The work runs in another thread; a timer in this one shows its progress.
"""

from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from magicgui.widgets import (
    CheckBox,
    ComboBox,
    Container,
    FileEdit,
    FloatSpinBox,
    Label,
    LineEdit,
    ProgressBar,
    PushButton,
)
from napari.layers import Image, Layer
from napari.qt.threading import create_worker
from napari.utils.notifications import show_error, show_warning
from qtpy.QtCore import QTimer

from ..base.errors import InputError
from ..base.progress import CancellableProgress, Cancelled
from ..cli.options import METHODS, SUPPRESSIONS, find_design, shipped_designs
from .layers import Newest, Result, newest_captures, prepare_layers

# Milliseconds between updates of the progress bar.
_POLL_INTERVAL = 100


class Reconstruct(Container):
    """Dock widget: reconstructs a file or layer with a design, and adds the volume as a layer, to scale and in place.

    `napari_viewer`: the viewer with the layers.
    """

    def __init__(self, napari_viewer):
        self.viewer = napari_viewer
        # napari calls it again when layers come and go.
        captures: Callable = lambda _: [
            layer for layer in napari_viewer.layers if isinstance(layer, Image) and layer.ndim == 2 and not layer.rgb
        ]
        names = sorted((path.stem for path in shipped_designs()), key=lambda name: name != "geomscope")
        self.layer = ComboBox(label="Capture", choices=captures, tooltip="An open grey layer, or:")
        self.file = FileEdit(label="or a file", nullable=True, filter="*.tif *.tiff *.png *.npy")
        tip = "Live: its newest capture, again and again, while a camera writes."
        self.folder = FileEdit(label="or a folder", nullable=True, mode="d", tooltip=tip)
        self.design = ComboBox(label="Design", choices=names, tooltip="One that comes with gs-jax, or:")
        self.design_file = FileEdit(label="or a file", nullable=True, filter="*.toml")
        self.depths = LineEdit(
            label="Depths, mm", value="18:22:0.25", tooltip="START:STOP:STEP from the plate, STOP included; or one."
        )
        self.voxel = FloatSpinBox(
            label="Voxel, um", min=0.0, max=1e6, step=5.0, tooltip="Lateral pitch; twice as wide takes a quarter."
        )
        self.method = ComboBox(label="Method", choices=METHODS)
        self.suppress = ComboBox(label="Suppress", choices=SUPPRESSIONS, tooltip="Background, after backproject.")
        self.points = CheckBox(label="Find points")
        self.deviation = CheckBox(label="Deviation", tooltip="Of each voxel, by four more reconstructions.")
        self.run, self.live, self.cancel = (PushButton(text=each) for each in ("Run", "Live", "Cancel"))
        self.cancel.enabled = False
        self.bar, self.status = ProgressBar(label=" "), Label(label=" ", value="")
        buttons = Container(widgets=[self.run, self.live, self.cancel], layout="horizontal", labels=False, label=" ")
        files = self.layer, self.file, self.folder, self.design, self.design_file
        options = self.depths, self.voxel, self.method, self.suppress, self.points, self.deviation
        super().__init__(widgets=[*files, *options, buttons, self.bar, self.status])
        self.voxel.native.setSpecialValueText("default")
        self.status.native.setWordWrap(True)
        self.run.clicked.connect(self.start)
        self.live.clicked.connect(self.start_live)
        self.cancel.clicked.connect(self.abort)
        self.worker: Any = None
        self._capture: Any = None
        self._result = Newest()
        self._live: list[Layer] | None = None  # of the newest capture of a folder; the next one replaces their data
        # The timer polls what the other thread sets, and is deleted with the widget.
        self._done, closed = Event(), Event()
        self.native.destroyed.connect(lambda: closed.set())
        self.progress = CancellableProgress(lambda: closed.is_set() or self.worker.abort_requested)
        self._timer = QTimer(self.native)
        self._timer.setInterval(_POLL_INTERVAL)
        self._timer.timeout.connect(self._poll)

    def start(self) -> None:
        """Starts the reconstruction in another thread."""
        file: Any = self.file.value
        self._capture = self.layer.value if file is None else None
        if file is None and self._capture is None:
            show_error("Capture must be a layer or a file, got none.")
            return
        name = self._capture.name if file is None else file.name
        self._live = None
        self._start(name, self._capture.data if file is None else file)

    def start_live(self) -> None:
        """Starts the reconstruction of the newest capture of a folder, again and again, in another thread."""
        folder: Any = self.folder.value
        if folder is None:
            show_error("The folder must be one into which a camera writes, got none.")
            return
        self._capture, self._live = None, []
        self._start(folder.name, folder)

    def _start(self, name: str, capture: Path | np.ndarray) -> None:
        request = {
            "design": self.design_file.value or find_design(self.design.value),
            "depths": self.depths.value,
            "voxel_um": self.voxel.value,
            "method": self.method.value,
            "suppress": self.suppress.value,
            "points": self.points.value,
            "deviation": self.deviation.value,
        }
        self._result = Newest()
        self._done.clear()
        work: Any = self._work
        is_live = self._live is not None
        self.worker = create_worker(work, name, capture, request, is_live, self._result, _start_thread=False)
        self._set_running(True)
        self.worker.start()

    def abort(self) -> None:
        """Stops the reconstruction after the current step."""
        self.worker.quit()
        self.cancel.enabled = False
        self.status.value = "Stops after this step."

    def _work(
        self, name: str, capture: Path | np.ndarray, request: dict[str, Any], is_live: bool, results: Newest
    ) -> None:
        # Other exceptions are errors of the program, which napari shows.
        try:
            make = prepare_layers(**request, progress=self.progress)
            if is_live and isinstance(capture, Path):
                for result in newest_captures(capture, make, self.progress):
                    results.put(result)
            else:
                results.put(make(name, capture))
        except Cancelled:
            pass
        except InputError as error:
            results.put(str(error))
        except OSError as error:
            results.put(f"{name}: {error.strerror or error}")
        finally:
            self._done.set()

    def _poll(self) -> None:
        status, done, total = self.progress.state
        self.bar.native.setRange(0, total or 0)
        self.bar.native.setValue(done)
        if status and self.cancel.enabled and not self._live:
            self.status.value = status
        if self._done.is_set():
            self._finish()
        elif self._live is not None:
            self._show_newest(self._result.take())

    def _finish(self) -> None:
        self._set_running(False)
        result, self.status.value = self._result.take(), ""
        if self._live is not None and isinstance(result, Result):
            self._show_newest(result)
        if self.worker.abort_requested:
            self.status.value = "Cancelled."
        elif isinstance(result, str):
            show_error(result)
        elif result is not None and self._live is None:
            self._show(result, self._capture)

    def _show_newest(self, result: Result | str | None) -> None:
        if isinstance(result, str):
            show_warning(result)
        elif result is not None and any(each in self.viewer.layers for each in self._live or ()):
            # The user's limits of contrast stay.
            for layer, (data, fields, _) in zip(self._live or (), result.layers, strict=True):
                layer.data, layer.name = data, fields["name"]
                layer.features = fields.get("features", {})
            self.status.value = result.status
        elif result is not None:
            self._live = self._show(result, None)

    def _show(self, result: Result, capture: Layer | None) -> list[Layer]:
        """Add the layers of a result, and return them."""
        for warning in result.warnings:
            show_warning(warning)
        was_flat = self.viewer.dims.ndim < 3
        # Layers in pixels and in um cannot be shown together.
        moved = capture is not None and "pixel" in map(str, capture.units)
        if moved:
            for name, value in result.transform.items():
                setattr(capture, name, value)
        added = [self.viewer.add_layer(Layer.create(*layer)) for layer in result.layers]
        if was_flat:
            self.viewer.dims.set_point(0, float(np.mean(self.viewer.dims.range[0][:2])))
        if moved:
            self.viewer.reset_view()
        self.status.value = result.status
        return added

    def _set_running(self, running: bool) -> None:
        self.run.enabled = self.live.enabled = not running
        self.cancel.enabled = running
        if running:
            self._timer.start()
        else:
            self._timer.stop()
            self.bar.native.setRange(0, 1)
            self.bar.native.reset()
