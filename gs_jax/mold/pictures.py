"""A picture of an array or its mold: the height of the lenses as they are seen, and the part in perspective."""

import math

import manifold3d as m3
import numpy as np
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..lenses import MicrolensArray
from .caps import caps_of, surface
from .solids import MoldShape, array_solid, coarsest_chord, mold_solid

# Facets that a perspective view draws: more cannot be told apart.
_FACETS = 20_000
_PIXELS = 700


def preview(array: MicrolensArray, shape: MoldShape | None, name: str) -> Figure:
    """The picture.

    Parameters
    ----------
    array
        Lenses on a plate of finite size.
    shape
        Of the mold, or None to show the array itself.
    name
        Of the design.
    """
    figure = Figure(figsize=(12, 5.6), dpi=110, layout="constrained")
    heights = figure.add_subplot(1, 2, 1)
    _draw_heights(figure, heights, array, "array" if shape is None else "cavity of the mold, before shrinkage")
    view = figure.add_subplot(1, 2, 2, projection="3d")
    draw_solid(view, coarse_solid(array, shape), from_below=shape is None)
    figure.suptitle(f"{_printable(name)}: {'array' if shape is None else 'negative mold'}, {len(array.centers)} lenses")
    return figure


def _draw_heights(figure, axes, array, what):
    x, y = (np.linspace(-side / 2, side / 2, _PIXELS) for side in array.size)
    caps = caps_of(array)
    height = surface(caps, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))[0].reshape(_PIXELS, _PIXELS)
    shaded = LightSource(azdeg=315, altdeg=50).hillshade(height, dx=x[1] - x[0], dy=y[1] - y[0])
    # A part that has been turned over is drawn as it lies, with the design's y.
    from_sensor = array.orientation == "plano"
    bottom = array.size[1] / 2 if from_sensor else -array.size[1] / 2
    extent = (-array.size[0] / 2, array.size[0] / 2, bottom, -bottom)
    image = axes.imshow(1000 * height, cmap="viridis", extent=extent, vmin=0)
    axes.imshow(shaded, cmap="gray", extent=extent, alpha=0.45)
    seen = "the sensor" if from_sensor else "the object"
    axes.set(title=f"{what}, seen from {seen}", xlabel="x, mm", ylabel="y, mm")
    figure.colorbar(image, ax=axes, label="height over the plate, um", shrink=0.85)


def coarse_solid(array: MicrolensArray, shape: MoldShape | None) -> m3.Manifold:
    """The mold of a shape, or the array, in no more facets than a picture shows."""
    caps = caps_of(array)
    # Equilateral facets of a sphere: a depth of `side^2 / (6 R)` below it.
    chord = math.prod(array.size) / (_FACETS * 1.5 * math.sqrt(3) * min(cap.radius for cap in caps))
    part = array_solid(array, min(chord, coarsest_chord(caps)))
    return part if shape is None else mold_solid(array, part, shape)


def draw_solid(axes, solid: m3.Manifold, *, from_below: bool) -> None:
    """Draws a solid on axes of `projection="3d"`, to scale, seen from above or below."""
    # The painter's algorithm wants facets of like size.
    box = np.reshape(solid.bounding_box(), (2, 3))
    mesh = solid.refine_to_length(float(np.ptp(box, axis=0).max()) / 30).to_mesh64()
    corners = mesh.vert_properties[:, :3][mesh.tri_verts.astype(int)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    # From the upper left of the picture, where eyes expect it: else cavities look like bumps.
    toward = np.array([0.0, -0.94, -0.33] if from_below else [-0.58, 0.0, 0.81])
    light = 0.25 + 0.75 * np.clip(normal @ toward, 0, 1)
    color = np.column_stack([light[:, None] * np.array([[0.78, 0.86, 0.95]]), np.ones(len(light))])
    axes.add_collection3d(Poly3DCollection(corners, facecolors=color, edgecolors=color, linewidths=0.3))
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.set_zticks([low[2], high[2]], [f"{low[2]:.3g}", f"z = {high[2]:.3g} mm"])
    axes.set_box_aspect(high - low, zoom=1.0)
    axes.tick_params(axis="z", pad=14)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.view_init(elev=-40 if from_below else 40, azim=-60)
    axes.set_title("from below: lenses look toward -z" if from_below else "open toward +z, as it is printed")


def _printable(name: str) -> str:
    return "".join(c for c in name if " " <= c <= "~").replace("$", r"\$")
