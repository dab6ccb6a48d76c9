"""All figures and tables of the paper that can be simulated: the paper's claims, our results, and pictures.

    make figures
    python -m experiments.gallery [DATA] [--out DIR]

DATA holds the ray-traced captures (`P1.toml`, `P1_*.tif`, `*.json`); without it only simulated captures are used.
Writes `gallery.md` and the pictures; under half an hour on two cores. The experiments' own scripts do more: other
sizes, controls, and results that are not in the paper.
"""

import re
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments import fig3_resolution, fig4_suppression, fig6_usaf, fig8_snowflake, optics_check, table1
from experiments.backprojection_speed import Job, race
from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from gs_jax import Progress
from gs_jax.apps import benchmark
from gs_jax.apps.benchmark import markdown_table, run as run_benchmark, time_exponents


class Claim(NamedTuple):
    """A row of the table; `met` is yes, or the reason why not."""

    where: str
    what: str
    paper: str
    ours: str
    met: str


class Page(NamedTuple):
    """Pictures by file name, and claims, of one figure of the paper."""

    pictures: dict[str, Figure]
    claims: list[Claim]


# Fig. 9: pixels along a side, and the paper's exponents of time against pixel-voxel pairs.
_SIDES = (32, 56, 100, 212)
_EXPONENTS = {"backproject": 0.5, "richardson-lucy, dense": 1.0, "admm, dense": 1.0}


def _met(met: bool, why: str) -> str:
    return "yes" if met else f"no: {why}"


def _is_within(ours: str, paper: str) -> bool:
    """Whether the texts are equal, or a number lies within a range, such as 520 nm and 500-530 nm."""
    number, limits = re.fullmatch(r"([\d.]+)( .*)?", ours), re.fullmatch(r"([\d.]+)-([\d.]+)( .*)?", paper)
    if ours == paper or not (number and limits):
        return ours == paper
    return float(limits[1]) <= float(number[1]) <= float(limits[2]) and number[2] == limits[3]


def table_1(data: Path | None, progress: Progress) -> Page:
    plain = lambda text: text.strip("~").split(" (")[0]
    claims = []
    for row in table1.run()["table"]:
        what, paper, ours = row["what"], row["paper"], row["focused: v = 5.8 mm"]
        same = _is_within(plain(ours), plain(paper))
        claims.append(Claim("Table 1", what, paper, ours, "yes" if same else f"differs: {row['why']}"))
    return Page({}, [claim for claim in claims if claim.paper != "-"])


def equation_1(data: Path | None, progress: Progress) -> Page:
    results = optics_check.scales(design_of(data), data, progress=progress)
    rows = [row for lines in results.values() for row in lines]
    off = max(abs(row["s_z"] / row["by_eq_1"] - 1) for row in rows)
    z, s = np.array([(row["depth_mm"], row["by_eq_1"]) for row in rows]).T
    bent = np.abs(np.polynomial.Polynomial.fit(z, s, 1)(z) - s).max() / np.ptp(s)
    met = _met(off < 1e-3, "cores of spots are off their chief rays; calibration accounts for it")
    straight, bend = _met(bent < 0.01, "a hyperbola"), f"{100 * bent:.0f} % of its range off a line"
    claims = [
        Claim("Eq. (1)", "scale of the pattern, s_z", "(z + v) / z", f"within {100 * off:.2f} %", met),
        Claim("Eq. (1)", "s_z with depth, 18 to 26 mm", "linear", bend, straight),
    ]
    return Page({"depth_scaling.png": optics_check.picture_of_scales(results)}, claims)


def strehl_ratio(data: Path | None, progress: Progress) -> Page:
    with progress.step("Rays"):
        results = optics_check.run()
    rows = results["field"] + results["depth"]
    least = min(row["wavefront_rms_waves"] for row in rows)
    off = max(abs(row["strehl"] - row["strehl_optiland"]) for row in rows)
    by_eq9 = [np.exp(-((2 * np.pi * row["wavefront_rms_waves"]) ** 2)) for row in rows]
    worst = max(abs(row["strehl"] - ratio) for row, ratio in zip(rows, by_eq9, strict=True))
    ours = f"that of the PSF agrees with Optiland's rays within {off:.2f}, and is up to {worst:.2f} off Eq. (9)"
    met = _met(worst < 0.02, f"Eq. (9) holds below 0.1 waves, the lens has {least:.1f} at least")
    claim = Claim("Eq. (9)", "Strehl ratio against field", "exp(-(2 pi w)^2) of third-order w", ours, met)
    return Page({"strehl.png": optics_check.curves(results)}, [claim])


def figure_3(data: Path | None, progress: Progress) -> Page:
    results = fig3_resolution.run(design_of(data), data, progress=progress)
    best = results.get("ray-traced", results["gs_jax"])

    def claim(what: str, paper: str, key: str, form: str) -> Claim:
        ours = " / ".join(format(result[key], form) for result in results.values())
        return Claim("Fig. 3", what, paper, ours, _met(best[key] <= fig3_resolution.BARS[key], "wider"))

    sources = " / ".join(results)
    claims = [
        claim(f"a point at 20 mm: lateral FWHM, um ({sources})", "~40", "lateral_fwhm_um", ".0f"),
        claim("axial FWHM, um", "~300", "axial_fwhm_um", ".0f"),
        claim("two points 40 um apart: the dip between them", "below ~0.85", "lateral_dip", ".2f"),
        claim("two points 300 um apart axially: the dip", "resolved", "axial_dip", ".2f"),
    ]
    return Page({"fig3.png": fig3_resolution.picture(results)}, claims)


def figure_4(data: Path | None, progress: Progress) -> Page:
    results = list(fig4_suppression.run(design_of(data), data, progress=progress).values())[-1]
    f1 = {method: score.get("f1") for method, score in results["scores"].items()}
    plain, best = f1["the paper's clustering"], f1["clustering, the best"]
    ours = f"F1 {plain:.2f}, with the best of thresholds {best:.2f}"
    met = _met(best > 0.95, "light of other lenses and haze exceed its thresholds")
    claims = [
        Claim("Fig. 4A", "120 points, 18 to 22 mm, by clustering", "faithfully reconstructed", ours, met),
        Claim("Fig. 4A", "the same by find_points", "-", f"F1 {f1['find_points']:.3f}", "ours"),
    ]
    return Page({"fig4.png": fig4_suppression.picture(results)}, claims)


def figure_5(data: Path | None, progress: Progress) -> Page:
    depths = tuple(np.arange(17.0, 24.1, 1.0))
    results = fig3_resolution.over_depth(design_of(data), data, depths, progress=progress)
    claims = []
    for what in ("lateral", "axial"):
        bar = fig3_resolution.BARS[f"{what}_fwhm_um"]
        within = [row["depth_mm"] for row in results["gs_jax"] if row[f"{what}_fwhm_um"] <= bar]
        ours = f"within {bar} um at {', '.join(f'{z:g}' for z in within)} mm"
        met = _met(len(within) > 5, "the sensor distance is the best one for 20 mm; sharper there")
        claims.append(Claim("Fig. 5", f"{what} FWHM over ~5 mm of depth", "stable", ours, met))
    return Page({"fig5.png": fig3_resolution.picture_over_depth(results)}, claims)


def figure_6(data: Path | None, progress: Progress) -> Page:
    results = fig6_usaf.run(design_of(data), progress=progress)
    rows = fig6_usaf.numbers(results)
    right = sum(row["sharpest_mm"] == row["target_mm"] for row in rows)
    both = min(rows[0]["vertical"], rows[0]["horizontal"])
    sharp, resolved = _met(right == len(rows), "another is"), _met(both >= fig6_usaf.RESOLVED, "contrast below 0.1")
    finest = "; ".join(f"{row['target_mm']:g} mm: {row['finest']}" for row in rows)
    claims = [
        Claim(
            "Fig. 6", "the plane of the target is the sharpest", "at six depths", f"at {right} of {len(rows)}", sharp
        ),
        Claim("Fig. 6", "group 3, element 2 at 18 mm", "clearly resolved", f"contrast {both:.2f}", resolved),
        Claim("Fig. 6", "finest resolved lines, by depth", "-", finest, "ours"),
    ]
    return Page({"fig6.png": fig6_usaf.picture(results)}, claims)


def figure_7(data: Path | None, progress: Progress) -> Page:
    results = fig4_suppression.find_beads(design_of(data), data, progress=progress)
    claims = []
    for name, score in ((name, result["scores"]) for name, result in results.items()):
        ours = f"{score['found']} of {score['points']}, F1 {score['f1']:.3f}, {score['axial_rmse_um']:.0f} um axially"
        claims.append(Claim("Fig. 7", name, "resolved at different depths", ours, _met(score["f1"] > 0.95, "missed")))
    return Page({"fig7.png": fig4_suppression.picture_of_beads(results)}, claims)


def figure_8(data: Path | None, progress: Progress) -> Page:
    scenes = fig8_snowflake.run(design_of(data), data, progress=progress)["scenes"]
    pictures, claims = {}, []
    for name, scene in scenes.items():
        psnr = {method: score["psnr_db"] for method, score in scene["scores"].items()}
        ours = ", ".join(f"{psnr[m]:.1f} dB ({m})" for m in ("all zero", "back-projection", *fig8_snowflake.NETWORKS))
        better = psnr["paper's network"] > max(psnr["all zero"], psnr["back-projection"])
        claims.append(Claim("Figs. 4B, 8", name, "its network recovers the object", ours, _met(better, "ours does")))
        shown = (18.0,) if "USAF" in name else (18.0, 20.0, 22.0)
        file = f"fig8_{name.split(',')[0].lower().replace(' ', '_')}_{name.split()[-1]}.png"
        pictures[file] = fig8_snowflake.picture(scene, shown, upward="ray-traced" in name)
    return Page(pictures, claims)


def figure_9(data: Path | None, progress: Progress) -> Page:
    with progress.step("Back-projection at the paper's full scale"):
        seconds = race(Job(), ["gs_jax"], 5, {})["contestants"]["gs_jax"]["median_s"]
    records, _ = run_benchmark(_SIDES, progress=progress)
    time, rate = f"{1000 * seconds:.0f} ms", f"{1 / seconds:.0f} volumes a second"
    fast, live = _met(seconds < 18, "slower"), _met(1 / seconds > 20, "below 20 a second")
    claims = [
        Claim("Fig. 8", "13 depths, 4e6 voxels, 1e14 pairs", "18 s on 8 threads", time, fast),
        Claim("Fig. 9", "speed", "close to video rate some day", rate, live),
    ]
    exponents = time_exponents(records)
    for method, paper in _EXPONENTS.items():
        if (ours := exponents.get(method)) is not None:
            met = _met(ours < paper if paper < 1 else abs(ours - paper) < 0.2, "small matrices fit the cache")
            claim = f"{'< ' if paper < 1 else ''}{paper:g}"
            claims.append(Claim("Fig. 9A", f"exponent of time in pairs, {method}", claim, f"{ours:.2f}", met))
    most = max(r["pairs"] for r in records)
    largest = lambda method: [r["psnr_db"] for r in records if r["method"] == method and r["pairs"] == most]
    names = ("backproject + clusters", "admm", "richardson-lucy", "fista")
    mean = {name: statistics.fmean(largest(name)) for name in names}
    ours = ", ".join(f"{value:.1f} dB ({name})" for name, value in mean.items())
    near = mean["backproject + clusters"] > min(mean["admm"], mean["richardson-lucy"]) - 1
    met = _met(near, "more than 1 dB below the lesser of both")
    claims.append(Claim("Fig. 9B-D", f"clustering at {most:.0e} pairs", "approaches the solvers", ours, met))
    return Page({"fig9.png": benchmark.picture(records)}, claims)


PAGES: dict[str, Callable[[Path | None, Progress], Page]] = {
    "Table 1: the design": table_1,
    "Eq. (1): the pattern's scale": equation_1,
    "Eq. (9): the Strehl ratio": strehl_ratio,
    "Fig. 3: one point and two": figure_3,
    "Fig. 4A: points in 3-D": figure_4,
    "Fig. 5: width against depth": figure_5,
    "Fig. 6: resolution target": figure_6,
    "Fig. 7: beads": figure_7,
    "Figs. 4B and 8: volumes": figure_8,
    "Fig. 9: against solvers": figure_9,
}


def run(data: Path | None, pages: list[str], *, progress: Progress) -> tuple[dict[str, Page], dict[str, float]]:
    """Return each page, and the seconds it took."""
    results, seconds = {}, {}
    for title in progress.track(pages, "Figures"):
        begun = time.monotonic()
        results[title] = PAGES[title](data, progress)
        seconds[title] = time.monotonic() - begun
    return results, seconds


def markdown(pages: dict[str, Page], seconds: dict[str, float]) -> str:
    claims = [claim for page in pages.values() for claim in page.claims]
    parts = [
        "# The paper's figures and tables",
        "What F. Tian, J. Hu and W. Yang claim (Laser & Photonics Reviews 15, 2100072, 2021), and what we find.",
        markdown_table(("where", "what", "paper", "ours", "met"), claims),
    ]
    for title, page in pages.items():
        pictures = [f"![{title}]({name})" for name in page.pictures]
        if pictures:
            parts += [f"## {title}", *pictures]
    taken = ", ".join(f"{title.split(':')[0]} {taken_s:.0f} s" for title, taken_s in seconds.items())
    return "\n\n".join([*parts, f"Made in {sum(seconds.values()) / 60:.0f} min: {taken}."]) + "\n"


def report(data: Path | None, only: str, progress: Progress) -> Report:
    pages = [title for title in PAGES if only.lower() in title.lower()]
    results, seconds = run(data, pages, progress=progress)
    pictures = {name: figure for page in results.values() for name, figure in page.pictures.items()}
    claims = [claim for page in results.values() for claim in page.claims]
    return Report({"gallery.md": markdown(results, seconds), **pictures}, [table(Claim._fields, claims)])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH, "--only": {"default": "", "help": "Pages with this in their title."}})
