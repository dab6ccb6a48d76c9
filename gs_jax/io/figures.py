"""Pictures on disk."""

import os

from matplotlib.figure import Figure

from .disk import atomic_write, check_output


def write_figure(path: str | os.PathLike[str], figure: Figure) -> None:
    """Writes a figure as PNG at its own resolution, whole or not at all; `InputError` as `check_output`."""
    with atomic_write(check_output(path, [".png"])) as temporary:
        figure.savefig(temporary, format="png")
