"""The demonstration: a built-in microscope images a scene that we draw, and the scene is reconstructed."""

import time
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from .builtin import geomscope
from .camera import Camera, expose
from .coverage import nearest_neighbour_distances
from .designs import write_design
from .disk import atomic_write, make_folder, write_text
from .files import read_capture, write_capture
from .geometry import Grid
from .phantoms import letters, rasterize
from .progress import Progress
from .reconstruct import reconstruct_stack
from .simulate import simulate_volume
from .volumes import write_volume

# What is written at which depth (mm), and where its middle is (mm).
_WORDS = ((18.0, "near", (-4.0, -5.0)), (20.0, "focus", (0.0, 0.0)), (22.0, "far", (4.0, 5.0)))
_LETTER_MM = 2.5
_PEAK_ELECTRONS = 10_000
_DEPTHS = np.arange(17.0, 23.01, 0.5)
_VOXEL_MM = 0.0415
_SCENE_MM = 0.016  # finer than the voxels and no multiple of them


def run(folder: Path, progress: Progress) -> Path:
    """Run the pipeline and write a folder: design, capture, volume, picture, report.

    Returns
    -------
    Path
        Of the report, in Markdown.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    make_folder(folder)
    with progress.step("Laying out the lenses"):
        design = geomscope()
        write_design(folder / "design.toml", design)
    imager = design.imager()
    scene_grid = Grid.over(imager.sensor, depths=[z for z, _, _ in _WORDS], pitch=_SCENE_MM)
    scene = np.asarray(rasterize(_scene(), scene_grid))
    wavelength = design.imaging.wavelength_nm * 1e-6
    light = simulate_volume(scene, imager, scene_grid, wavelength=wavelength, progress=progress)
    with progress.step("Exposing"):
        counts = expose(light, Camera(), jax.random.key(0), peak_electrons=_PEAK_ELECTRONS)
        write_capture(folder / "capture.tif", counts)
    image = read_capture(folder / "capture.tif", imager.sensor.shape)
    grid = Grid.over(imager.sensor, depths=_DEPTHS, pitch=_VOXEL_MM)
    started = time.perf_counter()
    volume = reconstruct_stack(image, imager, grid, progress)
    cold = time.perf_counter() - started
    with progress.step("Writing the volume, picture and report"):
        write_volume(folder / "volume.ome.tif", volume, grid)
        with atomic_write(folder / "picture.png") as path:
            _picture(image, scene, volume, imager, grid).savefig(path, format="png", dpi=110)
        write_text(folder / "report.md", _report(design, grid, cold), [".md"])
    return folder / "report.md"


def _scene() -> np.ndarray:
    """Emitters: each word on its plane, in its place."""
    words = [letters(word, depth=z, height=_LETTER_MM, pitch=_SCENE_MM) + (x, y, 0, 0) for z, word, (x, y) in _WORDS]
    return np.concatenate(words)


def _picture(image, scene, volume, imager, grid: Grid) -> Figure:
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots(2, len(_WORDS) + 1)
    height, width = (n * imager.sensor.pixel_pitch / 2 for n in imager.sensor.shape)
    sensor = (-width, width, height, -height)
    step = max(1, image.shape[0] // 1024)
    axes[0, 0].imshow(image[::step, ::step], cmap="gray", extent=sensor, vmax=np.percentile(image[::step], 99.8))
    axes[0, 0].set_title("capture")
    middle = image.shape[0] // 2
    zoom = image[middle - 400 : middle + 400, middle - 400 : middle + 400]
    half = 400 * imager.sensor.pixel_pitch
    axes[1, 0].imshow(zoom, cmap="gray", extent=(-half, half, half, -half), vmax=np.percentile(zoom, 99.8))
    axes[1, 0].set_title("its middle")
    for column, (depth, _, _) in enumerate(_WORDS, start=1):
        nearest = int(np.argmin(np.abs(np.asarray(grid.depths) - depth)))
        axes[0, column].imshow(scene[column - 1, ::3, ::3], cmap="magma", extent=sensor)
        axes[0, column].set_title(f"scene, z = {depth:g} mm")
        axes[1, column].imshow(volume[nearest], cmap="magma", extent=sensor, vmin=np.percentile(volume[nearest], 50))
        axes[1, column].set_title(f"back-projection, z = {depth:g} mm")
    for axis in axes.flat:
        axis.set_xlabel("x, mm")
    for axis in axes[:, 0]:
        axis.set_ylabel("y, mm")
    return figure


def _report(design, grid: Grid, seconds: float) -> str:
    distances = nearest_neighbour_distances(np.array(design.array.centers_mm))
    rows, columns = grid.shape
    near, far = float(grid.depths[0]), float(grid.depths[-1])
    return f"""# gs-jax demo

A lensless microscope of {len(distances)} random microlenses (pitch {distances.mean():.2f} mm, SD
{distances.std():.2f} mm) images three words at 18, 20 and 22 mm. The stack is reconstructed by pixel back-projection:
{grid.depths.size} depths from {near:g} to {far:g} mm, {rows} x {columns} voxels of {grid.pitch * 1000:g} um, in
{seconds:.2f} s, compilation included.

![Capture, scene and back-projection](picture.png)

Each plane shows its own word sharp, and the others as a blur of ghosts: back-projection alone does not remove
light from other depths.

| file | what |
|---|---|
| `design.toml` | the microscope |
| `capture.tif` | the camera's image, 16 bits, with diffraction, shot and read noise |
| `volume.ome.tif` | the reconstructed stack, to scale in Fiji and napari |
| `picture.png` | the picture above |

The capture comes from the package's own forward model (exact wavefront and diffraction of a lens on its axis, the
same for all lenses and fields), on a finer grid than the voxels: a demonstration, not a proof of quality.
"""
