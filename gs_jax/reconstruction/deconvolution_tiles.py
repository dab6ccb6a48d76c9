"""Deconvolution of captures whose scenes do not fit into memory, in tiles.

A PSF reaches a part of the sensor, so a tile is deconvolved from the pixels that its points reach. The scene around it
whose light falls onto these pixels is reconstructed with it, and left out. All tiles share the capture's offset and
unit, and the largest back-projected value, to which weights are relative.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Num

from ..base.machine import available_memory
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..io.ngff import VolumeSeries, tile_unit
from ..linear.measured_psf import ConvolutionOperator
from ..microscope.grid import Grid
from ..solvers.admm import ConvolutionADMM
from ..solvers.base import estimate_of, run_solver, start_solver
from ..solvers.richardson_lucy import RichardsonLucy
from .deconvolution import (
    ARRAYS,
    Deconvolver,
    Smoothness,
    check_memory,
    choose_smoothness,
    light_and_unit,
    normalise_spots,
)
from .recording import reconstruct_frames
from .tiles import Tiles, largest_side, with_weights


def scene_tiles(
    grid: Grid, psf: Num[Array | np.ndarray, "depth high wide"], solver: Deconvolver, side: int | None
) -> Tiles:
    """Tiles of a scene with as much margin as a PSF reaches, of a side in pixels or of the largest that fits memory."""
    unit, widest = tile_unit(grid.shape), max(psf.shape[1:])
    if side is None:
        # The capture, and the same in its unit.
        memory = available_memory() - 8 * math.prod(grid.shape)
        side = largest_side(grid.shape, memory / (4 * ARRAYS[type(solver)] * len(psf)), 2 * widest)
    return Tiles(grid, -(-side // unit) * unit, -(-widest // 2))


def deconvolve_tiles(
    image: Image,
    psf: Num[Array | np.ndarray, "depth high wide"],
    solver: Deconvolver,
    tiles: Tiles,
    series: VolumeSeries,
    *,
    choose: bool = False,
    progress: Progress | None = None,
) -> Smoothness | None:
    """Deconvolve a capture tile by tile, and write each as it is done; parameters and errors as `run_deconvolution`.

    Parameters
    ----------
    tiles
        From `scene_tiles`.
    series
        Store of the scene, with `tile=tiles.side`. What it has is kept; its journal has each tile's steps and last
        change.
    """
    progress = progress or Progress()
    light, unit = light_and_unit(image)
    spots = normalise_spots(psf, light.shape)
    # The same for all tiles, whose pixels are of one shape.
    system = ConvolutionOperator(spots, tiles.shape)
    check_memory(solver, system)
    smoothness = None
    if choose and isinstance(solver, ConvolutionADMM):
        smoothness = choose_smoothness(light, spots, solver, progress)
        solver = dataclasses.replace(solver, tv=smoothness.tv)
        series.provenance = {**series.provenance, "tv": f"{smoothness.tv:.3g}, chosen from the capture"}
    largest = 1.0
    if not isinstance(solver, RichardsonLucy):
        windows = (tiles.window(number) for number in range(tiles.count))
        largest = max(float(_back(system, light[window])[(slice(None), *system.window)].max()) for window in windows)

    def make(number: int, _) -> tuple[Volume, dict[str, Any], None]:
        part = light[tiles.window(number)]
        state = with_weights(start_solver(solver, part, system), solver, largest)
        run = run_solver(solver, part, system, Progress(), state=state)
        scene = np.asarray(estimate_of(solver, run.state), np.float32)[:, *system.window][:, *tiles.inner(number)]
        return unit * scene, {"steps": run.steps, "change": run.residual}, None

    reconstruct_frames(series, int, make, progress=progress)
    return smoothness


@jax.jit
def _back(system, image):
    return system.T.mv(image)
