"""Run a study: from a design to a better design.

A study (`gs_jax.codesign.study`) has free parameters, terms with targets, and stages of solvers. The first stage may
start from several points; the best goes on to the next stage. A log of all steps and the solver's state make a
checkpoint.
"""

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..base.errors import InputError, errors_name_file
from ..base.machine import Workers
from ..base.progress import Progress
from ..design.design import Design, read_design
from ..design.light_path import reduced_depth, reduced_sensor_distance, sample_table
from ..lenses import lenses_by_type
from ..optics.lens_types import interleave
from ..typing import PathLike
from .parameters import new_design, start_values
from .solve import Log, State, read_checkpoint, write_checkpoint
from .stages import entries_of, make_stage, problem_of, rows_of, run_stages
from .study import Study, read_study
from .targets import Row

# Seconds between two checkpoints.
_EVERY = 10.0


class Outcome(NamedTuple):
    """Result of a search.

    `parent`, `study`: its inputs. `design`: the new one, with the study's name. `before`, `after`: one row for each
    of the study's terms. `log`: of every start and step. `seconds`: of the search, compilation included.
    """

    parent: Design
    study: Study
    design: Design
    before: list[Row]
    after: list[Row]
    log: Log
    seconds: float


@contextlib.contextmanager
def load(design: Design | PathLike, study: Study | PathLike) -> Iterator[tuple[Design, Study]]:
    """The initial design of a study and the study, read if they are files.

    An `InputError` within names the study's file.
    """
    found = design if isinstance(design, Design) else read_design(design)
    if isinstance(study, Study):
        yield initial_design(found, study), study
        return
    question = read_study(study)
    with errors_name_file(study):
        yield initial_design(found, question), question


def run_study(
    design: Design | PathLike,
    study: Study | PathLike,
    *,
    progress: Progress | None = None,
    checkpoint: PathLike | None = None,
    resume: bool = False,
    every: float = _EVERY,
    workers: Workers | None = None,
) -> Outcome:
    """Search for a design that does what a study wants.

    *Host.*

    Searches end within a billionth of the minimum in double precision (`jax_enable_x64`); single stops far from it.

    Parameters
    ----------
    design
        The initial design, or its file.
    study
        The study, or its file. Its own `design` is ignored.
    progress
        Shows progress; silent by default.
    checkpoint
        File for the state; none by default.
    resume
        Continue from that file, with the same result as without the interruption.
    every
        Seconds between two checkpoints.
    workers
        Processes that run the first stage's starts; this one by default. The result is the same.

    Raises
    ------
    InputError
        If a file cannot be read, the study does not fit the design, the checkpoint is missing or another study's, or
        nothing was found.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gs_jax as gs
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
    >>> outcome = gs.run_study(gs.geomscope(), "study.toml")
    >>> print(round(outcome.design.imaging.sensor_distance_mm, 1))  # where a thin lens images the middle
    6.0
    """
    with load(design, study) as (parent, question):
        path = None if checkpoint is None else Path(checkpoint)
        return _run_study(parent, question, progress, path, resume, every, workers)


def _run_study(
    design: Design,
    study: Study,
    progress: Progress | None,
    checkpoint: Path | None,
    resume: bool,
    every: float,
    workers: Workers | None,
) -> Outcome:
    began = time.monotonic()
    log, saved = Log(), None
    if resume and checkpoint:
        log, state = read_checkpoint(checkpoint, study, design)
        saved = (checkpoint, state) if state else None
    problem, each = problem_of(design, study), _Saver(checkpoint, every, log, study, design)
    values = start_values(problem.imager, problem.at)
    before = rows_of(study.terms, entries_of(problem, study.terms), values)
    # Built when they are needed, so that compilation shows in the progress.
    stages = (make_stage(problem, index) for index in range(len(study.stages)))
    how = {"log": log, "progress": progress, "each": each, "saved": saved, "workers": workers}
    values = run_stages(problem, stages, study.terms, values, **how)
    found = new_design(design, problem.imager, problem.at, values).model_copy(update={"name": study.name})
    written = problem_of(found, study.model_copy(update={"depths_mm": None}))
    after = rows_of(study.terms, entries_of(written, study.terms), start_values(written.imager, written.at))
    return Outcome(design, study, found, before, after, log, time.monotonic() - began)


class _Saver:
    """Write a checkpoint after the first step, then at intervals, and after each start that a worker ran."""

    def __init__(self, path: Path | None, every: float, log: Log, study: Study, design: Design):
        self.path, self.every, self.last = path, every, -math.inf
        self.log, self.study, self.design = log, study, design

    def __call__(self, state: State | None) -> None:
        if self.path is not None and (state is None or time.monotonic() - self.last >= self.every):
            write_checkpoint(self.path, self.log, self.study, self.design, state)
            self.last = time.monotonic()


def initial_design(design: Design, study: Study) -> Design:
    """Apply the sample, the orientation and the lens types of a study to a design.

    Raises `InputError` if it has no such sample, its depths are in front of that, its lenses have another number of
    types, or are ideal thin lenses, which have no radii.
    """
    if study.sample is not None:
        table = sample_table(design, study.sample)
        depths = study.depths_mm or design.imaging.working_distance_mm
        design = design.replace(sample=table.model_dump(), working_distance_mm=depths)
    if study.orientation is not None:
        design = design.replace(orientation=study.orientation)
    if study.kinds is None:
        return design
    found = len(lenses_by_type(design.imager().array))
    if found == study.kinds:
        return design
    if found > 1:
        raise InputError(f"`kinds` must be {found}, as the design's lens types, or be left out, got {study.kinds}.")
    if design.lens.focal_length_mm is not None:
        raise InputError("`kinds` needs a design without `lens.focal_length_mm`.")
    if study.kinds > (count := len(design.array.centers_mm)):
        raise InputError(f"`kinds` must be at most {count}, the number of lenses, got {study.kinds}.")
    radius = np.ravel(design.lens.radius_of_curvature_mm)[0] * _relative_focal_lengths(design, study, study.kinds)
    which = interleave(np.array(design.array.centers_mm), study.kinds)
    return _with(design, radius_of_curvature_mm=tuple(radius[which].tolist()))


def _relative_focal_lengths(design: Design, study: Study, types: int) -> np.ndarray:
    """Focal lengths of thin lenses focused on equal parts of the depths, in vergence, relative to the middle's."""
    near, far = study.depths_mm or design.imaging.working_distance_mm
    ends = 1 / reduced_depth(design, near), 1 / reduced_depth(design, far)
    share = (np.arange(types) + 0.5) / types
    behind = 1 / reduced_sensor_distance(design, design.imaging.sensor_distance_mm)
    return (np.mean(ends) + behind) / (ends[0] + share * (ends[1] - ends[0]) + behind)


def _with(design: Design, **lens) -> Design:
    return design.model_copy(update={"lens": design.lens.model_copy(update=lens)})
