"""The arguments of a study, the study that follows from them, and the commands that give the same study again.

Printed commands are made from every field of `StudyArguments`, so nothing that the user gave is lost from one command
to the next. Options that hold for one command only (--workers, --replace) are not part of them.
"""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction, arg

from data_pipelines.registry import all_specs, find_spec, register
from data_pipelines.registry.mixtures import get_mixture
from experiments.data_size import are_counted, sizes_by_tokens, use_sizes
from experiments.presets import get_preset
from experiments.running.run_options import UNSET
from experiments.running.workspace import Workspace, find_record, use_own_entries
from experiments.study import Study, most_trajectories, on_tokenizer, on_user_data, without_equal_caps
from experiments.terminal.program import PROGRAM
from experiments.terminal.progress import say, short
from experiments.terminal.words import few
from experiments.user_input.override import override
from hma_jax.config import ConfigError, ModelConfig
from hma_jax.training.run_lock import is_address

Preset = Literal[
    "smoke",
    "cpu",
    "cpu-full",
    "accelerator",
    "paper",
    "smoke-continuous",
    "cpu-continuous",
    "cpu-full-continuous",
    "play",
    "play-gpu",
]


@dataclass(frozen=True)
class StudyArguments:
    """Which study, on which data, in which directory, on which devices."""

    preset: Preset = "cpu"
    """Named study: smoke (seconds), cpu (minutes), cpu-full (17 hours), accelerator (one GPU), paper (as published).
    With -continuous: tokens are latents instead of ids. play-gpu: the model of `make play`; play: a smaller one."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: runs/PRESET)")] = None
    """Directory for all output."""
    data: Annotated[tuple[str, ...], arg(metavar="[DIR ...]", help_behavior_hint="(default: the simulated suite)")] = ()
    """Your datasets: RLDS directories (paths, or URLs such as gs://...), LeRobot folders, robomimic files.
    Their names must be in the registry."""
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None
    """TOML file with your own registry entries, as `hma data inspect --entry` writes it."""
    mixture: Annotated[str | None, arg(metavar="NAME"), UNSET] = None
    """Named list of datasets, such as dataset10; --data then takes the directories that contain them."""
    tokenizer: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None
    """Directory of a tokenizer to use, instead of training one on the data.
    It sets the model's number and kind of tokens."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="PATH=VALUE")] = ()
    """Change one setting, such as --set model.frames=4 --set train.steps=100.
    --set help lists all settings, --set model.help those of a group."""
    mesh: Annotated[tuple[int, int, int] | None, arg(metavar="DATA FSDP TENSOR"), UNSET] = None
    """Number of devices for data, fsdp and tensor parallelism; -1 takes all that are left. Presets have -1 1 1.
    Short for --set execution.mesh.data=... and so on. Does not change results."""

    def anywhere(self) -> StudyArguments:
        """The same with absolute paths. Raises ConfigError for an `out` or a `tokenizer` at a URL."""
        from data_pipelines.sources.rlds.location import absolute

        require_local("--out", self.out)
        require_local("--tokenizer", self.tokenizer)

        def whole(path: Path | None) -> Path | None:
            return path and path.absolute()

        return replace(
            self,
            out=(self.out or Path("runs") / self.preset).absolute(),
            data=tuple(map(absolute, self.data)),
            registry=whole(self.registry),
            tokenizer=whole(self.tokenizer),
        )

    def chosen(self) -> tuple[str, ...]:
        """The settings that --set changes, each once."""
        return tuple(dict.fromkeys(one.partition("=")[0].strip() for one in self.set))

    def words(self) -> list[str]:
        """These arguments as words of a command line."""
        words = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value == field.default and field.name != "preset":
                continue
            flag = f"--{field.name}"
            if field.name == "set":
                words += [word for one in value for word in (flag, one)]
            else:
                words += [flag, *map(_word, value if isinstance(value, tuple) else (value,))]
        return words


@dataclass(frozen=True)
class StudySetup:
    """A study, its data and where it lives: what every command works on."""

    arguments: StudyArguments
    study: Study
    data: tuple[str, ...]  # directories of datasets; () for the suite
    workspace: Workspace
    asked_counts: tuple[int, ...]  # trajectory_counts as asked for; those of `study` may be fewer

    @property
    def tokenizer(self) -> Path | None:
        """A tokenizer to use; None: one is trained on the data."""
        return self.arguments.tokenizer

    def command(self, name: str, *arguments: str | Path) -> str:
        """The command line `hma NAME ARGUMENTS` for the same study, data, directory and devices."""
        return command(name, *arguments, *self.arguments.words())


def require_local(flag: str, path: Path | None) -> None:
    """Raises ConfigError for a URL: only datasets are read from one, and nothing is written to one."""
    if path is not None and is_address(path):
        raise ConfigError(
            f"{flag} {path}: results cannot be written to a bucket, only to a directory of a file system; mount the "
            "bucket, or use a disk that all hosts share and copy the finished results"
        )


def command(name: str, *arguments: str | Path) -> str:
    """The command line `hma NAME ARGUMENTS`, quoted for a shell."""
    return f"{PROGRAM} {name} {command_words(*arguments)}".strip()


def command_words(*arguments: str | Path) -> str:
    """Arguments as written in a shell, with paths as short as possible here."""
    return shlex.join(map(_word, arguments))


def make_setup(where: StudyArguments, model: ModelConfig | None = None) -> StudySetup:
    """The preset, on the user's data and tokenizer if given, with overrides. Writes nothing. Numbers of trajectories
    that would give the same training data are left out, except points of a study that is in the directory. Prints where
    the data's files have numbers of episodes other than the registry's.

    `model`: that of a trained run, in place of the preset's. Raises ConfigError, and DataError for directories that are
    not datasets.
    """
    arguments = where.anywhere()
    study, data, workspace = get_preset(arguments.preset), arguments.data, Workspace(arguments.out)
    if in_the_way := [str(place) for place in (workspace.root, *workspace.root.parents) if os.path.isfile(place)]:
        raise ConfigError(
            f"cannot write to {workspace.root}: {in_the_way[0]} is a file; choose another --out, in a directory where you "
            "may write"
        )
    use_entries(arguments.registry)
    datasets: dict[str, dict[str, str]] = {}
    if arguments.mixture is not None:
        names = get_mixture(arguments.mixture)
        study = on_user_data(study, names)
        data = find_directories(names, data) if data else ()
    elif data:
        from experiments.preparing.sources import group_by_dataset

        datasets = group_by_dataset(data)
        study = on_user_data(study, tuple(datasets))
    if arguments.tokenizer is not None:
        from hma_jax.tokenizers.io import load_config

        study = on_tokenizer(study, load_config(arguments.tokenizer))
    study = override(study, arguments.set, model)
    use_sizes({})
    if data:
        from experiments.preparing.sizes import find_sizes, group_readable
        from experiments.preparing.sources import require_entries

        require_entries(study.all_names(), datasets)
        use_sizes(find_sizes(datasets or group_readable(data), study.store.held_out, workspace))
    asked = study.trajectory_counts
    if data or arguments.mixture:
        study = _without_equal_caps(study, arguments, workspace)
    say_unmatched(arguments.registry, study.all_names())
    if arguments.mesh is not None:
        sizes = dict(zip(("data", "fsdp", "tensor"), arguments.mesh, strict=True))
        mesh = replace(study.execution.mesh, **sizes)
        study = replace(study, execution=replace(study.execution, mesh=mesh))
    return StudySetup(arguments, study, data, workspace, asked)


def count_again(setup: StudySetup) -> StudySetup:
    """The same on the user's data, once its tokens are made: they say how many trajectories have windows."""
    use_sizes(sizes_by_tokens(setup.workspace.data_summary))
    asked = replace(setup.study, trajectory_counts=setup.asked_counts)
    return replace(setup, study=_without_equal_caps(asked, setup.arguments, setup.workspace))


def _without_equal_caps(study: Study, arguments: StudyArguments, workspace: Workspace) -> Study:
    """The same study without the numbers of trajectories that would give the same training data. Numbers that the user
    chose are left out only if the data, not the registry, say so. The numbers of the study in `workspace` are kept if
    they differ only in numbers that leave out no trajectory, or if they follow from the registry: its finished trials
    are then not run again under another number, and a study that an earlier version planned can continue."""
    chosen, counted = "trajectory_counts" in arguments.chosen(), are_counted(study.dataset_names())
    if chosen and not counted:
        return study
    planned = without_equal_caps(study)
    try:
        earlier = find_record(workspace)
    except ConfigError:  # the code that continues it reports this
        return planned
    if earlier is None:
        return planned
    before = replace(study, trajectory_counts=earlier.study.trajectory_counts)
    if not chosen and before == without_equal_caps(study, by_entries=True):
        return before
    same, caps, most = without_equal_caps(before), planned.trajectory_counts, most_trajectories(study)
    *_, last = same.trajectory_counts
    if counted and most and min(last, caps[-1]) >= most:
        planned = replace(planned, trajectory_counts=(*caps[:-1], last))
    return before if planned == same else planned


def use_entries(registry: Path | None, run: Path | None = None) -> None:
    """Adds the user's own entries to the registry, for the rest of this process: those that the study of `run` was
    planned with, if it has any, and those of a TOML file, which replace others of the same name."""
    if run is not None:
        use_own_entries(Workspace.of_run(run))
    if registry is not None:
        from data_pipelines.registry.toml_file import load_entries

        register(load_entries(registry))


def say_unmatched(registry: Path | None, names: Sequence[str]) -> None:
    """If the user's file has entries that nothing uses, prints which of the datasets `names` (as their files call them)
    are read by the project's own entries: a name in the user's file may be misspelt."""
    if registry is None:
        return
    from data_pipelines.registry.toml_file import load_entries

    joining = {part: spec.name for spec in all_specs() for part in spec.joins}
    names = [joining.get(name, name) for name in names]
    given = [entry.name for entry in load_entries(registry)]
    unused, own = [n for n in given if n not in names], [n for n in names if n not in given and find_spec(n)]
    if unused and own:
        say(
            f"note: {short(registry)} has no entry called {few(own)}: the project's own is used. "
            f"Its entries that nothing here uses: {few(unused)}. {under_another_name(own)}"
        )


def under_another_name(names: Sequence[str]) -> str:
    """Advice for datasets that their files call `names`, if a robot of another name may be the same one."""
    joins = json.dumps(list(names[:1]))
    return f"If {names[0]} is one of these robots, add joins = {joins} to its entry in the file of --registry"


def find_directories(names: Sequence[str], roots: Sequence[str]) -> tuple[str, ...]:
    """`<root>/<name>` for every name, or for those that its entry joins, in the first root that has it. Raises
    ConfigError, with the names, if some are in none."""
    from data_pipelines.sources.rlds.location import locate

    entries = {name: find_spec(name) for name in names}
    names = [one for name, entry in entries.items() for one in (entry and entry.joins) or (name,)]
    found = {n: locate(r) / n for r in reversed(roots) for n in names if (locate(r) / n).is_dir()}
    missing = [n for n in names if n not in found]
    if missing:
        raise ConfigError(
            f"no directory for {', '.join(missing)} in {', '.join(roots)}; with --mixture, give in --data the "
            "directories that contain <name>/<version>"
        )
    return tuple(str(found[n]) for n in names)


def _word(value: Any) -> str:
    if not isinstance(value, Path):
        return str(value)
    text = short(value)
    return f"./{text}" if text.startswith("-") else text  # otherwise it would be read as an option
