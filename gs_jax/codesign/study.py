"""Study files, TOML: the free parameters, the terms with their targets, and the solvers.

design = "../geomscope.toml"            # to start from; `gs-jax optimize` takes its own
name = "geomscope-optimized"
depths_mm = [18.0, 23.0]
confusion_um = 36.0
types = 1                               # of lenses: 2 for two foci on one plate
sample = "water"                        # one of the design's [samples]; its [sample] by default

[free]                                  # name = [lowest, highest]; see gs_jax.codesign.parameters
sensor_distance_mm = [2.0, 6.0]

[[terms]]                               # see gs_jax.codesign.terms
name = "occupancy"
at_most = 0.5

[[stages]]
solver = "levenberg-marquardt"
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from pydantic import AfterValidator, Field, ValidationError, model_validator

from ..base.errors import InputError, short_repr
from ..base.typing import PathLike
from ..design.conversion import object_begins, reduced_depth, reduced_sensor_distance, sample_table
from ..design.design import Design
from ..io.toml import Table, one_line, read_toml
from ..microscope.layouts import interleave
from ..microscope.lenses import Orientation
from ..objectives.conditions import DETAIL
from .parameters import NAMES
from .terms import GOALS, KINDS, check_term, current_name

Solver = Literal["levenberg-marquardt", "bfgs", "lbfgs", "lbfgsb", "adam"]
# Relative difference within which an equality holds.
_LEAST_TOLERANCE = 1e-3

# Lower limits of free parameters that are not lengths.
_LOWER_LIMITS = {
    "refractive_index": 1,
    "centers_mm": -math.inf,
    "conic_constant": -math.inf,
    "aspheric_terms": -math.inf,
}

Positive = Annotated[float, Field(gt=0, le=1e9)]
Range = Annotated[tuple[float, float], Field(strict=False)]
Entries = Sequence[float] | Float[Array | np.ndarray, " entry"]
TermName = Annotated[str, AfterValidator(current_name)]
Depths = Annotated[tuple[Positive, Positive], Field(strict=False, description="[near, far] in mm, near below far")]


class Row(NamedTuple):
    """Lowest and highest entry of a term, and whether it meets its target (None without one)."""

    low: float
    high: float
    met: bool | None


class TermTable(Table):
    """`[[terms]]`: a term, its target or direction, and its weight.

    `at_most`, `at_least`, `equal`: a target for every entry of the term. `minimise`, `maximise`: the value that counts
    as 1; the worst entry of a term counts.
    """

    name: TermName = Field(description="the name of a term")
    at_most: Positive | None = Field(default=None, description="a positive number")
    at_least: Positive | None = Field(default=None, description="a positive number")
    equal: Positive | None = Field(default=None, description="a positive number")
    minimise: Positive | None = Field(default=None, description="a positive number")
    maximise: Positive | None = Field(default=None, description="a positive number")
    weight: Positive = Field(default=1.0, description="a positive number")

    @model_validator(mode="after")
    def _check_target(self) -> "TermTable":
        check_term(self.name)
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            got = " and ".join(kinds) or "none"
            raise ValueError(f"{self.name}: one of {', '.join(KINDS)} must be given, got {got}")
        return self

    @property
    def kind(self) -> str:
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def target(self) -> float:
        return getattr(self, self.kind)

    @property
    def is_goal(self) -> bool:
        """Whether the term is minimised or maximised."""
        return self.kind in GOALS

    def worst(self, entries: Entries) -> float:
        """The entry farthest from the target."""
        entries = np.asarray(entries)
        if self.kind == "equal":
            return float(entries[np.argmax(np.abs(entries - self.target))])
        return float(entries.min() if self.kind in ("at_least", "maximise") else entries.max())

    def assess(self, entries: Entries) -> Row:
        """Compare the entries of the term with its target. An equality holds within 0.1 %."""
        low, high, target = float(np.min(entries)), float(np.max(entries)), self.target
        off = max(abs(low - target), abs(high - target)) / target
        met = {"at_most": high <= target, "at_least": low >= target, "equal": off <= _LEAST_TOLERANCE}.get(self.kind)
        return Row(low, high, met)


class StageTable(Table):
    """`[[stages]]`: a solver for some of the parameters and terms, all by default. Stages run one after the other.

    `learning_rate`: of Adam, at the start; it falls to zero over the steps.
    """

    solver: Solver = Field(description="one of levenberg-marquardt, bfgs, lbfgs, lbfgsb, adam")
    steps: int = Field(default=200, ge=1, le=10**7, description="a whole number from 1 to 1e7")
    learning_rate: Positive = Field(default=0.03, description="a positive number")
    free: tuple[str, ...] | None = Field(default=None, strict=False, description="names of parameters in [free]")
    terms: tuple[TermName, ...] | None = Field(default=None, strict=False, description="names of terms in [[terms]]")

    def of(self, terms: Sequence[TermTable]) -> list[TermTable]:
        """The terms that the stage looks at."""
        return [term for term in terms if self.terms is None or term.name in self.terms]


class LimitTable(Table):
    """`[[pareto]]`: a term with a list of limits, each with a weight of 30.

    It replaces the term of that name and kind, if there is one.
    """

    name: TermName = Field(description="the name of a term")
    at_most: tuple[Positive, ...] | None = Field(default=None, strict=False, description="positive numbers")
    at_least: tuple[Positive, ...] | None = Field(default=None, strict=False, description="positive numbers")

    @model_validator(mode="after")
    def _check_target(self) -> "LimitTable":
        check_term(self.name)
        if bool(self.at_most) == bool(self.at_least):
            got = "both" if self.at_most else "neither"
            raise ValueError(f"{self.name}: one of at_most and at_least must be given, got {got}")
        return self

    @property
    def kind(self) -> Literal["at_most", "at_least"]:
        return "at_most" if self.at_most else "at_least"

    @property
    def targets(self) -> tuple[float, ...]:
        return self.at_most or self.at_least or ()


class Study(Table):
    """A study; the module's docstring has an example of its file.

    `margin`: fraction by which targets are tightened during the search, so that the rounded result meets them.
    `exposure`: electrons that each mm^2 of clear aperture, 20 mm away in air, would collect without losses from an
    emitter of 40 um x 40 um, for terms that count light. `detail_um`: width of the scene's voxels, for `volume_error`.
    `orientation`: side of the lenses toward the object, if it is not the design's. `sample`: of the design's
    `[samples]`, or "none", the one that holds the object; it becomes that of the new design, and must be given if the
    design has several and no `[sample]`. `types`: number of lens types (`kinds` in earlier versions, which is still
    read); lenses that are alike are divided into so many types, with radii spread over the depths, and each type has
    its own radius, aperture and conic constant.
    `starts`: number of starts of the first stage; all but the first are random within the bounds, and the best goes on.
    `seed`: of random numbers.
    """

    design: str | None = Field(default=None, description="the file of a design, relative to the study")
    name: str = Field(default="optimized", description="a string")
    orientation: Orientation | None = Field(default=None, description='"plano" or "curved"')
    sample: str | None = Field(default=None, description='the name of one of the design\'s `[samples]`, or "none"')
    types: int | None = Field(default=None, ge=1, description="a positive whole number")
    depths_mm: Depths | None = Field(default=None, description="[near, far] in mm, near below far")
    depth_count: int = Field(default=6, ge=2, le=1000, description="a whole number from 2 to 1000")
    confusion_um: Positive | None = Field(default=None, description="a positive number of micrometres")
    exposure: Positive = Field(default=1e4, description="a positive number of electrons")
    detail_um: Positive = Field(default=1000 * DETAIL, description="a positive number of micrometres")
    margin: float = Field(default=0.005, ge=0, le=0.5, description="a number from 0 to 0.5")
    starts: int = Field(default=1, ge=1, le=10_000, description="a whole number from 1 to 10000")
    seed: int = Field(default=0, ge=0, le=2**31 - 1, description="a whole number from 0 to 2147483647")
    free: dict[str, Range] = Field(description="a table of name = [lowest, highest]")
    terms: tuple[TermTable, ...] = Field(strict=False, min_length=1, description="one or more tables")
    stages: tuple[StageTable, ...] = Field(strict=False, min_length=1, description="one or more tables")
    pareto: tuple[LimitTable, ...] = Field(default=(), strict=False, max_length=2, description="one or two tables")

    @property
    def scene(self) -> dict[str, Any]:
        """What `evaluated` takes beside depths: circle of confusion, exposure and detail, mm and electrons."""
        circle_of_confusion = None if self.confusion_um is None else self.confusion_um / 1000
        return {
            "circle_of_confusion": circle_of_confusion,
            "exposure": self.exposure,
            "detail": self.detail_um / 1000,
        }

    @model_validator(mode="before")
    @classmethod
    def _rename_old_keys(cls, data: Any) -> Any:
        if isinstance(data, dict) and "kinds" in data and "types" not in data:
            return {"types" if key == "kinds" else key: value for key, value in data.items()}
        return data

    @model_validator(mode="after")
    def _fits_together(self) -> "Study":
        for check in (_check_free, _check_terms, _check_stages, _check_pareto):
            check(self)
        return self


def only_goal(terms: Sequence[TermTable]) -> TermTable | None:
    """The one term that is minimised or maximised; None if there are several or none."""
    goals = [term for term in terms if term.is_goal]
    return goals[0] if len(goals) == 1 else None


def labels(terms: Sequence[TermTable], study: Study) -> list[str]:
    """Names of terms in records, with the kind where a study has a name twice."""
    names = [term.name for term in study.terms]
    return [term.name if names.count(term.name) == 1 else f"{term.name} {term.kind}" for term in terms]


def read_study(path: PathLike) -> Study:
    """The study in a TOML file.

    *File.*

    Raises
    ------
    InputError
        If the file cannot be read, or a key is missing, extra, of the wrong type or out of its range.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("study.toml").write_text('''
    ... depths_mm = [18.0, 22.0]
    ... [free]
    ... sensor_distance_mm = [4.0, 8.0]
    ... [[terms]]
    ... name = "focus_offset"
    ... minimise = 1.0
    ... [[stages]]
    ... solver = "levenberg-marquardt"
    ... steps = 20
    ... ''')
    >>> study = gs.read_study("study.toml")
    >>> study.free, study.terms[0].name
    ({'sensor_distance_mm': (4.0, 8.0)}, 'focus_offset')
    """
    data = read_toml(path)
    try:
        return Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{one_line(error, Study, {})} ({path}).") from error


def parent_path(path: PathLike, study: Study) -> Path:
    """Path of the initial design of a study.

    Raises `InputError` if the study names none.
    """
    if study.design is None:
        raise InputError(f"{path}: `design` must be the file of a design, relative to the study, got nothing.")
    return Path(path).parent / study.design


def _check_free(study: Study) -> None:
    if not study.free:
        raise ValueError(f"`free` must have one or more of {', '.join(NAMES)}, got nothing")
    for name, (low, high) in study.free.items():
        if name not in NAMES:
            raise ValueError(f"`free`: keys must be among {', '.join(NAMES)}, got {short_repr(name)}")
        if not low < high or not math.isfinite(high - low):
            raise ValueError(f"`free.{name}` must be [lowest, highest], lowest below highest, got [{low:g}, {high:g}]")
        if not low > (least := _LOWER_LIMITS.get(name, 0)):
            raise ValueError(f"`free.{name}` must be above {least}, got [{low:g}, {high:g}]")
    if study.depths_mm is not None and not study.depths_mm[0] < study.depths_mm[1]:
        raise ValueError(f"`depths_mm` must be [near, far] in mm, near below far, got {list(study.depths_mm)}")


def _check_terms(study: Study) -> None:
    pairs = [(term.name, term.kind) for term in study.terms]
    if twice := [name for name, kind in pairs if pairs.count((name, kind)) > 1]:
        raise ValueError(f"`terms`: {twice[0]} must be given once with the same kind, got it twice")


def _check_stages(study: Study) -> None:
    known = {"free": set(study.free), "terms": {term.name for term in study.terms}}
    for stage in study.stages:
        for key, names in known.items():
            chosen = getattr(stage, key)
            wrong = [name for name in chosen or () if name not in names]
            if wrong or chosen == ():
                got = short_repr(wrong[0]) if wrong else "nothing"
                raise ValueError(f"`stages.{key}` must be one or more of {', '.join(sorted(names))}, got {got}")


def _check_pareto(study: Study) -> None:
    goals = [term.name for term in study.terms if term.is_goal]
    if study.pareto and len(goals) != 1:
        raise ValueError(f"`terms`: exactly one must be minimised or maximised beside `pareto`, got {len(goals)}")


def initial_design(design: Design, study: Study) -> Design:
    """Apply the sample, the orientation and the lens types of a study to a design.

    Raises `InputError` if it has no such sample, or several and none is chosen, its depths are in front of that, its
    lenses have another number of types, or are ideal thin lenses, which have no radii.
    """
    table = sample_table(design, study.sample)
    if study.sample is not None:
        depths = study.depths_mm or design.imaging.working_distance_mm
        design = design.replace(sample=table.model_dump(), working_distance_mm=depths)
    if study.orientation is not None:
        design = design.replace(orientation=study.orientation)
    if study.types is None:
        return design
    count = design.imager().array.type_count
    if count == study.types:
        return design
    if count > 1:
        raise InputError(f"`types` must be {count}, as the design's lens types, or be left out, got {study.types}.")
    if design.lens.focal_length_mm is not None:
        raise InputError("`types` needs a design without `lens.focal_length_mm`.")
    if study.types > (lenses := len(design.array.centers_mm)):
        raise InputError(f"`types` must be at most {lenses}, the number of lenses, got {study.types}.")
    radius = np.ravel(design.lens.radius_of_curvature_mm)[0] * _relative_focal_lengths(design, study, study.types)
    which = interleave(np.array(design.array.centers_mm), study.types)
    lens = design.lens.model_copy(update={"radius_of_curvature_mm": tuple(radius[which].tolist())})
    return design.model_copy(update={"lens": lens})


def _relative_focal_lengths(design: Design, study: Study, types: int) -> np.ndarray:
    """Focal lengths of thin lenses focused on equal parts of the depths, in vergence, relative to the middle's."""
    near, far = study.depths_mm or design.imaging.working_distance_mm
    ends = 1 / reduced_depth(design, near), 1 / reduced_depth(design, far)
    share = (np.arange(types) + 0.5) / types
    behind = 1 / reduced_sensor_distance(design, design.imaging.sensor_distance_mm)
    return (np.mean(ends) + behind) / (ends[0] + share * (ends[1] - ends[0]) + behind)


def check_design(design: Design, study: Study) -> None:
    """Raise `InputError` if a free parameter does not exist in the design, or depths may lie behind the plate."""
    if "pitch_mm" in study.free and len(design.array.centers_mm) == 1:
        raise InputError("`free.pitch_mm` needs a design of two lenses or more, got one lens.")
    _check_room(design, study)
    of_lens = {"radius_of_curvature_mm", "refractive_index", "conic_constant", "aspheric_terms"} & set(study.free)
    if design.lens.focal_length_mm is not None and of_lens:
        raise InputError(f"`free.{min(of_lens)}` needs a design without `lens.focal_length_mm`.")


def _check_room(design: Design, study: Study) -> None:
    """Raise `InputError` if depths may come to lie before the object's medium, or the sensor within its windows."""
    begins, (near, far) = object_begins(design), study.depths_mm or design.imaging.working_distance_mm
    if near < begins:
        raise InputError(
            f"`depths_mm` must be {begins:g} mm or more, where the object's medium begins, got {near:g} mm."
        )
    twice = near + far - 2 * begins
    if "depth_span_mm" in study.free and study.free["depth_span_mm"][1] >= twice:
        bounds, from_there = list(study.free["depth_span_mm"]), f" from {begins:g} mm on" if begins else ""
        allowed = f"below {twice:g}, twice the middle of the depths{from_there}"
        raise InputError(f"`free.depth_span_mm` must be {allowed}, got {bounds}.")
    windows = sum(layer.thickness_mm for layer in design.layers.sensor)
    if "sensor_distance_mm" in study.free and study.free["sensor_distance_mm"][0] < windows:
        bounds = list(study.free["sensor_distance_mm"])
        raise InputError(
            f"`free.sensor_distance_mm` must be {windows:g} or more, as thick as the windows, got {bounds}."
        )
