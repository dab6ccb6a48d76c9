"""What `show` draws: every voxel that is brightest along a line of sight, where it is in mm."""

from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, show


@pytest.mark.parametrize("depths", [[20.0], [18.0, 19.0, 22.0]])
def test_a_bright_voxel_is_where_its_millimetres_are(depths):
    grid = Grid(depths, (5, 7), 0.1, origin=(1.0, -2.0))
    volume = np.zeros(grid.volume_shape)
    volume[-1, 3, 5] = 1
    (x, y, z) = grid.to_mm(np.array([len(depths) - 1, 3, 5]))
    figure = show(volume, grid, points=np.array([[x, y, z, 1.0]]))
    views = {(0, 1): figure.axes[0], (2, 1): figure.axes[1], (0, 2): figure.axes[2]}
    for (across, along), axes in views.items():
        drawn: Any = axes.collections  # a mesh and circles
        mesh, circles = drawn
        corners = mesh.get_coordinates()
        row, column = np.argwhere(mesh.get_array() == 1)[0]
        low, high = np.sort(corners[[row, row + 1], [column, column + 1]], axis=0)
        place = np.array([x, y, z])[[across, along]]
        np.testing.assert_allclose(circles.get_offsets()[0], place)
        # Between the edges of what is drawn; of uneven planes the depth is not in the middle.
        assert np.all((low < place) & (place < high))
    assert figure.axes[0].get_ylim()[0] > figure.axes[0].get_ylim()[1]  # row 0 at the top


def test_a_volume_of_another_grid_is_refused():
    with pytest.raises(ValueError, match=r"the grid's shape \(1, 5, 7\), got \(1, 7, 5\)"):
        show(np.zeros((1, 7, 5)), Grid([20.0], (5, 7), 0.1))


def test_a_dark_volume_and_no_points():
    show(np.zeros((1, 5, 7)), Grid([20.0], (5, 7), 0.1), points=np.zeros((0, 4))).canvas.draw()
