"""The planes of a volume as pictures, and a slider through them: for pages and notebooks, without a network."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from ..grid import Grid
from .encode import in_range, png, thinned

# Number of slices, and pixels of a side.
_SLICES, _SIDE = 100, 720
# Darkest and brightest that are told apart, percentiles: back-projection has a pedestal, which is no object.
_DARKEST, _BRIGHTEST = 50, 99.95
# Voxels that tell.
_LOOKED_AT = 20_000_000
# Points that are drawn, the brightest; the radius of a circle around one, of the picture's width.
_DRAWN, _RADIUS = 2000, 0.012
# What the slider does. It needs no name that another one on the page might have, and no script beside it.
_MOVE = (
    "const planes=this.closest('figure').querySelectorAll('.plane'),z=planes[this.value].dataset.depth;"
    "planes.forEach((plane,k)=>plane.hidden=k!=this.value);"
    "this.nextElementSibling.value=z;this.setAttribute('aria-valuetext',z)"
)


class Slices(NamedTuple):
    """Planes of a volume as pictures with their depths, mm, and the values that are black and white.

    `sides`: width and height of the pictures, mm; `step`: voxels each way that are one pixel; `of`: all planes.
    """

    pictures: list[str]
    depths: list[float]
    low: float
    high: float
    step: int
    sides: tuple[float, float]
    of: int


def brightness(volume: Num[np.ndarray, "*shape"]) -> tuple[float, float]:
    """The values that are shown as black and as white."""
    some = np.asarray(volume).ravel()[:: -(-np.size(volume) // _LOOKED_AT)]
    low, high = (float(v) for v in np.percentile(some, (_DARKEST, _BRIGHTEST)))
    if high <= low:  # nearly all of it is dark
        high = float(volume.max())
    return low, high


def slices(volume: Num[np.ndarray, "depth row column"], grid: Grid, most_bytes: int) -> Slices:
    """At most a hundred planes, evenly chosen; large ones are binned, so that all have `most_bytes` uncompressed."""
    kept = np.unique(np.linspace(0, len(volume) - 1, min(_SLICES, len(volume))).round().astype(int))
    most = max(min(_SIDE, int(np.sqrt(most_bytes / len(kept)))), 64)
    low, high = brightness(volume)
    step = -(-max(volume.shape[1:]) // most)
    made = [png(in_range(thinned(volume[k], most), low, high), "magma") for k in kept]
    rows, columns = (max(n // step, 1) * min(step, n) * grid.pitch for n in volume.shape[1:])
    return Slices(made, [float(grid.depths[k]) for k in kept], low, high, step, (columns, rows), len(volume))


def slider(shown: Slices, marks: Sequence[str] = ()) -> str:
    """A figure of HTML with a slider through the slices; it begins in the middle, where it stays without scripts.

    `marks` are drawings over the slices, SVG.
    """
    start, words = len(shown.depths) // 2, [f"{z:.5g} mm" for z in shown.depths]
    planes = "".join(
        f'<div class="plane" data-depth="{z}" style="position:relative"{"" if k == start else " hidden"}>'
        f'<img class="picture" src="{picture}" alt="The volume at {z}" style="display:block;width:100%">'
        f"{marks[k] if marks else ''}</div>"
        for k, (z, picture) in enumerate(zip(words, shown.pictures, strict=True))
    )
    said = f"Black is {shown.low:.3g} and white {shown.high:.3g} in all slices"
    said += f"; means of {shown.step} x {shown.step} voxels" if shown.step > 1 else ""
    said += f"; {len(words)} of {shown.of} depths" if len(words) < shown.of else ""
    return (
        f'<figure class="slices" style="width:100%;max-width:640px;margin:0">{planes}'
        '<label class="row" style="display:flex;gap:.6em;align-items:center;margin:.5em 0">depth '
        f'<input type="range" min="0" max="{len(words) - 1}" step="1" value="{start}" autocomplete="off" '
        f'aria-valuetext="{words[start]}" oninput="{_MOVE}" style="flex:1"> <output>{words[start]}</output></label>'
        f"<figcaption>{said}. Arrow keys move the slider.</figcaption></figure>"
    )


def circles(points: Float[np.ndarray, "point 4"], shown: Slices, grid: Grid) -> list[str]:
    """Drawings for `slider`: circles around points, in the slice that is next to each."""
    points = points[np.argsort(-points[:, 3], kind="stable")[:_DRAWN]]
    nearest = np.abs(points[:, 2:3] - np.asarray(shown.depths)).argmin(1)
    (left, _, _, top), (width, height) = grid.extent, shown.sides
    start = (
        f'<svg viewBox="{left:.5g} {top:.5g} {width:.5g} {height:.5g}" fill="none" stroke="cyan" '
        'style="position:absolute;inset:0;width:100%;height:100%">'
    )
    draw = '<circle cx="{:.4f}" cy="{:.4f}" r="{:.3g}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'
    return [
        start + "".join(draw.format(x, y, _RADIUS * width) for x, y in points[nearest == k, :2]) + "</svg>"
        for k in range(len(shown.depths))
    ]
