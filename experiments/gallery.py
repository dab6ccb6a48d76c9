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

from experiments import (
    depth_scaling,
    fig3_resolution,
    fig4_suppression,
    fig5_fwhm_depth,
    fig6_usaf,
    fig7_beads,
    fig8_snowflake,
    optics_check,
    table1,
)
from experiments.backprojection_speed import Job, race
from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from gs_jax.apps import benchmark_report as benchmark
from gs_jax.apps.benchmark_report import markdown_table, time_exponents
from gs_jax.apps.method_benchmark import run as run_benchmark
from gs_jax.base.progress import Progress


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


def _met(results: bool, why: str) -> str:
    return "yes" if results else f"no: {why}"


def _is_within(ours: str, paper: str) -> bool:
    """Whether the texts are equal, or a number lies within a range, such as 520 nm and 500-530 nm."""
    number, limits = re.fullmatch(r"([\d.]+)( .*)?", ours), re.fullmatch(r"([\d.]+)-([\d.]+)( .*)?", paper)
    if ours == paper or not (number and limits):
        return ours == paper
    return float(limits[1]) <= float(number[1]) <= float(limits[2]) and number[2] == limits[3]


def table_1(data: Path | None, progress: Progress) -> Page:
    rows = table1.run()["table"]
    plain = lambda text: text.strip("~").split(" (")[0]
    same = lambda row: _is_within(plain(row["focused: v = 5.8 mm"]), plain(row["paper"]))
    claims = [
        Claim(
            "Table 1",
            row["what"],
            row["paper"],
            row["focused: v = 5.8 mm"],
            "yes" if same(row) else f"differs: {row['why']}",
        )
        for row in rows
        if row["paper"] != "-"
    ]
    return Page({}, claims)


def equation_1(data: Path | None, progress: Progress) -> Page:
    results = depth_scaling.run(design_of(data), data, progress=progress)
    rows = [row for each in results.values() for row in each]
    off = max(abs(row["s_z"] / row["by_eq_1"] - 1) for row in rows)
    z, s = np.array([(row["depth_mm"], row["by_eq_1"]) for row in rows]).T
    bent = np.abs(np.polynomial.Polynomial.fit(z, s, 1)(z) - s).max() / np.ptp(s)
    why = "cores of spots are off their chief rays; calibration accounts for it"
    claims = [
        Claim(
            "Eq. (1)", "scale of the pattern, s_z", "(z + v) / z", f"within {100 * off:.2f} %", _met(off < 1e-3, why)
        ),
        Claim(
            "Eq. (1)",
            "s_z with depth, 18 to 26 mm",
            "linear",
            f"{100 * bent:.0f} % of its range off a line",
            _met(bent < 0.01, "a hyperbola"),
        ),
    ]
    return Page({"depth_scaling.png": depth_scaling.picture(results)}, claims)


def strehl_ratio(data: Path | None, progress: Progress) -> Page:
    with progress.step("Rays"):
        results = optics_check.run()
    rows = results["field"] + results["depth"]
    least = min(row["wavefront_rms_waves"] for row in rows)
    off = max(abs(row["strehl"] - row["strehl_optiland"]) for row in rows)
    by_eq9 = [np.exp(-((2 * np.pi * row["wavefront_rms_waves"]) ** 2)) for row in rows]
    worst = max(abs(row["strehl"] - each) for row, each in zip(rows, by_eq9, strict=True))
    claims = [
        Claim(
            "Eq. (9)",
            "Strehl ratio against field",
            "exp(-(2 pi w)^2) of third-order w",
            f"that of the PSF agrees with Optiland's rays within {off:.2f}, and is up to {worst:.2f} off Eq. (9)",
            _met(worst < 0.02, f"Eq. (9) holds below 0.1 waves, the lens has {least:.1f} at least"),
        )
    ]
    return Page({"strehl.png": optics_check.curves(results)}, claims)


def figure_3(data: Path | None, progress: Progress) -> Page:
    results = fig3_resolution.run(design_of(data), data, progress=progress)
    best = results.get("ray-traced", results["gs_jax"])
    claim = lambda what, paper, key, form: Claim(
        "Fig. 3", what, paper, " / ".join(format(each[key], form) for each in results.values()),
        _met(best[key] <= fig3_resolution.BARS[key], "wider"),
    )  # fmt: skip
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
    f1 = lambda method: results["scores"][method]["f1"]
    plain, best = f1("the paper's clustering"), f1("clustering, the best")
    said = f"F1 {plain:.2f}, with the best of thresholds {best:.2f}"
    claims = [
        Claim("Fig. 4A", "120 points, 18 to 22 mm, by clustering", "faithfully reconstructed", said,
              _met(best > 0.95, "light of other lenses and haze exceed its thresholds")),
        Claim("Fig. 4A", "the same by find_points", "-", f"F1 {f1('find_points'):.3f}", "ours"),
    ]  # fmt: skip
    return Page({"fig4.png": fig4_suppression.picture(results)}, claims)


def figure_5(data: Path | None, progress: Progress) -> Page:
    results = fig5_fwhm_depth.run(design_of(data), data, depths=tuple(np.arange(17.0, 24.1, 1.0)), progress=progress)
    rows = results["gs_jax"]
    claims = []
    for key, bar, what in (("lateral_fwhm_um", 40, "lateral"), ("axial_fwhm_um", 300, "axial")):
        within = [row["depth_mm"] for row in rows if row[key] <= bar]
        said = f"within {bar} um at {', '.join(f'{z:g}' for z in within)} mm"
        stable = len(within) > 5
        why = "the sensor distance is the best one for 20 mm; sharper there"
        claims.append(Claim("Fig. 5", f"{what} FWHM over ~5 mm of depth", "stable", said, _met(stable, why)))
    return Page({"fig5.png": fig5_fwhm_depth.picture(results)}, claims)


def figure_6(data: Path | None, progress: Progress) -> Page:
    results = fig6_usaf.run(design_of(data), progress=progress)
    rows = fig6_usaf.numbers(results)
    right = sum(row["sharpest_mm"] == row["target_mm"] for row in rows)
    first = rows[0]
    both = min(first["vertical"], first["horizontal"])
    claims = [
        Claim("Fig. 6", "the plane of the target is the sharpest", "at six depths", f"at {right} of {len(rows)}",
              _met(right == len(rows), "another plane is sharper")),
        Claim("Fig. 6", "group 3, element 2 at 18 mm", "clearly resolved", f"contrast {both:.2f}",
              _met(both >= fig6_usaf.RESOLVED, "contrast below 0.1")),
        Claim("Fig. 6", "finest resolved lines, by depth", "-",
              "; ".join(f"{row['target_mm']:g} mm: {row['finest']}" for row in rows), "ours"),
    ]  # fmt: skip
    return Page({"fig6.png": fig6_usaf.picture(results)}, claims)


def figure_7(data: Path | None, progress: Progress) -> Page:
    results = fig7_beads.run(design_of(data), data, progress=progress)
    claims = []
    for name, result in results.items():
        score = result["scores"]
        said = f"{score['found']} of {score['points']}, F1 {score['f1']:.3f}, {score['axial_rmse_um']:.0f} um axially"
        claims.append(Claim("Fig. 7", name, "resolved at different depths", said, _met(score["f1"] > 0.95, "missed")))
    return Page({"fig7.png": fig7_beads.picture(results)}, claims)


def figure_8(data: Path | None, progress: Progress) -> Page:
    scenes = fig8_snowflake.run(design_of(data), data, progress=progress)["scenes"]
    pictures, claims = {}, []
    for name, scene in scenes.items():
        psnr = {method: score["psnr_db"] for method, score in scene["scores"].items()}
        said = ", ".join(f"{psnr[m]:.1f} dB ({m})" for m in ("all zero", "back-projection", *fig8_snowflake.NETWORKS))
        better = psnr["paper's network"] > max(psnr["all zero"], psnr["back-projection"])
        claim = Claim("Figs. 4B, 8", name, "its network recovers the object", said, _met(better, "ours does"))
        claims.append(claim)
        shown = (18.0,) if "USAF" in name else (18.0, 20.0, 22.0)
        file = f"fig8_{name.split(',')[0].lower().replace(' ', '_')}_{name.split()[-1]}.png"
        pictures[file] = fig8_snowflake.picture(scene, shown, upward="ray-traced" in name)
    return Page(pictures, claims)


def figure_9(data: Path | None, progress: Progress) -> Page:
    with progress.step("Back-projection at the paper's full scale"):
        ours = race(Job(), ["gs_jax"], 5, {})["contestants"]["gs_jax"]["median_s"]
    records, _ = run_benchmark(_SIDES, progress=progress)
    exponents = time_exponents(records)
    claims = [
        Claim(
            "Fig. 8",
            "13 depths, 4e6 voxels, 1e14 pairs",
            "18 s on 8 threads",
            f"{1000 * ours:.0f} ms",
            _met(ours < 18, "slower"),
        ),
        Claim(
            "Fig. 9",
            "speed",
            "close to video rate some day",
            f"{1 / ours:.0f} volumes a second",
            _met(1 / ours > 20, "below 20 a second"),
        ),
    ]
    for method, paper in _EXPONENTS.items():
        if method in exponents:
            met = exponents[method] < paper if method == "backproject" else abs(exponents[method] - paper) < 0.2
            why = "small matrices fit the cache"
            said = f"{exponents[method]:.2f}"
            claims.append(
                Claim(
                    "Fig. 9A",
                    f"exponent of time in pairs, {method}",
                    f"{'< ' if paper < 1 else ''}{paper:g}",
                    said,
                    _met(met, why),
                )
            )
    most = max(r["pairs"] for r in records)
    mean = lambda method: statistics.fmean(
        [r["psnr_db"] for r in records if r["method"] == method and r["pairs"] == most]
    )
    said = ", ".join(f"{mean(m):.1f} dB ({m})" for m in ("backproject + clusters", "admm", "richardson-lucy", "fista"))
    near = mean("backproject + clusters") > min(mean("admm"), mean("richardson-lucy")) - 1
    claims.append(
        Claim(
            "Fig. 9B-D",
            f"clustering at {most:.0e} pairs",
            "approaches the solvers",
            said,
            _met(near, "more than 1 dB below the lesser of both"),
        )
    )
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
    taken = ", ".join(f"{title.split(':')[0]} {each:.0f} s" for title, each in seconds.items())
    return "\n\n".join([*parts, f"Made in {sum(seconds.values()) / 60:.0f} min: {taken}."]) + "\n"


def report(data: Path | None, only: str, progress: Progress) -> Report:
    pages = [title for title in PAGES if only.lower() in title.lower()]
    results, seconds = run(data, pages, progress=progress)
    pictures = {name: figure for page in results.values() for name, figure in page.pictures.items()}
    claims = [claim for page in results.values() for claim in page.claims]
    return Report({"gallery.md": markdown(results, seconds), **pictures}, [table(Claim._fields, claims)])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH, "--only": {"default": "", "help": "Pages with this in their title."}})
