"""Which robots a design judges and which it adds, drawn anew for every seed, so that no result depends on one set of
five.

They are drawn by a hash of seed and name, so the order of the robots does not matter, and every set lies inside the
larger ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from typing import Literal

from experiments.study import Study
from hma_jax.config import require

Kinship = Literal["any", "siblings", "strangers"]


def draw_judged(study: Study, seed: int, count: int | None = None) -> tuple[str, ...]:
    """The robots that a seed judges, `designs.judged` or as many as given, in the study's order. In the suite, each is
    of another family, and none has video only: without actions there is nothing to judge. Raises ConfigError if there
    are too few."""
    names, families = study.dataset_names(), _families()
    found: list[str] = []
    for name in _drawn(names, seed):
        if name in families and (families[name][1] or families[name][0] in {families[n][0] for n in found}):
            continue
        found.append(name)
    wanted = study.designs.judged if count is None else count
    require(
        len(found) >= wanted,
        f"{wanted} judged robots are needed, each of another family, but only {len(found)} can be drawn",
    )
    return _in_order(names, found[:wanted])


def draw_mixture(
    study: Study, seed: int, count: int, kinship: Kinship = "any", judged: int | None = None
) -> tuple[str, ...]:
    """The judged robots of a seed and as many newcomers as make `count`, in the study's order.

    `kinship`: newcomers only of the judged robots' families, or of none of them. Raises ConfigError if there are too
    few.
    """
    names, own = study.dataset_names(), draw_judged(study, seed, judged)
    newcomers = [name for name in _drawn(names, seed) if name not in own]
    if kinship != "any":
        families = _families()
        missing = [name for name in names if name not in families]
        require(
            not missing, f"only robots of the suite have families, but {', '.join(missing[:3])} is not in the suite"
        )
        kin = {families[name][0] for name in own}
        newcomers = [name for name in newcomers if (families[name][0] in kin) == (kinship == "siblings")]
    added = count - len(own)
    require(
        0 <= added <= len(newcomers),
        f"{count} robots with {len(own)} judged ones and {added} {'newcomers' if kinship == 'any' else kinship}: "
        f"there are {len(newcomers)}",
    )
    return _in_order(names, {*own, *newcomers[:added]})


def _families() -> dict[str, tuple[str, bool]]:
    """{robot of the suite: (its family, whether it has video only)}."""
    from data_pipelines.suite.embodiments import EMBODIMENTS

    return {e.name: (e.family, e.video_only) for e in EMBODIMENTS}


def _drawn(names: Sequence[str], seed: int) -> list[str]:
    return sorted(names, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).hexdigest())


def _in_order(names: Sequence[str], chosen: Collection[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name in chosen)
