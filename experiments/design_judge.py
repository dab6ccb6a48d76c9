"""Judge of designs: scenes of four kinds, ray-traced with equal exposure, and what is reconstructed of them.

Letters with bars, beads, tilted sheets and dense texture lie at three depths of a span, at random places and turns.
`experiments/ray_tracer.py`, which shares no code with `gs_jax`, images them through all lenses onto the whole sensor of
each design, and the diffraction of its clear area blurs the images; noise is that of one exposure time for all designs.
Volumes are on the same grid for all, three planes about each depth. Scores, after the best gain: PSNR and SSIM; the
contrast of bars of 60 um over that of the truth; F1 of beads. Intervals are by a bootstrap over squares of 0.7 mm. A
second table has what the full model leaves of images without noise, unless it makes the images (`--images model`).

    python -m experiments.design_judge [DESIGN.toml ...] [--span 15 30] [--scale 0.4] [--draws 2] [--exposures 3000]
        [--rays 1200] [--width 1.0] [--images {rays,model}] [--records FILE]

Lengths of scenes and voxels are for the paper's microscope, times the scale. Exposures are electrons in the brightest
pixel of the first design.

Writes the records after each scene, from which the next run goes on, and then `design_judge.md`. A scene and an
exposure of `geomscope-optimized` took four and a half minutes of a loaded core of an AMD EPYC, compilation included.
"""

import hashlib
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import gs_jax as gs
from experiments.common import Report, cropped, design_file, designs_by_name, main, read_records, tables_report
from experiments.ray_tracer import traced
from experiments.surfaces import texture
from gs_jax.io.files import make_folder, write_json
from gs_jax.optics.apertures import clear_area
from gs_jax.reconstruction.inverse_problem import subtract_offset, sum_pixels
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.simulation import letters

# Those that come with the package, for 18 to 23 mm; the first defines the exposures.
DESIGNS = ("geomscope", "geomscope-optimized", "geomscope-asphere")
KINDS = ("letters", "beads", "tilted sheets", "texture")
IN_PLANES = KINDS[:2]
VOXEL, PLANE, READ_NOISE = 0.04, 0.3, 2.0
# Steps of Richardson-Lucy, the default of `gs-jax reconstruct`.
STEPS = 20
# Distance of emitters, of which so many share rays, mm; and squares of a scene that the bootstrap draws, along a side.
APART, TILE, SQUARES = 0.01, 0.1, 3
# How images are made; records of others are refused.
IMAGES = {"rays": "by rays and diffraction", "model": "by the full model"}
# Bars: their period and size, mm. A bead's diameter, and beads at each depth.
PERIOD, SIZE, BEAD, BEADS = 0.12, 0.48, 0.06, 10


class Settings(NamedTuple):
    """What designs are judged by; lengths in mm.

    `sensor` is the width of the sensor's middle; lenses beyond it by 0.4 mm are left out. None is the whole device.
    `rays` go from each tile of the scene to each lens: with 600, the images of `geomscope` differed by 5 % (letters)
    and 11 % (beads) from those with 10,000, and with 2,400 by 2 and 4 %. `width`: of the unrolled inversion's voxels,
    relative to those that are scored; pixels are binned to it. `images`: a key of `IMAGES`. `scale`: of the scenes and
    voxels, beside those described here; `field` and `sensor` are those of a scale of 1.
    """

    span: tuple[float, float] = (18.0, 23.0)
    sensor: float | None = None
    field: float = 2.2
    around: int = 1
    kinds: tuple[str, ...] = KINDS
    exposures: tuple[int, ...] = (20_000, 3_000, 500)
    methods: tuple[str, ...] = ("richardson-lucy", "unrolled")
    rays: int = 1_200
    width: float = 1.0
    images: str = "rays"
    scale: float = 1.0

    @property
    def depths(self) -> np.ndarray:
        """Depths of the scenes: the middle, and 0.4 mm from both ends, times the scale."""
        return np.array([self.span[0] + 0.4 * self.scale, sum(self.span) / 2, self.span[1] - 0.4 * self.scale])

    @property
    def grid(self) -> gs.Grid:
        planes = self.scale * PLANE * np.arange(-self.around, self.around + 1)
        count = round(self.field / VOXEL) | 1
        return gs.Grid(np.add.outer(self.depths, planes).ravel(), (count, count), self.scale * VOXEL)


class Scene(NamedTuple):
    """Emitters `(x, y, z, intensity)`; the middles of beads; bars `(x, y, depth)` across x."""

    emitters: np.ndarray
    points: np.ndarray
    bars: np.ndarray


def make_scene(kind: str, draw: int, settings: Settings = Settings()) -> Scene:
    """A scene of a kind; each draw has other places."""
    if settings.scale != 1:
        unit = settings._replace(span=tuple(np.divide(settings.span, settings.scale)), scale=1.0)
        emitters, points, bars = make_scene(kind, draw, unit)
        lengths = np.array([settings.scale] * 3 + [1])
        return Scene(emitters * lengths, points * settings.scale, bars * settings.scale)
    rng = np.random.default_rng([draw, KINDS.index(kind)])
    half, turn = settings.field / 2, rng.uniform(0, 2 * np.pi)
    third = turn + 2 * np.pi / 3 * np.arange(3)
    around = lambda radius, angle: radius * np.column_stack([np.cos(angle), np.sin(angle)])
    places, others = around(0.45 * half, third), around(0.55 * half, third + np.pi / 3)
    points, bars, parts = np.zeros((0, 3)), np.zeros((0, 3)), []
    if kind == "beads":
        at = rng.uniform(0.15 - half, half - 0.15, (3 * BEADS, 2))
        points = np.column_stack([at, np.repeat(settings.depths, BEADS)])
        count = 40
        r, way = BEAD / 2 * np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * np.pi * (3 - 5**0.5)
        disc = np.column_stack([r * np.cos(way), r * np.sin(way), 0 * r])
        dots = (points[:, None] + disc).reshape(-1, 3)
        return Scene(np.column_stack([dots, np.ones(len(dots))]), points, bars)
    for depth, place, other in zip(settings.depths, places, others, strict=True):
        if kind == "letters":
            letter = letters(rng.choice(list("ABEGHKRSXZ")), depth=depth, height=0.6 * half, pitch=APART)
            x, y = lattice(SIZE)
            some = np.mod(x / PERIOD, 1) < 0.5
            lines = np.column_stack([x[some], y[some], np.full(some.sum(), depth), np.full(some.sum(), APART**2)])
            parts += [letter + [*place, 0, 0], lines + [*other, 0, 0]]
            bars = np.vstack([bars, [*other, depth]])
        elif kind == "tilted sheets":
            x, y = lattice(0.8 * half)
            slope, way = 0.55 * PLANE / (0.4 * half), rng.uniform(0, 2 * np.pi)
            z = depth + slope * (x * np.cos(way) + y * np.sin(way))
            parts.append(np.column_stack([x + place[0], y + place[1], z, texture(x, y, int(rng.integers(2**31)))]))
        else:
            x, y = lattice(1.3 * half)
            light = texture(x, y, int(rng.integers(2**31)))
            parts.append(np.column_stack([x + 0.6 * place[0], y + 0.6 * place[1], np.full_like(x, depth), light]))
    emitters = np.concatenate(parts)
    # So that emitters form no lattice.
    emitters[:, :2] += rng.uniform(-APART / 2, APART / 2, (len(emitters), 2))
    return Scene(emitters, points, bars)


def lattice(side: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a square about the origin."""
    along = (np.arange(round(side / APART)) + 0.5) * APART - side / 2
    x, y = np.meshgrid(along, along)
    return x.ravel(), y.ravel()


def device(imager: gs.Imager, settings: Settings) -> gs.Imager:
    """The middle of a sensor, and the lenses near it; by default all."""
    if settings.sensor is None:
        return imager
    pixels = 2 * round(settings.sensor / float(imager.sensor.pixel_pitch) / 2)
    return cropped(imager, pixels, settings.sensor / 2 + 0.4)


def mark(name: str, imager: gs.Imager) -> str:
    """The key of a design's records, which another design of the same name does not share."""
    numbers = np.concatenate([np.ravel(x) for x in jax.tree.leaves(imager)])
    return f"{name} {hashlib.sha256(numbers.tobytes()).hexdigest()[:8]}"


def image_of(scene: Scene, imager: gs.Imager, settings: Settings) -> np.ndarray:
    """The image without noise: the share of all light in each pixel."""
    light = scene.emitters.copy()
    light[:, 3] /= light[:, 3].sum()
    if settings.images == "model":
        return image_by_model(light, imager, finer(settings.grid, settings.width))
    return diffracted(traced(light, imager, settings.rays, settings.scale * TILE), imager)


def image_by_model(emitters: np.ndarray, imager: gs.Imager, grid: gs.Grid) -> np.ndarray:
    """The full model's image of emitters that the voxels of a grid share."""
    volume = np.asarray(gs.rasterize(emitters, grid), np.float32)
    image = jax.jit(gs.forward)(volume, imager, grid, gs.psf_model(imager, grid, "full"))
    # Sharpened kernels ring about edges, down to -0.3 % of the brightest pixel.
    return np.maximum(np.asarray(image), 0)


def diffracted(image: np.ndarray, imager: gs.Imager) -> np.ndarray:
    """Blur an image by rays with the diffraction of a disc, as large as the mean clear area of the lenses.

    The product of the transfer functions by rays and by diffraction is what lens design programs show beside the one by
    rays; it is exact for spots that are small beside that of diffraction.
    """
    transfer = diffraction_transfer(imager, image.shape, float(imager.sensor.pixel_pitch))
    # An image by rays is not band-limited, so that the product rings below zero.
    return np.maximum(np.fft.irfft2(np.fft.rfft2(image) * transfer, image.shape), 0)


def diffraction_transfer(imager: gs.Imager, shape: tuple[int, ...], pixel: float) -> np.ndarray:
    """Transfer function of a disc of the lenses' mean clear area, at the frequencies of `rfft2`; `pixel` in mm."""
    diameter = 2 * np.sqrt(float(clear_area(imager.array).mean()) / np.pi)
    rows, columns = shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)) / pixel
    cutoff = diameter / (float(imager.wavelength) * float(imager.reduced_sensor_distance))
    part = np.minimum(frequency / cutoff, 1)
    return 2 / np.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))


class Methods:
    """The reconstructions of a device, with its tables: functions of an image that return volumes by name."""

    def __init__(self, imager: gs.Imager, settings: Settings):
        self.imager, self.grid, self.settings = imager, settings.grid, settings
        if "richardson-lucy" in settings.methods:
            self.lucy = gs.Reconstructor(imager, self.grid, METHODS["richardson-lucy"](STEPS))
        if "unrolled" in settings.methods:
            self.fine = finer(self.grid, settings.width)
            self.unrolled = gs.Reconstructor(imager, self.fine, METHODS["unrolled"](1), progress=gs.Progress())

    def volumes(self, image: np.ndarray) -> dict[str, np.ndarray]:
        """Volume by each method."""
        volumes = {}
        if "richardson-lucy" in self.settings.methods:
            volumes["richardson-lucy"] = self.lucy(image)
        if "unrolled" in self.settings.methods:
            volumes["unrolled"] = shared(self.unrolled(image, gs.Progress()), self.fine, self.grid)
        return volumes

    def model_error(self, scene: Scene, clean: np.ndarray) -> float:
        """Error of the methods' image of a scene, after the best gain, relative to a clean image on the same pixels."""
        problem = (self.unrolled if "unrolled" in self.settings.methods else self.lucy).problem
        light = sum_pixels(subtract_offset(clean.astype(np.float32)), problem.binning)
        volume = np.asarray(gs.rasterize(scene.emitters, problem.grid), np.float32)
        image = np.asarray(gs.forward(volume, problem.imager, problem.grid, problem.optics))
        gain = np.vdot(image, light) / np.vdot(image, image)
        return float(np.linalg.norm(gain * image - light) / np.linalg.norm(light))


def finer(grid: gs.Grid, width: float) -> gs.Grid:
    """Voxels of a relative width over the same field, one in the middle."""
    rows, columns = (round(n / width) | 1 for n in grid.shape)
    return gs.Grid(grid.depths, (rows, columns), width * grid.pitch, grid.origin)


def shared(volume: np.ndarray, fine: gs.Grid, grid: gs.Grid) -> np.ndarray:
    """The light of fine voxels in linear shares of a grid's."""
    z, y, x = np.meshgrid(np.asarray(fine.depths), np.asarray(fine.y), np.asarray(fine.x), indexing="ij")
    voxels = np.column_stack([x.ravel(), y.ravel(), z.ravel(), volume.ravel()])
    return np.asarray(gs.rasterize(voxels, grid), np.float32)


def scores(volume: np.ndarray, truth: np.ndarray, scene: Scene, grid: gs.Grid) -> dict[str, Any]:
    """PSNR, SSIM, mean squares over the squares of a scene relative to the squared peak, and the contrast of bars."""
    score = gs.quality(volume, truth)
    error = ((score.gain * volume - truth) / truth.max()) ** 2
    squares = [part.mean() for rows in np.array_split(error, SQUARES, 1) for part in np.array_split(rows, SQUARES, 2)]
    record = {"psnr_db": score.psnr_db, "ssim": score.ssim, "squares": [float(x) for x in squares]}
    if len(scene.bars):
        ratio = [contrast(volume, bar, grid) / contrast(truth, bar, grid) for bar in scene.bars]
        record["contrast"] = float(np.mean(ratio))
    return record


def contrast(volume: np.ndarray, bar: np.ndarray, grid: gs.Grid) -> float:
    """Amplitude of the bars' period over the mean, in the plane of the bars."""
    plane = volume[np.abs(np.asarray(grid.depths) - bar[2]).argmin()]
    scale = float(grid.pitch) / VOXEL
    x, y = (np.asarray(grid.x) - bar[0]) / scale, (np.asarray(grid.y) - bar[1]) / scale
    lines = plane[np.abs(y) < 0.4 * SIZE][:, near := np.abs(x) < SIZE / 2].mean(0)
    wave = np.exp(2j * np.pi * x[near] / PERIOD)
    # Without the mean of the wave, which is not of whole periods on the voxels.
    return float(2 * abs(np.mean(lines * (wave - wave.mean()))) / max(lines.mean(), 1e-12))


def judged(
    imager: gs.Imager, scene: Scene, clean: np.ndarray, brightest: float, methods: Methods, seed: int = 0
) -> dict[str, Any]:
    """Scores of each exposure and method; `brightest` is the brightest pixel of the reference's image."""
    grid, records = methods.grid, {}
    truth = np.asarray(gs.rasterize(scene.emitters, grid), np.float32)
    for exposure in methods.settings.exposures:
        rng = np.random.default_rng([seed, exposure])
        image = rng.poisson(clean * (exposure / brightest)) + rng.normal(0, READ_NOISE, clean.shape)
        image = image.astype(np.float32)
        record: dict[str, Any] = {n: scores(v, truth, scene, grid) for n, v in methods.volumes(image).items()}
        if len(scene.points):
            found, scale = gs.find_points(image, imager, grid), methods.settings.scale
            record["f1"] = gs.localization(found, scene.points, lateral=0.1 * scale, axial=0.4 * scale).f1
        records[str(exposure)] = record
    return records


class Judge:
    """Judge designs scene by scene, and keep the records in a file, from which another judge goes on."""

    def __init__(self, file: Path, settings: Settings, reference: gs.Imager):
        self.file, self.settings, self.reference = file, settings, device(reference, settings)
        own = {"images": IMAGES[settings.images], "reference": mark("first", self.reference)}
        as_json = json.loads(json.dumps(settings._asdict() | own))
        self.kept = read_records(file, "settings", as_json, {"scenes": {}, "found": {}})
        records = [record for found in self.kept["found"].values() for record in found.values()]
        if settings.images == "rays" and not all("model" in record for record in records):
            raise gs.InputError(f"{file} must have the model's error of each scene, got records of an earlier version.")

    def judge(self, name: str, imager: gs.Imager, draws: Sequence[int], progress: gs.Progress) -> dict[str, Any]:
        """Records of a design by kind of scene and draw."""
        small, methods = device(imager, self.settings), None
        records = self.kept["found"].setdefault(mark(name, small), {})
        for draw in draws:
            for kind in progress.track(list(self.settings.kinds), name):
                key = f"{kind} {draw}"
                if key in records:
                    continue
                scene, methods = make_scene(kind, draw, self.settings), methods or Methods(small, self.settings)
                clean = image_of(scene, small, self.settings)
                if eqx.tree_equal(small, self.reference):
                    self.kept["scenes"].setdefault(key, float(clean.max()))
                found = judged(small, scene, clean, self.brightest(key, scene), methods, draw)
                if self.settings.images == "rays":
                    found["model"] = methods.model_error(scene, clean)
                records[key] = found
                write_json(self.file, self.kept)
        return records

    def brightest(self, key: str, scene: Scene) -> float:
        """Brightest pixel of the reference's image."""
        if key not in self.kept["scenes"]:
            clean = image_of(scene, self.reference, self.settings)
            self.kept["scenes"][key] = float(clean.max())
        return self.kept["scenes"][key]


def difference(records: dict, others: dict, key: str, exposure: int, method: str) -> tuple[float, float, float]:
    """PSNR of one design less that of another, dB, and its 95 % interval, over the draws of a kind of scene."""
    parts = [k for k in records if k.startswith(f"{key} ") and k in others]
    ours, theirs = (
        np.concatenate([one[k][str(exposure)][method]["squares"] for k in parts]) for one in (records, others)
    )
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(ours), (4000, len(ours)))
    many = 10 * np.log10(theirs[drawn].mean(1) / ours[drawn].mean(1))
    low, high = np.quantile(many, (0.025, 0.975))
    return float(10 * np.log10(theirs.mean() / ours.mean())), float(low), float(high)


def mean_of(records: dict, key: str, exposure: int, read) -> float:
    """Mean over the draws of what `read` takes of a record."""
    return float(np.mean([read(one[str(exposure)]) for k, one in records.items() if k.startswith(f"{key} ")]))


def rows_of(by_design: dict[str, dict], settings: Settings) -> tuple[tuple[str, ...], list[list[str]]]:
    """PSNR by each method, SSIM by the last, F1 or contrast; by each method, differences from the first design."""
    names, first, method, rows = list(by_design), next(iter(by_design)), settings.methods[-1], []
    for kind in settings.kinds:
        for exposure in settings.exposures:
            row = [kind, str(exposure)]
            for name in names:
                read = partial(mean_of, by_design[name], kind, exposure)
                cell = " / ".join(f"{read(lambda r, m=m: r[m]['psnr_db']):.1f}" for m in settings.methods)
                cell += f", {read(lambda r: r[method]['ssim']):.2f}"
                if kind == "beads":
                    cell += f", F1 {read(lambda r: r['f1']):.2f}"
                if kind == "letters":
                    cell += f", bars {read(lambda r: r[method]['contrast']):.2f}"
                if name != first:
                    gains = (difference(by_design[name], by_design[first], kind, exposure, m) for m in settings.methods)
                    cell += (
                        " (" + " / ".join(f"{more:+.1f}: {low:+.1f} to {high:+.1f}" for more, low, high in gains) + ")"
                    )
                row.append(cell)
            rows.append(row)
    return ("scene", "electrons", *names), rows


def report(
    designs: list[Path],
    span: list[float],
    scale: float,
    draws: int,
    exposures: list[int],
    rays: int,
    width: float,
    images: str,
    records: Path,
    progress: gs.Progress,
) -> Report:
    # Planes about the three depths must not meet.
    if draws < 1 or rays < 1 or min(exposures) < 1 or not (scale > 0 and 0 < span[0] < span[1] - 2 * scale):
        wanted = (
            "--draws, --exposures and --rays must be 1 or more, and --span positive and wider than 2 mm times --scale"
        )
        raise gs.InputError(f"{wanted}, got {draws}, {exposures}, {rays}, {span} and {scale}.")
    settings = Settings(
        (span[0], span[1]), exposures=tuple(exposures), rays=rays, width=width, images=images, scale=scale
    )
    files = designs or [design_file(name) for name in DESIGNS]
    reference = gs.read_design(files[0]).imager()
    imagers = {name: design.imager() for name, design in designs_by_name(files).items()}
    make_folder(records.parent)
    judge = Judge(records, settings, reference)
    by_design = {name: judge.judge(name, imager, range(draws), progress) for name, imager in imagers.items()}
    if images == "model":
        return tables_report("design_judge", by_design, rows_of(by_design, settings))
    of_model = ("design", *(f"{kind}, error of the model" for kind in IN_PLANES))
    errors = [
        [name, *(f"{found[f'{kind} 0']['model']:.3f}" for kind in IN_PLANES)] for name, found in by_design.items()
    ]
    return tables_report("design_judge", by_design, rows_of(by_design, settings), (of_model, errors))


if __name__ == "__main__":
    main(
        report,
        {
            "designs": {"type": Path, "nargs": "*"},
            "--span": {"type": float, "nargs": 2, "default": [18.0, 23.0]},
            "--scale": {"type": float, "default": Settings().scale},
            "--draws": {"type": int, "default": 1},
            "--exposures": {"type": int, "nargs": "+", "default": Settings().exposures},
            "--rays": {"type": int, "default": Settings().rays},
            "--width": {"type": float, "choices": [0.5, 0.75, 1.0], "default": Settings().width},
            "--images": {"choices": list(IMAGES), "default": Settings().images},
            "--records": {"type": Path, "default": Path("out/design_judge/records.json")},
        },
    )
