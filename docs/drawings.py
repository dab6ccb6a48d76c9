"""Draw the SVG pictures of these pages: `python docs/drawings.py`."""

import ast
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "drawings"
INK, FAINT, LIGHT, GLASS, RAY = "#263238", "#90a4ae", "#eceff1", "#cfe8f3", "#e64a19"
# Modules that the drawing of imports leaves out.
_LEFT_OUT = {"_version", "__main__", "__init__"}


def svg(width: float, height: float, parts: list[str]) -> str:
    """Return an SVG drawing on a white background."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="13" fill="{INK}">'
    )
    return "\n".join([head, f'<rect width="{width:g}" height="{height:g}" fill="white"/>', *parts, "</svg>", ""])


def text(x: float, y: float, words: str, *, anchor: str = "start", italic: bool = False, color: str = INK) -> str:
    style = ' font-style="italic"' if italic else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{color}"{style}>{words}</text>'


def line(x1: float, y1: float, x2: float, y2: float, color: str = INK, width: float = 1.2, dashes: str = "") -> str:
    more = f' stroke-dasharray="{dashes}"' if dashes else ""
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{color}" stroke-width="{width:g}"{more}/>'


def dot(x: float, y: float, radius: float = 4, color: str = RAY) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{color}"/>'


def measure(x1: float, x2: float, y: float, words: str) -> list[str]:
    """Return a dimension line along x, with its label."""
    ends = [line(x, y - 5, x, y + 5) for x in (x1, x2)]
    return [line(x1, y, x2, y), *ends, text((x1 + x2) / 2, y + 19, words, anchor="middle", italic=True)]


def chief_ray() -> str:
    """Side view, z to the right as in `design/KEYS.md`: sensor, plate, object, and the chief ray of a lens."""
    axis, sensor, vertex, front, point = 150.0, 80.0, 268.0, 310.0, 580.0
    lens, q = axis - 40, axis + 55
    m = (vertex - sensor) / (point - vertex)
    image = lens + (lens - q) * m
    caps = [
        f'<path d="M {vertex} {y - 20} Q {vertex - 22} {y} {vertex} {y + 20} Z" fill="{GLASS}" stroke="{FAINT}"/>'
        for y in (axis - 80, lens, axis, axis + 40, axis + 80)
    ]
    parts = [
        line(30, axis, 610, axis, FAINT, 1, "6 4"),
        f'<rect x="{vertex}" y="40" width="{front - vertex}" height="220" fill="{GLASS}" stroke="{FAINT}"/>',
        *caps,
        f'<rect x="{sensor - 8}" y="30" width="8" height="240" fill="{INK}"/>',
        line(point, q, sensor, image, RAY, 1.8),
        dot(point, q),
        dot(sensor, image),
        dot(vertex - 10, lens, 3, INK),
        line(point, 40, point, 270, FAINT, 1, "2 4"),
        text(point + 8, q + 20, "q", italic=True),
        text(sensor - 16, image + 4, "p", anchor="end", italic=True),
        text(vertex - 26, lens - 8, "c", anchor="end", italic=True),
        text(point, 28, "object", anchor="middle"),
        text((front + vertex) / 2, 28, "plate, n", anchor="middle"),
        text(sensor - 4, 22, "sensor", anchor="middle"),
        *measure(front, point, 288, "z"),
        *measure(vertex, front, 288, "t"),
        *measure(sensor, vertex, 288, "v"),
        text(sensor, 330, "z' = z + t/n: the plate counts as t/n of air. p = c + (c - q) v/z'."),
    ]
    return svg(640, 345, parts)


# Of `light_path`, along x: media other than air, as left and right edge, refractive index, label and colour.
_MEDIA = (
    (105.0, 127.0, 1.51, "window", "#b0bec5"),
    (235.0, 265.0, 1.43, "array", GLASS),
    (265.0, 310.0, 1.52, "filter", "#ffe0b2"),
    (520.0, 534.0, 1.52, "cover slip", "#b0bec5"),
    (534.0, 760.0, 1.43, "gel", "#e8f5e9"),
)


def light_path() -> str:
    """Side view of layers and a sample, by their tables in a design file, and where a point seems to be."""
    axis, top, bottom = 185.0, 75.0, 295.0
    sensor, vertex, front, cover, surface, point = 80.0, 235.0, 265.0, 520.0, 534.0, 700.0
    seems = surface + _reduced(point) - _reduced(surface)
    faces = sorted({sensor, vertex, point, *(x for edges in _MEDIA for x in edges[:2] if x < point)})
    parts = [
        f'<rect x="{left}" y="{top}" width="{right - left}" height="{bottom - top}" fill="{color}" stroke="{FAINT}"/>'
        for left, right, _, _, color in _MEDIA
    ]
    parts += [
        f'<path d="M {vertex} {y - 28} Q {vertex - 22} {y} {vertex} {y + 28} Z" fill="{GLASS}" stroke="{FAINT}"/>'
        for y in (axis - 80, axis - 24, axis + 24, axis + 80)
    ]
    parts += [
        line(40, axis, 780, axis, FAINT, 1, "6 4"),
        f'<rect x="{sensor - 8}" y="{top}" width="8" height="{bottom - top}" fill="{INK}"/>',
    ]
    for lens in (-80.0, 80.0):
        # A chief ray is straight along the reduced distance.
        slope = lens / (_reduced(point) - _reduced(vertex))
        y = {x: axis + slope * (_reduced(point) - _reduced(x)) for x in faces}
        corners = " ".join(f"{x:.1f},{y[x]:.1f}" for x in faces)
        parts += [
            f'<polyline points="{corners}" fill="none" stroke="{RAY}" stroke-width="1.8"/>',
            line(surface, y[surface], seems, axis, RAY, 1.2, "4 4"),
            dot(sensor, y[sensor]),
        ]
    parts += [
        dot(point, axis, 5),
        f'<circle cx="{seems:.1f}" cy="{axis}" r="5" fill="white" stroke="{RAY}" stroke-width="1.5"/>',
        text(point + 8, axis - 12, "a point"),
        text(seems + 4, axis + 42, "seems to be here", anchor="middle"),
        line(seems, axis + 28, seems, axis + 8, FAINT),
        text(sensor + 4, top - 10, "sensor", anchor="end"),
        *(text((left + right) / 2, top - 10, name, anchor="middle") for left, right, _, name, _ in _MEDIA),
        *(text(x, top - 10, "air", anchor="middle") for x in (181, 415)),
        *_pointer(sensor, 127, 36, "[[layers.sensor]]"),
        *_pointer(front, 310, 36, "[[layers.object]]"),
        *_pointer(cover, surface, 36, "layers of [sample]"),
        text(650, 23, "[sample]", anchor="middle"),
        *measure(sensor, vertex, 320, "sensor_distance_mm"),
        *measure(front, surface, 320, "surface_mm"),
        *measure(front, point, 360, "depth z"),
    ]
    return svg(800, 390, parts)


def _reduced(x: float) -> float:
    """Return the reduced distance from the left."""
    return x - sum((min(max(x, left), right) - left) * (1 - 1 / n) for left, right, n, *_ in _MEDIA)


def _pointer(start: float, stop: float, y: float, words: str) -> list[str]:
    """Return an arrow along x, from where layers are listed to where they end, with a label above."""
    tips = [line(stop, y, stop - 6, y + side, FAINT, 1.5) for side in (-4, 4)]
    return [line(start, y, stop, y, FAINT, 1.5), *tips, text((start + stop) / 2, y - 13, words, anchor="middle")]


def field() -> str:
    """A point seen along the axis: the lenses within the field radius, and its image, their pattern magnified."""
    random, centers = 7, []
    # A displaced lattice by a generator of its own, so that the pattern is the same everywhere.
    for row, column in itertools.product(range(6), range(6)):
        random = (random * 1103515245 + 12345) % 2**31
        angle = 2 * math.pi * random / 2**31
        centers.append((60 + 38 * column + 9 * math.cos(angle), 70 + 38 * row + 9 * math.sin(angle)))
    q, radius, m = (145.0, 175.0), 72.0, 0.3
    sees = [c for c in centers if math.dist(c, q) < radius]
    move = 330
    parts = [
        text(155, 25, "plate, seen along the axis", anchor="middle"),
        text(155 + move, 25, "sensor", anchor="middle"),
        f'<rect x="35" y="40" width="240" height="250" fill="{LIGHT}" stroke="{FAINT}"/>',
        f'<rect x="{35 + move}" y="40" width="240" height="250" fill="{INK}"/>',
        f'<circle cx="{q[0]}" cy="{q[1]}" r="{radius}" fill="{GLASS}" stroke="{RAY}" stroke-dasharray="5 4"/>',
        *(dot(x, y, 3, INK if (x, y) in sees else FAINT) for x, y in centers),
        dot(q[0], q[1], 4.5),
        line(q[0], q[1], q[0] + radius, q[1], RAY),
        text(q[0] + radius / 2, q[1] - 6, "field radius", anchor="middle", color=RAY),
    ]
    for c in sees:
        x, y = c[0] + m * (c[0] - q[0]), c[1] + m * (c[1] - q[1])
        parts.append(dot(x + move, y, 3, "#ffcc80"))
    parts += [
        text(155, 312, "dark: the lenses within the field radius", anchor="middle"),
        text(155 + move, 312, "its image: their pattern, s times as large", anchor="middle"),
    ]
    return svg(620, 330, parts)


def stray_light() -> str:
    """A spot: the position of the chief ray, the core beside it, and the stray light around and behind the core."""
    x, y = 320.0, 120.0
    shades = [
        f'<ellipse cx="{x + 26 * s:.0f}" cy="{y}" rx="{100 * s:.0f}" ry="{78 * s:.0f}" fill="{GLASS}" opacity="0.45"/>'
        for s in (1.0, 0.8, 0.6, 0.4)
    ]
    parts = [
        line(40, y, 560, y, FAINT, 1, "6 4"),
        *shades,
        dot(x - 26, y, 6),
        line(x - 46, y - 10, x - 46, y + 10),
        line(x - 56, y, x - 36, y),
        dot(70, y, 4, INK),
        text(70, y + 24, "the lens's axis", anchor="middle"),
        text(x - 52, y - 64, "chief ray", anchor="end"),
        line(x - 54, y - 58, x - 47, y - 14, FAINT),
        text(x - 20, y - 90, "core: a few pixels, the bright part"),
        line(x - 12, y - 84, x - 24, y - 8, FAINT),
        text(x + 110, y + 70, "stray light: more than half of all"),
        *measure(70, x - 26, y + 100, "M (1 + e) times the field"),
    ]
    return svg(640, 250, parts)


def arrow(x: float, y: float, along_x: float, along_y: float, words: str, color: str = INK) -> list[str]:
    """Return an arrow from (x, y), with a label beyond its tip."""
    length = math.hypot(along_x, along_y)
    to_x, to_y, u, w = x + along_x, y + along_y, along_x / length, along_y / length
    tips = [line(to_x, to_y, to_x - 6 * u + s * 4 * w, to_y - 6 * w - s * 4 * u, color, 1.5) for s in (-1, 1)]
    label = text(to_x + 11 * u, to_y + 11 * w + 4.5, words, anchor="middle", italic=True, color=color)
    return [line(x, y, to_x, to_y, color, 1.5), *tips, label]


def array_frames() -> str:
    """Frames of the maker's files: arrays from the side, light from the left, and as seen from their lenses."""
    parts, glass = [], f'fill="{GLASS}" stroke="{FAINT}"'
    for left, plano in ((0.0, True), (330.0, False)):
        side, names = (1, ("plano", "the sensor", "down")) if plano else (-1, ("curved", "the object", "up"))
        middle, base = left + 160, left + 160 + 12.0 * side
        tip = base + 20 * side
        parts += [
            text(middle, 22, f"{names[0]} side toward the object", anchor="middle"),
            f'<rect x="{min(base, base - 36 * side):g}" y="40" width="36" height="130" {glass}/>',
            *(
                f'<path d="M {base} {y - 21} Q {2 * tip - base} {y} {base} {y + 21} Z" {glass}/>'
                for y in (62, 105, 148)
            ),
            *arrow(left + 20, 60, 50, 0, "light", RAY)[:-1],
            text(left + 20, 50, "light", color=RAY),
            line(tip, 40, tip, 205, FAINT, 1, "3 3"),
            line(base, 30, base, 230, FAINT, 1, "3 3"),
            *arrow(tip, 190, 44, 0, "z", RAY),
            text(tip + 60, 208, ".dat, .csv", color=RAY, anchor="middle"),
            *arrow(base, 222, 44 * side, 0, "z"),
            text(base + 52 * side, 242, ".tif, .png, .xyz", anchor="middle"),
            f'<rect x="{left + 90}" y="290" width="140" height="110" {glass}/>',
            *(
                f'<circle cx="{left + x}" cy="{y}" r="17" fill="{LIGHT}" stroke="{FAINT}"/>'
                for x, y in ((125, 320), (190, 312), (142, 368), (204, 374))
            ),
            *arrow(middle, 345, 45, 0, "x"),
            *arrow(middle, 345, 0, -38, "y"),
            dot(middle, 345, 3, INK),
            text(middle, 278, f"seen from the lenses, from {names[1]}", anchor="middle"),
            text(left + 84, 300, "row 0", anchor="end", color=FAINT),
            text(left + 84, 400, "last row", anchor="end", color=FAINT),
            text(middle, 420, f"x of the design: to the right; y: {names[2]}", anchor="middle"),
        ]
    return svg(660, 435, parts)


def imports() -> dict[str, set[str]]:
    """Return the imports between folders and modules of the package."""
    graph: dict[str, set[str]] = {}
    for path in sorted((ROOT / "gs_jax").rglob("*.py")):
        parts = path.relative_to(ROOT / "gs_jax").with_suffix("").parts
        if parts[0] not in _LEFT_OUT:
            graph.setdefault(parts[0], set()).update(_imported(path, parts))
    return {name: {other for other in others if other in graph and other != name} for name, others in graph.items()}


def _imported(path: Path, parts: tuple[str, ...]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == len(parts):
            yield from [node.module.split(".")[0]] if node.module else [each.name for each in node.names]


def layers(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sort names into layers such that each imports only from layers before it."""
    done: list[list[str]] = []
    while left := sorted(set(graph) - {name for layer in done for name in layer}):
        known = {name for layer in done for name in layer}
        done.append([name for name in left if graph[name] <= known])
    return done


def imports_drawing() -> str:
    """Draw the direction of imports, without those that others imply."""
    graph = imports()
    rows, place = layers(graph), {}
    high, wide = 62, 720
    for number, row in enumerate(rows):
        for index, name in enumerate(row):
            place[name] = (wide * (index + 0.5) / len(row), 40 + high * number)
    reach: dict[str, set[str]] = {}
    for name in itertools.chain(*rows):
        reach[name] = graph[name].union(*(reach[other] for other in graph[name]))
    parts = []
    for name, others in graph.items():
        for other in sorted(others):
            if not any(other in reach[third] for third in others - {other}):
                (x1, y1), (x2, y2) = place[name], place[other]
                parts.append(line(x1, y1 - 13, x2, y2 + 13, FAINT, 1.2))
                angle = math.atan2(y2 + 13 - (y1 - 13), x2 - x1)
                tips = [(x2 - 7 * math.cos(angle + turn), y2 + 13 - 7 * math.sin(angle + turn)) for turn in (-0.4, 0.4)]
                parts += [line(x2, y2 + 13, x, y, FAINT, 1.2) for x, y in tips]
    for name, (x, y) in place.items():
        half = 5 + 3.9 * len(name)
        parts.append(
            f'<rect x="{x - half:.1f}" y="{y - 13:.1f}" width="{2 * half:.1f}" height="26" rx="4" '
            f'fill="{LIGHT}" stroke="{FAINT}"/>'
        )
        parts.append(text(x, y + 4.5, name, anchor="middle"))
    return svg(wide, 40 + high * len(rows) - 10, parts)


DRAWINGS = {
    "chief-ray": chief_ray,
    "light-path": light_path,
    "field": field,
    "stray-light": stray_light,
    "array-frames": array_frames,
    "imports": imports_drawing,
}


def main() -> None:
    """Write all drawings."""
    FOLDER.mkdir(exist_ok=True)
    for name, draw in DRAWINGS.items():
        (FOLDER / f"{name}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
