"""Wavefront errors of one plano-convex lenslet: by exact rays, and third-order (Seidel) with the Strehl ratio of Eq. 9.

The paper's third-order analysis is in a supplement that we do not have. Ours takes a thin lens in air with the stop at
the lens. With curvature `c = K/(n-1)`, power `K = 1/f`, semi-aperture `a`, object vergence `s = 1/z'`,
`g = (n^2 - 1)/n^2` and field angle `b = h/z'`, the sums `S_I = -sum A^2 y D(u/n)`, `S_II = -sum A B y D(u/n)`
over both surfaces (Welford, Aberrations of Optical Systems, ch. 8) become, plano side toward the object,

    S_I   = a^4 (g s^3 + (n c - s)^2 (K - g s))
    S_II  = a^3 b (s (K + n g c) - n c K)
    S_III = a^2 b^2 K
    S_IV  = a^2 b^2 K / n

With the curved side toward the object the light is reversed: `s` becomes `K - s`, and `S_II` changes its sign. A
surface that falls `d r^4` more than the sphere, `d = k / (8 R^3) + A_4`, adds `8 (n - 1) d a^4` to `S_I` alone, as the
stop is there (ch. 8.5). The wavefront error against a sphere about the Gaussian image is
`W040 r^4 + W131 r^3 cos + W222 r^2 cos^2 + W220 r^2` for the pupil radius `r` from 0 to 1 and the angle from the
direction of the image, `W040 = S_I/8`, `W131 = S_II/2`, `W222 = S_III/2`, `W220 = (S_III + S_IV)/4`. Positive errors
are ahead of the sphere. The spherical aberration of the plate, `t (n^2 - 1) / (8 n^3) (a/z')^4`, is left out: 2e-4
waves for the paper's lens at 20 mm.

Lengths and errors in mm unless a name says waves; `reduced_depth` is `z'`.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import jit, safe_quotient, safe_sqrt
from ..base.typing import Real, Result, ScalarLike
from ..microscope.geometry import Imager
from ..microscope.lenses import MicrolensArray
from .pupil import pupil_quadrature, pupil_radius
from .raytrace import Point, chief_ray_length, direction_cosines, trace_lenslet

# Gauss-Newton steps to the best focus. The first is right to 1e-3, and each squares its error.
_FOCUS_STEPS = 3


class WavefrontCoefficients(eqx.Module):
    """Coefficients W040, W131, W222, W220 and W020 of a wavefront error at the edge of the pupil, mm.

    They multiply `r^4`, `r^3 cos`, `r^2 cos^2`, `r^2` and `r^2`.
    """

    spherical: Float[Array, "..."]
    coma: Float[Array, "..."]
    astigmatism: Float[Array, "..."]
    field_curvature: Float[Array, "..."]
    defocus: Float[Array, "..."]


class RmsTerms(eqx.Module):
    """Root-mean-square wavefront errors of independent terms, mm; none is negative."""

    spherical: Float[Array, "..."]
    coma: Float[Array, "..."]
    astigmatism: Float[Array, "..."]
    defocus: Float[Array, "..."]


@jit
def wavefront(
    imager: Imager, depth: ScalarLike, pupil_points: Float[Array | np.ndarray, "*batch 2"], field: Point = (0.0, 0.0)
) -> Float[Array, "*batch"]:
    """Wavefront error, mm: optical path to the reference sphere less the chief ray's; positive where light is late.

    The sphere goes through the vertex as seen from the sensor, about the point where the chief ray meets the sensor, so
    that defocus counts. Parameters are those of `trace_lenslet`; NaN where no ray gets through.
    """
    rays = trace_lenslet(imager, depth, pupil_points, field)
    chief = trace_lenslet(imager, depth, np.zeros(2), field)
    radius2 = chief_ray_length(imager, chief) ** 2
    offset = rays.landing - chief.landing.reshape((1,) * (rays.path.ndim) + (2,))
    cosines = direction_cosines(rays.tangent)
    along, offset2 = jnp.sum(offset * cosines, -1), jnp.sum(offset**2, -1)
    # From the sphere to the sensor along the ray: m = along + sqrt(radius^2 - offset^2 + along^2), the chief's radius.
    root = jnp.sqrt(jnp.maximum(radius2 - offset2 + along**2, 0))
    past = along + (along**2 - offset2) / (root + jnp.sqrt(radius2))
    return jnp.where(rays.valid, rays.path - past, jnp.nan)


@jit
def wavefront_rms(
    imager: Imager, depth: ScalarLike, *, field: Point = (0.0, 0.0), radius: ScalarLike | None = None
) -> Float[Array, ""]:
    """RMS wavefront error over the pupil less piston and tilt, mm; NaN if part of the pupil reflects totally.

    `radius` is the pupil's, mm, by default half the aperture's diameter; the rest is as in `trace_lenslet`.
    """
    points, weights = pupil_quadrature(pupil_radius(imager, radius))
    return safe_sqrt(jnp.sum(weights * _remove_tilt(wavefront(imager, depth, points, field), points, weights) ** 2))


@jit
def best_focus(
    imager: Imager, depth: ScalarLike, *, field: Point = (0.0, 0.0), radius: ScalarLike | None = None
) -> Float[Array, ""]:
    """Sensor distance `v` of the least `wavefront_rms`, mm, whatever the imager's own sensor distance.

    Under spherical aberration it lies between the paraxial image and the smallest RMS spot. For an object within the
    focal length there is none: the result is then not a distance. Parameters are those of `wavefront_rms`.
    """
    points, weights = pupil_quadrature(pupil_radius(imager, radius))

    def error(vergence):
        moved = eqx.tree_at(lambda i: i.sensor_distance, imager, imager.sensor_distance_of(1 / vergence))
        return _remove_tilt(wavefront(moved, depth, points, field), points, weights)

    # Gauss-Newton: the wavefront is all but linear in 1/v'.
    vergence = 1 / imager.array.focal_length - 1 / imager.reduced_depth(jnp.asarray(depth, weights.dtype))

    def step(_, vergence):
        value, slope = jax.jvp(error, (vergence,), (jnp.ones_like(vergence),))
        return vergence - jnp.sum(weights * value * slope) / jnp.sum(weights * slope**2)

    return imager.sensor_distance_of(1 / jax.lax.fori_loop(0, _FOCUS_STEPS, step, vergence))


def _remove_tilt(error: Array, points: Array, weights: Array) -> Array:
    """Subtract mean and slopes; by symmetry `1, x, y` are orthogonal over a disc."""
    error = error - jnp.sum(weights * error)
    slopes = jnp.sum((weights * error)[:, None] * points, 0) / jnp.sum(weights[:, None] * points**2, 0)
    return error - points @ slopes


def seidel(
    focal_length: Real,
    refractive_index: Real,
    pupil_radius: Real,
    reduced_depth: Real,
    field_height: Real,
    sensor_distance: Real,
    *,
    plano_to_object: bool = True,
    departure: Real = 0.0,
) -> WavefrontCoefficients:
    """Third-order wavefront error of a plano-convex lens for a point `field_height` beside its axis.

    A sensor beside the Gaussian image gives `W020 = a^2/2 (1/v_f - 1/v)`. `departure` is `d` of the surface from a
    sphere, 1/mm^3.
    """
    n, a = jnp.asarray(refractive_index), jnp.asarray(pupil_radius)
    power, toward = 1 / jnp.asarray(focal_length), 1 / jnp.asarray(reduced_depth)
    angle = field_height * toward
    s = toward if plano_to_object else power - toward
    c, g = power / (n - 1), (n**2 - 1) / n**2
    s1 = a**4 * (g * s**3 + (n * c - s) ** 2 * (power - g * s) + 8 * (n - 1) * departure)
    s2 = a**3 * angle * (s * (power + n * g * c) - n * c * power)
    s3 = a**2 * angle**2 * power
    s4 = s3 / n
    defocus = a**2 / 2 * (power - toward - 1 / jnp.asarray(sensor_distance))
    return WavefrontCoefficients(s1 / 8, s2 / 2 if plano_to_object else -s2 / 2, s3 / 2, (s3 + s4) / 4, defocus)


def seidel_of_array(
    array: MicrolensArray, pupil_radius: Real, reduced_depth: Real, field_height: Real, sensor_distance: Real
) -> WavefrontCoefficients:
    """`seidel` of an array's lens, for the reduced sensor distance `v'`; an ideal lens has defocus alone."""
    lens = array.focal_length, array.refractive_index, pupil_radius, reduced_depth
    plano, departure = array.orientation == "plano", array.departure
    error = seidel(*lens, field_height, sensor_distance, plano_to_object=plano, departure=departure)
    if array.thin_lens_focal_length is None:
        return error
    zero = jnp.zeros_like(error.coma)
    return WavefrontCoefficients(zero, zero, zero, zero, zero + error.defocus)


def balanced_rms(error: WavefrontCoefficients) -> RmsTerms:
    """RMS of each term with the tilt and defocus that balance it, and of the remaining defocus.

    `W040 / (6 sqrt 5)`, `W131 / (6 sqrt 2)`, `W222 / (2 sqrt 6)`, `(W020 + W220 + W040 + W222/2) / (2 sqrt 3)`: the
    coefficients of the orthonormal Zernike polynomials (Mahajan), whose squares add up to the wavefront's variance.
    """
    left = error.defocus + error.field_curvature + error.spherical + error.astigmatism / 2
    return RmsTerms(
        jnp.abs(error.spherical) / (6 * math.sqrt(5)),
        jnp.abs(error.coma) / (6 * math.sqrt(2)),
        jnp.abs(error.astigmatism) / (2 * math.sqrt(6)),
        jnp.abs(left) / (2 * math.sqrt(3)),
    )


def linear_rms(error: WavefrontCoefficients) -> Result:
    """`dw = dw_c + dw_s + dw_d` (Eq. 10), mm: balanced coma and spherical aberration, and defocus.

    An upper bound, as independent errors do not add up linearly; without astigmatism and field curvature.
    """
    zero = jnp.zeros_like(error.spherical)
    terms = balanced_rms(WavefrontCoefficients(error.spherical, error.coma, zero, zero, error.defocus))
    return terms.coma + terms.spherical + terms.defocus


def independent_rms(error: WavefrontCoefficients) -> Result:
    """Standard deviation of the wavefront less its tilt: root of the sum of the balanced squares, mm."""
    terms = balanced_rms(error)
    return safe_sqrt(terms.spherical**2 + terms.coma**2 + terms.astigmatism**2 + terms.defocus**2)


def log_strehl(rms: Real, wavelength: Real) -> Result:
    """Logarithm of `strehl`, which underflows for the errors of the paper's lens."""
    return -((2 * math.pi * jnp.asarray(rms) / wavelength) ** 2)


def strehl(rms: Real, wavelength: Real) -> Result:
    """Strehl ratio `exp(-(2 pi dw)^2)` (Eq. 9) of an RMS error; valid below about 0.1 waves.

    The paper's lens has waves of error: there the value only says that the image is far from diffraction-limited.
    """
    return jnp.exp(log_strehl(rms, wavelength))


def linear_field_radius(
    array: MicrolensArray, pupil_radius: Real, reduced_depth: Real, sensor_distance: Real, wavelength: Real
) -> Result:
    """Field height where the Strehl ratio of Eqs. 9 and 10 is half of that on the axis (paper, "Field of view"), mm.

    Coma alone grows with the field there, `dw(h) = dw(0) + k h`. With `L = ln 2 (lambda / 2 pi)^2` the height solves
    `dw(h)^2 = dw(0)^2 + L`; without coma it is infinite. Parameters as in `seidel_of_array`.
    """
    error = seidel_of_array(array, pupil_radius, reduced_depth, 1.0, sensor_distance)
    slope = balanced_rms(error).coma
    axis = linear_rms(error) - slope
    drop = math.log(2) * (jnp.asarray(wavelength) / (2 * math.pi)) ** 2
    return safe_quotient(drop, slope * (axis + jnp.sqrt(axis**2 + drop)))
