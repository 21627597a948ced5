"""`hma data sim` and `hma data sim-table`: robots simulated with published models, as RLDS directories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from experiments.study_setup import UNSET, command, command_words
from experiments.terminal.progress import console, say, step, wrote
from experiments.terminal.words import few

if TYPE_CHECKING:
    from data_pipelines.simulators import SimSpec

SimPreset = Literal["smoke", "full"]


@dataclass(frozen=True)
class Amount:
    """How much is simulated. `names` is None: all robots of the table."""

    names: tuple[str, ...] | None
    episodes: int
    size: int
    study: str  # preset of a study for which this amount is enough


PRESETS = {
    "smoke": Amount(
        (
            "pusht", "dmc_reacher", "pointmaze_ball", "metaworld_sawyer", "fetch", "ogbench_ur5e",
            "dmc_walker", "robosuite_panda_lift", "mujoco_ant", "franka_kitchen", "aloha", "adroit_door",
        ),
        episodes=4,
        size=64,
        study="smoke",
    ),
    "full": Amount(None, episodes=20, size=128, study="cpu"),
}  # fmt: skip

SHEET, SHEET_EPISODES = "contact.png", 4

REPORT = 10
"""Number of episodes between two lines of a log."""


def data_sim(
    out: Annotated[Path, arg(metavar="DIR")],
    preset: SimPreset = "smoke",
    names: Annotated[tuple[str, ...], arg(metavar="[NAME ...]"), UNSET] = (),
    episodes: Annotated[int | None, UNSET] = None,
    size: Annotated[int | None, UNSET] = None,
    workers: int = 2,
    seed: int = 0,
) -> None:
    """Simulate real robots' models (MuJoCo and others) and write them as RLDS directories.

    Needs the extra `sim`. Run the same command again after an interruption: only what is missing
    is made, and the bytes are the same. Existing datasets with another number of episodes, size or seed are refused.

    Args:
        out: Directory to write: one dataset per embodiment, each with a contact sheet.
        preset: smoke (12 embodiments, 4 episodes, 64 pixels: minutes) or full (all embodiments, 20
            episodes, 128 pixels: hours).
        names: Only these embodiments. Default: the preset's.
        episodes: Episodes per dataset. Default: the preset's.
        size: Side of the frames in pixels. Default: the preset's.
        workers: Simulators that run at the same time, each in a process with one core; no effect on the data.
        seed: Random seed; another one gives other episodes.
    """
    from data_pipelines.inspection.inspect import inspect_dataset
    from data_pipelines.simulators import generate_sim, select
    from data_pipelines.sources.rlds.writer import VERSION
    from experiments.cli.data.contact_sheet import write_sheet

    chosen = PRESETS[preset]
    specs = select(tuple(names) or chosen.names)
    episodes, size = chosen.episodes if episodes is None else episodes, chosen.size if size is None else size
    wanted = _to_simulate(out, specs, episodes, size, seed)
    with step(f"simulate {len(wanted)} robots") as update:

        def report(name: str, done: int, total: int) -> None:
            update(done, total, name)
            if done and not console.is_terminal and (done == total or done % REPORT == 0):
                console.print(f"{done} of {total} episodes, the last of {name}")

        if wanted:
            how = {"episodes": episodes, "size": size, "seed": seed}
            generate_sim(out, names=wanted, **how, workers=workers, progress=report)
    paths = [out / spec.name / VERSION for spec in specs]
    with step("draw contact sheets"):
        for path in paths:
            sample = inspect_dataset(str(path), episodes=SHEET_EPISODES, max_examples=SHEET_EPISODES)
            write_sheet(path.parent / SHEET, sample)
    everything = sorted(paths) == sorted(out.glob(f"*/{paths[0].name}"))  # then a pattern is shorter
    data = f"{command_words(out)}/*/{paths[0].name}" if everything else command_words(*paths)
    study = command("study", "--preset", chosen.study, "--out", "runs/sim")
    wrote(*paths, then=f"{study} --data {data}")
    say(f"or, to look at them first: {command('data view')} {data}")


def _to_simulate(out: Path, specs: Sequence[SimSpec], episodes: int, size: int, seed: int) -> list[str]:
    """The robots to simulate: all whose dataset does not exist yet. Prints which existing datasets were made by other
    versions of the packages.

    Raises ConfigError, before anything is made, if a dataset exists that was made with other settings or by another
    program.
    """
    from data_pipelines.simulators.generate import made_by_other_versions

    kept = made_by_other_versions(out, specs, episodes, size, seed)
    if kept:
        say(
            f"note: {few(kept)} in {out}: made by other versions of the simulators, and still used; remove them to make "
            "them again"
        )
    return [spec.name for spec in specs if spec.name not in kept]


def data_sim_table(directory: Annotated[Positional[Path], arg(metavar="DIR")]) -> None:
    """Print frames per second, episode lengths and success rates of `hma data sim`, as Markdown.

    Args:
        directory: The --out of `hma data sim`.
    """
    from data_pipelines.simulators.stats import stats_table

    print(stats_table(directory))
