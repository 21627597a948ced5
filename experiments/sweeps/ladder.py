"""What makes the model better at the same number of steps?

Question: held-out nats, PSNR and what actions decide, for the reference, with masked tokens that also hold the token of
    the frame before at their position (`model.recall`), with matrices updated by Muon (`train.optimizer.matrices`), and
    with both. Single changes, and the study's long runs, have the first seed only. The variants have
    `designs.ablation_steps`. For the study's own number of steps all are trained too, and both changes are combined
    with chained factors (`model.chain_factors`), and with tokens that count three or ten times where they change
    (`train.masking.change_weight`). Long runs have both changes, the shortest of them also with tokens that count three
    times where they change.
Paper figure: none.
Command: python -m experiments.sweeps.ladder --preset cpu-full
Cost: per seed of `ablation_seeds` four training runs, two of them with longer branches; besides these, one for each
    single change and for the tenfold weight, the control and the long runs; `--dry-run` prints it.
Expected outcome: recall and Muon are ahead of the reference, both together ahead of each; chained factors give fewer
    nats but not more dB, and weighting changes gives neither. The outcome: experiments/results/ladder/findings.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Point, Sweep, make_ablation, reference_trial
from experiments.terminal.program import run_sweep
from experiments.terminal.words import counted

REFERENCE, RECALL, MUON, BEST = "reference", "recall", "Muon", "recall, Muon"
CHAINED, WEIGHED, TENFOLD = f"{BEST}, chained", f"{BEST}, changes thrice", f"{BEST}, changes tenfold"


def recalling(trial: Trial) -> Trial:
    return replace(trial, model=replace(trial.model, recall=True))


def with_muon(trial: Trial) -> Trial:
    optimizer = replace(trial.train.optimizer, matrices="muon")
    return replace(trial, train=replace(trial.train, optimizer=optimizer))


def with_both(trial: Trial) -> Trial:
    return with_muon(recalling(trial))


def chained(trial: Trial) -> Trial:
    return replace(trial, model=replace(trial.model, chain_factors=True))


def with_changes_weighed(trial: Trial, weight: float) -> Trial:
    masking = replace(trial.train.masking, change_weight=weight)
    return replace(trial, train=replace(trial.train, masking=masking))


VARIANTS: dict[str, Callable[[Trial], Trial]] = {
    REFERENCE: lambda trial: trial,
    RECALL: recalling,
    MUON: with_muon,
    BEST: with_both,
}

LONGER = VARIANTS | {
    CHAINED: lambda trial: chained(with_both(trial)),
    WEIGHED: lambda trial: with_changes_weighed(with_both(trial), 3.0),
    TENFOLD: lambda trial: with_changes_weighed(with_both(trial), 10.0),
}


def plan(study: Study) -> Sweep:
    """All datasets and trajectories for every variant. Those of `LONGER` are also trained for the study's steps, which
    the label states, unless the variants already have that number."""
    seeds, first = study.ablation_seeds, study.ablation_seeds[0]
    sweep = make_ablation(
        study,
        name="ladder",
        axis="change",
        variants=VARIANTS,
        default=REFERENCE,
        question="What makes the model better at the same number of steps? One change alone, changes tenfold, and the longest runs have one "
        "seed.",
        gain="such changes",
        title="Ladder: what pays",
    )
    several = {sweep.labels.index(name) for name in (REFERENCE, BEST)}
    points = [point for point in sweep.points if point.x in several or point.trial.train.seed == first]
    labels = list(sweep.labels)
    longer = [(name, study.train.steps, seeds) for name in (BEST, REFERENCE, CHAINED, WEIGHED)]
    longer += [(name, study.train.steps, (first,)) for name in (RECALL, MUON, TENFOLD)]
    if study.designs.ablation_steps in (None, study.train.steps):
        longer = [one for one in longer if one[0] not in VARIANTS]
    longer += [(BEST, steps, (first,)) for steps in study.designs.long]
    longer += [(WEIGHED, steps, (first,)) for steps in study.designs.long[:1]]
    for name, steps, chosen in longer:
        for seed in chosen:
            trial = replace(reference_trial(study, seed, steps), measure_untrained=False)
            points.append(Point(len(labels), LONGER[name](trial)))
        labels.append(f"{name}, {counted(steps, 'step')}")
    # The longest run continues the first seed of BEST: in this order it is not left running alone at the end.
    points.sort(key=lambda point: point.x != sweep.labels.index(BEST))
    return replace(sweep, points=tuple(points), labels=tuple(labels))


if __name__ == "__main__":
    run_sweep("ladder")
