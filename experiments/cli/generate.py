"""`hma generate`: recorded actions replayed in a learned simulator, written as a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from data_pipelines.errors import DataError, EpisodeError, without_advice
from data_pipelines.names import made_name
from experiments.running.workspace import Workspace
from experiments.study_setup import UNSET, command, require_local, use_entries
from experiments.terminal.progress import Eta, say, step, wrote
from experiments.terminal.words import counted
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
    recorded: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
    allow_clipping: Annotated[FlagCreatePairsOff[bool], arg(name="allow-clipping"), UNSET] = False,
    skip_damaged: Annotated[FlagCreatePairsOff[bool], arg(name="skip-damaged"), UNSET] = False,
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
        batch: Episodes generated at the same time. It affects the frames, through rounding.
        clips: Number of episodes that are also written as MP4, the recording on the left. With 0, PyAV is not needed.
        unmask_steps: Unmasking steps per frame; more are slower. Default: as in RUN/decode.json, or 2.
        temperature: Temperature at which tokens or latents are sampled; 0 takes the most likely ones. Default: as in
            RUN/decode.json, or 0.
        recorded: Also write the recordings of the same episodes in the same layout, as ROBOT_recorded or NAME_recorded,
            so that policies can be trained on both.
        allow_clipping: Replay actions even if most values of one of them lie outside the robot's range.
        skip_damaged: Leave out damaged episodes and count them, instead of stopping.
        tokenizer: Directory of the tokenizer that the model was trained with, if it is not beside RUN.
        registry: TOML file with your own registry entries, besides those of the study of RUN.
    """
    from data_pipelines.convert.write import convert
    from data_pipelines.sources.convertible import require_module
    from experiments.applications.generating.compare import compare
    from experiments.applications.generating.source import SHARD_BYTES, GeneratedSource, checkpoint_hash
    from experiments.applications.generating.survey import survey
    from experiments.applications.generating.trajectories import (
        describe_lacking,
        describe_reconstruction,
        describe_training,
        open_trajectories,
    )
    from experiments.simulators import DEAF, load_simulator
    from hma_jax.runtime.outputs import make_directory
    from hma_jax.simulator.folder import change_decode, find_decode

    require_local("--out", out)
    require(given >= 1, f"--given must be at least 1, got {given}")
    require(batch >= 1, f"--batch must be at least 1, got {batch}")
    require(episodes is None or episodes >= 1, f"--episodes must be at least 1, got {episodes}")
    require_seed(seed, "--seed")
    require(clips >= 0, f"--clips must not be negative, got {clips}")
    if clips:
        require_module("av", f"--clips {clips}")
    use_entries(registry, run)
    make_directory(out)
    decode = change_decode(find_decode(run), temperature, unmask_steps=unmask_steps)
    simulator = load_simulator(
        run, own_starts=True, tokenizer=tokenizer, execution=ExecutionConfig(remat="none"), episodes=batch,
        decode=decode, history=1,
    )  # fmt: skip
    if simulator.ignores_actions:
        say(f"note: {DEAF}")
    robots, stores = dict(simulator.robots), Workspace.of_run(run).store
    named = simulator.robot(robot) if robot else None
    found, driven = open_trajectories(
        actions, split, named, robots, simulator.tokenizer, stores, skip_damaged=skip_damaged
    )
    count = len(found) if episodes is None else min(episodes, len(found))
    for note in (describe_reconstruction(found), describe_lacking(found), describe_training(found, count, stores)):
        if note:
            say(note)
    mark = checkpoint_hash(run, simulator.model.step)
    called, eta = name or made_name(f"{driven.name}_generated"), Eta()
    twin = f"{name}_recorded" if name else made_name(f"{driven.name}_recorded")
    try:
        with step(f"read the actions of {counted(count, 'episode')}") as update:
            known = survey(found, count, driven, update)
        if not allow_clipping:
            known.require_raw_units()
        if note := known.note():
            say(note)
        source = GeneratedSource(
            simulator, driven, found, given=given, count=count, seed=seed, checkpoint=mark,
            knows_success=known.knows_success,
        )  # fmt: skip
        origin = {"clipped": known.shares(), "run": str(run)}
        with step(f"generate {counted(count, 'episode')} of {driven.name}") as update:
            done = convert(
                source, out, called, shard_bytes=SHARD_BYTES, origin=source.origin() | origin,
                progress=lambda n, total, unit: update(n, total, unit + eta(n, total)),
            )  # fmt: skip
        if recorded:
            with step(f"write the recordings as {twin}") as update:
                same = source.twin()
                beside = convert(same, out, twin, origin=same.origin() | origin, progress=update)
    except EpisodeError as error:
        raise DataError(f"{without_advice(str(error))} Add --skip-damaged to leave it out.") from error
    for reason, left in done.skipped.items():
        say(f"left out {left:,} x: {reason}")
    with step("compare with the recordings") as update:
        comparison = compare(done.directory, found, given, clips, source.hz, update)
    _print_comparison(comparison, done.episodes)
    written = [done.directory, done.directory.parent / "psnr.csv"]
    written += [done.directory.parent / "clips"] if clips else []
    written += [beside.directory] if recorded else []
    wrote(*written, then=command("data inspect", done.directory, "--entry", f"{called}.toml"))


def _print_comparison(comparison: Comparison, episodes: int) -> None:
    """PSNR of the generated frames and of a still picture, with intervals over episodes if there are several."""
    generated, still = comparison
    of_generated, of_still = " (one alone has no interval)", ""
    if episodes > 1:
        of_generated = f" ({generated.low:.2f} to {generated.high:.2f}, 95 % over episodes)"
        of_still = f" ({still.low:.2f} to {still.high:.2f})"
    say(
        f"{counted(episodes, 'episode')}. PSNR against the recording {generated.mean:.2f} dB{of_generated}; a still picture "
        f"{still.mean:.2f}{of_still}"
    )
