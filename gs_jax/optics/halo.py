"""All of a spot's light that is not its core, out to where light ends: tables in polar coordinates about the lens.

A round lens turns with the point that it images: at a field `(rho, phi)` its spot is the one at `(rho, 0)`, turned by
`phi`. So in polar coordinates about the lens's axis, on both sides, the image is a convolution over the angle: each
angular harmonic of the object becomes the same harmonic of the image by a small matrix over the radii, without a limit
on the rank. A lens's own clear area counts to first order.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int, Num

from ..geometry import Imager
from .cores import RINGS, Cores, diffracted, ring_edges, ring_light, spread
from .light import Zones, spot_rays

# Widest field, in reduced depths of the nearest plane: beyond, a lens passes on a third of its light and less.
_WIDEST = 0.9
# Radii of the object's nodes grow linearly up to about this part of the widest field, then exponentially.
_LINEAR = 0.45
# Nodes in the linear part. The nodes' distance at the sensor is the halo's pixel.
_NODES = 44
# How far beyond the widest field's chief ray light is followed on the sensor, in the image of the widest field.
_BEYOND = 0.35
# How steeply angular harmonics end where waves of two pixels do.
_STEEP = 8
# Of each field; samples of a core.
_RAYS, _CORE_SAMPLES = 16384, 2048


class HaloGrid(NamedTuple):
    """Polar nodes about a lens's axis, on the object's side and on the sensor's.

    `step`: distance of the inner nodes in the object, mm; `pixel`: of those on the sensor. `bend`: radius at which
    they begin to spread, in steps. `angles`, `fields`, `radii`: numbers of nodes, around and outward on either side.
    """

    step: float
    pixel: float
    bend: float
    angles: int
    fields: int
    radii: int

    def nodes(self, count: int) -> Float64[np.ndarray, " node"]:
        """Radii of the nodes, in steps: as far apart as they are around, where they spread."""
        return self.bend * np.sinh(np.arange(count) / self.bend)

    def areas(self, count: int) -> Float64[np.ndarray, " node"]:
        """Area of a node's cell, in squared steps."""
        edges = self.bend * np.sinh((np.arange(count + 1) - 0.5) / self.bend)
        edges[0] = 0
        return np.pi * np.diff(edges**2) / self.angles


def halo_grid(imager: Imager, depths: Float64[np.ndarray, " depth"], most: float) -> HaloGrid:
    """Nodes for a range of depths.

    Parameters
    ----------
    imager
        Its sensor and magnification decide.
    depths
        Of the object, mm.
    most
        The largest field that occurs, mm: no point is farther from a lens.
    """
    near = float(imager.reduced_depth(float(depths.min())))
    widest = min(_WIDEST * near, most)
    middle = float(imager.magnification(float(depths.min() + depths.max()) / 2))
    linear = _LINEAR * _WIDEST * near
    # A whole number of pixels.
    pixels = max(round(middle * linear / _NODES / imager.sensor.pixel_pitch), 1)
    pixel = pixels * imager.sensor.pixel_pitch
    step = pixel / middle
    bend = linear / step
    count = lambda reach: math.ceil(bend * math.asinh(reach / bend)) + 2
    largest = float(imager.magnification(float(depths.min()))) / middle
    radii = count((1 + _BEYOND) * largest * widest / step)
    return HaloGrid(step, pixel, bend, 4 * round(2 * math.pi * bend / 4), count(widest / step), radii)


def halo_table(
    imager: Imager, depth: float, aperture: Zones, grid: HaloGrid, cores: Cores, ends: Sequence[float] = RINGS
) -> Float32[np.ndarray, "kind harmonic radius field"]:
    """From each object harmonic over the fields to the image's over the radii, at one depth.

    The first kind is that of a mean lens, less its cores; the second is what it changes by with the clear area, 1/mm^2.
    An object in the direction `phi` is imaged in the opposite one, from which the image's angle counts.
    """
    fields = grid.step * grid.nodes(grid.fields)
    rays = diffracted(imager, spot_rays(imager, depth, fields, aperture, _RAYS))
    chief = float(imager.magnification(float(depth)))
    table = np.zeros((2, grid.fields, grid.radii * grid.angles))
    share = lambda landing, light: np.stack([_shared(grid, *one) for one in zip(landing, light, strict=True)])
    table[0] = share(rays.landing, rays.light)
    if aperture.by_area.any():
        table[1] = share(rays.landing, rays.light_by_area)
    for (inner, outer), stretch, light, profile in zip(ring_edges(imager, ends), *cores, strict=True):
        # The share of a core's light that a lens has at each field.
        amount = np.asarray(ring_light(fields**2, light, inner, outer), np.float64)
        core = imager.sensor.pixel_pitch * spread(profile, _CORE_SAMPLES)
        for field in np.flatnonzero(amount):
            landing = core - [chief * stretch * fields[field], 0]
            table[0, field] -= _shared(grid, landing, np.full(len(core), amount[field] / len(core)))
    around = table.reshape(2, grid.fields, grid.radii, grid.angles)
    # Spots are symmetric about the field's direction: their spectra are real.
    spectra = np.fft.rfft(around).real * _resolved(grid)
    return spectra.transpose(0, 3, 2, 1).astype(np.float32)


def _resolved(grid: HaloGrid) -> Float64[np.ndarray, "radius harmonic"]:
    """Near the axis nodes are closer together than pixels, which would sample what they cannot resolve."""
    finest = np.pi * np.maximum(grid.nodes(grid.radii), 0.5)
    return 1 / (1 + (np.arange(grid.angles // 2 + 1) / finest[:, None]) ** _STEEP)


def polar_shares(
    grid: HaloGrid, count: int, x: Num[np.ndarray, " place"], y: Num[np.ndarray, " place"]
) -> tuple[Int[np.ndarray, " entry"], Int[np.ndarray, " entry"], Float64[np.ndarray, " entry"]]:
    """How the four nodes around each place share it, bilinearly in the nodes' numbers: (place, node, share).

    Places are in steps; of those beyond the nodes, `count` outward, there are no entries.
    """
    outward = grid.bend * np.arcsinh(np.hypot(x, y) / grid.bend)
    place = np.flatnonzero(outward < count - 1)
    outward = outward[place]
    turned = np.arctan2(y, x)[place] * (grid.angles / (2 * np.pi)) % grid.angles
    radius, around = outward.astype(int), turned.astype(int)
    parts = []
    for step, turn in np.ndindex(2, 2):
        node = (radius + step) * grid.angles + (around + turn) % grid.angles
        share = np.abs(1 - step - (outward - radius)) * np.abs(1 - turn - (turned - around))
        parts.append((place, node, share))
    place, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    return place, node, share


def _shared(grid, landing, light):
    """Light of rays on the polar nodes, `(radius angle)`."""
    x, y = -landing.T / grid.pixel
    ray, node, share = polar_shares(grid, grid.radii, x, y)
    return np.bincount(node, light[ray] * share, grid.radii * grid.angles)
