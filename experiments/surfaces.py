"""Sheets fitted to ray-traced captures: depth, focus and volume, beside free voxels and the unrolled inversion.

A tilted snowflake, a curved leaf with veins, a hemisphere with texture, two sheets one behind the other, and blobs,
which are no sheet, within 9.2 mm, are traced through all lenses of a design onto its whole sensor. Columns: mean and
standard deviation of the depth's error over lit columns, but steep rims; how many errors are within one predicted
standard deviation; PSNR above an empty image or volume, blurred by one voxel, of the image in focus and of the volume,
where the truth has each emitter on its nearest plane, or in linear shares of two; that of the truth's own shares; that
of the unrolled inversion; what the sheets, and one sheet more, leave of the capture. Scenes without one depth have one
exposure.

    python -m experiments.surfaces [--design geomscope] [--scenes "curved leaf,hemisphere"] [--out DIR]

Writes `surfaces.md`, `surfaces.json` and `surfaces.png`; four minutes of a core for a scene and an exposure.
"""

import time

import equinox as eqx
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from experiments.common import Report, design_file, main, names_of, tables_report
from experiments.phantoms import snowflake
from experiments.ray_tracer import traced
from gs_jax import Grid, Imager, Progress, Reconstructor, Surface, quality, rasterize, read_design
from gs_jax.io.camera import Readout
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.surface_fit import fit_sheets

# Width of the scenes and of pixels, at least, mm.
WIDTH, PITCH, VOXEL, STEP, DEPTHS = 9.2, 0.009, 0.08, 0.5, (18.0, 23.0)
ELECTRONS, READ = (10_000, 500), 2.0
STEEPEST = np.deg2rad(60)
# Rays of each tile toward each lens, the width of a tile, and the distance from an emitter to the next, mm.
RAYS, TILE, APART = 300, 0.1, 0.02

# Scenes with one depth in each column.
SHEETS = ("tilted snowflake", "curved leaf", "hemisphere")
SCENES = (*SHEETS, "two sheets", "blobs")

# Heading, factor and digits of each number.
COLUMNS = {
    "bias_mm": ("depth bias, mm", 1, 3),
    "sd_mm": ("SD, mm", 1, 3),
    "within_one_sd": ("within 1 SD", 1, 2),
    "in_focus_db": ("in focus, dB", 1, 1),
    "nearest_db": ("3-D, dB", 1, 1),
    "truth_db": ("of the truth, dB", 1, 1),
    "shares_db": ("shares, dB", 1, 1),
    "unrolled_db": ("unrolled, dB", 1, 1),
    "left": ("left, %", 100, 1),
    "left_by_one_more": ("one more, %", 100, 1),
}

Emitters = Float[np.ndarray, "emitter 4"]


def device(design: str) -> Imager:
    """A design, whose pixels are binned to the width of those that voxels need."""
    imager = read_design(design_file(design)).imager()
    side = max(int(PITCH / imager.sensor.pixel_pitch + 0.02), 1)
    return eqx.tree_at(lambda i: i.sensor, imager, Readout(binning=side).sensor(imager.sensor))


def make_scenes(width: float) -> dict[str, Emitters]:
    """Emitters `(x, y, z, intensity)` of each scene, of this width, mm."""
    near, far = DEPTHS
    middle, half = (near + far) / 2, (far - near) / 2
    flake = snowflake((middle, middle), 0.8 * width, width=min(0.7, 0.8 * width / 14.5), pitch=APART)
    flake[:, 2] = middle + 0.9 * half * flake[:, 0] / (0.4 * width)
    side = np.arange(-0.42 * width, 0.42 * width, APART)
    x, y = (part.ravel() for part in np.meshgrid(side, side))

    def sheet(inside, depth, light):
        return np.column_stack([x, y, depth, light])[inside]

    veins = np.minimum(np.abs(y), np.abs(((x - 0.7 * np.abs(y)) / 0.9 + 50) % 1.0 - 0.5) * 0.9) < 0.08
    bent = 1 - 0.5 * (y / (0.25 * width)) ** 2
    leaf = sheet(
        (x / (0.4 * width)) ** 2 + (y / (0.25 * width)) ** 2 < 1,
        middle + 0.8 * half * np.sin(2.2 * x / (0.4 * width)) * bent,
        0.3 + veins,
    )
    radius = np.hypot(x, y) / (0.35 * width)
    round_off = np.sqrt(np.maximum(1 - radius**2, 0))
    dome = sheet(radius < 0.97, far - 0.3 - (far - near - 0.6) * round_off, texture(x, y, 1))
    box = lambda middle: (np.abs(x - middle) < 0.25 * width) & (np.abs(y) < 0.3 * width)
    front = sheet(box(-0.1 * width), near + 0.8 + 0.05 * y, texture(x, y, 2))
    behind = sheet(box(0.1 * width), far - 0.8 + 0.1 * x, texture(x, y, 3))
    named = {"tilted snowflake": flake, "curved leaf": leaf, "hemisphere": dome}
    return named | {"two sheets": np.concatenate([front, behind]), "blobs": blobs(width, 0)}


def blobs(width: float, seed: int) -> Emitters:
    """60 Gaussian blobs at random places, of this width, mm."""
    rng, middle = np.random.default_rng(seed), float(np.mean(DEPTHS))
    sizes = np.array([0.35 * width, 0.35 * width, (DEPTHS[1] - DEPTHS[0]) / 2 - 0.2])
    middles = rng.uniform(-sizes, sizes, (60, 3)) + [0, 0, middle]
    points = (middles[:, None] + rng.normal(0, 0.15, (60, 2000, 3))).reshape(-1, 3)
    return np.column_stack([points, np.ones(len(points))])


def texture(x, y, seed: int, z: float | np.ndarray = 0.0) -> np.ndarray:
    """Light that varies over about 0.1 mm, log-normal."""
    rng = np.random.default_rng(seed)
    frequencies, phases, along = rng.normal(0, 1 / 0.12, (40, 2)), rng.uniform(0, 2 * np.pi, 40), rng.normal(size=40)
    parts = zip(frequencies, phases, along / 0.12, strict=True)
    return np.exp(0.8 * sum(np.cos(x * a + y * b + z * c + p) for (a, b), p, c in parts) / np.sqrt(20))


def capture(emitters: Emitters, imager: Imager) -> np.ndarray:
    """The image without noise; emitters are placed within their squares."""
    within = np.random.default_rng(0).uniform(-APART / 2, APART / 2, (len(emitters), 2))
    return traced(emitters + np.pad(within, ((0, 0), (0, 2))), imager, RAYS, TILE)


def true_maps(emitters: Emitters, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light and mean depth of each column, NaN where there are several or it is steep; volume on the nearest planes."""
    flat = grid.at([float(np.mean(DEPTHS))])

    def moment(power):
        at, light = np.full(len(emitters), float(np.mean(DEPTHS))), emitters[:, 3] * emitters[:, 2] ** power
        return np.asarray(rasterize(np.column_stack([emitters[:, :2], at, light]), flat), np.float64)[0]

    light = moment(0)
    mean, square = (moment(power) / np.maximum(light, 1e-12) for power in (1, 2))
    lit = (light > 0.2 * np.median(light[light > 0])) & (square - mean**2 < STEP**2)
    lit &= ~(slope(np.where(lit, mean, np.nan), grid.pitch) > np.tan(STEEPEST))
    planes, nearest = np.asarray(grid.depths), emitters.copy()
    nearest[:, 2] = planes[np.abs(emitters[:, 2:3] - planes).argmin(1)]
    return light, np.where(lit, mean, np.nan), np.asarray(rasterize(nearest, grid), np.float32)


def slope(depth: np.ndarray, pitch: float) -> np.ndarray:
    """The larger slope toward the lit neighbours of each column, along both axes together; 0 without any."""
    along = []
    for axis in (0, 1):
        steps = np.nan_to_num(np.abs(np.diff(depth, axis=axis)))
        none = np.zeros_like(np.take(depth, [0], axis))
        along.append(np.maximum(np.concatenate([none, steps], axis), np.concatenate([steps, none], axis)))
    return np.hypot(*along) / pitch


def gain(found: np.ndarray, true: np.ndarray) -> float:
    """PSNR above that of nothing, both blurred by one voxel, dB."""
    found, true = (gaussian_filter(part, (0, 1, 1)) for part in (found, true))
    return quality(found, true).psnr_db - quality(np.zeros_like(true), true).psnr_db


class Methods:
    """What is compared, with the tables of one device: functions of an image and a progress display."""

    def __init__(self, imager: Imager, progress: Progress):
        side = round(WIDTH / VOXEL) | 1
        self.grid = Grid(np.arange(DEPTHS[0], DEPTHS[1] + 0.01, STEP), (side, side), VOXEL)
        self.sheet = Reconstructor(imager, self.grid, Surface(), progress=progress)
        self.sheets = self.sheet.by(Surface(2))
        self.unrolled = Reconstructor(imager, self.grid, METHODS["unrolled"](20), progress=progress)


def noisy(clean: np.ndarray, electrons: float) -> np.ndarray:
    """Shot noise of so many electrons in the brightest pixel, readout noise, and an offset."""
    rng = np.random.default_rng(1)
    image = rng.poisson(clean * electrons / clean.max()) + rng.normal(0, READ, clean.shape)
    return (image + 100).astype(np.float32)


def run(image: np.ndarray, name: str, emitters: Emitters, methods: Methods, free: bool, progress: Progress) -> dict:
    """Fit the capture of a scene and, if wanted, invert it by free voxels."""
    light, depth, volume = true_maps(emitters, methods.grid)
    shares = np.asarray(rasterize(emitters, methods.grid), np.float32)
    began = time.process_time()
    fit, _ = fit_sheets(methods.sheets if name == "two sheets" else methods.sheet, image, progress)
    took = time.process_time() - began
    error, sd = fit.depth[0] - depth, fit.depth_sd[0]
    known = np.isfinite(error)
    results = {
        "scene": name,
        "in_focus_db": gain(fit.volume.sum(0)[None], light[None]),
        "nearest_db": gain(fit.volume, volume),
        "truth_db": gain(shares, volume),
        "shares_db": gain(fit.volume, shares),
        "left": fit.error,
        "left_by_one_more": fit.further_error,
        "warning": fit.warning,
    }
    if free:
        began = time.process_time()
        results["unrolled_db"] = gain(methods.unrolled(image, progress), volume)
        results["time_over_unrolled"] = took / (time.process_time() - began)
    if name in SHEETS:
        results |= {"bias_mm": float(error[known].mean()), "sd_mm": float(error[known].std())}
        results["within_one_sd"] = float((np.abs(error[known]) < sd[known]).mean())
    return results | {"maps": (fit.brightness[0], fit.depth[0], depth)}


def picture(results: list[dict]) -> Figure:
    """Brightness, depth and true depth of each sheet at the first exposure."""
    sheets = [r for r in results if "sd_mm" in r and r["electrons"] == ELECTRONS[0]]
    figure = Figure(figsize=(9, 2.9 * len(sheets)), layout="constrained")
    half = WIDTH / 2
    for row, each in enumerate(sheets):
        for column, title in enumerate(("brightness", "depth, mm", "truth, mm")):
            axes = figure.add_subplot(len(sheets), 3, 3 * row + column + 1)
            colours = "gray" if column == 0 else "viridis"
            shown = axes.imshow(each["maps"][column], cmap=colours, extent=(-half, half, half, -half))
            if column:
                shown.set_clim(*DEPTHS)
            axes.set(xlabel="x, mm", ylabel="y, mm")
            axes.set_title(f"{each['scene']}: {title}", fontsize="medium")
            if column:
                figure.colorbar(shown, ax=axes, shrink=0.8)
    return figure


def report(design: str, scenes: list[str], progress: Progress) -> Report:
    imager, all_scenes = device(design), make_scenes(WIDTH)
    methods, results = Methods(imager, progress), []
    for name in scenes:
        emitters = all_scenes[name]
        clean = capture(emitters, imager)
        for electrons in ELECTRONS if name in SHEETS else ELECTRONS[:1]:
            image, free = noisy(clean, electrons), name == scenes[0]
            results.append({"electrons": electrons} | run(image, name, emitters, methods, free, progress))
    slower = [r["time_over_unrolled"] for r in results if "time_over_unrolled" in r][-1]
    columns = ("scene", "electrons", *(title for title, _, _ in COLUMNS.values()), "warned")
    cell = lambda value, factor, digits: "" if value is None else f"{factor * value:.{digits}f}"
    cells = lambda r: (cell(r.get(key), *form) for key, (_, *form) in COLUMNS.items())
    rows = [[r["scene"], str(r["electrons"]), *cells(r), "yes" if r["warning"] else "no"] for r in results]
    took = f"A fit takes {slower:.1f} times the processor time of the unrolled inversion."
    kept = [{key: value for key, value in r.items() if key != "maps"} for r in results]
    numbers, title = {"scenes": kept, "time_over_unrolled": slower}, f"Sheets in ray-traced captures by {design}"
    return tables_report("surfaces", numbers, (columns, rows), title=title, text=took, png=picture(results))


if __name__ == "__main__":
    main(report, {"--design": {"default": "geomscope"}, "--scenes": {"type": names_of(SCENES), "default": SCENES}})
