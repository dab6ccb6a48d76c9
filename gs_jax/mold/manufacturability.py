"""What is checked before a mold or an array is written: whether it can be made, and whether the solid is the design.

Lengths in mm. An error stops the work; a warning is for the user to weigh.
"""

import math
from dataclasses import dataclass
from typing import Literal

import manifold3d as m3
import numpy as np
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..design.design import Design
from ..layouts import cell_edges, coverage, max_gap
from ..lenses import MicrolensArray
from .export import Mesh
from .lenslets import STEEPEST, cap_sag, caps_of, estimated_facets, surface, visible_reaches
from .solids import MAX_FACETS, VOLUME_TOLERANCE, MoldShape, coarsest_chord, plate_thickness, too_wide

# Thinner sheets of cast silicone tear when they are peeled off, thinner prints warp.
THINNEST_MM = 0.3
# Of steps in a surface, RMS: a Strehl ratio of 0.8, Marechal's criterion.
MOST_WAVES = 1 / 14
# Places a side of the plate at which lenses that differ are looked at: what is counted is right to a percent.
_PLACES = 1000


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
        The largest distance between a facet and its lens, mm.
    resolution
        The smallest feature that the printer makes, mm.
    layer
        Thickness of its layers, mm, if it prints any.
    """
    imager = design.imager()
    array = imager.array
    # What cannot be made is not looked at any closer.
    if (first := _slope(array)).level == "error":
        return [first]
    return [
        _focal_length(array),
        _plate(array),
        _walls(shape),
        first,
        _spacing(array, resolution),
        _ridges(array, resolution),
        _holes(array),
        _chord(array, chord, resolution),
        *([] if layer is None else [_layers(array, float(imager.wavelength), layer)]),
    ]


def _focal_length(array: MicrolensArray) -> Finding:
    given = array.thin_lens_focal_length
    f = np.asarray(array.radius_of_curvature, float) / (float(array.refractive_index) - 1)
    if given is None or np.allclose(given, f, rtol=1e-3, atol=0):
        return Finding("focal length", "ok", f"the lenses' focal length is R / (n - 1) = {_range(f)} mm.")
    allowed = f"R / (n - 1) = {_range(f)} mm, which is what a part has, or no such key"
    return Finding("focal length", "error", f"`lens.focal_length_mm`: found {float(given):g}, allowed: {allowed}.")


def _range(values) -> str:
    """One number, or from the least to the largest."""
    low, high = f"{np.min(values):.4g}", f"{np.max(values):.4g}"
    return low if low == high else f"{low} to {high}"


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
    caps = caps_of(array)
    if fault := too_wide(caps):
        allowed = f"at most {fault.allowed}, with lenses that slope by {math.degrees(STEEPEST):g} degrees"
        text = f"`lens.aperture_diameter_mm`: found {fault.found}, allowed: {allowed}."
        return Finding("edge slope", "error", text)
    radii = [np.linspace(0, cap.reach, 257) for cap in caps]
    slope = max(float((r * cap.sag_slope_over_r(r**2)).max()) for cap, r in zip(caps, radii, strict=True))
    degrees, critical = math.degrees(math.atan(slope)), math.degrees(math.asin(1 / float(array.refractive_index)))
    is_sphere = array.alike and caps[0].conic == 0 and not caps[0].terms
    text = f"the lenses slope by {'asin(D / 2R) =' if is_sphere else 'up to'} {degrees:.3g} degrees"
    if degrees > critical:
        reason = f"beyond {critical:.3g} degrees, asin(1 / n), light along the axis is totally reflected"
        return Finding("edge slope", "warning", f"{text}; {reason}.")
    return Finding("edge slope", "ok", f"{text}.")


def _spacing(array: MicrolensArray, resolution: float) -> Finding:
    caps = caps_of(array)
    if len(caps) == 1:
        return Finding("smallest feature", "ok", f"a single lens, {2 * caps[0].reach:g} mm wide.")
    centers = np.stack([cap.center for cap in caps])
    distance, nearest = map(np.asarray, KDTree(centers).query(centers, k=2))
    first = int(distance[:, 1].argmin())
    pair = [caps[first], caps[int(nearest[first, 1])]]
    along = np.linspace(0, 1, 1001)[:, None]
    height, _ = surface(pair, pair[0].center * (1 - along) + pair[1].center * along)
    groove, spacing = max(cap.rim for cap in pair) - height.min(), distance[first, 1]
    text = f"the closest lenses are {spacing:.4g} mm apart, with a groove {1000 * groove:.4g} um deep between them"
    if groove < resolution:
        return Finding(
            "smallest feature", "warning", f"{text}: the printer's {1000 * resolution:g} um will not show it."
        )
    return Finding("smallest feature", "ok", f"{text}; the printer makes {1000 * resolution:g} um.")


def _ridges(array: MicrolensArray, resolution: float) -> Finding:
    """The mold's ridges between lenses are sharp: a printer rounds them to its resolution."""
    total = _length_of_ridges(array)
    share = total * resolution / math.prod(array.size)
    text = f"{total:.4g} mm of sharp edges between lenses: rounded over {1000 * resolution:g} um they are "
    return Finding("sharp edges", "warning" if share > 0.1 else "ok", f"{text}{100 * share:.2g} % of the plate.")


def _length_of_ridges(array: MicrolensArray) -> float:
    if not array.alike:
        # Cauchy and Crofton: as often as lines of a grid cross it.
        owner = _owners(array)
        steps = np.array(array.size) / _PLACES
        crossings = [
            ((a != b) & (a >= 0) & (b >= 0)).sum() for a, b in ((owner[1:], owner[:-1]), (owner[:, 1:], owner[:, :-1]))
        ]
        return math.pi / 4 * float(crossings @ steps[::-1])
    centers, reach = np.asarray(array.centers, float), float(array.aperture_diameter) / 2
    edges, side = cell_edges(centers, array.size), np.array(array.size) / 2
    half = np.sqrt(np.maximum(reach**2 - edges.height**2, 0))
    first, last = (np.clip(t, -half, half) for t in (edges.low, edges.high))
    between = (np.abs(centers[edges.lens] + (edges.start + edges.end) / 2) < side * (1 - 1e-6)).all(axis=1)
    # Each ridge is an edge of two cells.
    return float((last - first)[between].sum()) / 2


def _owners(array: MicrolensArray):
    """The lens that is seen at places of a grid over the plate, -1 for none."""
    x, y = (((np.arange(_PLACES) + 0.5) / _PLACES - 0.5) * side for side in array.size)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return surface(caps_of(array), places)[1].reshape(_PLACES, _PLACES)


def _holes(array: MicrolensArray) -> Finding:
    centers = np.asarray(array.centers, float)
    if array.alike:
        share = 1 - coverage(centers, array.size, diameter=float(array.aperture_diameter))
    else:
        share = float((_owners(array) < 0).mean())
    hole = max_gap(centers, array.size)
    if share < 1e-6:
        return Finding("coverage", "ok", "lenses cover the whole plate.")
    area = share * math.prod(array.size)
    text = f"{100 * share:.3g} % of the plate ({area:.3g} mm2) is no lens, up to {hole:.3g} mm from the nearest lens"
    return Finding("coverage", "warning", f"{text}: without a mask (`gs-jax mask`) light goes through it unfocused.")


def _chord(array: MicrolensArray, chord: float, resolution: float) -> Finding:
    caps = caps_of(array)
    limit = coarsest_chord(caps)
    if chord > limit:
        allowed = f"at most {1000 * limit:.4g} um, a tenth of the height of a lens"
        return Finding("facets", "error", f"the chord error: found {1000 * chord:g} um, allowed: {allowed}.")
    if (count := estimated_facets(caps, visible_reaches(caps, array.size), chord)) > MAX_FACETS:
        allowed = f"at least {1000 * chord * count / MAX_FACETS:.2g} um; it takes about {count:.2g} facets"
        return Finding("facets", "error", f"the chord error: found {1000 * chord:g} um, allowed: {allowed}.")
    text = f"facets within {1000 * chord:g} um of the lenses"
    if chord > resolution / 4:
        return Finding("facets", "warning", f"{text}: the printer, with {1000 * resolution:g} um, may show them.")
    return Finding("facets", "ok", f"{text}.")


def _layers(array: MicrolensArray, wavelength: float, layer: float) -> Finding:
    """Steps of the surface: evenly spread errors of a layer have a standard deviation of a layer over root 12."""
    sag = cap_sag(array)
    waves = (float(array.refractive_index) - 1) * layer / math.sqrt(12) / wavelength
    text = f"a lens is {sag / layer:.3g} layers of {1000 * layer:g} um high; their steps are {waves:.2g} waves RMS"
    if waves > MOST_WAVES:
        finest = 1000 * layer * MOST_WAVES / waves
        return Finding("layers", "warning", f"{text}: smooth them, or print layers of {finest:.2g} um.")
    return Finding("layers", "ok", f"{text}.")


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
