"""Pictures of traces and of tracks: regions and their signals over time, and the paths of particles."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int, Shaped
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from ..io.traces import SIGNALS
from ..microscope.grid import Grid

# Colours of neighbours in number differ: steps of the golden ratio through a map.
_COLOURS, _TURN = "turbo", (5**0.5 - 1) / 2
# More regions are not numbered; rows of a heat map with labels.
_NUMBERED, _TICKS = 100, 12


def _colours(numbers: Int[np.ndarray, " item"]) -> np.ndarray:
    return colormaps[_COLOURS](0.05 + 0.9 * (_TURN * numbers % 1))


def draw_tracks(
    frames: Int[np.ndarray, " point"],
    particles: Int[np.ndarray, " point"],
    positions: Float[np.ndarray, "point 3"],
    interval: float | None = None,
) -> Figure:
    """Draw the paths of particles from above, and their depth over time; a dot is where a path begins."""
    order = np.lexsort((frames, particles))
    frames, particles, positions = frames[order], particles[order], positions[order]
    numbers, first = np.unique(particles, return_index=True)
    time = frames * (interval or 1.0)
    figure = Figure(figsize=(11, 5), dpi=110, layout="constrained")
    above, depth = figure.subplots(1, 2)
    for axes, x, y in ((above, *positions[:, :2].T), (depth, time, positions[:, 2])):
        parts = np.split(np.column_stack([x, y]), first[1:]) if len(first) else []
        axes.add_collection(LineCollection(parts, colors=_colours(numbers), lw=1.2))
        axes.scatter(x[first], y[first], c=_colours(numbers), s=12, zorder=3)
        axes.autoscale_view()
    count = f"{len(numbers)} particle{'s' * (len(numbers) != 1)}"
    above.set(xlabel="x, mm", ylabel="y, mm", title=f"{count}, from above", aspect="equal")
    above.invert_yaxis()
    depth.set(xlabel="time, s" if interval else "frame", ylabel="z, mm", title="Depth")
    return figure


def draw_traces(
    columns: Mapping[str, Shaped[np.ndarray, " row"]],
    image: Float[np.ndarray, "y x"] | None = None,
    labels: Int[np.ndarray, "y x"] | None = None,
    grid: Grid | None = None,
) -> Figure:
    """Draw regions from above, with their numbers, and a heat map of dF/F, a row for each.

    Parameters
    ----------
    columns
        Of a table of `traces_table`.
    image, labels, grid
        A picture of the volume, the regions in it, and their voxels, if there are any.
    """
    numbers, row = np.unique(columns["region"], return_inverse=True)
    frames, column = np.unique(columns["frame"], return_inverse=True)
    name = "dff" if np.isfinite(columns["dff"]).any() else next(name for name in SIGNALS if name in columns)
    # Columns from edge to edge; those between the edges of frames are gaps.
    edges = np.union1d(frames - 0.5, frames + 0.5)
    values = np.full((len(numbers), len(edges) - 1), np.nan)
    values[row, np.searchsorted(edges, frames - 0.5)[column]] = columns[name]
    places = np.array([[np.median(columns[axis][row == n]) for axis in ("x_mm", "y_mm")] for n in range(len(numbers))])
    figure = Figure(figsize=(12, 5), dpi=110, layout="constrained")
    above, heat = figure.subplots(1, 2, width_ratios=(1, 1.4))
    if image is not None and grid is not None:
        low, high = np.percentile(image, (1, 99.8))
        above.imshow(image, "gray", vmin=low, vmax=high, extent=grid.extent)
        if labels is not None:
            x, y = np.asarray(grid.x), np.asarray(grid.y)
            for number, colour in zip(numbers, _colours(numbers), strict=True):
                # Another region may hide it.
                if 0 < np.count_nonzero(inside := labels == number) < inside.size:
                    above.contour(x, y, inside, [0.5], colors=[colour], linewidths=1)
    else:
        above.scatter(*places.T, c=_colours(numbers), s=25)
        above.set(aspect="equal")
        above.invert_yaxis()
    if len(numbers) <= _NUMBERED:
        for number, place in zip(numbers, places, strict=True):
            text = above.annotate(str(number), place, (4, 4), textcoords="offset points", fontsize=8, color="white")
            text.set_path_effects([withStroke(linewidth=2, foreground="black")])
    count = f"{len(numbers)} region{'s' * (len(numbers) != 1)}"
    above.set(xlabel="x, mm", ylabel="y, mm", title=f"{count}, from above")
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    if timed := "time_s" in columns:
        ends = np.argmin(columns["frame"]), np.argmax(columns["frame"])
        step = np.ptp(columns["time_s"][[*ends]]) / (np.ptp(frames) or 1) or 1.0
        edges = columns["time_s"][ends[0]] + step * (edges - frames[0])
    else:
        heat.xaxis.set_major_locator(MaxNLocator(integer=True))
    rows = np.arange(len(numbers) + 1)
    picture = heat.pcolorfast(edges, rows, values, cmap="viridis", vmin=low, vmax=high)
    heat.set(xlabel="time, s" if timed else "frame", ylabel="region", title="Signals over time", ylim=(rows[-1], 0))
    ticks = np.arange(0, len(numbers), -(-len(numbers) // _TICKS) or 1)
    heat.set_yticks(ticks + 0.5, [str(numbers[tick]) for tick in ticks])
    figure.colorbar(picture, ax=heat, label="dF/F" if name == "dff" else name)
    return figure
