"""From datasets to everything a trial needs: suite, tokenizer, token store, frozen windows and, of the suite, what is
true in them under other actions.

Each step is skipped if its output exists and was made from the same inputs, and continues where it was interrupted.
Output that was made from other inputs is refused unless it may be replaced (`preparing.made_from`). What was prepared
is identified by the hashes of `Provenance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.preparing.asked import write_asked
from experiments.preparing.changes import require_preparable
from experiments.preparing.counterfactual import make_counterfactual
from experiments.preparing.given_tokenizer import adopt_tokenizer, judge_tokenizer
from experiments.preparing.made_from import Step
from experiments.preparing.sources import find_sources, say_other_versions, say_short_episodes
from experiments.preparing.store import make_store
from experiments.preparing.suite import make_suite
from experiments.preparing.tokenizer import make_tokenizer
from experiments.preparing.windows import freeze_windows
from experiments.running.provenance import Provenance
from experiments.running.workspace import Workspace
from experiments.study import Study
from hma_jax.evaluation.lpips import require_lpips
from hma_jax.training.run_lock import require_plain


def prepare(
    study: Study,
    workspace: Workspace,
    data: Sequence[str] = (),
    tokenizer: Path | None = None,
    *,
    replace: Step | None = None,
    batch: int | None = None,
    threads: int | None = None,
) -> Provenance:
    """Makes what is missing and returns what trials depend on.

    `data` are directories of the user's datasets; () simulates the suite. A trained `tokenizer` is taken from its
    directory instead of training one. Steps from `replace` on may be redone and their products replaced. `batch` and
    `threads` as in `make_store`; a tokenizer is trained and judged with the same number of threads. Raises ConfigError
    or DataError.
    """
    require_plain(workspace.root)
    if study.eval.lpips:
        require_lpips()  # before all the work that precedes the evaluation
    require_preparable(study, workspace, data, tokenizer, replace)
    sources = find_sources(study, data) if data else make_suite(study, workspace, replace)
    write_asked(study, workspace, sources, tokenizer)
    if replace or not workspace.manifest.exists():  # else all is known
        say_other_versions(sources)
        say_short_episodes(study, sources)
    if tokenizer is None:
        make_tokenizer(study, workspace, sources, replace, threads=threads)
    else:
        adopt_tokenizer(tokenizer, study, workspace, sources, replace)
        judge_tokenizer(study, workspace, sources, threads=threads)
    make_store(study, workspace, sources, replace=replace, batch=batch, threads=threads)
    provenance = freeze_windows(study, workspace, replace)
    if not data and study.eval.other_actions and study.eval.context == "generated":
        make_counterfactual(study, workspace)
    elif data:  # a study of the suite may have left frames of its own windows here
        workspace.counterfactual.unlink(missing_ok=True)
    return provenance
