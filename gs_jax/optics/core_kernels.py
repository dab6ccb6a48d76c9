"""Kernels of the cores of spots: rendered on pixels, corrected for what the model adds. Host code."""

import numpy as np
from jaxtyping import Float64

from .psf_core import BINS, HARMONICS
from .pupil import vogel_spiral

# Samples of a rendered kernel.
_SAMPLES = 2**17


def render_kernel(
    profile: Float64[np.ndarray, " bin"], size: int, parts: float | int = 1
) -> Float64[np.ndarray, "row column"]:
    """Symmetric kernel with a radial profile, on `size` x `size` (odd) pixels or `parts` of a pixel, with the sum 1."""
    column, row = np.floor(parts * sample_profile(profile, _SAMPLES) + size / 2).astype(int).T
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    light = np.bincount((row * size + column)[inside], minlength=size * size).reshape(size, size) / _SAMPLES
    light = light + light[::-1] + light[:, ::-1] + light[::-1, ::-1]
    return (light + light.T) / 8


def sample_profile(profile: Float64[np.ndarray, " bin"], count: int) -> Float64[np.ndarray, "point 2"]:
    """Points `(x, y)` in pixels whose density follows a core's profile."""
    order = np.arange(count) + 0.5
    edges = np.arange(profile.size + 1) / BINS
    return vogel_spiral(np.sqrt(np.interp(order / count, np.append(0, np.cumsum(profile)), edges**2)), order)


def harmonic_shares(
    points: Float64[np.ndarray, "point 2"],
    profile: Float64[np.ndarray, " bin"],
    harmonics: Float64[np.ndarray, "order bin"],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The cosine and the sine of each harmonic at points of `sample_profile`, relative to the profile there."""
    bins = np.minimum((np.hypot(*points.T) * BINS).astype(int), profile.size - 1)
    ratios = np.divide(harmonics, profile, out=np.zeros_like(harmonics), where=profile > 0)
    angle = np.arctan2(*points.T[::-1])
    return [
        (ratio[bins] * np.cos(m * angle), ratio[bins] * np.sin(m * angle))
        for m, ratio in zip(HARMONICS[: len(ratios)], ratios, strict=True)
    ]


def render_harmonics(
    profile: Float64[np.ndarray, " bin"],
    harmonics: Float64[np.ndarray, "order bin"],
    size: int,
    parts: float | int = 1,
) -> Float64[np.ndarray, "wave row column"]:
    """Kernels of a core's harmonics on such pixels as `render_kernel`'s, for each order a cosine's and a sine's."""
    points = sample_profile(profile, _SAMPLES // 8)
    points = np.concatenate([points * sign for sign in np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])])
    points = np.concatenate([points, points[:, ::-1]])
    column, row = np.floor(parts * points + size / 2).astype(int).T
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    place = (row * size + column)[inside]
    waves = [wave for both in harmonic_shares(points, profile, harmonics) for wave in both]
    kernels = [np.bincount(place, wave[inside], size * size) / len(points) for wave in waves]
    return np.reshape(kernels, (len(waves), size, size))


def narrow_kernel(kernel: Float64[np.ndarray, "row column"], variance: float) -> Float64[np.ndarray, "row column"]:
    """Subtract a variance in squared pixels, each way, from a kernel; what would be negative is zero."""
    kernel = np.maximum(sharpen(kernel, variance), 0)
    return kernel / kernel.sum()


def sharpen(
    kernels: Float64[np.ndarray, "*wave row column"], variance: float
) -> Float64[np.ndarray, "*wave row column"]:
    """Subtract a variance in squared pixels, each way, from kernels that may be negative."""
    for axis in (-2, -1):
        around = np.roll(kernels, 1, axis) + np.roll(kernels, -1, axis)
        kernels = kernels - variance / 2 * (around - 2 * kernels)
    return kernels
