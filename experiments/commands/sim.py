"""What `hma data sim` does. Ends by saying what it wrote and what to run next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.commands.study import wrote
from experiments.progress import console, step
from experiments.setting import command, command_words


@dataclass(frozen=True)
class SimPreset:
    """How much is simulated. No names: all of the table."""

    names: tuple[str, ...] | None
    episodes: int
    size: int
    study: str  # the preset of a study for which that is enough


PRESETS = {
    "smoke": SimPreset(
        (
            "pusht", "dmc_reacher", "pointmaze_ball", "metaworld_sawyer", "fetch", "ogbench_ur5e",
            "dmc_walker", "robosuite_panda_lift", "mujoco_ant", "franka_kitchen", "aloha", "adroit_door",
        ),
        episodes=4,
        size=64,
        study="smoke",
    ),
    "full": SimPreset(None, episodes=20, size=128, study="cpu"),
}  # fmt: skip

SHEET = "overview.png"
SHEET_EPISODES = 4

REPORT = 10
"""Episodes from one line of a log to the next."""


def write_sim(
    out: Path,
    preset: str,
    names: Sequence[str],
    episodes: int | None,
    size: int | None,
    workers: int,
    seed: int,
) -> None:
    from data_pipelines.sim import generate_sim, select
    from data_pipelines.sim.sheet import draw_sheet

    chosen = PRESETS[preset]
    specs = select(tuple(names) or chosen.names)
    with step(f"simulate {len(specs)} robots") as update:

        def report(name: str, done: int, total: int) -> None:
            update(done, total, name)
            if done and not console.is_terminal and (done == total or done % REPORT == 0):
                console.print(f"{done} of {total} episodes, the last of {name}")

        paths = generate_sim(
            out,
            names=[spec.name for spec in specs],
            episodes=chosen.episodes if episodes is None else episodes,
            size=chosen.size if size is None else size,
            seed=seed,
            workers=workers,
            progress=report,
        )
    with step("draw contact sheets"):
        for path in paths:
            draw_sheet([path], path.parent / "contact.png", SHEET_EPISODES)
        draw_sheet(paths, out / SHEET)
    everything = sorted(paths) == sorted(out.glob(f"*/{paths[0].name}"))  # then a pattern says it shorter
    data = f"{command_words(out)}/*/{paths[0].name}" if everything else command_words(*paths)
    study = command("study", "--preset", chosen.study, "--out", "runs/sim")
    wrote(*paths, out / SHEET, then=f"{study} --data {data}")


def print_table(directory: Path) -> None:
    from data_pipelines.sim.stats import stats_table

    print(stats_table(directory))
