"""Checks before a mold or an array is written: whether the design can be manufactured, and whether the solid is valid.

Errors stop the export; warnings are for the user to weigh. Lengths in mm.
"""

import math
import os
from dataclasses import dataclass
from typing import Literal

import manifold3d as m3
import numpy as np
import trimesh
from scipy.spatial import KDTree

from ..base.typing import PathLike
from ..design.conversion import AIR
from ..design.design import Design, read_design
from ..microscope.layouts import cell_edges, coverage, max_gap
from .export import Mesh
from .lenslets import MAX_SLOPE, Part, surface_height
from .solids import MAX_FACETS, VOLUME_TOLERANCE, MoldShape, aperture_fault

# Thinner sheets of cast silicone tear when they are peeled off; thinner prints warp.
MIN_THICKNESS_MM = 0.3
# RMS wavefront error for a Strehl ratio of 0.8, Marechal's criterion.
MAX_WAVES = 1 / 14
# Samples per side of the plate for unequal lenses; areas and lengths are right to a percent.
_SAMPLES = 1000


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check."""

    check: str
    level: Literal["ok", "warning", "error"]
    text: str


def raise_first_error(results: list[CheckResult], error: type[Exception], prefix: str = "") -> None:
    """Raises `error` with the text of the first result of level "error", if there is one."""
    for result in results:
        if result.level == "error":
            raise error(f"{prefix or result.check}: {result.text}")


def open_design(design: Design | PathLike) -> tuple[Design, str]:
    """The design, read if it is a file, and what messages call it."""
    if isinstance(design, Design):
        return design, f"design {design.name!r}"
    return read_design(design), os.fspath(design)


def check_design(
    design: Design, shape: MoldShape, *, chord: float, resolution: float, layer: float | None = None
) -> list[CheckResult]:
    """Checks a design before its solid is built.

    `chord` is the chordal tolerance of the facets, `resolution` the smallest feature that the printer makes, and
    `layer` the thickness of its layers, if it prints layers, all in mm.
    """
    imager = design.imager(AIR)
    part = Part(imager.array)
    # Rims that are too steep have no solid to check further.
    if (slope := _check_slope(part)).level == "error":
        return [slope]
    owner = None if part.array.alike else _owner_map(part)
    return [
        _check_focal_length(part),
        _check_plate(part),
        _check_walls(shape),
        slope,
        _check_spacing(part, resolution),
        _check_ridges(part, owner, resolution),
        _check_coverage(part, owner),
        _check_chord(part, chord, resolution),
        *([] if layer is None else [_check_layers(part, float(imager.wavelength), layer)]),
    ]


def _warn_if(condition: bool, check: str, text: str, warning: str, otherwise: str = ".") -> CheckResult:
    return CheckResult(check, "warning", text + warning) if condition else CheckResult(check, "ok", text + otherwise)


def _check_focal_length(part: Part) -> CheckResult:
    array = part.array
    given = array.thin_lens_focal_length
    f = np.asarray(array.radius_of_curvature, float) / (float(array.refractive_index) - 1)
    low, high = f"{np.min(f):.4g}", f"{np.max(f):.4g}"
    expected = f"R / (n - 1) = {low if low == high else f'{low} to {high}'} mm"
    if given is None or np.allclose(given, f, rtol=1e-3, atol=0):
        return CheckResult("focal length", "ok", f"the focal length of the lenses is {expected}.")
    text = f"`lens.focal_length_mm` must be {expected}, as of the part, or absent, got {float(given):g}."
    return CheckResult("focal length", "error", text)


def _check_plate(part: Part) -> CheckResult:
    t, sag, between = part.thickness, part.height, part.plate_thickness
    if between <= 0:
        text = f"`array.substrate_thickness_mm` must be more than the lenses' sag, {sag:.4g} mm, got {t:g}."
        return CheckResult("plate", "error", text)
    text = f"the array is {t:g} mm thick at the lenses' vertices (sag {sag:.4g} mm) and {between:.4g} mm between them"
    return _warn_if(between < MIN_THICKNESS_MM, "plate", text, f". Less than {MIN_THICKNESS_MM} mm tears easily.")


def _check_walls(shape: MoldShape) -> CheckResult:
    text = f"the mold's walls are {shape.wall:g} mm and its floor {shape.floor:g} mm thick"
    is_thin = min(shape.wall, shape.floor) < MIN_THICKNESS_MM
    return _warn_if(is_thin, "walls", text, f"; less than {MIN_THICKNESS_MM} mm warps.")


def _check_slope(part: Part) -> CheckResult:
    array, lenslets = part.array, part.lenslets
    if fault := aperture_fault(part):
        limit = f"lenses may slope by at most {math.degrees(MAX_SLOPE):g} degrees"
        return CheckResult("edge slope", "error", f"`lens.aperture_diameter_mm` {fault}; {limit}.")
    slope = max(lenslet.max_slope for lenslet in lenslets)
    degrees, critical = math.degrees(math.atan(slope)), math.degrees(math.asin(1 / float(array.refractive_index)))
    is_sphere = array.alike and lenslets[0].conic == 0 and not lenslets[0].terms
    text = f"the lenses slope by {'asin(D / 2R) =' if is_sphere else 'up to'} {degrees:.3g} degrees"
    reflected = f"; beyond {critical:.3g} degrees, asin(1 / n), light along the axis is totally reflected."
    return _warn_if(degrees > critical, "edge slope", text, reflected)


def _check_spacing(part: Part, resolution: float) -> CheckResult:
    lenslets = part.lenslets
    if len(lenslets) == 1:
        return CheckResult("smallest feature", "ok", f"a single lens, {2 * lenslets[0].semi_aperture:g} mm wide.")
    distance, nearest = map(np.asarray, KDTree(part.centers).query(part.centers, k=2))
    first = int(distance[:, 1].argmin())
    pair = [lenslets[first], lenslets[int(nearest[first, 1])]]
    along = np.linspace(0, 1, 1001)[:, None]
    height, _ = surface_height(pair, pair[0].center * (1 - along) + pair[1].center * along)
    groove, spacing = max(lenslet.rim_sag for lenslet in pair) - float(height.min()), distance[first, 1]
    text = f"the closest lenses are {spacing:.4g} mm apart, with a groove {1000 * groove:.4g} um deep between them"
    shallow = f": shallower than the printer's resolution, {1000 * resolution:g} um."
    resolved = f"; the printer resolves {1000 * resolution:g} um."
    return _warn_if(groove < resolution, "smallest feature", text, shallow, resolved)


def _check_ridges(part: Part, owner: np.ndarray | None, resolution: float) -> CheckResult:
    """The share of the plate that a printer rounds: ridges of the mold between lenses, as wide as the resolution."""
    total = _equal_ridge_length(part) if owner is None else _ridge_length(owner, part.size)
    share = total * resolution / math.prod(part.size)
    text = f"{total:.4g} mm of sharp edges between lenses: rounded over {1000 * resolution:g} um they are "
    return CheckResult("sharp edges", "warning" if share > 0.1 else "ok", f"{text}{100 * share:.2g} % of the plate.")


def _owner_map(part: Part) -> np.ndarray:
    """The index of the visible lens on a grid over the plate, -1 for none."""
    middles = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    return part.surface(*(middles * side for side in part.size))[1]


def _ridge_length(owner: np.ndarray, size: tuple[float, float]) -> float:
    """By the Cauchy-Crofton formula: lengths from crossings with the lines of a grid."""
    neighbours = (owner[1:], owner[:-1]), (owner[:, 1:], owner[:, :-1])
    crossings = [((a != b) & (a >= 0) & (b >= 0)).sum() for a, b in neighbours]
    return math.pi / 4 * float(crossings @ np.array(size)) / _SAMPLES


def _equal_ridge_length(part: Part) -> float:
    centers, radius = part.centers, part.lenslets[0].semi_aperture
    edges, side = cell_edges(centers, part.size), np.array(part.size) / 2
    half = np.sqrt(np.maximum(radius**2 - edges.height**2, 0))
    first, last = (np.clip(t, -half, half) for t in (edges.low, edges.high))
    between = (np.abs(centers[edges.lens] + (edges.start + edges.end) / 2) < side * (1 - 1e-6)).all(axis=1)
    # Each ridge is an edge of two cells.
    return float((last - first)[between].sum()) / 2


def _check_coverage(part: Part, owner: np.ndarray | None) -> CheckResult:
    if owner is None:
        share = 1 - coverage(part.centers, part.size, diameter=2 * part.lenslets[0].semi_aperture)
    else:
        share = float((owner < 0).mean())
    gap = max_gap(part.centers, part.size)
    if share < 1e-6:
        return CheckResult("coverage", "ok", "lenses cover the whole plate.")
    area = share * math.prod(part.size)
    text = f"{100 * share:.3g} % of the plate ({area:.3g} mm2) is no lens, up to {gap:.3g} mm from the nearest lens"
    return CheckResult("coverage", "warning", f"{text}: light passes there unfocused without a mask (`gs-jax mask`).")


def _check_chord(part: Part, chord: float, resolution: float) -> CheckResult:
    given = f"got {1000 * chord:g} um"
    if chord > part.max_chord:
        limit = f"{1000 * part.max_chord:.4g} um, a tenth of the height of a lens"
        text = f"the chord error must be at most {limit}, {given} (--chord-um)."
        return CheckResult("facets", "error", text)
    if (count := part.facet_count(chord)) > MAX_FACETS:
        least = 1000 * chord * count / MAX_FACETS
        text = f"the chord error must be at least {least:.2g} um, {given}, which takes about {count:.2g} facets"
        return CheckResult("facets", "error", f"{text} (--chord-um).")
    text = f"facets within {1000 * chord:g} um of the lenses"
    visible = f": the printer, with {1000 * resolution:g} um, may show them."
    return _warn_if(chord > resolution / 4, "facets", text, visible)


def _check_layers(part: Part, wavelength: float, layer: float) -> CheckResult:
    # The standard deviation of a uniform error of one layer is the layer over root 12.
    waves = (float(part.array.refractive_index) - 1) * layer / math.sqrt(12) / wavelength
    layers = part.height / layer
    text = f"a lens is {layers:.3g} layers of {1000 * layer:g} um high; their steps are {waves:.2g} waves RMS"
    finest = 1000 * layer * MAX_WAVES / waves
    return _warn_if(waves > MAX_WAVES, "layers", text, f": smooth them, or print layers of {finest:.2g} um.")


def _holes(count: int) -> str:
    return f" {count} hole{'s' * (count > 1)} through it" if count else "out handles"


def check_solid(
    mesh: Mesh, expected: float, name: str, tolerance: float = VOLUME_TOLERANCE, handles: int = 0
) -> list[CheckResult]:
    """Checks that a mesh, rounded as it will be written, is one solid with so many handles, as holes through it are.

    `expected` is its analytic volume, mm^3, and `tolerance` relative; `name` is that of the part.
    """
    surface = trimesh.Trimesh(mesh.vertices, mesh.facets, process=False)
    watertight = surface.is_watertight and surface.is_winding_consistent
    solid = mesh.solid()
    manifold = solid.status() == m3.Error.NoError
    bodies = len(solid.decompose()) if manifold else 0
    volume = solid.volume()
    error = float(abs(volume / expected - 1))
    size = " x ".join(f"{side:.4g}" for side in np.ptp(mesh.vertices, axis=0).tolist())
    tests = {
        "watertight": (watertight, f"every edge of the {name} has one facet on either side"),
        "manifold": (manifold, f"the {name} is a manifold ({solid.status().name})"),
        "genus": ((bodies, solid.genus()) == (1, handles), f"the {name} is one body with{_holes(handles)}"),
        "volume": (error < tolerance, f"the {name} has {volume:.6g} mm3, {error:.1e} off the analytic volume"),
        "size": (True, f"the {name} is {size} mm (x, y, z), of {len(mesh.facets):,} facets"),
    }
    return [
        CheckResult(check, "ok" if passed else "error", f"{'' if passed else 'not true: '}{text}.")
        for check, (passed, text) in tests.items()
    ]
