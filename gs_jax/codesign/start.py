"""The design that a search starts from: turned over, or with its lenses divided into types, as the study wants it."""

import numpy as np

from ..base.errors import InputError
from ..design.checks import plate_as_air
from ..design.design import Design
from ..layouts import interleave
from ..lenses import lenses_by_type
from .study import Study


def started(design: Design, study: Study) -> Design:
    """A design with the orientation and the types of lenses that a study asks for.

    Raises
    ------
    InputError
        If its lenses differ and are not of so many types, or are ideal thin lenses, which have no radii to spread.
    """
    if study.orientation is not None:
        design = _with(design, orientation=study.orientation)
    if study.kinds is None:
        return design
    found = len(lenses_by_type(design.imager().array))
    if found == study.kinds:
        return design
    if found > 1:
        raise InputError(f"`kinds`: found {study.kinds} for a design of {found} types, allowed: {found}, or none.")
    if design.lens.focal_length_mm is not None:
        raise InputError("`kinds`: found it for a design with `lens.focal_length_mm`, allowed: for one without it.")
    if study.kinds > (count := len(design.array.centers_mm)):
        raise InputError(f"`kinds`: found {study.kinds} for a design of {count} lenses, allowed: up to {count}.")
    radius = np.ravel(design.lens.radius_of_curvature_mm)[0] * _relative_focal_lengths(design, study, study.kinds)
    which = interleave(np.array(design.array.centers_mm), study.kinds)
    return _with(design, radius_of_curvature_mm=tuple(radius[which].tolist()))


def _relative_focal_lengths(design: Design, study: Study, types: int) -> np.ndarray:
    """Of thin lenses that image the middles of equal parts of the depths, in vergence, over that of their middle."""
    near, far = study.depths_mm or design.imaging.working_distance_mm
    lens, array = design.lens, design.array
    front, back = plate_as_air(array.substrate_thickness_mm, lens.refractive_index, lens.orientation)
    ends = 1 / (near + front), 1 / (far + front)
    share = (np.arange(types) + 0.5) / types
    behind = 1 / (design.imaging.sensor_distance_mm + back)
    return (np.mean(ends) + behind) / (ends[0] + share * (ends[1] - ends[0]) + behind)


def _with(design: Design, **lens) -> Design:
    return design.model_copy(update={"lens": design.lens.model_copy(update=lens)})
