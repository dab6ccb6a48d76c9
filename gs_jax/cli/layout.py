"""`gs-jax layout`: random lens centres."""

from pathlib import Path

import click

from ..io.files import check_output
from .files import check_may_write, force_option, provenance_of
from .options import MM


@click.command("layout", epilog="Example: gs-jax layout --count 200 --size-mm 20 20 --pitch-mm 1.23 -o centers.csv")
@click.option("--count", type=click.IntRange(1, 100_000), required=True, help="Number of lenses.")
@click.option("--size-mm", type=MM, nargs=2, required=True, help="Size of the plate, X Y.")
@click.option("--pitch-mm", type=MM, required=True, help="Mean distance of a lens from its nearest neighbour.")
@click.option("--diameter-mm", type=MM, default=2.0, show_default=True, help="Of the lenses; they leave no hole.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("-o", "--output", type=Path, required=True, help="CENTERS.csv, with the header x_mm,y_mm.")
@force_option
def command(
    count: int, size_mm: tuple[float, float], pitch_mm: float, diameter_mm: float, seed: int, output: Path, force: bool
):
    """Make a random layout of lenses, for the key `centers_file` of a design."""
    from ..design.centers import write_centers
    from ..layouts.cells import coverage, nearest_neighbour_distances
    from ..layouts.patterns import random_layout

    check_output(output, [".csv"])
    check_may_write(output, inputs=(), force=force)
    centers = random_layout(count, size_mm, pitch=pitch_mm, diameter=diameter_mm, seed=seed)
    write_centers(output, centers, provenance_of())
    distances = nearest_neighbour_distances(centers)
    covered = coverage(centers, size_mm, diameter=diameter_mm)
    spread = f"pitch {distances.mean():.3f} mm, SD {distances.std():.3f} mm, " if count > 1 else ""
    click.echo(f"{output}: {count} lenses, {spread}{100 * covered:.1f} % of the plate covered")
