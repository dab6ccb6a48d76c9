"""How a layout covers its plate: distances of neighbours, holes, Voronoi cells. Host code; lengths in mm.

Reflect the centres at the four edges, and the Voronoi cells of the originals become their cells within the
plate, with the plate's corners and the crossings of cells and edges among the vertices. All that is exact here
rests on this.

Which lens of a plate is of which type, so that neighbours are of different types. Host code; lengths in mm.

Where the lenses go: random and regular layouts of their centres.

Host code, NumPy and SciPy. Every length is in millimetres. A plate has the size `(x, y)`, the origin is its
middle, and every centre lies on it: `|x| <= size[0] / 2`, `|y| <= size[1] / 2`.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, KDTree, Voronoi

from .base.errors import InputError

Number = float | int
# Of a place in single precision: a lens on the plate's edge is on the plate.
ROUNDING = 1e-6


def nearest_neighbour_distances(centers: Float[np.ndarray, "lens 2"]) -> Float[np.ndarray, " lens"]:
    """Distance of each centre from the nearest other one, mm; infinite for a single centre.

    Their mean is the array's pitch.
    """
    return KDTree(centers).query(centers, k=2)[0][:, 1]


def coverage(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number], *, diameter: Number) -> float:
    """The fraction of the plate's area that lies in a disc of this diameter (mm) about a centre; exact.

    The sum over the lenses of the area that a disc and its lens's Voronoi cell share.

    Raises
    ------
    InputError
        If the diameter is not positive or a centre lies outside the plate.
    """
    check_positive("diameter", diameter)
    edges = cell_edges(centers, size)
    height, radius = edges.height, diameter / 2
    half_chord = np.sqrt(np.maximum(radius**2 - height**2, 0))

    def wedge(t):  # what the disc shares with the triangle from its centre to the edge's line, from the foot to t
        inner = np.clip(t, -half_chord, half_chord)
        return height * inner / 2 + radius**2 / 2 * (np.arctan2(t, height) - np.arctan2(inner, height))

    area = wedge(edges.high) - wedge(edges.low)
    return min(1.0, float(area.sum() / math.prod(size)))


def max_gap(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number]) -> float:
    """The largest distance of a point of the plate from the nearest centre, mm; exact.

    Discs of this radius about the centres just cover the plate. The farthest point is a vertex of a Voronoi
    cell, where a cell meets an edge of the plate, or a corner.

    Raises
    ------
    InputError
        If a centre lies outside the plate.
    """
    _check_inside(centers, half := half_size(size))
    vertices, _, _ = voronoi_vertices(centers, half)
    return float(KDTree(centers).query(vertices)[0].max())


def voronoi_vertices(centers, half, reach=math.inf):
    """Vertices of the Voronoi cells within the plate, the lenses around each, and its distance from them."""
    points, owners = _reflected(centers, half, reach)
    triangles = Delaunay(points)
    # Qhull finds triangles as facets of the points lifted to a paraboloid; a normal's foot is a circumcentre.
    vertices = -triangles.equations[:, :2] / (2 * triangles.paraboloid_scale * triangles.equations[:, 2:3])
    inside = (np.abs(vertices) <= half * (1 + 1e-6)).all(axis=1)
    vertices, lenses = np.clip(vertices[inside], -half, half), owners[triangles.simplices[inside]]
    return vertices, lenses, np.hypot(*(vertices - centers[lenses[:, 0]]).T)


def _reflected(centers, half, reach=math.inf):
    """Centres, then their reflections at each edge within reach; and which centre each one is of."""
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


class Edges(NamedTuple):
    """Edges of Voronoi cells, each once for every cell: their lens, and where they are as seen from its centre, mm.

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


def cell_edges(centers, size) -> Edges:
    """Edges of the cells within the plate."""
    _check_inside(centers, half := half_size(size))
    points, _ = _reflected(centers, half)
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
    height, low, high = np.abs(cross(start, along)), (start * along).sum(axis=1), (end * along).sum(axis=1)
    return Edges(lens, start, end, height, low, high, beyond)


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def check_positive(name, value):
    if not 0 < value < math.inf:
        raise InputError(f"`{name}` must be positive and finite, mm, got {value}.")


def _check_inside(centers, half):
    outside = (np.abs(centers) > half * (1 + ROUNDING)).any(axis=1) | ~np.isfinite(centers).all(axis=1)
    if outside.any() or len(centers) == 0:
        raise InputError(
            f"`centers` must be one or more points on a plate of {in_mm(half)}, got {outside.sum()} outside."
        )


def half_size(size) -> Float[np.ndarray, "2"]:
    """Half the plate's size, mm."""
    if len(size) != 2 or not all(0 < length < math.inf for length in size):
        raise InputError(f"`size` must be two positive lengths, mm, got {tuple(size)}.")
    return np.array(size, float) / 2


def in_mm(half) -> str:
    return f"{2 * half[0]:.4g} x {2 * half[1]:.4g} mm"


# Neighbours whose types a lens looks at.
_NEIGHBOURS = 6


def interleave(centers: Float[np.ndarray, "lens 2"], types: int) -> Int[np.ndarray, " lens"]:
    """The type of each lens, 0 to `types - 1`, as many of each to a few lenses.

    Column after column, each lens gets the type that its six nearest neighbours so far have least of, and of those the
    rarest on the plate.
    """
    found = np.full(len(centers), -1)
    if types == 1 or len(centers) == 1:
        return found + 1
    tree: Any = KDTree(centers)
    near = tree.query(centers, k=min(_NEIGHBOURS + 1, len(centers)))[1][:, 1:]
    columns = np.round(centers[:, 0] / nearest_neighbour_distances(centers).mean())
    for lens in np.lexsort((centers[:, 1], columns)):
        others = np.bincount(found[near[lens]][found[near[lens]] >= 0], minlength=types)
        rare = np.bincount(found[found >= 0], minlength=types)
        found[lens] = np.lexsort((rare, others))[0]
    return found


# The authors' array: 213 centres on 20 x 20 mm, pitch 1.23 mm, and SD 0.09 mm in the paper.
PITCH_BY_SPACING = 1.23 / math.sqrt(20 * 20 / 213)
SD_BY_PITCH = 0.09 / 1.23

# `random_layout` meets the mean and the SD of the nearest-neighbour distances within this fraction of the pitch.
TOLERANCE = 0.01

# Found by trial on 185 lenses of 2 mm on 20 x 20 mm with the paper's pitch, close to what is possible at all.
RELAXATIONS, ROUNDS, STEPS = 5, 8, 400
GAIN_PITCH, GAIN_HOLE, MOMENTUM = 0.1, 0.6, 0.8  # 0.8 for the holes would be unstable
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
    """A random layout with a wanted pitch and no hole between the lenses.

    *Host.*

    Random points are relaxed a little and then moved in small steps: each lens to or from its nearest
    neighbour, so that the distances get the wanted mean and SD, and the lenses around a hole into it. Where
    this gets stuck, random kicks that fade help. The paper does not say how its layout was found; the method
    is ours.

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
        Standard deviation of the nearest-neighbour distances, mm, met within 1 % of the pitch. By default in
        the paper's proportion, 0.073 of the pitch (0 for two lenses, which have but one distance).
    diameter
        Of the discs that leave no hole, mm: every point of the plate, corners included, lies in a disc about
        a centre. None: holes do not matter.
    seed
        The same seed gives the same layout.

    Raises
    ------
    InputError
        If an argument is out of range, if lenses so few and small cannot cover the plate, if the pitch is
        larger than in a hexagonal layout, or if the search fails; then it says how close it came (after about
        4 s for 200 lenses).

    Examples
    --------
    >>> import gs_jax as gs
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
        found = f"{count} lenses on {in_mm(half)}, got {pitch:.4g}"
        raise InputError(f"`pitch` must be at most {limit:.4g} mm for {found}.")
    pitch_sd = (SD_BY_PITCH * pitch if count > 2 else 0.0) if pitch_sd is None else pitch_sd
    if not 0 <= pitch_sd < pitch:
        raise InputError(f"`pitch_sd` must be at least 0 and less than the pitch, {pitch:.4g} mm, got {pitch_sd:.4g}.")
    rng = np.random.default_rng(seed)
    start = lloyd_relax(rng.uniform(-half, half, (count, 2)), size, iterations=RELAXATIONS)
    return _matched(start, size, pitch, pitch_sd, diameter, rng)


def poisson_disc_layout(size: Sequence[Number], *, min_distance: Number, seed: int = 0) -> Float[np.ndarray, "lens 2"]:
    """Random centres that keep a distance, as many as fit: there is no room for another one.

    Uniform random points, without those too close to an earlier one; then random points where there still is
    room, until there is none.

    Parameters
    ----------
    size
        `(x, y)` of the plate, mm.
    min_distance
        Least distance of two centres, mm. Each point of the plate is nearer than this to a centre.
    seed
        The same seed gives the same layout.

    Raises
    ------
    InputError
        If the size or the distance is not positive.
    """
    half = half_size(size)
    check_positive("min_distance", min_distance)
    rng = np.random.default_rng(seed)
    centers = np.empty((0, 2))
    candidates = rng.uniform(-half, half, (1 + round(4 * half.prod() / min_distance**2), 2))
    while len(candidates):
        centers = _thinned(np.concatenate([centers, candidates]), min_distance)
        vertices, _, radii = voronoi_vertices(centers, half)
        room = rng.permutation(np.flatnonzero(radii > min_distance * (1 + 1e-9)))
        angle, reach = rng.uniform(0, 2 * np.pi, len(room)), np.sqrt(rng.uniform(size=len(room)))
        offset = (reach * (radii[room] - min_distance))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        candidates = np.clip(vertices[room] + offset, -half, half)
    return centers


def hexagonal_layout(size: Sequence[Number], *, pitch: Number) -> Float[np.ndarray, "lens 2"]:
    """The centres of a hexagonal lattice on a plate `(x, y)`, one of them in the middle, rows along x, mm.

    Raises
    ------
    InputError
        If the size or the pitch is not positive.
    """
    return _lattice(size, pitch, [[1, 0], [0.5, math.sqrt(0.75)]])


def square_layout(size: Sequence[Number], *, pitch: Number) -> Float[np.ndarray, "lens 2"]:
    """The centres of a square lattice on a plate `(x, y)`, one of them in the middle, mm.

    Raises
    ------
    InputError
        If the size or the pitch is not positive.
    """
    return _lattice(size, pitch, [[1, 0], [0, 1]])


def lloyd_relax(
    centers: Float[np.ndarray, "lens 2"], size: Sequence[Number], *, iterations: int
) -> Float[np.ndarray, "lens 2"]:
    """Centres moved to the centroids of their Voronoi cells within the plate, several times (Lloyd, 1982).

    Raises
    ------
    InputError
        If a centre lies outside the plate or on another one.
    """
    for _ in range(iterations):
        lens, start, end, *_ = cell_edges(centers, size)
        area = np.abs(cross(start, end)) / 2
        total = np.bincount(lens, area, len(centers))
        if not total.all():
            raise InputError("`centers` must differ from each other, got two that coincide.")
        moment = area[:, None] * (start + end) / 3
        centers = centers + np.stack([np.bincount(lens, m, len(centers)) for m in moment.T], axis=1) / total[:, None]
    return centers


def _matched(centers, size, pitch, pitch_sd, diameter, rng):
    """Centres moved until pitch, SD and holes are as wanted."""
    half, velocity = half_size(size), np.zeros_like(centers)
    for step in range(ROUNDS * STEPS):  # the first round has no kicks; it does for most requests
        to_pitch, mean, sd = _pitch_step(centers, pitch, pitch_sd)
        to_holes, hole = _hole_step(centers, half, diameter)
        pitch_met = max(abs(mean - pitch), abs(sd - pitch_sd)) <= TOLERANCE * pitch
        if pitch_met and (diameter is None or max(hole, max_gap(centers, size)) <= diameter / 2):
            return centers
        kicks = 0.0 if step < STEPS else max(0.0, 1 - step % STEPS / (NOISY_PART * STEPS))
        velocity = MOMENTUM * velocity + GAIN_PITCH * to_pitch + GAIN_HOLE * to_holes
        velocity += NOISE * pitch * kicks * rng.normal(size=centers.shape)
        centers = np.clip(centers + velocity, -half, half)
    distances, hole = nearest_neighbour_distances(centers), max_gap(centers, size)
    raise InputError(
        f"found no such layout of {len(centers)} lenses on {in_mm(half)}; the search came to pitch "
        f"{distances.mean():.4f} mm of {pitch:.4g}, SD {distances.std():.4f} mm of {pitch_sd:.4g}, largest hole "
        f"{hole:.4f} mm of {'any' if diameter is None else f'at most {diameter / 2:.4g}'}; try another count or pitch."
    )


def _pitch_step(centers, pitch, pitch_sd):
    """Steps that move neighbours together or apart, and mean and SD of their distances now.

    The distances wanted are those there are, shifted and scaled to the wanted mean and SD.
    """
    distance, neighbour = (np.asarray(found)[:, 1] for found in KDTree(centers).query(centers, k=2))
    mean, sd = distance.mean(), distance.std()
    wanted = pitch + pitch_sd * (distance - mean) / max(sd, 1e-9 * pitch)
    away = (centers - centers[neighbour]) / np.maximum(distance, 1e-9 * pitch)[:, None]
    step = (wanted - distance)[:, None] * away
    np.subtract.at(step, neighbour, step.copy())
    return step, mean, sd


def _hole_step(centers, half, diameter):
    """Steps that move the lenses around each hole into it, and the radius of the largest hole."""
    step = np.zeros_like(centers)
    if diameter is None:
        return step, 0.0
    # Lenses farther than a diameter from an edge leave a hole if their cells reach it: no need to reflect them.
    vertices, lenses, radii = voronoi_vertices(centers, half, reach=diameter)
    # Half a percent more than wanted, so that the end is reached and not only approached.
    wide = radii > (radius := 0.995 * diameter / 2)
    excess = (1 - radius / radii[wide])[:, None]
    for lens in lenses[wide].T:
        np.add.at(step, lens, excess * (vertices[wide] - centers[lens]))
    return step, radii.max(initial=0.0)


def _thinned(points, min_distance):
    """The points without those too close to an earlier one that stays."""
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


def _largest_pitch(count, half):
    """The pitch of a hexagonal layout that reaches the edges (an upper bound: Oler, Acta Math. 105, 1961), mm.

    `N <= 2 A / (sqrt(3) d^2) + P / (2 d) + 1` for N points at least d apart, on area A with perimeter P.
    """
    area, half_perimeter = 4 * half.prod(), 2 * half.sum()
    root = math.sqrt(half_perimeter**2 + 8 / math.sqrt(3) * (count - 1) * area)
    oler = (half_perimeter + root) / (2 * (count - 1))
    return min(oler, 2 * math.hypot(*half))


def _check_coverable(count, half, diameter):
    """Raise if a disc's hexagon has too little area (Kershner, Am. J. Math. 61, 1939), or the only disc does."""
    check_positive("diameter", diameter)
    fewest = math.ceil(4 * half.prod() / (1.5 * math.sqrt(3) * (diameter / 2) ** 2))
    fewest = max(fewest, 1 if math.hypot(*half) <= diameter / 2 else 2)
    if count < fewest:
        raise InputError(
            f"`count` must be {fewest} or more for lenses of {diameter:.4g} mm to cover {in_mm(half)}, got {count}; "
            "in Python `diameter=None` allows holes."
        )
