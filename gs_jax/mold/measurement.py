"""Measurement of the lenslets of a mesh: centres, radii, conic constants, and the optical effect of the facets.

Molds and arrays are measured alike, both in the frame of the part. Lengths in mm.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..microscope.geometry import Imager
from .export import Mesh
from .lenslets import NODES, WEIGHTS, Lenslet, Part, surface_height

# A facet belongs to a lenslet if its corners are this close to the surface, its normal is this well aligned, and the
# lenslet is higher than others by this margin: near a groove, facets are ambiguous.
_MAX_DISTANCE, _MIN_ALIGNMENT, _MARGIN = 0.02, math.cos(math.radians(20)), 2e-3
# Of low lenses distance and margin are at most these parts of the height.
_DISTANCE_PART, _MARGIN_PART = 1.0, 0.05
# Four unknowns and two to check them; with a free conic constant, enough that scatter is no shape.
_MIN_VERTICES, _MIN_CONIC_VERTICES = 6, 12
# RMS rounding error of float32 coordinates around 10 mm.
_ROUNDING = 3e-7
# Least height of a conic's surface over its middle, in radii of curvature, in its derivatives.
_LEAST_ROOT = 1e-3
# Vertices are outliers beyond this multiple of the median distance.
_OUTLIER = 10
# Largest standard deviations of what is reported: of conic constants; of centres, mm, and relative radii.
_MAX_CONIC_DEVIATION, _MAX_DEVIATION = 0.1, 3e-4


@dataclass(frozen=True)
class LensletMeasurement:
    """Lenslets of a mesh, one entry each; NaN where there are too few vertices. Lengths in mm, angles in radians.

    `center`, `radius` and the RMS distance of the vertices, `misfit`, are of the best-fit surface with the conic
    constant of the design. `conic` is that of the best fit with free radius, and `conic_deviation` its standard
    deviation from the scatter and rounding of the vertices. The effect of a conic constant is `r^4 / (8 R^3)`, so small
    apertures determine it poorly: NaN above 0.1. `offset` is the mean distance of the facets outside the design's
    surface, `surface_rms` the RMS of the remainder, and `slope_rms` the RMS angle between facets and surface.
    `vertices` counts those that belong to the lenslet alone.
    """

    center: Float[np.ndarray, "lens 2"]
    radius: Float[np.ndarray, " lens"]
    misfit: Float[np.ndarray, " lens"]
    conic: Float[np.ndarray, " lens"]
    conic_deviation: Float[np.ndarray, " lens"]
    offset: Float[np.ndarray, " lens"]
    surface_rms: Float[np.ndarray, " lens"]
    slope_rms: Float[np.ndarray, " lens"]
    vertices: Int[np.ndarray, " lens"]


def measure_lenslets(mesh: Mesh, part: Part, *, scale: float = 1.0) -> LensletMeasurement:
    """Measures the lenslets of an array or of its mold.

    The mesh is in the frame of the part and `scale` times as large as the part, the design, which assigns facets to
    lenslets and gives the aspheric terms.

    Raises `ValueError` if the mesh has no facet near any lenslet.
    """
    # Depths below the plane of the vertices.
    vertices = mesh.vertices.astype(float) / scale + (0, 0, part.thickness)
    design = [_Fit(lenslet) for lenslet in part.lenslets]
    fits, _ = _fit_all(vertices, mesh.facets, design)
    # Assign facets again, in case the lenslets are not where the design has them.
    fits, owner = _fit_all(vertices, mesh.facets, fits)
    facets = _group(owner, len(design))
    errors = [_facet_errors(vertices[mesh.facets[its]], fit) for its, fit in zip(facets, design, strict=True)]
    offset, surface_rms, slope_rms = np.array(errors).T
    rows = [(*fit.lenslet.center, fit.lenslet.radius, fit.misfit, fit.conic, fit.conic_deviation) for fit in fits]
    determined = np.array([[fit.determined] for fit in fits])
    x, y, radius, misfit, conic, conic_deviation = np.where(determined, rows, np.nan).T
    return LensletMeasurement(
        center=np.stack([x, y], axis=1),
        radius=radius,
        misfit=misfit,
        conic=np.where(conic_deviation <= _MAX_CONIC_DEVIATION, conic, np.nan),
        conic_deviation=conic_deviation,
        offset=offset,
        surface_rms=surface_rms,
        slope_rms=slope_rms,
        vertices=np.array([fit.vertices for fit in fits]),
    )


@dataclass(frozen=True)
class _Fit:
    """A fitted lenslet; `vertex` is the depth of its vertex below the design's."""

    lenslet: Lenslet
    vertex: float = 0.0
    misfit: float = math.nan
    conic: float = math.nan
    conic_deviation: float = math.nan
    vertices: int = 0
    determined: bool = False


def _fit_all(vertices, facets, fits: list[_Fit]) -> tuple[list[_Fit], np.ndarray]:
    """Fits all lenslets to the vertices near the given ones; also returns the lenslet of each facet, -1 for none."""
    owner = _assign(vertices[facets], fits)
    if (owner < 0).all():
        raise ValueError("`mesh` has no facet near any lens of the array.")
    # Vertices between lenslets belong to facets of both, those on a rim also to the plate: neither are on a surface.
    lowest, highest = np.full(len(vertices), len(fits)), np.full(len(vertices), -1)
    np.minimum.at(lowest, facets, owner[:, None])
    np.maximum.at(highest, facets, owner[:, None])
    groups = _group(np.where(lowest == highest, highest, -1), len(fits))
    return [_fit(fit, vertices[its]) for fit, its in zip(fits, groups, strict=True)], owner


def _group(owner, count: int) -> list[np.ndarray]:
    """The indices of the entries of each owner."""
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(count + 1))
    return [order[first:last] for first, last in zip(ends, ends[1:], strict=False)]


def _assign(corners, fits: list[_Fit]):
    middle, height = corners.mean(axis=1), max(fit.lenslet.rim_sag for fit in fits)
    margin, most = min(_MARGIN, _MARGIN_PART * height), min(_MAX_DISTANCE, _DISTANCE_PART * height)
    _, owner = surface_height([fit.lenslet for fit in fits], middle[:, :2], margin)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for its, fit in zip(_group(owner, len(fits)), fits, strict=True):
        distance = np.abs(_distance(corners[its], fit)[0]).max(axis=1)
        _, expected = _distance(middle[its], fit)
        cosine = np.abs((normal[its] * expected).sum(axis=1))
        aligned = cosine > _MIN_ALIGNMENT * np.linalg.norm(normal[its], axis=1)
        owner[its[~(aligned & (distance < most))]] = -1
    return owner


def _distance(points, fit: _Fit):
    """Distance of points outside a surface, to first order, and its normal there; lenslets face -z."""
    spoke = points[..., :2] - fit.lenslet.center
    squared = np.minimum((spoke**2).sum(axis=-1), fit.lenslet.semi_aperture**2)
    slope_over_r = fit.lenslet.sag_slope_over_r(squared)[..., None]
    normal = np.concatenate([slope_over_r * spoke, -np.ones_like(slope_over_r)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return (points[..., 2] - fit.vertex - fit.lenslet.sag(squared)) * normal[..., 2], normal


def _fit(fit: _Fit, points) -> _Fit:
    """Fits a surface to points by Gauss-Newton, with outliers removed."""
    fit = _Fit(fit.lenslet, fit.vertex, vertices=len(points))
    if len(points) < _MIN_VERTICES:
        return fit
    # Where facets of two lenslets intersect in slivers, vertices may be assigned wrongly. Iteratively reweighted
    # least squares minimises absolute distances, which such outliers do not affect.
    for _ in range(8):
        fit = _gauss_newton(fit, points, 4, weight=1 / np.sqrt(np.abs(_distance(points, fit)[0]) + _ROUNDING))
    distance = np.abs(_distance(points, fit)[0])
    points = points[distance <= _OUTLIER * np.median(distance) + _ROUNDING]
    for _ in range(3):
        fit = _gauss_newton(fit, points, 4)
    residual, jacobian = _linearize(fit, points)
    fit = replace(fit, vertices=len(points))
    if not np.isfinite(jacobian).all():
        return fit
    misfit = float(np.sqrt((residual**2).mean()))
    x, y, _, radius = _deviations(jacobian[:, :4], misfit)
    determined = bool(max(x, y, radius / fit.lenslet.radius) < _MAX_DEVIATION)
    fit = replace(fit, misfit=misfit, determined=determined)
    few = len(points) < _MIN_CONIC_VERTICES
    if not determined or few or _deviations(jacobian, 0.0)[-1] > _MAX_CONIC_DEVIATION:
        return fit
    free = fit
    for _ in range(6):
        free = _gauss_newton(free, points, 5)
    residual, jacobian = _linearize(free, points)
    # With one more unknown a fit that has converged is no worse.
    if not float(np.sqrt((residual**2).mean())) <= misfit + _ROUNDING:
        return fit
    scatter = math.sqrt((residual**2).sum() / max(len(points) - 5, 1))
    return replace(fit, conic=free.lenslet.conic, conic_deviation=float(_deviations(jacobian, scatter)[-1]))


def _gauss_newton(fit: _Fit, points, unknowns: int, weight=1.0) -> _Fit:
    """One step in centre, vertex, radius and, as the fifth unknown, conic constant."""
    residual, jacobian = _linearize(fit, points)
    if not np.isfinite(jacobian).all():  # a step before this one went far beyond all lenses
        return fit
    weighted = (jacobian[:, :unknowns].T * weight).T
    x, y, vertex, radius, conic = (*np.linalg.lstsq(weighted, weight * residual, rcond=1e-12)[0], 0.0)[:5]
    lens = fit.lenslet
    lens = replace(lens, center=lens.center + (x, y), radius=lens.radius + radius, conic=lens.conic + conic)
    return replace(fit, lenslet=lens, vertex=fit.vertex + vertex)


def _linearize(fit: _Fit, points):
    """Distances of points outside, and their negative derivatives with respect to the five unknowns."""
    lens = fit.lenslet
    residual, normal = _distance(points, fit)
    squared = np.minimum(((points[:, :2] - lens.center) ** 2).sum(axis=1), lens.semi_aperture**2)
    # A step on the way may be a conic that ends within the lens.
    root = np.sqrt(np.maximum(lens.radius**2 - (1 + lens.conic) * squared, (_LEAST_ROOT * lens.radius) ** 2))
    by_radius = -squared / (root * (lens.radius + root))
    by_conic = squared**2 / (2 * root * (lens.radius + root) ** 2)
    return residual, np.column_stack([normal, normal[:, 2] * by_radius, normal[:, 2] * by_conic])


def _deviations(jacobian, scatter: float):
    """Standard deviations of the unknowns for points with this scatter, at least their rounding."""
    variances = np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-15, hermitian=True))
    return max(scatter, _ROUNDING) * np.sqrt(np.maximum(variances, 0))


def _facet_errors(corners, design: _Fit) -> tuple[float, float, float]:
    """Mean and RMS of the facets' distance outside the design's surface, and their RMS slope against it."""
    if not len(corners):
        return math.nan, math.nan, math.nan
    error, expected = _distance(np.einsum("qk,fkx->fqx", NODES, corners), design)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Weighted by the projected area, as light travels along the axis.
    area = np.abs(normal[:, 2])
    cosine = np.abs((expected * normal[:, None]).sum(axis=2)) / np.linalg.norm(normal, axis=1)[:, None]

    def mean(values) -> float:
        return float(area @ (values @ WEIGHTS) / area.sum())

    offset = mean(error)
    return offset, math.sqrt(mean((error - offset) ** 2)), math.sqrt(mean(2 * (1 - np.minimum(cosine, 1))))


def summarize(measured: LensletMeasurement, imager: Imager) -> dict[str, Any]:
    """Deviations of a measurement from the design, and their optical effect, for a JSON file.

    A surface error `e` delays light by `(n - 1) e`. The Strehl ratio `exp(-(2 pi sigma / lambda)^2)`, Marechal's
    approximation for sigma below 0.1 waves, is that of the facets alone, without the aberrations of the lens.
    """
    part, wavelength, sensor_distance = Part(imager.array), float(imager.wavelength), imager.reduced_sensor_distance
    power = float(part.array.refractive_index) - 1
    shift = np.linalg.norm(measured.center - part.centers, axis=1)
    radius_error = measured.radius / [lenslet.radius for lenslet in part.lenslets] - 1
    conic_error = measured.conic - [lenslet.conic for lenslet in part.lenslets]
    waves = power * measured.surface_rms / wavelength
    strehl = np.exp(-((2 * np.pi * waves) ** 2))
    known = np.isfinite(measured.radius)

    def worst(values) -> float:
        return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else math.nan

    def rms(values) -> float:
        return float(np.sqrt(np.nanmean(values**2)))

    return {
        "lenses": len(shift),
        "lenses_measured": int(known.sum()),
        "lenses_not_measured": (np.flatnonzero(~known) + 1).tolist(),
        "center_deviation_max_um": 1000 * worst(shift),
        "radius_deviation_max_percent": 100 * worst(radius_error),
        "lenses_conic_measured": int(np.isfinite(measured.conic).sum()),
        "conic_deviation_max": worst(conic_error),
        "conic_uncertainty_max": worst(np.where(np.isfinite(conic_error), measured.conic_deviation, np.nan)),
        "surface_misfit_max_um": 1000 * worst(measured.misfit),
        "surface_offset_max_um": 1000 * worst(measured.offset),
        "surface_error_rms_um": 1000 * rms(measured.surface_rms),
        "slope_error_rms_mrad": 1000 * rms(measured.slope_rms),
        "ray_error_on_sensor_rms_um": 1000 * power * float(sensor_distance) * rms(measured.slope_rms),
        "wavefront_error_rms_waves": rms(waves),
        "strehl_of_facets_median": float(np.nanmedian(strehl)),
        "strehl_of_facets_worst": float(np.nanmin(strehl)),
        "surface_error_for_strehl_0.8_um": 1000 * wavelength * math.sqrt(-math.log(0.8)) / (2 * math.pi * power),
    }
