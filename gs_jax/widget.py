"""napari's dock widget: a capture and a design to a volume, as `gs-jax reconstruct` makes it; and a capture to try.

`napari.yaml` names both. Work is done in another thread; this one shows how far it is.
"""

from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import click
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

from .base.errors import InputError
from .base.progress import Ended, Watched
from .cli.options import DESIGN, METHODS, SUPPRESSIONS, Depths, depth_range, shipped_designs

# Milliseconds between two looks at how far it is; um in a mm.
_LOOK = 100
_UM = 1000.0


class Asked(NamedTuple):
    """What the widget's fields say; the capture is a file, or the pixels of a layer."""

    name: str
    capture: Path | np.ndarray
    design: Path
    depths: str
    voxel_um: float
    method: str
    suppress: str
    points: bool


class Found(NamedTuple):
    """Layers to show, the capture's place on the sensor, and what is to be said."""

    layers: list[Any]
    place: dict[str, Any]
    words: str
    warnings: list[str]


def reconstructed(asked: Asked, progress: Watched) -> Found:
    """What `gs-jax reconstruct` with these options would write, as layers.

    Raises
    ------
    InputError
        As the command.
    """
    from .cli.options import CaptureOptions
    from .design.design import read_design
    from .io.napari import points_layer, step_of, volume_layer
    from .reconstruction.plan import Plan

    try:
        depths = Depths().convert(asked.depths, None, None)
    except click.BadParameter as error:
        raise InputError(f"Depths {error.message}") from error
    camera = CaptureOptions(dark=None, flat=None, bad_pixels="auto", offset=0.0)
    with progress.step("Reading"):
        imager = camera.imager(read_design(asked.design).imager())
        if isinstance(asked.capture, Path):
            image, warnings = camera.read(asked.capture), list(camera.warnings)
        else:
            image, warnings = _corrected(asked.name, asked.capture, imager.sensor)
    options = {"method": asked.method, "suppress": asked.suppress, "points": asked.points}
    plan = Plan.of(imager, depths, asked.voxel_um / _UM or None, **options)
    grid, volume_of = plan.grid, plan.prepare(progress)
    with progress.step("Reconstructing"):
        volume, points, _, warning = volume_of(image, progress)
    progress.go_on()
    how = asked.method if asked.suppress == "none" else asked.suppress
    layers = [volume_layer(volume, grid, f"{asked.name}, {how}")]
    if points is not None:
        layers.append(points_layer(points, f"{asked.name}, {len(points)} points", step_of(grid)))
    z, y, x = volume.shape
    words = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * _UM:.4g} um laterally, {depth_range(depths)}"
    return Found(layers, _place(imager.sensor), words, warnings + ([warning] if warning else []))


def _corrected(name, pixels, sensor):
    """A layer's pixels as those of a file: checked, and hot ones repaired; and what is wrong with them."""
    from .io.camera import prepare, read_frame
    from .io.captures import DTYPES, checked

    pixels = np.asarray(pixels)
    if pixels.shape != sensor.shape or pixels.dtype.name not in DTYPES:
        given, needed = (" x ".join(map(str, shape)) for shape in (pixels.shape, sensor.shape))
        raise InputError(
            f"{name}: the layer must have {needed} pixels (rows x columns, as the design's sensor) of type "
            f"{', '.join(DTYPES)}, got {given} of {pixels.dtype}."
        )
    found = read_frame(name, checked(name, iter([pixels])), prepare(pixels.shape))
    return found.image, found.warnings


def _place(sensor) -> dict[str, Any]:
    """Where a capture's pixels are, for its layer."""
    pitch, (x, y) = sensor.pixel_pitch, map(float, sensor.origin)
    first = [middle - (n - 1) / 2 * pitch for middle, n in zip((y, x), sensor.shape, strict=True)]
    translate = tuple(_UM * each for each in first)
    return {
        "scale": (_UM * pitch, _UM * pitch),
        "translate": translate,
        "units": ("um", "um"),
        "axis_labels": ("y", "x"),
    }


class Reconstruct(Container):
    """Reconstructs a capture, a file or a layer, with a design, and adds the volume as a layer, to scale and in place.

    Parameters
    ----------
    napari_viewer
        Which has the layers.
    """

    def __init__(self, napari_viewer):
        self.viewer = napari_viewer
        # Asked for anew by napari when layers come and go.
        captures: Callable = lambda _: [
            layer for layer in napari_viewer.layers if isinstance(layer, Image) and layer.ndim == 2 and not layer.rgb
        ]
        names = sorted((path.stem for path in shipped_designs()), key=lambda name: name != "geomscope")
        self.layer = ComboBox(label="Capture", choices=captures, tooltip="A grey layer that is open, or:")
        self.file = FileEdit(label="or a file", nullable=True, filter="*.tif *.tiff *.png *.npy")
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
        self.points = CheckBox(label="Points, too")
        self.run, self.cancel = PushButton(text="Run"), PushButton(text="Cancel", enabled=False)
        self.bar, self.said = ProgressBar(label=" "), Label(label=" ", value="")
        buttons = Container(widgets=[self.run, self.cancel], layout="horizontal", labels=False, label=" ")
        files = self.layer, self.file, self.design, self.design_file
        options = self.depths, self.voxel, self.method, self.suppress, self.points
        super().__init__(widgets=[*files, *options, buttons, self.bar, self.said])
        self.voxel.native.setSpecialValueText("default")
        self.said.native.setWordWrap(True)
        self.run.clicked.connect(self.start)
        self.cancel.clicked.connect(self.end)
        self.worker: Any = None
        self._capture: Any = None
        self._found: Found | str | None = None
        # Set in the other thread, and looked at in this one, by a timer that is gone when the widget is.
        self._done, closed = Event(), Event()
        self.native.destroyed.connect(lambda: closed.set())
        self.progress = Watched(lambda: closed.is_set() or self.worker.abort_requested)
        self._timer = QTimer(self.native)
        self._timer.setInterval(_LOOK)
        self._timer.timeout.connect(self._look)

    def start(self) -> None:
        """Reconstructs in another thread."""
        file: Any = self.file.value
        layer: Any = self.layer.value if file is None else None
        design: Any = self.design_file.value or DESIGN.convert(self.design.value, None, None)
        if file is not None:
            name, capture = file.name, file
        elif layer is not None:
            name, capture = layer.name, layer.data
        else:
            show_error("Capture must be a layer or a file, got none.")
            return
        asked = Asked(
            name,
            capture,
            design,
            self.depths.value,
            self.voxel.value,
            self.method.value,
            self.suppress.value,
            self.points.value,
        )
        self._capture, self._found = layer, None
        self._done.clear()
        work: Any = self._work
        self.worker = create_worker(work, asked, _start_thread=False)
        self._set_running(True)
        self.worker.start()

    def end(self) -> None:
        """Ends it after the part that is being done."""
        self.worker.quit()
        self.cancel.enabled = False
        self.said.value = "Ends after this step."

    def _work(self, asked: Asked) -> None:
        """Finds what there is, or what is wrong, in words; anything else is a fault of ours, which napari shows."""
        try:
            self._found = reconstructed(asked, self.progress)
        except Ended:
            pass
        except InputError as error:
            self._found = str(error)
        except OSError as error:
            self._found = f"{asked.name}: {error.strerror or error}"
        finally:
            self._done.set()

    def _look(self) -> None:
        words, done, total = self.progress.now
        self.bar.native.setRange(0, total or 0)
        self.bar.native.setValue(done)
        if words and self.cancel.enabled:
            self.said.value = words
        if self._done.is_set():
            self._finish()

    def _finish(self) -> None:
        self._set_running(False)
        found, self._found, self.said.value = self._found, None, ""
        if self.worker.abort_requested:
            self.said.value = "Cancelled."
        elif isinstance(found, str):
            show_error(found)
        elif found is not None:
            self._show(found, self._capture)

    def _show(self, found: Found, capture: Layer | None) -> None:
        for warning in found.warnings:
            show_warning(warning)
        flat = self.viewer.dims.ndim < 3
        # Pixels and um do not go together.
        moved = capture is not None and "pixel" in map(str, capture.units)
        if moved:
            for name, value in found.place.items():
                setattr(capture, name, value)
        for layer in found.layers:
            self.viewer.add_layer(Layer.create(*layer))
        if flat:
            self.viewer.dims.set_point(0, float(np.mean(self.viewer.dims.range[0][:2])))
        if moved:
            self.viewer.reset_view()
        self.said.value = found.words

    def _set_running(self, running: bool) -> None:
        self.run.enabled, self.cancel.enabled = not running, running
        if running:
            self._timer.start()
        else:
            self._timer.stop()
            self.bar.native.setRange(0, 1)
            self.bar.native.reset()


def sample() -> list[Any]:
    """A capture of forty beads between 18 and 22 mm by `geomscope`, with the noise of a camera."""
    import jax

    from .design.design import read_design
    from .simulation.phantoms import random_points
    from .simulation.synthetic import Camera, expose, simulate

    imager = read_design(DESIGN.convert("geomscope", None, None)).imager()
    light = simulate(random_points(40, (6.0, 6.0), (18.0, 22.0), seed=0), imager, optics="near", psf="geometric")
    image = np.asarray(expose(light, Camera(), jax.random.key(0), peak_electrons=2e4))
    shown = tuple(map(float, np.percentile(image, (1, 99.95))))
    return [(image, {"name": "beads", "contrast_limits": shown} | _place(imager.sensor), "image")]
