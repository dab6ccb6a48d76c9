"""The point spread function of the lens array under back-projection: its sidelobes and its spectrum.

A point at `q` and depth `z` has one image under each lens, at `s_z c_j - M_z q`, weighted by the envelope: the array's
multi-spot PSF. Back-projection reads a voxel at those places for the voxel itself. Where the spots of a voxel meet the
spots of another point, the voxel also reads that point's light. These sidelobes are the ghosts of a reconstruction: at
other depths through the same lenses, at the same depth through others where sub-images overlap. They follow from the
layout without rendering an image.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.arrays import jit
from ..geometry import Imager
from ..typing import Real

# Added to the power at each frequency, in units of a single lens's: keeps logarithms finite.
_FLOOR = 1e-3


class Sidelobes(NamedTuple):
    """Sidelobes relative to the peak, over points and voxels: a smooth maximum, and the root mean square."""

    peak: Float[Array, ""]
    rms: Float[Array, ""]


@jit
def crosstalk(
    imager: Imager,
    sources: Float[Array | np.ndarray, "source 3"],
    targets: Float[Array | np.ndarray, "target 3"],
    *,
    width: Real,
) -> Float[Array, "source target"]:
    """Light of each source point that back-projection reads at each target, relative to the source's own voxel.

        G = sum_ij C_i(q) C_j(q') exp(-|p_i(q, z) - p_j(q', z')|^2 / (4 width^2))

    divided by the same sum with `q' = q, z' = z`: the overlap of Gaussian spots. It is zero for a source that no lens
    sees. The edges of the sensor are ignored.

    Parameters
    ----------
    imager
        The lens array and the sensor.
    sources, targets
        `(x, y, z)`, mm.
    width
        Standard deviation of a spot on the sensor, mm: that of the PSF, or wider for a smoother objective.
    """
    dtype = imager.sensor_distance.dtype
    sources, targets = jnp.asarray(sources, dtype), jnp.asarray(targets, dtype)
    target_spots, target_weights = _spots(imager, targets)

    def one(source):
        spots, weights = (a[:, 0] for a in _spots(imager, source[None]))

        # One lens at a time: all pairs for all targets do not fit into memory for a full array.
        @jax.checkpoint
        def add(total, of_lens):
            spot, weight = of_lens
            overlap = jnp.sum(target_weights * _overlap(target_spots, spot[None, None], width), axis=0)
            return total + weight * overlap, None

        total = lax.scan(add, jnp.zeros(len(targets), dtype), (spots, weights))[0]
        own = weights @ _overlap(spots[:, None], spots[None], width) @ weights
        seen = own > 0
        return jnp.where(seen, total / jnp.where(seen, own, 1), 0)

    return lax.map(one, sources)


@jit
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
    """Level of the sidelobes: `crosstalk` without its main lobe.

    A target has the weight `1 - exp(-(d / lateral)^2 - (dz / axial)^2)`, which excludes the main lobe.

    Parameters
    ----------
    imager, sources, targets, width
        As for `crosstalk`. Random targets give an estimate for stochastic optimisers.
    lateral, axial
        Size of the main lobe in the object, mm: a few times the resolution.
    power
        Exponent of the power mean that stands for the maximum.
    """
    ghosts = crosstalk(imager, sources, targets, width=width)
    apart = (jnp.asarray(sources)[:, None] - jnp.asarray(targets)[None]).astype(ghosts.dtype)
    near = jnp.sum(apart[..., :2] ** 2, axis=2) / lateral**2 + (apart[..., 2] / axial) ** 2
    counted = ghosts * (1 - jnp.exp(-near))
    # Relative to the largest, whose derivative is stopped: powers of small numbers would underflow.
    largest = lax.stop_gradient(jnp.maximum(counted.max(), jnp.finfo(ghosts.dtype).tiny))
    mean = jnp.mean((counted / largest) ** power)
    return Sidelobes(largest * _root(mean, power), largest * _root(jnp.mean((counted / largest) ** 2), 2))


@jit
def mean_inverse_views(
    imager: Imager, points: Float[Array | np.ndarray, "point 3"], *, floor: Real = 0.5
) -> Float[Array, ""]:
    """Mean over points of `1 / (sum_j C_j + floor)`, the inverse of the number of lenses that see a point.

    The error of back-projection by sidelobes of other points is proportional to it as long as sub-images hardly
    overlap. It is smooth over the distance of lenses and cheap: an objective for a first stage.

    Parameters
    ----------
    imager
        The lens array and the sensor.
    points
        `(x, y, z)` over the object, mm.
    floor
        Keeps the value finite where no lens sees a point, in units of a lens on its axis.
    """
    weights = _spots(imager, jnp.asarray(points, imager.sensor_distance.dtype))[1]
    return jnp.mean(1 / (jnp.sum(weights, axis=0) + floor))


@jit
def array_spectrum(
    imager: Imager, points: Float[Array | np.ndarray, "point 3"], frequencies: Float[Array | np.ndarray, "frequency 2"]
) -> Float[Array, "point frequency"]:
    """Power spectrum of the array PSF of each point: `|sum_j C_j exp(-2 pi i k.(s_z c_j))|^2 / sum_j C_j^2`.

    It is the structure factor of the lenses that see the point: 1 on average for random lenses, and the number of
    lenses at `k = 0`. It is zero for a point that no lens sees.

    Parameters
    ----------
    imager
        The lens array and the sensor.
    points
        `(x, y, z)`, mm.
    frequencies
        On the sensor, `(x, y)`, cycles per mm.
    """
    dtype = imager.sensor_distance.dtype
    points, frequencies = jnp.asarray(points, dtype), jnp.asarray(frequencies, dtype)

    def one(point):
        spots, weights = (a[:, 0] for a in _spots(imager, point[None]))
        phase = 2 * math.pi * (frequencies @ spots.T)
        energy = jnp.sum(weights**2)
        seen = energy > 0
        power = (jnp.cos(phase) @ weights) ** 2 + (jnp.sin(phase) @ weights) ** 2
        return jnp.where(seen, power / jnp.where(seen, energy, 1), 0)

    return lax.map(one, points)


def spectral_flatness(spectrum: Float[Array, "point frequency"], *, floor: Real = _FLOOR) -> Float[Array, ""]:
    """Geometric over arithmetic mean of a power spectrum, averaged over points; 1 for a white one.

    `spectrum`: of `array_spectrum`, without the lowest frequencies, which every layout has: above
    `1 / (s_z field_radius)`. `floor`: added to the power, so that a missing frequency counts as this.
    """
    power = spectrum + floor
    return jnp.mean(jnp.exp(jnp.mean(jnp.log(power), axis=1)) / jnp.mean(power, axis=1))


def condition_number(
    spectrum: Float[Array, "point frequency"], *, floor: Real = _FLOOR, power: Real = 16.0
) -> Float[Array, ""]:
    """Largest over smallest power of a spectrum (with `floor` added), averaged over points, by power means.

    `(mean S^p)^(1/p) (mean S^-p)^(1/p)` is smooth, and below the ratio itself by at most the factor
    `frequencies^(2/p)`. Parameters are those of `spectral_flatness`.
    """
    log = jnp.log(spectrum + floor)
    count = math.log(spectrum.shape[1])
    mean = lambda sign: (jax.nn.logsumexp(sign * power * log, axis=1) - count) / power
    return jnp.mean(jnp.exp(mean(1) + mean(-1)))


def _spots(imager: Imager, points: Array) -> tuple[Array, Array]:
    """Spots `(lens, point, 2)` of points, mm, and the envelope `(lens, point)` at each."""
    views = imager.views_of_all(points)
    return views.spot, imager.brightness(views)


def _overlap(spots, others, width):
    return jnp.exp(-jnp.sum((spots - others) ** 2, axis=-1) / (4 * width**2))


def _root(x, power):
    """`x^(1/power)`, with the derivative 0 at 0."""
    some = x > 0
    return jnp.where(some, jnp.where(some, x, 1) ** (1 / power), 0)
