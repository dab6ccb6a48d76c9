"""What limits volumes of scenes that are no sheets: the model, light between planes, the prior, or the iterations.

Blobs, a textured slab and a vessel tree, three of each, have light at depths 0.125 mm apart. `ray_tracer.py`, which
shares no code with the package, images them through the lenses of a design about the middle onto 640 x 640 pixels of 9
um, with the noise of 10,000 electrons in the brightest pixel. Voxels are 80 um wide, planes 0.5 mm apart from 18 to 23
mm. Captures with fewer causes of error have as much light: rays from emitters that are shared linearly by the planes;
the package's own model of the emitters, on voxels half as wide; and the model of the voxels that are reconstructed.

Ceilings are Richardson-Lucy with more iterations, and with the true support; and the Wiener estimate that knows the
power spectrum of the scene. Scores are PSNR above that of an empty volume, dB, with the truth shared linearly by the
planes; truth and volume are blurred by the width of the device's own spots, 40 um and 0.3 mm. Intervals are of 95 %.

    python -m experiments.volume_limits [--design geomscope] [--draws 3] [--out DIR]

Writes `volume_limits.json`, `volume_limits.md` and `volume_limits.png`; about twenty minutes on two cores.
"""

from collections.abc import Callable
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from scipy.stats import t as student

from experiments.common import Report, main, table
from experiments.ray_tracer import traced
from experiments.surfaces import DEPTHS, PITCH, READ, STEP, VOXEL, Emitters, blobs, device, noisy, texture
from gs_jax import Grid, Imager, ImagingOperator, psf_model, quality, rasterize
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.inverse_problem import prepare_data, prepare_model
from gs_jax.reconstruction.pipeline import METHODS, Reconstructor
from gs_jax.solvers.base import Operator

PIXELS, ELECTRONS, RAYS, TILE, LAYER = 640, 10_000, 100, 0.1, STEP / 4
# Standard deviations of the device's own width, 0.3 mm in depth and 40 um, in voxels.
WIDTH = tuple(np.array([0.3 / STEP, 0.04 / VOXEL, 0.04 / VOXEL]) / np.sqrt(8 * np.log(2)))
PLAIN = ("richardson-lucy", "fista", "unrolled", "surface")
# Iterations; and those of ceilings, by Richardson-Lucy and conjugate gradients.
ITERATIONS, MORE = 20, 60
CASES = ("rays", "rays, on planes", "model", "voxels")
FURTHER, SUPPORTED = f"richardson-lucy, {MORE} steps", "the same in the true support"
# What is taken away, and a case without and with it.
CAUSES = (
    ("no light between planes", "rays, on planes", "rays"),
    ("no error of the model", "model", "rays"),
    ("and no light between voxels", "voxels", "model"),
)


def slab(width: float, seed: int) -> Emitters:
    """A square slab, 1.5 mm deep, of light that varies over about 0.1 mm in all directions."""
    rng = np.random.default_rng(seed)
    side, near = np.arange(-0.25 * width, 0.25 * width, 0.04), rng.uniform(DEPTHS[0] + 0.5, DEPTHS[1] - 2)
    x, y, z = (part.ravel() for part in np.meshgrid(side, side, near + np.arange(0, 1.5, LAYER)))
    x, y = (part + rng.uniform(-0.02, 0.02, len(x)) for part in (x, y))
    return np.column_stack([x, y, z, texture(x, y, seed, z)])


def vessels(width: float, seed: int) -> Emitters:
    """A tree of filled tubes of radii from 0.25 to 0.06 mm, which branch in two by Murray's law."""
    rng, middle = np.random.default_rng(seed), np.array([0, 0, np.mean(DEPTHS)])
    half = np.array([0.33 * width, 0.33 * width, (DEPTHS[1] - DEPTHS[0]) / 2 - 0.3])
    open_ends, parts = [(np.array([-0.3 * width, 0, 0]), np.array([1.0, 0, 0]), 0.25)], []
    while open_ends:
        start, way, radius = open_ends.pop()
        length = 8 * radius
        # Tubes turn back before they leave the box.
        way = np.where(np.abs(start + length * way) > half, -way, way)
        count = round(1.5e5 * length * radius**2)
        along, across = rng.uniform(0, length, (count, 1)), rng.normal(size=(count, 3))
        across -= (across @ way)[:, None] * way
        across *= radius * np.sqrt(rng.uniform(size=(count, 1))) / np.linalg.norm(across, axis=1, keepdims=True)
        parts.append(start + along * way + across)
        if radius > 0.07:
            side = np.cross(way, rng.normal(size=3))
            side *= 0.7 / np.linalg.norm(side)
            ways = ((way + turn) / np.linalg.norm(way + turn) for turn in (side, -side))
            open_ends += [(start + length * way, new, radius / 2 ** (1 / 3)) for new in ways]
    points = np.concatenate(parts) + middle
    return np.column_stack([points, np.ones(len(points))])


KINDS: dict[str, Callable[[float, int], Emitters]] = {"blobs": blobs, "textured slab": slab, "vessel tree": vessels}


def scene(kind: str, draw: int) -> Emitters:
    """Emitters of a scene, in layers; their light is 1."""
    emitters = KINDS[kind](PIXELS * PITCH, draw)
    emitters[:, 2] = np.clip(np.round(emitters[:, 2] / LAYER) * LAYER, *DEPTHS)
    emitters[:, 3] /= emitters[:, 3].sum()
    return emitters


def flattened(emitters: Emitters, depths: np.ndarray) -> Emitters:
    """Each emitter on the two planes about it, in linear shares."""
    index = (emitters[:, 2] - depths[0]) / STEP
    below = np.clip(np.floor(index).astype(int), 0, len(depths) - 2)
    first, second = emitters.copy(), emitters.copy()
    first[:, 2], second[:, 2] = depths[below], depths[below + 1]
    first[:, 3] *= 1 - index + below
    second[:, 3] *= index - below
    return np.concatenate([first, second])


class Methods:
    """Volumes of a device's captures on its planes by name of the method, with the tables at hand."""

    def __init__(self, imager: Imager, progress: Progress):
        depths_of = lambda step: np.arange(DEPTHS[0], DEPTHS[1] + 0.01, step)
        self.imager, self.progress = imager, progress
        self.grid = Grid.over(imager.sensor, depths=depths_of(STEP), pitch=VOXEL)
        self.model = prepare_model(imager, self.grid, "full", progress)
        self.operator = ImagingOperator(self.model.imager, self.grid, self.model.optics)
        by = lambda name: Reconstructor(imager, self.grid, METHODS[name](ITERATIONS), progress=progress)
        self.plain = {name: by(name) for name in PLAIN}
        # Light at any depth of a scene, on voxels half as wide.
        half = Grid.over(imager.sensor, depths=depths_of(LAYER), pitch=VOXEL / 2)
        optics = psf_model(self.model.imager, half, "full", progress=progress)
        self.imaging = ImagingOperator(self.model.imager, half, optics)

    def run(self, image: np.ndarray, truth: np.ndarray, case: str) -> dict[str, np.ndarray]:
        """Volumes; ceilings for rays and voxels alone."""
        found = {name: method(image, self.progress) for name, method in self.plain.items()}
        if case in ("rays", "voxels"):
            found[FURTHER] = self.lucy(image, MORE)[0]
            found[SUPPORTED] = self.in_support(image, truth > 0)
            found["Wiener, true spectrum"] = self.wiener(image, truth)
        return found

    def lucy(self, image: np.ndarray, steps: int, start=None):
        """The volume by Richardson-Lucy, and its state."""
        lucy = self.plain["richardson-lucy"].by(METHODS["richardson-lucy"](steps))
        state = lucy.run(lucy.init(image, start), self.progress)
        return np.array(lucy.finish(state)), state.solver

    def in_support(self, image: np.ndarray, support: np.ndarray) -> np.ndarray:
        """Richardson-Lucy, where voxels without light stay dark."""
        state = self.lucy(image, 1)[1]
        x = jnp.where(support, state.x, 0)
        momentum = (x.copy(), jnp.zeros_like(x), state.momentum[2])
        return self.lucy(image, MORE - 1, state._replace(x=x, momentum=momentum))[0]

    def wiener(self, image: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """The estimate that knows the power spectrum of the truth, without its negative values."""
        light, _ = prepare_data(image, self.model)
        shown = np.asarray(self.operator.mv(truth))
        unit = np.vdot(light, shown) / np.vdot(shown, shown)
        power = np.abs(np.fft.rfftn(unit * truth)) ** 2 / truth.size
        noise = np.maximum(light, 0) + (READ * self.model.binning) ** 2
        return np.asarray(_wiener(self.operator, light, power.astype(np.float32), noise.astype(np.float32)))


@jax.jit
def _wiener(A: Operator, light: Array, power: Array, noise: Array) -> Array:
    prior = lambda x: jnp.fft.irfftn(power * jnp.fft.rfftn(x), x.shape)
    # Scaled by the noise.
    root = jnp.sqrt(noise)
    normal = lambda u: A.mv(prior(A.T.mv(u / root))) / root + u
    weights = cg(normal, light / root, maxiter=MORE)[0]
    return jnp.maximum(prior(A.T.mv(weights / root)), 0)


def images(emitters: Emitters, methods: Methods, truth: np.ndarray) -> dict[str, np.ndarray]:
    """Captures of a scene by case, with equal light."""
    flat = flattened(emitters, np.asarray(methods.grid.depths, np.float64))
    side = methods.model.binning
    pixels = lambda image: np.kron(np.maximum(image, 0), np.ones((side, side)))
    clean = {
        "rays": traced(emitters, methods.imager, RAYS, TILE),
        "rays, on planes": traced(flat, methods.imager, RAYS, TILE),
        "model": pixels(methods.imaging.mv(rasterize(emitters, methods.imaging.grid))),
        "voxels": pixels(methods.operator.mv(truth)),
    }
    light = clean["rays"].sum() / clean["rays"].max()
    return {case: noisy(each, ELECTRONS * light * each.max() / each.sum()) for case, each in clean.items()}


def gain(found: np.ndarray, truth: np.ndarray) -> float:
    """PSNR above that of nothing, both blurred by the width of the device, dB."""
    found, truth = (gaussian_filter(part, WIDTH) for part in (found, truth))
    return quality(found, truth).psnr_db - quality(np.zeros_like(truth), truth).psnr_db


def cell(values: np.ndarray) -> str:
    """Mean and half of its 95 % interval by Student's t."""
    if len(values) < 2:
        return "".join(f"{value:.1f}" for value in values)
    half = student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.1f} ± {half:.1f}"


def picture(kept: dict) -> Figure:
    """Slices across and along the depth of the truth and of volumes, on one scale for a scene."""
    columns = [("", "truth"), *(("rays", name) for name in PLAIN), ("rays", SUPPORTED)]
    columns += [("voxels", "unrolled"), ("voxels", SUPPORTED)]
    half, most = PIXELS * PITCH / 2, 0.4 * PIXELS * PITCH
    figure = Figure(figsize=(1.6 * len(columns), 3 * len(KINDS)), dpi=75, layout="constrained")
    axes = figure.subplots(2 * len(KINDS), len(columns), squeeze=False)
    for row, kind in enumerate(KINDS):
        truth = kept[kind, "", "truth"]
        plane, line = (int(truth.sum(others).argmax()) for others in ((1, 2), (0, 2)))
        for column, key in enumerate(columns):
            across, along = axes[2 * row : 2 * row + 2, column]
            volume, scale = kept[kind, *key], {"cmap": "gray", "vmin": 0, "vmax": np.percentile(truth[truth > 0], 99)}
            across.imshow(volume[plane], extent=(-half, half, half, -half), **scale)
            along.imshow(volume[:, line], extent=(-half, half, DEPTHS[1], DEPTHS[0]), **scale)
            across.set(xlim=(-most, most), ylim=(most, -most))
            along.set(xlim=(-most, most))
            if row == 0:
                name = key[1].replace("the same", "richardson-lucy").replace(" in ", "\nin ")
                across.set_title(f"{name}\n{key[0]}", fontsize=8)
        axes[2 * row, 0].set_ylabel(f"{kind}\ny, mm")
        axes[2 * row + 1, 0].set_ylabel("z, mm")
    for axis in axes.flat:
        axis.tick_params(labelsize=6)
    figure.supxlabel("x, mm")
    return figure


def run(imager: Imager, draws: int, progress: Progress) -> tuple[list[dict], dict]:
    """Records of each scene, case and method, and the volumes of the first draw."""
    methods, records, kept = Methods(imager, progress), [], {}
    for draw, kind in progress.track(list(product(range(draws), KINDS)), "Scenes"):
        emitters = scene(kind, draw)
        truth = np.asarray(rasterize(emitters, methods.grid), np.float32)
        for case, image in images(emitters, methods, truth).items():
            for name, volume in methods.run(image, truth, case).items():
                record = {"kind": kind, "draw": draw, "case": case, "method": name}
                records.append(record | {"db": gain(volume, truth)})
                if draw == 0:
                    kept |= {(kind, "", "truth"): truth, (kind, case, name): quality(volume, truth).gain * volume}
    return records, kept


def report(design: str, draws: int, progress: Progress) -> Report:
    return shown(design, *run(device(design, PIXELS), draws, progress))


def shown(design: str, records: list[dict], kept: dict) -> Report:
    """Tables and the picture."""
    of = lambda key, **what: [r[key] for r in records if all(r[k] == value for k, value in what.items())]
    names = list(dict.fromkeys(of("method", case="rays")))
    db = lambda name, case, **what: np.array(of("db", method=name, case=case, **what))
    rows = [[kind, name, *(cell(db(name, case, kind=kind)) for case in CASES)] for kind in KINDS for name in names]
    lost = [[cause, *(cell(db(name, case) - db(name, other)) for name in PLAIN)] for cause, case, other in CAUSES]
    for cause, better, worse in (
        (f"{MORE} iterations, not {ITERATIONS}", FURTHER, PLAIN[0]),
        ("the support known", SUPPORTED, FURTHER),
    ):
        lost.append([cause, cell(db(better, "rays") - db(worse, "rays")), *[""] * (len(PLAIN) - 1)])
    tables = (("scene", "method", *CASES), rows), (("more, dB", *PLAIN), lost)
    text = "\n\n".join(markdown_table(*each) for each in tables)
    files = {"volume_limits.json": records, "volume_limits.md": f"# Limits of volumes by {design}\n\n{text}\n"}
    return Report(files | {"volume_limits.png": picture(kept)}, [table(*each) for each in tables])


if __name__ == "__main__":
    main(report, {"--design": {"default": "geomscope"}, "--draws": {"type": int, "default": 3}})
