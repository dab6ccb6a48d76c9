"""How much of an independently ray-traced image the forward model explains.

The near model has one PSF within the field radius, the full model all transmitted light. One gain per image is fitted,
and nothing else. Error is the RMS of the difference over that of the image, correlation is Pearson's, for the images
and for both binned by 4 and 16; light is the model's sum over the image's. Captures are another group's, with noise;
images by other devices, for which nothing was tuned, are those of `experiments/ray_tracer.py`. Zones: Eq. (2) takes the
envelope C at the centre of the zone that a voxel lies in, a Voronoi cell, `gs_jax.forward` at the voxel.

    python -m experiments.true_image [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_*.tif` and the scenes' `*.json`; without it only the other devices are used. Writes
`true_image.json` and `true_image.md`; about twelve minutes on two cores.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, main, points_of, tables_report
from experiments.ray_tracer import traced
from gs_jax.microscope.geometry import envelope
from gs_jax.microscope.lenses import Orientation
from gs_jax.optics.aberrations import best_focus
from gs_jax.optics.field_varying import field_varying_psf
from gs_jax.optics.psf import psf_of_depth
from gs_jax.projection.point_sources import full_image_of_points
from gs_jax.simulation import letters, random_points, simulate_points

BINS = (1, 4, 16)
# Captures: electrons per count, and the black level.
GAIN, BLACK = 10, 16


class Device(NamedTuple):
    """A microscope with a random layout, in focus at the middle of its depths; lengths in mm."""

    lenses: int = 120
    plate: float = 12.0
    pixels: int = 2048
    pixel: float = 0.006
    radius: float = 1.6
    refractive_index: float = 1.5
    thickness: float = 0.5
    aperture: float = 1.5
    field_radius: float = 2.2
    depths: tuple[float, float] = (12.5, 15.5)
    orientation: Orientation = "plano"
    conic_constant: float = 0.0

    def imager(self) -> gs.Imager:
        """The imager of the models."""
        centers = gs.random_layout(self.lenses, (self.plate, self.plate), diameter=self.aperture, seed=1)
        array = gs.MicrolensArray(
            centers,
            self.radius,
            self.refractive_index,
            self.aperture,
            self.thickness,
            orientation=self.orientation,
            conic_constant=self.conic_constant,
        )
        sensor = gs.Sensor((self.pixels, self.pixels), self.pixel)
        v = best_focus(gs.Imager(array, sensor, 1.0, self.field_radius), np.mean(self.depths))
        return gs.Imager(array, sensor, v, self.field_radius)


DEVICES = {
    "R = 1.6": Device(),
    "thin plate": Device(lenses=150, pixels=3072, pixel=0.004, thickness=0.2),
    "curved side in front, k = -0.7": Device(orientation="curved", conic_constant=-0.7),
}


def scores(model: np.ndarray, image: np.ndarray) -> dict:
    """Error, correlation and light, after the model's one gain."""
    gain = float(np.vdot(model, image) / np.vdot(model, model))
    results: dict = {"gain": gain, "light": gain * float(model.sum() / image.sum())}
    for size in BINS:
        a, b = (_binned(part, size) for part in (gain * model, image))
        error = float(np.linalg.norm(a - b) / np.linalg.norm(b))
        results[f"bin_{size}"] = {"error": error, "correlation": float(np.corrcoef(a.ravel(), b.ravel())[0, 1])}
    return results


def _binned(image, size):
    rows, columns = (n // size for n in image.shape)
    return image[: rows * size, : columns * size].reshape(rows, size, columns, size).sum((1, 3), dtype=np.float64)


def of_volume(emitters: np.ndarray, imager: gs.Imager, pitch: float, image: np.ndarray, progress: gs.Progress) -> dict:
    """Scores of the models for planes of emitters, as voxels."""
    depths, count = np.unique(emitters[:, 2]), 2 * math.ceil(np.abs(emitters[:, :2]).max() / pitch + 1) + 1
    grid = gs.Grid(depths, (count, count), pitch)
    volume = gs.rasterize(emitters, grid)
    kernel = psf_of_depth(imager, depths, "geometric")
    near = gs.forward(volume, imager, grid, jnp.stack([kernel(depth) for depth in depths]))
    full = gs.forward(volume, imager, grid, field_varying_psf(imager, depths, progress=progress))
    return {"near": scores(np.asarray(near), image), "full": scores(np.asarray(full), image)}


def of_points(points: np.ndarray, imager: gs.Imager, image: np.ndarray, progress: gs.Progress) -> dict:
    """Scores of the near and the full model for points."""
    near = simulate_points(points, imager, kind="geometric", progress=progress)
    return {"near": scores(near, image), "full": scores(full_image_of_points(points, imager, progress), image)}


def on_captures(data: Path, rays: int, progress: gs.Progress) -> dict:
    """Scores on the ray-traced captures, and of our own tracer on the points, with so many rays."""
    imager, points = gs.read_design(data / "P1.toml").imager(), points_of(data, "d")
    image = lambda scene: electrons(gs.read_capture(data / f"P1_{scene}.tif", imager.sensor.shape))
    results = {
        "letters": of_volume(words(data / "h.json"), imager, 0.012, image("h"), progress),
        "USAF target": of_volume(target(data / "f.json"), imager, 0.005, image("f"), progress),
        "120 points": of_points(points, imager, capture := image("d"), progress),
    }
    if rays:
        results["120 points"]["own tracer"] = scores(traced(points, imager, rays), capture)
    return results


def electrons(capture: np.ndarray) -> np.ndarray:
    """Electrons of a ray-traced capture in counts."""
    return GAIN * (capture.astype(np.float64) - BLACK)


def words(scene: Path) -> np.ndarray:
    """Emitters of the words of a ray-traced scene."""
    return np.concatenate([strokes(plane) for plane in json.loads(scene.read_text())["planes"]])


def target(scene: Path) -> np.ndarray:
    """Emitters of the resolution target of a ray-traced scene."""
    return bars(json.loads(scene.read_text())["elements"])


def strokes(plane: dict, pitch: float = 0.012) -> np.ndarray:
    """Emitters `(x, y, z, area)` of lines with round ends, on a lattice about the axis."""
    ends = np.array(plane["segments_xy"]).reshape(-1, 2, 2)  # line, end, axis
    half = plane["width_mm"] / 2 + pitch
    reach = [math.ceil((np.abs(ends[..., axis]).max() + half) / pitch) for axis in (0, 1)]
    x, y = (pitch * np.arange(-n, n + 1) for n in reach)
    points, distance = x + 1j * y[:, None], np.inf
    for start, end in ends[..., 0] + 1j * ends[..., 1]:
        along = np.clip(np.real((points - start) / (end - start)), 0, 1)
        distance = np.minimum(distance, np.abs(points - start - along * (end - start)))
    covered = np.clip((plane["width_mm"] / 2 - distance) / pitch + 0.5, 0, 1)
    lit, light = points[covered > 0], covered[covered > 0] * pitch**2
    return np.column_stack([np.real(lit), np.imag(lit), np.full(lit.size, plane["z_mm"]), light])


def bars(elements: list[dict], depth: float = 18.0, pitch: float = 0.0025) -> np.ndarray:
    """Emitters of rectangles, evenly spread over each."""
    parts = []
    for x0, x1, y0, y1 in (bar for e in elements for bar in (*e["vertical_bars"], *e["horizontal_bars"])):
        across, along = math.ceil((x1 - x0) / pitch), math.ceil((y1 - y0) / pitch)
        x, y = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(along) + 0.5) / along)
        light = np.full(x.size, (x1 - x0) * (y1 - y0) / x.size)
        parts.append([x0 + (x1 - x0) * x.ravel(), y0 + (y1 - y0) * y.ravel(), np.full(x.size, depth), light])
    return np.concatenate(parts, 1).T


def on_device(device: Device, progress: gs.Progress, *, points=25, samples=400_000, point_rays=200_000, rays=8) -> dict:
    """Scores on our tracer's images of points and of three thick letters (none if there are no samples)."""
    imager, size = device.imager(), 0.8 * device.plate
    scene = random_points(points, (size, size), device.depths, seed=3)
    results = {f"{points} points": of_points(scene, imager, traced(scene, imager, point_rays), progress)}
    if samples:
        pitch = 0.6 * device.pixel / float(imager.magnification(device.depths[1]))
        place = zip("HTL", np.linspace(*device.depths, 3), ((-0.25, -0.2), (0, 0.2), (0.25, -0.1)), strict=True)
        shift = lambda xy: np.array([*np.multiply(xy, device.plate), 0, 0])
        height = device.plate / 5
        word = np.concatenate([letters(a, depth=z, height=height, pitch=pitch) + shift(xy) for a, z, xy in place])
        rng = np.random.default_rng(0)
        some = word[rng.choice(len(word), samples, p=word[:, 3] / word[:, 3].sum())]
        some[:, :2] += rng.uniform(-pitch / 2, pitch / 2, (samples, 2))
        some[:, 3] = word[:, 3].sum() / samples
        results["three letters"] = of_volume(word, imager, pitch, traced(some, imager, rays), progress)
    return results


def zone_departure(
    imager: gs.Imager, depth: float, size: tuple[float, float], points: int = 20_000
) -> dict[str, float]:
    """Share of a point's light that zones assign to wrong lenses, sum |C_zone - C| / sum C, over random points."""
    rng = np.random.default_rng(0)
    centers = np.asarray(imager.centers)
    place = rng.uniform(-0.5, 0.5, (points, 2)) * size
    zone = KDTree(centers).query(place)[1]
    # ApertureProfile' centroids, by the points themselves.
    middle = np.stack([np.bincount(zone, q, len(centers)) for q in place.T], -1) / np.bincount(zone)[:, None]
    reduced = imager.reduced_depth(depth)
    squared = lambda q: ((q[:, None] - centers[None]) ** 2).sum(-1)
    light = lambda q: np.asarray(envelope(squared(q), reduced, imager.field_radius))
    exact = light(place)
    departure = np.abs(light(middle[zone]) - exact).sum(1) / exact.sum(1)
    return {"depth_mm": depth, "mean": float(departure.mean()), "worst": float(departure.max())}


def run(
    data: Path | None, devices: dict[str, Device] | None = None, *, rays=50_000, progress: gs.Progress, **sizes
) -> dict:
    """Return scores by image, scene and model; `rays` are for `on_captures`, `sizes` for `on_device`."""
    results = {"the authors' array": on_captures(data, rays, progress)} if data else {}
    for name, device in (DEVICES if devices is None else devices).items():
        results[name] = on_device(device, progress, **sizes)
    return results


def report(data: Path | None, progress: gs.Progress) -> Report:
    results = run(data, progress=progress)
    columns = ("image of", "scene", "by", *(f"error / correlation, {b} x {b}" for b in BINS), "light")
    rows = []
    for name, scenes in results.items():
        for scene, models in scenes.items():
            for model, score in models.items():
                cells = ("{error:.3f} / {correlation:.3f}".format(**score[f"bin_{b}"]) for b in BINS)
                rows.append([name, scene, model, *cells, f"{score['light']:.3f}"])
    design = gs.geomscope()
    results["zones"] = zones = zone_departure(design.imager(), 20.0, design.array.size_mm)
    departure = (
        f"Zones of Eq. (2) move {zones['mean']:.0%} of a point's light to other lenses, {zones['worst']:.0%} at most."
    )
    title = "What the forward model explains"
    return tables_report("true_image", results, (columns, rows), title=title, text=departure)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
