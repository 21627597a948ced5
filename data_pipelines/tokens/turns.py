"""Looks for wrapping angles in the actions while they are tokenised and so read anyway.

No model can predict a value that jumps by a whole turn, and to find this out after training wastes the training. Owns
what is remembered about the actions; `registry.angles` says what such a jump is. Changes nothing that is stored.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_pipelines.registry import DatasetSpec
from data_pipelines.registry.angles import RECOGNISED, SWITCH_SHARE, AngleUnit, angle_lines, count_jumps, find_turns

EARLY = 64
"""Number of episodes after which the first check is made; the second is at the end."""

REMEMBERED = 4096
"""Least number of steps needed to distinguish an angle from a switch, if there are that many."""


class TurnWatch:
    """Watches the angles of one dataset. `warn` is called at most once for each value of the action."""

    def __init__(self, spec: DatasetSpec, warn: Callable[[str], None]):
        self._spec, self._warn = spec, warn
        width = sum(spec.action_dims)
        self._low, self._high = np.full(width, np.inf), np.full(width, -np.inf)
        self._jumps = {unit: np.zeros((2, width), np.int64) for unit in RECOGNISED}
        self._open = np.ones(width, bool)  # values about which neither the entry nor a warning says anything yet
        self._open[list(spec.angles if spec.angle_form != "as_recorded" else ())] = False
        self._first: list[np.ndarray] = []
        self._steps = self._episodes = 0

    def see(self, actions: np.ndarray) -> None:
        """The actions of an episode, [N, A] as recorded."""
        if not actions.size:
            return
        self._low = np.minimum(self._low, actions.min(0))
        self._high = np.maximum(self._high, actions.max(0))
        for unit, jumps in self._jumps.items():
            jumps += count_jumps(actions, unit)
        if self._steps < REMEMBERED:
            self._first.append(actions)
        self._steps, self._episodes = self._steps + len(actions), self._episodes + 1
        if self._episodes == EARLY:
            self.look()

    def look(self) -> None:
        """Warns of what was found and not reported before."""
        for unit, jumps in self._jumps.items():
            turning = self._open & find_turns(self._low, self._high, jumps, unit)
            found = [int(d) for d in np.flatnonzero(turning) if not self._is_switch(int(d))]
            if found:
                self._open[found] = False
                self._warn(self._text(found, unit))

    def _is_switch(self, d: int) -> bool:
        counts = np.unique(np.concatenate([actions[:, d] for actions in self._first]), return_counts=True)[1]
        return np.sort(counts)[-2:].sum() >= SWITCH_SHARE * counts.sum()

    def _text(self, found: list[int], unit: AngleUnit) -> str:
        where, first = [], 0
        for key, width in zip(self._spec.action_keys, self._spec.action_dims, strict=True):
            if own := [d - first for d in found if first <= d < first + width]:
                where.append(f"{key}: value{'s' * (len(own) > 1)} {', '.join(map(str, own))}")
            first += width
        return (
            f"{self._spec.name}: {'; '.join(where)} jump{'s' * (len(found) == 1)} by a whole turn, as wrapping angles do, "
            f"which no model can predict. Write {angle_lines(found, unit)} into its entry, in a file for --registry "
            "(`hma data inspect DIR --entry FILE` makes one), and tokenise again with --replace tokens"
        )
