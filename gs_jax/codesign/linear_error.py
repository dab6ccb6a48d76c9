"""How well volumes can be estimated from a capture: defocus, aberrations, light, noise and parallax in one number.

Scenes are planes of random objects with edges, stationary, independent of each other. Of such a scene, image and noise
only second moments count for the best linear estimate (Wiener's), and each frequency `v` of the sensor counts for
itself. Lens `j` sees plane `k` there through

    A_jk = sqrt(w_jk) H_k(v) L_k M_k exp(2 pi i v . r_j M_k)

with the envelope `w`, the transfer function `H`, a lit plane's light `L` on the sensor, the magnification `M` and the
lens's place `r_j` beside the object. For planes of the spectrum `S_k` and noise of the density `n` what is not found
of plane `k` is the diagonal of

    (1 + S^(1/2) A* A S^(1/2) / n)^-1

(Kailath, Sayed and Hassibi, Linear Estimation, 2000, Theorem 3.2.1). Nothing is drawn at random.

Left out: sub-images are taken as apart from each other (their light counts as noise where they overlap, what they show
does not), a lens's transfer function is its mean over the field, and frequencies above the pixels' count as others do,
since lenses see an object with different parts of a pixel. Where a scene is sparse, a solver that knows that light is
positive does better than any linear one. The paper has no such measure.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager, envelope
from ..objectives.conditions import Conditions, field_radius
from ..objectives.paraxial import occupancy
from .transfer import PLACE, directions, lit_density, transfer_power

# Of a scene: lit part of a plane, and the distance over which its correlation falls to 1/e, mm.
FILL, LENGTH = 0.03, 0.05
# Electrons of read noise.
READ_NOISE = 2.0
# Frequencies, up to that of voxels as wide as `PLACE`.
_NODES = 16


def lost_power(parts: Sequence[tuple[Imager, Conditions]], places: Float[Array, "place 2"]) -> Float[Array, " depth"]:
    """Mean squared error of the best linear estimate over the scene's variance, at each depth: 0 to 1.

    Parameters
    ----------
    parts
        The lenses of each type and their conditions, as of `gs_jax.objectives.conditions.per_type`. The depths are the
        scene's planes.
    places
        `(x, y)` of objects, mm: the lenses around each, where they are, give the parallax. They are averaged over.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    imager, at = parts[0]
    dtype, finest = at.depths.dtype, 1 / (2 * PLACE)
    # In the object, 1/mm; over a plane's area. On the sensor they are those of a mean magnification.
    object_frequency = jnp.asarray(finest * (nodes + 1) / 2, dtype)
    ring = jnp.asarray(weights, dtype) * object_frequency
    frequency = object_frequency / jnp.mean(imager.magnification(at.depths))
    spectrum = _spectrum(imager.magnification(at.depths)[:, None] * frequency[None])
    amplitudes = [_amplitude(*part, parts, frequency, spectrum) for part in parts]
    ways, planes = directions(dtype), jnp.eye(at.depths.size, dtype=dtype)

    def at_place(place):
        views = [_view(*part, place, ways) for part in parts]

        def at_frequency(frequency, amplitudes):
            real, imaginary = planes[None], 0.0
            for (weight, turns), amplitude in zip(views, amplitudes, strict=True):
                cos, sin = (weight[None] * wave(frequency * turns) for wave in (jnp.cos, jnp.sin))
                same = jnp.einsum("wlj,wlk->wjk", cos, cos) + jnp.einsum("wlj,wlk->wjk", sin, sin)
                other = jnp.einsum("wlj,wlk->wjk", cos, sin)
                both = amplitude[None, :, None] * amplitude[None, None]
                real = real + both * same
                imaginary = imaginary + both * (other - jnp.swapaxes(other, 1, 2))
            # A complex matrix as a real one of twice the size.
            known = jnp.block([[real, -imaginary], [imaginary, real]])
            left = jnp.diagonal(jnp.linalg.inv(known), axis1=1, axis2=2)
            return jnp.mean(left[:, : len(planes)], 0)

        return jax.vmap(at_frequency, (0, 1), 1)(frequency, amplitudes)

    left = jnp.mean(jax.lax.map(at_place, places), 0)
    share = ring[None] * spectrum
    return jnp.sum(left * share, 1) / jnp.sum(share, 1)


def _amplitude(imager, at, parts, frequency, spectrum) -> Float[Array, "depth frequency"]:
    """What a lens passes on of each plane, over the noise."""
    amplitude = lit_density(imager, at) * imager.magnification(at.depths) / jnp.sqrt(noise_density(imager, at, parts))
    return amplitude[:, None] * safe_sqrt(transfer_power(imager, at, frequency) * spectrum)


def _view(imager, at, place, ways):
    """Weights of the lenses `(lens, depth)`, and the turns of their images over frequency `(way, lens, depth)`."""
    beside = imager.array.centers - place[None]
    squared = jnp.sum(beside**2, 1)[:, None]
    weight = safe_sqrt(envelope(squared, imager.reduced_depth(at.depths)[None], field_radius(imager, at)))
    return weight, 2 * jnp.pi * (beside @ ways).T[:, :, None] * imager.magnification(at.depths)[None, None]


def noise_density(imager: Imager, at: Conditions, parts: Sequence[tuple[Imager, Conditions]]) -> Float[Array, ""]:
    """Electrons^2 per mm^2 of a sub-image: shot noise of all planes and of the sub-images over it, and read noise.

    `imager` has the type of lens whose sub-image it is, `parts` are all types: each as bright as its aperture is large.
    """
    over = sum(occupancy(*part) * lit_density(*part) for part in parts)
    shot = FILL * jnp.sum(lit_density(imager, at) + over)
    return shot + (READ_NOISE / imager.sensor.pixel_pitch) ** 2


def _spectrum(frequency):
    """Of random objects with edges: correlations that fall exponentially (Debye), in two dimensions, mm^2."""
    return FILL * (1 - FILL) * 2 * jnp.pi * LENGTH**2 / (1 + (2 * jnp.pi * LENGTH * frequency) ** 2) ** 1.5
