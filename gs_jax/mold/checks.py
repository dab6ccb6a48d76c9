"""What is checked before a mold or an array is written: whether it can be made, and whether the solid is the design.

Lengths in mm. An error stops the work; a warning is for the user to weigh.
"""

import math
from dataclasses import dataclass
from typing import Literal

import manifold3d as m3
import numpy as np

from ..base.errors import InputError
from ..designs.design import Design
from ..layouts.cells import cell_edges, coverage, largest_hole, nearest_neighbour_distances
from ..lenses import MicrolensArray
from .caps import COARSEST, MAX_FACETS, cap_sag, estimated_facets
from .mesh_files import Mesh
from .solids import STEEPEST, MoldShape, engravings, mold_block, plate_thickness, widest_aperture

# Of a solid's volume against the analytic one. Facets within 0.5 um of the lenses come within 1e-5.
VOLUME_TOLERANCE = 1e-4
# Thinner sheets of cast silicone tear when they are peeled off, thinner prints warp.
THINNEST_MM = 0.3
# Of steps in a surface, RMS: a Strehl ratio of 0.8, Marechal's criterion.
MOST_WAVES = 1 / 14


@dataclass(frozen=True)
class Finding:
    """The outcome of one check, in words."""

    check: str
    level: Literal["ok", "warning", "error"]
    text: str


def refuse_errors(findings: list[Finding], place: str) -> None:
    """`InputError` with the first error among the findings, if there is one."""
    for finding in findings:
        if finding.level == "error":
            raise InputError(f"{place}: {finding.text}")


def check_design(
    design: Design, shape: MoldShape, *, chord: float, resolution: float, layer: float | None = None
) -> list[Finding]:
    """What can be said before anything is built.

    Parameters
    ----------
    design
        The microscope.
    shape
        What is around the array in its mold.
    chord
        The largest distance between a facet and its sphere, mm.
    resolution
        The smallest feature that the printer makes, mm.
    layer
        Thickness of its layers, mm, if it prints any.
    """
    array = design.imager().array
    return [
        _focal_length(design),
        _plate(array),
        _walls(shape),
        _slope(array),
        _spacing(array, resolution),
        _ridges(array, resolution),
        _holes(array),
        _chord(array, chord, resolution),
        *([] if layer is None else [_layers(design, array, layer)]),
    ]


def _focal_length(design: Design) -> Finding:
    given, lens = design.lens.focal_length_mm, design.lens
    f = lens.radius_of_curvature_mm / (lens.refractive_index - 1)
    if given is None or math.isclose(given, f, rel_tol=1e-3):
        return Finding("focal length", "ok", f"the lenses' focal length is R / (n - 1) = {f:.4g} mm.")
    allowed = f"R / (n - 1) = {f:.4g} mm, which is what a part has, or no such key"
    return Finding("focal length", "error", f"`lens.focal_length_mm`: found {given:g}, allowed: {allowed}.")


def _plate(array: MicrolensArray) -> Finding:
    t, sag, between = float(array.substrate_thickness), cap_sag(array), plate_thickness(array)
    if between <= 0:
        text = f"`array.substrate_thickness_mm`: found {t:g}, allowed: more than the lenses' sag, {sag:.4g} mm."
        return Finding("plate", "error", text)
    text = f"the array is {t:g} mm thick at the lenses' vertices (sag {sag:.4g} mm) and {between:.4g} mm between them."
    if between < THINNEST_MM:
        return Finding("plate", "warning", f"{text} Less than {THINNEST_MM} mm tears easily.")
    return Finding("plate", "ok", text)


def _walls(shape: MoldShape) -> Finding:
    thinnest = min(shape.wall, shape.floor)
    text = f"the mold's walls are {shape.wall:g} mm and its floor {shape.floor:g} mm thick"
    if thinnest < THINNEST_MM:
        return Finding("walls", "warning", f"{text}; less than {THINNEST_MM} mm warps.")
    return Finding("walls", "ok", f"{text}.")


def _slope(array: MicrolensArray) -> Finding:
    n = float(array.refractive_index)
    slope = math.asin(min(float(array.aperture_diameter) / 2 / float(array.radius_of_curvature), 1.0))
    degrees, critical = math.degrees(slope), math.degrees(math.asin(1 / n))
    text = f"the lenses' rims slope by asin(D / 2R) = {degrees:.3g} degrees"
    if slope > STEEPEST:
        found = f"`lens.aperture_diameter_mm`: found {float(array.aperture_diameter):g}"
        allowed = f"at most {widest_aperture(array):.4g} mm, with rims that slope by {math.degrees(STEEPEST):g} degrees"
        return Finding("edge slope", "error", f"{found}, allowed: {allowed}.")
    if degrees > critical:
        reason = f"beyond {critical:.3g} degrees, asin(1 / n), light along the axis is totally reflected"
        return Finding("edge slope", "warning", f"{text}; {reason}.")
    return Finding("edge slope", "ok", f"{text}.")


def _spacing(array: MicrolensArray, resolution: float) -> Finding:
    centers = np.asarray(array.centers, float)
    reach = float(array.aperture_diameter) / 2
    if len(centers) == 1:
        return Finding("smallest feature", "ok", f"a single lens, {2 * reach:g} mm wide.")
    spacing = float(nearest_neighbour_distances(centers).min())
    radius = float(array.radius_of_curvature)
    groove = radius - math.sqrt(radius**2 - min(spacing / 2, reach) ** 2)
    text = f"the closest lenses are {spacing:.4g} mm apart, with a groove {1000 * groove:.4g} um deep between them"
    if groove < resolution:
        return Finding(
            "smallest feature", "warning", f"{text}: the printer's {1000 * resolution:g} um will not show it."
        )
    return Finding("smallest feature", "ok", f"{text}; the printer makes {1000 * resolution:g} um.")


def _ridges(array: MicrolensArray, resolution: float) -> Finding:
    """The mold's ridges between lenses are sharp: a printer rounds them to its resolution."""
    centers, reach = np.asarray(array.centers, float), float(array.aperture_diameter) / 2
    edges, side = cell_edges(centers, array.size), np.array(array.size) / 2
    half = np.sqrt(np.maximum(reach**2 - edges.height**2, 0))
    first, last = (np.clip(t, -half, half) for t in (edges.low, edges.high))
    between = (np.abs(centers[edges.lens] + (edges.start + edges.end) / 2) < side * (1 - 1e-6)).all(axis=1)
    # Each ridge is an edge of two cells.
    total = float((last - first)[between].sum()) / 2
    share = total * resolution / math.prod(array.size)
    text = f"{total:.4g} mm of sharp edges between lenses: rounded over {1000 * resolution:g} um they are "
    return Finding("sharp edges", "warning" if share > 0.1 else "ok", f"{text}{100 * share:.2g} % of the plate.")


def _holes(array: MicrolensArray) -> Finding:
    centers = np.asarray(array.centers, float)
    share = 1 - coverage(centers, array.size, diameter=float(array.aperture_diameter))
    hole = largest_hole(centers, array.size)
    if share < 1e-6:
        return Finding("coverage", "ok", "lenses cover the whole plate.")
    area = share * math.prod(array.size)
    text = f"{100 * share:.3g} % of the plate ({area:.3g} mm2) is flat, up to {hole:.3g} mm from the nearest lens"
    return Finding("coverage", "warning", f"{text}: without a mask (`gs-jax mask`) light goes through it unfocused.")


def _chord(array: MicrolensArray, chord: float, resolution: float) -> Finding:
    limit = cap_sag(array) * COARSEST
    if chord > limit:
        allowed = f"at most {1000 * limit:.4g} um, a tenth of the height of a lens"
        return Finding("facets", "error", f"the chord error: found {1000 * chord:g} um, allowed: {allowed}.")
    if (count := estimated_facets(array, chord)) > MAX_FACETS:
        allowed = f"at least {1000 * chord * count / MAX_FACETS:.2g} um; it takes about {count:.2g} facets"
        return Finding("facets", "error", f"the chord error: found {1000 * chord:g} um, allowed: {allowed}.")
    text = f"facets within {1000 * chord:g} um of the lenses"
    if chord > resolution / 4:
        return Finding("facets", "warning", f"{text}: the printer, with {1000 * resolution:g} um, may show them.")
    return Finding("facets", "ok", f"{text}.")


def _layers(design: Design, array: MicrolensArray, layer: float) -> Finding:
    """Steps of the surface: evenly spread errors of a layer have a standard deviation of a layer over root 12."""
    sag, wavelength = cap_sag(array), design.imaging.wavelength_nm * 1e-6
    waves = (float(array.refractive_index) - 1) * layer / math.sqrt(12) / wavelength
    text = f"a lens is {sag / layer:.3g} layers of {1000 * layer:g} um high; their steps are {waves:.2g} waves RMS"
    if waves > MOST_WAVES:
        finest = 1000 * layer * MOST_WAVES / waves
        return Finding("layers", "warning", f"{text}: smooth them, or print layers of {finest:.2g} um.")
    return Finding("layers", "ok", f"{text}.")


def caps_volume(array: MicrolensArray, nodes: int = 64) -> float:
    """Volume of the lenses over the plate's plane, by quadrature over the sectors of their cells, mm^3.

    In the direction `phi` a cap ends at `r = min(D/2, d / cos(phi))`, with `d` the distance of the cell's edge, and
    holds `int h r dr = (R^3 - (R^2 - r^2)^{3/2}) / 3 - sqrt(R^2 - D^2/4) r^2 / 2`. What ends at the rim is a constant.
    For what ends at the edge, `r = d cosh(u)` and `dphi = du / cosh(u)`: smooth even where the edge passes by the
    vertex.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    """
    radius, reach = float(array.radius_of_curvature), float(array.aperture_diameter) / 2
    held = lambda r2: (radius**3 - (radius**2 - r2) ** 1.5) / 3 - math.sqrt(radius**2 - reach**2) * r2 / 2
    edges = cell_edges(np.asarray(array.centers, float), array.size)
    # An edge through the vertex has no sector.
    off, *ends = (x[edges.height > 1e-12] for x in (edges.height, edges.low, edges.high))
    half = np.sqrt(np.maximum(reach**2 - off**2, 0))
    within = [np.clip(t, -half, half) for t in ends]
    at_rim = (
        np.arctan2(ends[1], off) - np.arctan2(ends[0], off) - np.arctan2(within[1], off) + np.arctan2(within[0], off)
    )
    low, high = (np.arcsinh(t / off)[:, None] for t in within)
    x, weights = np.polynomial.legendre.leggauss(nodes)
    cosh = np.cosh((high + low) / 2 + (high - low) / 2 * x)
    at_edge = (high - low)[:, 0] / 2 * ((held(np.minimum(off[:, None] * cosh, reach) ** 2) / cosh) @ weights)
    return float((held(reach**2) * at_rim + at_edge).sum())


def array_volume(array: MicrolensArray) -> float:
    """Volume of the array: plate and lenses, mm^3."""
    return math.prod(array.size) * plate_thickness(array) + caps_volume(array)


def mold_volume(array: MicrolensArray, shape: MoldShape) -> float:
    """Volume of the mold: the block, less lenses, what the walls enclose, and engraved marks and label, mm^3."""
    low, high = mold_block(array, shape)
    deep = plate_thickness(array) * shape.scale + shape.headroom
    flare = deep * math.tan(shape.draft)
    areas = [math.prod(side * shape.scale + wider for side in array.size) for wider in (0.0, flare, 2 * flare)]
    enclosed = deep * (areas[0] + 4 * areas[1] + areas[2]) / 6
    above = m3.Manifold.cube([*(high - low)[:2], 1e3]).translate([*low[:2], high[2]])
    engraved = sum((tool - above).volume() for tool in engravings(array, shape))
    return math.prod(high - low) - shape.scale**3 * caps_volume(array) - enclosed - engraved


def volume_tolerance(array: MicrolensArray, chord: float) -> float:
    """How far a volume may be from the analytic one, as a fraction: coarse facets cannot do as well as fine ones.

    Facets are right on average but for their rims: a quarter of the chord error over the plate is more than they miss.
    """
    return max(VOLUME_TOLERANCE, chord / 4 * math.prod(array.size) / array_volume(array))


def check_solid(mesh: Mesh, expected: float, name: str, tolerance: float = VOLUME_TOLERANCE) -> list[Finding]:
    """Whether a mesh, rounded as it will be written, is one solid without handles and of the right volume.

    Parameters
    ----------
    mesh
        What will be written.
    expected
        Its volume, mm^3.
    name
        What it is, for the words.
    tolerance
        Of its volume, as a fraction.
    """
    edges = np.concatenate([mesh.facets[:, [0, 1]], mesh.facets[:, [1, 2]], mesh.facets[:, [2, 0]]])
    forward, backward = (
        np.sort(edges @ np.array(radix)) for radix in ((len(mesh.vertices), 1), (1, len(mesh.vertices)))
    )
    tight = bool((forward == backward).all() and (forward[1:] != forward[:-1]).all())
    solid = mesh.solid()
    sound = solid.status() == m3.Error.NoError
    bodies = len(solid.decompose()) if sound else 0
    volume = solid.volume()
    off = float(abs(volume / expected - 1))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = " x ".join(f"{side:.4g}" for side in (high - low).tolist())
    return [
        _judged("watertight", tight, f"every edge of the {name} has one facet on either side"),
        _judged("manifold", sound, f"the {name} is a manifold ({solid.status().name})"),
        _judged("genus", (bodies, solid.genus()) == (1, 0), f"the {name} is one body without handles"),
        _judged("volume", off < tolerance, f"the {name} has {volume:.6g} mm3, {off:.1e} off the analytic volume"),
        Finding("size", "ok", f"the {name} is {size} mm (x, y, z), of {len(mesh.facets):,} facets."),
    ]


def _judged(check: str, passed: bool, text: str) -> Finding:
    return Finding(check, "ok" if passed else "error", f"{text}." if passed else f"found untrue: {text}.")
