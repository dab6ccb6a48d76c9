"""Independent ray tracer for random microlens arrays, which shares no code with `gs_jax`, as a reference for its model.

Rays from an isotropic emitter pass the plano face, then a conic, to the sensor, or the conic first, by the vector law
of refraction and with Fresnel losses; no diffraction, no layers and no aspheric terms. From `gs_jax` it takes only the
parameters of an imager.
"""

import dataclasses
import math

import numpy as np
from numba import njit, prange

from gs_jax import Imager, InputError

# Parts of a scene, traced by threads, each into its own image.
PARTS = 4
# At most so many neighbours cut an aperture.
NEIGHBOURS = 16
# Depth of a tile, mm, and the angle between its rays, which spreads them evenly.
DEEP, TURN = 0.01, np.pi * (3 - 5**0.5)


def traced(emitters: np.ndarray, imager: Imager, rays: int, tile: float = 0.0) -> np.ndarray:
    """Image emitters `(x, y, z, intensity)`; a pixel gets its share of each intensity.

    `rays` go from each emitter toward each lens, random but reproducible. Apertures end at their disc and where a
    neighbour's surface is higher, which is half-way for identical lenses. A tilted array is traced in its own frame, in
    which emitters and the sensor are turned about the point of the vertices' plane above the sensor's centre.

    With a `tile`, mm, emitters within a square of that width and a hundredth of a millimetre in depth share the rays of
    their mean place, displaced by the magnification: many times the rays for the same time. Spots must hardly change
    within a tile.
    """
    images = np.zeros((PARTS, *imager.sensor.shape))
    emitters = _before(np.asarray(emitters, np.float64), imager)
    first = np.arange(len(emitters) + 1)
    if tile:
        place = np.floor(emitters[:, :3] / (tile, tile, DEEP)).astype(int)
        order = np.lexsort(place.T)
        emitters, place = emitters[order], place[order]
        first = np.r_[0, np.flatnonzero((np.diff(place, axis=0) != 0).any(1)) + 1, len(emitters)]
    _traced(emitters, first, *_lenses(imager), images, rays)
    return images.sum(0)


def can_trace(imager: Imager) -> bool:
    """Whether an imager has neither layers, a band nor aspheric terms, which are not traced."""
    parts = imager.filters, imager.windows, imager.sample, imager.band
    return all(part is None for part in parts) and not imager.array.aspheric_terms.size


def bundles(places: np.ndarray, imager: Imager, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Where rays of each place `(x, y, z)` toward each lens land: x, y, mm, and their share of the place's light.

    Returns `(place, lens, ray, 3)`, and the magnification of each place. Lost rays have no share.
    """
    lenses = _lenses(imager)
    landed, magnification = np.zeros((len(places), len(lenses[0]), rays, 3)), np.zeros(len(places))
    _bundles(_before(np.asarray(places, np.float64), imager), *lenses, landed, magnification)
    return landed, magnification


def _turn(imager: Imager) -> np.ndarray:
    """The least rotation from the sensor's frame to the array's, `(3, 3)`."""
    slopes = np.zeros(2) if imager.tilt is None else np.asarray(imager.tilt, np.float64)
    cosine = 1 / np.sqrt(1 + slopes @ slopes)
    turn = np.eye(3)
    turn[:2, :2] -= np.outer(slopes, slopes) * cosine**2 / (1 + cosine)
    turn[:2, 2], turn[2, :2], turn[2, 2] = slopes * cosine, -slopes * cosine, cosine
    return turn


def _before(emitters: np.ndarray, imager: Imager) -> np.ndarray:
    """Emitters in the array's frame."""
    behind = float(imager.array.substrate_thickness) if imager.array.orientation == "plano" else 0.0
    lift = np.array([0.0, 0.0, behind])
    return np.column_stack([(emitters[:, :3] + lift) @ _turn(imager).T - lift, emitters[:, 3:]])


def _lenses(imager: Imager):
    """Lenses, the numbers of their nearest neighbours, what all share, and whether the curved side is in front."""
    if not can_trace(imager):
        raise InputError("the ray tracer takes no layers, no emission band and no aspheric terms")
    centers = np.asarray(dataclasses.replace(imager, tilt=None).centers, np.float64)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    a = imager.array
    touching = (apart < float(np.max(a.aperture_diameter))).sum(1).max()
    near = np.argsort(apart)[:, 1 : min(NEIGHBOURS + 1, touching)]
    each = a.radius_of_curvature, a.conic_constant, a.aperture_diameter / 2
    lenses = np.column_stack([centers, *(np.broadcast_to(np.asarray(x, np.float64), len(centers)) for x in each)])
    curve_first = a.orientation == "curved"
    shared = a.refractive_index, a.substrate_thickness, imager.sensor_distance, imager.sensor.pixel_pitch
    origin = np.asarray(imager.sensor.origin, np.float64)
    numbers = (*(float(x) for x in shared), origin, _turn(imager))
    return lenses, near, numbers, curve_first


@njit(parallel=True, fastmath=True, error_model="numpy")
def _traced(emitters, first, lenses, near, numbers, curve_first, images, rays):
    for part in prange(PARTS):
        np.random.seed(part)
        landed = np.empty((rays, 3))
        for number in range(part, len(first) - 1, PARTS):
            tile = emitters[first[number] : first[number + 1]]
            for lens in range(len(lenses)):
                others = lenses[near[lens]]
                others[:, :2] -= lenses[lens, :2]
                _add_spots(images[part], tile, lenses[lens], others, numbers, curve_first, landed)


@njit(fastmath=True, error_model="numpy")
def _bundles(places, lenses, near, numbers, curve_first, landed, magnification):
    np.random.seed(PARTS)
    for number in range(len(places)):
        place = places[number, 0], places[number, 1], places[number, 2]
        for lens in range(len(lenses)):
            others = lenses[near[lens]]
            others[:, :2] -= lenses[lens, :2]
            magnification[number] = _land(landed[number, lens], place, lenses[lens], others, numbers, curve_first)


@njit(fastmath=True, error_model="numpy")
def _add_spots(image, tile, lens, others, numbers, curve_first, landed):
    place = tile[:, 0].mean(), tile[:, 1].mean(), tile[:, 2].mean()
    magnification = _land(landed, place, lens, others, numbers, curve_first)
    pixel, origin = numbers[3], numbers[4]
    for x, y, share in landed:
        if share > 0:
            for one in tile:
                row = math.floor((y - magnification * (one[1] - place[1]) - origin[1]) / pixel + image.shape[0] / 2)
                column = math.floor((x - magnification * (one[0] - place[0]) - origin[0]) / pixel + image.shape[1] / 2)
                if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                    image[row, column] += share * one[3]


@njit(fastmath=True, error_model="numpy")
def _land(landed, place, lens, others, numbers, curve_first):
    """Trace rays to where they land, x, y, mm, and their share of the point's light; return the magnification."""
    n, t, v, _, _, turned = numbers
    radius, conic, aperture = lens[2:]
    vertices = v + t if curve_first else v
    x, y, z = place[0] - lens[0], place[1] - lens[1], place[2]
    sag = _sag(aperture**2, radius, conic)
    # The disc of the front plane through which light reaches the aperture.
    if curve_first:
        air = math.hypot(x, y) / z
        disc, toward = aperture * (1 + sag / z) + sag * air / 2, sag / 2 / z
    else:
        air = math.hypot(x, y) / (z + t / n)
        glass = 1 / math.sqrt(n**2 + (n**2 - 1) * air**2) / (z + t / n)
        disc, toward = aperture + sag * air / n / 2 + (t + sag) * aperture / z, glass * (t - sag / 2)
    rays = len(landed)
    light, start = disc**2 / (4 * rays), 2 * np.pi * np.random.random()
    for i in range(rays):
        landed[i, 2] = 0
        r, turn = disc * math.sqrt((i + np.random.random()) / rays), start + i * TURN
        sign = -1 if curve_first else 1
        front = r * math.cos(turn) + sign * x * toward, r * math.sin(turn) + sign * y * toward
        # Isotropic emitter: solid angle of an element of the front plane.
        length = math.sqrt((front[0] - x) ** 2 + (front[1] - y) ** 2 + z**2)
        outside = (front[0] - x) / length, (front[1] - y) / length, z / length
        if curve_first:
            cap, normal = _met(front, outside, 0.0, 1.0, radius, conic)
            inside, passed = _refracted(outside, normal, 1 / n)
            way = (t - cap[2]) / inside[2]
            last = cap[0] + way * inside[0], cap[1] + way * inside[1]
            ray, again = _refracted(inside, (0.0, 0.0, 1.0), n)
            to_sensor = v
        else:
            inside, passed = _refracted(outside, (0.0, 0.0, 1.0), 1 / n)
            cap, normal = _met(front, inside, t, -1.0, radius, conic)
            ray, again = _refracted(inside, normal, n)
            last, to_sensor = (cap[0], cap[1]), v + cap[2]
        if not cap[2] <= sag or passed * again == 0 or ray[2] <= 0 or _covered(cap, others):
            continue
        # Heights in the array's frame are minus the way toward the sensor, whose height is 0 in its own frame.
        at = lens[0] + last[0], lens[1] + last[1], to_sensor - vertices
        height = vertices + turned[0, 2] * at[0] + turned[1, 2] * at[1] + turned[2, 2] * at[2]
        way = height / (turned[2, 2] * ray[2] - turned[0, 2] * ray[0] - turned[1, 2] * ray[1])
        hit = at[0] + way * ray[0], at[1] + way * ray[1], at[2] - way * ray[2]
        landed[i, 0] = turned[0, 0] * hit[0] + turned[1, 0] * hit[1] + turned[2, 0] * hit[2]
        landed[i, 1] = turned[0, 1] * hit[0] + turned[1, 1] * hit[1] + turned[2, 1] * hit[2]
        landed[i, 2] = light * passed * again * z / length**3
    return (v + t / n) / z if curve_first else v / (z + t / n)


@njit(fastmath=True, error_model="numpy")
def _met(start, ray, below, toward, radius, conic):
    """Intersection of a ray with `x^2 + y^2 = 2 R w - (1 + k) w^2`, `(x, y, w)`, and the normal there, along the ray.

    The ray starts at `w = below`; `toward` is 1 if w increases along the light. Rays that miss have an unreachable w.
    """
    deeper = toward * ray[2]
    a = ray[0] ** 2 + ray[1] ** 2 + (1 + conic) * deeper**2
    b = start[0] * ray[0] + start[1] * ray[1] + ((1 + conic) * below - radius) * deeper
    c = start[0] ** 2 + start[1] ** 2 - 2 * radius * below + (1 + conic) * below**2
    root = math.sqrt(max(b * b - a * c, 0.0))
    if b * b < a * c:
        return (0.0, 0.0, 1e9), (0.0, 0.0, 1.0)
    # From outside take the first intersection, from inside the one ahead.
    way = c / (root - b) if toward > 0 else -c / (b + root)
    x, y, w = start[0] + way * ray[0], start[1] + way * ray[1], below + way * deeper
    along = radius - (1 + conic) * w
    length = math.sqrt(x**2 + y**2 + along**2)
    return (x, y, w), (-toward * x / length, -toward * y / length, along / length)


@njit(fastmath=True, error_model="numpy")
def _covered(cap, others):
    """Whether a neighbour's surface is above a point of the lens."""
    for other in others:
        apart = (cap[0] - other[0]) ** 2 + (cap[1] - other[1]) ** 2
        if apart < other[4] ** 2 and _sag(apart, other[2], other[3]) < cap[2]:
            return True
    return False


@njit(fastmath=True, error_model="numpy")
def _sag(squared, radius, conic):
    return squared / (radius + math.sqrt(radius**2 - (1 + conic) * squared))


@njit(fastmath=True, error_model="numpy")
def _refracted(ray, normal, ratio):
    """The ray behind a face and its transmitted share, unpolarised; `ratio` is n before over n behind it."""
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
