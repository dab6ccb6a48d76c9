"""Run one solver of `peers.py` in the environment that has it, step by step.

    PYTHON experiments/peers_runs.py CODE INPUT.npz OUTPUT.npz STEPS

CODE is gs_jax, scico or LenslessPiCam (`pip install scico`, `pip install lensless`, each in an environment of its own),
for its ADMM, or one with a method, such as "scico FISTA". After each step the objective of its scene is computed here,
in NumPy and SciPy, the same for all; this is not timed.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft

WARM_UP = 2
# Penalties and relaxation of scico's example of this problem.
PENALTIES, RELAXATION = (1.0, 5.0, 10.0), 1.8


class Problem:
    """`|crop(sum h_k * x_k) - y|^2 / 2 + tv |D x| + l1 |x|`, with differences along rows and columns."""

    def __init__(self, path: str):
        given = np.load(path)
        self.image, self.stack = given["image"], given["stack"]
        self.tv, self.l1 = float(given["tv"]), float(given["l1"])
        # Of gradient vectors and of either sign, or of each axis and not negative.
        self.isotropic = self.signed = bool(given["signed"])
        size = tuple(n + k for n, k in zip(self.image.shape, self.stack.shape[1:], strict=True))
        self.size: tuple[int, int] = (size[0], size[1])

    def window(self, size: tuple[int, ...]) -> tuple[slice, slice]:
        corner = [(n - m) // 2 for n, m in zip(size, self.image.shape, strict=True)]
        rows, columns = (slice(a, a + m) for a, m in zip(corner, self.image.shape, strict=True))
        return rows, columns

    def objective(self, scene: np.ndarray) -> float:
        spectrum, penalty, fft = np.zeros(()), 0.0, scipy.fft
        high, wide = self.stack.shape[1:]
        for plane, psf in zip(scene.astype(np.float32), self.stack, strict=True):
            padded = np.zeros(plane.shape, np.float32)
            padded[:high, :wide] = psf
            padded = np.roll(padded, (-(high // 2), -(wide // 2)), (0, 1))
            spectrum = spectrum + np.asarray(fft.rfft2(padded, workers=2)) * np.asarray(fft.rfft2(plane, workers=2))
            steps = [np.roll(plane, -1, axis) - plane for axis in (0, 1)]
            lengths = np.hypot(*steps) if self.isotropic else np.abs(steps[0]) + np.abs(steps[1])
            penalty += self.tv * lengths.sum(dtype=np.float64) + self.l1 * np.abs(plane).sum(dtype=np.float64)
        residual = np.asarray(fft.irfft2(spectrum, scene.shape[1:]))[self.window(scene.shape[1:])] - self.image
        return float((residual.astype(np.float64) ** 2).sum() / 2 + penalty)


# A code starts runs. After each step a run yields its scene, as a function, and the objective that the code itself has.
Run = Iterator[tuple[Callable[[], np.ndarray], float]]


def gs_jax(problem: Problem, method: str = "ADMM") -> Callable[[], Run]:
    import jax

    from gs_jax import FISTA, ConvolutionADMM, ConvolutionOperator, RichardsonLucy

    A = ConvolutionOperator(problem.stack, problem.image.shape)
    if method == "ADMM":
        unit = float(jax.jit(lambda A, y: A.T.mv(y).max())(A, problem.image))
        weights = {"tv": problem.tv / unit, "sparsity": problem.l1 / unit, "tv_z": 0.0}
        solver = ConvolutionADMM(1, isotropic=problem.isotropic, nonnegative=not problem.signed, **weights)
    else:
        solver = FISTA(1, sparsity=0.0) if method == "FISTA" else RichardsonLucy(1)
    init, step = jax.jit(solver.init), jax.jit(solver.step, donate_argnums=2)

    def start() -> Run:
        state = jax.block_until_ready(init(A, problem.image))
        while True:
            state = jax.block_until_ready(step(A, problem.image, state)[0])
            yield partial(np.asarray, solver.estimate(state)), float(getattr(state, "cost", math.nan))

    return start


def scico(problem: Problem, prints: bool = True) -> Callable[[], Run]:
    """With `prints` a step includes the objective that scico prints after it."""
    import jax
    from scico.functional import (  # pyright: ignore[reportMissingImports]
        L1Norm,
        L21Norm,
        NonNegativeIndicator,
        ZeroFunctional,
    )
    from scico.linop import FiniteDifference, Identity  # pyright: ignore[reportMissingImports]
    from scico.loss import SquaredL2Loss  # pyright: ignore[reportMissingImports]
    from scico.optimize.admm import ADMM, G0BlockCircularConvolveSolver  # pyright: ignore[reportMissingImports]

    crop, blur, options = _scico_operators(problem)
    differences = FiniteDifference(axes=(-2, -1), circular=True, **options)
    last = problem.l1 * L1Norm() if problem.signed else NonNegativeIndicator()

    def start() -> Run:
        solver = ADMM(
            f=ZeroFunctional(),
            g_list=[
                SquaredL2Loss(y=jax.device_put(problem.image), A=crop),
                problem.tv * (L21Norm() if problem.isotropic else L1Norm()),
                last,
            ],
            C_list=[blur, differences, Identity(**options)],
            rho_list=list(PENALTIES),
            alpha=RELAXATION,
            subproblem_solver=G0BlockCircularConvolveSolver(ndims=2),
            itstat_options={"display": False},
        )
        while True:
            solver.step()
            jax.block_until_ready([solver.x, *solver.z_list, *solver.u_list])
            yield partial(_of_sign, solver.x, problem.signed), float(solver.objective()) if prints else math.nan

    return start


def scico_fista(problem: Problem) -> Callable[[], Run]:
    import jax
    from scico.functional import NonNegativeIndicator  # pyright: ignore[reportMissingImports]
    from scico.loss import SquaredL2Loss  # pyright: ignore[reportMissingImports]
    from scico.optimize import AcceleratedPGM  # pyright: ignore[reportMissingImports]

    crop, blur, options = _scico_operators(problem)
    loss = SquaredL2Loss(y=jax.device_put(problem.image), A=crop @ blur)
    largest = float(np.abs(np.fft.rfft2(problem.stack, problem.size)).max() ** 2)

    def start() -> Run:
        zeros = jax.device_put(np.zeros(options["input_shape"], np.float32))
        solver = AcceleratedPGM(loss, NonNegativeIndicator(), largest, zeros, itstat_options={"display": False})
        while True:
            solver.step()
            jax.block_until_ready([solver.x, solver.v])
            yield partial(np.asarray, solver.x), math.nan

    return start


def _scico_operators(problem: Problem) -> tuple[Any, Any, dict]:
    """Crop, sum of convolutions, and the shape and type of scenes."""
    import jax
    from scico.linop import CircularConvolve, Crop, Sum  # pyright: ignore[reportMissingImports]

    options = {"input_shape": (len(problem.stack), *problem.size), "input_dtype": np.float32}
    middle = np.array(problem.stack.shape[1:]) // 2
    pads = [(rows.start, n - rows.stop) for rows, n in zip(problem.window(problem.size), problem.size, strict=True)]
    crop = Crop(tuple(pads), input_shape=problem.size, input_dtype=np.float32)
    convolve = CircularConvolve(jax.device_put(problem.stack), h_center=middle, ndims=2, **options)
    return crop, Sum(axis=0, **options) @ convolve, options


def _of_sign(scene, signed: bool) -> np.ndarray:
    return np.asarray(scene) if signed else np.maximum(np.asarray(scene), 0)


def LenslessPiCam(problem: Problem, method: str = "ADMM") -> Callable[[], Run]:
    """The scene of FISTA ends where the image does."""
    from lensless import ADMM, FISTA  # pyright: ignore[reportMissingImports]

    def start() -> Run:
        psf, is_admm = problem.stack[..., None].astype(np.float32), method == "ADMM"
        solver = ADMM(psf) if is_admm else FISTA(psf, norm="backward", initial_est=np.zeros_like(psf[None]))
        solver.set_data(problem.image[None, None, :, :, None].astype(np.float32))
        for number in count():
            solver._update(number)
            if is_admm:
                yield partial(_of_sign, solver._image_est[0, ..., 0], problem.signed), math.nan
            else:
                yield partial(_within, solver._xk, problem), math.nan

    return start


def _within(scene, problem: Problem) -> np.ndarray:
    """The middle of a scene that is dark beside it."""
    whole = np.zeros((1, *problem.size), np.float32)
    whole[(0, *problem.window(problem.size))] = scene[0, 0, ..., 0]
    return whole


# Names begin with that of the code.
CODES: dict[str, Callable[[Problem], Callable[[], Run]]] = {
    **{code.__name__: code for code in (gs_jax, scico, LenslessPiCam)},
    "gs_jax ADMM": gs_jax,
    "gs_jax FISTA": partial(gs_jax, method="FISTA"),
    "gs_jax Richardson-Lucy": partial(gs_jax, method="Richardson-Lucy"),
    "scico ADMM": partial(scico, prints=False),
    "scico FISTA": scico_fista,
    "LenslessPiCam ADMM": LenslessPiCam,
    "LenslessPiCam FISTA": partial(LenslessPiCam, method="FISTA"),
}
# Packages whose versions are written, by the code.
PACKAGES = {"gs_jax": ("gs-jax", "jax"), "scico": ("scico", "jax"), "LenslessPiCam": ("lensless", "scipy")}


def peak_mib() -> float:
    """Peak memory of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def main() -> None:
    code, given, results, steps = sys.argv[1:]
    problem = Problem(given)
    start = CODES[code](problem)
    run = start()
    for _ in range(WARM_UP):
        next(run)
    memory = peak_mib()
    run = start()
    seconds, processor, objectives, printed, scene = [], [], [], [], np.zeros(0)
    for _ in range(int(steps)):
        began, began_cpu = time.perf_counter(), time.process_time()
        look, own = next(run)
        seconds.append(time.perf_counter() - began)
        processor.append(time.process_time() - began_cpu)
        scene = look()
        objectives.append(problem.objective(scene))
        printed.append(own)
    seen = scene[:, *problem.window(scene.shape[1:])]
    np.savez(
        results,
        versions=", ".join(f"{package} {version(package)}" for package in PACKAGES[code.split()[0]]),
        objectives=objectives,
        printed=printed,
        peak_mib=memory,
        planes=seen,
        seconds=np.cumsum(seconds),
        processor_seconds=np.cumsum(processor),
    )


if __name__ == "__main__":
    main()
