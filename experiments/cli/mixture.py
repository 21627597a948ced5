"""The table of a mixture: the amount of data in each dataset, and how often a training run draws from it."""

from __future__ import annotations

from collections.abc import Mapping

from data_pipelines.loading.selection import Drawn, select_windows
from data_pipelines.tokens.store import TokenStore
from experiments.running.trial import Trial, loader_of
from experiments.terminal.progress import console, tidy_table
from experiments.terminal.words import OF_MIXTURE, counted, mixture_rows


def show_mixture(store: TokenStore, trial: Trial) -> None:
    """What `trial` would draw of each dataset; nothing where there is only one. Raises DataError without a window."""
    show_drawn(select_windows(store, loader_of(trial)).drawn(), trial)


def show_drawn(drawn: Mapping[str, Drawn], trial: Trial) -> None:
    """The same table, from counts that were already made."""
    if sum(one.share > 0 for one in drawn.values()) < 2:
        return
    draws = trial.train.steps * trial.train.batch
    kept = ", by the windows of all trajectories" if trial.weighed == "all" else ""
    title = (
        f"The mixture: windows^(1/{trial.tau:g}) sets each dataset's share of the draws{kept}; passes over its windows in "
        f"{counted(trial.train.steps, 'step')} of {trial.train.batch}"
    )
    table = tidy_table(title, *OF_MIXTURE)
    for row in mixture_rows(drawn, draws):
        table.add_row(*row)
    console.print(table)
