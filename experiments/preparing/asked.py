"""What the process that holds a study's directory was asked to make there, for other processes that want to share the
work."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from data_pipelines.publishing.output_lock import backoff
from experiments.preparing.sources import Source, check_sources
from experiments.running.workspace import Busy, Workspace
from experiments.study import Study
from experiments.terminal.progress import say
from hma_jax.config.json import diff, to_dict
from hma_jax.runtime.files import write_file

FILE = ".asked.json"

WRITTEN_WITHIN = 60.0
"""Seconds for which a joining process waits for the file of a process that has just taken the directory, also on a
shared disk; a process that has written none by then is running another command."""

ENTRIES, RECORDINGS = "entries", "recordings"

Asked = dict[str, Any]


def asked_for(study: Study, sources: Sequence[Source], tokenizer: Path | None) -> Asked:
    """What tokens and windows depend on, under the names that --set uses; a `tokenizer` that is given, as a directory,
    is identified by its content. The recordings are not known before the sources are opened."""
    from hma_jax.tokenizers.io import load_tokenizer

    return {
        "datasets": study.all_names(),
        "store": to_dict(study.store),
        "rate": study.rate,
        "model.frames": study.model.frames,
        "eval": {name: getattr(study.eval, name) for name in ("seed", "windows_per_dataset", "prompt_frames")},
        "--tokenizer": load_tokenizer(tokenizer, expect=study.tokenizer).identity if tokenizer else "not given",
        ENTRIES: {spec.name: to_dict(spec.facts()) for spec, _ in sources},
        RECORDINGS: None,
    }


def with_recordings(asked: Asked, study: Study, sources: Sequence[Source]) -> Asked:
    """The same with fingerprints of the recordings. Raises what `check_sources` raises, and takes as long."""
    opened = check_sources(study, sources)
    return asked | {RECORDINGS: {name: source.fingerprint() for name, source in opened.items()}}


def write_asked(study: Study, workspace: Workspace, sources: Sequence[Source], tokenizer: Path | None) -> None:
    """Writes what was asked, for processes that join while the directory is held; raises what `check_sources` raises.
    Sources without an index take hours to open, so what is known before that is written first."""
    asked = asked_for(study, sources, tokenizer)
    _write(workspace, asked)
    _write(workspace, with_recordings(asked, study, sources))


def _write(workspace: Workspace, asked: Asked) -> None:
    holder = workspace.holder
    if holder is not None:
        write_file(workspace.root / FILE, json.dumps({"holder": holder.token, "asked": asked}))


def require_same_asked(
    study: Study, workspace: Workspace, sources: Sequence[Source], tokenizer: Path | None, busy: Busy
) -> None:
    """Raises Busy if the process that holds the directory says that it was asked for something else; and what
    `check_sources` raises. Waits for what that process has still to find out."""
    here, began = asked_for(study, sources, tokenizer), time.monotonic()
    if there := _wait_for_asked(workspace, busy, began):
        _require_same(there | {RECORDINGS: None}, here, busy)
    here = with_recordings(here, study, sources)
    if there := _wait_for_asked(workspace, busy, began, opened=True):
        _require_same(there, here, busy)


def _require_same(there: Asked, here: Asked, busy: Busy) -> None:
    both = there[ENTRIES].keys() & here[ENTRIES].keys()  # `datasets` shows the others
    if lines := diff(_of(both, there), _of(both, here)):
        raise Busy(
            f"{busy}. The work cannot be shared, since that one was asked for something else (there -> here):\n  "
            + "\n  ".join(lines),
            busy.holder,
        )


def _of(names: Collection[str], asked: Asked) -> Asked:
    some = {key: {name: asked[key][name] for name in names} for key in (ENTRIES, RECORDINGS) if asked[key]}
    return asked | some


def _wait_for_asked(workspace: Workspace, busy: Busy, began: float, *, opened: bool = False) -> Asked | None:
    """What the holder of the directory was asked for; with `opened`, waits until this includes its recordings. None if
    the holder has ended, or is running another command (it has written nothing for WRITTEN_WITHIN seconds since
    `began`)."""
    announced = False
    for pause in backoff():
        asked = _read(workspace)
        if asked is None and time.monotonic() - began > WRITTEN_WITHIN:
            return None
        if asked is not None and (not opened or asked.get(RECORDINGS) is not None):
            return asked
        with suppress(Busy), workspace.locked():
            return None
        if not announced:
            say(f"waiting until {busy.who} says what it was asked for, or ends")
            announced = True
        time.sleep(pause)


def _read(workspace: Workspace) -> Asked | None:
    """What the process that holds the directory was asked for; None if it has written nothing."""
    holder = workspace.holder
    try:
        written = json.loads((workspace.root / FILE).read_text())
    except FileNotFoundError:
        return None
    return written["asked"] if holder is not None and written["holder"] == holder.token else None
