"""Error of the best linear estimate of volumes: defocus, aberrations, light, noise and parallax in one number.

Scenes are planes of random objects with edges, stationary and independent of each other. The best linear estimate
(Wiener's) depends on second moments of scene, image and noise only, and treats each frequency `v` of the sensor by
itself. Lens `j` images plane `k` with

    A_jk = sqrt(w_jk) H_k(v) L_k M_k exp(2 pi i v . r_j M_k)

for the envelope `w`, the transfer function `H`, the light `L` of a lit plane on the sensor, the magnification `M` and
the lens's position `r_j` beside the object. For planes with the spectrum `S_k` and noise of the density `n` the
relative error of plane `k` is the diagonal of

    (1 + S^(1/2) A* A S^(1/2) / n)^-1

(Kailath, Sayed and Hassibi, Linear Estimation, 2000, Theorem 3.2.1). No random numbers are drawn.

Approximations: sub-images do not overlap (their light counts as noise where they do), the transfer function is its mean
over a lens's field, and frequencies above Nyquist count as others do, since lenses sample an object with different
parts of a pixel. For sparse scenes, solvers with a positivity constraint do better than any linear estimate. The paper
has no such measure.

An exposure is a time and a brightness, the same for all candidates: the electrons that each mm^2 of clear aperture at a
distance of 20 mm in air collects from an emitter of 40 um x 40 um. So a smaller aperture pays for its sharpness with
light, and a magnification for its detail.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..microscope.geometry import Imager, envelope
from ..objectives.conditions import (
    Conditions,
    by_type,
    clear_diameter,
    field_heights,
    field_radius,
    finite_plate,
    of_lenses,
)
from ..objectives.quantities import occupancy
from ..optics import theory
from ..optics.pupil import pupil_quadrature
from ..optics.raytrace import trace_lenslet

# Lit fraction of a plane of the scene, and the distance over which its correlation falls to 1/e, mm.
_FILL, _LENGTH = 0.03, 0.05
# Read noise, electrons.
_READ_NOISE = 2.0
# Nodes of the quadrature over frequencies, up to Nyquist of voxels of 40 um.
_NODES = 16
# Positions along a side of the part of the plate whose points see a whole field of lenses.
_POSITIONS = 2


def volume_error(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """Relative error of volumes by the best linear estimate: the root of the mean of `lost_power` over the depths."""
    return jnp.sqrt(jnp.mean(lost_power(imager, at, _positions(imager))))


def _positions(imager: Imager) -> Float[Array, "position 2"]:
    """Four points that stand for the plate, mm: a field radius from its edge, if it is large."""
    plate = finite_plate(imager)
    inner = jnp.maximum(plate - 2 * imager.field_radius, plate / 4)
    side = jnp.asarray((np.arange(_POSITIONS) + 0.5) / _POSITIONS - 0.5, inner.dtype)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * inner[None]


def lost_power(imager: Imager, at: Conditions, positions: Float[Array, "position 2"]) -> Float[Array, " depth"]:
    """Mean squared error of the best linear estimate over the scene's variance, at each depth: 0 to 1.

    Parameters
    ----------
    imager, at
        Lenses of any number of types, and conditions whose depths are the scene's planes.
    positions
        `(x, y)` of objects, mm; the result is the mean over them. The lenses around each give its parallax.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, finest = at.depths.dtype, 1 / (2 * _EMITTER_SIDE)
    # Frequencies in the object, 1/mm; on the sensor they are those of the mean magnification.
    object_frequency = jnp.asarray(finest * (nodes + 1) / 2, dtype)
    ring = jnp.asarray(weights, dtype) * object_frequency
    frequency = object_frequency / jnp.mean(imager.magnification(at.depths))
    spectrum = _spectrum(imager.magnification(at.depths)[:, None] * frequency[None])
    amplitude = _amplitude(imager, at, frequency, spectrum)
    ways, planes = directions(dtype), jnp.eye(at.depths.size, dtype=dtype)

    def at_position(position):
        weight, turns = _view(imager, at, position, ways)

        def at_frequency(frequency, amplitude):
            cos, sin = ((amplitude * weight)[None] * wave(frequency * turns) for wave in (jnp.cos, jnp.sin))
            same = jnp.einsum("wlj,wlk->wjk", cos, cos) + jnp.einsum("wlj,wlk->wjk", sin, sin)
            other = jnp.einsum("wlj,wlk->wjk", cos, sin)
            real, imaginary = planes[None] + same, other - jnp.swapaxes(other, 1, 2)
            # A complex matrix as a real one of twice the size.
            normal = jnp.block([[real, -imaginary], [imaginary, real]])
            left = jnp.diagonal(jnp.linalg.inv(normal), axis1=1, axis2=2)
            return jnp.mean(left[:, : len(planes)], 0)

        return jax.vmap(at_frequency, (0, 2), 1)(frequency, amplitude)

    left = jnp.mean(jax.lax.map(at_position, positions), 0)
    share = ring[None] * spectrum
    return jnp.sum(left * share, 1) / jnp.sum(share, 1)


def _amplitude(imager, at, frequency, spectrum) -> Float[Array, "lens depth frequency"]:
    """Amplitude with which each lens images each plane, relative to the noise."""
    noise = jnp.sqrt(noise_density(imager, at))
    amplitude = of_lenses(imager, lit_density(imager, at)) * imager.magnification(at.depths)[None] / noise[:, None]
    power = of_lenses(imager, transfer_power(imager, at, frequency))
    return amplitude[..., None] * safe_sqrt(power * spectrum[None])


def _view(imager, at, position, ways):
    """Weights of the lenses `(lens, depth)`, and their images' phase over frequency `(direction, lens, depth)`."""
    points = jnp.concatenate([jnp.tile(position, (at.depths.size, 1)), at.depths[:, None]], 1)
    views = imager.views_of_all(points)
    weight = safe_sqrt(envelope(jnp.sum(views.offset**2, -1), views.reduced_depth, field_radius(imager, at)))
    return weight, 2 * jnp.pi * jnp.moveaxis((views.spot - imager.centers[:, None]) @ ways, -1, 0)


def noise_density(imager: Imager, at: Conditions) -> Float[Array, " lens"]:
    """Noise density of each lens's sub-image, electrons^2 per mm^2.

    It is the shot noise of the planes and of the sub-images that overlap, whose light follows from the apertures, and
    the read noise.
    """
    own = of_lenses(imager, lit_density(imager, at))
    over = occupancy(imager, at) * jnp.mean(own, 0)
    return _FILL * jnp.sum(own + over[None], 1) + (_READ_NOISE / imager.sensor.pixel_pitch) ** 2


def _spectrum(frequency):
    """Power spectrum of random objects with edges, whose correlation falls exponentially (Debye), mm^2."""
    return _FILL * (1 - _FILL) * 2 * jnp.pi * _LENGTH**2 / (1 + (2 * jnp.pi * _LENGTH * frequency) ** 2) ** 1.5


# Distance and side of the emitter that an exposure is defined by, mm.
_EMITTER_DISTANCE, _EMITTER_SIDE = 20.0, 0.04
# Rings of rays: enough for spots twenty periods wide.
_RINGS = 16
# Directions of frequencies over half a turn.
_DIRECTIONS = 4


def directions(dtype) -> Float[Array, "2 direction"]:
    """Unit vectors evenly over half a turn; the other half is equivalent."""
    angle = jnp.asarray((np.arange(_DIRECTIONS) + 0.5) * np.pi / _DIRECTIONS, dtype)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@by_type
def transfer_power(
    imager: Imager, at: Conditions, frequencies: Float[Array, " frequency"]
) -> Float[Array, "depth frequency"]:
    """Squared modulus of the transfer function, averaged over a lens's field and over directions.

    It is the Fourier transform of exact rays through the clear aperture, with defocus and all aberrations, times the
    transfer functions of a perfect lens and of a pixel. The product is exact for spots much wider than the Airy disc
    and for those without aberrations; between these limits it is a little low.

    Parameters
    ----------
    imager, at
        Lenses, and the depths.
    frequencies
        On the sensor, 1/mm.
    """
    points, weights = pupil_quadrature(clear_diameter(imager, at) / 2, _RINGS)
    heights, ways = field_heights(imager, at), directions(at.depths.dtype)

    def power(depth, height):
        rays = trace_lenslet(imager, depth, points, (height, jnp.zeros_like(height)))
        lit = jnp.where(rays.valid, weights, 0)
        # Rays with total reflection at the rim are missing. Phases are relative to the centroid.
        middle = jnp.sum(lit[:, None] * rays.landing, 0) / jnp.maximum(jnp.sum(lit), 1e-6)
        phase = 2 * jnp.pi * frequencies[:, None, None] * ((rays.landing - middle[None]) @ ways)[None]
        real, imaginary = (jnp.einsum("r,frw->fw", lit, wave(phase)) for wave in (jnp.cos, jnp.sin))
        return jnp.mean(real**2 + imaginary**2, 1)

    powers = jax.lax.map(lambda depth: jax.vmap(power, (None, 0))(depth, heights), at.depths)
    weight = envelope(heights[None] ** 2, imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    mean = jnp.einsum("dh,dhf->df", weight / jnp.sum(weight, 1, keepdims=True), powers)
    cutoff = theory.cutoff_frequency(imager.wavelength, imager.reduced_sensor_distance, clear_diameter(imager, at))
    others = theory.ideal_mtf(frequencies, cutoff) * jnp.sinc(frequencies * imager.sensor.pixel_pitch)
    return mean * (others**2)[None]


@by_type
def lens_electrons(imager: Imager, at: Conditions) -> Float[Array, " depth"]:
    """Electrons that a lens on its axis collects from an emitter of 40 um x 40 um."""
    area = jnp.pi / 4 * clear_diameter(imager, at) ** 2
    # In a medium the lens takes a smaller solid angle.
    return at.exposure.astype(area.dtype) * area * (_EMITTER_DISTANCE / imager.depth_in_medium(at.depths)) ** 2


@by_type
def lit_density(imager: Imager, at: Conditions) -> Float[Array, " depth"]:
    """Electrons per mm^2 of the sensor in the image of a lit plane."""
    return lens_electrons(imager, at) / (_EMITTER_SIDE * imager.magnification(at.depths)) ** 2
