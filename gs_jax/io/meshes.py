"""Sheets of a scene as triangles, and as PLY."""

from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int

from ..microscope.grid import Grid

# Neighbours whose depths differ by more voxels than this lie on different parts of the scene.
_STEEP = 4

Maps = Float[np.ndarray, "sheet y x"]


class Mesh(NamedTuple):
    """Triangles between lit neighbours of sheets: vertices `(x, y, z)`, mm, and their brightness, from 0 to 1."""

    vertices: Float[np.ndarray, "vertex 3"]
    brightness: Float[np.ndarray, " vertex"]
    faces: Int[np.ndarray, "face 3"]


def surface_mesh(brightness: Maps, depth: Maps, grid: Grid) -> Mesh:
    """Triangles between lit neighbours, of all sheets, but where the depth jumps."""
    y, x = np.meshgrid(np.asarray(grid.y), np.asarray(grid.x), indexing="ij")
    number = np.arange(depth.size).reshape(depth.shape)
    corners = [np.s_[:, :-1, :-1], np.s_[:, :-1, 1:], np.s_[:, 1:, 1:], np.s_[:, 1:, :-1]]
    around = np.stack([depth[part] for part in corners])
    # Where it is dark the range is NaN, which is not small.
    flat = np.ptp(around, axis=0) <= _STEEP * grid.pitch
    a, b, c, d = (number[part][flat] for part in corners)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    vertices = np.stack([np.broadcast_to(x, depth.shape), np.broadcast_to(y, depth.shape), depth], -1).reshape(-1, 3)
    light = np.clip(brightness / max(np.percentile(brightness, 99.5), 1e-30), 0, 1).reshape(-1)
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], light[used], faces.reshape(-1, 3))


def as_ply(mesh: Mesh) -> bytes:
    """A mesh as PLY, coloured by brightness."""
    import trimesh  # 0.3 s that images do not need

    grey = (255 * mesh.brightness).astype(np.uint8)
    colours = np.stack([grey, grey, grey, np.full_like(grey, 255)], -1)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    return bytes(cast(bytes, made.export(file_type="ply")))
