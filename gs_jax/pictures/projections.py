"""A reconstruction to look at: maximum projections to scale, with points on them; in a notebook slices, too."""

import base64
import io

import numpy as np
from jaxtyping import Array, Float, Num
from matplotlib import colormaps
from matplotlib.figure import Figure

from ..grid import Grid
from .planes import circles, slices, slider

# Darkest and brightest shown, percentiles: back-projection has a pedestal, which is no object, and a few bright voxels.
_DARKEST, _BRIGHTEST = 50, 99.95
# Of a notebook: bytes of the slices before they are compressed, and dots of an inch of the projections.
_SLICE_BYTES, _DPI = 2_500_000, 80


class _Shown(Figure):
    """The projections, which a notebook shows below slices of the volume."""

    def __init__(self, volume, grid, points, **options):
        super().__init__(**options)
        self._seen = volume, grid, points

    def _repr_html_(self) -> str:
        volume, grid, points = self._seen
        made = slices(volume, grid, _SLICE_BYTES)
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=_DPI)
        maxima = f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"
        marks = [] if points is None else circles(np.asarray(points), made, grid)
        return f'<div>{slider(made, marks)}<img src="{maxima}" alt="Maxima along z, x and y"></div>'


def show(
    volume: Num[Array | np.ndarray, "depth y x"],
    grid: Grid,
    *,
    points: Float[Array | np.ndarray, "point 4"] | None = None,
) -> Figure:
    """Maximum projections of a volume along z, y and x, to scale in mm, with points as circles.

    *Host.*

    Parameters
    ----------
    volume, grid
        `grid.volume_shape`, and where its voxels are; depths ascend.
    points
        `(x, y, z, intensity)`, as `find_points` returns them: circles, coloured by depth; in slices where they are.

    Returns
    -------
    matplotlib.figure.Figure
        `figure.savefig(path)` writes it. In Jupyter and VS Code, as the last line of a cell, it is below a slider
        through the depths, which is HTML of less than 5 MB and works in saved notebooks, without a network or a kernel.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> grid = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)
    >>> figure = gs.show(np.random.default_rng(0).random(grid.volume_shape), grid)
    >>> figure.savefig("volume.png")
    """
    volume = np.asarray(volume)
    if volume.shape != grid.volume_shape:
        raise ValueError(f"`volume` must be of the grid's shape {grid.volume_shape}, got {volume.shape}.")
    # As high as the plane is, so that it fills its place and the views beside it are in line with it.
    figure = _Shown(
        volume, grid, points, figsize=(8.2, 2.4 + 5.4 * grid.shape[0] / grid.shape[1]), layout="constrained"
    )
    axes = figure.subplots(2, 2, width_ratios=(4, 1), height_ratios=(4 * grid.shape[0] / grid.shape[1], 1))
    plane, beside, below = axes[0, 0], axes[0, 1], axes[1, 0]
    axes[1, 1].axis("off")

    left, right, bottom, top = grid.extent
    x, y = np.linspace(left, right, grid.shape[1] + 1), np.linspace(top, bottom, grid.shape[0] + 1)
    z = _edges(np.asarray(grid.depths, float), grid.pitch)
    image = _draw(plane, x, y, volume.max(0))
    _draw(beside, z, y, volume.max(2).T)
    _draw(below, x, z, volume.max(1))
    plane.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=(left, right), ylim=(bottom, top))
    beside.set(xlabel="z, mm", ylim=(bottom, top), xlim=(z[0], z[-1]))
    below.set(xlabel="x, mm", ylabel="z, mm", xlim=(left, right), ylim=(z[0], z[-1]))
    figure.colorbar(image, ax=axes[1, 1], label="from above", fraction=0.6, location="left")
    plane.set_title(" x ".join(map(str, volume.shape)) + " voxels (z, y, x), maxima")
    if points is not None and len(points):
        px, py, pz = np.asarray(points)[:, :3].T
        colours = colormaps["winter"](np.clip((pz - z[0]) / (z[-1] - z[0]), 0, 1))
        for axis, a, b in ((plane, px, py), (beside, pz, py), (below, px, pz)):
            axis.scatter(a, b, s=30, facecolors="none", edgecolors=colours)
        plane.set_title(f"{plane.get_title()}, {len(points)} points")
    return figure


def _draw(axes, across, along, maxima):
    """Each view to its own brightness: the more voxels a line of sight has, the brighter are their maxima."""
    low, high = np.percentile(maxima, (_DARKEST, _BRIGHTEST))
    return axes.pcolormesh(across, along, maxima, cmap="magma", vmin=low, vmax=max(high, low + 1e-12), rasterized=True)


def _edges(depths, pitch):
    """Between the planes, and half a step beyond the first and the last; a single plane is as thick as a voxel."""
    if len(depths) == 1:
        return depths[0] + np.array([-0.5, 0.5]) * pitch
    between = (depths[1:] + depths[:-1]) / 2
    return np.concatenate([[2 * depths[0] - between[0]], between, [2 * depths[-1] - between[-1]]])
