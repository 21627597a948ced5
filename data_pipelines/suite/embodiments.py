"""The fifty robots of the suite, and the order in which a study adds them.

The order matters: scaling over datasets takes the first 5, 10, 20 and 40, and judges on the first
five. It follows from a rule: in each of five rounds, every trained family contributes one robot. A hash draws the order
of the families in a round and of the robots in a family, except that robots whose dataset has video only come last,
since their actions cannot be judged. So every prefix has many families and sizes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence

from data_pipelines.suite.families import FAMILIES, UNSEEN_FAMILIES
from data_pipelines.suite.spec import EmbodimentSpec
from hma_jax.config import require

Family = tuple[EmbodimentSpec, ...]


def _drawn(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _in_rounds(families: Iterable[Family]) -> tuple[EmbodimentSpec, ...]:
    orders = [sorted(siblings, key=lambda s: (s.video_only, _drawn(s.name))) for siblings in families]
    return tuple(
        spec
        for turn, robots in enumerate(zip(*orders, strict=True))
        for spec in sorted(robots, key=lambda s: _drawn(f"{turn}/{s.family}"))
    )


TRAINED = _in_rounds(FAMILIES)
"""Forty robots, in the order in which studies add them."""

UNSEEN = _in_rounds(UNSEEN_FAMILIES)
"""Ten robots that no study trains on unless it names them."""

EMBODIMENTS = TRAINED + UNSEEN

SPECS = {spec.name: spec for spec in EMBODIMENTS}


def select(names: Sequence[str] | None) -> tuple[EmbodimentSpec, ...]:
    """Specs by name, in the given order; all of them for None. Raises ConfigError for unknown names."""
    if names is None:
        return EMBODIMENTS
    unknown = [name for name in names if name not in SPECS]
    require(not unknown, f"unknown embodiment(s) {', '.join(unknown)}; the suite has {', '.join(SPECS)}")
    return tuple(SPECS[name] for name in names)


def siblings(spec: EmbodimentSpec) -> tuple[EmbodimentSpec, ...]:
    """The other robots of its family."""
    return tuple(s for s in EMBODIMENTS if s.family == spec.family and s.name != spec.name)


def strangers(spec: EmbodimentSpec) -> tuple[EmbodimentSpec, ...]:
    """Robots of other families with the same number of action values."""
    return tuple(s for s in EMBODIMENTS if s.family != spec.family and s.action_dim == spec.action_dim)
