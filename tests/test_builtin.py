from pathlib import Path

import numpy as np
import pytest

from gs_jax.design.design import read_design
from gs_jax.design.start import geomscope
from gs_jax.microscope.layouts import coverage, nearest_neighbour_distances

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("folder", "name", "distance"), [("design", "geomscope", 5.8), ("experiments/designs", "geomscope-table1", 4.0)]
)
def test_designs_are_what_their_script_makes(folder, name, distance):
    shipped = read_design(ROOT / folder / f"{name}.toml")
    made = geomscope(sensor_distance_mm=distance)
    # The layout's search sums floats, so another processor may round its way to another layout: not the centres.
    same = lambda design: design.model_dump(exclude={"name", "provenance", "array"})
    assert shipped.name == name
    assert same(shipped) == same(made)


def test_the_layout_has_the_papers_statistics():
    design = read_design(ROOT / "design" / "geomscope.toml")
    centers = np.array(design.array.centers_mm)
    distances = nearest_neighbour_distances(centers)
    assert len(centers) == 200
    assert abs(distances.mean() - 1.23) <= 0.02 and abs(distances.std() - 0.09) <= 0.02
    assert coverage(centers, design.array.size_mm, diameter=2.0) == pytest.approx(1, abs=1e-4)
