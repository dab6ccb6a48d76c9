"""Lens positions on a plate: random and regular layouts, Voronoi cells and coverage.

Host code; lengths in mm. A plate has the size `(x, y)`, the origin is its middle, and every centre
lies on it: `|x| <= size[0] / 2`, `|y| <= size[1] / 2`. Voronoi cells within the plate are exact: with the centres
reflected at the four edges, the cells of the originals end at the plate.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, KDTree, Voronoi

from ..base.errors import InputError
from ..base.typing import Number
from .geometry import Imager

# A position in single precision: a lens on the plate's edge is on the plate.
ROUNDING = 1e-6
# The authors' array: 213 centres on 20 x 20 mm, pitch 1.23 mm, and SD 0.09 mm in the paper.
PITCH_BY_SPACING, SD_BY_PITCH = 1.23 / math.sqrt(20 * 20 / 213), 0.09 / 1.23
# Tolerance of the mean and the SD of the nearest-neighbour distances of `random_layout`, in pitches.
TOLERANCE = 0.01
# Settings of its search, by trial on 185 lenses of 2 mm on 20 x 20 mm with the paper's pitch, which hardly fit.
RELAXATIONS, ROUNDS, STEPS = 5, 8, 400
GAIN_PITCH, GAIN_GAP, MOMENTUM = 0.1, 0.6, 0.8  # 0.8 for the gaps would be unstable
NOISE, NOISY_PART = 0.02, 0.6


def random_layout(
    count: int,
    size: Sequence[Number],
    *,
    pitch: Number | None = None,
    pitch_sd: Number | None = None,
    diameter: Number | None = 2.0,
    seed: int = 0,
) -> Float[np.ndarray, "lens 2"]:
    """A random layout with a given pitch, without gaps between the lenses.

    *Host.*

    Random points are relaxed a little and then moved in small steps: each lens to or from its nearest neighbour, so
    that the distances get the given mean and SD, and the lenses around a gap into it. Random kicks that fade help the
    search out of local minima. The paper does not say how its layout was found; the method is ours.

    Parameters
    ----------
    count
        Number of lenses. A single lens lies in the middle and has no pitch.
    size
        `(x, y)` of the plate, mm.
    pitch
        Mean nearest-neighbour distance, mm, met within 1 %. By default the authors' at the same density,
        `0.90 sqrt(area / count)`.
    pitch_sd
        Their standard deviation, mm, met within 1 % of the pitch. By default the paper's 0.073 of the pitch.
    diameter
        Of the discs about the centres that cover the whole plate, corners included, mm. None allows gaps.
    seed
        The same seed gives the same layout.

    Raises
    ------
    InputError
        If an argument is out of range, lenses so few and small cannot cover the plate, the pitch is larger than in a
        hexagonal layout, or the search fails (after about 4 s for 200 lenses).

    Examples
    --------
    >>> centers = gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1)
    >>> centers.shape
    (20, 2)
    >>> array = gs.MicrolensArray(centers, size=(6.0, 6.0))
    """
    half = half_size(size)
    if count < 1:
        raise InputError(f"`count` must be 1 or more, got {count}.")
    if diameter is not None:
        _check_coverable(count, half, diameter)
    if count == 1:
        if pitch is not None or pitch_sd is not None:
            raise InputError("`pitch` and `pitch_sd` must be None for a single lens, which has no neighbour.")
        return np.zeros((1, 2))
    pitch = PITCH_BY_SPACING * math.sqrt(4 * half.prod() / count) if pitch is None else pitch
    check_positive("pitch", pitch)
    if pitch > (limit := _largest_pitch(count, half)):
        raise InputError(
            f"`pitch` must be at most {limit:.4g} mm for {count} lenses on {in_mm(half)}, got {pitch:.4g}."
        )
    pitch_sd = (SD_BY_PITCH * pitch if count > 2 else 0.0) if pitch_sd is None else pitch_sd
    if not 0 <= pitch_sd < pitch:
        raise InputError(f"`pitch_sd` must be at least 0 and less than the pitch, {pitch:.4g} mm, got {pitch_sd:.4g}.")
    rng = np.random.default_rng(seed)
    start = lloyd_relax(rng.uniform(-half, half, (count, 2)), size, iterations=RELAXATIONS)
    return _match_statistics(start, size, pitch, pitch_sd, diameter, rng)


def poisson_disc_layout(size: Sequence[Number], *, min_distance: Number, seed: int = 0) -> Float[np.ndarray, "lens 2"]:
    """Random centres at least `min_distance` (mm) apart, as many as fit: every point is nearer than that to a centre.

    Uniform random points, without those too close to an earlier one; then random points where there still is room.
    """
    half = half_size(size)
    check_positive("min_distance", min_distance)
    rng = np.random.default_rng(seed)
    centers = np.empty((0, 2))
    candidates = rng.uniform(-half, half, (1 + round(4 * half.prod() / min_distance**2), 2))
    while len(candidates):
        centers = _thin(np.concatenate([centers, candidates]), min_distance)
        vertices, _, radii = voronoi_vertices(centers, half)
        room = rng.permutation(np.flatnonzero(radii > min_distance * (1 + 1e-9)))
        angle, reach = rng.uniform(0, 2 * np.pi, len(room)), np.sqrt(rng.uniform(size=len(room)))
        offset = (reach * (radii[room] - min_distance))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        candidates = np.clip(vertices[room] + offset, -half, half)
    return centers


def hexagonal_layout(size: Sequence[Number], *, pitch: Number) -> Float[np.ndarray, "lens 2"]:
    """The centres of a hexagonal lattice on a plate, one of them in the middle, rows along x."""
    return _lattice(size, pitch, [[1, 0], [0.5, math.sqrt(0.75)]])


def square_layout(size: Sequence[Number], *, pitch: Number) -> Float[np.ndarray, "lens 2"]:
    """The centres of a square lattice on a plate, one of them in the middle."""
    return _lattice(size, pitch, [[1, 0], [0, 1]])


def lloyd_relax(
    centers: Float[np.ndarray, "lens 2"], size: Sequence[Number], *, iterations: int
) -> Float[np.ndarray, "lens 2"]:
    """Move centres to the centroids of their Voronoi cells within the plate, several times (Lloyd, 1982).

    Raises `InputError` if a centre lies outside the plate or on another one.
    """
    for _ in range(iterations):
        lens, start, end, *_ = cell_edges(centers, size)
        area = np.abs(_cross(start, end)) / 2
        total = np.bincount(lens, area, len(centers))
        if not total.all():
            raise InputError("`centers` must differ from each other, got two that coincide.")
        moment = area[:, None] * (start + end) / 3
        centers = centers + np.stack([np.bincount(lens, m, len(centers)) for m in moment.T], axis=1) / total[:, None]
    return centers


def nearest_neighbour_distances(centers: Float[np.ndarray, "lens 2"]) -> Float[np.ndarray, " lens"]:
    """Distance of each centre from the nearest other one, mm; infinite for a single centre. The pitch is their mean."""
    return KDTree(centers).query(centers, k=2)[0][:, 1]


def coverage(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number], *, diameter: Number) -> float:
    """Fraction of the plate's area within discs of this diameter (mm) about the centres; exact, cell by cell."""
    check_positive("diameter", diameter)
    edges = cell_edges(centers, size)
    height, radius = edges.height, diameter / 2
    half_chord = np.sqrt(np.maximum(radius**2 - height**2, 0))

    def wedge(t):  # area of the disc in the triangle from its centre to the edge's line, from the foot to t
        inner = np.clip(t, -half_chord, half_chord)
        return height * inner / 2 + radius**2 / 2 * (np.arctan2(t, height) - np.arctan2(inner, height))

    area = wedge(edges.high) - wedge(edges.low)
    return min(1.0, float(area.sum() / math.prod(size)))


def max_gap(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number]) -> float:
    """Largest distance of a point of the plate from the nearest centre, mm: that of a Voronoi vertex, exact."""
    _check_inside(centers, half := half_size(size))
    vertices, _, _ = voronoi_vertices(centers, half)
    return float(KDTree(centers).query(vertices)[0].max())


def voronoi_vertices(centers, half, reach=math.inf):
    """Vertices of the Voronoi cells within the plate, the lenses around each, and its distance from them."""
    points, owners = _reflect(centers, half, reach)
    triangles = Delaunay(points)
    # Qhull's triangles are facets of the points lifted to a paraboloid; a normal's foot is a circumcentre.
    vertices = -triangles.equations[:, :2] / (2 * triangles.paraboloid_scale * triangles.equations[:, 2:3])
    inside = (np.abs(vertices) <= half * (1 + 1e-6)).all(axis=1)
    vertices, lenses = np.clip(vertices[inside], -half, half), owners[triangles.simplices[inside]]
    return vertices, lenses, np.hypot(*(vertices - centers[lenses[:, 0]]).T)


class Edges(NamedTuple):
    """Edges of Voronoi cells, each once for every cell, relative to the centre of their lens, mm.

    `start`, `end`: points. `height`: distance of the edge's line. `low`, `high`: the ends along it, from the foot.
    `beyond`: the lens on its other side; for the plate's sides at -x, +x, -y and +y the count of lenses plus 0 to 3.
    """

    lens: Int[np.ndarray, " edge"]
    start: Float[np.ndarray, "edge 2"]
    end: Float[np.ndarray, "edge 2"]
    height: Float[np.ndarray, " edge"]
    low: Float[np.ndarray, " edge"]
    high: Float[np.ndarray, " edge"]
    beyond: Int[np.ndarray, " edge"]


def on_sensor(imager: Imager, points: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
    """Points of the array's plane in the sensor's frame: turned, shifted and tilted as the lens centres are, mm."""
    host = jax.tree.map(np.asarray, imager)
    return np.asarray(eqx.tree_at(lambda i: i.array.centers, host, points).centers, float)


def plate_corners(imager: Imager) -> Float[np.ndarray, "4 2"]:
    """Corners of the plate in the sensor's frame, in order around it, mm."""
    return on_sensor(imager, np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([imager.array.plate]) / 2)


def cell_edges(centers, size) -> Edges:
    """Edges of the Voronoi cells within the plate."""
    _check_inside(centers, half := half_size(size))
    points, _ = _reflect(centers, half)
    diagram = Voronoi(points)
    lens, beyond = diagram.ridge_points.ravel(), diagram.ridge_points[:, ::-1].ravel()
    # Reflections follow the lenses, side by side.
    beyond = np.where(beyond < len(centers), beyond, len(centers) + beyond // len(centers) - 1)
    vertices = np.repeat(diagram.ridge_vertices, 2, axis=0)
    ends = diagram.vertices[vertices]
    kept = (lens < len(centers)) & (ends[:, 0] != ends[:, 1]).any(axis=1)
    lens, beyond, ends = lens[kept], beyond[kept], ends[kept] - points[lens[kept], None]
    start, end = ends[:, 0], ends[:, 1]
    along = (end - start) / np.hypot(*(end - start).T)[:, None]
    height, low, high = np.abs(_cross(start, along)), (start * along).sum(axis=1), (end * along).sum(axis=1)
    return Edges(lens, start, end, height, low, high, beyond)


def check_positive(name, value):
    if not 0 < value < math.inf:
        raise InputError(f"`{name}` must be positive and finite, mm, got {value}.")


def half_size(size) -> Float[np.ndarray, "2"]:
    if len(size) != 2 or not all(0 < length < math.inf for length in size):
        raise InputError(f"`size` must be two positive lengths, mm, got {tuple(size)}.")
    return np.array(size, float) / 2


def in_mm(half) -> str:
    return f"{2 * half[0]:.4g} x {2 * half[1]:.4g} mm"


def _check_inside(centers, half):
    outside = (np.abs(centers) > half * (1 + ROUNDING)).any(axis=1) | ~np.isfinite(centers).all(axis=1)
    if outside.any() or len(centers) == 0:
        raise InputError(
            f"`centers` must be one or more points on a plate of {in_mm(half)}, got {outside.sum()} outside."
        )


def _check_coverable(count, half, diameter):
    """Raise if a disc's hexagon has too little area (Kershner, Am. J. Math. 61, 1939), or the only disc does."""
    check_positive("diameter", diameter)
    fewest = math.ceil(4 * half.prod() / (1.5 * math.sqrt(3) * (diameter / 2) ** 2))
    fewest = max(fewest, 1 if math.hypot(*half) <= diameter / 2 else 2)
    if count < fewest:
        raise InputError(
            f"`count` must be {fewest} or more for lenses of {diameter:.4g} mm to cover {in_mm(half)}, got {count}; "
            "in Python `diameter=None` allows gaps."
        )


def _largest_pitch(count, half):
    """Upper bound of the pitch (Oler, Acta Math. 105, 1961), mm: that of a hexagonal layout that reaches the edges.

    `N <= 2 A / (sqrt(3) d^2) + P / (2 d) + 1` for N points at least d apart, on area A with perimeter P.
    """
    area, half_perimeter = 4 * half.prod(), 2 * half.sum()
    root = math.sqrt(half_perimeter**2 + 8 / math.sqrt(3) * (count - 1) * area)
    oler = (half_perimeter + root) / (2 * (count - 1))
    return min(oler, 2 * math.hypot(*half))


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _reflect(centers, half, reach=math.inf):
    """Centres, then their reflections at each edge within reach; and the index of each one's centre."""
    # A centre on an edge would coincide with its reflection.
    inner = np.clip(centers, -half * (1 - 1e-8), half * (1 - 1e-8))
    points, owners = [inner], [np.arange(len(centers))]
    for axis, side in product((0, 1), (-1, 1)):
        near = np.flatnonzero(half[axis] - side * inner[:, axis] < reach)
        images = inner[near]
        images[:, axis] = 2 * side * half[axis] - images[:, axis]
        points.append(images)
        owners.append(near)
    return np.concatenate(points), np.concatenate(owners)


def _match_statistics(centers, size, pitch, pitch_sd, diameter, rng):
    """Move centres until pitch, SD and gaps are as requested."""
    half, velocity = half_size(size), np.zeros_like(centers)
    for step in range(ROUNDS * STEPS):  # the first round has no kicks; it does for most requests
        to_pitch, mean, sd = _pitch_step(centers, pitch, pitch_sd)
        to_gaps, gap = _gap_step(centers, half, diameter)
        pitch_met = max(abs(mean - pitch), abs(sd - pitch_sd)) <= TOLERANCE * pitch
        if pitch_met and (diameter is None or max(gap, max_gap(centers, size)) <= diameter / 2):
            return centers
        kicks = 0.0 if step < STEPS else max(0.0, 1 - step % STEPS / (NOISY_PART * STEPS))
        velocity = MOMENTUM * velocity + GAIN_PITCH * to_pitch + GAIN_GAP * to_gaps
        velocity += NOISE * pitch * kicks * rng.normal(size=centers.shape)
        centers = np.clip(centers + velocity, -half, half)
    distances, gap = nearest_neighbour_distances(centers), max_gap(centers, size)
    raise InputError(
        f"found no such layout of {len(centers)} lenses on {in_mm(half)}; the search came to pitch "
        f"{distances.mean():.4f} mm of {pitch:.4g}, SD {distances.std():.4f} mm of {pitch_sd:.4g}, largest gap "
        f"{gap:.4f} mm of {'any' if diameter is None else f'at most {diameter / 2:.4g}'}; try another count or pitch."
    )


def _pitch_step(centers, pitch, pitch_sd):
    """Steps toward distances with the requested mean and SD, by shift and scale; and the present mean and SD."""
    distance, neighbour = (np.asarray(found)[:, 1] for found in KDTree(centers).query(centers, k=2))
    mean, sd = distance.mean(), distance.std()
    wanted = pitch + pitch_sd * (distance - mean) / max(sd, 1e-9 * pitch)
    away = (centers - centers[neighbour]) / np.maximum(distance, 1e-9 * pitch)[:, None]
    step = (wanted - distance)[:, None] * away
    np.subtract.at(step, neighbour, step.copy())
    return step, mean, sd


def _gap_step(centers, half, diameter):
    """Steps that move the lenses around each gap into it, and the radius of the largest gap."""
    step = np.zeros_like(centers)
    if diameter is None:
        return step, 0.0
    # Lenses farther than a diameter from an edge leave a gap if their cells reach it: no need to reflect them.
    vertices, lenses, radii = voronoi_vertices(centers, half, reach=diameter)
    # Half a percent more than requested, so that the search gets there.
    wide = radii > (radius := 0.995 * diameter / 2)
    excess = (1 - radius / radii[wide])[:, None]
    for lens in lenses[wide].T:
        np.add.at(step, lens, excess * (vertices[wide] - centers[lens]))
    return step, radii.max(initial=0.0)


def _thin(points, min_distance):
    """Drop points that are too close to an earlier one that stays."""
    stays = np.ones(len(points), bool)
    pairs = KDTree(points).query_pairs(min_distance, output_type="ndarray")
    for first, second in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        stays[second] &= not stays[first]
    return points[stays]


def _lattice(size, pitch, basis):
    """The points of a lattice through the origin that lie on the plate."""
    half, basis = half_size(size), np.array(basis)
    check_positive("pitch", pitch)
    corners = np.array([[1, 1], [1, -1]]) * half / pitch
    n, m = np.ceil(np.abs(corners @ np.linalg.inv(basis)).max(axis=0)).astype(int)
    steps = np.array(list(product(range(-m, m + 1), range(-n, n + 1))))[:, ::-1]
    points = pitch * (steps @ basis)
    return np.clip(points[(np.abs(points) <= half * (1 + 1e-9)).all(axis=1)], -half, half)


def interleave(centers: Float[np.ndarray, "lens 2"], types: int) -> Int[np.ndarray, " lens"]:
    """Assign a lens type, 0 to `types - 1`, to each lens, in about equal numbers, so that neighbours differ.

    Column after column, each lens gets the type that is rarest among its six nearest neighbours so far, and of those
    the rarest on the plate.
    """
    assigned = np.full(len(centers), -1)
    if types == 1 or len(centers) == 1:
        return assigned + 1
    distance, near = (np.asarray(part)[:, 1:] for part in KDTree(centers).query(centers, k=min(7, len(centers))))
    columns = np.round(centers[:, 0] / distance[:, 0].mean())
    for lens in np.lexsort((centers[:, 1], columns)):
        others = np.bincount(assigned[near[lens]][assigned[near[lens]] >= 0], minlength=types)
        rare = np.bincount(assigned[assigned >= 0], minlength=types)
        assigned[lens] = np.lexsort((rare, others))[0]
    return assigned
