"""Whether objectives rank designs as reconstructed scenes do, for three specifications: Spearman's correlations.

An endoscope, a well plate and a deep volume each have a rule of thumb, what `gs-jax new-design` writes, and random
designs of other numbers of lenses, foci, apertures and distances. The judge is that of `experiments/design_judge.py`,
rays through all lenses onto the whole sensor, on dense texture of 1 mm times the scale, at 3,000 electrons in the
brightest pixel of the rule of thumb. A design counts with the mean gain over an empty volume, dB.

    python -m experiments.design_ranks [--seeds 7] [--records FOLDER] [--out DIR]

Writes the records after each scene, from which the next run goes on, and then `design_ranks.md`; three to fifteen
minutes of a core for each design.
"""

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import rankdata

from experiments.common import Report, main, tables_report
from experiments.design_judge import Judge, Settings, make_scene
from gs_jax import Design, InputError, Progress, quality, random_layout, rasterize, read_design
from gs_jax.codesign.terms import TERMS
from gs_jax.io.files import make_folder
from gs_jax.objectives import Conditions

METHODS = ("richardson-lucy", "unrolled")
# Terms, and whether more is better. What depends on the layout alone, or is a limit, is left out.
BETTER = {
    "volume_error": -1,
    "width_per_light_um": -1,
    "psf_width_um": -1,
    "encircled_radius_um": -1,
    "blur_um": -1,
    "light_percent": 1,
    "lateral_resolution_um": -1,
    "axial_resolution_um": -1,
    "lenses_per_point": 1,
    "occupancy": -1,
}
# Depths of terms, and the exposures of `volume_error`.
DEPTHS, EXPOSURES = 7, (1e3, 1e4)
# The draw of the scenes.
DRAW = 11


class Specification(NamedTuple):
    """A rule of thumb in `experiments/designs`, the depths, mm, and the scale of scenes beside the paper's."""

    start: str
    span: tuple[float, float]
    scale: float

    @property
    def settings(self) -> Settings:
        return Settings(self.span, field=1.0, kinds=("texture",), exposures=(3_000,), rays=400, scale=self.scale)


SPECIFICATIONS = {
    "endoscope": Specification("endoscope-start", (3.0, 6.0), 0.4),
    "well plate": Specification("well-plate-start", (8.0, 11.0), 0.5),
    "deep volume": Specification("deep-start", (15.0, 30.0), 1.0),
}


def start_of(specification: Specification) -> Design:
    return read_design(Path(__file__).parent / f"designs/{specification.start}.toml")


def random_design(specification: Specification, seed: int) -> Design:
    """A device on the same sensor and plate that could be made; its types are in focus, or nearly, over the depths."""
    start = start_of(specification)
    rng = np.random.default_rng([seed, *specification.start.encode()])
    count, types = round(np.exp(rng.uniform(np.log(80), np.log(300)))), int(rng.choice([1, 3, 3, 5]))
    distance = start.imaging.sensor_distance_mm * rng.uniform(0.75, 1.25)
    fill, focus = rng.uniform(0.35, 1.1), rng.uniform(0.97, 1.03)
    imager = start.replace(sensor_distance_mm=float(distance)).imager()
    size = start.array.size_mm
    assert size is not None
    centers = np.asarray(random_layout(count, size, diameter=None, seed=seed))
    # Evenly over the depths in vergence.
    depths = 1 / np.linspace(1 / specification.span[1], 1 / specification.span[0], 2 * types + 1)[1::2]
    vergence = 1 / np.asarray(imager.reduced_depth(depths)) + 1 / float(imager.reduced_sensor_distance)
    radii = (float(imager.array.refractive_index) - 1) * focus / vergence
    pitch = np.sqrt(size[0] * size[1] / len(centers) * 2 / np.sqrt(3))
    radius = radii[rng.permutation(len(centers)) % types]
    design = start.replace(
        centers_mm=centers,
        sensor_distance_mm=float(distance),
        radius_of_curvature_mm=float(radius[0]) if types == 1 else radius.tolist(),
        aperture_diameter_mm=float(min(fill * pitch, 1.4 * radii.min())),
    )
    return design.model_copy(update={"name": f"random {seed}", "provenance": {}})


def gains(found: dict[str, Any], empty: dict[str, float], method: str) -> float:
    """Mean gain over an empty volume over the scenes, dB."""
    return float(np.mean([record["3000"][method]["psnr_db"] - empty[key] for key, record in found.items()]))


def empty_scores(settings: Settings) -> dict[str, float]:
    """PSNR of empty volumes by scene, dB."""
    scores = {}
    for kind in settings.kinds:
        truth = np.asarray(rasterize(make_scene(kind, DRAW, settings).emitters, settings.grid), np.float32)
        scores[f"{kind} {DRAW}"] = quality(0 * truth, truth).psnr_db
    return scores


def term_of(name: str, design: Design, specification: Specification) -> float:
    """A term's worst value over its entries, as a logarithm, larger for better."""
    at = Conditions(np.linspace(*specification.span, DEPTHS), detail=0.04 * specification.scale)
    exposures = EXPOSURES if name == "volume_error" else EXPOSURES[:1]
    function, worst = eqx.filter_jit(TERMS[name].function), []
    for exposure in exposures:
        changed = eqx.tree_at(lambda at: at.exposure, at, jnp.asarray(exposure, at.exposure.dtype))
        values = np.log(np.ravel(function(design.imager(), changed)))
        worst.append(values.min() if BETTER[name] > 0 else values.max())
    return BETTER[name] * float(np.mean(worst))


def correlation(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float]:
    """Spearman's correlation, and its 95 % interval by a bootstrap over designs."""
    rng = np.random.default_rng(0)
    drawn = [spearman(a[i], b[i]) for i in rng.integers(0, len(a), (2000, len(a)))]
    low, high = np.nanquantile(drawn, (0.025, 0.975))
    return spearman(a, b), float(low), float(high)


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of ranks."""
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def report(seeds: int, records: Path, progress: Progress) -> Report:
    if seeds < 3:
        raise InputError(f"--seeds must be 3 or more, got {seeds}.")
    make_folder(records)
    names = ["start", *(f"random {seed}" for seed in range(seeds))]
    designs = {
        (title, name): random_design(each, seed - 1) if seed else start_of(each)
        for seed, name in enumerate(names)
        for title, each in SPECIFICATIONS.items()
    }
    judges = {
        title: Judge(records / f"{each.start}.json", each.settings, start_of(each).imager())
        for title, each in SPECIFICATIONS.items()
    }
    empty = {title: empty_scores(each.settings) for title, each in SPECIFICATIONS.items()}
    by_name: dict[str, dict[str, Any]] = {}
    for (title, name), design in designs.items():
        found = judges[title].judge(name, design.imager(), (DRAW,), progress)
        judged = {method: gains(found, empty[title], method) for method in METHODS}
        terms = {term: term_of(term, design, SPECIFICATIONS[title]) for term in BETTER}
        by_name[f"{title}, {name}"] = judged | {"terms": terms, "lenses": len(design.array.centers_mm)}
    return shown(by_name)


def shown(by_name: dict[str, dict[str, Any]]) -> Report:
    """Tables of correlations with the judge: the mean over the specifications, and all relative to their starts."""
    groups = {title: [key for key in by_name if key.startswith(f"{title}, ")] for title in SPECIFICATIONS}

    def values(read: Callable[[dict[str, Any]], float], keys: Sequence[str]) -> np.ndarray:
        return np.array([read(by_name[key]) for key in keys])

    def relative(read: Callable[[dict[str, Any]], float]) -> np.ndarray:
        return np.concatenate([values(read, keys) - read(by_name[keys[0]]) for keys in groups.values()])

    rows = []
    for term in BETTER:
        row = [f"`{term}`"]
        for method in METHODS:
            pair = (lambda r, m=method: r[m]), (lambda r, term=term: r["terms"][term])
            within = [spearman(*(values(read, keys) for read in pair)) for keys in groups.values()]
            row += [
                "{:.2f} ({:.2f} to {:.2f})".format(*correlation(*map(relative, pair))),
                " / ".join(f"{x:.2f}" for x in within),
            ]
        rows.append(row)
    columns = tuple(f"{method}, {what}" for method, what in product(METHODS, ("all", "each specification")))
    cells = [[key, str(r["lenses"]), *(f"{r[method]:.1f}" for method in METHODS)] for key, r in by_name.items()]
    of_designs = ("design", "lenses", *(f"{method}, dB" for method in METHODS)), cells
    return tables_report("design_ranks", by_name, (("objective", *columns), rows), of_designs)


if __name__ == "__main__":
    records = {"type": Path, "default": Path("out/design_ranks")}
    main(report, {"--seeds": {"type": int, "default": 7}, "--records": records})
