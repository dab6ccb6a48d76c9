"""Recordings whose frames start from the volume of the one before, beside frames that start afresh.

Letters and beads of `design_judge.py` move along x by 0, 40 or 120 um from frame to frame: by no, one or three voxels.
They are ray-traced through the lenses of `geomscope` onto the middle of its sensor, with the noise of 3,000 electrons
in the brightest pixel of the first frame. Columns: PSNR of the third frame above an empty volume, its steps, and
frames a second after the first one, without disk, medians.

    python -m experiments.warm_start [--design geomscope] [--out DIR]

Writes `warm_start.md`; about five minutes on two cores.
"""

import time
from contextlib import contextmanager

import numpy as np

from experiments.common import Report, design_file, main, table
from experiments.design_judge import READ_NOISE, Settings, device, image_of, scene
from gs_jax import Imager, quality, rasterize, read_design
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import METHODS, Reconstructor
from gs_jax.reconstruction.plan import follow_volume

MOVES, ELECTRONS, FRAMES = (0.0, 0.04, 0.12), 3000, 3
FOLLOWED = ("list-rl", "richardson-lucy")
COLUMNS = ("scene", "moves, um", "method", "start", "dB above empty", "steps", "frames/s")


class Counted(Progress):
    """Counts the steps of iterations."""

    steps = 0

    @contextmanager
    def counter(self, description, total, **_):
        self.steps = 1

        def advance():
            # The step that ends an iteration early is not told.
            self.steps = min(self.steps + 1, total)

        yield advance


def recording(kind: str, move: float, imager: Imager, settings: Settings) -> list[tuple[np.ndarray, np.ndarray]]:
    """Noisy images of a scene that moves, and its volumes."""
    frames, brightest = [], 0.0
    for number in range(FRAMES):
        one = scene(kind, 0, settings)
        emitters = one.emitters + [number * move, 0, 0, 0]
        clean = image_of(one._replace(emitters=emitters), imager, settings)
        brightest = brightest or clean.max()
        rng = np.random.default_rng(number)
        image = rng.poisson(clean * (ELECTRONS / brightest)) + rng.normal(0, READ_NOISE, clean.shape)
        frames.append((image.astype(np.float32), np.asarray(rasterize(emitters, settings.grid), np.float32)))
    return frames


def measured(
    reconstructor: Reconstructor, frames: list[tuple[np.ndarray, np.ndarray]], *, follow: bool
) -> tuple[float, int, float]:
    """PSNR above an empty volume and steps of the last frame, and frames a second."""
    seconds, counted, volume, last = [], Counted(), np.zeros(0), None
    for image, _ in frames:
        began = time.perf_counter()
        if follow:
            volume, last = follow_volume(reconstructor, image, last, counted)
        else:
            volume = reconstructor(image, counted)
        seconds.append(time.perf_counter() - began)
    truth = frames[-1][1]
    empty = quality(np.zeros_like(truth), truth).psnr_db
    return quality(volume, truth).psnr_db - empty, counted.steps, 1 / float(np.median(seconds[1:]))


def report(design: str, progress: Progress) -> Report:
    settings = Settings()
    imager = device(read_design(design_file(design)).imager(), settings)
    afresh = {
        name: Reconstructor(imager, settings.grid, METHODS[name](20)) for name in ("backproject", *FOLLOWED, "unrolled")
    }
    rows, cases = [], [(kind, move) for kind in ("letters", "beads") for move in MOVES]
    for kind, move in progress.track(cases, "Moving scenes"):
        frames = recording(kind, move, imager, settings)
        for name, alone in afresh.items():
            for start in ("afresh", "warm") if name in FOLLOWED else ("afresh",):
                gain, steps, rate = measured(alone, frames, follow=start == "warm")
                count = "" if name == "backproject" else str(steps)
                rows.append([kind, f"{1000 * move:.0f}", name, start, f"{gain:.1f}", count, f"{rate:.2g}"])
    return Report({"warm_start.md": markdown_table(COLUMNS, rows)}, [table(COLUMNS, rows)])


if __name__ == "__main__":
    main(report, {"--design": {"default": "geomscope"}})
