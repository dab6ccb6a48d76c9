import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import j0, j1

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.microscope.geometry import chief_ray
from gs_jax.optics.aberrations import best_focus, wavefront_rms
from gs_jax.optics.diffraction import strehl
from gs_jax.optics.psf import _pixel_energy, diffraction_psf, gaussian_psf, geometric_psf
from gs_jax.optics.raytrace import trace_lenslet

WAVELENGTH, RADIUS = 520e-6, 0.65
KINDS = [diffraction_psf, geometric_psf, gaussian_psf]
# Where compiling takes longer than ten seconds on a busy machine.
SLOW_FIRST = [*(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[:2]), gaussian_psf]


def lenslet(v=5.8, dtype=jnp.float64, pitch=0.0045, **lens):
    imager = Imager(MicrolensArray([[0.0, 0.0]], **lens), Sensor((64, 64), pitch), v, 3.0)
    return jax.tree.map(lambda leaf: jax.device_put(np.array(leaf, dtype)), imager)


def in_focus(**more):
    """A thin lens whose sensor is at the image of a point 20 mm in front."""
    return lenslet(1 / (1 / 4.65 - 1 / (20 + 1 / 1.43)), thin_lens_focal_length=4.65, **more)


def centroid(image):
    grid = np.indices(image.shape) - image.shape[0] // 2
    return (grid * np.asarray(image)).sum((1, 2))


def test_a_thin_lens_in_focus_makes_airys_pattern():
    """On fine pixels, so that a pixel's middle stands for the pixel."""
    imager, radius = in_focus(pitch=0.0002), 0.3
    image = diffraction_psf(imager, 20.0, size=65, radius=radius, samples=4)
    rows, columns = (np.indices((65, 65)) - 32) * 0.0002
    x = 2 * np.pi * radius * np.hypot(rows, columns) / (WAVELENGTH * float(imager.sensor_distance))
    airy = (2 * j1(np.where(x, x, 1)) / np.where(x, x, 1)) ** 2
    airy[32, 32] = 1
    # A pixel is 1/25 of the disc; its average differs from its middle by 2e-3 of the peak.
    np.testing.assert_allclose(image / image.max(), airy / airy.max(), atol=4e-3)


def test_what_is_outside_the_window_is_accounted_for():
    """Airy's encircled energy in a square window is between that of its inner and outer circles."""
    imager, radius, size = in_focus(), 0.3, 5
    light = lambda size, samples: _pixel_energy(imager, 20.0, size, (0.0, 0.0), (0.0, 0.0), radius, None, samples).sum()
    fraction = light(size, 8)
    circle = lambda r: 2 * np.pi * radius * r / (WAVELENGTH * float(imager.sensor_distance))
    inner, outer = (1 - j0(circle(r)) ** 2 - j1(circle(r)) ** 2 for r in (size * 0.0045 / 2, size * 0.0045 / 2**0.5))
    assert inner < fraction < outer
    # Parseval: all of it is somewhere.
    everything = light(129, 4)
    np.testing.assert_allclose(everything, 1, atol=3e-3)  # the rings beyond 65 pixels


@pytest.mark.parametrize("field", [(0.0, 0.0), (2.0, -1.0)])
def test_far_from_focus_it_is_the_shadow_of_the_aperture(field):
    """Thin lens, v = 4 mm: a disc, a (1 - v/v') in radius, evenly lit, about the chief ray."""
    imager = lenslet(4.0, thin_lens_focal_length=4.65)
    image = diffraction_psf(imager, 20.0, size=129, radius=RADIUS, field=field)
    blur = RADIUS * (1 - 4 * (1 / 4.65 - 1 / (20 + 1 / 1.43))) / 0.0045
    distance = np.hypot(*(np.indices((129, 129)) - 64))
    # Fresnel fringes at the edge, a few pixels wide, are what is not geometric.
    np.testing.assert_allclose(np.asarray(image)[distance < blur - 5].mean(), 1 / (np.pi * blur**2), rtol=0.03)
    assert float(image[distance > blur + 5].sum()) < 0.01
    rays = geometric_psf(imager, 20.0, size=129, radius=RADIUS, field=field)
    np.testing.assert_allclose(np.asarray(rays)[distance < blur - 2], 1 / (np.pi * blur**2), rtol=0.15)


@pytest.mark.integration
@pytest.mark.parametrize(("v", "field"), [pytest.param(4.0, (0.0, 0.0), marks=pytest.mark.slow), (5.67, (3.0, 0.0))])
def test_huygens_principle_summed_directly(v, field):
    """Wavelets from points of the lens, a sum for each point of the sensor; no exit pupil, no linear phase."""
    imager, z, size = lenslet(v), 20.0, 65 if field[0] else 129
    count = 400
    side = RADIUS * (2 * (np.arange(count) + 0.5) / count - 1)
    points = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    points = points[(points**2).sum(1) < RADIUS**2]
    rays = trace_lenslet(imager, z, points, field)
    behind = v + 2 - np.sqrt(4 - (points**2).sum(1))
    to_lens = np.asarray(rays.path) - behind * np.sqrt(1 + (np.asarray(rays.tangent) ** 2).sum(1))
    chief = np.asarray(chief_ray(np.zeros(2), np.array(field), float(imager.magnification(z))))
    # A line of fine pixels along the field.
    fine = np.arange(-size // 2 * 4, size // 2 * 4) * 0.0045 / 4
    direct = []
    for x in fine:
        total = to_lens + np.sqrt(behind**2 + ((points - chief - [x, 0]) ** 2).sum(1))
        direct.append(abs(np.exp(2j * np.pi / WAVELENGTH * (total - total[0])).sum()) ** 2)
    direct = np.array(direct)
    tiny = lenslet(v, pitch=0.0045 / 4)
    ours = diffraction_psf(
        tiny, z, size=4 * size - 1 if size % 2 == 0 else 4 * size + 1, field=field, radius=RADIUS, samples=1
    )
    middle = ours.shape[0] // 2
    line = np.asarray(ours)[middle, middle + np.round(fine / (0.0045 / 4)).astype(int)]
    # Not the fringes one by one: amplitudes differ by the obliquity (cosines of 0.95) and the edge's softness.
    smooth = lambda a: np.convolve(a / a.sum(), np.ones(4), "valid")
    assert np.abs(smooth(line) - smooth(direct)).sum() < 0.12 * smooth(direct).sum()
    np.testing.assert_allclose((line * fine).sum() / line.sum(), (direct * fine).sum() / direct.sum(), atol=0.002)


# Small apertures, so that each has less than 0.1 waves and is nearly one term: what, lens, v less the focus, field.
SMALL = {
    "defocus": (dict(thin_lens_focal_length=4.65), 0.3, 0.05, (0.0, 0.0)),
    "spherical": ({}, 0.45, 0.0, (0.0, 0.0)),
    "coma and astigmatism": ({}, 0.3, 0.0, (1.5, 1.0)),
    "astigmatism": ({}, 0.22, 0.0, (0.0, 2.5)),
}


@pytest.mark.integration
@pytest.mark.parametrize("what", SMALL)
def test_strehl_of_small_errors_is_the_exponential(what):
    lens, radius, beside, field = SMALL[what]
    v = best_focus(lenslet(**lens), 20.0, field=field, radius=radius) + beside
    imager = lenslet(v, **lens)
    rms = wavefront_rms(imager, 20.0, field=field, radius=radius) / WAVELENGTH
    assert 0.02 < rms < 0.1
    ratio = strehl(imager, 20.0, field=field, radius=radius)
    # The exponential leaves out the fourth power of the phase: (2 pi 0.1)^4 / 8 is 2 %.
    np.testing.assert_allclose(ratio, np.exp(-((2 * np.pi * rms) ** 2)), rtol=0.02)


def test_strehl_is_one_without_aberrations():
    np.testing.assert_allclose(strehl(in_focus(), 20.0, radius=RADIUS), 1, rtol=1e-9)


@pytest.mark.integration
@pytest.mark.parametrize("field", [(0.0, 0.0), (1.0, -2.0)])
def test_rays_and_waves_have_the_same_centroid(field):
    """Ehrenfest: the mean of the waves is that of the rays, whatever the aberrations."""
    options = dict(size=129, field=field, radius=RADIUS)
    image, rays, gauss = (kind(lenslet(5.2), 20.0, **options) for kind in KINDS)
    # The wings outside the window, and the aperture's soft edge: some hundredths of a pixel.
    np.testing.assert_allclose(centroid(image), centroid(rays), atol=0.15)
    np.testing.assert_allclose(centroid(gauss), centroid(rays), atol=0.02)


def test_the_gaussian_has_the_rays_second_moment():
    imager = lenslet(4.0)
    image = gaussian_psf(imager, 20.0, size=257, radius=RADIUS)
    second = lambda a: (np.asarray(a) * (np.arange(257) - 128.0) ** 2).sum()
    rays = geometric_psf(imager, 20.0, size=257, radius=RADIUS)
    # Sheppard: integration over pixels adds 1/12; sharing rays among pixels about 1/6.
    np.testing.assert_allclose(second(image) - 1 / 12, second(rays) - 1 / 6, rtol=2e-3)


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
def test_sum_centre_and_symmetry(kind):
    options = dict(size=65, radius=RADIUS)
    image = kind(lenslet(), 20.0, **options)
    np.testing.assert_allclose(image.sum(), 1, rtol=1e-12)
    # The spiral of rays is symmetric only on average.
    tolerance = 3e-3 if kind is geometric_psf else 1e-12
    for other in (image.T, image[::-1], image[:, ::-1]):
        np.testing.assert_allclose(other, image, atol=tolerance * float(image.max()))
    moved = kind(lenslet(), 20.0, offset=(0.3, -0.4), **options)
    # The wide halo is cut by the window, on one side more.
    np.testing.assert_allclose(centroid(moved), [0.3, -0.4], atol=0.03)
    along_x, along_y = (kind(lenslet(), 20.0, field=field, **options) for field in ((2.0, 0.0), (0.0, 2.0)))
    np.testing.assert_allclose(along_y, along_x.T, atol=20 * tolerance * float(along_x.max()))


@pytest.mark.parametrize("kind", [diffraction_psf, geometric_psf])
def test_edges_cut_the_aperture(kind):
    """Half a lens far from focus makes half a disc, on the side where the lens is: before the image, no inversion."""
    imager = lenslet(4.0, thin_lens_focal_length=4.65)
    options = dict(size=129, radius=RADIUS, edges=np.array([[1e-6, 0.0]]))
    image = kind(imager, 20.0, **options)
    # Half of the middle column, 1/80 of the light, and Fresnel's fringes are beyond.
    assert float(image[:, :64].sum()) > 0.97


@pytest.mark.integration
@pytest.mark.parametrize(
    ("v", "field", "size"),
    [(5.8, (0.0, 0.0), 65), (5.8, (3.0, 0.0), 65), pytest.param(4.0, (0.0, 0.0), 129, marks=pytest.mark.slow)],
)
def test_float32(v, field, size):
    options = dict(size=size, field=field, radius=RADIUS)
    exact, low = diffraction_psf(lenslet(v), 20.0, **options), diffraction_psf(lenslet(v, jnp.float32), 20.0, **options)
    assert low.dtype == jnp.float32
    # Phases of 30 waves to a thousandth.
    np.testing.assert_allclose(low, exact, rtol=0, atol=2e-3 * float(exact.max()))


@pytest.mark.slow
@pytest.mark.parametrize(("v", "size", "samples"), [(5.8, 65, 3), (4.0, 129, 4)])
def test_more_samples_change_little(v, size, samples):
    """Parseval asks for 1.9 and 2.8. What is left is the aperture's edge, and light folded back."""
    image, finer = (diffraction_psf(lenslet(v), 20.0, samples=s, size=size, radius=RADIUS) for s in (samples, 6))
    assert float(jnp.abs(image - finer).sum()) < 0.03


@pytest.mark.integration
def test_depths_map():
    depths = jnp.array([18.0, 20.0])
    one = lambda z: diffraction_psf(lenslet(), z, size=33, radius=RADIUS)
    np.testing.assert_allclose(jax.vmap(one)(depths)[1], one(20.0), atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("kind", SLOW_FIRST)
def test_gradients(kind):
    smooth = jnp.cos(jnp.arange(17.0) / 5)

    @jax.jit
    def moment(imager, depth, field, offset, radius):
        arguments = dict(size=17, field=field, offset=offset, radius=radius)
        image = kind(imager, depth, **arguments)
        return smooth @ image @ smooth

    arguments = (lenslet(), jnp.array(20.0), jnp.array([0.6, -0.3]), jnp.array([0.2, 0.1]), jnp.array(0.4))
    # Rays cross pixel borders and edges of the soft aperture: kinks, of a 1/32768 and a 1/1000 of the light each.
    rtol = 2e-2 if kind is geometric_psf else 1e-3
    # The wavelength is 1e-4 of the rest: a step of 1e-7 mm is still small for it.
    check_grads(moment, arguments, order=1, eps=1e-8, atol=1e-4, rtol=rtol)


@pytest.mark.slow
def test_gradient_of_the_strehl_ratio():
    ratio = jax.jit(lambda imager, depth: strehl(imager, depth, radius=0.4, samples=64))
    check_grads(ratio, (lenslet(5.9), jnp.array(20.0)), order=1, eps=1e-7, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", SLOW_FIRST)
def test_gradients_are_finite_for_an_ideal_lens_on_its_axis(kind):
    total = jax.jit(lambda imager: jnp.sum(kind(imager, 20.0, size=9, radius=0.4) ** 2))
    gradient = jax.jit(jax.grad(total))(in_focus())
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize(
    ("options", "words"),
    [(dict(size=8), "`size` must be odd and positive, got 8"), (dict(size=9, samples=0), "`samples` must be positive")],
)
def test_wrong_arguments_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        diffraction_psf(lenslet(), 20.0, **options)
