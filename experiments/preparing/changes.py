"""Whether a study can be prepared in its directory: asked before anything is made, by commands and their dry runs.

Compares what is there with the study's settings and entries, in all steps at once. No dataset is opened, so changed
recordings are not noticed here: the step that reads them refuses them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.preparing.given_tokenizer import given_changes
from experiments.preparing.made_from import Change, Step, require_unchanged
from experiments.preparing.store import token_changes
from experiments.preparing.suite import suite_changes
from experiments.preparing.tokenizer import require_trainable_tokenizer, trained_changes, unchanged
from experiments.preparing.windows import window_changes
from experiments.running.workspace import Workspace
from experiments.study import Study


def require_preparable(
    study: Study,
    workspace: Workspace,
    data: Sequence[str],
    tokenizer: Path | None,
    replace: Step | None,
    more: Sequence[Change] = (),
) -> None:
    """Raises ConfigError for a study on `data` that has no tokenizer and cannot train one, and, unless `replace` allows
    it, for products that were made from other inputs; `more`: such changes that the caller knows."""
    if data and tokenizer is None:
        require_trainable_tokenizer(study.tokenizer)
    require_unchanged([*find_changes(study, workspace, data, tokenizer), *more], replace)


def find_changes(study: Study, workspace: Workspace, data: Sequence[str], tokenizer: Path | None) -> list[Change]:
    """Steps, in order, whose product exists but was made from other inputs. For steps after a changed one, consequences
    of that change are not listed."""
    changes = [
        Change("suite", workspace.suite, () if data else suite_changes(study, workspace)),
        Change("tokenizer", workspace.tokenizer, trained_changes(study, workspace), unchanged(workspace.tokenizer))
        if tokenizer is None
        else Change("tokenizer", workspace.tokenizer, given_changes(tokenizer, workspace)),
        Change("tokens", workspace.store, token_changes(study, workspace)),
        Change("windows", workspace.manifest, window_changes(study, workspace)),
    ]
    return [change for change in changes if change.lines]
