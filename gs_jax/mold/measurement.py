"""What was written is read back: where its lenses are, how they are curved, and what facets do to light.

Lengths in mm. A mold and an array are measured alike, both are in the design's frame.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..geometry import Imager
from ..lenses import MicrolensArray
from .caps import cap_sag
from .mesh_files import Mesh
from .solids import plate_thickness

# A facet belongs to a lens if its corners are so close to the lens's sphere and its normal so close to the sphere's.
_NEAR = 0.02
_ALIGNED = math.cos(math.radians(20))
# Four unknowns, and one more to see that they fit.
_FEWEST = 5

# Dunavant's rule of degree 4 on a triangle: a facet's distance from a sphere is a quadratic, its square a quartic.
_NODES = np.array(
    [[1 - 2 * a if i == j else a for j in range(3)] for a in (0.445948490915965, 0.091576213509771) for i in range(3)]
)
_WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


@dataclass(frozen=True)
class Verification:
    """What the lenses of a mesh are, one entry a lens; NaN where a lens has too few vertices to be measured.

    Parameters
    ----------
    center
        Axis of the sphere that fits the vertices best, `(x, y)`, mm.
    radius
        Radius of that sphere, mm.
    misfit
        Root mean square distance of the vertices from it, mm.
    offset, surface_rms
        Mean distance of the facets outside the design's sphere, and what is left of it, root mean square, mm.
    slope_rms
        Root mean square angle between a facet and the design's sphere, radians.
    vertices
        How many were measured.
    """

    center: Float[np.ndarray, "lens 2"]
    radius: Float[np.ndarray, " lens"]
    misfit: Float[np.ndarray, " lens"]
    offset: Float[np.ndarray, " lens"]
    surface_rms: Float[np.ndarray, " lens"]
    slope_rms: Float[np.ndarray, " lens"]
    vertices: Int[np.ndarray, " lens"]


def verify(mesh: Mesh, array: MicrolensArray, *, scale: float = 1.0) -> Verification:
    """Measures the lenses of an array or of its mold.

    Parameters
    ----------
    mesh
        As read back, in the design's frame.
    array
        What it should be: tells which facets are whose.
    scale
        By how much the mesh is larger than the array, `MoldShape.scale` for a mold.

    Raises
    ------
    ValueError
        If the mesh has no facet near any lens.
    """
    vertices = mesh.vertices.astype(float) / scale
    radius = float(array.radius_of_curvature)
    sphere = np.column_stack([array.centers, np.full(len(array.centers), radius - float(array.substrate_thickness))])
    # The second look starts from where the lenses were found, in case that is not where they should be.
    fit = _look(vertices, mesh.facets, array, sphere, np.full(len(sphere), radius))
    fit = _look(vertices, mesh.facets, array, fit.center, fit.radius)
    offset, surface, slope = _facet_errors(vertices[fit.facets], fit.lens, sphere, radius)
    known = np.where(fit.count < _FEWEST, np.nan, 1.0)
    center = fit.center[:, :2] * known[:, None]
    return Verification(center, fit.radius * known, fit.misfit * known, offset, surface, slope, fit.count)


@dataclass(frozen=True)
class _Fit:
    """Spheres, how well they fit how many vertices, and the facets of each."""

    center: np.ndarray
    radius: np.ndarray
    misfit: np.ndarray
    count: np.ndarray
    facets: np.ndarray
    lens: np.ndarray


def _look(vertices, facets, array, center, radius) -> _Fit:
    """The spheres through the vertices that are close to others."""
    facets, lens = _belonging(vertices, facets, array, center, radius)
    if not len(facets):
        raise ValueError(f"`mesh` has no facet within {_NEAR} mm of any lens of the array.")
    point, owner = _vertices_of(vertices, facets, lens, array)
    count = np.bincount(owner, minlength=len(radius))
    return _Fit(*_fit(vertices[point], owner, center, radius), count, facets, lens)


def _belonging(vertices, facets, array, sphere, radius):
    """The facets of each lens's cap, and the lens of each."""
    corners = vertices[facets]
    middle = corners.mean(axis=1)
    distance, lens = map(np.asarray, KDTree(sphere[:, :2]).query(middle[:, :2]))
    spoke = middle - sphere[lens]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(spoke, axis=1)
    aligned = np.abs((normal * spoke).sum(axis=1)) > _ALIGNED * size
    off = np.abs(np.linalg.norm(corners - sphere[lens, None], axis=2) - radius[lens, None]).max(axis=1)
    kept = aligned & (off < _NEAR) & (distance < float(array.aperture_diameter) / 2) & (spoke[:, 2] < 0)
    return facets[kept], lens[kept]


def _vertices_of(vertices, facets, lens, array):
    """Which vertices each lens has. Those on its rim are as much the plate's, and are left out."""
    pairs = np.unique(np.repeat(lens, 3) * len(vertices) + facets.ravel())
    owner, point = np.divmod(pairs, len(vertices))
    above = -plate_thickness(array) - vertices[point, 2]
    kept = above > cap_sag(array) / 300
    return point[kept], owner[kept]


def _fit(points, owner, center, radius):
    """Spheres through the points of each owner: Gauss and Newton's steps on the sum of squared distances."""
    count = len(center)
    unknowns = np.column_stack([center, radius])
    for _ in range(6):
        spoke, residual = _residual(points, unknowns[owner])
        gradient = np.column_stack([-spoke, -np.ones(len(points))])
        normal = np.zeros((count, 4, 4))
        right = np.zeros((count, 4))
        for i in range(4):
            right[:, i] = np.bincount(owner, gradient[:, i] * residual, count)
            for j in range(4):
                normal[:, i, j] = np.bincount(owner, gradient[:, i] * gradient[:, j], count)
        # The pseudo-inverse: what too few points say nothing of stays.
        unknowns = unknowns - (np.linalg.pinv(normal, rcond=1e-14, hermitian=True) @ right[..., None])[..., 0]
    squares = np.bincount(owner, _residual(points, unknowns[owner])[1] ** 2, count)
    return unknowns[:, :3], unknowns[:, 3], np.sqrt(squares / np.maximum(np.bincount(owner, minlength=count), 1))


def _residual(points, spheres):
    """Unit vectors from the centres of spheres, `(x, y, z, radius)`, to points, and how far outside the points are."""
    spoke = points - spheres[:, :3]
    length = np.linalg.norm(spoke, axis=1)
    return spoke / length[:, None], length - spheres[:, 3]


def _facet_errors(corners, lens, sphere, radius):
    """Mean and spread of the facets' distance outside the design's sphere, and their slope against it, by lens."""
    count = len(sphere)
    spoke = np.einsum("qk,fkx->fqx", _NODES, corners - sphere[lens, None])
    distance = np.linalg.norm(spoke, axis=2)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Light comes along the axis: a facet counts as much as its shadow.
    area = np.abs(normal[:, 2])
    cosine = np.abs(np.einsum("fqx,fx->fq", spoke, normal)) / (distance * np.linalg.norm(normal, axis=1)[:, None])
    square_slope = 2 * (1 - np.minimum(cosine, 1)) @ _WEIGHTS
    total = np.bincount(lens, area, count)
    total[total == 0] = np.nan
    mean = lambda values: np.bincount(lens, area * values, count) / total
    error = distance - radius
    offset = mean(error @ _WEIGHTS)
    return offset, np.sqrt(mean((error - offset[lens, None]) ** 2 @ _WEIGHTS)), np.sqrt(mean(square_slope))


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
    shift = np.linalg.norm(found.center - np.asarray(array.centers, float), axis=1)
    larger = found.radius / float(array.radius_of_curvature) - 1
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
        "sphere_misfit_max_um": 1000 * worst(found.misfit),
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
