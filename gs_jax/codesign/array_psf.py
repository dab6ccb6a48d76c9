"""Ghosts and missing frequencies of a layout, without images: terms for co-design.

At depth `z` a point at `q` is seen as the comb of its images, `s_z c_j - M_z q`, cut out by the envelope. Back-
projection reads a voxel `q'` at `z'` through the comb of that voxel. Where teeth of the two combs meet, the voxel reads
the point's light: on every tooth for the voxel itself, on few elsewhere. Those few are the ghosts, or sidelobes: at
other depths through the same lenses (the streaks), at the same depth through others where sub-images overlap.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry import Imager
from ..typing import Real

# Least power that a frequency counts with, as a fraction of one lens's: keeps logarithms finite.
_FLOOR = 1e-3


class Sidelobes(NamedTuple):
    """Ghosts relative to a point's own voxel: a smooth maximum, and the root mean square. Over points and voxels."""

    peak: Float[Array, ""]
    rms: Float[Array, ""]


@jax.jit
def readback(
    imager: Imager,
    sources: Float[Array | np.ndarray, "source 3"],
    targets: Float[Array | np.ndarray, "target 3"],
    *,
    width: Real,
) -> Float[Array, "source target"]:
    """What each target voxel reads of each source point's light, over what the source's own voxel reads.

        G = sum_ij C_i(q) C_j(q') exp(-|p_i(q, z) - p_j(q', z')|^2 / (4 width^2))

    divided by the same with `q' = q, z' = z`: two Gaussian teeth of that standard deviation, multiplied. Zero for a
    source that no lens sees. The sensor has no edge here.

    Parameters
    ----------
    imager
        What sees the points.
    sources, targets
        `(x, y, z)`, mm.
    width
        Standard deviation of a tooth on the sensor, mm: of the PSF, or wider for a smoother objective.
    """
    dtype = imager.sensor_distance.dtype
    sources, targets = jnp.asarray(sources, dtype), jnp.asarray(targets, dtype)
    target_teeth, target_weights = _teeth(imager, targets)

    def one(source):
        teeth, weights = (a[:, 0] for a in _teeth(imager, source[None]))

        # Lens by lens: all pairs for all targets would not fit for a full array.
        @jax.checkpoint
        def add(total, tooth):
            place, weight = tooth
            return total + weight * jnp.sum(
                target_weights * _meet(target_teeth, place[None, None], width), axis=0
            ), None

        total = lax.scan(add, jnp.zeros(len(targets), dtype), (teeth, weights))[0]
        meet = _meet(teeth[:, None], teeth[None], width)
        own = weights @ meet @ weights
        seen = own > 0
        return jnp.where(seen, total / jnp.where(seen, own, 1), 0)

    return lax.map(one, sources)


@jax.jit
def sidelobes(
    imager: Imager,
    sources: Float[Array | np.ndarray, "source 3"],
    targets: Float[Array | np.ndarray, "target 3"],
    *,
    width: Real,
    lateral: Real,
    axial: Real,
    power: Real = 16.0,
) -> Sidelobes:
    """How strong the ghosts are: `readback` without the point's own image.

    A target counts by `1 - exp(-(d / lateral)^2 - (dz / axial)^2)`: not where it lies in the point's own image.

    Parameters
    ----------
    imager, sources, targets, width
        As for `readback`. Targets at random places make an estimate for stochastic optimisers.
    lateral, axial
        Size of a point's own image in the object, mm: some times the resolution.
    power
        The smooth maximum is the mean of this power, to the one over it: between the mean and the maximum.
    """
    ghosts = readback(imager, sources, targets, width=width)
    apart = (jnp.asarray(sources)[:, None] - jnp.asarray(targets)[None]).astype(ghosts.dtype)
    near = jnp.sum(apart[..., :2] ** 2, axis=2) / lateral**2 + (apart[..., 2] / axial) ** 2
    counted = ghosts * (1 - jnp.exp(-near))
    # Relative to the largest, which has no derivative here: powers of small numbers would vanish.
    largest = lax.stop_gradient(jnp.maximum(counted.max(), jnp.finfo(ghosts.dtype).tiny))
    mean = jnp.mean((counted / largest) ** power)
    return Sidelobes(largest * _root(mean, power), largest * _root(jnp.mean((counted / largest) ** 2), 2))


@jax.jit
def lens_shortage(
    imager: Imager, points: Float[Array | np.ndarray, "point 3"], *, floor: Real = 0.5
) -> Float[Array, ""]:
    """Mean over points of `1 / (sum_j C_j + floor)`: how much a voxel lacks lenses.

    Of a reconstruction by back-projection, the error by ghosts from elsewhere goes as one over the number of lenses,
    as long as sub-images hardly overlap. Smooth over the distance of lenses, and cheap: a first stage.

    Parameters
    ----------
    imager
        What sees the points.
    points
        `(x, y, z)` over the object, mm.
    floor
        Keeps it finite where no lens sees a point, in lenses on their axes.
    """
    weights = _teeth(imager, jnp.asarray(points, imager.sensor_distance.dtype))[1]
    return jnp.mean(1 / (jnp.sum(weights, axis=0) + floor))


@jax.jit
def comb_spectrum(
    imager: Imager,
    points: Float[Array | np.ndarray, "point 3"],
    frequencies: Float[Array | np.ndarray, "frequency 2"],
) -> Float[Array, "point frequency"]:
    """Power spectrum of the comb of each point: `|sum_j C_j exp(-2 pi i k.(s_z c_j))|^2 / sum_j C_j^2`.

    1 is what random lenses have on average; the number of lenses, for `k = 0`. It is the structure factor of the
    lenses that see the point. Zero for a point that no lens sees.

    Parameters
    ----------
    imager
        What sees the points.
    points
        `(x, y, z)`, mm.
    frequencies
        On the sensor, `(x, y)`, cycles per mm.
    """
    dtype = imager.sensor_distance.dtype
    points, frequencies = jnp.asarray(points, dtype), jnp.asarray(frequencies, dtype)

    def one(point):
        teeth, weights = (a[:, 0] for a in _teeth(imager, point[None]))
        phase = 2 * math.pi * (frequencies @ teeth.T)
        energy = jnp.sum(weights**2)
        seen = energy > 0
        power = (jnp.cos(phase) @ weights) ** 2 + (jnp.sin(phase) @ weights) ** 2
        return jnp.where(seen, power / jnp.where(seen, energy, 1), 0)

    return lax.map(one, points)


def spectral_flatness(spectrum: Float[Array, "point frequency"], *, floor: Real = _FLOOR) -> Float[Array, ""]:
    """Geometric over arithmetic mean of a power spectrum, averaged over points; 1 for a white one.

    Parameters
    ----------
    spectrum
        Of `comb_spectrum`, at frequencies without the lowest, which every comb has: above `1 / (s_z field_radius)`.
    floor
        Added to the power: a frequency that is missing counts as this.
    """
    power = spectrum + floor
    return jnp.mean(jnp.exp(jnp.mean(jnp.log(power), axis=1)) / jnp.mean(power, axis=1))


def condition_number(
    spectrum: Float[Array, "point frequency"], *, floor: Real = _FLOOR, power: Real = 16.0
) -> Float[Array, ""]:
    """Largest over smallest power of a spectrum (with `floor` added), averaged over points, by power means.

    `(mean S^p)^(1/p) (mean S^-p)^(1/p)`: smooth, and below the ratio itself by at most the number of frequencies to
    the `2/p`. Parameters as for `spectral_flatness`.
    """
    log = jnp.log(spectrum + floor)
    count = math.log(spectrum.shape[1])
    mean = lambda sign: (jax.nn.logsumexp(sign * power * log, axis=1) - count) / power
    return jnp.mean(jnp.exp(mean(1) + mean(-1)))


def _teeth(imager: Imager, points: Array) -> tuple[Array, Array]:
    """Images `(lens, point, 2)` of points, mm, and the envelope `(lens, point)` at each."""
    views = imager.views_of_all(points)
    return views.spot, imager.brightness(views)


def _meet(teeth, place, width):
    return jnp.exp(-jnp.sum((teeth - place) ** 2, axis=-1) / (4 * width**2))


def _root(x, power):
    """`x^(1/power)`, with the derivative 0 at 0."""
    some = x > 0
    return jnp.where(some, jnp.where(some, x, 1) ** (1 / power), 0)
