"""Reconstruction as asked for by the options of `gs-jax reconstruct` and napari's widget: volume, and points."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..base.arrays import flat_warning
from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..optics.psf_core import blur_warning, sharpness
from ..solvers.richardson_lucy import State as LucyState, restarted
from ..solvers.surface import Surface
from ..solvers.unrolled import Unrolled
from .networks import read_unrolled
from .pipeline import (
    METHODS,
    PIXELS_PER_VOXEL,
    STEPPED,
    BackProjection,
    Method,
    Reconstructor,
    method_by_name,
    voxel_grid,
)
from .residual import CrossValidation, ForwardResidual, cross_validated, forward_residual
from .surface_fit import SurfaceFit, follow_sheets

# Steps of an iterative method.
_STEPS = 20
# What an image may leave unexplained, of what the last one that took all steps left, for its steps to end.
_TARGET_RATIO = 1.02
# Relative change of the light with which an image starts afresh: it, or the one before, may be dark.
_COLD_CHANGE = 0.5


class Result(NamedTuple):
    """Reconstruction of an image: volume, points if asked for, their statistics as columns, a warning, and sheets.

    `last` is what the next frame of a recording may start from; `sieve` the one that was chosen from the image.
    """

    volume: Any
    points: Any = None
    statistics: Any = None
    warning: str | None = None
    surface: SurfaceFit | None = None
    last: Any = None
    sieve: float | None = None


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that a reconstruction depends on but the image; workers receive it pickled, and prepare it."""

    imager: Imager
    grid: Grid
    method: Method
    optics: str
    stop_at_discrepancy: bool
    suppress: str
    points: bool
    weights: Path | None
    warm_start: bool = False
    reconstructor: Reconstructor | None = None
    network: Any = None
    sharpness: Any = None

    @classmethod
    def from_options(
        cls,
        imager: Imager,
        depths: list[float],
        pitch: float | None = None,
        *,
        method: str,
        steps: int | None = None,
        optics: str = "full",
        stop_at_noise: bool = False,
        suppress: str = "none",
        points: bool = False,
        weights: Path | None = None,
        warm_start: bool = False,
        in_tiles: bool = False,
        **method_options: float | None,
    ) -> "Plan":
        """The plan of some options; `method_options` are those of some methods: `tv`, `sparsity`, `sieve`.

        `steps`: 20 by default, for methods that take steps.

        Raises `InputError` if options exclude each other, or the volume would not fit into memory.
        """
        if suppress != "none" and method != "backproject":
            raise InputError(f"--suppress {suppress} must be used with --method backproject, got {method}.")
        if suppress == "points" and optics != "full":
            raise InputError(f"--optics must be full with --suppress points, got {optics}.")
        if weights and suppress != "unet" and method != "unrolled":
            raise InputError(
                "--weights must be used with --method unrolled or --suppress unet, "
                f"got --method {method} and --suppress {suppress}."
            )
        for option, given in {"--steps": steps is not None, "--stop-at-noise": stop_at_noise}.items():
            if given and method not in STEPPED:
                raise InputError(f"{option} must be used with {', '.join(STEPPED)}, got --method {method}.")
        if warm_start and method not in ("list-rl", "richardson-lucy"):
            raise InputError(f"--warm-start must be used with list-rl or richardson-lucy, got --method {method}.")
        methods = METHODS | ({"unrolled": lambda steps: read_unrolled(weights)} if weights else {})
        solver = method_by_name(methods, method, _STEPS if steps is None else steps, method_options)
        pixels = 1 if method == "backproject" else PIXELS_PER_VOXEL
        grid = voxel_grid(imager, depths, pitch, pixels=pixels, in_tiles=in_tiles)
        return cls(imager, grid, solver, optics, stop_at_noise, suppress, points, weights, warm_start)

    def prepare(self, progress: Progress) -> "Plan":
        """The plan with what all images share, which reconstructs them."""
        network = reconstructor = sharp = None
        if self.suppress == "unet" and self.weights:
            from ..detection.unet import read_weights

            network = read_weights(self.weights)
        if self.suppress != "points":
            options = {"stop_at_discrepancy": self.stop_at_discrepancy, "progress": progress}
            reconstructor = Reconstructor(self.imager, self.grid, self.method, self.optics, **options)
        if self._finds_points:
            sharp = sharpness(self.imager, self.grid)
        return dataclasses.replace(self, network=network, reconstructor=reconstructor, sharpness=sharp)

    @property
    def of_frames(self) -> "Plan":
        """The plan for a recording, of which no frame chooses a sieve of its own."""
        if not isinstance(sieve := getattr(self.method, "sieve", None), tuple):
            return self
        method: Any = self.method
        return dataclasses.replace(self, method=dataclasses.replace(method, sieve=sieve[0]))

    @property
    def reads_pixels_once(self) -> bool:
        """Whether an image is only back-projected, as the camera's integers, too."""
        return isinstance(self.method, BackProjection) and not self._finds_points

    @property
    def _finds_points(self) -> bool:
        """Whether points are found in images, not in volumes."""
        return self.suppress == "points" or (self.points and self.suppress != "clusters")

    def __call__(self, image: Image, progress: Progress, last: Any = None) -> Result:
        """Reconstruct an image, where the method can do so from `last` of the result of the frame before."""
        surface = points = statistics = warning = sieve = None
        if self._finds_points:
            points, statistics, warning = self._find_points(image, progress)
        if self.reconstructor is None:
            volume = self._volume_of_points(points)
        elif isinstance(self.method, Surface):
            surface, last = follow_sheets(self.reconstructor, image, last, progress)
            volume, warning = surface.volume, warning or surface.warning
        elif self.warm_start:
            volume, last = follow_volume(self.reconstructor, image, last, progress)
        else:
            state = self.reconstructor.solve(image, progress)
            volume = np.asarray(self.reconstructor.finish(state, progress), np.float32)
            if self.reconstructor.wider and isinstance(getattr(self.method, "sieve", None), tuple):
                sieve = float(state.sieve)
        if self.suppress == "clusters":
            from ..detection.particles import find_clusters

            with progress.step("Clustering"):
                points = find_clusters(volume, self.grid)
                volume = self._volume_of_points(points)
        if self.suppress == "unet":
            from ..detection.unet import suppress

            with progress.step("Suppressing the background"):
                volume = suppress(volume, network=self.network)
        return Result(volume, points, statistics, warning or flat_warning(volume), surface, last, sieve)

    def _find_points(self, image: Image, progress: Progress) -> tuple[Any, dict[str, Any], str | None]:
        from ..detection.background import subtract_background
        from ..detection.point_finder import NOT_TRUSTED, find_points
        from ..detection.view_samples import detection_stats

        light = subtract_background(image)
        points = find_points(light, self.imager, self.grid, progress=progress)
        warning = blur_warning(self.sharpness, "points", NOT_TRUSTED)
        statistics = detection_stats(points, light, self.imager, self.grid)._asdict()
        return points, statistics | {"confident": np.full(len(points), int(warning is None))}, warning

    def _volume_of_points(self, points: Any) -> Volume:
        from ..simulation import rasterize

        # Dark points up to a power of two: other numbers of points compile nothing.
        padded = np.zeros((1 << max(len(points) - 1, 0).bit_length(), 4))
        padded[: len(points)] = points
        return np.asarray(rasterize(padded, self.grid), np.float32)

    @property
    def is_learned(self) -> bool:
        """Whether a network made the volume, which `check` compares with the capture."""
        return self.suppress == "unet" or isinstance(self.method, Unrolled)

    def check(self, volume: Volume, image: Image, progress: Progress) -> ForwardResidual:
        return forward_residual(volume, image, self.imager, self.grid, optics=self.optics, progress=progress)

    def check_scored(self, option: str) -> None:
        """Raise `InputError` naming an option for which `score` is needed, unless lenses can be left out."""
        if self.suppress != "none" or isinstance(self.method, Surface):
            got = f"--suppress {self.suppress} and {type(self.method).__name__}()"
            raise InputError(f"{option} must be used with --suppress none and methods of free voxels, got {got}.")

    def score(self, image: Image, progress: Progress) -> CrossValidation:
        """How well lenses are predicted from the others, without suppression; `InputError` with sheets."""
        options = {"optics": self.optics, "stop_at_discrepancy": self.stop_at_discrepancy}
        return cross_validated(image, self.imager, self.grid, self.method, **options, progress=progress)


class LastVolume(NamedTuple):
    """State of the last image, its light, and what the last one that took all steps left of its light."""

    solver: LucyState
    light: float
    unexplained: float


def follow_volume(
    reconstructor: Reconstructor, image: Image, last: LastVolume | None, progress: Progress
) -> tuple[Volume, LastVolume]:
    """Reconstruct an image by Richardson-Lucy from the volume of the last one; return what the next one starts from.

    The first image takes all steps. Each of the others starts from the volume of the last one, and its steps end when
    they explain it as well as all steps explained an earlier one. An image with much more or less light than the last
    one starts afresh.
    """
    light = float(np.sum(image, dtype=float))
    # No step lights a volume that is dark.
    follows = last is not None and abs(light - last.light) < _COLD_CHANGE * last.light and bool(last.solver.x.any())
    target = _TARGET_RATIO * last.unexplained * light if last and follows else 0.0
    if last and follows:
        state = reconstructor.init(image, _restart(last.solver))
        state = reconstructor.run(state._replace(target=max(state.target, target)), progress)
    else:
        state = reconstructor.solve(image, progress)
    # The divergence of counts is proportional to their sum.
    unexplained = last.unexplained if last else 0.0
    if state.cost >= target:
        unexplained = state.cost / light if light > 0 else 0.0
    return np.asarray(reconstructor.finish(state), np.float32), LastVolume(state.solver, light, unexplained)


@jax.jit
def _restart(state):
    # A copy, as steps overwrite their state.
    return jax.tree.map(jnp.copy, restarted(state))
