"""Does it help a video model to be told the actions, or to predict them too?

Question: perplexity and delta PSNR of passive video prediction (no actions), full dynamics
    (frames and actions predicted) and forward dynamics (actions given), all else equal.
Paper figure: 5 (a).
Command: python -m experiments.sweeps.settings --preset cpu
Cost: three training runs per seed of `ablation_seeds`, and the control; `--dry-run` prints it.
Expected outcome: forward is best, full between it and passive. Passive has a delta PSNR of zero
    by construction; the shuffled-action control should score as passive does.

Models that predict actions cannot be trained with teacher forcing. For a fair comparison every setting is trained as in
the release, whatever the study's other axes do.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Sweep, make_ablation
from experiments.terminal.program import run_sweep
from hma_jax.config import MaskingSetting, require

NAMES: dict[MaskingSetting, str] = {"passive": "passive", "full": "full dynamics", "forward": "forward dynamics"}


def under(setting: MaskingSetting, trial: Trial) -> Trial:
    """`trial` trained in `setting`; action heads are added if there are actions to predict."""
    masking = replace(trial.train.masking, setting=setting)
    model = replace(trial.model, action_heads=trial.model.action_heads or masking.predicts_actions)
    return replace(trial, model=model, train=replace(trial.train, masking=masking))


def plan(study: Study) -> Sweep:
    """All datasets and trajectories in every setting, none with teacher forcing."""
    default = study.train.masking.setting
    require(
        default in NAMES,
        f"train.masking.setting is {default!r}, which predicts no frames, so they cannot be evaluated; use one of "
        f"{', '.join(NAMES)}",
    )
    released = replace(study.train, masking=replace(study.train.masking, teacher_forcing=False))
    return make_ablation(
        replace(study, train=released),
        name="settings",
        axis="setting",
        variants={name: partial(under, setting) for setting, name in NAMES.items()},
        default=NAMES[default],
        question="Does it help a video model to see the actions, or to predict them too? Passive "
        "prediction sees no actions, so its ΔPSNR is zero by construction.",
        gain="knowing actions",
        title="Ablation: dynamics setting",
    )


if __name__ == "__main__":
    run_sweep("settings")
