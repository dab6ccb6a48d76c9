"""Fig. 6: a resolution target at six depths, its resolved lines, and the plane where it is sharpest.

Groups 2 and 3 of a USAF 1951 target (MIL-STD-150A), self-luminous, are imaged at each of the paper's depths by the
independent ray tracer, with camera noise, and back-projected at all six. Contrast is that of the bars of an element
against the gaps between them, `(I_bar - I_gap) / (I_bar + I_gap)`; the pedestal of back-projection lowers it.

    python -m experiments.fig6_usaf [--out DIR]

Writes `fig6.json` and `fig6.png`; about two minutes on two cores.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.ndimage import map_coordinates

from experiments.common import Report, main, table
from experiments.ray_tracer import traced
from experiments.true_image import bars
from gs_jax import Camera, Design, Grid, Progress, expose, geomscope, reconstruct
from gs_jax.apps.pictures import draw_image
from gs_jax.simulation import electrons

DEPTHS = (18.0, 18.64, 19.27, 19.91, 20.54, 21.18)  # mm, from the paper
# mm: pitch of voxels and emitters, and the left and upper edges of the groups.
_VOXEL, _EMITTERS, _LEFT, _TOP = 0.005, 0.005, {2: -1.25, 3: 0.5}, 1.93
_PEAK_ELECTRONS = 10_000
# Contrast from which lines count as resolved (Rayleigh criterion for slits).
RESOLVED = 0.1
# Fraction of a bar's length that is averaged, without its ends.
_MIDDLE = 0.6


class Element(NamedTuple):
    """Three vertical and three horizontal bars, `(x0, x1, y0, y1)` of each, mm, +y upwards."""

    group: int
    number: int
    width: float
    vertical: list[tuple[float, float, float, float]]
    horizontal: list[tuple[float, float, float, float]]

    @property
    def pairs(self) -> float:
        """Line pairs per mm."""
        return 0.5 / self.width


def target() -> list[Element]:
    """Elements of groups 2 and 3: bars five times as long as wide, `2^(group + (number - 1) / 6)` line pairs per mm."""
    elements = []
    for group, left in _LEFT.items():
        top = _TOP
        for number in range(1, 7):
            w = 0.5 / 2 ** (group + (number - 1) / 6)
            steps, beside = (0, 2 * w, 4 * w), left + 7 * w
            vertical = [(left + step, left + step + w, top - 5 * w, top) for step in steps]
            horizontal = [(beside, beside + 5 * w, top - step - w, top - step) for step in steps]
            elements.append(Element(group, number, w, vertical, horizontal))
            top -= 7 * w
    return elements


def run(
    design: Design, *, depths: Sequence[float] = DEPTHS, voxel: float = _VOXEL, rays: int = 8, progress: Progress
) -> dict:
    """Return volumes `(target, depth, y, x)` and contrasts `(target, depth, element, direction)`."""
    imager, elements = design.imager(), target()
    side = round(4.2 / voxel / 2) * 2 + 1
    grid = Grid(np.array(depths), (side, side), voxel)
    boxes = [{"vertical_bars": e.vertical, "horizontal_bars": e.horizontal} for e in elements]
    volumes = []
    for depth in progress.track(depths, "Target depths"):
        light = traced(bars(boxes, depth, _EMITTERS), imager, rays)
        counts = expose(light, Camera(), jax.random.key(0), peak_electrons=_PEAK_ELECTRONS)
        volumes.append(reconstruct(electrons(np.asarray(counts), Camera()), imager, grid, progress=Progress()))
    both = lambda plane, element: [contrast(*profile(plane, grid, element, direction)) for direction in (0, 1)]
    contrasts = [[[both(plane, e) for e in elements] for plane in volume] for volume in volumes]
    return {"depths": list(depths), "grid": grid, "volumes": np.array(volumes), "contrast": np.array(contrasts)}


def profile(plane: np.ndarray, grid: Grid, element: Element, direction: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in bar widths from the first edge, and mean values across the bars (`direction` 0: vertical bars)."""
    x0, x1, y0, y1 = np.transpose((element.vertical, element.horizontal)[direction])
    x0, x1, y0, y1 = x0.min(), x1.max(), y0.min(), y1.max()
    across = np.linspace(-1, 6, 141)
    along = (0.5 + _MIDDLE * np.linspace(-0.5, 0.5, 21)) * 5 * element.width
    if direction == 0:
        x, y = np.meshgrid(x0 + across * element.width, y0 + along)
    else:
        y, x = np.meshgrid(y1 - across * element.width, x0 + along)
    left, _, _, top = grid.extent
    places = [(y - top) / grid.pitch - 0.5, (x - left) / grid.pitch - 0.5]
    return across, map_coordinates(plane, places, order=1).mean(0)


def contrast(across: np.ndarray, values: np.ndarray) -> float:
    """Contrast between the middle halves of the three bars and of the two gaps between them."""
    mean = lambda places: np.mean([values[np.abs(across - place) <= 0.25].mean() for place in places])
    bar, gap = mean((0.5, 2.5, 4.5)), mean((1.5, 3.5))
    return float((bar - gap) / (bar + gap))


def numbers(results: dict) -> list[dict]:
    """For each depth of the target: the sharpest plane, and the finest resolved element in the target's own plane."""
    elements, rows = target(), []
    number = next(i for i, e in enumerate(elements) if (e.group, e.number) == (3, 2))
    for k, depth in enumerate(results["depths"]):
        contrasts, own = results["contrast"][k, :, number].mean(-1), results["contrast"][k, k]
        resolved = [e for e, both in zip(elements, own, strict=True) if both.min() >= RESOLVED]
        finest = max(resolved, key=lambda e: e.pairs, default=None)
        row = {"target_mm": depth, "sharpest_mm": results["depths"][int(contrasts.argmax())]}
        row |= {"vertical": float(own[number, 0]), "horizontal": float(own[number, 1])}
        rows.append(row | {"finest": f"group {finest.group}, element {finest.number}" if finest else "none"})
    return rows


def picture(results: dict) -> Figure:
    """Plot a row per depth of the target and a column per plane, with lines of group 3, element 2 beside them."""
    depths, grid, elements = results["depths"], results["grid"], target()
    extent, count = grid.extent, len(depths)
    figure = Figure(figsize=(13.5, 8.6), dpi=75, layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(2, 1))
    planes, beside = halves
    for k, row in enumerate(planes.subplots(count, count, squeeze=False)):
        high = float(np.quantile(results["volumes"][k], 0.9995))
        for j, axes in enumerate(row):
            draw_image(axes, results["volumes"][k, j], extent, high=high, upward=True)
            if k == 0:
                axes.set_title(f"{depths[j]:g} mm", fontsize=9)
            if j == k:
                for spine in axes.spines.values():
                    spine.set(color="C6", lw=2.5, ls="--")
        row[0].set_ylabel(f"target at\n{depths[k]:g} mm", fontsize=9)
    planes.supxlabel(
        "Planes of back-projection, each row from zero to its 99.95th percentile; dashed: the target's depth",
        fontsize=9,
    )
    element = next(e for e in elements if (e.group, e.number) == (3, 2))
    image, lines, depth = beside.subplots(3, 1)
    _draw_zoom(image, results["volumes"][0, 0], grid, element)
    for direction, name in enumerate(("vertical bars", "horizontal bars")):
        across, values = profile(results["volumes"][0, 0], grid, element, direction)
        lines.plot(across * 1000 * element.width, values / values.max(), "-", label=name)
    for start in (0, 2, 4):
        lines.axvspan(1000 * start * element.width, 1000 * (start + 1) * element.width, color="0.9", zorder=0)
    lines.set(xlabel="across the bars (grey), um", ylabel="back-projection", ylim=(0, 1.05))
    lines.set_title("Lines of group 3, element 2, at 18 mm", fontsize=10)
    lines.legend(loc="lower center", ncols=2, fontsize=8)
    for group, number, style in ((2, 2, "o-"), (3, 2, "s-"), (3, 4, "^-"), (3, 6, "v-")):
        at = next(i for i, e in enumerate(elements) if (e.group, e.number) == (group, number))
        own = [results["contrast"][k, k, at].mean() for k in range(count)]
        depth.plot(depths, own, style, label=f"{elements[at].pairs:.1f} pairs/mm ({group}-{number})")
    depth.axhline(RESOLVED, color="gray", ls=":")
    depth.set(xlabel="depth of target and plane, mm", ylabel="contrast", ylim=(0, None))
    depth.legend(fontsize=8, ncols=2)
    return figure


def _draw_zoom(axes, plane: np.ndarray, grid: Grid, element: Element) -> None:
    """Draw the surroundings of group 3, element 2, with the element's frame."""
    left, _, _, top = grid.extent
    (x0, x1), (y0, y1) = (0.4, 1.35), (0.8, 2.0)
    rows, columns = (
        slice(*(round((edge - first) / grid.pitch) for edge in edges))
        for edges, first in (((y0, y1), top), ((x0, x1), left))
    )
    part = plane[rows, columns]
    draw_image(axes, part, (x0, x1, y1, y0), high=float(part.max()), upward=True)
    boxes = np.array(element.vertical + element.horizontal)
    (u0, v0), (u1, v1) = boxes[:, [0, 2]].min(0), boxes[:, [1, 3]].max(0)
    frame = Rectangle((u0 - 0.03, v0 - 0.03), u1 - u0 + 0.06, v1 - v0 + 0.06, fill=False, ec="white", lw=1)
    axes.add_patch(frame)
    axes.set_title("Target at 18 mm; framed: group 3, element 2", fontsize=10)


def report(progress: Progress) -> Report:
    results = run(geomscope(), progress=progress)
    rows = numbers(results)
    columns = ("target, mm", "sharpest plane, mm", "contrast of 3-2, vertical", "horizontal", "finest resolved")
    lines = [[f"{x:.3g}" if isinstance(x, float) else x for x in row.values()] for row in rows]
    return Report({"fig6.json": rows, "fig6.png": picture(results)}, [table(columns, lines)])


if __name__ == "__main__":
    main(report)
