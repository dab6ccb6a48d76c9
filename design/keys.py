"""Write `KEYS.md` and `geometry.svg`, the page of all keys of design files: `python design/keys.py`."""

import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle

from gs_jax.design.start import FRAME, Key, design_keys

LAYERS = ("layers.object", "layers.sensor", "sample.layers")  # have the same keys
HERE = Path(__file__).parent
PAGE, DRAWING = HERE / "KEYS.md", HERE / "geometry.svg"
HEAD = f"""# Keys of a design file

<!-- Written by `python design/keys.py` from the descriptions of the fields in gs_jax/design. Edit those instead. -->

{FRAME} The frame of the array is that of the plate; `[calibration]` rotates and shifts it on the sensor.

![Side view and image, with axes and distances](geometry.svg)

`gs-jax new-design -o my.toml` writes a file with these descriptions as comments, from prompts or options. Valid but
unusual values cause a question: `sensor_distance_mm = 5800: did you mean 5.8 mm (5800 um)?`
"""
TAIL = """
## Lens centres from a file

`centers_file` is a text table with x and y of one lens per line, separated by commas, semicolons (with decimal points
or commas), tabs or blanks, with or without a header or other columns. Columns are recognised by name (`x_um`,
`Pos X [µm]`, `center x`, `column`), or named explicitly:

```toml
[array]
size_mm = [18.6, 13.6]
substrate_thickness_mm = 1.0
centers_file = "vendor.csv"
centers_columns = ["Pos X", "Pos Y"]
centers_unit = "um"
centers_origin = "corner"            # of the plate, with the smallest x and y
mirror = true                        # the list describes the other side of the plate
```

Columns `radius_of_curvature_mm`, `aperture_diameter_mm` and `conic_constant` hold a number for each lens, and replace
the keys of these names in `[lens]`.

Pixels (`"px"`) are those of a capture: (0, 0) is the centre of the first pixel, x the column, y the row. `gs-jax
calibrate` detects mirroring itself.

## Filters, windows and samples

An [example](../docs/howto/samples.md#list-them-in-the-design-file) shows them. A material's index follows the
wavelength; it is relative to air.

## In an editor

`gs-jax new-design --schema > gs-jax.schema.json` writes the JSON schema of design files. With the first line
`#:schema ./gs-jax.schema.json` in a design beside it, editors with Taplo (in VS Code: "Even Better TOML") complete and
describe keys and underline errors; `taplo lint my.toml` checks in a terminal.
"""


def page() -> str:
    """Return the page in Markdown."""
    tables: dict[str, list[Key]] = {}
    for key in design_keys().values():
        tables.setdefault(key.table, []).append(key)
    lines = [HEAD]
    for table, keys in tables.items():
        if table in LAYERS[1:]:
            continue
        shown = [key for key in keys if key.allowed != "a table"]
        headings = [f"`{_heading(name)}`" for name in (LAYERS if table == LAYERS[0] else (table,)) if name]
        lines += [f"## {', '.join(headings) or 'At the top'}", ""]
        if table and table != LAYERS[0]:
            lines += [f"{design_keys()[table].meaning.capitalize()}.", ""]
        lines += ["| key | meaning | allowed |", "|---|---|---|"]
        lines += [_row(key) for key in shown]
        lines.append("")

    lines.append(f"`[provenance]`: {design_keys()['provenance'].meaning}.")
    return "\n".join(lines) + "\n" + TAIL


def _heading(table: str) -> str:
    return f"[[{table}]]" if design_keys()[table].allowed == "a list of tables" else f"[{table}]"


def _row(key: Key) -> str:
    needed = "" if key.required else " (optional)"
    usual = f"; usually {key.usual}" if key.usual else ""
    cells = (f"`{key.name}`{needed}", key.meaning, f"{key.allowed.removeprefix('a number of ')}{usual}")
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def drawing() -> Figure:
    """Draw the distances in a side view, and the directions in the image."""
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    side, image = figure.subplots(1, 2, width_ratios=(1.35, 1))
    _side(side)
    _image(image)
    for axes in (side, image):
        axes.set_aspect("equal")
        axes.axis("off")
    return figure


# Along z, not to scale: sensor, lens vertices, front of the plate, nearest and farthest object.
SENSOR, VERTEX, FRONT, NEAR, FAR = -5.8, -2.0, 0.0, 6.4, 9.6


def _side(axes: Axes) -> None:
    pitch, radius, sag = 1.5, 1.15, 0.45
    lenses = pitch * np.arange(-2, 3)
    axes.plot([SENSOR - 0.6, FAR + 1.6], [0, 0], "-.", color="0.6", lw=0.8)
    axes.add_patch(Rectangle((VERTEX + sag, -3.75), FRONT - VERTEX - sag, 7.5, facecolor="#cfe3f5", edgecolor="none"))
    for y in lenses:
        t = np.linspace(-1, 1, 41)
        bulge = np.stack([VERTEX + sag * t**2, y + pitch / 2 * t], -1)
        axes.add_patch(Polygon(bulge, facecolor="#cfe3f5", edgecolor="#3572a5", closed=False))
    axes.plot([FRONT, FRONT], [-3.75, 3.75], color="#3572a5")
    axes.add_patch(Rectangle((SENSOR - 0.2, -3.9), 0.2, 7.8, facecolor="0.35"))
    for z, name in ((NEAR, "near"), (FAR, "far")):
        axes.plot([z, z], [-3.75, 3.75], color="#b45f06", ls="--", lw=1)
        axes.text(z, 3.95, name, ha="center", va="bottom", color="#b45f06")
    # The chief ray of a point, through the middle of a lens.
    z, y, lens = NEAR, -0.45, lenses[3]
    landing = lens + (lens - y) * (VERTEX - SENSOR) / (z - VERTEX)
    axes.plot([z, VERTEX, SENSOR], [y, lens, landing], color="#cc0000", lw=1.2)
    axes.plot([z, SENSOR], [y, landing], "o", color="#cc0000", ms=4)
    axes.text((z + VERTEX) / 2 + 0.5, (y + lens) / 2 + 0.28, "chief ray", color="#cc0000", rotation=-13)
    # Field of a lens.
    axes.plot([VERTEX, NEAR + 0.9], [lens, lens], ":", color="0.35", lw=1)
    _span(axes, (NEAR + 0.7, lens), (NEAR + 0.7, lens - 2.3), "field_radius_mm", (0.15, -0.75), ha="left")
    _span(axes, (SENSOR, -4.5), (VERTEX, -4.5), "sensor_distance_mm,\nv > 0", (0, -0.25))
    _span(axes, (VERTEX, -4.5), (FRONT, -4.5), "t", (0, -0.25))
    axes.text((VERTEX + FRONT) / 2, -5.75, "substrate_thickness_mm", ha="center", va="top", fontsize=9)
    _span(axes, (FRONT, -4.5), (NEAR, -4.5), "", (0, 0))
    _span(axes, (FRONT, -5.3), (FAR, -5.3), "", (0, 0))
    axes.text(FAR + 0.2, -4.9, "working_distance_mm,\nz > 0", ha="left", va="center", fontsize=9)
    _span(
        axes,
        (VERTEX - 0.45, -pitch - radius / 1.55),
        (VERTEX - 0.45, -pitch + radius / 1.55),
        "D",
        (-0.2, 0),
        ha="right",
    )
    axes.annotate("", (FAR + 1.6, 0), (FAR + 0.4, 0), arrowprops={"arrowstyle": "->"})
    axes.text(FAR + 1.65, 0, "z", va="center", fontsize=12)
    for z, text in ((SENSOR - 0.1, "sensor"), ((VERTEX + FRONT) / 2, "plate"), ((NEAR + FAR) / 2, "object")):
        axes.text(z, 4.6, text, ha="center", va="bottom", fontsize=11)
    axes.text(VERTEX - 0.15, 3.95, "lenses", ha="center", va="bottom", color="#3572a5")
    axes.text(FRONT + 0.1, 3.95, "plano front,\nz = 0", ha="left", va="bottom", color="#3572a5", fontsize=9)
    axes.set(xlim=(SENSOR - 1, FAR + 4.2), ylim=(-6.4, 5.4))


def _span(axes: Axes, start, end, text: str, offset, ha: str = "center") -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0, "color": "0.2"})
    x, y = ((a + b) / 2 + d for a, b, d in zip(start, end, offset, strict=True))
    axes.text(x, y, text, ha=ha, va="top" if ha == "center" else "center", fontsize=9)


def _image(axes: Axes) -> None:
    """Draw the sensor with rows downward, as images are displayed."""
    width, height, angle, shift = 8.0, 6.4, math.radians(25), np.array([0.7, 0.45])
    axes.add_patch(Rectangle((-width / 2, -height / 2), width, height, facecolor="0.95", edgecolor="0.35", lw=1.5))
    axes.text(-width / 2, -height / 2 - 0.15, "sensor, as its image is shown; pixel (row 0, column 0)", fontsize=9)
    axes.plot(-width / 2 + 0.12, -height / 2 + 0.12, "s", color="0.35", ms=5)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    plate = np.array([[-2.3, -1.7], [2.3, -1.7], [2.3, 1.7], [-2.3, 1.7]]) @ turn.T + shift
    axes.add_patch(Polygon(plate, facecolor="#cfe3f5", edgecolor="#3572a5", alpha=0.8))
    rng = np.random.default_rng(4)
    spots = np.array([[x, y] for x in np.arange(-1.8, 1.9, 0.9) for y in np.arange(-1.2, 1.3, 0.8)])
    for spot in (spots + rng.uniform(-0.22, 0.22, spots.shape)) @ turn.T + shift:
        axes.add_patch(Circle(tuple(spot), 0.2, facecolor="white", edgecolor="#3572a5", lw=0.8))
    for direction in ((3.8, 0), (0, 3.05)):
        axes.annotate("", direction, (0, 0), arrowprops={"arrowstyle": "-|>", "color": "k", "lw": 1.4, "shrinkA": 0})
    axes.text(width / 2 + 0.12, 0, "+x", va="center", fontsize=12)
    axes.text(width / 2 + 0.12, 0.45, "column", va="center", fontsize=9)
    axes.text(0, height / 2 + 0.12, "+y  row", ha="center", va="top", fontsize=12)
    for axis in (0, 1):
        end = shift + 2.6 * turn[:, axis]
        axes.annotate(
            "", tuple(end), tuple(shift), arrowprops={"arrowstyle": "-|>", "color": "#3572a5", "lw": 1.2, "shrinkA": 0}
        )
    ends = shift + 2.85 * turn.T
    for end, name in zip(ends, "xy", strict=True):
        axes.text(end[0], end[1], name, color="#3572a5", fontsize=12, ha="center", va="center")
    axes.text(-3.7, -2.75, "centers_mm: [x, y] of each lens on the plate", color="#3572a5", fontsize=9)
    axes.add_patch(Arc(tuple(shift), 4.2, 4.2, theta1=0, theta2=math.degrees(angle), color="#cc0000", lw=1.6))
    axes.plot([shift[0], shift[0] + 2.35], [shift[1]] * 2, ":", color="#cc0000", lw=1)
    axes.text(
        shift[0] + 2.35, shift[1] + 0.75, "rotation_deg\n> 0", color="#cc0000", fontsize=9, va="center", clip_on=False
    )
    axes.annotate(
        "", tuple(shift), (0, 0), arrowprops={"arrowstyle": "->", "color": "#b45f06", "lw": 1.6, "shrinkA": 0}
    )
    axes.text(-0.1, 0.3, "shift_mm", color="#b45f06", fontsize=9, ha="right")
    axes.plot(0, 0, "ko", ms=4)
    axes.text(-0.1, -0.12, "[0, 0]", ha="right", va="bottom", fontsize=9)
    axes.set(xlim=(-width / 2 - 0.4, width / 2 + 1.5), ylim=(height / 2 + 0.9, -height / 2 - 0.8))


def main() -> None:
    """Write both files."""
    PAGE.write_text(page(), encoding="utf-8")
    # Reproducible bytes.
    with matplotlib.rc_context({"svg.hashsalt": "gs_jax", "svg.fonttype": "path"}):
        drawing().savefig(DRAWING, metadata={"Date": None}, bbox_inches="tight")


if __name__ == "__main__":
    main()
