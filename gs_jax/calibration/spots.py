"""Where the spots of point sources are, in a capture and by exact rays, by one definition: the middle of the core.

The middle is where a Gaussian window, moved to the centroid of what it sees, comes to rest (mean shift): rays far from
the core do not move it.
"""

import numpy as np
from jaxtyping import Array, Float64, Shaped
from skimage.feature import peak_local_max

from ..detection.consistency import signal
from ..geometry import Imager
from ..optics.psf_core import PupilSamples, aperture_profile, sample_pupil

# Of the window, pixels: standard deviation, half its side; how often it is moved at most, and when it rests.
_WINDOW, _HALF, _MOVES, _RESTS = 1.5, 4, 300, 1e-4
# A spot is so many times brighter than the noise, and so many pixels from the next.
_ABOVE, _APART = 8.0, 6
# Rays of a spot, and pixels about its chief ray within which its core lies.
_RAYS, _REACH = 8192, 40


def find_spots(image: Shaped[Array | np.ndarray, "row column"], most: int) -> Float64[np.ndarray, "spot 2"]:
    """The brightest spots, brightest first, as fractional `(row, column)`; none within six pixels of the edge."""
    light, noise = signal(image)
    threshold = _ABOVE * float(np.median(noise))
    peaks = peak_local_max(light, min_distance=_APART, threshold_abs=threshold, num_peaks=most)
    return np.array([_middle_of_pixels(light, peak) for peak in peaks]).reshape(-1, 2)


def _middle_of_pixels(light, peak):
    place, side = peak.astype(float), np.arange(-_HALF, _HALF + 1)
    square = np.maximum(light[tuple(slice(at - _HALF, at + _HALF + 1) for at in peak)], 0)
    for _ in range(_MOVES):
        weights = [np.exp(-((side - offset) ** 2) / (2 * _WINDOW**2)) for offset in place - peak]
        seen = square * np.outer(*weights)
        if not seen.sum() > 0:
            break
        step = np.array([seen.sum(1) @ side, seen.sum(0) @ side]) / seen.sum() - (place - peak)
        place = np.clip(place + step, peak - 2, peak + 2)
        if np.abs(step).max() < _RESTS:
            break
    return place


def core_offsets(
    imager: Imager, depths: Float64[np.ndarray, " depth"], fields: Float64[np.ndarray, " field"]
) -> Float64[np.ndarray, "depth field"]:
    """How far the core of a spot is from its chief ray, toward the point's side, mm, by exact rays.

    A point `field` beside a lens's axis is imaged at `-M_z field` from the axis, plus this.
    """
    aperture, found = aperture_profile(imager.array), []
    for depth in depths:
        rays = sample_pupil(imager, float(depth), fields, aperture, _RAYS)
        chief = float(imager.magnification(depth)) * fields
        found.append([_middle_of_rays(rays, k, chief[k], imager.sensor.pixel_pitch) for k in range(len(fields))])
    return np.array(found)


def _middle_of_rays(rays: PupilSamples, field: int, chief: float, pixel: float) -> float:
    along, across, light = rays.landing[field, :, 0] + chief, rays.landing[field, :, 1], rays.light[field]
    near = np.hypot(along, across) < _REACH * pixel
    if not light[near].sum() > 0:
        return 0.0
    # From the densest place along the radius: the light of each pixel's width about the middle line.
    edges = pixel * np.arange(-_REACH, _REACH + 1)
    line = np.histogram(along, edges, weights=light * (np.abs(across) < pixel))[0]
    place, width = (edges[line.argmax()] + pixel / 2), _WINDOW * pixel
    for _ in range(_MOVES):
        weight = light * np.exp(-((along - place) ** 2 + across**2) / (2 * width**2))
        last, place = place, float(weight @ along / weight.sum())
        if abs(place - last) < _RESTS * pixel:
            break
    return place
