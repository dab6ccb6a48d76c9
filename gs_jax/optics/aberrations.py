"""Third-order (Seidel) aberrations of one thin plano-convex lens, and the Strehl ratio of Eqs. 9 and 10.

The paper's own analysis is in a supplement that we do not have. This one takes the lens as thin, in air, with the stop
at the lens. With curvature `c = K/(n-1)`, power `K = 1/f`, semi-aperture `a`, object vergence `s = 1/z'`,
`g = (n^2 - 1)/n^2` and field angle `b = h/z'`, the sums `S_I = -sum A^2 y D(u/n)`, `S_II = -sum A B y D(u/n)`
over both surfaces (Welford, Aberrations of Optical Systems, ch. 8) become, plano side toward the object,

    S_I   = a^4 (g s^3 + (n c - s)^2 (K - g s))
    S_II  = a^3 b (s (K + n g c) - n c K)
    S_III = a^2 b^2 K
    S_IV  = a^2 b^2 K / n

A lens turned round is the same lens with the light reversed: `s` becomes `K - s`, and `S_II` changes its sign. A
surface that falls `d r^4` more than the sphere, `d = k / (8 R^3) + A_4`, adds `8 (n - 1) d a^4` to `S_I`, and nothing
to the others, as the stop is there (ch. 8.5). The wavefront error against a sphere about the Gaussian image is
`W040 r^4 + W131 r^3 cos + W222 r^2 cos^2 + W220 r^2` for the pupil radius `r` from 0 to 1 and the angle from the
direction of the image, with `W040 = S_I/8`, `W131 = S_II/2`,
`W222 = S_III/2`, `W220 = (S_III + S_IV)/4`. Positive means that the wavefront is ahead of the sphere: positive `W040`
focuses marginal rays short. The plate adds its own spherical aberration, `t (n^2 - 1) / (8 n^3) (a/z')^4`, for the
paper's lens 2e-4 waves at 20 mm; it is left out.

Lengths in mm; `reduced_depth` is `z'`. Errors are lengths too, unless a name says waves.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import safe_quotient, safe_sqrt
from ..lenses import MicrolensArray
from ..typing import Real, Result


class WavefrontCoefficients(eqx.Module):
    """Coefficients of a wavefront error at the edge of the pupil, mm.

    `spherical` (W040), `coma` (W131), `astigmatism` (W222), `field_curvature` (W220) and `defocus` (W020) multiply
    `r^4`, `r^3 cos`, `r^2 cos^2`, `r^2` and `r^2`.
    """

    spherical: Float[Array, "..."]
    coma: Float[Array, "..."]
    astigmatism: Float[Array, "..."]
    field_curvature: Float[Array, "..."]
    defocus: Float[Array, "..."]


class RmsTerms(eqx.Module):
    """Root-mean-square wavefront errors of independent terms, mm; all are positive."""

    spherical: Float[Array, "..."]
    coma: Float[Array, "..."]
    astigmatism: Float[Array, "..."]
    defocus: Float[Array, "..."]


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
    """Wavefront error of a plano-convex lens for a point beside its axis.

    Parameters
    ----------
    focal_length, refractive_index
        Of the lens; its radius of curvature is `f (n - 1)`.
    pupil_radius
        Of the clear aperture, mm.
    reduced_depth, field_height
        Depth of the point and its distance from the lens's axis, mm.
    sensor_distance
        `v`. A sensor beside the Gaussian image gives `W020 = a^2/2 (1/v_f - 1/v)`, the difference of the curvatures of
        two spheres; with the sensor at the Gaussian image it is zero.
    plano_to_object
        The side toward the object: plano as the paper's array is built, else convex.
    departure
        `d` of the surface from a sphere, 1/mm^3.
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
    """`seidel` of an array's lens; of an ideal thin lens nothing but the defocus.

    The sensor's distance is the reduced one, `v'`.
    """
    lens = array.focal_length, array.refractive_index, pupil_radius, reduced_depth
    plano, departure = array.orientation == "plano", array.departure
    error = seidel(*lens, field_height, sensor_distance, plano_to_object=plano, departure=departure)
    if array.thin_lens_focal_length is None:
        return error
    nothing = jnp.zeros_like(error.coma)
    return WavefrontCoefficients(nothing, nothing, nothing, nothing, nothing + error.defocus)


def balanced_rms(error: WavefrontCoefficients) -> RmsTerms:
    """RMS of each term with the tilt and defocus that balance it, and of the defocus that is left.

    `W040 / (6 sqrt 5)`, `W131 / (6 sqrt 2)`, `W222 / (2 sqrt 6)`, `(W020 + W220 + W040 + W222/2) / (2 sqrt 3)`: the
    coefficients of the orthonormal Zernike polynomials (Mahajan), so their squares add up to the wavefront's variance.
    The tilt moves the image and blurs nothing.
    """
    left = error.defocus + error.field_curvature + error.spherical + error.astigmatism / 2
    return RmsTerms(
        jnp.abs(error.spherical) / (6 * math.sqrt(5)),
        jnp.abs(error.coma) / (6 * math.sqrt(2)),
        jnp.abs(error.astigmatism) / (2 * math.sqrt(6)),
        jnp.abs(left) / (2 * math.sqrt(3)),
    )


def linear_rms(error: WavefrontCoefficients) -> Result:
    """`dw = dw_c + dw_s + dw_d` as printed (Eq. 10), mm: balanced coma and spherical aberration, and defocus.

    Errors that are independent do not add up like this: it is an upper bound. Astigmatism and field curvature are not
    in it.
    """
    nothing = jnp.zeros_like(error.spherical)
    terms = balanced_rms(WavefrontCoefficients(error.spherical, error.coma, nothing, nothing, error.defocus))
    return terms.coma + terms.spherical + terms.defocus


def independent_rms(error: WavefrontCoefficients) -> Result:
    """Standard deviation of the wavefront less its tilt, the root of the sum of the balanced squares, mm."""
    terms = balanced_rms(error)
    return safe_sqrt(terms.spherical**2 + terms.coma**2 + terms.astigmatism**2 + terms.defocus**2)


def log_strehl(rms: Real, wavelength: Real) -> Result:
    """Logarithm of `strehl`, which underflows for the errors of the paper's lens."""
    return -((2 * math.pi * jnp.asarray(rms) / wavelength) ** 2)


def strehl(rms: Real, wavelength: Real) -> Result:
    """Strehl ratio `exp(-(2 pi dw)^2)` (Eq. 9) of an RMS error, both arguments in mm.

    It holds for errors below about 0.1 waves. A lens of the paper has waves of error: there it only says that the
    image is far from diffraction-limited, not how good it is.
    """
    return jnp.exp(log_strehl(rms, wavelength))


def linear_field_radius(
    array: MicrolensArray, pupil_radius: Real, reduced_depth: Real, sensor_distance: Real, wavelength: Real
) -> Result:
    """Field height where the Strehl ratio is half of that on the axis (paper, "Field of view"), by Eqs. 9 and 10, mm.

    Coma alone grows with the field there, `dw(h) = dw(0) + k h`. With `L = ln 2 (lambda / 2 pi)^2` the height solves
    `dw(h)^2 = dw(0)^2 + L`. Parameters as in `seidel_of_array`; see `strehl` for where this means something. Without
    coma, as of an ideal lens, it is infinite.
    """
    error = seidel_of_array(array, pupil_radius, reduced_depth, 1.0, sensor_distance)
    slope = balanced_rms(error).coma
    axis = linear_rms(error) - slope
    drop = math.log(2) * (jnp.asarray(wavelength) / (2 * math.pi)) ** 2
    return safe_quotient(drop, slope * (axis + jnp.sqrt(axis**2 + drop)))
