import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.backprojection_speed import FORMS, FROM_HOST, OURS, Job, memory, on_accelerator, report, tables
from experiments.common import write
from experiments.kernels import count_pairs, lens_patches, paper_loop, plain
from gs_jax import backproject
from gs_jax.base.progress import Progress
from gs_jax.microscope.geometry import field_limit

from .helpers import scene

pytestmark = pytest.mark.integration

# Rotated lenses, rays that miss the sensor, voxels of all sizes.
SCENES: tuple[dict[str, Any], ...] = (dict(), dict(voxels=(40, 33), pitch=0.006), dict(voxels=(9, 8), pitch=0.21))


@pytest.mark.parametrize("kernel", [paper_loop, lens_patches])
def test_the_kernels_compute_the_same_sum(kernel):
    for case in SCENES:
        imager, grid = scene(jnp.float32, **case)
        image = jax.random.uniform(jax.random.key(0), imager.sensor.shape, jnp.float32)
        expected = np.asarray(backproject(image, imager, grid))
        found = kernel(np.asarray(image), plain(imager, grid))
        np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())


@pytest.mark.parametrize("case", SCENES)
def test_pairs_are_those_within_the_field_whose_ray_is_on_the_sensor(case):
    imager, grid = scene(**case)
    z, y, x = (a.ravel() for a in np.meshgrid(grid.depths, grid.y, grid.x, indexing="ij"))
    pixel = np.asarray(imager.sensor.to_pixels(imager.project(np.stack([x, y, z], axis=1))))
    on_sensor = ((pixel >= 0) & (pixel <= np.array(imager.sensor.shape) - 1)).all(-1)
    lens_x, lens_y = np.asarray(imager.centers).T[..., None]
    distance = np.hypot(lens_x - x[None], lens_y - y[None])
    expected = int((on_sensor & (distance < field_limit(imager.field_radius))).sum())
    assert 0 < expected == count_pairs(plain(imager, grid), imager.sensor.shape)


def test_run_at_toy_size(tmp_path):
    sizes = [Job(voxels=n, pixels=120, lenses=9, depths=2) for n in (8, 20)]
    names = ("gs_jax", "numba, the paper's loop", "numba, lens patches", "gs_jax, adjoint")
    made = report(Progress(), jobs=sizes[1:], study={"voxels": sizes}, names=names, rounds=1, memory_of=())
    write(tmp_path, made)
    found = made.files["speed.json"]
    assert json.loads((tmp_path / "speed.json").read_text()).keys() == {"machine", "jobs", "study", "slopes"}
    assert found["jobs"][0]["contestants"].keys() == set(names)
    assert found["jobs"][0]["contestants"]["gs_jax"].keys() == {
        "median_s", "min_s", "processor_s", "rounds", "compile_s", "pairs_per_s", "ratio",
    }  # fmt: skip
    assert "| numba, lens patches |" in (tmp_path / "speed.md").read_text()
    assert (tmp_path / "speed.png").stat().st_size < 150_000


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_holds_the_volume():
    found = memory("gs_jax", Job(voxels=2200, pixels=120, lenses=9, depths=2))
    assert found["process_mib"] > found["extra_mib"] > 2200 * 2200 * 2 * 4 / 2**20


def test_accelerators_are_timed_at_toy_size():
    result = on_accelerator(Job(voxels=20, pixels=120, lenses=9, depths=2), rounds=1)
    ((_, columns, rows),) = tables({"jobs": [result]})
    names = [row[0] for row in rows]
    assert names == [*OURS, *FORMS, *FROM_HOST]
    assert all(row["many_s"] > 0 for row in result["contestants"].values())
    assert all(len(row) == len(columns) for row in rows)
