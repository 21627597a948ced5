"""`hma coord-check`: do activations keep their size as the model widens?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from experiments.cli.arguments import StudyOptions
from experiments.study_setup import make_setup
from experiments.terminal.progress import console, say, step, tidy_table, wrote
from hma_jax.config import require

if TYPE_CHECKING:
    from hma_jax.diagnostics.coordinate_check import Size


def coord_check(
    arguments: StudyOptions,
    widths: Annotated[
        tuple[int, ...], arg(metavar="[D ...]", help_behavior_hint="(default: base width x 1, 2, 4, 8)")
    ] = (),
    steps: Annotated[int, arg(metavar="N")] = 10,
    seeds: Annotated[int, arg(metavar="N")] = 3,
    learning_rate: Annotated[
        float | None, arg(name="learning-rate", metavar="RATE", help_behavior_hint="(default: the study's)")
    ] = None,
) -> None:
    """Check that a model's activations keep their size as it widens: the coordinate check of muP.

    Models of several widths learn the same few random windows. The table says with which power of the width each
    activation, and its change in training, grows (both as root mean squares): with muP these powers are near 0; if they
    are not, a learning rate does not carry over from one width to another. Needs no data. Writes coord_check.csv and
    coord_check.png into --out. docs/models.md shows a result.

    Args:
        arguments: The study whose model and optimiser are checked.
        widths: Widths of the trunk.
        steps: Training steps.
        seeds: Number of random initialisations of each width.
        learning_rate: Learning rate at the base width. In a few steps a small one hides what is wrong.
    """
    require(steps >= 1, f"--steps must be at least 1, got {steps}")
    require(seeds >= 1, f"--seeds must be at least 1, got {seeds}")
    setup = make_setup(arguments)

    from experiments.bench.coord_check import choose_widths, measure_widths, write_sizes
    from experiments.report.plot_coords import plot_coords

    study, out = setup.study, setup.workspace.root
    rate = study.train.optimizer.learning_rate if learning_rate is None else learning_rate
    chosen = choose_widths(study.model, widths)
    with step(f"train {study.name} at widths {', '.join(map(str, chosen))}") as update:
        rows = measure_widths(study, chosen, steps, seeds, rate, update)
    _print_slopes(f"{study.name}, {'muP' if study.model.mup.enabled else 'without muP'}", rows)
    out.mkdir(parents=True, exist_ok=True)
    csv, figure = out / "coord_check.csv", out / "coord_check.png"
    write_sizes(csv, rows)
    plot_coords(rows, figure)
    wrote(csv, figure)


def _print_slopes(title: str, rows: list[Size]) -> None:
    from hma_jax.diagnostics.coordinate_check import check_coordinates, slopes

    table = tidy_table(f"{title}: powers of width", "activation", "size", "change")
    for quantity, slope in slopes(rows).items():
        table.add_row(quantity, f"{slope.size:+.2f}", f"{slope.change:+.2f}")
    console.print(table)
    findings = check_coordinates(rows)
    for finding in findings:
        say(finding)
    if any(" fades " in finding for finding in findings):
        say("what fades may not have outgrown the random start yet: try more --steps, or a larger --learning-rate")
    if not findings:
        say("passed: no activation grows with the width, and no change in training grows or fades")
