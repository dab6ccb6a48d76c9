"""Co-design of lenses that differ: a value for each kind, terms of kinds, and searches for several foci."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax import objectives, random_layout
from gs_jax.base.errors import InputError
from gs_jax.codesign.parameters import candidate, evaluated, new_design, start_values
from gs_jax.codesign.search import problem_of, run_study
from gs_jax.codesign.study import Study, initial_design
from gs_jax.codesign.terms import _OURS, TERMS
from gs_jax.design.datasheets import datasheet
from gs_jax.design.design import Design
from gs_jax.design.start import geomscope
from gs_jax.microscope.layouts import interleave
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.objectives.conditions import per_type
from gs_jax.optics.apertures import clear_diameter


def conics(count=12, side=4.2, *, diameter=0.8, radii=1.34):
    """Conics with their curved side to the object, a web of 0.1 mm between them at most; `radii` of one or of each."""
    centers = np.asarray(random_layout(count, (side, side), pitch=1.05, pitch_sd=0.08, seed=0))
    data = geomscope().model_dump()
    data["lens"] |= {"orientation": "curved", "conic_constant": -0.7, "aperture_diameter_mm": diameter}
    data["lens"] |= {"radius_of_curvature_mm": radii}
    # The plate goes on beyond the lenses: it cuts none of them.
    data["array"] |= {"centers_mm": tuple(map(tuple, centers.tolist())), "size_mm": (side + 1, side + 1)}
    data["imaging"] |= {"sensor_distance_mm": 2.95}
    return Design.model_validate(data | {"provenance": {}})


def study(**changes):
    base = {
        "depths_mm": (15.0, 30.0),
        "depth_count": 3,
        "free": {"radius_of_curvature_mm": [1.0, 3.0]},
        "terms": [{"name": "volume_error", "minimise": 0.1}],
        "stages": [{"solver": "lbfgsb", "steps": 5}],
    }
    return Study.model_validate(base | changes)


def two_kinds(**options):
    design = initial_design(conics(**options), study(types=2))
    return design, evaluated(design, depths_mm=(15.0, 30.0), depth_count=3)


def test_lenses_are_dealt_with_radii_spread_over_the_depths():
    """From 15 to 30 mm: paraxial foci are a third of the vergences apart, that of the middle kind in their middle."""
    design = initial_design(conics(), study(types=3))
    radii = np.array(design.lens.radius_of_curvature_mm)
    which = interleave(np.array(design.array.centers_mm), 3)
    np.testing.assert_array_equal(radii, np.unique(radii)[which])
    assert np.ptp(np.bincount(which)) <= 2
    middle = np.unique(radii)[1]
    focal, behind = np.unique(radii) / middle, 1 / (2.95 + 1 / 1.43)
    vergence = (0.05 + behind) / focal - behind  # 1/f - 1/v', for the middle kind in focus at 1/20
    np.testing.assert_allclose(vergence, [11 / 180, 0.05, 7 / 180], rtol=1e-9)
    assert middle == pytest.approx(1.34)
    assert initial_design(design, study(types=3)) is design and initial_design(design, study()) is design
    assert initial_design(conics(), study(types=1)) == conics()


def test_kinds_that_cannot_be():
    three = initial_design(conics(), study(types=3))
    with pytest.raises(InputError, match="`types` must be 3, .*, got 2"):
        initial_design(three, study(types=2))
    with pytest.raises(InputError, match="`types` must be at most 4, .*, got 5"):
        initial_design(conics(4, 2.4), study(types=5))
    thin = conics().model_copy(update={"lens": conics().lens.model_copy(update={"focal_length_mm": 4.65})})
    with pytest.raises(InputError, match="`types` needs a design without"):
        initial_design(thin, study(types=2))


@pytest.mark.integration
def test_each_kind_has_its_own_values_and_a_file_has_them_for_each_lens():
    design, parent = two_kinds()
    values = start_values(*parent)
    assert {name for name, x in values.items() if x.shape == (2,)} >= {"radius_of_curvature_mm", "conic_constant"}
    moved = {"conic_constant": jnp.array([-0.7, -0.5]), "aperture_diameter_mm": jnp.array([0.7, 0.65])}
    moved |= {"pitch_mm": 1.1 * values["pitch_mm"]}
    (found, at), made = candidate(*parent, values=moved), new_design(design, *parent, values=moved)
    array, which = made.imager().array, lenses_by_type(parent[0].array)
    first = which[0]
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(array.of_lenses("conic_constant")) == -0.7), first)
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(array.of_lenses("aperture_diameter")) == 0.7), first)
    np.testing.assert_allclose(found.array.radius_of_curvature, array.radius_of_curvature, atol=1e-4)
    # Rounded to 1e-4 mm; 64 directions against 512.
    np.testing.assert_allclose(objectives.clear_diameter(found, at), clear_diameter(array), rtol=1e-3)
    for part, lenses in zip(per_type(found, at), which, strict=True):
        np.testing.assert_allclose(objectives.clear_diameter(*part), clear_diameter(array.subset(lenses)), rtol=1e-3)
    # Kinds that come to the same are one number again.
    same = new_design(design, *parent, values={"radius_of_curvature_mm": jnp.array([1.34001, 1.34003])})
    assert same.lens.radius_of_curvature_mm == 1.34


@pytest.mark.integration
def test_where_lenses_overlap_they_end_as_those_of_the_file():
    """With a pitch that scales them all, as the plate's size cannot be traced."""
    design, parent = two_kinds(diameter=1.3)
    values = {"pitch_mm": 0.9 * start_values(*parent)["pitch_mm"]}
    (found, at), array = candidate(*parent, values=values), new_design(design, *parent, values=values).imager().array
    np.testing.assert_allclose(objectives.clear_diameter(found, at), clear_diameter(array), rtol=1e-3)


@pytest.mark.integration
def test_terms_of_kinds_that_are_alike_are_those_of_one():
    """The same lenses, counted as one kind and as two."""
    one = evaluated(conics(), depths_mm=(15.0, 30.0), depth_count=3)
    _, two = two_kinds()
    alike = {"radius_of_curvature_mm": jnp.full(2, 1.34)}

    @eqx.filter_jit
    def terms(parent, values):
        found = candidate(*parent, values=values)
        return {name: term.function(*found) for name, term in _OURS.items()}

    single, several = terms(one, {}), terms(two, alike)
    for name in _OURS:
        expected = np.broadcast_to(single[name], several[name].shape)
        np.testing.assert_allclose(several[name], expected, rtol=1e-6, err_msg=name)


@pytest.mark.integration
def test_every_lens_may_be_a_kind_of_its_own():
    """The best of all is the best of what each has alone, and a search takes them."""
    twelve = study(types=12, terms=[{"name": "psf_width_um", "minimise": 100.0}], depth_count=2)
    design, depths = initial_design(conics(), twelve), np.array([15.0, 30.0])
    alone = [objectives.spot_width(*part) for part in per_type(design.imager(), depths)]
    np.testing.assert_allclose(objectives.spot_width(design.imager(), depths), np.min(alone, 0), rtol=1e-9)
    found = run_study(design, twelve)
    assert found.after[0].high < found.before[0].high
    assert len(np.unique(found.design.lens.radius_of_curvature_mm)) == 12


@pytest.mark.integration
def test_the_best_kind_at_each_depth_is_the_datasheets():
    design, parent = two_kinds()
    found, sheet = candidate(*parent, values={}), datasheet(design, [15.0, 22.5, 30.0])
    widths = jax.jit(TERMS["psf_width_um"].function)(*found)
    np.testing.assert_allclose(widths, sheet["spot_width_um"], rtol=1e-3)
    assert set(sheet["sharpest_kind"]) == {1, 2}
    np.testing.assert_allclose(TERMS["coverage"].function(*found), sheet["coverage"], rtol=1e-3)
    slopes = TERMS["edge_slope_deg"].function(*found)
    assert slopes.shape == (2,) and slopes[0] != slopes[1]


def test_webs_are_between_apertures_of_their_own_size():
    _, parent = two_kinds()
    diameters = np.array([0.7, 0.5])
    found = candidate(*parent, values={"aperture_diameter_mm": jnp.array(diameters)})
    centers, each = np.asarray(found[0].array.centers), np.asarray(found[0].array.of_lenses("aperture_diameter"))
    least = [
        min(np.hypot(*(centers[i] - centers[j])) - (each[i] + each[j]) / 2 for j in range(12) if j != i)
        for i in range(12)
    ]
    np.testing.assert_allclose(TERMS["min_wall_mm"].function(*found), least, rtol=1e-12)


@pytest.mark.integration
def test_gradients():
    """By what is free of each kind, apart and where discs overlap; every entry, so that ties do not matter."""
    _, parent = two_kinds()
    names = ("volume_error", "light_percent", "min_wall_mm", "psf_width_um", "width_per_light_um")
    values = {
        name: start_values(*parent)[name] for name in ("radius_of_curvature_mm", "sensor_distance_mm", "pitch_mm")
    }
    values |= {"conic_constant": jnp.array([-0.7, -0.5]), "aperture_diameter_mm": jnp.array([0.6, 0.7])}
    terms = jax.jit(lambda values: [TERMS[name].function(*candidate(*parent, values=values)) for name in names])
    check_grads(terms, (values,), order=1, modes=["rev"], eps=1e-6, atol=1e-5, rtol=1e-5)
    values["aperture_diameter_mm"] = jnp.array([1.3, 1.21])
    light = jax.jit(lambda values: TERMS["light_percent"].function(*candidate(*parent, values=values)))
    check_grads(light, (values,), order=1, modes=["rev"], eps=1e-7, atol=1e-3, rtol=1e-3)


@pytest.mark.integration
def test_one_kind_is_as_before():
    """`kinds = 1` changes nothing, to the last digit."""
    few = {"stages": [{"solver": "lbfgsb", "steps": 3}], "terms": [{"name": "psf_width_um", "minimise": 100.0}]}
    plain, one = (run_study(conics(4, 2.4), study(**few, **types)) for types in ({}, {"kinds": 1}))
    assert plain.log == one.log and plain.design.lens == one.design.lens


@pytest.fixture(scope="module")
def searches():
    """The same search of one kind, and of two from where that ended."""
    free = {"radius_of_curvature_mm": [1.0, 3.0], "sensor_distance_mm": [2.0, 6.0]}
    one = run_study(conics(), study(free=free))
    return one, run_study(one.design, study(free=free, types=2))


@pytest.mark.integration
def test_two_foci_are_better_over_a_long_span(searches):
    """Than the start, and than the single kind, by 2 dB."""
    one, two = searches
    assert one.after[0].high < one.before[0].high and two.after[0].high < two.before[0].high
    assert 20 * np.log10(one.after[0].high / two.after[0].high) > 2
    radii = two.design.lens.radius_of_curvature_mm
    assert len(set(radii)) == 2 and len(radii) == 12
    assert "12 lenses of 2 types" in repr(two.design)


@pytest.mark.integration
def test_what_is_found_goes_on_as_a_design_of_two_kinds(searches):
    """What is written is read as its kinds, and judged as it was."""
    design = searches[1].design
    again = problem_of(design, study(types=2))
    assert len(lenses_by_type(again.imager.array)) == 2
    value = TERMS["volume_error"].function(*candidate(again.imager, again.at, {}))
    assert float(value) == pytest.approx(searches[1].after[0].high, rel=1e-6)


def test_dealt_lenses_are_balanced():
    centers = np.array(list(itertools.product(np.arange(6.0), np.arange(6.0))))
    for count in (1, 2, 3):
        assert np.bincount(interleave(centers, count)).tolist() == [36 // count] * count
    np.testing.assert_array_equal(interleave(np.zeros((1, 2)), 1), [0])
    which = interleave(centers, 2).reshape(6, 6)
    assert (which[1:] != which[:-1]).mean() + (which[:, 1:] != which[:, :-1]).mean() > 1.2  # at random: 1
