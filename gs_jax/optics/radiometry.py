"""How much of a point's light a ray carries: solid angle, and Fresnel losses at every face. Shapes are `refract`'s."""

from ..base.arrays import array_namespace
from ..geometry import Imager
from ..layers import object_indices
from ..typing import Coordinates, Scalar, Scalars
from .raytrace import RefractedRay, dot, secant, square_and_root


def solid_angle(imager: Imager, ray: RefractedRay) -> Scalars:
    """Solid angle that the lens takes of an object point's light, per area of its curved side, 1/mm^2.

    In air it is the Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`, with the lateral distance
    `a` and the height `h`: `|1 - a . grad h / h| / h^2`. The gradient follows from the equation of `_height`, where
    the sag makes the glass thinner, or the air thicker. In a medium of index `n` the same rays fill
    `cos / (n^2 cos_n)` of that, as `n sin` does not change.
    """
    h, square, array = ray.height, dot(ray.slope, ray.slope), imager.array
    along = 0 * h
    if array.thin_lens_focal_length is None:
        growing = h * dot(ray.slope, ray.point) * ray.sag_slope_over_r
        if array.orientation == "plano":
            growing = -growing / square_and_root(array.refractive_index, square)[1]
        along = (growing - ray.lengthening * h) / (1 - ray.lengthening)
    longer = secant(ray.slope)
    angle = abs(1 - along / h) / (longer * longer * longer * h * h)
    if imager.sample is None:
        return angle
    n = imager.sample.refractive_index
    return angle / (n**2 * _cosine(n, square) * longer)


def transmittance(imager: Imager, ray: RefractedRay) -> Scalars:
    """Fraction of the light that all faces transmit: Fresnel's equations, unpolarised; an ideal lens has no faces."""
    array = imager.array
    in_front = object_indices(imager.filters, imager.sample)
    behind = [] if imager.windows is None else [1.0, *imager.windows.refractive_index[::-1]]
    light = 1 + 0 * ray.height
    if array.thin_lens_focal_length is None:
        n, (before, after) = array.refractive_index, ray.curved
        if array.orientation == "plano":
            in_front, light = [*in_front, n], _fresnel(n, before, 1, after)
        else:
            in_front, behind, light = [*in_front, 1.0], [n, *(behind or [1.0])], _fresnel(1, before, n, after)
    return light * _through(in_front, ray.slope) * _through(behind, ray.tangent)


def _through(indices, slope: Coordinates) -> Scalars:
    """Light that plane faces between media of these indices transmit; `slope` is the ray's in air."""
    square = dot(slope, slope)
    light, cosines = 1.0, [_cosine(n, square) for n in indices]
    for k in range(len(indices) - 1):
        light = light * _fresnel(indices[k], cosines[k], indices[k + 1], cosines[k + 1])
    return light


def _cosine(n: Scalar, square: Scalars) -> Scalars:
    """Cosine of a ray's angle in a medium, by the square of its slope in air: `sqrt(1 - sin^2 / n^2)`."""
    xp = array_namespace(square)
    return xp.sqrt((1 + square - square / n**2) / (1 + square))


def _fresnel(n_in, cos_in, n_out, cos_out):
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2
