"""`gs-jax reconstruct` for several channels of a capture: one image with a volume of each."""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from ..base.errors import InputError, input_error
from ..base.progress import Progress
from .commands import given_options, print_warning, provenance_of
from .options import CaptureOptions, DepthLight, find_channel, voxels
from .recordings import examine

# Options that must not be given with several channels.
_ONE_CHANNEL = (
    "points",
    "surface",
    "score",
    "deviation",
    "tiles",
    "watch",
    "frame_interval",
    "track",
    "warm_start",
    "resume",
)
_ONE_CHANNEL += ("workers", "scheduler", "wavelength_nm", "bayer")


def reconstruct_channels(
    capture: Path,
    microscope,
    names: list[str],
    depths: list[float],
    voxel_um: float | None,
    options,
    output: Path,
    light: DepthLight,
    camera: CaptureOptions,
) -> None:
    """Reconstruct several channels of a capture, each at its wavelength, on the grid of the first, as one image.

    `options` are `MethodOptions`.
    """
    from ..io.provenance import DepthFrame
    from ..io.recordings import open_recording
    from ..io.volumes import write_channels
    from ..reconstruction.plan import Plan

    if given := given_options(_ONE_CHANNEL):
        raise InputError(f"{given[0]} must be used with one --channel, got {camera.channel}.")
    names = [find_channel(microscope, name) for name in names]
    if len(set(names)) < len(names):
        raise input_error("--channel", "different names", camera.channel)
    if missing := [name for name in names if name not in microscope.channels]:
        allowed = "in the design, with a wavelength_nm, for --channel of several"
        raise input_error(f"`channels.{missing[0]}`", allowed, ", ".join(microscope.channels) or "none")
    cameras = [replace(camera, channel=name) for name in names]
    plans, volumes, images, noted, lines = [], {}, [], {}, []
    with Progress() as progress:
        wavelengths = [microscope.channels[name].wavelength_nm for name in names]
        lights = [replace(light, wavelength_nm=wavelength) for wavelength in wavelengths]
        imagers = [one.imager(each.imager(microscope)) for one, each in zip(cameras, lights, strict=True)]
        frame, from_array = DepthFrame(light.origin(imagers[0])), light.from_array(depths, imagers[0])
        for one in cameras:
            with open_recording(capture, page=camera.page, channel=one.channel) as frames:
                if frames and len(frames.names) != 1:
                    got = f"{len(frames.names)} frames"
                    raise InputError(f"{capture}: must be one image for --channel of several, got {got}.")
                # A Zarr store is a recording, though of one frame.
                images.append(one.read_frame(capture, frames) if frames else one.read(capture))
        for name, imager, image in zip(names, imagers, images, strict=True):
            plan = Plan.from_options(imager, from_array, voxel_um and voxel_um / 1000, **vars(options))
            plans.append(replace(plan, grid=plans[0].grid) if plans else plan)
            result = plans[-1].prepare(progress)(image, progress)
            volumes[name] = np.asarray(result.volume)
            note, more = examine(plans[-1], result, image, progress)
            noted |= {f"{key} of {name}": text for key, text in note.items()}
            lines += [f"{name}: {line}" for line in more]
            if result.warning:
                print_warning(f"{name}: {result.warning}")
        plan = plans[0]
        with progress.step("Writing"):
            provenance = provenance_of(capture, options.weights, *camera.files, design=microscope)
            provenance = cameras[0].recorded(provenance) | noted
            provenance |= frame.note if plan.imager.sample is not None else {}
            write_channels(output, volumes, wavelengths, frame.grid(plan.grid), provenance)
    for one in cameras:
        one.print_corrections()
    shape = (len(names), *plan.grid.volume_shape)
    click.echo(f"{output}: {voxels(shape, 'c, z, y, x', plan.grid.pitch, depths, plan.imager)}")
    click.echo(f"{output}: {', '.join(f'{n} at {w:g} nm' for n, w in zip(names, wavelengths, strict=True))}")
    for line in lines:
        click.echo(f"{output}: {line}")
