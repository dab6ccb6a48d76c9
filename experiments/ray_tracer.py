"""Independent ray tracer for random microlens arrays, which shares no code with `gs_jax`, as a reference for its model.

Rays from an isotropic emitter pass the layers in front, the plano face and then a conic, or the conic first, and the
windows, to the sensor, by the vector law of refraction and with Fresnel losses; no diffraction, no band and no aspheric
terms. Filters, and a sample in contact with them or the array, tilt with it; windows and a sample with a surface of its
own are parallel to the sensor. From `gs_jax` it takes only the parameters of an imager.
"""

import dataclasses
import math

import numpy as np
from numba import njit, prange

from gs_jax import Imager, InputError
from gs_jax.microscope.lenses import EACH

# Parts of a scene, traced by threads, each into its own image.
PARTS = 4
# At most so many neighbours cut an aperture.
NEIGHBOURS = 16
# Parts of a pixel, along a side, to which rays of a tile are rounded.
FINE = 4
# Depth of a tile, mm, and the angle between its rays, which spreads them evenly.
DEEP, TURN = 0.05, np.pi * (3 - 5**0.5)


def traced(emitters: np.ndarray, imager: Imager, rays: int, tile: float = 0.0) -> np.ndarray:
    """Image emitters `(x, y, z, intensity)`; a pixel gets its share of each intensity.

    `rays` go from each emitter toward each lens, random but reproducible. Apertures end at their disc and where a
    neighbour's surface is higher, which is half-way for identical lenses. A tilted array is traced in its own frame, in
    which emitters and the sensor are turned about the point of the vertices' plane above the sensor's centre.

    With a `tile`, mm, emitters within a square of that width and a twentieth of a millimetre in depth share the rays of
    their mean place, displaced as chief rays are and to a quarter of a pixel: many times the rays for the same time.
    Spots must hardly change within a tile.
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
    """Whether an imager has neither a band nor aspheric terms, which are not traced."""
    return imager.band is None and not imager.array.aspheric_terms.size


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
        raise InputError("the ray tracer takes no emission band and no aspheric terms")
    centers = np.asarray(dataclasses.replace(imager, tilt=None).centers, np.float64)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    a = imager.array
    touching = (apart < float(np.max(a.aperture_diameter))).sum(1).max()
    near = np.argsort(apart)[:, 1 : min(NEIGHBOURS + 1, touching)]
    radius, diameter, conic = (np.asarray(a.of_lenses(name), np.float64) for name in EACH)
    lenses = np.column_stack([centers, radius, conic, diameter / 2])
    curve_first = a.orientation == "curved"
    shared = a.refractive_index, a.substrate_thickness, imager.sensor_distance, imager.sensor.pixel_pitch
    origin = np.asarray(imager.sensor.origin, np.float64)
    numbers = (*(float(x) for x in shared), origin, _turn(imager), *_layers(imager))
    return lenses, near, numbers, curve_first


def _layers(imager: Imager):
    """Faces in front of the array, what shortens the way to them, and the windows.

    A face is its unit normal along the light, the product of that and a point on it, and the index behind it. Points
    are in the array's frame, from its front along the light. The last face is the front of a plano array, or where a
    filter ends before the curved side. The others: whether the sample tilts with the array, where it begins, its index,
    and by how much layers beside it are optically thinner. Windows are thickness and index from the array on.
    """
    slabs = lambda part: [] if part is None else np.stack([part.thickness, part.refractive_index], -1).tolist()
    plano, sample = imager.array.orientation == "plano", imager.sample
    filters, cover = slabs(imager.filters), slabs(None if sample is None else sample.layers)
    index = 1.0 if sample is None else float(sample.refractive_index)
    surface = None if sample is None else sample.surface
    contact = surface is None
    thick = lambda parts: float(sum(t for t, _ in parts))
    begins = thick(filters) + thick(cover) if surface is None else float(surface)
    turn = _turn(imager)
    behind = float(imager.array.substrate_thickness) if plano else 0.0
    level = lambda z: (*-turn[:2, 2], turn[2, 2], turn[2, 2] * behind - (z + behind))
    along = lambda z: (0.0, 0.0, 1.0, -z)
    faces, at, place = [], begins, along if contact else level
    # A face lies in front of each layer, which the light meets in this order.
    for t, n in cover:
        faces.append((*place(at), n))
        at -= t
    if not contact:
        faces.append((*level(at), 1.0))
    at = thick(filters)
    for t, n in filters[::-1]:
        faces.append((*along(at), n))
        at -= t
    if plano or filters:
        faces.append((*along(0.0), float(imager.array.refractive_index) if plano else 1.0))
    elif contact and sample is not None:
        raise InputError("the ray tracer takes no sample in contact with a curved side")
    shorter = float(sum(t * (1 - 1 / n) for t, n in (*filters, *cover)))
    windows = np.array(slabs(imager.windows)[::-1], float).reshape(-1, 2)
    return np.array(faces, float).reshape(-1, 5), np.array([contact, begins, index, shorter]), windows


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
            magnification[number], _ = _land(landed[number, lens], place, lenses[lens], others, numbers, curve_first)


@njit(fastmath=True, error_model="numpy")
def _add_spots(image, tile, lens, others, numbers, curve_first, landed):
    place = tile[:, 0].mean(), tile[:, 1].mean(), tile[:, 2].mean()
    magnification, reduced = _land(landed, place, lens, others, numbers, curve_first)
    pixel, origin, index = numbers[3], numbers[4], numbers[7][2]
    away = np.empty((len(tile), 3))
    for one in range(len(tile)):
        # By how much the magnification is larger than in the middle.
        larger = magnification * (place[2] - tile[one, 2]) / (reduced * index + tile[one, 2] - place[2])
        away[one, 0] = (larger * (lens[0] - tile[one, 0]) - magnification * (tile[one, 0] - place[0])) / pixel
        away[one, 1] = (larger * (lens[1] - tile[one, 1]) - magnification * (tile[one, 1] - place[1])) / pixel
        away[one, 2] = tile[one, 3]
    left, top = math.floor(away[:, 0].min()), math.floor(away[:, 1].min())
    # Pixels that one ray may light; where they are fewer than emitters, the emitters' pattern is made once for each
    # `FINE` of a pixel, by which rays are moved then: that blurs less than a tenth of a pixel.
    wide, tall = math.floor(away[:, 0].max()) - left + 2, math.floor(away[:, 1].max()) - top + 2
    if FINE**2 < len(landed) and wide * tall < len(tile):
        patterns = np.zeros((FINE, FINE, tall, wide))
        for down, right in np.ndindex(FINE, FINE):
            for x, y, light in away:
                row, column = math.floor(y + (down + 0.5) / FINE) - top, math.floor(x + (right + 0.5) / FINE) - left
                patterns[down, right, row, column] += light
        for x, y, share in landed:
            if share > 0:
                y, x = (y - origin[1]) / pixel + image.shape[0] / 2, (x - origin[0]) / pixel + image.shape[1] / 2
                row, column = math.floor(y), math.floor(x)
                pattern = patterns[min(int(FINE * (y - row)), FINE - 1), min(int(FINE * (x - column)), FINE - 1)]
                row, column = row + top, column + left
                for i in range(max(-row, 0), min(tall, image.shape[0] - row)):
                    for j in range(max(-column, 0), min(wide, image.shape[1] - column)):
                        image[row + i, column + j] += share * pattern[i, j]
        return
    for x, y, share in landed:
        if share > 0:
            for right, down, light in away:
                row = math.floor((y - origin[1]) / pixel + down + image.shape[0] / 2)
                column = math.floor((x - origin[0]) / pixel + right + image.shape[1] / 2)
                if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                    image[row, column] += share * light


@njit(fastmath=True, error_model="numpy")
def _land(landed, place, lens, others, numbers, curve_first):
    """Trace rays to where they land, x, y, mm, and their share of the point's light.

    Returns the magnification and the reduced distance, mm.
    """
    n, t, v, _, _, turned, faces, sample, windows = numbers
    contact, begins, index, shorter = sample[0] == 1, sample[1], sample[2], sample[3]
    radius, conic, aperture = lens[2:]
    vertices = v + t if curve_first else v
    x, y, z = place[0] - lens[0], place[1] - lens[1], place[2]
    behind = 0.0 if curve_first else t
    depth = turned[0, 2] * place[0] + turned[1, 2] * place[1] + turned[2, 2] * (z + behind) - behind
    # Distance from the front in air.
    away = z - shorter - ((z if contact else depth) - begins) * (1 - 1 / index)
    sag = _sag(aperture**2, radius, conic)
    # The disc of the front plane through which light reaches the aperture.
    if curve_first:
        air = math.hypot(x, y) / away
        disc, toward = aperture * (1 + sag / away) + sag * air / 2, sag / 2 / away
    else:
        air = math.hypot(x, y) / (away + t / n)
        glass = 1 / math.sqrt(n**2 + (n**2 - 1) * air**2) / (away + t / n)
        disc, toward = aperture + sag * air / n / 2 + (t + sag) * aperture / away, glass * (t - sag / 2)
    middle = x * toward, y * toward
    # Where a point in air would send its rays from: the ray toward the disc's middle must meet it.
    source = x, y
    if shorter or index != 1:
        disc *= 1.03
        for _ in range(4):
            slope = (middle[0] - source[0]) / away, (middle[1] - source[1]) / away
            met, _, _, _ = _through(place, slope, lens, index, contact, turned, faces)
            source = source[0] + met[0] - middle[0], source[1] + met[1] - middle[1]
    rays = len(landed)
    light, start = disc**2 / (4 * rays * away**2), 2 * np.pi * np.random.random()
    for i in range(rays):
        landed[i, 2] = 0
        r, turn = disc * math.sqrt((i + np.random.random()) / rays), start + i * TURN
        front = middle[0] + r * math.cos(turn), middle[1] + r * math.sin(turn)
        slope = (front[0] - source[0]) / away, (front[1] - source[1]) / away
        front, ray, angle, before = _through(place, slope, lens, index, contact, turned, faces)
        if curve_first:
            cap, normal = _met(front, ray, 0.0, 1.0, radius, conic)
            inside, passed = _refracted(ray, normal, 1 / n)
            way = (t - cap[2]) / inside[2]
            last = cap[0] + way * inside[0], cap[1] + way * inside[1]
            ray, again = _refracted(inside, (0.0, 0.0, 1.0), n)
            to_sensor = v
        else:
            cap, normal = _met(front, ray, t, -1.0, radius, conic)
            ray, again = _refracted(ray, normal, n)
            passed, last, to_sensor = 1.0, (cap[0], cap[1]), v + cap[2]
        passed *= before * again
        if not cap[2] <= sag or passed == 0 or ray[2] <= 0 or _covered(cap, others):
            continue
        # Heights in the array's frame are minus the way toward the sensor, whose height is 0 in its own frame.
        at = lens[0] + last[0], lens[1] + last[1], to_sensor - vertices
        down = turned[2, 2] * ray[2] - turned[0, 2] * ray[0] - turned[1, 2] * ray[1]
        across = turned[0, 0] * ray[0] + turned[1, 0] * ray[1] - turned[2, 0] * ray[2]
        along = turned[0, 1] * ray[0] + turned[1, 1] * ray[1] - turned[2, 1] * ray[2]
        height = vertices + turned[0, 2] * at[0] + turned[1, 2] * at[1] + turned[2, 2] * at[2]
        hit_x = turned[0, 0] * at[0] + turned[1, 0] * at[1] + turned[2, 0] * at[2]
        hit_y = turned[0, 1] * at[0] + turned[1, 1] * at[1] + turned[2, 1] * at[2]
        ray, gap, index_before = (across, along, down), height - windows[:, 0].sum(), 1.0
        hit_x, hit_y = hit_x + gap * ray[0] / ray[2], hit_y + gap * ray[1] / ray[2]
        for thickness, window in windows:
            ray, again = _refracted(ray, (0.0, 0.0, 1.0), index_before / window)
            passed, index_before = passed * again, window
            hit_x, hit_y = hit_x + thickness * ray[0] / ray[2], hit_y + thickness * ray[1] / ray[2]
        landed[i, 0], landed[i, 1], landed[i, 2] = hit_x, hit_y, light * angle * passed
    v -= (windows[:, 0] * (1 - 1 / windows[:, 1])).sum()
    reduced = away if curve_first else away + t / n
    return (v + t / n if curve_first else v) / reduced, reduced


@njit(fastmath=True, error_model="numpy")
def _through(place, slope, lens, index, contact, turned, faces):
    """Where a ray meets the front plane, beside the lens, and its direction there.

    `slope` is its slope in air, to the array's normal. Also returned are the solid angle in the object's medium over
    the element of slopes, and the light that the faces transmit.
    """
    length = math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    ray, angle, light, before = (slope[0] / length, slope[1] / length, 1 / length), length**-3, 1.0, index
    if index != 1:
        normal = (0.0, 0.0, 1.0) if contact else (-turned[0, 2], -turned[1, 2], turned[2, 2])
        cosine = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
        ray, _ = _refracted(ray, normal, 1 / index)
        angle *= cosine / (index**2 * (normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]))
    x, y, w = place[0] - lens[0], place[1] - lens[1], -place[2]
    for a, b, c, offset, after in faces:
        way = (offset - a * (x + lens[0]) - b * (y + lens[1]) - c * w) / (a * ray[0] + b * ray[1] + c * ray[2])
        x, y, w = x + way * ray[0], y + way * ray[1], w + way * ray[2]
        ray, passed = _refracted(ray, (a, b, c), before / after)
        light, before = light * passed, after
    way = -w / ray[2]
    return (x + way * ray[0], y + way * ray[1]), ray, angle, light


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
