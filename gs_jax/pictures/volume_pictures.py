"""A reconstruction to look at: maximum projections to scale, with points on them; in a notebook slices, too."""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Num, Shaped, UInt8
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image

from ..grid import Grid
from ..typing import Points

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
    points: Points | None = None,
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


def in_range(values: Num[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Values from `low` to `high` as 0 to 255; what is beyond is cut."""
    width = high - low if high > low else 1.0
    return np.clip((np.asarray(values, np.float32) - low) * (255 / width) + 0.5, 0, 255).astype(np.uint8)


def png(image: UInt8[np.ndarray, "row column"], colours: str = "gray") -> str:
    """An image of 256 colours, by the name of Matplotlib's map, as a data URI; without loss."""
    drawn = Image.fromarray(image, mode="L" if colours == "gray" else "P")
    if colours != "gray":
        drawn.putpalette(palette(colours))
    file = io.BytesIO()
    drawn.save(file, "PNG")
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def palette(colours: str) -> list[int]:
    """Red, green and blue of 256 colours, one after the other."""
    return colormaps[colours](np.arange(256), bytes=True)[:, :3].ravel().tolist()


def packed(numbers: Shaped[np.ndarray, "*shape"]) -> str:
    """The bytes of an array, little-endian, as base64."""
    numbers = np.ascontiguousarray(numbers)
    return base64.b64encode(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes()).decode()


def thinned(image: Num[np.ndarray, "row column"], most: int) -> Num[np.ndarray, "fewer_rows fewer_columns"]:
    """An image of at most `most` pixels a side: means of squares of pixels; rows and columns left over are cut."""
    step = -(-max(image.shape) // most)
    if step == 1:
        return image
    rows, columns = (max(n // step, 1) for n in image.shape)
    cut = np.asarray(image[: rows * step, : columns * step], np.float32)
    return cut.reshape(rows, min(step, cut.shape[0]), columns, min(step, cut.shape[1])).mean((1, 3))


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
