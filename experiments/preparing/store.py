"""The token store of a study: every dataset's episodes as tokens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from data_pipelines.errors import DataError, UnreachableError
from data_pipelines.registry import get_spec
from experiments.preparing.made_from import Step, may_replace, require_same
from experiments.preparing.sources import (
    Source,
    group_by_dataset,
    open_source,
    say_unreached_rates,
    source_of,
)
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.terminal.progress import Eta, say, step
from experiments.terminal.words import counted, few
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer


def make_store(
    study: Study,
    workspace: Workspace,
    sources: Sequence[Source],
    *,
    tokenizer: Path | None = None,
    batch: int | None = None,
    threads: int | None = None,
    replace: Step | None = None,
) -> None:
    """Makes the tokens of every source; those made in the same way are kept. Any number of processes may do this at the
    same time.

    Raises ConfigError, before anything is done, if other tokens are in the place of some, unless `replace` allows it.
    When it returns, every dataset is complete: at the end it waits for parts that other processes are making.
    `tokenizer`: a directory, if it is not the workspace's. `batch` and `threads` as in `tokenize_dataset`.
    """
    from data_pipelines.tokens.tokenize_job import tokenize_dataset
    from hma_jax.tokenizers.io import load_tokenizer

    made_with, s = load_tokenizer(tokenizer or workspace.tokenizer), study.store
    require_same("tokens", workspace.store, _differences(study, workspace, sources, made_with), replace)
    say_other_rates(study, sources)
    say_unreached_rates(study, sources)
    how = {k: v for k, v in (("batch", batch), ("threads", threads)) if v is not None}
    workspace.store.mkdir(parents=True, exist_ok=True)

    def make(i: int, wait: bool) -> bool:
        (spec, path), eta = sources[i], Eta()
        note = f"{spec.name} ({i + 1} of {len(sources)}{', the rest is made by other processes' if wait else ''})"
        manifest = tokenize_dataset(
            spec, path, made_with, workspace.store, held_out=s.held_out, frame_step=s.frame_step, rate=study.rate,
            corrupt=s.corrupt, max_skipped=s.max_skipped, **how,
            overwrite=may_replace("tokens", replace), wait=wait,
            progress=lambda done, total: update(done, total, f"{note}{eta(done, total)}"),
            warn=lambda text: say(f"warning: {text}"),
        )  # fmt: skip
        return manifest is not None

    with step(f"tokenise {counted(len(sources), 'dataset')}") as update:
        for i in [i for i in range(len(sources)) if not make(i, wait=False)]:
            make(i, wait=True)


def data_differences(study: Study, workspace: Workspace, data: Sequence[str], tokenizer: Tokenizer) -> list[str]:
    """How the recordings at `data`, and their registry entries, differ from those from which the tokens here were made.
    Settings of the store are not compared, nor data that cannot be opened."""
    try:
        sources = [source_of(name, places) for name, places in group_by_dataset(data).items()]
        lines = _differences(study, workspace, sources, tokenizer)
    except (DataError, ConfigError):  # evaluation reads no episode of it
        return []
    return [line for line in lines if line.startswith(("spec.", "source:"))]


def say_other_rates(study: Study, sources: Sequence[Source]) -> None:
    """Notes datasets whose files state a native rate other than their entry's; the entry's rate is used."""
    from data_pipelines.sources.open import read_rate
    from data_pipelines.sources.source import same_rate

    for spec, path in sources:
        own = read_rate(path)
        if own is not None and not same_rate(own, spec.hz):
            say(
                f"note: {spec.name}: its files say {own:g} Hz, but its registry entry {spec.hz:g} Hz, which is used; "
                "if the files are right, correct the entry"
            )


def _differences(study: Study, workspace: Workspace, sources: Sequence[Source], tokenizer: Tokenizer) -> list[str]:
    """How the datasets in the store were made differently; a line that holds for several datasets is given once."""
    from data_pipelines.tokens.dataset_writer import differences
    from data_pipelines.tokens.tokenize_job import plan_dataset

    s = study.store
    plans = {
        spec.name: plan_dataset(
            spec, open_source((spec, path), s), tokenizer, s.held_out, frame_step=s.frame_step, rate=study.rate,
        )
        for spec, path in sources
        if (workspace.store / spec.name).exists()
    }  # fmt: skip
    return _joined_lines(plans, lambda name: differences(workspace.store, plans[name]))


def token_changes(study: Study, workspace: Workspace) -> list[str]:
    """How the datasets in the store were made differently, as far as is known before one is opened: from their entries
    and the settings."""
    from data_pipelines.tokens.dataset_writer import differences
    from data_pipelines.tokens.manifest import FILE
    from data_pipelines.tokens.manifest_file import load_manifest
    from data_pipelines.tokens.tokenize_job import plan_again

    s, root = study.store, workspace.store

    def lines(name: str) -> list[str]:
        existing = load_manifest(root / name / FILE)
        return differences(
            root, plan_again(existing, get_spec(name), s.held_out, frame_step=s.frame_step, rate=study.rate)
        )

    return _joined_lines([name for name in study.all_names() if (root / name).exists()], lines)


def _joined_lines(names: Iterable[str], differences: Callable[[str], list[str]]) -> list[str]:
    """The `differences` of datasets; a line that holds for several datasets is given once."""
    found: dict[str, list[str]] = {}
    for name in names:
        try:
            lines = differences(name)
        except UnreachableError:  # it may be intact
            raise
        except DataError as error:  # damaged, or of another format
            lines = [str(error)]
        for line in lines:
            if line.startswith("settings."):
                line = f"store.{line.removeprefix('settings.')}"  # as --set calls it
            found.setdefault(line, []).append(name)
    return [f"{line} ({few(names)})" for line, names in found.items()]
