"""How should actions enter the trunk?

Question: perplexity and delta PSNR when actions modulate every block, are extra tokens of their frame, are added to its
    tokens, are attended to, or do both: modulate blocks and enter as tokens. For the last, also with the other
    `model.action_alignment` than the study's: a frame is given the chunk before it instead of the one after it, or the
    other way round.
Paper figure: 5 (b); the alignment is not in the paper.
Command: python -m experiments.sweeps.conditioning --preset cpu
Cost: six training runs per seed of `ablation_seeds`, and the control; `--dry-run` prints it.
Expected outcome: modulation, alone or with tokens, ahead of tokens alone. The official release's
    cross-attention is defective (reference section 9.1) and so is the paper's bar; ours is not.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Sweep, make_ablation
from experiments.terminal.program import run_sweep
from hma_jax.config import Conditioning

BOTH: Conditioning = "concat+modulate"
KINDS: tuple[Conditioning, ...] = ("modulate", "concat", "add", "cross_attention", BOTH)


def conditioned(trial: Trial, **changes: str) -> Trial:
    return replace(trial, model=replace(trial.model, **changes))


def plan(study: Study) -> Sweep:
    """All datasets and trajectories under every conditioning."""
    other = "causal" if study.model.action_alignment == "released" else "released"
    variants = {kind: partial(conditioned, conditioning=kind) for kind in KINDS}
    variants[f"{BOTH}, {other} alignment"] = partial(conditioned, conditioning=BOTH, action_alignment=other)
    return make_ablation(
        study,
        name="conditioning",
        axis="conditioning",
        variants=variants,
        default=study.model.conditioning,
        question="How should actions enter the trunk?",
        gain="the way actions enter",
        title="Ablation: action conditioning",
    )


if __name__ == "__main__":
    run_sweep("conditioning")
