"""What the options of `gs-jax reconstruct`, and of napari's widget, make of an image: a volume, and points."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import InputError


class Made(NamedTuple):
    """Of an image: the volume; if points were asked for, these, columns that speak for them, and a warning."""

    volume: Any
    points: Any = None
    evidence: Any = None
    warning: str | None = None


def plan(
    imager,
    depths: list[float],
    pitch: float | None = None,
    *,
    method: str,
    steps: int = 20,
    optics: str = "full",
    tv: float | None = None,
    sparsity: float | None = None,
    stop_at_noise: bool = False,
    suppress: str = "none",
    points: bool = False,
    weights: Path | None = None,
) -> tuple[Any, Callable]:
    """The voxels, and from what shows how far it is to a `maker`'s function.

    Raises
    ------
    InputError
        Where options do not go together, or the volume does not fit into the memory.
    """
    from .pipeline import COARSE, voxel_grid

    if suppress != "none" and method != "backproject":
        raise InputError(f"--suppress {suppress}: found --method {method}, allowed: backproject, for which it is made.")
    if suppress == "points" and optics != "full":
        raise InputError(f"--optics {optics}: found --suppress points, allowed: full, which finds points.")
    if weights and suppress != "unet" and method != "unrolled":
        found = f"--method {method} and --suppress {suppress}"
        raise InputError(f"--weights: found {found}, allowed: --method unrolled or --suppress unet.")
    if stop_at_noise and method in ("backproject", "unrolled"):
        raise InputError(f"--stop-at-noise: found --method {method}, allowed: list-rl, richardson-lucy, fista, admm.")
    inversion = method_of(method, steps, weights, tv=tv, sparsity=sparsity)
    grid = voxel_grid(imager, depths, pitch, pixels=1 if method == "backproject" else COARSE)
    options = {"optics": optics, "stop_at_noise": stop_at_noise, "suppress": suppress, "points": points}
    return grid, partial(maker, imager, grid, inversion, **options, weights=weights)


def maker(imager, grid, inversion, progress, *, optics, stop_at_noise, suppress, points, weights) -> Callable:
    """From an image, and what shows how far it is, to what is `Made` of it; the same for all of its images is done."""
    from .pipeline import reconstructor

    cleaned = _network(weights) if suppress == "unet" else None
    options = {"optics": optics, "stop_at_noise": stop_at_noise, "progress": progress}
    volume_of: Any = None if suppress == "points" else reconstructor(imager, grid, inversion, **options)

    # Of the design and the depths alone.
    sharp = cache(partial(_sharpness, imager, grid))

    def made(image, progress):
        found = evidence = warning = None
        if suppress == "points" or (points and suppress != "clusters"):
            found, evidence, warning = _points(image, imager, grid, sharp(), progress)
        volume = _volume_of_points(found, grid) if suppress == "points" else volume_of(image, progress)
        if suppress == "clusters":
            from ..detection.clustering import find_clusters

            with progress.step("Clustering"):
                found = find_clusters(volume, grid)
                volume = _volume_of_points(found, grid)
        if cleaned:
            with progress.step("Suppressing the background"):
                volume = cleaned(volume)
        return Made(volume, found, evidence, warning)

    return made


def imaged_again(imager, grid, optics, volume, image, progress):
    """How far a volume that is imaged again is from its image."""
    from .residual import reproject

    return reproject(volume, image, imager, grid, optics=optics, progress=progress)


def method_of(name: str, steps: int, weights: Path | None, **options) -> Any:
    """The method of this name, with the options that were given, if it has them."""
    from ..solvers.unrolled import read_unrolled
    from .methods import METHODS as BY_NAME

    method: Any = read_unrolled(weights) if weights and name == "unrolled" else BY_NAME[name](steps)
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        if not hasattr(method, option):
            has = [other for other, make in BY_NAME.items() if hasattr(make(1), option)]
            raise InputError(f"--{option}: found --method {name}, allowed: {', '.join(has)}.")
    return dataclasses.replace(method, **given)


def _sharpness(imager, grid):
    from ..optics.lens_types import sharpness

    return sharpness(imager, grid)


def _points(image, imager, grid, sharp, progress):
    """Points, the columns of a file that speak for them, and a warning where they are not to be trusted."""
    import numpy as np

    from ..detection.consistency import signal
    from ..detection.evidence import point_evidence
    from ..detection.locate import NOT_TRUSTED, find_points
    from ..optics.lens_types import blur_warning

    light = signal(image)
    points = find_points(light, imager, grid, progress=progress)
    warning = blur_warning(sharp, "points", NOT_TRUSTED)
    columns = point_evidence(points, light, imager, grid)._asdict()
    return points, columns | {"confident": np.full(len(points), int(warning is None))}, warning


def _network(weights: Path | None):
    """What cleans a volume: our network, or that of a file."""
    from ..detection.unet import read_weights, suppress

    return partial(suppress, network=read_weights(weights) if weights else None)


def _volume_of_points(points, grid):
    import numpy as np

    from ..simulation.phantoms import rasterize

    # Points of no light beside them, up to a power of two: other numbers of points need no other program.
    padded = np.zeros((1 << max(len(points) - 1, 0).bit_length(), 4))
    padded[: len(points)] = points
    return np.asarray(rasterize(padded, grid), np.float32)
