"""Pictures of traces and of tracks: regions and their signals over time, and the paths of particles."""

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

# Colours of neighbours in number differ: steps of the golden ratio through a map.
_COLOURS, _TURN = "turbo", (5**0.5 - 1) / 2


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
