"""A real printed array: calibration from its one measured spot pattern, places of lenses left out, and spot widths.

The image is the measured point spread function of a printed array (Randoscope), of which the source and the objective
are not known: `calibrate` is given it as a pattern, and finds mirror, rotation, shift and scale. Each lens is left out
of the fit, and its spot is predicted. The half-light radius of each spot is compared with that of exact rays through
its lens, and with `w^2 = w_0^2 + k^2 (1 - R_0/R)^2` of a lens out of focus.

    python -m experiments.printed_array DATA [--out DIR]

DATA holds `psf.tif` and `lenses.csv`. Writes `printed_array.json` and `printed_array.png`; a minute on two cores.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.optimize import least_squares

from experiments.common import Report, half_light_radius, main, table
from gs_jax import Imager, MicrolensArray, Progress, Sensor, calibrate, read_capture
from gs_jax.calibration.fit import PATTERN_FITTED, Calibration, refine
from gs_jax.calibration.spot_model import predict_spots, trace_core_offsets
from gs_jax.calibration.spots import half_light_radii, mean_shift
from gs_jax.microscope.layouts import nearest_neighbour_distances
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.optics.apertures import split_by_type
from gs_jax.optics.pupil import add_diffraction, aperture_profile, sample_pupil

# The device: shape and pixels of the image, mm, as read 4 x 4; distance of the sensor, index of the resin, plate and
# wavelength, mm. Neighbours end the lenses before the nominal aperture does.
SHAPE, PIXEL, DISTANCE, INDEX, PLATE, WAVELENGTH = (486, 648), 4 * 0.0022, 8.74, 1.515, 1.7, 510e-6
APERTURE, FAR = 0.4, 1e4
# Standard deviations of two windows, pixels.
WINDOWS = (4.0, 8.0)
# Distances of a source that are tried, mm, and rays through a lens.
SOURCES, RAYS = np.geomspace(100.0, 1000.0, 15), 2000


def recipe(data: Path) -> Imager:
    """The array as the recipe says, which is not how it lies on the sensor."""
    x, y, radius = np.loadtxt(data / "lenses.csv", delimiter=",", skiprows=1).T
    numbers = {"radius_of_curvature": radius, "refractive_index": INDEX, "aperture_diameter": APERTURE}
    array = MicrolensArray(np.stack([x, y], -1), **numbers, substrate_thickness=0.0, size=(PLATE, PLATE))
    return Imager(array, Sensor(SHAPE, PIXEL), DISTANCE, field_radius=100.0, wavelength=WAVELENGTH)


def left_out(calibration: Calibration, start: Imager) -> np.ndarray:
    """Predicted less observed spot of each lens, `(x, y)` in pixels, with a similarity fitted to the other lenses."""
    off, unknown = [], np.zeros((1, 3), bool)
    spots, sources = calibration.spots.positions, calibration.sources
    offsets = trace_core_offsets(start, np.zeros(0))
    for k, lens in enumerate(calibration.spots.lenses):
        others = refine([np.delete(spots, k, 0)], start, sources, unknown, PATTERN_FITTED).imager
        predicted = np.asarray(predict_spots(others, sources.points, offsets, np.zeros(1, bool)))[0, lens]
        off.append((predicted - spots[k]) / PIXEL)
    return np.array(off)


def left_out_with_distortion(calibration: Calibration) -> np.ndarray:
    """As `left_out`, with a stretch and a third-order term; least squares in complex numbers `x + iy`, pixels."""
    centers = np.asarray(calibration.imager.array.centers, np.float64)[calibration.spots.lenses]
    lens, spot = centers @ (1, 1j), calibration.spots.positions @ (1, 1j) / PIXEL
    terms = np.stack([lens, np.ones_like(lens), lens.conj(), lens * abs(lens) ** 2], -1)
    hat = terms @ np.linalg.pinv(terms)
    # What a fit without one row would leave there.
    off = (hat @ spot - spot) / (1 - np.diag(hat).real)
    return np.stack([off.real, off.imag], -1)


def ray_widths(imager: Imager, depth: float) -> np.ndarray:
    """Half-light radius of each lens's rays of a point on its axis, mm."""
    types, widths = lenses_by_type(imager.array), np.zeros(len(imager.array.centers))
    for which, lens in zip(types, split_by_type(imager, types), strict=True):
        aperture = aperture_profile(lens.array)
        rays = add_diffraction(lens, sample_pupil(lens, depth, np.zeros(1), aperture, RAYS), aperture)
        widths[list(which)] = half_light_radius(np.hypot(*rays.landing[0].T), rays.light[0])
    return widths


def defocus_law(radius: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """`(w_0, k, R_0)` of `w^2 = w_0^2 + k^2 (1 - R_0/R)^2`, pixels and mm."""
    return np.abs(least_squares(lambda p: law(p, radius) - widths, [3.0, 15.0, DISTANCE * (INDEX - 1)]).x)


def law(numbers, radius) -> np.ndarray:
    sharpest, slope, focused = numbers
    return np.hypot(sharpest, slope * (1 - focused / radius))


def run(data: Path, *, progress: Progress) -> tuple[dict, dict]:
    """Return the content of `printed_array.json`, and what the figure shows."""
    start = recipe(data)
    image = read_capture(data / "psf.tif", SHAPE).astype(np.float64)
    image -= np.median(image)
    source = np.array([[0.0, 0.0, FAR]])
    calibration = calibrate([image], source, start, fit=PATTERN_FITTED, blurred=[0], progress=progress)
    pixels_per_mm = calibration.values["scale"] / PIXEL
    with progress.step("Leaving out lenses"):
        similarity, distorted = left_out(calibration, calibration.imager), left_out_with_distortion(calibration)
    lenses = calibration.spots.lenses
    radius = np.asarray(start.array.of_lenses("radius_of_curvature"))[lenses]
    pitch = pixels_per_mm * float(nearest_neighbour_distances(np.asarray(start.array.centers)).mean())
    spots = np.asarray(calibration.imager.sensor.to_pixels(calibration.spots.positions))
    measured = half_light_radii(image, spots, np.full(len(spots), pitch))
    with progress.step("Tracing rays"):
        rays = {depth: pixels_per_mm * ray_widths(start, depth)[lenses] for depth in (FAR, *SOURCES)}
    agree = lambda widths: float(np.corrcoef(widths, measured)[0, 1])
    best = max(SOURCES, key=lambda depth: agree(rays[depth]))
    every = np.arange(len(measured))
    others = [law(defocus_law(radius[every != k], measured[every != k]), radius[k]) for k in every]
    numbers = defocus_law(radius, measured)
    rms = lambda off: float(np.sqrt((off**2).sum(-1).mean()))
    # Where a wide spot is depends on the window that looks.
    ones = np.ones(len(spots))
    two = [mean_shift(image, spots, width * ones, pitch / 2 * ones, pitch / 4 * ones) for width in WINDOWS]
    wide = measured > np.median(measured)
    results = {
        "mirrored": calibration.mirrored,
        "values": calibration.values,
        "standard_deviations": calibration.deviations,
        "pixels_per_mm": pixels_per_mm,
        "lenses_matched": len(lenses),
        "lenses": len(start.array.centers),
        "fit_rms_pixels": calibration.rms,
        "left_out_rms_pixels": {
            "similarity": rms(similarity),
            "of_the_narrower_half": rms(similarity[~wide]),
            "of_the_wider_half": rms(similarity[wide]),
            "with_distortion": rms(distorted),
        },
        "middles_by_two_windows_differ_rms_pixels": rms(two[0] - two[1]),
        "half_light_radius_pixels": {"least": measured.min(), "most": measured.max()},
        "width_correlation": {
            "rays_far_source_nothing_fitted": agree(rays[FAR]),
            "rays_best_distance": agree(rays[best]),
            "law": agree(law(numbers, radius)),
            "law_left_out": agree(np.array(others)),
        },
        "best_source_distance_mm": float(best),
        "law": dict(zip(("w0_pixels", "k_pixels", "focused_radius_mm"), numbers.tolist(), strict=True)),
    }
    shown = {"found": calibration, "off": similarity, "radius": radius, "seen": measured, "numbers": numbers}
    return results, shown | {"far": rays[FAR], "best": rays[best]}


def picture(results: dict, shown: dict) -> Figure:
    """Spots with predicted places, their errors, and widths by radius. The image itself is not ours to show."""
    calibration, radius = shown["found"], shown["radius"]
    figure = Figure(figsize=(13, 4.4), dpi=100, layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    positions = np.asarray(calibration.imager.sensor.to_pixels(calibration.spots.positions))
    predicted = positions + shown["off"][:, ::-1]
    (low, high), margin = (predicted.min(0), predicted.max(0)), 30
    for position, width in zip(positions, shown["seen"], strict=True):
        left.add_patch(Circle((position[1], position[0]), width, alpha=0.4))
    left.scatter(*predicted.T[::-1], marker="+", s=40, linewidths=0.8, color="k")
    left.set_title("spots, half of their light; + predicted without this lens", fontsize=9)
    middle.scatter(*positions.T[::-1], c=radius, cmap="viridis", s=14)
    bar = figure.colorbar(middle.collections[0], ax=middle, shrink=0.8)
    bar.set_label("radius of curvature, mm")
    middle.quiver(*positions.T[::-1], *shown["off"].T, angles="xy", scale_units="xy", scale=0.2, width=0.004)
    errors = results["left_out_rms_pixels"]
    middle.set_title(f"predicted less observed, x 5: {errors['similarity']:.2f} pixels RMS", fontsize=9)
    for axis in (left, middle):
        axis.set(xlim=(low[1] - margin, high[1] + margin), ylim=(high[0] + margin, low[0] - margin), aspect="equal")
        axis.set(xticks=[], yticks=[])
    order, line = np.argsort(radius), np.linspace(radius.min(), radius.max(), 200)
    right.plot(radius, shown["seen"], "o", ms=4, label="measured")
    right.plot(line, law(shown["numbers"], line), label="lens out of focus, three numbers fitted")
    right.plot(radius[order], shown["far"][order], ".:", ms=3, lw=0.8, label="exact rays, nothing fitted")
    right.set(xlabel="radius of curvature, mm", ylabel="half-light radius, pixels", ylim=(0, None))
    agree = results["width_correlation"]
    far = agree["rays_far_source_nothing_fitted"]
    right.set_title(f"correlation with the measured {agree['law']:.2f} and {far:.2f}", fontsize=9)
    right.legend(fontsize=8)
    return figure


def report(data: Path, progress: Progress) -> Report:
    results, shown = run(data, progress=progress)
    rows = [
        [f"{group}: {name}", f"{value:.4g}"]
        for group in ("values", "left_out_rms_pixels", "width_correlation", "law")
        for name, value in results[group].items()
    ]
    rows.append(["middles by two windows differ", f"{results['middles_by_two_windows_differ_rms_pixels']:.3g}"])
    rows.insert(0, ["lenses matched", f"{results['lenses_matched']} of {results['lenses']}"])
    files = {"printed_array.json": results, "printed_array.png": picture(results, shown)}
    return Report(files, [table(("", "found"), rows)])


if __name__ == "__main__":
    main(report, {"data": {"type": Path}})
