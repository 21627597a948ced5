"""What `--dry-run` says a trial will cost."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from experiments.cli.main import main
from experiments.cost import estimate, evaluation_flops_per_window
from experiments.presets import SMOKE, SMOKE_CONTINUOUS
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import EvalConfig, ExecutionConfig, MaskingConfig
from hma_jax.evaluation.protocol import make_predictor
from hma_jax.model.hma import declare_model
from tests.hma_jax.test_generation_flops import DIFFUSION, ROWS, counted
from tests.tiny import TABLE, model_config, random_batch


@pytest.mark.parametrize("diffusion", [None, DIFFUSION], ids=["ids", "latents"])
@pytest.mark.parametrize("context", ["generated", "recorded"])
@pytest.mark.parametrize("setting", ["forward", "policy"])
def test_evaluation_counts_what_the_protocol_multiplies(diffusion, context, setting):
    config = model_config(width=64, diffusion=diffusion, action_heads=setting == "policy")
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


def test_the_plan_says_what_it_counts_and_what_not(capsys):
    assert main(["study", "--preset", "smoke", "--dry-run", "--set", "trial_seconds=60"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "About 5.0 min for the trials, one after the other" in said
    assert "60 s for each to start, compile and write" in said
    assert "Not counted: simulating, tokenizer and tokens" in said
