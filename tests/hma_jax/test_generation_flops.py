"""FLOPs of generation by formula, against the products of matrices in the traced programs, loops unrolled."""

import dataclasses
import math
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import pytest

from hma_jax.config import Conditioning, DecodeConfig, DiffusionConfig, ExecutionConfig, SamplerConfig
from hma_jax.config.evaluation import SamplerKind
from hma_jax.generation import rollout, rollout_naive, steps
from hma_jax.generation.cache import Window
from hma_jax.generation.flops import frame_flops, rollout_flops, sampler_flops
from hma_jax.kernels.dense import CHUNK
from hma_jax.model.flops import denoiser_flops, forward_flops_per_window, pass_flops
from hma_jax.model.hma import declare_model
from tests.tiny import TABLE, model_config, random_batch

DIFFUSION = DiffusionConfig(channels=2, patch=2, width=48, depth=2, steps=20)
KINDS = {"ids": None, "latents": DIFFUSION}

ROWS = 2
"""Examples at a time: with one, a product of matrices may have one row."""


def counted(function, *args) -> float:
    """FLOPs, per example, of every product of matrices that `function` runs; a loop's body as often as it runs.

    Products with one row or column only are sums, written so where that is fast.
    """
    return in_jaxpr(jax.make_jaxpr(function)(*args).jaxpr) / ROWS


def in_jaxpr(jaxpr) -> float:
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            total += of_product(equation)
            continue
        inner = [x for value in equation.params.values() for x in as_jaxprs(value)]
        if equation.primitive.name == "cond":  # the program for one platform or another
            total += max(map(in_jaxpr, inner))
            continue
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        assert equation.primitive.name != "while" or not any(map(in_jaxpr, inner)), "how often is not written down"
        total += times * sum(map(in_jaxpr, inner))
    return total


def as_jaxprs(value) -> list:
    values = value if isinstance(value, (tuple, list)) else [value]
    return [getattr(v, "jaxpr", v) for v in values if hasattr(getattr(v, "jaxpr", v), "eqns")]


def of_product(equation) -> float:
    (contracted, _), (batch, right_batch) = equation.params["dimension_numbers"]
    left, right = (v.aval.shape for v in equation.invars)
    (_, right_contracted), _ = equation.params["dimension_numbers"]
    rows = math.prod(n for i, n in enumerate(left) if i not in (*contracted, *batch))
    columns = math.prod(n for i, n in enumerate(right) if i not in (*right_contracted, *right_batch))
    if 1 in (rows, columns):
        return 0.0
    shared = math.prod(left[i] for i in batch) * math.prod(left[i] for i in contracted)
    return 2.0 * shared * rows * columns


class Case:
    """A model with everything that generation needs."""

    def __init__(self, **changes):
        self.config = model_config(width=64, action_heads=False, **changes)
        self.declared = declare_model(self.config, TABLE, ExecutionConfig(attention="plain"))
        self.params = self.declared.init(0)
        self.batch = {k: v[:ROWS] for k, v in random_batch(0, self.config).items()}
        self.keys = jax.random.split(jax.random.key(0), ROWS)

    def window(self, params) -> Window:
        return Window.over(self.declared.merge(params), self.batch["actions"], None, self.batch["embodiment"])

    def cache(self, params):
        return self.window(params).empty(ROWS, self.config.frames - 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("conditioning", get_args(Conditioning))
def test_a_pass_counts_exactly_what_is_multiplied(kind, conditioning):
    case = Case(diffusion=KINDS[kind], conditioning=conditioning)
    frames = case.config.frames
    count = counted(lambda p: whole_pass(case, p), case.params)
    padding = 2 * frames * (2 * CHUNK - TABLE.action_width) * case.config.width  # actions come in whole chunks
    assert count == pass_flops(case.config, TABLE, frames, frames) + padding  # what is masked is multiplied too
    half = pass_flops(case.config, TABLE, frames, frames / 2)
    denoiser = denoiser_flops(case.config, frames * case.config.tokens) if KINDS[kind] else 0
    assert forward_flops_per_window(case.config, TABLE) == half + denoiser


def whole_pass(case: Case, params) -> jax.Array:
    batch = case.batch
    model = case.declared.merge(params)
    return model(batch["tokens"], None, model.align(batch["actions"]), batch["embodiment"]).token_outputs


def ways(case: Case, decode: DecodeConfig) -> dict:
    tokens, size = case.batch["tokens"], case.config.frames
    past, newest = tokens[:, :-1], tokens[:, -2]
    last = {"t": jnp.int32(size - 1), "key_B": case.keys, "decode": decode}
    robots = case.batch["embodiment"]
    return {
        "fill": lambda p: steps.fill(case.window(p), case.cache(p), newest, **last),
        "stream": lambda p: steps.stream(case.window(p), case.cache(p), newest, jnp.int32(size), case.keys, decode),
        "slide": lambda p: steps.slide(case.window(p), past, case.keys, decode),
        "recompute": lambda p: rollout_naive(
            case.declared.merge(p), past, case.batch["actions"], robots, case.keys, decode
        ),
    }


@pytest.mark.parametrize("looks", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))])
@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_counts_every_look_and_every_sampler_step(kind, looks):
    case = Case(diffusion=KINDS[kind])
    decode = DecodeConfig(looks, sampler=SamplerConfig(steps=10))
    for way, make in ways(case, decode).items():
        count, formula = counted(make, case.params), frame_flops(case.config, TABLE, decode, way)
        # Attention over time: some of it is no product of matrices, some of it masked.
        assert formula == pytest.approx(count, rel=0.03), way


def test_of_the_frames_before_a_new_one_none_is_read_out():
    """With a vocabulary so large that reading out is most of a pass."""
    case = Case(factor_vocab=2048, layers=1)
    decode = DecodeConfig(2)
    for way, make in ways(case, decode).items():
        count, formula = counted(make, case.params), frame_flops(case.config, TABLE, decode, way)
        assert formula == pytest.approx(count, rel=0.03), way
    tokens, size = jnp.asarray(case.batch["tokens"])[:, :-1], case.config.frames
    chunks = jnp.asarray(case.batch["actions"])[:, None]
    count = counted(
        lambda p: rollout(case.declared.merge(p), tokens, chunks, case.batch["embodiment"], case.keys, decode),
        case.params,
    )
    assert rollout_flops(case.config, TABLE, decode, size, size - 1) == pytest.approx(count, rel=0.03)


@pytest.mark.parametrize("resample", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize(
    "sampler", [SamplerConfig(kind, 5 + n) for n, kind in enumerate(get_args(SamplerKind))], ids=get_args(SamplerKind)
)
def test_the_denoiser_counts_the_tokens_that_it_sees_at_every_step(resample, sampler):
    """Without the trunk's part: the difference of two numbers of steps."""
    case = Case(diffusion=DIFFUSION)
    decode = DecodeConfig(4, sampler=sampler, resample=resample)
    fewer = dataclasses.replace(decode, sampler=dataclasses.replace(sampler, steps=2))
    more, less = (counted(ways(case, d)["fill"], case.params) for d in (decode, fewer))
    assert more - less == sampler_flops(case.config, decode) - sampler_flops(case.config, fewer)
    drawn = denoiser_flops(case.config, 19 if resample else 9, own_steps=False)
    assert sampler_flops(case.config, decode) == sampler.steps * drawn
    assert sampler_flops(Case().config, decode) == 0


@pytest.mark.parametrize("slide", ["exact", "streaming"])
@pytest.mark.parametrize(
    ("frames", "prompt"), [(9, 2), *(pytest.param(*p, marks=pytest.mark.slow) for p in [(6, 2), (10, 8)])]
)
def test_a_rollout_is_the_sum_of_its_frames(slide, frames, prompt):
    case = Case(diffusion=DIFFUSION)
    decode = DecodeConfig(2, slide=slide, sampler=SamplerConfig(steps=4))
    repeat = -(-frames // case.config.frames) * 2
    tokens = jnp.concatenate([jnp.asarray(case.batch["tokens"])] * repeat, axis=1)[:, :prompt]
    actions = jnp.concatenate([jnp.asarray(case.batch["actions"])] * repeat, axis=1)[:, :frames]
    robots = case.batch["embodiment"]

    def cached(p, sequences):
        chunks = jnp.stack([actions] * sequences, axis=1)
        return rollout(case.declared.merge(p), tokens, chunks, robots, case.keys, decode)

    def naive(p):
        return rollout_naive(case.declared.merge(p), tokens, actions, robots, case.keys, decode)

    of = partial(rollout_flops, case.config, TABLE, decode, frames, prompt)
    for sequences in (1, 3):
        count = counted(lambda p, n=sequences: cached(p, n), case.params)
        assert of(sequences=sequences) == pytest.approx(count, rel=0.03)
    if slide == "exact":  # recomputing is the same in both
        assert of(naive=True) == pytest.approx(counted(naive, case.params), rel=0.03)
