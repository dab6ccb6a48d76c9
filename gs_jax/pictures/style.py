"""One style for all pictures: a colour and a marker for each method, and images that say how long and how bright."""

from typing import Any

import numpy as np
from jaxtyping import Num
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

# Told apart with any colour vision (M. A. Petroff, arXiv:2107.02270).
PALETTE = ("#3f90da", "#ffa90e", "#bd1f01", "#94a4a2", "#832db6", "#a96b59", "#e76300", "#b9ac70", "#717581", "#92dadd")
# What a method is called in a picture, its colour and its marker.
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
# Methods that some tables call otherwise.
_ALSO = {
    "backproject + clusters": "backproject + cluster",
    "backproject + our U-Net": "backproject + unet",
    "back-projection": "backproject",
    "paper's network": "backproject + paper's U-Net",
    "our network": "backproject + unet",
}
_DENSE = ", dense"
# Perceptually uniform, of matplotlib.
IMAGES = "magma"
# Of the width of an image, at most, for the bar that says how long a length is.
_BAR = 0.3


def label_of(method: str) -> str:
    """What a method is called in a picture; an unknown one as it is."""
    name = method.removesuffix(_DENSE)
    name = _ALSO.get(name, name)
    return _METHODS.get(name, (name,))[0] + method[len(method.removesuffix(_DENSE)) :]


def line_of(method: str) -> dict[str, Any]:
    """Label, colour, marker and line of a method, the same in every picture; dense matrices have dashes."""
    name = method.removesuffix(_DENSE)
    _, colour, marker = _METHODS.get(_ALSO.get(name, name), (name, "black", "."))
    style = ":" if not marker else "--" if method.endswith(_DENSE) else "-"
    return {"label": label_of(method), "color": colour, "marker": marker, "ls": style, "ms": 5}


def draw_image(
    axes: Axes,
    image: Num[np.ndarray, "row column"],
    extent: tuple[float, float, float, float],
    *,
    low: float = 0.0,
    high: float | None = None,
    upward: bool = False,
    cmap: str = IMAGES,
) -> AxesImage:
    """An image without axes, with a bar that says how long, from `low` to `high`, by default its maximum.

    Parameters
    ----------
    axes
        Where.
    image
        Rows downwards.
    extent
        `(left, right, bottom, top)`, mm.
    low, high
        What is darkest and brightest.
    upward
        +y upwards, as some scenes were drawn, not downwards as on the sensor.
    cmap
        Of matplotlib; perceptually uniform.
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
    said = f"{length:g} mm" if length >= 1 else f"{1000 * length:g} um"
    x, part = 0.95 - length / width, length / width
    axes.plot([x, x + part], [0.05, 0.05], color=colour, lw=2.5, solid_capstyle="butt", transform=axes.transAxes)
    # Dark behind, for images that are bright there.
    box = {"facecolor": colormaps[IMAGES](0.0), "alpha": 0.6, "lw": 0, "pad": 1}
    place = {"ha": "center", "va": "bottom", "transform": axes.transAxes, "bbox": box}
    axes.text(x + part / 2, 0.08, said, color=colour, fontsize=8, **place)
