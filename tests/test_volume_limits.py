"""The experiments on what limits volumes: scenes, light on planes, voxels between planes, and intervals."""

import jax
import numpy as np
import pytest

from experiments import voxel_width
from experiments.between_planes import PLANES, Slabs, count, on_planes, spread
from experiments.surfaces import DEPTHS, STEP
from experiments.volume_limits import KINDS, cell, flattened, scene
from gs_jax import Grid, Imager, MicrolensArray, Sensor
from gs_jax.reconstruction.inverse_problem import InverseProblem


@pytest.mark.parametrize("kind", KINDS)
def test_emitters_put_on_planes_keep_their_light_and_depth(kind):
    emitters, depths = scene(kind, 0), np.linspace(*DEPTHS, count(STEP))
    flat = flattened(emitters, depths)
    assert not np.array_equal(emitters, scene(kind, 1))
    assert (flat[:, 3] > -1e-12).all() and np.isin(flat[:, 2], depths).all()
    assert flat[:, 3].sum() == pytest.approx(1)
    assert flat[:, 2] @ flat[:, 3] == pytest.approx(emitters[:, 2] @ emitters[:, 3])


@pytest.mark.parametrize(("step", "fine"), PLANES)
def test_light_is_kept_from_planes_to_planes(step, fine):
    volume = np.random.default_rng(0).uniform(size=(count(step), 2, 2))
    on_fine = np.tensordot(spread(step, fine), volume, 1)
    assert on_fine.sum() == pytest.approx(volume.sum(), rel=1e-6)
    assert on_planes(on_fine, fine).shape == (count(STEP), 2, 2)
    assert on_planes(on_fine, fine).sum() == pytest.approx(volume.sum(), rel=1e-6)


def test_voxels_between_planes_have_an_exact_adjoint():
    imager = Imager(MicrolensArray([[-1.2, 0.3], [0.9, -0.2]]), Sensor((40, 40), 0.1), 5.8, 3.0)
    fine = InverseProblem(imager, Grid(np.linspace(18, 20, 5), (9, 9), 0.4), None)
    A = Slabs(fine, spread(2.5, 1.25).astype(float))
    x, y = (jax.random.normal(jax.random.key(n), s.shape) for n, s in enumerate((A.in_structure(), A.out_structure())))
    assert A.in_structure().shape == (3, 9, 9)
    assert np.vdot(A.mv(x), y) == pytest.approx(np.vdot(x, A.T.mv(y)))


def test_intervals_are_students():
    assert cell(np.array([1.0, 2.0, 3.0])) == "2.0 ± 2.5" and cell(np.array([1.0])) == "1.0"


def test_finer_voxels_keep_their_light_and_place():
    grid = Grid([20.0], (9, 7), 0.08, (0.01, -0.02))
    fine = voxel_width.finer(grid, 0.5)
    assert fine.pitch == 0.04 and fine.shape == (19, 15) and fine.origin is grid.origin
    volume = np.zeros(fine.volume_shape, np.float32)
    volume[0, 9 + 4, 7 - 1] = 1  # 0.16 mm down, and half-way between two columns
    wide = voxel_width.shared(volume, fine, grid)
    assert wide[0, 6, 2:5].tolist() == pytest.approx([0.5 if column in (2, 3) else 0 for column in range(2, 5)])
    assert wide.sum() == pytest.approx(1)
