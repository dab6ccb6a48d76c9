"""Layers, samples and materials in design files."""

import dataclasses
from typing import get_args

import jax
import numpy as np
import pytest

import gs_jax as gs
from gs_jax.base.errors import InputError
from gs_jax.codesign.study import Study
from gs_jax.design.datasheets import datasheet
from gs_jax.design.design import Design, checked_design
from gs_jax.design.start import commented
from gs_jax.design.tables import Material
from gs_jax.microscope.media import MATERIALS
from gs_jax.mold.manufacturability import check_design
from gs_jax.mold.solids import MoldShape

from .test_designs import edited

FILTER = {"name": "filter", "thickness_mm": 2.0, "refractive_index": 1.52}
SLIP = {"thickness_mm": 0.17, "refractive_index": 1.523}
STACK = {
    "imaging.working_distance_mm": [19.7, 30.0],
    "layers.object": [FILTER],
    "layers.sensor": [{"thickness_mm": 0.6}, {"thickness_mm": 0.55, "refractive_index": "BK7"}],
    "sample": {"refractive_index": "water", "surface_mm": 19.67, "layers": [{"thickness_mm": 1.0}, SLIP]},
    "samples": {"gel": {"refractive_index": 1.43, "layers": [SLIP]}},
}


def design_of(changes) -> Design:
    return checked_design("design.toml", edited(changes))


@pytest.mark.parametrize(
    ("material", "wavelength", "index"),
    [
        ("BK7", 587.56, 1.51680),
        ("BK7", 486.13, 1.52238),
        ("fused silica", 587.56, 1.45846),
        ("PMMA", 587.56, 1.4911),
        ("water", 589.3, 1.3332),
        ("PDMS", 589.3, 1.4118),  # data sheet of Sylgard 184
        ("air", 520.0, 1.0),
    ],
)
def test_indices_of_materials_are_the_published_ones(material, wavelength, index):
    last_digit = {"BK7": 1e-5, "fused silica": 1e-5, "air": 0}.get(material, 6e-4)
    assert gs.refractive_index(material, wavelength) == pytest.approx(index, abs=last_digit)


def test_files_take_all_materials():
    assert get_args(Material) == tuple(MATERIALS)


@pytest.mark.parametrize(
    ("material", "wavelength", "words"),
    [("PMMA", 400.0, "436.8 to 1052 nm for the index of PMMA, got 400"), ("glass", 520.0, "fused silica, water, got")],
)
def test_indices_that_are_not_known(material, wavelength, words):
    with pytest.raises(InputError, match=words):
        gs.refractive_index(material, wavelength)


def test_the_imager_has_the_layers_of_the_file():
    design = design_of(STACK)
    water, scope = gs.refractive_index("water", 520.0), design.imager()
    by_hand = 19.67 - 2.0 * (1 - 1 / 1.52) - 0.17 * (1 - 1 / 1.523) + 1.33 / water + 1.0 / 1.43
    assert float(scope.reduced_depth(21.0)) == pytest.approx(by_hand)
    assert float(scope.reduced_sensor_distance) == pytest.approx(
        5.8 - 0.55 * (1 - 1 / gs.refractive_index("BK7", 520.0))
    )
    in_contact = 2.17 - 2.0 * (1 - 1 / 1.52) - 0.17 * (1 - 1 / 1.523) + (21 - 2.17) / 1.43 + 1.0 / 1.43
    assert float(design.imager("gel").reduced_depth(21.0)) == pytest.approx(in_contact)
    assert design.imager("air").sample is None
    red, thick = design.imager(wavelength_nm=650.0), design.imager(gs.Sample(1.5))
    assert red.sample is not None and thick.sample is not None
    assert float(red.wavelength) == pytest.approx(650e-6)
    assert float(red.sample.refractive_index) == pytest.approx(gs.refractive_index("water", 650.0))
    assert float(thick.sample.refractive_index) == 1.5


def test_an_imager_with_layers_makes_the_same_design(tmp_path):
    scope = dataclasses.replace(
        gs.geomscope().imager(),
        filters=gs.Layers([2.0, 0.5], [1.52, 1.0]),
        windows=gs.Layers([0.6, 0.55], [1.0, 1.51]),
        sample=gs.Sample(1.43, surface=19.0, layers=gs.Layers([0.17, 0.5], [1.523, 1.33])),
    )
    design = Design.from_imager(scope, name="stack", working_distance_mm=(19.5, 24.0))
    gs.write_design(tmp_path / "stack.toml", design)
    (tmp_path / "commented.toml").write_text(commented(design.replace(samples=design_of(STACK).samples)))
    assert gs.read_design(tmp_path / "stack.toml") == design
    assert gs.read_design(tmp_path / "commented.toml").samples == design_of(STACK).samples
    same = jax.tree.map(lambda a, b: np.array_equal(a, b), design.imager(), scope)
    assert all(jax.tree.leaves(same))
    assert "2 mm of n = 1.52" in str(design) and "n = 1.43, from z = 19 mm" in str(design)
    assert design.replace(sample={"refractive_index": 1.0}, layers={}).imager().filters is None


STUDY = Study.model_validate(
    {
        "depths_mm": (18.0, 22.0),
        "free": {"sensor_distance_mm": (4.0, 8.0)},
        "terms": ({"name": "focus_offset", "minimise": 1.0},),
        "stages": ({"solver": "lbfgsb", "steps": 1},),
    }
)


def test_a_design_with_samples_needs_a_default_or_a_choice(tmp_path):
    gel = STACK["samples"]["gel"]
    design = gs.geomscope().replace(samples={"gel": gel, "water": {"refractive_index": "water"}})
    for make in (design.imager, lambda: datasheet(design), lambda: gs.run_study(design, STUDY)):
        with pytest.raises(InputError, match="`sample` must be given .* has no default .sample., but .samples.: gel"):
            make()
    assert design.imager("none").sample is None and design.imager("gel").sample is not None
    # A table of air is a default, and stays one in a file. Molds ask for none.
    dry = design.replace(sample={"refractive_index": 1.0})
    gs.write_design(tmp_path / "dry.toml", dry)
    assert gs.read_design(tmp_path / "dry.toml") == dry and dry.imager().sample is None
    assert "samples by name: gel, water and no default" in str(design) and "no default" not in str(dry)
    shape = check_design(design, MoldShape(), chord=4e-4, resolution=0.025)
    assert all(result.level != "error" for result in shape)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"sample": "jelly"}, "`sample` must be one of [samples] in the design, gel, air, got 'jelly'"),
        ({"wavelength_nm": 0.52}, "`wavelength_nm` must be a number of nanometres from 10 to 100000, got 0.52"),
        (
            {"sample": gs.Sample(1.4, 1.0)},
            "`surface` must be 2 mm, as thick as the layers in front of the medium are, or more",
        ),
        ({"wavelength_nm": 2000.0}, "the wavelength must be 182 to 1129 nm for the index of water, got 2000"),
    ],
)
def test_imagers_that_cannot_be(how, words):
    with pytest.raises(InputError) as caught:
        design_of(STACK).imager(**how)
    assert words in str(caught.value)
