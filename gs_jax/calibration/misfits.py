"""What else the positions of a calibration may mean where they do not fit the captures: axes or captures swapped."""

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from ..base.errors import InputError
from .sources import CaptureFit, Sources

# Most captures of which all pairs are swapped, alternatives that are fitted, and names of one that are said.
_MOST_SWAPPED, _MOST_FITTED, _MOST_SAID = 10, 3, 2


def alternatives(sources: Sources) -> Iterator[tuple[str, Sources]]:
    """Other positions of sharp sources that a stage or a file may have meant, with what they change; none twice.

    Depths are reversed within their own range, as a stage's zero is not known better.
    """
    sharp = np.flatnonzero(sources.sharp)
    points, captures = sources.points[sharp], sources.captures[sharp]
    x, y, z = points.T
    back = np.nanmin(z) + np.nanmax(z) - z if np.isfinite(z).any() else z
    meant = [
        ("the sign of x reversed", np.stack([-x, y, z], -1)),
        ("the sign of y reversed", np.stack([x, -y, z], -1)),
        ("the direction of z reversed (near and far swapped)", np.stack([x, y, back], -1)),
        ("x and y swapped", np.stack([y, x, z], -1)),
        ("the signs of x and y reversed", np.stack([-x, -y, z], -1)),
    ]
    if len(np.unique(captures)) == len(captures):
        rows = np.arange(len(captures))
        for one, other in combinations(rows, 2) if len(rows) <= _MOST_SWAPPED else ():
            order = rows.copy()
            order[[one, other]] = other, one
            meant.append((f"captures {captures[one] + 1} and {captures[other] + 1} swapped", points[order]))
        meant.append(("the order of the captures reversed", points[::-1]))
    words: dict[bytes, list[str]] = {}
    for said, changed in meant:
        # What is unknown stays unknown; -0 is 0.
        if (np.isnan(changed) != np.isnan(points)).any():
            continue
        words.setdefault((changed + 0.0).tobytes(), []).append(said)
    words.pop((points + 0.0).tobytes(), None)
    for key, said in words.items():
        changed = sources.points.copy()
        changed[sharp] = np.frombuffer(key).reshape(points.shape)
        yield " or ".join(said[:_MOST_SAID]), sources._replace(points=changed)


def best_alternative(
    sources: Sources,
    explain: Callable[[Sources], Sequence[CaptureFit]],
    refine: Callable[[Sources], Sequence[CaptureFit]],
) -> tuple[str, float] | None:
    """The first alternative that explains most spots and fits all captures, and its residual, pixels RMS.

    `explain` predicts spots without a fit, `refine` fits.
    """
    candidates = []
    for said, meant in alternatives(sources):
        try:
            fits = explain(meant)
        except InputError:
            continue
        if all(fit.fits for fit in fits):
            candidates.append((sum(fit.spots for fit in fits), said, meant))
    for _, said, meant in sorted(candidates, key=lambda candidate: -candidate[0])[:_MOST_FITTED]:
        try:
            fits = refine(meant)
        except InputError:
            continue
        spots = np.array([fit.spots for fit in fits])
        return said, float(np.sqrt((spots * np.array([fit.rms for fit in fits]) ** 2).sum() / spots.sum()))
    return None


def would_fit(alternative: tuple[str, float]) -> str:
    """What to do about positions of which an alternative fits."""
    said, rms = alternative
    return f"with {said} all would fit, {rms:.2f} pixels RMS: correct the positions."


def describe_misfit(fits: Sequence[CaptureFit], alternative: tuple[str, float] | None, *, tried: bool = True) -> str:
    """One line about captures that a geometry does not explain; `tried` says if other positions were."""
    wrong = [number for number, fit in enumerate(fits, 1) if not fit.fits]
    first = fits[wrong[0] - 1]
    which = f"capture {wrong[0]}" if len(wrong) == 1 else f"captures {', '.join(map(str, wrong))}"
    got = f"{which} of {len(fits)} {'does' if len(wrong) == 1 else 'do'} not fit, "
    got += f"{'the first ' * (len(wrong) > 1)}with {first.spots} of {first.expected} expected spots"
    if np.isfinite(first.away):
        got += f" (the nearest are {first.away:.0f} pixels away)"
    if alternative is not None:
        return f"captures: {got}; {would_fit(alternative)}"
    cause = "are positions, order and pixel pitch right?"
    if len(wrong) > len(fits) / 2:
        cause = "are positions and pixel pitch right, and is there nothing but a lens array before the sensor?"
    if not tried:
        return f"captures: {got}."
    return f"captures: {got}; reversing an axis or swapping captures does not help: {cause}"
