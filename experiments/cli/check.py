"""`hma check`: does a model listen to its actions?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from experiments.running.workspace import Workspace
from experiments.study_setup import UNSET, require_local
from experiments.terminal.progress import console, say, step, tidy_table
from experiments.terminal.words import plus_minus
from hma_jax.config import require


def check(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: the directory that RUN is in)")
    ] = None,
    robots: Annotated[tuple[str, ...], arg(metavar="[NAME ...]"), UNSET] = (),
    windows: int = 64,
) -> None:
    """Find action dimensions that a model ignores, or uses with the wrong sign, scale or position.

    Held-out windows are evaluated with the recorded actions, and again with one action dimension held constant,
    negated, scaled or swapped with another. The table says how much each dimension is worth: by how much
    the loss rises when it is held constant, in nats per token (of a model on latents: in units of its diffusion loss).
    Robots with too few held-out episodes are left out and listed. Writes RUN/check.json.

    Args:
        run: Directory of a training run.
        out: Directory of a study with tokens and windows of the robots: of your own recordings, or of those that the
            model was trained on.
        robots: Check only these robots. Default: all that have windows in --out.
        windows: Windows per robot.
    """
    from experiments.applications.check import check_run, choose_robots, open_study, verdict, write_effects
    from experiments.cli.evaluate import check_fits, note_possible_leakage
    from hma_jax.simulator.folder import find_robots
    from hma_jax.training.runs import load_model, require_frames

    require_local("--out", out)
    require(windows >= 2, f"--windows must be at least 2, got {windows}")
    workspace = Workspace(out) if out else Workspace.of_run(run)
    with step(f"check {run}"):
        model = load_model(run)
        require_frames(model.run, "judge")
        prepared = open_study(workspace)
        check_fits(model.run, prepared)
        chosen, left_out = choose_robots(run, model, prepared, robots, windows, workspace.root)
        for why in left_out.values():
            say(f"not checked: {why}")
        note_possible_leakage(model.run, chosen, prepared.store)
        found = check_run(run, model, prepared, chosen, windows)
    names = {robot.name: robot.dimensions for robot in find_robots(run, model.table)}
    for robot, effects in found.items():
        table = tidy_table(robot, "dimension", "worth", "verdict")
        for effect in effects:
            worth = plus_minus(effect.worth.mean, effect.worth.sem)
            table.add_row(names[robot][effect.dimension], worth, verdict(effect, names[robot]))
        console.print(table)
    write_effects(run / "check.json", found, names)
    if left_out:
        say(f"not checked, too few held-out episodes: {', '.join(left_out)}; the messages above say what to do")
    say(f"wrote {run / 'check.json'}")
