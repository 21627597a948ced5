"""What the process that holds a study's directory was asked to make in it, for those that would share the work."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.preparing.sources import Source, check_sources
from experiments.running.workspace import Busy, Workspace
from experiments.study import Study
from hma_jax.config.json import diff, to_dict
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.sources.source import EpisodeSource

FILE = ".asked.json"


def asked_for(
    study: Study, sources: Sequence[Source], opened: Mapping[str, EpisodeSource], tokenizer: Path | None
) -> dict[str, Any]:
    """What tokens and windows depend on, under the names that --set has; a `tokenizer` that is given, by its directory,
    is known by its identity. `opened`: the sources by name, as `check_sources` gives them."""
    from hma_jax.tokenizers.io import load_tokenizer

    return {
        "datasets": study.all_names(),
        "store": to_dict(study.store),
        "rate": study.rate,
        "model.frames": study.model.frames,
        "eval": {name: getattr(study.eval, name) for name in ("seed", "windows_per_dataset", "prompt_frames")},
        "--tokenizer": load_tokenizer(tokenizer, expect=study.tokenizer).identity if tokenizer else "not given",
        "data": {
            spec.name: {"entry": to_dict(spec.facts()), "recordings": opened[spec.name].fingerprint()}
            for spec, _ in sources
        },
    }


def write_asked(
    study: Study,
    workspace: Workspace,
    sources: Sequence[Source],
    opened: Mapping[str, EpisodeSource],
    tokenizer: Path | None,
) -> None:
    """For those that join while the directory is held."""
    holder = workspace.holder
    if holder is not None:
        written = {"holder": holder.token, "asked": asked_for(study, sources, opened, tokenizer)}
        write_file(workspace.root / FILE, json.dumps(written))


def require_same_asked(
    study: Study, workspace: Workspace, sources: Sequence[Source], tokenizer: Path | None, busy: Busy
) -> None:
    """Raises Busy if the process that holds the directory was asked for something else, where it says so, and as
    `check_sources` does."""
    try:
        written = json.loads((workspace.root / FILE).read_text())
    except FileNotFoundError:  # another command
        return
    if busy.holder is None or written["holder"] != busy.holder.token:
        return
    there, here = written["asked"], asked_for(study, sources, check_sources(study, sources), tokenizer)
    both = there["data"].keys() & here["data"].keys()  # the others are told by `datasets`
    for one in (there, here):
        one["data"] = {name: one["data"][name] for name in both}
    if lines := diff(there, here):
        raise Busy(
            f"{busy}. The work cannot be shared, since that one was asked for something else (there -> here):\n  "
            + "\n  ".join(lines),
            busy.holder,
        )
