"""A ray tracer for random microlens arrays that shares no code with `gs_jax`, to judge its forward model by.

Rays from an isotropic emitter to the plano face, to a sphere and to the sensor, by the vector law of refraction and
with Fresnel's losses; no diffraction. Of `gs_jax` it takes the numbers of an imager, nothing else.
"""

import math

import numpy as np
from numba import njit, prange

from gs_jax import Imager

# Parts of a scene that threads trace, each into an image of its own.
PARTS = 4
# More lenses than these do not cut an aperture.
NEIGHBOURS = 16


def traced(emitters: np.ndarray, imager: Imager, rays: int) -> np.ndarray:
    """The image of `(x, y, z, intensity)`: the part of each intensity that a pixel gets.

    `rays` go from each emitter toward each lens, at random but always the same. Apertures end at the disc and half-way
    to the neighbours.
    """
    centers = np.asarray(imager.centers, np.float64)
    near = np.argsort(np.linalg.norm(centers[:, None] - centers, axis=-1))[:, 1 : NEIGHBOURS + 1]
    a = imager.array
    lens = a.radius_of_curvature, a.refractive_index, a.substrate_thickness, a.aperture_diameter / 2
    numbers = tuple(float(x) for x in (*lens, imager.sensor_distance, imager.sensor.pixel_pitch))
    images = np.zeros((PARTS, *imager.sensor.shape))
    _traced(np.asarray(emitters, np.float64), centers, near, numbers, images, rays)
    return images.sum(0)


@njit(parallel=True, fastmath=True, error_model="numpy")
def _traced(emitters, centers, near, numbers, images, rays):
    for part in prange(PARTS):
        np.random.seed(part)
        for number in range(part, len(emitters), PARTS):
            for lens in range(len(centers)):
                _add_spot(images[part], emitters[number], centers[lens], centers[near[lens]], numbers, rays)


@njit(fastmath=True, error_model="numpy")
def _add_spot(image, emitter, center, others, numbers, rays):
    radius, n, t, aperture, v, pixel = numbers
    x, y, z, intensity = emitter
    x, y, others = x - center[0], y - center[1], others - center
    # The part of the front face, a disc, that light of the whole aperture can come through.
    air = math.hypot(x, y) / (z + t / n)
    glass = 1 / math.sqrt(n**2 + (n**2 - 1) * air**2) / (z + t / n)
    sag = radius - math.sqrt(radius**2 - aperture**2)
    disc = aperture + sag * air / n / 2 + (t + sag) * aperture / z
    light = intensity * disc**2 / (4 * rays)
    for i in range(rays):
        r, turn = disc * math.sqrt((i + np.random.random()) / rays), 2 * np.pi * np.random.random()
        front_x = r * math.cos(turn) + x * glass * (t - sag / 2)
        front_y = r * math.sin(turn) + y * glass * (t - sag / 2)
        # An isotropic emitter: the solid angle of a piece of the front face.
        length = math.sqrt((front_x - x) ** 2 + (front_y - y) ** 2 + z**2)
        outside = (front_x - x) / length, (front_y - y) / length, z / length
        inside, passed = _refracted(outside, (0.0, 0.0, 1.0), 1 / n)
        # To the sphere, from its middle, which is at the height t - radius.
        from_z = radius - t
        along = front_x * inside[0] + front_y * inside[1] + from_z * inside[2]
        root = along**2 + radius**2 - front_x**2 - front_y**2 - from_z**2
        if root < 0:
            continue
        way = math.sqrt(root) - along
        cap_x, cap_y, cap_z = front_x + way * inside[0], front_y + way * inside[1], from_z + way * inside[2]
        if cap_z <= 0 or cap_x**2 + cap_y**2 > aperture**2:
            continue
        clear = True
        for other in others:
            if cap_x * other[0] + cap_y * other[1] > (other[0] ** 2 + other[1] ** 2) / 2:
                clear = False
                break
        if not clear:
            continue
        ray, again = _refracted(inside, (cap_x / radius, cap_y / radius, cap_z / radius), n)
        if again == 0 or ray[2] <= 0:
            continue
        way = (v + radius - cap_z) / ray[2]
        row = math.floor((center[1] + cap_y + way * ray[1]) / pixel + image.shape[0] / 2)
        column = math.floor((center[0] + cap_x + way * ray[0]) / pixel + image.shape[1] / 2)
        if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
            image[row, column] += light * passed * again * z / length**3


@njit(fastmath=True, error_model="numpy")
def _refracted(ray, normal, ratio):
    """The ray behind a face and the share of its light that passes, unpolarised; `ratio` of the indices before it."""
    before = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
    square = 1 - ratio**2 * (1 - before**2)
    if before <= 0 or square <= 0:
        return ray, 0.0
    behind = math.sqrt(square)
    bend = behind - ratio * before
    across = (ratio * before - behind) / (ratio * before + behind)
    along = (before - ratio * behind) / (before + ratio * behind)
    new = ratio * ray[0] + bend * normal[0], ratio * ray[1] + bend * normal[1], ratio * ray[2] + bend * normal[2]
    return new, 1 - (across**2 + along**2) / 2
