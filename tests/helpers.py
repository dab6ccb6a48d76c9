"""A small scene and slow, literal references."""

import math
import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gs_jax import (
    Camera,
    Design,
    Grid,
    Imager,
    MicrolensArray,
    Sensor,
    expose,
    objectives,
    read_design,
    simulate,
    write_capture,
    write_design,
)
from gs_jax.projection.rays import trace
from gs_jax.reconstruction.residual import BRIGHT
from gs_jax.simulation import random_points

from .compilations import compilations as compilations

# A design as a file, of four lenses.
DESIGN = """
name = "small"
[sensor]
pixel_pitch_um = 20.0
shape = [96, 80]
[lens]
radius_of_curvature_mm = 2.0
refractive_index = 1.43
aperture_diameter_mm = 0.4
[array]
size_mm = [2.0, 2.0]
substrate_thickness_mm = 1.0
centers_mm = [[0.0, 0.0], [0.3, 0.1], [-0.25, 0.2], [0.05, -0.4]]
[imaging]
sensor_distance_mm = 5.8
working_distance_mm = [18.0, 30.0]
wavelength_nm = 520.0
field_radius_mm = 0.5
"""
# Cropped captures that ship with the tests.
CAPTURES = Path(__file__).parent / "data"
# Whole ones, and what others publish, lie beside the repository: too large, or not ours, to ship.
DATA = Path(__file__).parents[2] / "shared" / "data"
SOURCES = {
    "randoscope": "a measured point spread function of a printed array, and its recipe",
    "geomscope": "the lens centres that the paper's authors publish",
    "oracle": "whole captures by the ray tracer of tests/data",
    "diffusercam": "real captures of Waller Lab's DiffuserCam tutorial",
    "whiteimages": "white images of two light-field microscopes, from napari-LF",
    "plenoptic": "a ray-traced white image and its makers' lens centres",
    "stage": "real spots of an LED at five places of a stage",
    "diffusercam3d": "a real capture and a measured stack of Waller Lab's DiffuserCam",
}


def examples(count: int) -> int:
    """How many examples hypothesis draws: at most 100, but all of them in `make test-all`."""
    return count if os.environ.get("EXAMPLES") == "all" else min(count, 100)


def needs(path: str) -> Path:
    """A file of `DATA`, or skip and say what is missing and where it comes from."""
    if not (DATA / path).exists():
        folder = path.split("/")[0]
        pytest.skip(f"no ../shared/data/{folder}: {SOURCES[folder]}")
    return DATA / path


def scene(dtype=jnp.float64, *, shape=(96, 80), voxels=(21, 17), depths=(18.0, 20.0, 23.5), pitch=0.05):
    """A 24-lens imager, rotated and shifted a little, and a grid whose edge is off the sensor for some lenses."""
    rng = np.random.default_rng(0)
    centers = rng.uniform(-0.9, 0.9, (24, 2))
    imager = Imager(MicrolensArray(centers), Sensor(shape, 0.02), 5.8, 0.45, rotation=0.02, shift=(0.013, -0.007))
    grid = Grid(depths, voxels, pitch)
    cast = lambda leaf: jax.device_put(np.array(leaf, dtype))
    return jax.tree.map(cast, imager), jax.tree.map(cast, grid)


# Rays in one program; eagerly they are a hundred.
trace_rays = jax.jit(trace, static_argnames=("nearest", "dtype", "limit"))


@eqx.filter_jit
def quantities(imager, depths, names: tuple[str, ...]) -> dict[str, jax.Array]:
    """Objectives by name, as one program for imagers of one structure, whatever their numbers."""
    return {name: getattr(objectives, name)(imager, depths) for name in names}


def aperture_edge(array, angles):
    """Distance `(lens, angle)` from each lens's vertex to the edge of its clear aperture, lens by lens.

    In the direction `e` the nearest of the disc, of the bisectors `|d|^2 / (2 d.e)` with neighbours at `d`, `d.e > 0`,
    and of the plate's sides.
    """
    centers, direction = np.asarray(array.centers), np.stack([np.cos(angles), np.sin(angles)])
    edges = []
    for center in centers:
        offset = centers - center
        toward = np.concatenate([offset @ direction, direction, -direction])
        room = [(np.array(array.plate) / 2 - sign * center) for sign in (1, -1)]
        lines = np.concatenate([np.sum(offset**2, axis=1) / 2, *room])
        distance = np.where(toward > 0, lines[:, None] / np.where(toward > 0, toward, 1), np.inf)
        edges.append(np.minimum(distance.min(axis=0), float(array.aperture_diameter) / 2))
    return np.stack(edges)


def backproject_loop(image, imager, grid, method="linear"):
    """The paper's sum as it is told: for each voxel, for each lens, find the pixel. Returns it and the weights' sum."""
    image = np.asarray(image, np.float64)
    volume, weights = np.zeros(grid.volume_shape), np.zeros(grid.volume_shape)
    cos, sin = np.cos(float(imager.rotation)), np.sin(float(imager.rotation))
    centers = np.asarray(imager.array.centers, np.float64) @ np.array([[cos, sin], [-sin, cos]])
    centers = centers + np.asarray(imager.shift, np.float64)
    tilt = np.zeros(2) if imager.tilt is None else np.asarray(imager.tilt, np.float64)
    # The plane of the array turns about the line through its middle on which it stays level.
    slope, angle = np.linalg.norm(tilt), np.arctan(np.linalg.norm(tilt))
    axis = np.array([tilt[1], -tilt[0], 0]) / (slope or 1)
    turned = Rotation.from_rotvec(angle * axis).apply(np.column_stack([centers, np.zeros(len(centers))]))
    centers, lifts = turned[:, :2], turned[:, 2]
    thickness = float(imager.array.substrate_thickness) / float(imager.array.refractive_index)
    in_front = thickness if imager.array.orientation == "plano" else 0.0
    behind = float(imager.sensor_distance) + thickness - in_front
    # A plate that leans with the array moves what is seen through it, the point or the spot.
    plate = float(imager.array.substrate_thickness) - thickness
    point_moves, spot_moves = (plate, 0.0) if in_front else (0.0, plate)
    pixel, radius2 = imager.sensor.pixel_pitch, imager.field_radius**2
    height, width = imager.sensor.shape
    for d, r, c in np.ndindex(*volume.shape):
        depth = float(grid.depths[d]) + in_front
        q = np.array([c - (grid.shape[1] - 1) / 2, r - (grid.shape[0] - 1) / 2]) * grid.pitch
        for center, lift in zip(centers, lifts, strict=True):
            seen = q + point_moves * tilt
            x, y = center + (center - seen) * (behind + lift) / (depth - lift) + spot_moves * tilt
            u, v = y / pixel + (height - 1) / 2, x / pixel + (width - 1) / 2
            if method == "nearest":
                u, v = np.floor(u + 0.5), np.floor(v + 0.5)
            if not (0 <= u <= height - 1 and 0 <= v <= width - 1):
                continue
            distance2 = np.sum((center - depth * tilt - seen) ** 2)  # from the axis, which leans with the array
            t = np.clip((1.1 * radius2 - distance2) / (0.2 * radius2), 0, 1)
            weight = (depth**2 / (depth**2 + distance2)) ** 2 * t * t * (3 - 2 * t)
            i, j = min(int(u), height - 2), min(int(v), width - 2)
            a, b = u - i, v - j
            square = image[i : i + 2, j : j + 2]
            volume[d, r, c] += weight * (np.array([1 - a, a]) @ square @ np.array([1 - b, b]))
            weights[d, r, c] += weight
    return volume, weights


def design_and_capture(folder: Path) -> np.ndarray:
    """A middle piece of the built-in microscope in `design/geomscope.toml`, and its `capture.tif` of five points.

    54 lenses and 800^2 pixels of 9 um, so that what is written for the whole takes seconds.
    """
    data = read_design(Path(__file__).parents[1] / "design" / "geomscope.toml").model_dump()
    data["sensor"] = {"shape": (800, 800), "pixel_pitch_um": 9.0}
    data["array"]["centers_mm"] = [center for center in data["array"]["centers_mm"] if max(map(abs, center)) < 4.4]
    (folder / "design").mkdir()
    write_design(folder / "design" / "geomscope.toml", design := Design.model_validate(data))
    points = random_points(5, (3.0, 3.0), (18.5, 21.5), seed=3)
    image = simulate(points, design.imager(), optics="near", psf="geometric")
    write_capture(folder / "capture.tif", np.asarray(expose(image, Camera(), jax.random.key(0), peak_electrons=2e4)))
    return points


def shares_within(
    volume: np.ndarray, deviation: np.ndarray, truth: np.ndarray, imager: Imager, grid: Grid
) -> tuple[float, float]:
    """Shares of the bright voxels that differ from the truth, scaled best, by one deviation at most, and by two.

    The truth is blurred along z until the lenses of the field tell its planes apart: the disc over which they see a
    voxel's light there, of half its radius in RMS, is as wide as a voxel, whose RMS is its side over root 12.
    """
    depths = np.asarray(grid.depths, np.float64)
    blur = depths.mean() * grid.pitch / (math.sqrt(3) * float(imager.field_radius))
    truth = gaussian_filter1d(np.asarray(truth, np.float64), blur / np.diff(depths).mean(), axis=0)
    bright = volume > BRIGHT * volume.max()
    error = np.abs(volume - np.vdot(volume, truth) / np.vdot(truth, truth) * truth)[bright]
    return float(np.mean(error <= deviation[bright])), float(np.mean(error <= 2 * deviation[bright]))
