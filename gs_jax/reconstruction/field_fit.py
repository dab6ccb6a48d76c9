"""A low-rank model of PSFs that were measured over the field.

The PSFs are moved to the middle, decomposed by an SVD, and the coefficients of the components are interpolated over the
field by thin-plate splines (Yanny et al., Light Sci. Appl. 9, 171, 2020). Where a source's image is follows from its
place by an affine map, which is fitted to the PSFs' cross-correlations: no scale or orientation has to be known.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from ..base.errors import input_error
from ..linear.measured_psf import FieldConvolutionOperator, middle, scene_size
from ..solvers.richardson_lucy import hat_functions
from .inverse_problem import subtract_offset

# Default error of the decomposition, relative to the PSFs' RMS.
MAX_ERROR = 0.05
# An affine map and one more place, so that a wrong one is noticed.
_LEAST_PLACES = 4
# Nodes of weights each way; between them weights are bilinear.
_NODES = 48


class FieldFit(NamedTuple):
    """Operator of PSFs measured over the field, and how well it describes them.

    Parameters
    ----------
    operator
        Of all planes.
    depths
        The planes' depths, mm, NaN if unknown.
    rank
        Number of components.
    error
        RMS error of the components, relative to the PSFs.
    left_out_error
        The same of each PSF, predicted from those at other places, or from the nearest where these are on a line: what
        to expect between places.
    place_error
        RMS distance between the images of the sources and the affine map of their places, pixels.
    """

    operator: FieldConvolutionOperator
    depths: Float[np.ndarray, " depth"]
    rank: int
    error: float
    left_out_error: float
    place_error: float


def fit_field(
    psfs: Num[np.ndarray, "source high wide"],
    places: Float[np.ndarray, "place 3"],
    image_shape: tuple[int, int],
    *,
    max_error: float = MAX_ERROR,
) -> FieldFit:
    """Fit a low-rank model to PSFs that were measured over the field, for each depth.

    *Host.*

    Parameters
    ----------
    psfs
        Images of a point at each place, at one exposure; its light should lie on the sensor.
    places
        `(x, y, z)` of the points, mm. Sources at the same z are of one plane; z may be NaN for all.
    image_shape
        `(rows, columns)` of the captures.
    max_error
        As many components are kept as leave at most this RMS error, relative to the PSFs.

    Raises
    ------
    InputError
        If places and PSFs do not match, x or y is unknown, a plane has less than four places or all on a line, or a
        PSF is dark.
    """
    if len(places) != len(psfs):
        raise input_error("places", f"one for each PSF, {len(psfs)} in all", f"{len(places)}")
    if not np.isfinite(places[:, :2]).all():
        raise input_error("places", "known in x and y", "an empty cell")
    depths = np.unique(places[:, 2])
    planes = [
        _Plane(psfs[same], places[same, :2], image_shape, max_error, depth)
        for depth in depths
        for same in [(places[:, 2] == depth) | (np.isnan(places[:, 2]) & np.isnan(depth))]
    ]
    rank = max(plane.rank for plane in planes)
    kernels, weights = zip(*(plane.components(rank) for plane in planes), strict=True)
    errors = (np.array([getattr(p, name) for p in planes]) for name in ("error", "left_out_error", "place_error"))
    error, left_out, place = (float(np.sqrt((values**2).mean())) for values in errors)
    operator = FieldConvolutionOperator(np.stack(kernels), np.stack(weights), image_shape)
    return FieldFit(operator, depths, rank, error, left_out, place)


class _Plane:
    """The decomposition of one plane."""

    def __init__(self, psfs, places, image_shape, max_error, depth):
        where = "" if np.isnan(depth) else f" at z = {depth:g} mm"
        if len(psfs) < _LEAST_PLACES:
            raise input_error(f"places{where}", f"{_LEAST_PLACES} or more", f"{len(psfs)}")
        spots = np.stack([subtract_offset(np.asarray(psf, np.float32)) for psf in psfs])
        if not (spots.sum((1, 2)) > 0).all():
            raise input_error(f"psf{where}", "the image of a point", "no light above the darkest percent")
        spots /= spots.sum((1, 2)).mean()
        self.image_shape = image_shape
        self.positions, self.place_error = _positions(spots, places, where)
        aligned = np.stack([_moved(spot, -at) for spot, at in zip(spots, self.positions, strict=True)])
        self.shape = aligned.shape[1:]
        left, values, self.kernels = np.linalg.svd(aligned.reshape(len(psfs), -1), full_matrices=False)
        # Of the first components, all together.
        rest = np.sqrt(np.maximum(1 - np.cumsum(values**2) / np.sum(values**2), 0))
        self.rank = int(np.argmax(rest <= max_error)) + 1
        self.error, self.coefficients = float(rest[self.rank - 1]), left * values
        self.left_out_error = self._left_out()

    def _left_out(self):
        """Error of each PSF's coefficients by those of the others, relative to all.

        Others on a line do not tell how the PSF changes across it: the nearest of them then stands for it.
        """
        count, total = len(self.positions), 0.0
        for source in range(count):
            others = np.arange(count) != source
            positions, values = self.positions[others], self.coefficients[others, : self.rank]
            if _spans(positions):
                at = np.clip(self.positions[source], positions.min(0), positions.max(0))
                predicted = _interpolate(positions, values, at[None])[0]
            else:
                predicted = values[np.argmin(((positions - self.positions[source]) ** 2).sum(1))]
            total += np.sum((predicted - self.coefficients[source, : self.rank]) ** 2)
        return float(np.hypot(np.sqrt(total / np.sum(self.coefficients**2)), self.error))

    def components(self, rank):
        """Kernels `(component, high, wide)` and weights `(component, tall, wide)`, filled up with zeros."""
        tall, wide = scene_size(self.image_shape, self.shape)
        origin = [
            part.start + n // 2
            for part, n in zip(middle(self.image_shape, (tall, wide)), self.image_shape, strict=True)
        ]
        nodes = [np.linspace(0, n - 1, min(_NODES, n)) for n in (tall, wide)]
        grid = np.stack(np.meshgrid(*nodes, indexing="ij"), -1) - origin
        # Nothing is known beyond the outermost places: the PSF there is the nearest one's.
        grid = np.clip(grid.reshape(-1, 2), self.positions.min(0), self.positions.max(0))
        coarse = _interpolate(self.positions, self.coefficients[:, : self.rank], grid)
        coarse = coarse.T.reshape(self.rank, *map(len, nodes))
        down, across = (np.asarray(hat_functions(n, min(_NODES, n), float)) for n in (tall, wide))
        weights = np.zeros((rank, tall, wide), np.float32)
        weights[: self.rank] = down @ coarse @ across.T
        kernels = np.zeros((rank, *self.shape), np.float32)
        kernels[: self.rank] = self.kernels[: self.rank].reshape(-1, *self.shape)
        return kernels, weights


def _positions(spots, places, where):
    """Where sources are imaged, `(row, column)` from the image of one at (0, 0), and the RMS error of that, pixels."""
    transform, inverse = np.fft.rfft2, np.fft.irfft2
    central = int(np.argmin(((places - places.mean(0)) ** 2).sum(1)))
    size = [2 * n for n in spots.shape[1:]]
    spectrum = transform(spots[central], size).conj()
    shifts = []
    for spot in spots:
        peak = np.unravel_index(np.argmax(inverse(transform(spot, size) * spectrum, size)), size)
        shifts.append([(at + n // 2) % n - n // 2 for at, n in zip(peak, size, strict=True)])
    basis = np.column_stack([places, np.ones(len(places))])
    if not _spans(places):
        raise input_error(f"places{where}", "not all on one line", f"{len(places)} on a line or at the same place")
    affine = np.linalg.lstsq(basis, np.array(shifts, float), rcond=None)[0]
    away = basis @ affine - shifts
    return places @ affine[:2], float(np.sqrt((away**2).sum(1).mean()))


def _spans(points):
    """Whether points span a plane."""
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return len(points) > 2 and values[1] > 1e-6 * values[0]


def _moved(spot, shift):
    """An image moved by a part of its size, bilinear; what leaves it is lost."""
    from scipy.ndimage import shift as move

    return move(spot, shift, order=1)


def _interpolate(places, values, at):
    from scipy.interpolate import RBFInterpolator

    return RBFInterpolator(places, values, kernel="thin_plate_spline")(at)
