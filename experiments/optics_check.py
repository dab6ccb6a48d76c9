"""Exact rays and PSF of one lenslet against an independent ray tracer, and against ray-traced captures.

Optiland (a general ray tracer) sends rays through the same surfaces: landing points, optical paths, spot sizes,
wavefront errors and Strehl ratios are compared against field and depth, with third-order theory beside them. With DATA,
the spots of each lens for a single point are compared with our PSF in position, size and brightness. The scale of the
pattern of spots (Eq. 1) is the slope of a line through the positions of spots against those of their lenses.

    python -m experiments.optics_check [DATA] [--out DIR]

DATA holds `P1.toml`, `P2.toml`, `P1_a.tif`, `P2_a.tif`, `P1_i_*.tif` and the scenes' `*.json`.
"""

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.json import JSON
from scipy.optimize import minimize
from scipy.spatial import KDTree

from experiments.common import OPTIONAL_PATH, Report, design_of, half_light_radius, main, points_of, table
from experiments.ray_tracer import traced
from gs_jax import Design, Imager, MicrolensArray, Progress, Sensor, read_capture, read_design
from gs_jax.calibration.spots import find_spots
from gs_jax.microscope.geometry import envelope
from gs_jax.microscope.media import layers_in_front, object_index
from gs_jax.optics.aberrations import best_focus, independent_rms, seidel_of_array, wavefront_rms
from gs_jax.optics.apertures import aperture_area
from gs_jax.optics.diffraction import strehl
from gs_jax.optics.psf import diffraction_psf, geometric_psf
from gs_jax.optics.pupil import pupil_quadrature
from gs_jax.optics.raytrace import trace_lenslet

WAVELENGTH = 520e-6
# Pupil radius, mm: about half the paper's pitch (1.23 mm), and the largest at which the lens can be traced to a field
# of 3 mm.
RADIUS = 0.65
FIELDS, DEPTHS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0), (18.0, 19.0, 20.0, 21.0, 22.0, 23.0)
SCALED = (18.0, 19.0, 20.0, 21.0, 22.0, 23.0, 24.0, 26.0)
# A spot matches a lens within this distance of its position at a scale of 1.3, mm: half of the smallest pitch.
_ROUGHLY, _NEAR = 1.3, 0.45
SPOTS = ("a", *(f"i_{z}_{place}" for z in (18, 20, 22) for place in ("c", "px", "mx", "py", "my")))
SHAPES: dict[str, dict] = {
    "plano side in front, k = -2": {"conic_constant": -2.0},
    "curved side in front, sphere": {"orientation": "curved"},
    "curved side in front, k = -0.7": {"orientation": "curved", "conic_constant": -0.7},
    "curved side in front, k = -0.7, A4, A6": {
        "orientation": "curved",
        "conic_constant": -0.7,
        "aspheric_terms": (0.004, -0.001),
    },
}
Rays = tuple[Float[np.ndarray, "ray 2"], Float[np.ndarray, "ray 2"], Float[np.ndarray, " ray"]]


def optiland_rays(imager: Imager, depth: float, points: Float[np.ndarray, "ray 2"], field: float) -> Rays:
    """Landing points, slopes and optical paths of the rays through `points` of the convex surface, by Optiland.

    The object is `field` off the axis along x. Repeated tracing finds where a ray has to cross the plane of the first
    vertex.
    """
    with warnings.catch_warnings():
        # Optiland's just-in-time compiler warns about itself.
        warnings.simplefilter("ignore")
        from optiland.materials import IdealMaterial
        from optiland.optic.optic import Optic
        from optiland.rays.real_rays import RealRays

        array, optic = imager.array, Optic()
        before, layers = _layers(imager, depth)
        after = [] if imager.windows is None else imager.windows.slabs[::-1]
        curved = len(layers) + (1 if array.orientation == "curved" else 2)
        toward = 1 if array.orientation == "curved" else -1
        shape = dict(
            radius=toward * float(array.radius_of_curvature),
            conic=float(array.conic_constant),
            # Coefficients of r^2, r^4, ...
            coefficients=[0.0, *(toward * float(term) for term in array.aspheric_terms)],
            surface_type="even_asphere",
            tol=1e-14,
        )
        air = float(imager.sensor_distance) - sum(float(thickness) for thickness, _ in after)
        plate = float(array.substrate_thickness), float(array.refractive_index)
        gaps = [before, *layers, plate, (air, 1.0), *after, (0.0, 1.0)]
        for index, (thickness, n) in enumerate(gaps):
            more: dict[str, Any] = {"is_stop": True} if index == 1 else {}
            more |= shape if index == curved else {}
            optic.surfaces.add(index=index, thickness=float(thickness), material=IdealMaterial(n=float(n)), **more)
        optic.wavelengths.add(1000 * WAVELENGTH, is_primary=True)
        entry, one = np.array(points, float), np.ones(len(points))
        start = float(before[0])
        for _ in range(60):
            # Aimed at the array as if all were of the object's medium.
            x, y = entry.T - [[field], [0]]
            length = np.sqrt(x**2 + y**2 + depth**2)
            cosines = (x / length, y / length, depth / length)
            rays = RealRays(field * one, 0 * one, -start * one, *cosines, one, 1000 * WAVELENGTH * one)
            optic.surfaces.trace(rays)
            slopes = np.column_stack([rays.L, rays.M]) / rays.N[:, None]
            result = np.column_stack([rays.x, rays.y]), slopes, np.asarray(rays.opd)
            miss = points - np.column_stack([optic.surfaces.x[curved], optic.surfaces.y[curved]])
            if np.abs(miss).max() < 1e-13:
                return result
            entry += miss
        raise RuntimeError("no rays through the points")


def _layers(imager: Imager, depth: float) -> tuple[tuple[float, float], list[tuple[float, float]]]:
    """Thickness and index of the object's medium in front of the point, and of what follows up to the array."""
    layers = [(float(t), float(n)) for t, n in layers_in_front(imager.filters, imager.sample)[::-1]]
    return (depth - sum(t for t, _ in layers), float(object_index(imager.sample))), layers


def compare(imager: Imager, depth: float, field: float, radius: float = RADIUS) -> dict:
    """Largest differences between our and Optiland's rays of one object point, and the spot by both."""
    points, weights = map(np.asarray, pupil_quadrature(radius, 16))
    theirs, slopes, path = optiland_rays(imager, depth, np.vstack([[0, 0], points]), field)
    ours = trace_lenslet(imager, depth, points, (field, 0.0))
    error = _on_sphere(theirs, slopes, path, imager)
    seidel = seidel_of_array(imager.array, radius, imager.reduced_depth(depth), field, imager.reduced_sensor_distance)
    mean, mine, off = weights @ theirs[1:], np.asarray(ours.landing), (field, 0.0)
    return {
        "depth_mm": depth,
        "field_mm": field,
        "landing_difference_nm": 1e6 * float(np.abs(mine - theirs[1:]).max()),
        "path_difference_waves": float(np.abs(np.asarray(ours.path) - path[1:] + path[0]).max()) / WAVELENGTH,
        "spot_rms_um": 1000 * float(np.sqrt(weights @ ((mine - weights @ mine) ** 2).sum(1))),
        "spot_rms_optiland_um": 1000 * float(np.sqrt(weights @ ((theirs[1:] - mean) ** 2).sum(1))),
        "wavefront_rms_waves": float(wavefront_rms(imager, depth, field=off, radius=radius)) / WAVELENGTH,
        "wavefront_rms_optiland_waves": _rms(error, points, weights) / WAVELENGTH,
        "wavefront_rms_third_order_waves": float(independent_rms(seidel)) / WAVELENGTH,
        "strehl": float(strehl(imager, depth, field=off, radius=radius)),
        "strehl_optiland": _strehl(imager, (theirs, slopes, path), points, weights),
    }


def _on_sphere(landing: np.ndarray, slopes: np.ndarray, path: np.ndarray, imager: Imager) -> np.ndarray:
    """Path difference to the first ray, on the sphere through the vertex about the end of the first ray."""
    # Origin of the first ray, from the vertex, if there were no plate.
    length2 = (landing[0] ** 2).sum() * (1 + 1 / max((slopes[0] ** 2).sum(), 1e-30))
    if not slopes[0].any():
        length2 = float(imager.reduced_sensor_distance) ** 2
    cosines = np.column_stack([slopes, np.ones(len(slopes))]) / np.sqrt(1 + (slopes**2).sum(1, keepdims=True))
    offset = np.column_stack([landing - landing[0], np.zeros(len(landing))])
    along = (offset * cosines).sum(1)
    back = along + np.sqrt(along**2 - (offset**2).sum(1) + length2)
    return ((path - back) - (path - back)[0])[1:]


def _rms(error: np.ndarray, points: np.ndarray, weights: np.ndarray) -> float:
    modes = np.column_stack([np.ones(len(points)), points])
    root = np.sqrt(weights)[:, None]
    fit, *_ = np.linalg.lstsq(root * modes, root[:, 0] * error, rcond=None)
    return float(np.sqrt(weights @ (error - modes @ fit) ** 2))


def _strehl(imager: Imager, rays: Rays, points: np.ndarray, weights: np.ndarray) -> float:
    """Highest `|sum exp(2 pi i (L + |P - B|) / wavelength)|^2` over points P of the sensor: Huygens' principle.

    B are the points where rays leave the array, L the paths to them. This is independent of our pupil.
    """
    landing, slopes, path = (part[1:] for part in rays)
    behind = np.full(len(points), float(imager.sensor_distance))
    if imager.array.orientation == "plano":
        behind += np.asarray(imager.array.sag((points**2).sum(1)))
    else:
        points = landing - behind[:, None] * slopes
    to_lens = path - behind * np.sqrt(1 + (slopes**2).sum(1))

    def dark(place):
        total = to_lens + np.sqrt(behind**2 + ((points - place) ** 2).sum(1))
        return -(np.abs(weights @ np.exp(2j * np.pi * (total - total[0]) / WAVELENGTH)) ** 2)

    middle = np.median(landing, axis=0)
    x, y = np.arange(-0.06, 0.06, 5e-4), np.arange(-0.002, 0.0021, 1e-3)
    _, start = min((dark(middle + (a, b)), (middle[0] + a, middle[1] + b)) for a in x for b in y)
    return float(-minimize(dark, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}).fun)


def spots(data: Path, scene: str, design: str = "P1", half: int = 64, reach: float = 3.0) -> list[dict]:
    """Compare each spot of a single point in a capture with our PSF, for lenses within `reach` of the point, mm.

    Positions are centroids over the window, relative to the chief ray; radii hold half of the window's light.
    """
    imager = read_design(data / f"{design}.toml").imager()
    image = 10 * (read_capture(data / f"{design}_{scene}.tif", imager.sensor.shape).astype(float) - 16)
    ((x, y, z, _),) = points_of(data, scene)
    centers, areas = np.asarray(imager.centers), np.asarray(aperture_area(imager.array))
    pixels = np.asarray(imager.sensor.to_pixels(imager.project(np.array([[x, y, z]]))[:, 0]))
    rows = []
    for lens in np.flatnonzero(np.hypot(*(centers - (x, y)).T) < reach):
        row, column = np.round(pixels[lens]).astype(int)
        if not (half <= min(row, column) and max(row, column) < min(image.shape) - half):
            continue
        window = image[row - half : row + half + 1, column - half : column + half + 1]
        field, offset = np.array([x, y]) - centers[lens], pixels[lens] - (row, column)
        near = [k for k in KDTree(centers).query_ball_point(centers[lens], 2.0) if k != lens]
        ours = _model(imager, z, field, offset, _padded(centers[near] - centers[lens]), half)
        distance2 = float(field @ field)
        given = envelope(distance2, float(imager.reduced_depth(z)), imager.field_radius)
        rows.append(
            {
                "field_mm": distance2**0.5,
                "expected_light": float(areas[lens] * given),
                "light": float(window.sum()),
                "capture": _measures(window, offset),
                **{name: _measures(spot, offset) for name, spot in ours.items()},
            }
        )
    return rows


@partial(jax.jit, static_argnames="half")
def _model(imager, depth, field, offset, edges, half: int) -> dict:
    arguments = dict(size=2 * half + 1, field=field, offset=offset, edges=edges)
    # Lenses extend to 1 mm; 4 samples would alias the edge of their halo into the window.
    return {
        "rays": geometric_psf(imager, depth, **arguments),
        "diffraction": diffraction_psf(imager, depth, samples=6, **arguments),
    }


def _padded(neighbours: np.ndarray, count: int = 16) -> np.ndarray:
    """Points padded to a fixed number, so that all lenses share one compiled function; distant edges cut nothing."""
    return np.vstack([neighbours / 2, np.full((count, 2), 10.0)])[:count]


def _measures(image, offset: np.ndarray) -> dict:
    """Centroids of the spot and of its core relative to the chief ray, and radius of half the light, pixels.

    The core is 5 x 5 pixels about the brightest; a spot out of focus has none.
    """
    image = np.asarray(image, float)
    image = image / image.sum()
    grid = np.indices(image.shape) - image.shape[0] // 2
    centroid = (grid * image).sum((1, 2))
    radii = np.hypot(*(grid - centroid[:, None, None])).ravel()
    peak = np.unravel_index(np.argmax(image), image.shape)
    core = np.abs(grid - grid[(slice(None), *peak)][:, None, None]).max(0) <= 2
    middle = (grid * image * core).sum((1, 2)) / (image * core).sum()
    return {
        "centroid_px": centroid - offset,
        "core_px": middle - offset,
        "half_light_px": half_light_radius(radii, image.ravel()),
    }


def summary(rows: list[dict]) -> dict:
    """Differences over all spots of a scene."""
    median_and_max = lambda values: [float(np.median(values)), float(values.max())]
    all_of = lambda name, key: np.array([row[name][key] for row in rows])
    ratio = np.array([row["light"] / row["expected_light"] for row in rows if row["field_mm"] < 2.5])
    result: dict = {"spots": len(rows), "light_over_area_and_envelope_relative_sd": float(ratio.std() / ratio.mean())}
    for place in ("centroid_px", "core_px"):
        captured = all_of("capture", place)
        result[f"map_to_{place}"] = median_and_max(np.hypot(*captured.T))
        for name in ("rays", "diffraction"):
            result[f"{name}_to_{place}"] = median_and_max(np.hypot(*(captured - all_of(name, place)).T))
    for name in ("rays", "diffraction"):
        sizes = all_of(name, "half_light_px") / all_of("capture", "half_light_px")
        result[f"{name}_half_light_ratio"] = median_and_max(sizes)
    return result


def run(fields=FIELDS, depths=DEPTHS) -> dict:
    """Compare with Optiland over the field, and over the depth on the axis, with the sensor focused for 20 mm."""
    imager = focused()
    return {
        "sensor_distance_mm": float(imager.sensor_distance),
        "pupil_radius_mm": RADIUS,
        "field": [compare(imager, 20.0, h) for h in fields],
        "depth": [compare(imager, z, 0.0) for z in depths],
    }


def shapes(fields=(0.0, 1.5, 3.0)) -> dict:
    """Compare aspheres with either side facing the object with Optiland, each with the sensor focused for 20 mm."""
    imagers = {name: focused(**lens) for name, lens in SHAPES.items()}
    return {name: [compare(imager, 20.0, field) for field in fields] for name, imager in imagers.items()}


def focused(radius: float = RADIUS, **lens: Any) -> Imager:
    """One lens, in focus for a point at 20 mm and this pupil."""
    imager = Imager(MicrolensArray([[0.0, 0.0]], **lens), Sensor((3, 3), 0.0045), 5.8, 3.0)
    return eqx.tree_at(lambda i: i.sensor_distance, imager, best_focus(imager, 20.0, radius=radius))


def breakdown(radii=(0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.8, 1.0)) -> list[dict]:
    """Eq. (9) against the PSF's peak, on the axis, for a point at 20 mm at the best focus of each aperture."""
    rows = []
    for radius in radii:
        imager = focused(radius)
        waves = float(wavefront_rms(imager, 20.0, radius=radius)) / WAVELENGTH
        peak = float(strehl(imager, 20.0, radius=radius))
        equation = float(np.exp(-((2 * np.pi * waves) ** 2)))
        rows.append({"pupil_radius_mm": radius, "wavefront_rms_waves": waves, "strehl": peak, "equation_9": equation})
    return rows


def curves(result: dict) -> Figure:
    """Plot wavefront error and Strehl ratio over field and depth."""
    axes = (figure := Figure(figsize=(10, 6.5), dpi=90, layout="constrained")).subplots(2, 2)
    for column, (name, label) in enumerate([("field", "field, mm"), ("depth", "depth, mm")]):
        at = lambda key, name=name: [row[key] for row in result[name]]
        x = at(f"{name}_mm")
        rms, ratio = axes[:, column]
        rms.plot(x, at("wavefront_rms_waves"), "-", label="exact rays, gs_jax")
        rms.plot(x, at("wavefront_rms_optiland_waves"), "k+", ms=9, label="Optiland")
        rms.plot(x, at("wavefront_rms_third_order_waves"), ":", label="third order")
        rms.set(xlabel=label, ylabel="RMS wavefront error, waves", ylim=(0, None))
        ratio.plot(x, at("strehl"), "-", label="PSF, gs_jax")
        ratio.plot(x, at("strehl_optiland"), "k+", ms=9, label="Optiland's rays")
        ratio.plot(x, np.exp(-((2 * np.pi * np.array(at("wavefront_rms_waves"))) ** 2)), ":", label="Eq. (9)")
        ratio.set(xlabel=label, ylabel="Strehl ratio", ylim=(0, None))
        rms.legend()
        ratio.legend()
    return figure


def scales(
    design: Design, data: Path | None, *, depths: Sequence[float] = SCALED, rays: int = 20_000, progress: Progress
) -> dict[str, list[dict]]:
    """Return the scale by source and depth, its value by Eq. (1), and the residuals of the line."""
    imager = design.imager()
    point = lambda depth: np.array([[0.0, 0.0, depth, 1e6]])
    results = {
        "our tracer": [
            scale_of(traced(point(depth), imager, rays), imager, depth) for depth in progress.track(depths, "Tracing")
        ]
    }
    if data is not None:
        captured = lambda name: read_capture(data / f"P1_{name}.tif", imager.sensor.shape).astype(np.float64)
        names = sorted(path.stem.removeprefix("P1_") for path in data.glob("P1_i_*_c.tif"))
        results["another group's"] = [scale_of(captured(n), imager, float(points_of(data, n)[0, 2])) for n in names]
    return results


def scale_of(image: np.ndarray, imager: Imager, depth: float) -> dict:
    """Measure the scale in a capture of a point on the axis."""
    seen, scale = imager.field_radius, _ROUGHLY
    centers = np.asarray(imager.centers, np.float64)
    centers = centers[np.hypot(*centers.T) < float(seen)]
    positions = np.asarray(imager.sensor.to_mm(find_spots(image, 2 * len(centers))))
    tree: Any = KDTree(positions)
    # Match twice; the second time with the positions predicted by the first fit.
    for reach in (_NEAR, _NEAR / 10):
        distance, nearest = tree.query(scale * centers)
        sure = distance < reach
        scale = float((centers[sure] * positions[nearest[sure]]).sum() / (centers[sure] ** 2).sum())
    off = positions[nearest[sure]] - scale * centers[sure]
    by_eq1 = 1 + float(imager.magnification(depth))
    row = {"depth_mm": depth, "spots": int(sure.sum()), "s_z": scale, "by_eq_1": by_eq1}
    thin = 1 + float(imager.sensor_distance) / depth
    return row | {"plate_left_out": thin, "rms_um": 1000 * float(np.sqrt((off**2).sum(1).mean()))}


def picture_of_scales(results: dict[str, list[dict]]) -> Figure:
    """Plot the scale against depth, and its difference from Eq. (1)."""
    figure = Figure(figsize=(9.5, 3.8), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    ours = next(iter(results.values()))
    column = lambda rows, key: np.array([row[key] for row in rows])
    depths = column(ours, "depth_mm")
    left.plot(depths, column(ours, "by_eq_1"), "-", color="black", label="Eq. (1), the plate as air")
    left.plot(depths, column(ours, "plate_left_out"), ":", color="black", label="Eq. (1), the plate left out")
    line = np.polynomial.Polynomial.fit(depths, column(ours, "by_eq_1"), 1)(depths)
    right.plot(depths, 1000 * (line - column(ours, "by_eq_1")), "--", color="0.5", label='a line ("scales linearly")')
    for (source, rows), marker in zip(results.items(), "os", strict=False):
        left.plot(column(rows, "depth_mm"), column(rows, "s_z"), marker, label=f"measured, {source}")
        error = 1000 * (column(rows, "s_z") - column(rows, "by_eq_1"))
        right.plot(column(rows, "depth_mm"), error, marker + "-", label=f"measured, {source}")
    right.axhline(0, color="black", lw=0.8)
    left.set(xlabel="depth, mm", ylabel="scale $s_z$")
    right.set(xlabel="depth, mm", ylabel="scale less Eq. (1), thousandths")
    left.legend()
    right.legend()
    return figure


_OF_SHAPES = {
    "field_mm": "field, mm",
    "landing_difference_nm": "landing, nm",
    "path_difference_waves": "path, waves",
    "spot_rms_um": "spot, um RMS",
    "wavefront_rms_waves": "wavefront, waves RMS",
    "wavefront_rms_third_order_waves": "third order",
    "strehl": "Strehl ratio of the PSF",
    "strehl_optiland": "of Optiland's rays",
}


def report(data: Path | None, progress: Progress) -> Report:
    with jax.enable_x64(True):  # accurate to 1e-11 waves
        result = run() | {"breakdown": breakdown(), "shapes": shapes()}
    keys = ("depth_mm", "field_mm", "landing_difference_nm", "path_difference_waves")
    columns = ("depth, mm", "field, mm", "largest difference to Optiland: landing, nm", "path, waves")
    rows = [[f"{row[key]:.3g}" for key in keys] for row in result["field"] + result["depth"]]
    others = [(name, row) for name, rows in result["shapes"].items() for row in rows]
    shaped = [[name, *(f"{row[key]:.3g}" for key in _OF_SHAPES)] for name, row in others]
    broken = [[f"{number:.3g}" for number in row.values()] for row in result["breakdown"]]
    limits = ("pupil radius, mm", "wavefront error, waves RMS", "Strehl ratio of the PSF", "Eq. (9)")
    shown = [table(columns, rows), table(("lens", *_OF_SHAPES.values()), shaped), table(limits, broken)]
    result["scales"] = scaled = scales(design_of(data), data, progress=progress)
    columns = ("captures", "depth, mm", "spots", "s_z", "by Eq. (1)", "without the plate", "off the line, um RMS")
    rows = [[source, *(f"{x:.5g}" for x in row.values())] for source, lines in scaled.items() for row in lines]
    shown.append(table(columns, rows))
    pictures = {"curves.png": curves(result), "depth_scaling.png": picture_of_scales(scaled)}
    files: dict[str, Any] = pictures | {"result.json": result}
    if data is not None:
        results = {f"P1_{scene}": spots(data, scene) for scene in progress.track(SPOTS, "Captures")}
        results["P2_a"] = spots(data, "a", "P2")
        result["captures"] = {name: summary(rows) for name, rows in results.items()}
        return Report(files, [*shown, JSON.from_data(result["captures"])])
    return Report(files, shown)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
