"""Wiener filter: a linear deconvolution by one PSF in a second, as a preview and as a baseline."""

import numpy as np
from jaxtyping import Float, Float32

from ..projection.measured_psf import middle, scene_size

# Share of an edge within which images fade out.
_TAPER = 0.05
# Ratios of noise to signal that are tried, relative to the largest power of the PSF.
_RATIOS = np.geomspace(1e-7, 1e-1, 25)


def filter_by_wiener(
    light: Float32[np.ndarray, "row column"], psf: Float[np.ndarray, "high wide"]
) -> tuple[Float32[np.ndarray, "row column"], float]:
    """Deconvolve a capture by one PSF with a Wiener filter; return the scene, and the ratio of noise to signal.

    The ratio, which is the same at all frequencies, is chosen by generalised cross-validation (Golub, Heath and Wahba,
    Technometrics 21, 215, 1979). Negative values are set to 0. Light from beyond the sensor's edges is not modelled.
    """
    from scipy import fft

    size = scene_size(light.shape, psf.shape)
    light, psf = (_tapered(a) for a in (light, psf))
    image, spot = np.zeros(size, np.float32), np.zeros(size, np.float32)
    image[middle(light.shape, size)] = light
    spot[: psf.shape[0], : psf.shape[1]] = psf
    spot = np.roll(spot, [-(k // 2) for k in psf.shape], (0, 1))
    seen, transfer = (np.asarray(fft.rfft2(a, workers=-1)) for a in (image, spot))
    power = np.abs(transfer) ** 2
    energy, peak = np.abs(seen) ** 2, power.max()

    def score(ratio):
        """Sum of squared residuals over the squared number of degrees of freedom that are left."""
        left = ratio / (power / peak + ratio)
        return float(np.mean(left**2 * energy) / np.mean(left) ** 2)

    ratio = min(_RATIOS, key=score)
    scene = np.asarray(fft.irfft2(seen * transfer.conj() / (power + ratio * peak), size, workers=-1))
    return np.maximum(scene[middle(light.shape, size)], 0).astype(np.float32), float(ratio)


def _tapered(image):
    """An image that fades out at its edges: a cut would be taken for detail, and leave bright lines."""
    rows, columns = (np.minimum(1, (np.arange(n) + 0.5) / (_TAPER * n)).astype(np.float32) for n in image.shape)
    return image * np.minimum(rows, rows[::-1])[:, None] * np.minimum(columns, columns[::-1])
