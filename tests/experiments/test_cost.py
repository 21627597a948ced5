"""What `--dry-run` says a trial will cost."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments.cli.main import main
from experiments.declared_table import declared_table
from experiments.dry_run.cost import (
    checkpoint_bytes,
    estimate,
    evaluation_flops_per_window,
    plan_trials,
)
from experiments.dry_run.preparing_cost import describe, estimate_preparing
from experiments.dry_run.trainable import devices_of
from experiments.presets import ACCELERATOR, CPU_FULL, PAPER, SMOKE, SMOKE_CONTINUOUS
from experiments.running.launchers import local, registry
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.slots import Accelerators
from experiments.sweeps.registry import find_axis, plan_sweeps
from experiments.sweeps.sweep import POINT, reference_trial
from experiments.terminal.words import duration
from hma_jax.config import ConfigError, EvalConfig, ExecutionConfig, MaskingConfig, MeshConfig
from hma_jax.evaluation.protocol import make_predictor
from hma_jax.model.hma import declare_model
from tests.hma_jax.test_generation_flops import DIFFUSION, ROWS, counted
from tests.tiny import TABLE, model_config, random_batch


@pytest.mark.parametrize("diffusion", [None, DIFFUSION], ids=["ids", "latents"])
@pytest.mark.parametrize(
    ("context", "setting"),
    [
        ("generated", "forward"),
        ("recorded", "policy"),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in (("generated", "policy"), ("recorded", "forward"))),
    ],
)
def test_evaluation_counts_what_the_protocol_multiplies(diffusion, context, setting):
    # Of so many entries the read-out is a large part: of the true frames, which are not predicted, none is read out.
    config = model_config(width=64, factor_vocab=512, diffusion=diffusion, action_heads=setting == "policy")
    steps = replace(EvalConfig().decode.sampler, steps=5)
    protocol = replace(
        EvalConfig(), context=context, prompt_frames=2, random_actions=3, other_actions=4,
        decode=replace(EvalConfig().decode, sampler=steps),
    )  # fmt: skip
    trial = replace(
        reference_trial(replace(SMOKE, datasets=("a", "b", "c")), 0), model=config, eval=protocol,
        train=replace(SMOKE.train, masking=MaskingConfig(setting=setting)),
    )  # fmt: skip
    execution = ExecutionConfig(attention="plain")
    number = np.arange(ROWS, dtype=np.int32)
    batch = {k: v[:ROWS] for k, v in random_batch(0, config).items()} | {"episode": number, "start": number}
    others = (ROWS, protocol.other_actions)
    batch |= {"other_actions": np.zeros((*others, *batch["actions"].shape[1:])), "other_valid": np.ones(others, bool)}
    if context == "generated":
        batch |= {"other_images": number, "other_seen": number > 0}
    predict = make_predictor(config, TABLE, protocol, setting, execution)
    params = jax.eval_shape(lambda: declare_model(config, TABLE, execution).init(0))
    # Action heads, attention over time and what is masked make the difference.
    assert evaluation_flops_per_window(trial, TABLE) == pytest.approx(counted(predict, params, batch), rel=0.05)


def test_batches_hold_windows_of_several_datasets_and_the_last_is_filled_up():
    trial = replace(reference_trial(SMOKE, 0), measure_untrained=False)
    assert (len(trial.evaluated), trial.eval.windows_per_dataset, trial.eval.batch) == (3, 2, 2)

    def flops(**changes) -> float:
        return estimate(replace(trial, eval=replace(trial.eval, **changes))).evaluation_flops

    assert flops(windows_per_dataset=3) == pytest.approx(10 / 6 * flops())
    assert flops(windows_per_dataset=3, batch=4) == flops(windows_per_dataset=4) == 2 * flops()


def test_samplers_of_latents_are_paid_for_step_by_step():
    trial = reference_trial(replace(SMOKE_CONTINUOUS, eval=replace(SMOKE_CONTINUOUS.eval, other_actions=0)), 0)
    sampler = trial.eval.decode.sampler

    def flops(steps: int) -> float:
        decode = replace(trial.eval.decode, sampler=replace(sampler, steps=steps))
        return estimate(replace(trial, eval=replace(trial.eval, decode=decode))).evaluation_flops

    assert flops(40) - flops(20) == pytest.approx(20 / 5 * (flops(15) - flops(10)))
    assert flops(100) > 3 * flops(10)  # the rest is the trunk's


def test_what_other_sequences_cost_is_as_the_page_says():
    page = " ".join((Path(__file__).parents[2] / "docs" / "statistics.md").read_text().split())
    trial = reference_trial(PAPER, 0)
    with_others, without = (
        estimate(replace(trial, eval=replace(trial.eval, other_actions=n))) for n in (trial.eval.other_actions, 0)
    )
    whole = with_others.evaluation_flops
    own, whole = (x / with_others.train_flops for x in (whole - without.evaluation_flops, whole))
    assert trial.eval.other_actions == 15
    assert f"Fifteen cost {own:.0%}".replace("%", " %") in page
    assert f"of `paper`, and the whole evaluation {whole:.0%}.".replace("%", " %") in page


def test_the_plan_says_what_it_counts(capsys):
    plan = ["study", "--preset", "smoke", "--dry-run", "--set", "trial_seconds=60"]
    assert main(plan) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "5.0 min for the trials, one after the other" in said
    assert "60 s for each to start, compile, decode and write" in said
    assert "to prepare (simulating " in said and "the tokenizer " in said and "tokens " in said
    assert main([*plan, "--workers", "2"]) == 0
    assert "2.5 min for the trials, 2 at a time" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("gpus", "launching", "mesh", "each", "at_once"),
    [
        (0, LauncherOptions(), (-1, 1, 1), 1, 1),
        (0, LauncherOptions(workers=8), (-1, 1, 1), 1, 8),
        (0, LauncherOptions(), (8, 1, 1), 8, 1),
        (0, LauncherOptions(workers=2), (2, -1, 2), 4, 2),
        (8, LauncherOptions(), (-1, 1, 1), 8, 1),
        (8, LauncherOptions(workers=2), (-1, 1, 1), 4, 2),
        (8, LauncherOptions(workers=16), (-1, 1, 1), 0.5, 16),
        (8, LauncherOptions("slurm"), (-1, 1, 1), 1, None),
        (8, LauncherOptions("slurm", None, ("gpus=4",)), (-1, 1, 1), 4, None),
        (0, LauncherOptions("slurm", 3, ("gpus=4",)), (1, -1, 1), 4, 3),
        (0, LauncherOptions("ray", 4, ("tpus=4",)), (-1, 1, 1), 4, 4),
        (0, LauncherOptions("ray", 2, ("gpus=0.5",)), (1, 1, 1), 0.5, 2),
    ],
)
def test_every_launcher_says_which_devices_a_trial_runs_on(gpus, launching, mesh, each, at_once, monkeypatch):
    found = Accelerators("gpu", tuple(map(str, range(gpus)))) if gpus else None
    monkeypatch.setattr(local, "find_accelerators", lambda: found)
    assert (devices_of(MeshConfig(*mesh), launching.share()), launching.at_once) == (each, at_once)


def test_the_plan_prices_the_devices_that_trials_run_on(capsys, monkeypatch):
    """Before, a rate was that of a whole machine, for each worker."""
    monkeypatch.setattr(local, "find_accelerators", lambda: None)
    monkeypatch.setattr(registry, "usable_cores", lambda: 4)
    plan = ["study", "--preset", "smoke", "--dry-run", "--set", "trial_seconds=3600", "--set", "train.batch=8"]
    plan += ["--set", "flops_per_second=1e20"]
    for more, said in (
        ("", "priced for 1 device at 100.0 EFLOP/s each (flops_per_second); 5.0 device-hours"),
        ("--workers 4", "priced for 4 devices, 1 for each trial, at 100.0 EFLOP/s each (flops_per_second); 5.0 dev"),
        # A rate of accelerators, where there is none: they are another machine's, which these cores do not limit.
        ("--workers 5", "priced for 5 devices, 1 for each trial, at 100.0 EFLOP/s each (flops_per_second); 5.0 dev"),
        (
            "--workers 5 --set flops_per_second=9e11",
            "priced for 4 devices, 0.8 for each trial, at 900.0 GFLOP/s each (flops_per_second); 4.0 dev",
        ),
        ("--launcher slurm --launcher-set gpus=8", "if the cluster runs all at the same time"),
        ("--launcher slurm --launcher-set gpus=8", "for 8 devices at 100.0 EFLOP/s each (flops_per_second); 40.0 dev"),
    ):
        assert main([*plan, *more.split()]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert said in printed and "'Control': trained on shuffled actions." in printed


def test_several_devices_are_as_many_times_faster():
    sweep = find_axis("width")(SMOKE)
    for one, eight in zip(*(plan_trials(SMOKE, [sweep], devices).values() for devices in (1, 8)), strict=True):
        start = SMOKE.trial_seconds
        assert one.seconds - start == pytest.approx(8 * (eight.seconds - start)) and one.flops == eight.flops


def test_a_model_that_is_only_trained_pays_for_no_evaluation_and_leaves_two_checkpoints():
    plans = plan_trials(SMOKE, [find_axis("width")(SMOKE)], evaluated=False)
    assert all(plan.flops == plan.cost.train_flops < plan.cost.flops for plan in plans.values())
    counters = [checkpoint_bytes(plan) - 2 * 3 * 4 * plan.cost.parameters for plan in plans.values()]
    assert all(0 < size < 1000 for size in counters)


def test_more_workers_than_cores_make_nothing_faster(monkeypatch):
    """Sixteen workers were said to need a sixteenth of the time on two cores."""
    monkeypatch.setattr(local, "find_accelerators", lambda: None)
    monkeypatch.setattr(registry, "usable_cores", lambda: 4)
    shares = {n: LauncherOptions("local", n).cores_each() for n in (1, 4, 16)}
    assert shares == {1: 1, 4: 1, 16: 0.25} and LauncherOptions("slurm", 16).cores_each() == 1
    sweeps = [find_axis("width")(SMOKE)]
    alone, shared = (plan_trials(SMOKE, sweeps, shares[n]).values() for n in (4, 16))
    for a, b in zip(alone, shared, strict=True):
        assert b.seconds - SMOKE.trial_seconds == pytest.approx(4 * (a.seconds - SMOKE.trial_seconds))


def test_checkpoints_from_which_others_go_on_are_counted():
    plan = next(iter(plan_trials(SMOKE, [find_axis("width")(SMOKE)]).values()))
    plan = replace(plan, trial=replace(plan.trial, train=replace(plan.trial.train, steps=100)))
    assert checkpoint_bytes(replace(plan, keep=(10, 30))) == 2 * checkpoint_bytes(plan)
    assert checkpoint_bytes(replace(plan, keep=(80,))) == checkpoint_bytes(plan), "one of the newest two"


def test_what_is_frozen_leaves_no_moments_in_checkpoints():
    """They were counted as the trained robots' are: twice the size of all parameters."""
    plans = plan_trials(CPU_FULL, [find_axis("fewshot")(CPU_FULL)]).values()
    frozen = next(plan for plan in plans if plan.trial.train.only)
    trial = frozen.trial
    table = declared_table((*trial.source.datasets, *trial.datasets), trial.rate)
    leaves = declare_model(trial.model, table).leaves().values()
    own = sum(spec.size // table.size for spec in leaves if spec.embodiment_axis is not None)
    kept = frozen.cost.parameters + 2 * len(trial.train.only) * own
    assert 0 < checkpoint_bytes(frozen) - 2 * 4 * kept < 1000


def test_a_mesh_that_does_not_fit_what_a_trial_gets_is_refused_before_it_is_priced():
    assert devices_of(MeshConfig(-1, 2, 1), None) == 2 and devices_of(MeshConfig(-1, 2, 1), 8.0) == 8
    assert devices_of(MeshConfig(1, 1, 1), 0.5) == 0.5
    with pytest.raises(ConfigError, match="a mesh of data=8, fsdp=1, tensor=1 does not fit 4 device"):
        devices_of(MeshConfig(8, 1, 1), 4.0)


def test_a_mesh_that_a_trial_does_not_divide_over_is_refused_before_it_is_priced(capsys, monkeypatch):
    monkeypatch.setattr(local, "find_accelerators", lambda: Accelerators("gpu", ("0", "1", "2")))
    for command in ("train", "study"):
        assert main([command, "--preset", "smoke", "--dry-run"]) == 2
        said = capsys.readouterr().err
        assert "a batch of 4 cannot be divided over data=3 x fsdp=1 devices" in said
        assert ("each on its part of this machine: --workers 3" in said) == (command == "study")
        assert main([command, "--preset", "smoke", "--dry-run", "--mesh", "1", "1", "3"]) == 2
        said = capsys.readouterr().err
        assert "tensor=3 does not divide the model's heads of 2" in said and "--workers" not in said
    study = ["study", "--preset", "smoke", "--dry-run"]
    assert main([*study, "--mesh", "1", "1", "1"]) == 2
    assert "does not fit 3 device(s); set one axis to -1" in (said := capsys.readouterr().err) and "--workers 3" in said
    assert main([*study, "--workers", "3"]) == 0


def test_a_decay_that_begins_within_the_warm_up_is_refused_before_anything_is_made(capsys, tmp_path):
    """The rate came down to half of its peak at the end of this one, not to a tenth."""
    short = [word for one in ("schedule=wsd", "warmup_steps=8") for word in ("--set", f"train.optimizer.{one}")]
    for command in (["train"], ["study"], ["study", "--dry-run"], ["train", "--dry-run"], ["sweep", "horizon"]):
        steps = ("designs.budgets=[9, 20]", "train.steps=20") if "horizon" in command else ("train.steps=9",)
        steps = (*steps, "train.optimizer.decay_fraction=0.3")
        given = [*short, *(word for one in steps for word in ("--set", one))]
        assert main([*command, "--preset", "smoke", "--out", str(tmp_path / "out"), *given]) == 2
        said = capsys.readouterr().err
        assert "train.steps=9 are too few for the warm-up (train.optimizer.warmup_steps=8) and the decay of" in said
        assert not (tmp_path / "out").exists()


def test_robots_that_are_to_be_trained_alone_and_are_not_there_are_refused_before_anything_is_made(capsys, tmp_path):
    for command in (["train"], ["study"], ["sweep", "datasets", "--dry-run"]):
        only = "rover_mud" if command == ["train"] else SMOKE.dataset_names()[-1]  # not in the first point
        given = ["--preset", "smoke", "--out", str(tmp_path / "out"), "--set", f"train.only={only}"]
        assert main([*command, *given]) == 2
        assert f"train.only: the study has no robot {only}, but " in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


def test_robots_without_actions_that_are_to_be_trained_alone_are_refused_before_anything_is_made(capsys, tmp_path):
    """Trials of a study failed after its data, tokenizer and other trials were made."""
    video, one = "gripper_sky", ["--set", "designs.shots_after=1", "--set", "designs.judged=1"]
    fewshot = ["sweep", "fewshot", *one, "--set", f"unseen={video},omni_mint"]
    only = ["--set", f"datasets={video},picker_sand,arm_sky", "--set", f"train.only={video}"]
    nothing = f"train.only: {video} would have no parameters to train"
    for command, words in (
        (fewshot, f"{video}: a model cannot be adapted to robots without actions"),
        (["study", *only], nothing),
        (["train", *only], nothing),
    ):
        for dry in ([], ["--dry-run"]):
            assert main([*command, *dry, "--preset", "smoke", "--out", str(tmp_path / "out")]) == 2
            assert words in capsys.readouterr().err
            assert not (tmp_path / "out").exists()
    assert main([*fewshot, "--dry-run", "--preset", "smoke", "--set", "unseen=omni_mint"]) == 0


def test_what_nobody_knows_of_the_preparation_is_said_to_be_unknown(capsys):
    before = estimate_preparing(PAPER)
    words = describe(before)
    assert words.startswith("unknown for 38 of 40 datasets")
    assert f"{duration(before.seconds)} with the other 2 alone" in words
    assert describe(replace(before, unknown=("a", "b"), datasets=2)) == (
        "unknown for 2 of 2 datasets, because nothing says how many frames they have (a, b)"
    )
    assert main(["sweep", "width", "--preset", "paper", "--dry-run"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "and the preparation: unknown for 38 of 40" in said and " in all" not in said


def test_what_is_prepared_is_paid_for():
    """The tokenizer by its steps, tokens by the frames that are kept, what is given not at all."""
    whole = estimate_preparing(SMOKE)
    longer = estimate_preparing(replace(SMOKE, tokenizer_train=replace(SMOKE.tokenizer_train, steps=300)))
    assert longer.tokenizer > 2 * whole.tokenizer and longer.tokens == whole.tokens
    larger = estimate_preparing(replace(SMOKE, suite=replace(SMOKE.suite, scale=1.0)))
    assert larger.simulating > 2 * whole.simulating and larger.tokens > 2 * whole.tokens
    native = estimate_preparing(replace(SMOKE, rate=None))
    assert native.tokens > 2 * whole.tokens and native.simulating == whole.simulating
    given = estimate_preparing(SMOKE, simulated=False, trained=False)
    assert given.simulating == given.tokenizer == 0 < given.tokens
    assert estimate_preparing(replace(SMOKE, unseen=("omni_mint",))).simulating > whole.simulating


def test_what_trials_have_in_common_is_paid_for_once():
    """Of two numbers of steps the longer one pays for what comes after the common part."""
    optimizer = replace(SMOKE.train.optimizer, schedule="wsd")
    study = replace(SMOKE, train=replace(SMOKE.train, steps=1000, optimizer=optimizer),
                    designs=replace(SMOKE.designs, budgets=(500, 1000)))  # fmt: skip
    sweep = find_axis("horizon")(study)
    points = tuple(p for p in sweep.points if p.role == POINT)
    plans = {p.trial.train.steps: p for p in plan_trials(study, [replace(sweep, points=points)]).values()}
    per_step = plans[500].cost.train_flops / 500
    own = {steps: plan.flops - plan.cost.evaluation_flops for steps, plan in plans.items()}
    assert own[500] == pytest.approx(500 * per_step) and own[1000] == pytest.approx((1000 - 400) * per_step)


def test_the_table_of_what_to_run_on_is_what_dry_runs_say():
    """docs/launching.md: a row for each machine, of devices of a trial, trials at a time, rate."""
    page = (Path(__file__).parents[2] / "docs" / "launching.md").read_text()
    rows = [line.split("|")[1:-1] for line in page.splitlines() if line.startswith(("| 1 H100", "| 8 H100", "| TPU v"))]
    sweeps = plan_sweeps(ACCELERATOR, ACCELERATOR.axes)
    machines = ((1, 1, 1e14), (1, 8, 1e14), (4, 4, 2.75e13), (8, 1, 1.97e13))
    for (*_, hours, _, device_hours), (each, at_once, rate) in zip(rows, machines, strict=True):
        study = replace(ACCELERATOR, flops_per_second=rate)
        seconds = [plan.seconds for plan in plan_trials(study, sweeps, each).values()]
        whole = estimate_preparing(study).seconds + max(sum(seconds) / at_once, max(seconds))
        assert (float(hours), float(device_hours)) == (round(whole / 3600, 1), round(each * sum(seconds) / 3600, 1))
    assert f"{len(seconds)} trials" in page
