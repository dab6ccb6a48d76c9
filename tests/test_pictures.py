"""What `show` draws: every voxel that is brightest along a line of sight, where it is in mm."""

from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, show
from gs_jax.apps.pictures import make_slices


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


def drawn_value(figure, view, across, along):
    """The brightness, 0 to 1, of the cell of a view at a position, mm."""
    mesh: Any = figure.axes[view].collections[0]
    corners = mesh.get_coordinates()
    columns, rows = np.searchsorted(corners[0, :, 0], across) - 1, np.searchsorted(corners[:, 0, 1], along) - 1
    return float(mesh.norm(mesh.get_array()[rows, columns]))


def test_points_are_seen_in_all_views_and_ghosts_are_as_dim_as_they_are():
    """Single voxels of a wide volume: a picture has fewer pixels than it has voxels. Ghosts have 2 % of the light."""
    grid, rng = Grid([19.0, 20.0, 21.0], (1153, 1153), 0.02), np.random.default_rng(0)
    volume = np.full(grid.volume_shape, 0.01, np.float32)
    volume[rng.integers(0, 3, 200), rng.integers(0, 1153, 200), rng.integers(0, 1153, 200)] = 0.03
    points = {(0, 576, 576): 1.0, (1, 400, 651): 0.9, (2, 626, 477): 0.7}
    for voxel, light in points.items():
        volume[voxel] = light
    figure = show(volume, grid)
    meshes: list[Any] = [axes.collections[0] for axes in figure.axes[:3]]
    assert max(max(mesh.get_array().shape) for mesh in meshes) <= 400
    for voxel, light in points.items():
        x, y, z = grid.to_mm(np.array(voxel))
        for view, place in enumerate(((x, y), (z, y), (x, z))):
            assert drawn_value(figure, view, *place) == pytest.approx(np.sqrt((light - 0.01) / 0.99), abs=1e-3)
    assert max(float(np.sort(np.ravel(mesh.norm(mesh.get_array())))[-4]) for mesh in meshes) < 0.2
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "% from median to maximum"
    assert [text.get_text() for text in bar.get_yticklabels()][-1] == "100"


def test_slices_begin_at_the_brightest_and_say_how_long_a_length_is():
    grid = Grid([18.0, 19.0, 20.0, 21.0], (50, 60), 0.05, origin=(1.0, 0.0))
    volume = np.zeros(grid.volume_shape)
    volume[3, 20, 30] = 1.0
    figure: Any = show(volume, grid)
    html = figure._repr_html_()
    assert 'value="3"' in html and ">1 mm</div>" not in html and ">500 um</div>" in html
    assert "x from -0.5 to 2.5 mm to the right, y from -1.25 to 1.25 mm down" in html
    pictures = make_slices(volume, grid, 10**6).pictures
    assert len(set(pictures[:3])) == 1 and pictures[3] != pictures[0]


def test_a_volume_of_another_grid_is_refused():
    with pytest.raises(ValueError, match=r"the grid's shape \(1, 5, 7\), got \(1, 7, 5\)"):
        show(np.zeros((1, 7, 5)), Grid([20.0], (5, 7), 0.1))


def test_a_dark_volume_and_no_points():
    show(np.zeros((1, 5, 7)), Grid([20.0], (5, 7), 0.1), points=np.zeros((0, 4))).canvas.draw()
