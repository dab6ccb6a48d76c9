"""Files of a rig: holder and target as meshes, the table of pinholes, a drawing, and a report."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from ..base.progress import Progress
from ..base.typing import PathLike
from ..design.design import Design
from ..io.files import check_output, side_file, write_figure, write_json
from ..io.point_tables import write_rows
from ..io.provenance import KEY, Provenance, sidecar, write_sidecar
from .export import MESH_SUFFIXES, float32_mesh, write_mesh
from .holder import AIR_NAMES, Holder, HolderShape, Rig, make_rig
from .lenslets import Part
from .make import draw_solid
from .manufacturability import check_solid, open_design, raise_first_error

FRAME = "x, y as the sensor's, z toward the object, 0 on the shoulder that stands on the shims"
_COLORS = {"holder": "#90a4ae", "target": "#ffcc80", "array": "#4fc3f7", "window": "#c5e1a5", "sensor": "#37474f"}


def rig_files(path: PathLike) -> list[Path]:
    """What is written beside a holder: target, pinholes, picture, report, and where the first two come from."""
    path = Path(path)
    target = path.with_name(f"{path.stem}-target{path.suffix}")
    places = target.with_suffix(".csv")
    beside = [sidecar(places), *([sidecar(target)] if path.suffix.lower() == ".stl" else [])]
    return [target, places, side_file(path, ".png"), side_file(path, ".json"), *beside]


def write_rig(
    design: Design | PathLike,
    path: PathLike,
    shape: HolderShape = HolderShape(),
    *,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the holder of a design, with the files of `rig_files`, and return the report.

    *File.*

    `path` ends in `.stl` or `.3mf`. Raises `InputError` if a file cannot be written, or the array, the camera and the
    walls do not go together, before anything is written; `RuntimeError` if a mesh is not the solid that was meant.
    """
    progress = progress or Progress()
    path = check_output(path, MESH_SUFFIXES)
    target, places, picture, record, *_ = (check_output(beside, [beside.suffix]) for beside in rig_files(path))
    design, _ = open_design(design)
    with progress.step("Building and checking the solids"):
        rig = make_rig(design, shape)
        pinholes = len(rig.places)
        solids = {
            "holder": (path, rig.holder, rig.holder_volume, 5 if shape.bolts else 1),
            "target": (target, rig.target, rig.target_volume, pinholes),
        }
        meshes, checks = {}, list(rig.checks)
        for name, (file, solid, volume, handles) in solids.items():
            meshes[file] = name, float32_mesh(solid)
            checks += check_solid(meshes[file][1], volume, name, handles=handles)
        raise_first_error(checks, RuntimeError)
    with progress.step("Writing"):
        for file, (name, mesh) in meshes.items():
            write_mesh(file, mesh, f"{design.name} {name}", provenance)
        if path.suffix.lower() == ".stl":
            write_sidecar(target, provenance)
        rows = ((1, *place) for place in rig.places.tolist())
        write_rows(places, ["capture", "x_mm", "y_mm", "z_mm"], rows, provenance)
        write_figure(picture, draw_rig(design, shape, rig))
    report = {"design": design.name, "files": [file.name for file in (path, target, places)], "unit": "mm"}
    report |= {"frame": FRAME, "shape": asdict(shape), **rig.numbers, "checks": [asdict(check) for check in checks]}
    write_json(record, report | ({KEY: dict(provenance)} if provenance else {}))
    return report


def draw_rig(design: Design, shape: HolderShape, rig: Rig) -> Figure:
    """The parts in section, in place and to scale, and in perspective."""
    figure = Figure(figsize=(13, 6.4), dpi=110, layout="constrained")
    section, *views = figure.subplot_mosaic(
        [["section", "holder"], ["section", "target"]],
        width_ratios=[1.5, 1],
        per_subplot_kw={("holder", "target"): {"projection": "3d"}},
    ).values()
    _draw_section(section, design, Holder(design, shape), rig)
    for axes, solid, title in zip(
        views, (rig.holder, rig.target.rotate([180, 0, 0])), ("holder", "target, end down"), strict=True
    ):
        draw_solid(axes, solid, from_below=False)
        axes.set_title(f"{title}, as it is printed")
    printable = "".join(c for c in design.name if " " <= c <= "~").replace("$", r"\$")
    figure.suptitle(f"{printable}: holder for array and camera, and target of {len(rig.places)} pinholes")
    return figure


def _draw_section(axes, design: Design, holder: Holder, rig: Rig) -> None:
    def fill(corners, name, label):
        rings = (Outline(np.concatenate([ring, ring[:1]]), closed=True) for ring in corners)
        patch = PathPatch(Outline.make_compound_path(*rings))
        patch.set(facecolor=_COLORS[name], edgecolor="black", linewidth=0.6, label=label)
        axes.add_patch(patch)

    def box(half, low, high):
        return [np.array([(-half, low), (half, low), (half, high), (-half, high)])]

    for name, solid in (("holder", rig.holder), ("target", rig.target)):
        fill(_cut(solid), name, name)
    fill([_plate(design, holder)], "array", "array")
    half = design.sensor.shape[1] * design.sensor.pixel_pitch_um / 2000
    fill(box(half, holder.sensor - 0.3, holder.sensor), "sensor", "sensor")
    height = holder.sensor
    for layer in design.layers.sensor:
        if layer.refractive_index not in AIR_NAMES:
            fill(box(1.1 * half, height, height + layer.thickness_mm), "window", layer.name or "window")
        height += layer.thickness_mm
    face, mouth = -holder.shims, (holder.shape.bore or 25.4) / 2
    for sign in (-1, 1):
        axes.plot([sign * mouth, sign * 1.15 * holder.rim], [face, face], color="black", linewidth=1.5)
        axes.plot([sign * mouth] * 2, [face, holder.sensor], color="black", linewidth=1.5, linestyle=":")
    numbers, end = rig.numbers, holder.front + holder.depth
    shims = " + ".join(f"{1000 * shim:g}" for shim in numbers["shims_mm"])
    labels = {
        end: f"pinholes of {numbers['pinhole_um']:g} um, {holder.depth:g} from the array's front",
        holder.seat: f"ledge, printed at {holder.seat:+.2f}; {holder.step:+.3f} from the camera's face",
        face: f"camera's face, {holder.shape.flange:g} from the sensor; shims of {shims} um",
        holder.sensor: f"sensor, {numbers['sensor_distance_mm']:g} from the array",
    }
    apart, below = (end - holder.sensor) / 16, -np.inf
    for level in sorted(labels):
        below = max(level, below + apart)
        style = {"arrowstyle": "-", "linewidth": 0.5, "shrinkB": 0}
        begin = (1.3 * holder.rim, below)
        axes.annotate(
            labels[level], (holder.rim, level), begin, va="center", fontsize=8, annotation_clip=False, arrowprops=style
        )
    axes.set(xlabel="x, mm", ylabel="z, mm", title="section at y = 0, lengths in mm", aspect="equal")
    axes.set(xlim=(-1.2 * holder.rim, 1.2 * holder.rim), ylim=(holder.sensor - 2, end + 6))
    axes.legend(loc="upper center", ncol=5, fontsize=8, frameon=False)


def _cut(solid: m3.Manifold) -> list[np.ndarray]:
    """Outlines `(x, z)` of a solid at y = 0."""
    return [np.array(ring, float) for ring in solid.rotate([-90, 0, 0]).slice(0).to_polygons()]


def _plate(design: Design, holder: Holder) -> np.ndarray:
    """Outline `(x, z)` of the array, cut through the lens nearest to the axis."""
    x = np.linspace(-1, 1, 801) * holder.plate[0]
    depth = np.zeros_like(x)
    if design.lens.focal_length_mm is None:
        part = Part(holder.imager.array)
        y = part.centers[np.hypot(*part.centers.T).argmin(), 1:]
        depth = part.height - part.surface(x, y)[0][0]
    curved = holder.seat - holder.side * (holder.thickness - depth)
    return np.concatenate([np.stack([x, curved], -1), np.stack([x[[-1, 0]], [holder.seat] * 2], -1)])
