"""`hma generate`: recorded actions replayed in a learned simulator, written as a dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from experiments.study_setup import UNSET, command, require_local, use_entries
from experiments.terminal.progress import Eta, console, say, step, wrote
from hma_jax.config import ExecutionConfig, require
from hma_jax.config.base import require_seed

if TYPE_CHECKING:
    from experiments.applications.generating.compare import Comparison


def generate(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    actions: Annotated[str, arg(metavar="DATASET")],
    out: Annotated[Path, arg(metavar="DIR")],
    split: str = "train",
    episodes: Annotated[int | None, arg(metavar="N"), UNSET] = None,
    robot: Annotated[str | None, UNSET] = None,
    name: Annotated[str | None, UNSET] = None,
    given: int = 3,
    seed: int = 0,
    batch: int = 8,
    clips: int = 4,
    unmask_steps: Annotated[int | None, arg(name="unmask-steps", metavar="M"), UNSET] = None,
    temperature: Annotated[float | None, UNSET] = None,
    tokenizer: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Replay recorded actions in a trained model, and write the generated video as an RLDS dataset.

    Every episode begins with the first frames of its recording; the model generates all others. Prints PSNR against
    the recording. Run the same command again after an interruption: it continues, and the result has the same bytes.

    Args:
        run: Directory of a training run.
        actions: Dataset with the recorded episodes: its directory (RLDS, LeRobot, robomimic), a directory of a token
            store, or the name of a dataset in the token store beside RUN.
        out: Directory for the output: the dataset NAME/1.0.0, and beside it psnr.csv and clips.
        split: Split of the dataset.
        episodes: Replay only the first N episodes.
        robot: Robot of the model that replays the actions. Default: the one that has the dataset's name.
        name: Name of the new dataset. Default: ROBOT_generated.
        given: Number of recorded frames that each episode begins with.
        seed: Random seed; another one gives other samples of the same episodes.
        batch: Episodes generated at the same time. By rounding, it has an effect on the frames.
        clips: Number of episodes that are also written as MP4, the recording on the left. With 0, PyAV is not needed.
        unmask_steps: Unmasking steps per frame. Default: as in RUN/decode.json.
        temperature: Temperature at which tokens are sampled. Default: as in RUN/decode.json.
        tokenizer: Directory of the tokenizer that the model was trained with, if it is not beside RUN.
        registry: TOML file with your own registry entries.
    """
    from data_pipelines.convert.write import convert
    from data_pipelines.names import made_name
    from data_pipelines.sources.convertible import require_module
    from experiments.applications.generating.compare import compare
    from experiments.applications.generating.source import SHARD_BYTES, GeneratedSource, checkpoint_hash
    from experiments.applications.generating.trajectories import (
        describe_reconstruction,
        describe_training,
        open_trajectories,
    )
    from experiments.applications.simulators import DEAF, load_simulator
    from experiments.running.workspace import Workspace
    from hma_jax.simulator.folder import find_decode

    require_local("--out", out)
    require(given >= 1, f"--given must be at least 1, got {given}")
    require(batch >= 1, f"--batch must be at least 1, got {batch}")
    require(episodes is None or episodes >= 1, f"--episodes must be at least 1, got {episodes}")
    require_seed(seed, "--seed")
    require(clips >= 0, f"--clips must not be negative, got {clips}")
    if clips:
        require_module("av", f"--clips {clips}")
    use_entries(registry)
    given_decode = {"unmask_steps": unmask_steps, "temperature": temperature}
    decode = replace(find_decode(run), **{key: x for key, x in given_decode.items() if x is not None})
    simulator = load_simulator(
        run, own_starts=True, tokenizer=tokenizer, execution=ExecutionConfig(remat="none"), episodes=batch,
        decode=decode, history=1,
    )  # fmt: skip
    if simulator.ignores_actions:
        say(f"note: {DEAF}")
    robots, stores = dict(simulator.robots), Workspace.of_run(run).store
    named = simulator.robot(robot) if robot else None
    recorded, driven = open_trajectories(actions, split, named, robots, simulator.tokenizer, stores)
    if note := describe_reconstruction(recorded):
        say(note)
    count = len(recorded) if episodes is None else min(episodes, len(recorded))
    if note := describe_training(recorded, count, stores):
        say(note)
    mark = checkpoint_hash(run, simulator.model.step)
    source = GeneratedSource(simulator, driven, recorded, given=given, count=count, seed=seed, checkpoint=mark)
    called, eta = name or made_name(f"{driven.name}_generated"), Eta()
    with step(f"generate {count} episodes of {driven.name}") as update:
        done = convert(
            source, out, called, shard_bytes=SHARD_BYTES, origin=source.origin() | {"run": str(run)},
            progress=lambda n, total, unit: update(n, total, unit + eta(n, total)),
        )  # fmt: skip
    for reason, left in done.skipped.items():
        say(f"left out {left:,} x: {reason}")
    with step("compare with the recordings") as update:
        comparison = compare(done.directory, recorded, given, clips, source.hz, update)
    _print_comparison(comparison, done.episodes)
    written = [done.directory, done.directory.parent / "psnr.csv"]
    written += [done.directory.parent / "clips"] if clips else []
    wrote(*written, then=command("data inspect", done.directory, "--entry", f"{called}.toml"))


def _print_comparison(comparison: Comparison, episodes: int) -> None:
    """PSNR of the generated frames and of a still picture, with intervals over episodes if there are several."""
    generated, still = comparison
    counted, of_generated, of_still = "1 episode", " (one alone has no interval)", ""
    if episodes > 1:
        counted = f"{episodes:,} episodes"
        of_generated = f" ({generated.low:.2f} to {generated.high:.2f}, 95 % over episodes)"
        of_still = f" ({still.low:.2f} to {still.high:.2f})"
    console.print(
        f"{counted}. PSNR against the recording {generated.mean:.2f} dB{of_generated}; a still picture "
        f"{still.mean:.2f}{of_still}",
        soft_wrap=True,
    )
