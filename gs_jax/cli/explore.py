"""`gs-jax explore`: a design that sliders move."""

from pathlib import Path

import click

from ..base.progress import Progress
from ..io.files import check_output
from .files import provenance_of
from .options import DESIGN


@click.command("explore", epilog="Example: gs-jax explore geomscope --study targets.toml -o mine.toml")
@click.argument("design", type=DESIGN)
@click.option("--study", type=Path, help="STUDY.toml, whose targets are judged, as in `gs-jax optimize`.")
@click.option(
    "-o",
    "--output",
    type=Path,
    help="NEW.toml to save to; a number is added where it is there.  [default: NAME-new.toml]",
)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of the page.  [default: one that is free]")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page.")
def command(design: Path, study: Path | None, output: Path | None, port: int, browser: bool):
    """Move sensor distance, curvature, aperture, pitch, depths and field of DESIGN in a browser, and see what it does.

    The page shows what violates a target, in words; spots, the layout with ghosts, the datasheet, a small simulated
    reconstruction; keeps designs to compare with, and saves them. It is on this machine alone: nobody else can open it.
    Ctrl-C ends it.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.
    """
    import webbrowser

    from ..apps.explore.server import Server
    from ..apps.explore.session import Session
    from ..codesign.study import read_study
    from ..design.design import read_design

    saves = output or Path(f"{design.stem}-new.toml")
    check_output(saves, [".toml"])
    microscope, targets = read_design(design), read_study(study) if study else None
    with Progress() as progress:
        with progress.step("Compiling"):
            session = Session(microscope, targets, saves, provenance_of(design, study))
            session.move({})
    with Server(session, port) as server:
        click.echo(f"{server.url} shows {microscope.name}; Ctrl-C ends it")
        if browser:
            webbrowser.open_new_tab(server.url)
        server.serve_forever()
