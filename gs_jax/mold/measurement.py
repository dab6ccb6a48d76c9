"""What was written is read back: where its lenses are, how they are curved, and what facets do to light.

Lengths in mm. A mold and an array are measured alike, both are in the part's frame.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..geometry import Imager
from ..lenses import MicrolensArray
from .export import Mesh
from .lenslets import NODES, WEIGHTS, Cap, caps_of, part_centers, surface

# A facet belongs to a lens if its corners are so close to the lens's surface and its normal so close to the surface's.
_NEAR = 0.02
_ALIGNED = math.cos(math.radians(20))
# And if the lens is higher than all others by more than this: about a groove a facet may be either's.
_CLEARLY = 2e-3
# Five unknowns, and one more to see that they fit.
_FEWEST = 6
# Coordinates of float32 some 10 mm from the origin are rounded by so much, RMS.
_ROUNDED = 3e-7
# A vertex is no lens's if it is so many times as far off as the median.
_ASTRAY = 10
# A conic constant that vertices determine less well is not reported.
_MOST_UNCERTAIN = 0.1
# Nor is a lens whose centre, mm, or radius, as a fraction, they determine less well than this.
_UNCERTAIN = 3e-4


@dataclass(frozen=True)
class Verification:
    """What the lenses of a mesh are, one entry a lens; NaN where a lens has too few vertices to be measured.

    Parameters
    ----------
    center
        Axis of the surface that fits the vertices best, with the design's conic constant, `(x, y)`, mm.
    radius
        Radius of curvature of that surface, mm.
    misfit
        Root mean square distance of the vertices from it, mm.
    conic, conic_deviation
        The conic constant that fits best, the radius being free too, and its standard deviation, as the vertices'
        scatter and their rounding leave it: `r^4 / (8 R^3)` is all that it changes, so little apertures say little. NaN
        where the deviation is above 0.1.
    offset, surface_rms
        Mean distance of the facets outside the design's surface, and what is left of it, root mean square, mm.
    slope_rms
        Root mean square angle between a facet and the design's surface, radians.
    vertices
        How many were measured: those of one lens alone.
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


def verify(mesh: Mesh, array: MicrolensArray, *, scale: float = 1.0) -> Verification:
    """Measures the lenses of an array or of its mold.

    Parameters
    ----------
    mesh
        As read back, in the part's frame.
    array
        What it should be: tells which facets are whose, and the aspheric terms.
    scale
        By how much the mesh is larger than the array, `MoldShape.scale` for a mold.

    Raises
    ------
    ValueError
        If the mesh has no facet near any lens.
    """
    # Depths below the vertices' plane.
    vertices = mesh.vertices.astype(float) / scale + (0, 0, float(array.substrate_thickness))
    design = [_Found(cap) for cap in caps_of(array)]
    # The second look starts from where the lenses were found, in case that is not where they should be.
    found, _ = _look(vertices, mesh.facets, design)
    found, lens = _look(vertices, mesh.facets, found)
    facets = _by_lens(lens, len(design))
    measured = [_errors(vertices[mesh.facets[its]], was.cap) for its, was in zip(facets, design, strict=True)]
    offset, surface_rms, slope_rms = np.array(measured).T
    known = np.array([1.0 if its.determined else np.nan for its in found])
    values = lambda name: np.array([getattr(its, name) for its in found], float) * known
    certain = np.where(values("conic_deviation") <= _MOST_UNCERTAIN, 1.0, np.nan)
    return Verification(
        center=np.stack([its.cap.center for its in found]) * known[:, None],
        radius=np.array([its.cap.radius for its in found]) * known,
        misfit=values("misfit"),
        conic=values("conic") * certain,
        conic_deviation=values("conic_deviation"),
        offset=offset,
        surface_rms=surface_rms,
        slope_rms=slope_rms,
        vertices=np.array([its.vertices for its in found]),
    )


@dataclass(frozen=True)
class _Found:
    """A lens, the sag of its vertex below where the design has it, and how well how many mesh vertices fit it."""

    cap: Cap
    vertex: float = 0.0
    misfit: float = math.nan
    conic: float = math.nan
    conic_deviation: float = math.nan
    vertices: int = 0
    determined: bool = False


def _look(vertices, facets, lenses: list[_Found]) -> tuple[list[_Found], np.ndarray]:
    """The surfaces through the vertices that are close to others, and the lens of each facet, -1 for none."""
    lens = _belonging(vertices[facets], lenses)
    if (lens < 0).all():
        raise ValueError(f"`mesh` has no facet within {_NEAR} mm of any lens of the array.")
    # Vertices of two lenses lie where facets of both meet, those on a rim are as much the plate's: on no surface.
    least, most = np.full(len(vertices), len(lenses)), np.full(len(vertices), -1)
    np.minimum.at(least, facets, lens[:, None])
    np.maximum.at(most, facets, lens[:, None])
    of_lens = _by_lens(np.where(least == most, most, -1), len(lenses))
    return [_fit(its, vertices[points]) for its, points in zip(lenses, of_lens, strict=True)], lens


def _by_lens(lens, count: int) -> list[np.ndarray]:
    """Which of them are each lens's."""
    order = np.argsort(lens, kind="stable")
    ends = np.searchsorted(lens[order], np.arange(count + 1))
    return [order[first:last] for first, last in zip(ends, ends[1:], strict=False)]


def _belonging(corners, lenses: list[_Found]):
    """The lens of each facet, -1 for none."""
    middle = corners.mean(axis=1)
    _, lens = surface([its.cap for its in lenses], middle[:, :2], _CLEARLY)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for here, its in zip(_by_lens(lens, len(lenses)), lenses, strict=True):
        off = np.abs(_outside(corners[here], its)[0]).max(axis=1)
        _, upright = _outside(middle[here], its)
        aligned = np.abs((normal[here] * upright).sum(axis=1)) > _ALIGNED * np.linalg.norm(normal[here], axis=1)
        lens[here[~(aligned & (off < _NEAR))]] = -1
    return lens


def _outside(points, its: _Found):
    """How far points are outside a lens's surface, to first order, and the surface's normal there.

    Points are `(x, y, z)` over the vertices' plane, and lenses look toward -z.
    """
    spoke = points[..., :2] - its.cap.center
    squared = np.minimum((spoke**2).sum(axis=-1), its.cap.reach**2)
    steep = its.cap.sag_slope_over_r(squared)[..., None]
    normal = np.concatenate([steep * spoke, -np.ones_like(steep)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return (points[..., 2] - its.vertex - its.cap.sag(squared)) * normal[..., 2], normal


def _fit(its: _Found, points) -> _Found:
    """The surface through points: least squares of their distances, by Gauss and Newton."""
    if len(points) < _FEWEST:
        return replace(its, vertices=len(points), determined=False)
    # Where facets of two lenses cut each other in slivers, a vertex may seem one lens's. Least absolute distances,
    # by least squares that are weighted anew, do not follow such vertices; then they are left out.
    for _ in range(8):
        its = _step(its, points, 4, weight=1 / np.sqrt(np.abs(_outside(points, its)[0]) + _ROUNDED))
    off = np.abs(_outside(points, its)[0])
    points = points[off <= _ASTRAY * np.median(off) + _ROUNDED]
    for _ in range(3):
        its = _step(its, points, 4)
    residual, gradient = _gradient(its, points)
    misfit = float(np.sqrt((residual**2).mean()))
    x, y, _, radius = _deviations(gradient[:, :4], misfit)
    determined = bool(max(x, y, radius / its.cap.radius) < _UNCERTAIN)
    its = replace(its, misfit=misfit, conic=math.nan, vertices=len(points), determined=determined)
    if not determined or _deviations(gradient, 0.0)[-1] > _MOST_UNCERTAIN:
        return replace(its, conic_deviation=math.nan)
    free = its
    for _ in range(6):
        free = _step(free, points, 5)
    residual, gradient = _gradient(free, points)
    scatter = math.sqrt((residual**2).sum() / max(len(points) - 5, 1))
    return replace(its, conic=free.cap.conic, conic_deviation=float(_deviations(gradient, scatter)[-1]))


def _step(its: _Found, points, unknowns: int, weight=1.0) -> _Found:
    """Of centre, vertex, radius and, the fifth, conic constant."""
    residual, gradient = _gradient(its, points)
    weighted = (gradient[:, :unknowns].T * weight).T
    x, y, vertex, radius, conic = (*np.linalg.lstsq(weighted, weight * residual, rcond=1e-12)[0], 0.0)[:5]
    cap = its.cap
    cap = replace(cap, center=cap.center + (x, y), radius=cap.radius + radius, conic=cap.conic + conic)
    return replace(its, cap=cap, vertex=its.vertex + vertex)


def _gradient(its: _Found, points):
    """How far points are outside, and by how much less that is for each of the five unknowns."""
    cap = its.cap
    residual, normal = _outside(points, its)
    squared = np.minimum(((points[:, :2] - cap.center) ** 2).sum(axis=1), cap.reach**2)
    root = np.sqrt(cap.radius**2 - (1 + cap.conic) * squared)
    by_radius = -squared / (root * (cap.radius + root))
    by_conic = squared**2 / (2 * root * (cap.radius + root) ** 2)
    return residual, np.column_stack([normal, normal[:, 2] * by_radius, normal[:, 2] * by_conic])


def _deviations(gradient, scatter: float):
    """Standard deviations of the unknowns, if points scatter as they do, or at least by their rounding."""
    variances = np.diag(np.linalg.pinv(gradient.T @ gradient, rcond=1e-15, hermitian=True))
    return max(scatter, _ROUNDED) * np.sqrt(np.maximum(variances, 0))


def _errors(corners, cap: Cap) -> tuple[float, float, float]:
    """Mean and spread of the facets' distance outside the design's surface, and their slope against it."""
    if not len(corners):
        return math.nan, math.nan, math.nan
    error, upright = _outside(np.einsum("qk,fkx->fqx", NODES, corners), _Found(cap))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Light comes along the axis: a facet counts as much as its shadow.
    area = np.abs(normal[:, 2])
    cosine = np.abs((upright * normal[:, None]).sum(axis=2)) / np.linalg.norm(normal, axis=1)[:, None]
    mean = lambda values: float(area @ (values @ WEIGHTS) / area.sum())
    offset = mean(error)
    return offset, math.sqrt(mean((error - offset) ** 2)), math.sqrt(mean(2 * (1 - np.minimum(cosine, 1))))


def quality(found: Verification, imager: Imager) -> dict[str, Any]:
    """A verification in numbers for a JSON file: deviations from the design, and what they do to the light.

    A surface that is off by `e` delays light by `(n - 1) e`; the Strehl ratio `exp(-(2 pi sigma / lambda)^2)`
    (Marechal's approximation, good below about 0.1 waves) is that of the part in the smooth lens's: aberrations of the
    lens itself are not in it.

    Parameters
    ----------
    found
        Of the file.
    imager
        The design's.
    """
    array, wavelength, sensor_distance = imager.array, float(imager.wavelength), float(imager.reduced_sensor_distance)
    bend = float(array.refractive_index) - 1
    shift = np.linalg.norm(found.center - part_centers(array), axis=1)
    larger = found.radius / np.asarray(array.radius_of_curvature, float) - 1
    bent = found.conic - np.asarray(array.conic_constant, float)
    waves = bend * found.surface_rms / wavelength
    strehl = np.exp(-((2 * np.pi * waves) ** 2))
    measured = np.isfinite(found.radius)
    worst = lambda values: float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else math.nan
    return {
        "lenses": len(shift),
        "lenses_measured": int(measured.sum()),
        "lenses_not_measured": (np.flatnonzero(~measured) + 1).tolist(),
        "center_deviation_max_um": 1000 * worst(shift),
        "radius_deviation_max_percent": 100 * worst(larger),
        "lenses_conic_measured": int(np.isfinite(found.conic).sum()),
        "conic_deviation_max": worst(bent),
        "conic_uncertainty_max": worst(np.where(np.isfinite(bent), found.conic_deviation, np.nan)),
        "surface_misfit_max_um": 1000 * worst(found.misfit),
        "surface_offset_max_um": 1000 * worst(found.offset),
        "surface_error_rms_um": 1000 * _mean_square(found.surface_rms),
        "slope_error_rms_mrad": 1000 * _mean_square(found.slope_rms),
        "ray_error_on_sensor_rms_um": 1000 * bend * sensor_distance * _mean_square(found.slope_rms),
        "wavefront_error_rms_waves": _mean_square(waves),
        "strehl_of_facets_median": float(np.nanmedian(strehl)),
        "strehl_of_facets_worst": float(np.nanmin(strehl)),
        "surface_error_for_strehl_0.8_um": 1000 * wavelength * math.sqrt(-math.log(0.8)) / (2 * math.pi * bend),
    }


def _mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
