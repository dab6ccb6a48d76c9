"""Quality of a reconstruction: volumes and points against the truth. Host code."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity

from .base.arrays import host_code

# Axes without names: the two arguments of a score need not have the same.
Volume = Float[Array | np.ndarray, "_ _ _"]
Points = Float[Array | np.ndarray, "_ _"]


class Quality(NamedTuple):
    """Scores of a volume: PSNR in dB, SSIM (mean over planes), MSE, and the gain fitted before."""

    psnr_db: float
    ssim: float
    mse: float
    gain: float


@host_code()
def quality(estimate: Volume, truth: Volume) -> Quality:
    """PSNR, SSIM and MSE of a volume, after the scalar gain that fits it best.

    *Host.*

    Reconstructions have no absolute scale: the estimate is first multiplied by the gain of least MSE,
    `max(<estimate, truth> / <estimate, estimate>, 0)`. The data range is the truth's largest value. SSIM is the mean
    over planes (7 x 7 window, uniform, as in scikit-image). On sparse volumes zeros score well: compare with that
    score.

    Parameters
    ----------
    estimate, truth
        Volumes of one shape, with planes of 7 x 7 at least; the truth is not negative, and positive somewhere.

    Raises
    ------
    ValueError
        If they are not as described.

    Examples
    --------
    >>> truth = np.zeros((3, 32, 32))
    >>> truth[1, 10:20, 12:15] = 1.0
    >>> noisy = 5 * truth + np.random.default_rng(0).normal(0, 0.1, truth.shape)
    >>> empty = 0 * truth
    >>> print(round(gs.quality(noisy, truth).psnr_db), round(gs.quality(empty, truth).psnr_db))
    34 20
    """
    a, b = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if a.shape != b.shape:
        raise ValueError(f"`estimate` must be of the truth's shape {b.shape}, got {a.shape}.")
    if not (peak := b.max()) > 0:
        raise ValueError(f"`truth` must be positive somewhere, got {peak} as its largest value.")
    energy = np.vdot(a, a)
    gain = max(float(np.vdot(a, b) / energy), 0.0) if energy > 0 else 0.0
    a = gain * a
    similar = [structural_similarity(x, y, data_range=peak) for x, y in zip(a, b, strict=True)]
    psnr = peak_signal_noise_ratio(b, a, data_range=peak) if (a != b).any() else np.inf
    return Quality(float(psnr), float(np.mean(similar)), float(mean_squared_error(a, b)), gain)


class Localization(NamedTuple):
    """Scores of points; `pairs` `(pair, 2)` are indices of found and true points that match.

    The errors are root mean squares over the pairs, mm: of the distance in the plane, and of z; NaN without a pair.
    """

    precision: float
    recall: float
    f1: float
    lateral_rmse: float
    axial_rmse: float
    pairs: np.ndarray


@host_code()
def localization(found: Points, truth: Points, *, lateral: float = 0.1, axial: float = 0.4) -> Localization:
    """Match found points with true ones, each at most once, and score them.

    *Host.*

    Of all matchings with the most pairs, the closest is taken, by the distance in units of the two limits.

    Parameters
    ----------
    found, truth
        `(point, 3 or more)`, x, y, z first, mm; either may be empty. If both are, the scores are 1.
    lateral, axial
        Largest distance of a pair in the plane and in depth, mm. The defaults are a few times the resolution of the
        paper's microscope, 0.03 and 0.3 mm; choose them for the microscope and the density of points.

    Examples
    --------
    >>> truth = np.array([[0.0, 0.0, 20.0], [1.0, 0.0, 20.0]])
    >>> found = np.array([[0.003, 0.004, 20.02], [5.0, 5.0, 20.0]])  # one is near, one is a ghost
    >>> score = gs.localization(found, truth)
    >>> print(score.precision, score.recall, round(score.lateral_rmse, 4))
    0.5 0.5 0.005
    """
    a, b = (np.asarray(p, np.float64)[:, :3] for p in (found, truth))
    pairs = _matching(a, b, lateral, axial)
    precision = len(pairs) / len(a) if len(a) else float(not len(b))
    recall = len(pairs) / len(b) if len(b) else float(not len(a))
    f1 = 2 * len(pairs) / (len(a) + len(b)) if len(a) + len(b) else 1.0
    error = a[pairs[:, 0]] - b[pairs[:, 1]]
    rms = lambda squares: float(np.sqrt(squares.mean())) if len(pairs) else float("nan")
    return Localization(precision, recall, f1, rms((error[:, :2] ** 2).sum(1)), rms(error[:, 2] ** 2), pairs)


def _matching(a: np.ndarray, b: np.ndarray, lateral: float, axial: float) -> np.ndarray:
    """Best pairs within the limits, for each connected group of near points: the groups are small."""
    near = KDTree(a[:, :2]).query_ball_tree(KDTree(b[:, :2]), lateral) if len(a) and len(b) else []
    links = [(i, j) for i, some in enumerate(near) for j in some if abs(a[i, 2] - b[j, 2]) <= axial]
    if not links:
        return np.zeros((0, 2), int)
    i, j = np.array(links).T
    size = len(a) + len(b)
    group = connected_components(coo_array((np.ones(len(i)), (i, j + len(a))), (size, size)), directed=False)[1][i]
    pairs = []
    for number in np.unique(group):
        rows, row = np.unique(i[group == number], return_inverse=True)
        columns, column = np.unique(j[group == number], return_inverse=True)
        error = (a[rows[row]] - b[columns[column]]) / (lateral, lateral, axial)
        # Two links cost 4 at most, so an impossible pair is never worth what it saves.
        cost = np.full((len(rows), len(columns)), 4.0 * (min(len(rows), len(columns)) + 1))
        cost[row, column] = (error**2).sum(1)
        best = linear_sum_assignment(cost)
        possible = cost[best] <= 2 + 1e-9
        pairs.append(np.column_stack([rows[best[0]], columns[best[1]]])[possible])
    return np.concatenate(pairs)
