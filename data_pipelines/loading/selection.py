"""What a run is trained on: which windows, how often those of each dataset, and the statistics of their actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from data_pipelines.registry import FRAME_RATE
from data_pipelines.sampling.mixture import Mixture, make_mixture
from data_pipelines.sampling.order import ORDER_VERSION
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import WindowSet, require_windows, train_windows
from hma_jax.config import require
from hma_jax.config.training import ActionScale
from hma_jax.model.embodiments import Embodiment, EmbodimentTable

Weighed = Literal["used", "all"]
"""Which windows determine the mixture's weights: those of the trajectories that are used, or those of all trajectories,
so that a cap on trajectories does not change the weights."""


@dataclass(frozen=True)
class LoaderConfig:
    """The settings that determine the order of training windows."""

    frames: int = 12  # T
    batch: int = 64  # B, global
    tau: float = 3.0  # datasets are drawn with p ∝ windows^(1/tau)
    seed: int = 0  # random seed of the order and of the subset of trajectories
    max_trajectories: int | None = None  # per dataset
    capped: tuple[str, ...] = ()  # datasets to which max_trajectories applies; (): all of them
    datasets: tuple[str, ...] = ()  # empty: all datasets of the store
    shuffle_actions: bool = False  # control: actions of another episode
    rate: float | None = FRAME_RATE  # frame rate in Hz; None: native
    weighed: Weighed = "used"
    order: int = ORDER_VERSION  # part of the config, so that no run continues in another order

    def __post_init__(self):
        require(self.frames >= 1, f"loader.frames must be at least 1, got {self.frames}")
        require(self.batch >= 1, f"loader.batch must be at least 1, got {self.batch}")
        require(self.tau > 0, f"loader.tau must be positive, got {self.tau}")
        require(
            len(set(self.datasets)) == len(self.datasets),
            f"loader.datasets contains a dataset twice: {', '.join(self.datasets)}",
        )
        require(
            not self.capped or self.max_trajectories is not None,
            f"loader.capped says that loader.max_trajectories applies to {', '.join(self.capped)}, but it is not set; "
            "set it, or leave capped empty",
        )


@dataclass(frozen=True)
class Drawn:
    """What is drawn of one dataset."""

    trajectories: int  # those whose windows are drawn; fewer than asked for if some of a subset were skipped
    windows: int
    share: float  # of all windows drawn

    def passes(self, draws: int) -> float:
        """How often each window is seen, on average, in a training run that draws this many windows."""
        return self.share * draws / self.windows if self.windows else 0.0


@dataclass(frozen=True)
class TrainingWindows:
    """The windows that a config draws from, and the weights with which it draws."""

    sets: dict[str, WindowSet]
    mixture: Mixture

    def drawn(self) -> dict[str, Drawn]:
        """By dataset, including those from which nothing is drawn."""
        shares = dict(zip(self.mixture.names, self.mixture.weights, strict=True))
        return {name: Drawn(len(s.episodes), len(s), shares.get(name, 0.0)) for name, s in self.sets.items()}


def select_windows(store: TokenStore, config: LoaderConfig) -> TrainingWindows:
    """Counts windows and computes the datasets' weights. Raises DataError if no window is left, ConfigError for a cap
    on a dataset that is not used."""
    names = config.datasets or store.names
    strangers = [name for name in config.capped if name not in names]
    require(
        not strangers,
        f"loader.capped names {', '.join(strangers)}, not among the datasets that are trained on: {', '.join(names)}",
    )
    sets = {name: _windows(store, name, config, config.max_trajectories) for name in names}
    require_windows(sets)
    weighed = sets
    if config.weighed == "all" and config.max_trajectories is not None:
        weighed = {name: _windows(store, name, config, None) for name in names}
    # Nothing can be drawn from a dataset if all of its trajectories under the cap were skipped, whatever else it has.
    counts = {name: len(weighed[name]) if len(s) else 0 for name, s in sets.items()}
    return TrainingWindows(sets, make_mixture(counts, config.tau, {n: s.why_empty() for n, s in sets.items()}))


def training_table(store: TokenStore, config: LoaderConfig, scale: ActionScale = "deviation") -> EmbodimentTable:
    """The table of the datasets in `config`, in their order, with statistics of exactly the trajectories used."""
    names = config.datasets or store.names
    return EmbodimentTable(tuple(training_embodiment(store, name, config, scale) for name in names))


def training_embodiment(
    store: TokenStore, name: str, config: LoaderConfig, scale: ActionScale = "deviation"
) -> Embodiment:
    """One entry of `training_table`. Raises what `Manifest.embodiment` raises."""
    manifest, used = store.manifest(name), _windows(store, name, config, config.max_trajectories).episodes
    all_of_them = not len(used) or len(used) == len(manifest.train.episodes)
    if all_of_them or not manifest.spec.action_dim:
        return manifest.embodiment(config.rate, scale=scale)
    action_range = store.action_range(name, used) if scale == "quantiles" else None
    return manifest.embodiment(config.rate, store.action_moments(name, used), scale, action_range)


def _windows(store: TokenStore, name: str, config: LoaderConfig, limit: int | None) -> WindowSet:
    limit = limit if not config.capped or name in config.capped else None
    return train_windows(store, name, config.frames, limit, config.seed, rate=config.rate)
