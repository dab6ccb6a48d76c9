"""Cost of an end-to-end gradient at full scale, relative to forward model and back-projection.

5120^2 pixels, 213 lenses, 13 depths of 555^2 voxels, a PSF of 65 x 65 pixels at each depth. The gradient is that of
the squared error after `forward` and `backproject`, with respect to every leaf of the imager. Both are timed in
interleaved rounds, so that the ratio holds on a loaded machine too; memory is XLA's plan beside the arguments.

    python -m experiments.full_gradient [--out DIR] [--rounds N]

writes `full_gradient.json`; about two minutes on two cores.
"""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.backprojection_speed import Inputs, Job, inputs, timed
from experiments.common import Report, main
from experiments.end_to_end import misfit_db
from experiments.forward_model import PSF_PIXELS
from gs_jax import backproject, forward
from gs_jax.base.machine import describe
from gs_jax.base.progress import Progress


def run(job: Job | None = None, rounds: int = 3, *, progress: Progress) -> dict:
    """Return the content of `full_gradient.json`; units are in the keys."""
    job = Job() if job is None else job
    s: Inputs = inputs(job)
    psf = jnp.full((job.depths, PSF_PIXELS, PSF_PIXELS), PSF_PIXELS**-2.0, jnp.float32)

    def value(imager, volume):
        return misfit_db(backproject(forward(volume, imager, s.grid, psf), imager, s.grid), volume)

    compiled, compile_s, mib = {}, {}, {}
    for name, function in {"value": value, "gradient": jax.grad(value)}.items():
        compile_s[name], compiled[name] = timed(lambda f=function: jax.jit(f).lower(s.imager, s.volume).compile())
        memory = compiled[name].memory_analysis()
        mib[name] = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20
    seconds: dict[str, list[float]] = {name: [] for name in compiled}
    for number in progress.track(range(rounds + 1), "Timing"):
        for name, call in compiled.items():
            taken, _ = timed(lambda call=call: jax.block_until_ready(call(s.imager, s.volume)))
            if number:  # the first is warm-up
                seconds[name].append(taken)
    return {
        "machine": describe(),
        "job": job._asdict(),
        "seconds": seconds,
        "ratio": float(np.median(np.divide(seconds["gradient"], seconds["value"]))),
        "compile_seconds": compile_s,
        "mib": mib,
    }


def report(rounds: int, progress: Progress) -> Report:
    results = run(rounds=rounds, progress=progress)
    return Report({"full_gradient.json": results}, [str({key: results[key] for key in ("seconds", "ratio", "mib")})])


if __name__ == "__main__":
    main(report, {"--rounds": {"type": int, "default": 3}})
