"""Line charts as SVG, in the colours of the page that they stand in.

Colours and fonts are the page's style sheet's, so that a chart is dark on a dark page and black on paper.
"""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator

# Of the picture, pixels of a desktop's screen, which a phone shows nearly as large; room for numbers and labels.
_WIDTH, _HEIGHT = 440, 290
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 12, 44
# Line styles: those that colours alone would leave to good eyes.
_DASHES = ("", "7 4", "2 3", "9 3 2 3", "4 4", "1 4", "12 4")

Numbers = Sequence[float | None] | np.ndarray
Line = tuple[Numbers, Numbers]


def line_chart(
    lines: Mapping[str, Line],
    *,
    x: str,
    y: str,
    title: str,
    log: bool = False,
    marks: bool = False,
    bounds: tuple[float, float] | None = None,
) -> str:
    """The chart.

    Parameters
    ----------
    lines
        By name, places along x and y; what is None or not finite is left out.
    x, y
        Labels of the axes.
    title
        For those who cannot see it.
    log
        The axis y is logarithmic.
    marks
        A dot at each place.
    bounds
        Of the axis y; what the lines need by default, from 0 on unless it is logarithmic.
    """
    drawn = {name: _finite(line, log) for name, line in lines.items()}
    places = np.concatenate(list(drawn.values()), axis=1)
    if not places.size:
        return f'<p class="note">{escape(title)}: no finite number to draw.</p>'
    (left, right), (low, high) = _limits(places[0], False), bounds or _limits(places[1], log)
    if not log and bounds is None:
        low = min(low, 0.0)
    scale = np.log10 if log else np.asarray
    across = lambda v: _LEFT + (_WIDTH - _LEFT - _RIGHT) * (np.asarray(v) - left) / (right - left)
    span = float(scale(high) - scale(low))
    up = lambda v: _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1 - (scale(v) - float(scale(low))) / span)
    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">']
    for tick in _ticks(left, right, False):
        at = float(across(tick))
        parts.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(low, high, log):
        at = float(up(tick))
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    parts.append(f'<path class="axis" d="M{_LEFT} {_TOP}V{_HEIGHT - _BOTTOM}H{_WIDTH - _RIGHT}"/>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x)}</text>')
    turned = f"translate(13 {(_TOP + _HEIGHT - _BOTTOM) / 2:.0f}) rotate(-90)"
    parts.append(f'<text transform="{turned}" text-anchor="middle">{escape(y)}</text>')
    for number, (line_x, line_y) in enumerate(drawn.values()):
        inside = np.clip(line_y, low, high)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across(line_x), up(inside), strict=True))
        kind = f'class="line c{number % 7}" stroke-dasharray="{_DASHES[number % len(_DASHES)]}"'
        parts.append(f'<polyline {kind} points="{points}"/>')
        if marks:
            dots = "".join(
                f'<circle class="dot c{number % 7}" cx="{a:.1f}" cy="{b:.1f}" r="3"/>'
                for a, b in zip(across(line_x), up(inside), strict=True)
            )
            parts.append(dots)
    return "".join(parts) + "</svg>" + _legend(list(lines))


def _legend(names: list[str]) -> str:
    entry = (
        '<li><svg class="key" viewBox="0 0 30 8" aria-hidden="true"><path class="line c{kind}" '
        'stroke-dasharray="{dash}" d="M0 4H30"/></svg>{name}</li>'
    )
    items = [entry.format(kind=i % 7, dash=_DASHES[i % len(_DASHES)], name=escape(n)) for i, n in enumerate(names)]
    return f'<ul class="legend">{"".join(items)}</ul>'


def _finite(line: Line, log: bool) -> np.ndarray:
    both = np.array([[np.nan if v is None else float(v) for v in values] for values in line], float)
    kept = np.isfinite(both).all(0) & ((both[1] > 0) | (not log))
    return both[:, kept]


def _limits(values: np.ndarray, log: bool) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if low == high:
        return (low / 2, high * 2) if log else (low - (abs(low) or 1.0) / 10, high + (abs(high) or 1.0) / 10)
    return (low / 1.15, high * 1.15) if log else (low, high + (high - low) * 0.04)


def _ticks(low: float, high: float, log: bool) -> list[float]:
    if log and high / low > 300:
        found = LogLocator(subs=(1.0,)).tick_values(low, high)
    elif log:
        found = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high)
    else:
        found = MaxNLocator(6).tick_values(low, high)
    slack = 1e-9 * (high - low)
    return [float(f"{tick:.12g}") for tick in found if low - slack <= tick <= high + slack]
