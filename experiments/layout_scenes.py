"""System, scenes and scores of `experiments.layout_gain`.

The held-out scenes are not rendered by the model of the reconstruction or the loss: voxels are three times finer, blobs
lie between them and 0.1 mm off the reconstructed depths, the PSF is that of diffraction instead of a Gaussian, and a
camera adds noise and quantises.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.end_to_end import random_scene, reconstruct, reconstruction_loss
from gs_jax import Grid, Imager, ImagingOperator, MicrolensArray, Sensor, forward
from gs_jax.base.progress import Progress
from gs_jax.metrics import quality
from gs_jax.simulation.synthetic import Camera, electrons, expose
from gs_jax.solvers.base import solve
from gs_jax.solvers.richardson_lucy import RichardsonLucy

# Standard deviation of a blob and of the local background, mm.
WIDTH, BACKGROUND = 0.06, 0.2
ELECTRONS, READ_NOISE = 1000.0, 2.0
# Refinement of voxels and planes in the held-out scenes.
FINER, OFF_PLANE = 3, (-0.1, 0.0, 0.1)
METHODS = ("backproject", "list_rl")

Centers = Float[Array | np.ndarray, "lens 2"]
Scores = dict[str, list[float]]


class Study(NamedTuple):
    """Sizes in mm; `field` is the width of the object, which is centred."""

    plate: tuple[float, float] = (3.5, 3.5)
    distance: float = 0.65
    pixels: int = 560
    pixel: float = 0.01125
    field_radius: float = 2.2
    field: float = 3.0
    voxel: float = 0.05
    depths: tuple[float, ...] = (12.0, 14.0, 16.5)
    density: float = 0.008
    candidates: int = 200
    jitter: float = 0.05
    scored_on: int = 10
    steps: int = 12_000
    rate: float = 0.03
    held_out: int = 30

    @property
    def middle(self) -> float:
        return self.depths[len(self.depths) // 2]

    def imager(self, centers) -> Imager:
        # Focused at 14 mm. Apertures are smaller than the minimum spacing, so no layout clips them, and all have the
        # same PSF.
        array = MicrolensArray(centers, radius_of_curvature=1.8, aperture_diameter=0.5)
        return Imager(array, Sensor((self.pixels, self.pixels), self.pixel), 5.8, self.field_radius)

    def grid(self) -> Grid:
        count = round(self.field / self.voxel)
        return Grid(self.depths, (count, count), self.voxel)

    def fine_grid(self) -> Grid:
        depths = np.add.outer(self.depths, OFF_PLANE).ravel()
        return Grid(depths, tuple(FINER * n for n in self.grid().shape), self.voxel / FINER)


def psf_of(make: Callable[..., Array], study: Study, grid: Grid) -> Float[Array, "depth row column"]:
    """PSFs, one per depth, which do not depend on the layout."""
    imager = study.imager(np.zeros((1, 2)))
    return jnp.stack([make(imager, depth, size=33) for depth in grid.depths])


@partial(jax.jit, static_argnames="study")
def loss(centers: Centers, key: PRNGKeyArray, psfs: Array, study: Study) -> Float[Array, ""]:
    """End-to-end loss of one scene, dB, with given PSFs and the voxels of the reconstruction."""
    return reconstruction_loss(
        study.imager(centers),
        key,
        grid=study.grid(),
        psf=psfs,
        scenes=1,
        density=study.density,
        width=WIDTH,
        electrons=ELECTRONS,
        read_noise=READ_NOISE,
        background_width=BACKGROUND,
    )


def held_out(study: Study, key: PRNGKeyArray) -> tuple[Array, Array]:
    """A scene on fine voxels, and the truth on the voxels of the reconstruction."""
    fine, grid = study.fine_grid(), study.grid()
    part = FINER**2 * len(OFF_PLANE)
    scene = random_scene(key, fine, density=study.density / part, width=WIDTH)
    binned = scene.reshape(len(grid.depths), len(OFF_PLANE), grid.shape[0], FINER, grid.shape[1], FINER)
    return scene / FINER**2, binned.mean((3, 5)).sum(1)


@partial(jax.jit, static_argnames="study")
def _imaged(scene, centers, psfs, study):
    return jnp.maximum(ELECTRONS * forward(scene, study.imager(centers), study.fine_grid(), psfs), 0)


@partial(jax.jit, static_argnames=("study", "method"))
def _reconstructed(image, centers, study, method):
    image = jnp.asarray(image, centers.dtype)
    if method == "backproject":
        return reconstruct(image, study.imager(centers), study.grid(), background_width=BACKGROUND)
    return solve(ImagingOperator(study.imager(centers), study.grid()), image, RichardsonLucy(steps=10)).value


def judge(
    layouts: Mapping[str, Centers], study: Study, psfs: Array, progress: Progress
) -> tuple[dict[str, Scores], list[float]]:
    """PSNR and SSIM of every layout on every held-out scene by both methods, and the scores of an empty volume."""
    camera = Camera(read_noise=READ_NOISE)
    columns = [f"{method}_{what}" for method in METHODS for what in ("psnr_db", "ssim")]
    scores: dict[str, Scores] = {name: {column: [] for column in columns} for name in layouts}
    empty = []
    keys = jax.random.split(jax.random.key(2**22), (study.held_out, 2))
    for scene_key, noise_key in progress.track(list(keys), "Held-out scenes"):
        scene, truth = held_out(study, scene_key)
        empty.append(quality(jnp.zeros_like(truth), truth).psnr_db)
        for name, centers in layouts.items():
            clean = _imaged(scene, jnp.asarray(centers), psfs, study)
            # Scenes are in electrons, so all layouts have the same exposure.
            image = electrons(expose(clean, camera, noise_key, peak_electrons=clean.max()), camera)
            for method in METHODS:
                score = quality(_reconstructed(image, jnp.asarray(centers), study, method), truth)
                scores[name][f"{method}_psnr_db"].append(score.psnr_db)
                scores[name][f"{method}_ssim"].append(score.ssim)
    return scores, empty


@partial(jax.jit, static_argnames="study")
def _lit(centers, study):
    grid = study.grid()
    middle = grid.at(study.middle)
    one = lambda center: forward(jnp.ones((1, *grid.shape)), study.imager(center[None]), middle) > 0.05
    return jax.lax.map(lambda center: one(center).astype(int), centers).sum(0)


def overlap(centers: Centers, study: Study) -> float:
    """Mean number of lenses that share a lit pixel, for an object that fills the middle plane."""
    count = _lit(jnp.asarray(centers), study)
    return float(count.sum() / (count > 0).sum())
