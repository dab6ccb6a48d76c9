"""Reconstruction as asked for by the options of `gs-jax reconstruct` and napari's widget: volume, and points."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import InputError
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..optics.lens_types import blur_warning, sharpness
from ..solvers.surface import Surface
from ..solvers.unrolled import Unrolled, read_unrolled
from ..typing import Image, Volume
from .cross_validation import CrossValidation, cross_validated
from .methods import METHODS, STEPPED, Method
from .pipeline import PIXELS_PER_VOXEL, reconstructor, voxel_grid
from .residual import ForwardResidual, forward_residual
from .surface_fit import SurfaceFit, surface_fitter
from .warm_start import following_reconstructor

# Steps of an iterative method.
_STEPS = 20


class Result(NamedTuple):
    """Reconstruction of an image: volume, points if asked for, their statistics as columns, a warning, and sheets."""

    volume: Any
    points: Any = None
    statistics: Any = None
    warning: str | None = None
    surface: SurfaceFit | None = None


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that a reconstruction depends on but the image; workers receive it pickled."""

    imager: Imager
    grid: Grid
    method: Method
    optics: str
    stop_at_discrepancy: bool
    suppress: str
    points: bool
    weights: Path | None
    warm_start: bool = False

    @classmethod
    def of(
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
        **method_options: float | None,
    ) -> "Plan":
        """The plan of some options; `method_options` are those of some methods, `tv` and `sparsity`.

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
        solver = _method(method, _STEPS if steps is None else steps, weights, method_options)
        grid = voxel_grid(imager, depths, pitch, pixels=1 if method == "backproject" else PIXELS_PER_VOXEL)
        return cls(imager, grid, solver, optics, stop_at_noise, suppress, points, weights, warm_start)

    def prepare(self, progress: Progress, *, in_time: bool = False) -> Callable[[Image, Progress], Result]:
        """Compute what all images share; return the function that reconstructs one.

        `in_time`: the images follow each other, so that a surface, and with `warm_start` a volume, starts from the last
        one.
        """
        clean = volume_of = fit = None
        if self.suppress == "unet":
            from ..detection.unet import read_weights, suppress

            clean = partial(suppress, network=read_weights(self.weights) if self.weights else None)
        if isinstance(self.method, Surface):
            how = {"optics": self.optics, "progress": progress, "in_time": in_time}
            fit = surface_fitter(self.imager, self.grid, self.method, **how)
        elif self.suppress != "points":
            options = {"optics": self.optics, "stop_at_discrepancy": self.stop_at_discrepancy}
            prepare = following_reconstructor if self.warm_start and in_time else reconstructor
            volume_of = prepare(self.imager, self.grid, self.method, **options, progress=progress)
        # Computed once, and only if points are asked for.
        sharp = cache(partial(sharpness, self.imager, self.grid))

        def reconstruct(image: Image, progress: Progress) -> Result:
            points = statistics = warning = None
            if self.suppress == "points" or (self.points and self.suppress != "clusters"):
                points, statistics, warning = self._find_points(image, sharp(), progress)
            if fit:
                surface = fit(image, progress)
                return Result(surface.volume, points, statistics, warning or surface.warning, surface)
            volume = volume_of(image, progress) if volume_of else self._volume_of_points(points)
            if self.suppress == "clusters":
                from ..detection.particles import find_clusters

                with progress.step("Clustering"):
                    points = find_clusters(volume, self.grid)
                    volume = self._volume_of_points(points)
            if clean:
                with progress.step("Suppressing the background"):
                    volume = clean(volume)
            return Result(volume, points, statistics, warning)

        return reconstruct

    @property
    def is_learned(self) -> bool:
        """Whether a network made the volume, which `check` compares with the capture."""
        return self.suppress == "unet" or isinstance(self.method, Unrolled)

    def check(self, volume: Volume, image: Image, progress: Progress) -> ForwardResidual:
        return forward_residual(volume, image, self.imager, self.grid, optics=self.optics, progress=progress)

    def score(self, image: Image, progress: Progress) -> CrossValidation:
        """How well lenses are predicted from the others, without suppression; `InputError` with sheets."""
        options = {"optics": self.optics, "stop_at_discrepancy": self.stop_at_discrepancy}
        return cross_validated(image, self.imager, self.grid, self.method, **options, progress=progress)

    def _find_points(self, image: Image, sharp: Any, progress: Progress) -> tuple[Any, dict[str, Any], str | None]:
        from ..detection.background import subtract_background
        from ..detection.point_finder import NOT_TRUSTED, find_points
        from ..detection.view_samples import detection_stats

        light = subtract_background(image)
        points = find_points(light, self.imager, self.grid, progress=progress)
        warning = blur_warning(sharp, "points", NOT_TRUSTED)
        statistics = detection_stats(points, light, self.imager, self.grid)._asdict()
        return points, statistics | {"confident": np.full(len(points), int(warning is None))}, warning

    def _volume_of_points(self, points: Any) -> Volume:
        from ..simulation.phantoms import rasterize

        # Dark points up to a power of two: other numbers of points compile nothing.
        padded = np.zeros((1 << max(len(points) - 1, 0).bit_length(), 4))
        padded[: len(points)] = points
        return np.asarray(rasterize(padded, self.grid), np.float32)


def _method(name: str, steps: int, weights: Path | None, options: dict[str, float | None]) -> Any:
    """The method of a name with the options that are given; `InputError` if it lacks one."""
    method: Any = read_unrolled(weights) if weights and name == "unrolled" else METHODS[name](steps)
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        if not hasattr(method, option):
            names = [other for other, make in METHODS.items() if hasattr(make(1), option)]
            raise InputError(f"--{option} must be used with {', '.join(names)}, got --method {name}.")
    return dataclasses.replace(method, **given)
