"""Pictures: one style for all, maximum projections to scale, and slices with a slider as HTML without scripts.

A method has a colour and a marker, and images have a scale bar and a scale of brightness.
"""

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Num, Shaped, UInt8
from matplotlib import color_sequences, colormaps
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from PIL import Image

from ..base.arrays import host_code
from ..base.typing import Points
from ..microscope.grid import Grid

# Told apart with any colour vision (M. A. Petroff, arXiv:2107.02270).
PALETTE = color_sequences["petroff10"]
# Label, colour and marker of methods in pictures.
_METHODS = {
    "zeros": ("nothing", "black", ""),
    "backproject": ("back-projection", PALETTE[0], "o"),
    "backproject + points": ("find_points", PALETTE[9], "*"),
    "backproject + cluster": ("clustering", PALETTE[1], "v"),
    "backproject + paper's clusters": ("the paper's clustering", PALETTE[7], "^"),
    "backproject + unet": ("our U-Net", PALETTE[2], "D"),
    "backproject + paper's U-Net": ("the paper's U-Net", PALETTE[5], "d"),
    "unrolled": ("unrolled", PALETTE[4], "P"),
    "list-rl": ("list-RL", PALETTE[8], "h"),
    "richardson-lucy": ("Richardson-Lucy", PALETTE[6], "s"),
    "fista": ("FISTA", PALETTE[3], "p"),
    "admm": ("ADMM", "#009e73", "X"),
    "surface": ("surface", "#56b4e9", "<"),
    "truth": ("truth", "black", ""),
}
# Other names of methods in tables.
_ALIASES = {
    "backproject + clusters": "backproject + cluster",
    "backproject + our U-Net": "backproject + unet",
    "back-projection": "backproject",
    "paper's network": "backproject + paper's U-Net",
    "our network": "backproject + unet",
}
_DENSE = ", dense"
# Perceptually uniform, of matplotlib.
IMAGES = "magma"
# Largest length of a scale bar, as a share of the image's width.
_BAR = 0.3
# Voxels that are sampled for the median of a volume.
_SAMPLED = 20_000_000
# Cells along a side of a maximum projection, at most: fewer than pixels of the picture, so that none is left out.
_MAX_CELLS = 400
# Labelled brightness of the colour bar, in percent of the way from the median to the maximum.
_PERCENT = (0, 5, 20, 50, 100)
# Slices and their pixels along a side, at most.
_MAX_SLICES, _MAX_SIDE = 100, 720
# Circles in slices at most, those of the brightest points, and their radius relative to the width.
_MAX_CIRCLES, _CIRCLE_RADIUS = 2000, 0.012
# In notebooks: bytes of the slices before compression, and resolution of the projections.
_NOTEBOOK_BYTES, _NOTEBOOK_DPI = 2_500_000, 80
# Inline, so that it works in saved notebooks and several times on a page.
_ON_INPUT = (
    "const planes=this.closest('figure').querySelectorAll('.plane'),z=planes[this.value].dataset.depth;"
    "planes.forEach((plane,k)=>plane.hidden=k!=this.value);"
    "this.nextElementSibling.value=z;this.setAttribute('aria-valuetext',z)"
)


def label_of(method: str) -> str:
    """Label of a method in pictures; an unknown one as it is."""
    return line_of(method)["label"]


def line_of(method: str) -> dict[str, Any]:
    """Label, colour, marker and line of a method, the same in every picture; dense matrices have dashes."""
    name = method.removesuffix(_DENSE)
    dense = method[len(name) :]
    label, colour, marker = _METHODS.get(_ALIASES.get(name, name), (name, "black", "."))
    style = ":" if not marker else "--" if dense else "-"
    return {"label": label + dense, "color": colour, "marker": marker, "ls": style, "ms": 5}


def draw_image(
    axes: Axes,
    image: Num[np.ndarray, "row column *rgb"],
    extent: tuple[float, float, float, float],
    *,
    low: float = 0.0,
    high: float | None = None,
    upward: bool = False,
    cmap: str = IMAGES,
) -> AxesImage:
    """Draw an image with a scale bar in place of axes.

    Parameters
    ----------
    axes
        Axes to draw in.
    image
        Gray values, or red, green and blue from 0 to 1.
    extent
        `(left, right, bottom, top)`, mm.
    low, high
        Values of black and white; `high` is by default the maximum.
    upward
        +y upwards, as some scenes were drawn, not downwards as on the sensor.
    cmap
        Color map of matplotlib.
    """
    high = float(image.max()) if high is None else high
    shown = axes.imshow(image, cmap=cmap, vmin=low, vmax=max(high, low + 1e-12), extent=extent, interpolation="none")
    axes.set(xticks=[], yticks=[])
    if upward:
        axes.invert_yaxis()
    _draw_bar(axes, abs(extent[1] - extent[0]), colormaps[cmap](1.0))
    return shown


def round_length(most: float) -> float:
    """The longest of 1, 2 or 5 times a power of ten that is not above."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step for step in (1, 2, 5) if step * power <= most * (1 + 1e-9)) * power)


def _draw_bar(axes: Axes, width: float, colour) -> None:
    length = round_length(_BAR * width)
    start, share = 0.95 - length / width, length / width
    axes.plot([start, 0.95], [0.05, 0.05], color=colour, lw=2.5, solid_capstyle="butt", transform=axes.transAxes)
    # Dark behind, for images that are bright there.
    box = {"facecolor": colormaps[IMAGES](0.0), "alpha": 0.6, "lw": 0, "pad": 1}
    style = {"ha": "center", "va": "bottom", "transform": axes.transAxes, "bbox": box}
    axes.text(start + share / 2, 0.08, _length_text(length), color=colour, fontsize=9, **style)


def _length_text(length: float) -> str:
    return f"{length:g} mm" if length >= 1 else f"{1000 * length:g} um"


def to_uint8(values: Num[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Scale values from `low` to `high` to 0 to 255 and clip the others."""
    width = high - low if high > low else 1.0
    return np.clip((np.asarray(values, np.float32) - low) * (255 / width) + 0.5, 0, 255).astype(np.uint8)


def color_table(name: str) -> list[int]:
    """Red, green and blue of 256 colors of a map of matplotlib, flat."""
    return colormaps[name](np.arange(256), bytes=True)[:, :3].ravel().tolist()


def png_uri(image: UInt8[np.ndarray, "row column"], colors: str = "gray") -> str:
    """An image in the colors of a map of matplotlib, as PNG in a data URI."""
    picture = Image.fromarray(image, mode="L" if colors == "gray" else "P")
    if colors != "gray":
        picture.putpalette(color_table(colors))
    return _data_uri(lambda file: picture.save(file, "PNG"))


def figure_uri(figure: Figure, dpi: int = 100) -> str:
    """A figure as PNG in a data URI."""
    return _data_uri(lambda file: figure.savefig(file, format="png", dpi=dpi))


def _data_uri(write: Callable[[io.BytesIO], object]) -> str:
    write(file := io.BytesIO())
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def to_base64(numbers: Shaped[np.ndarray, "*shape"]) -> str:
    """The bytes of an array, little-endian, as base64."""
    numbers = np.ascontiguousarray(numbers)
    return base64.b64encode(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes()).decode()


def downsample(image: Num[np.ndarray, "row column"], max_side: int) -> Num[np.ndarray, "fewer_rows fewer_columns"]:
    """Means of square blocks, so that no side exceeds `max_side`; rows and columns that fill no block are cut."""
    step = -(-max(image.shape) // max_side)
    if step == 1:
        return image
    rows, columns = (max(n // step, 1) for n in image.shape)
    cut = np.asarray(image[: rows * step, : columns * step], np.float32)
    return cut.reshape(rows, min(step, cut.shape[0]), columns, min(step, cut.shape[1])).mean((1, 3))


def block_maxima(values: Num[np.ndarray, "*shape"], steps: Sequence[int]) -> Num[np.ndarray, "*fewer"]:
    """Maxima of blocks of `steps` along the axes; blocks at the ends may be smaller."""
    for axis, step in enumerate(steps):
        if step > 1:
            values = np.maximum.reduceat(values, np.arange(0, values.shape[axis], step), axis)
    return values


def display_range(volume: Num[np.ndarray, "*shape"]) -> tuple[float, float]:
    """The values shown as black and white: the median, as back-projection has a pedestal, and the maximum.

    With a lower white, ghosts of a hundredth of the brightest point would look as bright as the points.
    """
    sampled = np.asarray(volume).ravel()[:: -(-np.size(volume) // _SAMPLED)]
    return float(np.median(sampled)), float(np.max(volume))


def shade(values: Num[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Values from `low` to `high` as 0 to 255 by their square root, so that the dim is seen beside the bright."""
    width = high - low if high > low else 1.0
    return to_uint8(np.sqrt(np.clip((np.asarray(values, np.float32) - low) / width, 0, 1)), 0.0, 1.0)


class Slices(NamedTuple):
    """Planes of a volume as data URIs, their depths, mm, and the values of black and white.

    A pixel is the maximum of `step` x `step` voxels, `extent` is `(left, right, bottom, top)`, mm, `total` counts all
    planes, and `brightest` is the position of the plane with the brightest voxel in the list.
    """

    pictures: list[str]
    depths: list[float]
    low: float
    high: float
    step: int
    extent: tuple[float, float, float, float]
    total: int
    brightest: int


def make_slices(volume: Num[np.ndarray, "depth row column"], grid: Grid, max_bytes: int) -> Slices:
    """At most a hundred evenly chosen planes, binned to `max_bytes` in all before compression."""
    kept = np.unique(np.linspace(0, len(volume) - 1, min(_MAX_SLICES, len(volume))).round().astype(int))
    max_side = max(min(_MAX_SIDE, int(np.sqrt(max_bytes / len(kept)))), 64)
    low, high = display_range(volume)
    step = -(-max(volume.shape[1:]) // max_side)
    planes = [block_maxima(np.asarray(volume[k]), (step, step)) for k in kept]
    brightest = int(np.argmax([plane.max() for plane in planes]))
    left, _, _, top = grid.extent
    bottom, right = (first + step * n * grid.pitch for first, n in zip((top, left), planes[0].shape, strict=True))
    pictures = [png_uri(shade(plane, low, high), "magma") for plane in planes]
    depths, extent = [float(grid.depths[k]) for k in kept], (left, right, bottom, top)
    return Slices(pictures, depths, low, high, step, extent, len(volume), brightest)


def volume_html(
    volume: Num[np.ndarray, "depth row column"],
    grid: Grid,
    points: Points | None = None,
    *,
    maxima: Figure | None = None,
    max_bytes: int = _NOTEBOOK_BYTES,
) -> str:
    """HTML of a slider through slices, at most `max_bytes` before compression, above maximum projections.

    `maxima` is the figure that `show` returns for the same volume; by default it is drawn.
    """
    slices = make_slices(volume, grid, max_bytes)
    overlays = [] if points is None else _circle_overlays(np.asarray(points), slices)
    picture = figure_uri(show(volume, grid, points=points) if maxima is None else maxima, _NOTEBOOK_DPI)
    projections = f'<img src="{picture}" alt="Maxima along z, x and y" style="max-width:100%">'
    return f"<div>{_slider_html(slices, overlays)}{projections}</div>"


def _slider_html(slices: Slices, overlays: Sequence[str] = ()) -> str:
    """A figure with a slider through slices, at first at the brightest; `overlays` are SVG drawings, one per slice."""
    start, labels = slices.brightest, [f"{z:.5g} mm" for z in slices.depths]
    left, right, bottom, top = slices.extent
    bar = _scale_bar_html(right - left)
    planes = "".join(
        f'<div class="plane" data-depth="{z}" style="position:relative"{"" if k == start else " hidden"}>'
        f'<img class="picture" src="{picture}" alt="The volume at {z}" style="display:block;width:100%">'
        f"{overlays[k] if overlays else ''}{bar}</div>"
        for k, (z, picture) in enumerate(zip(labels, slices.pictures, strict=True))
    )
    caption = f"x from {left:.4g} to {right:.4g} mm to the right, y from {top:.4g} to {bottom:.4g} mm down. "
    caption += f"Black is {slices.low:.3g} and white {slices.high:.3g} in all slices, on a square-root scale"
    caption += f"; maxima of {slices.step} x {slices.step} voxels" if slices.step > 1 else ""
    caption += f"; {len(labels)} of {slices.total} depths" if len(labels) < slices.total else ""
    return (
        f'<figure class="slices" style="width:100%;max-width:640px;margin:0">{planes}'
        '<label class="row" style="display:flex;gap:.6em;align-items:center;margin:.5em 0">depth '
        f'<input type="range" min="0" max="{len(labels) - 1}" step="1" value="{start}" autocomplete="off" '
        f'aria-valuetext="{labels[start]}" oninput="{_ON_INPUT}" style="flex:1"> '
        f"<output>{labels[start]}</output></label>"
        f"<figcaption>{caption}. Arrow keys move the slider.</figcaption></figure>"
    )


def _scale_bar_html(width: float) -> str:
    """A scale bar over a picture that is `width` mm wide: HTML for the end of an element of `position: relative`."""
    length = round_length(_BAR * width)
    return (
        f'<div style="position:absolute;right:4%;bottom:4%;width:{100 * length / width:.4g}%;border-bottom:3px solid '
        "white;color:white;font-size:.85rem;line-height:1.4;text-align:center;white-space:nowrap;"
        f'text-shadow:0 0 3px black,0 0 3px black">{_length_text(length)}</div>'
    )


def _circle_overlays(points: Float[np.ndarray, "point 4"], slices: Slices) -> list[str]:
    """SVG circles around points, each in the nearest slice."""
    points = points[np.argsort(-points[:, 3], kind="stable")[:_MAX_CIRCLES]]
    nearest = np.abs(points[:, 2:3] - np.asarray(slices.depths)).argmin(1)
    left, right, bottom, top = slices.extent
    width, height = right - left, bottom - top
    opening = (
        f'<svg viewBox="{left:.5g} {top:.5g} {width:.5g} {height:.5g}" fill="none" stroke="cyan" '
        'style="position:absolute;inset:0;width:100%;height:100%">'
    )
    circle = '<circle cx="{:.4f}" cy="{:.4f}" r="{:.3g}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'
    return [
        opening + "".join(circle.format(x, y, _CIRCLE_RADIUS * width) for x, y in points[nearest == k, :2]) + "</svg>"
        for k in range(len(slices.depths))
    ]


class _VolumeFigure(Figure):
    """Maximum projections, which notebooks show below slices of the volume."""

    def __init__(self, volume, grid, points, **options):
        super().__init__(**options)
        self._data = volume, grid, points

    def _repr_html_(self) -> str:
        return volume_html(*self._data, maxima=self)


@host_code()
def show(volume: Num[Array | np.ndarray, "depth y x"], grid: Grid, *, points: Points | None = None) -> Figure:
    """Maximum projections of a volume along z, y and x, to scale in mm, with points as circles.

    *Host.*

    All three have the same scale of brightness: from the median of the projection along z, which is black, to the
    brightest voxel, by the square root, so that dim points are seen and ghosts of back-projection look as dim as they
    are. A side of more than 400 voxels is drawn as the maxima of blocks, which no picture is too small to show.

    Parameters
    ----------
    volume, grid
        An array of shape `grid.volume_shape`, and the positions of its voxels; depths ascend.
    points
        `(x, y, z, intensity)`, as from `find_points`: circles colored by depth, and circles in the slices.

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
    >>> figure = gs.show(np.random.default_rng(0).random(grid.volume_shape), grid)
    >>> figure.savefig("volume.png")
    """
    volume = np.asarray(volume)
    if volume.shape != grid.volume_shape:
        raise ValueError(f"`volume` must be of the grid's shape {grid.volume_shape}, got {volume.shape}.")
    # The height follows the plane, so that the views beside it are aligned.
    ratio = grid.shape[0] / grid.shape[1]
    figure = _VolumeFigure(volume, grid, points, figsize=(8.2, 2.4 + 5.4 * ratio), layout="constrained")
    (plane, beside), (below, empty) = figure.subplots(2, 2, width_ratios=(4, 1), height_ratios=(4 * ratio, 1))
    empty.axis("off")
    left, right, bottom, top = grid.extent
    x, y = np.linspace(left, right, grid.shape[1] + 1), np.linspace(top, bottom, grid.shape[0] + 1)
    z = _depth_edges(np.asarray(grid.depths, float), grid.pitch)
    low, high = display_range(maxima := volume.max(0))
    norm = PowerNorm(0.5, low, max(high, low + 1e-12), clip=True)
    image = _draw_maxima(plane, x, y, maxima, norm)
    _draw_maxima(beside, z, y, volume.max(2).T, norm)
    _draw_maxima(below, x, z, volume.max(1), norm)
    plane.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=(left, right), ylim=(bottom, top))
    beside.set(xlabel="z, mm", ylim=(bottom, top), xlim=(z[0], z[-1]))
    below.set(xlabel="x, mm", ylabel="z, mm", xlim=(left, right), ylim=(z[0], z[-1]))
    ticks = [low + (high - low) * percent / 100 for percent in _PERCENT]
    bar = figure.colorbar(image, ax=empty, label="% from median to maximum", fraction=0.6, location="left")
    bar.set_ticks(ticks, labels=list(map(str, _PERCENT)))
    plane.set_title(f"maxima of {' x '.join(map(str, volume.shape))} voxels (z, y, x), up to {high:.4g}")
    if points is not None and len(points):
        px, py, pz = np.asarray(points)[:, :3].T
        colors = colormaps["winter"](np.clip((pz - z[0]) / (z[-1] - z[0]), 0, 1))
        for axes, across, along in ((plane, px, py), (beside, pz, py), (below, px, pz)):
            axes.scatter(across, along, s=30, facecolors="none", edgecolors=colors)
        plane.set_title(f"{plane.get_title()}, {len(points)} points")
    return figure


def _draw_maxima(axes, across, along, maxima, norm):
    steps = [-(-n // _MAX_CELLS) for n in maxima.shape]
    down, right = (np.append(at[:-1:step], at[-1]) for at, step in zip((along, across), steps, strict=True))
    return axes.pcolormesh(right, down, block_maxima(maxima, steps), cmap="magma", norm=norm, rasterized=True)


def _depth_edges(depths, pitch):
    """Edges of the planes: half-way between them, and the outer ones symmetric; a single plane is a voxel thick."""
    if len(depths) == 1:
        return depths[0] + np.array([-0.5, 0.5]) * pitch
    between = (depths[1:] + depths[:-1]) / 2
    return np.concatenate([[2 * depths[0] - between[0]], between, [2 * depths[-1] - between[-1]]])
