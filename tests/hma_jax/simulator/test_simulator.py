"""The simulator against `rollout`, and everything that may be done to its episodes."""

import logging
from contextlib import nullcontext
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, MaskingConfig, TrainConfig
from hma_jax.generation import rollout
from hma_jax.model.hma import declare_model
from hma_jax.runtime.arrays import write_arrays
from hma_jax.simulator import Simulator, Start
from hma_jax.simulator.episode import as_arrays, from_arrays
from hma_jax.simulator.folder import DEFAULT_DECODE
from hma_jax.simulator.programs import Programs
from hma_jax.simulator.starts import load_starts, save_starts
from hma_jax.simulator.warm_up import sizes, warm_up_more
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.training.runs import Model
from tests.hma_jax.simulator.small import (
    CONFIG,
    DECODE,
    ROBOTS,
    TOKENIZER,
    chunks_of,
    latent_parts,
    parts,
    simulator,
    start,
)
from tests.tiny import TABLE

FRAMES = 7
"""Of an episode after its start: the window of 4 slides by then."""

STREAMING = DecodeConfig(2, temperature=1.0, slide="streaming")


@partial(jax.jit, static_argnums=4)
def rollout_of(*arguments):
    model, _ = parts()
    return rollout(model.declared.merge(model.params), *arguments)


def rolled_out(first, chunks: np.ndarray, seed: int, decode: DecodeConfig) -> np.ndarray:
    """The frames that `rollout` makes after a start under chunks [n, stride, A], decoded."""
    _, tokenizer = parts()
    robot = TABLE.index(first.robot)
    past = first.actions.reshape(len(first.images) - 1, *chunks.shape[1:])
    whole = np.concatenate([past, chunks, chunks[:1]])  # the last frame's own is seen by none
    padded = np.zeros((1, 1, len(whole), TABLE.action_width), np.float32)
    padded[0, 0, :, : whole[0].size] = whole.reshape(len(whole), -1)
    prompt, keys = tokenizer.encode(first.images)[None], jax.random.key(seed)[None]
    made = rollout_of(prompt, padded, np.array([robot], np.int32), keys, decode)
    return tokenizer.decode(np.asarray(made)[0, 0])


@pytest.mark.parametrize(
    "decode", [DECODE, pytest.param(STREAMING, marks=pytest.mark.slow)], ids=["exact", "streaming"]
)
def test_episodes_of_different_robots_starts_and_seeds_are_what_rollout_makes_of_each(decode):
    lengths, sim = (1, 6), simulator(episodes=2, decode=decode)
    for robots, seeds in (((0, 1), (5, 5)), ((2, 0), (2**32 - 1, 6))):
        starts = [start(robot, frames) for robot, frames in zip(robots, lengths, strict=True)]
        sim.reset(starts, seeds=seeds)
        plans = [chunks_of(robot, FRAMES) for robot in robots]
        made = np.stack([sim.step([plan[t] for plan in plans]) for t in range(FRAMES)])
        for b, robot in enumerate(robots):
            want = rolled_out(starts[b], plans[b], seeds[b], decode)
            np.testing.assert_array_equal(made[:, b], want, err_msg=f"robot {robot}")


def test_what_advances_any_number_of_episodes_was_compiled_before(monkeypatch):
    sim, asked = simulator(episodes=4), set()
    sim.reset([start(b % 3, 1) for b in range(4)])
    monkeypatch.setattr(sim, "_programs", copy(sim._programs))  # others share them

    def recorded(weights, state, rows_n, chunk_nU, seed_n):
        asked.add((rows_n is None, len(chunk_nU)))
        frames = np.zeros((len(chunk_nU), *sim.model.config.frame_shape), np.int32)
        return state, frames, np.zeros((len(chunk_nU), *sim.images.shape[1:]), np.uint8)

    monkeypatch.setattr(sim._programs, "advance", recorded)
    warm_up_more(sim, 0)
    compiled = set(asked)
    asked.clear()
    for together in range(1, 5):
        sim.step([chunks_of(b % 3, 1)[0] if b < together else None for b in range(4)])
    assert asked == compiled == {(False, 1), (False, 2), (False, 4), (True, 4)}


def test_caches_are_not_copied_in_vain():
    """Past the window no pass reads the cache. A program that advances all episodes holds activations and the cache of
    the window that it computes, one that advances some of them those episodes' too; both held more."""
    model, tokenizer = parts()
    config = replace(CONFIG, layers=32)  # so that caches are large beside activations
    declared = declare_model(config, TABLE)
    deep = Model(replace(model.run, model=config, params=declared.shapes()), declared, model.execution)
    programs = Programs(deep, tokenizer, 8, DECODE)
    state = programs._shapes
    chunk_nU, seed_n = np.zeros((8, TABLE.action_width), np.float32), np.zeros(8, np.uint32)
    cache = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state.cache.layers))
    for rows_n, caches in ((None, 3), (np.arange(8, dtype=np.int32), 4)):
        compiled = programs.advance.lower(programs.weights, state, rows_n, chunk_nU, seed_n).compile()
        assert compiled.memory_analysis().temp_size_in_bytes < caches * cache


def run(sim, plan: np.ndarray, b: int = 0) -> np.ndarray:
    wait = [None] * (len(sim) - 1)
    return np.stack([sim.step([*wait[:b], chunk, *wait[b:]])[b] for chunk in plan])


def test_a_waiting_episode_stays_and_another_s_actions_do_not_reach_it():
    sim, plan = simulator(episodes=2), chunks_of(1, 8)
    sim.reset([start(0, 2), start(1, 2)])
    alone = run(sim, plan, 1)
    assert sim.counts == (2, 10)
    sim.reset([start(0, 2), start(1, 2)])
    beside = np.stack([sim.step([chunks_of(0, 8)[t], plan[t]])[1] for t in range(8)])
    np.testing.assert_array_equal(beside, alone)
    before = sim.images[0].copy()
    sim.reset(start(1, 3), episodes=[1])
    np.testing.assert_array_equal(sim.images[0], before)
    assert sim.counts == (10, 3)


@pytest.mark.slow
def test_beginning_and_going_back_cost_what_they_are_of_and_come_to_the_same(monkeypatch):
    """Of four episodes one, then three: a power of two is computed, and the others stay where they are."""
    starts, asked, computed = [start(b % 3, b + 1) for b in range(4)], ([2], [1, 3, 0], []), []
    whole, parts = simulator(episodes=4), simulator(episodes=4)
    monkeypatch.setattr(parts, "_programs", copy(parts._programs))  # others share them
    for name in ("reset_from_images", "reset_from_tokens"):
        made = getattr(parts._programs, name)
        counted = lambda w, state, at, made=made: (computed.append(len(at.frames)), made(w, state, at))[1]  # noqa: E731
        monkeypatch.setattr(parts._programs, name, counted)
    whole.reset(starts, seeds=range(4))
    for which in asked:
        parts.reset([starts[b] for b in which], seeds=which, episodes=which)
    plans, frames = [chunks_of(b % 3, 4) for b in range(4)], []
    for t in range(4):
        frames.append(whole.step([p[t] for p in plans]))
        np.testing.assert_array_equal(parts.step([p[t] for p in plans]), frames[t])
    for which in asked:
        parts.rewind(2, which)
    np.testing.assert_array_equal(parts.images, frames[1])
    np.testing.assert_array_equal(parts.step([p[2] for p in plans]), frames[2])
    assert computed == [1, 4] * 2 and parts.counts == (4, 5, 6, 6)


@pytest.mark.parametrize("steps", [3, 9], ids=["in the window", "past it"])
def test_a_snapshot_is_gone_on_from_any_number_of_times(steps: int):
    sim, plan = simulator(), chunks_of(1, 12)
    sim.reset(start(1, 1), seeds=3)
    run(sim, plan[:steps])
    kept = sim.snapshot()
    first = run(sim, plan[steps:])
    for _ in range(2):
        sim.restore(kept)
        np.testing.assert_array_equal(run(sim, plan[steps:]), first)


def test_a_snapshot_of_another_model_changes_nothing():
    """It was taken, and the next step failed."""
    sim = simulator()
    kept = sim.snapshot()
    longer = kept._replace(state=jax.tree.map(lambda x: np.concatenate([x, x]), kept.state))
    before = sim.reset(start(1, 1))
    with pytest.raises(ConfigError, match="of a simulator of another model"):
        sim.restore(longer)
    assert sim.counts == (1,) and sim.images is not kept.images and np.array_equal(sim.images, before)


def test_a_snapshot_of_a_model_of_the_same_architecture_is_refused(tmp_path):
    """All shapes are equal: it went on, with another model's cache."""
    sim, (model, tokenizer) = simulator(), parts()
    params = jax.tree.map(lambda x: jax.device_put(np.asarray(x) + np.float32(0.01 * (x.ndim == 2))), model.params)
    others = {
        "model": Simulator(replace(model, run=replace(model.run, params=params)), tokenizer),
        "tokenizer": Simulator(model, LfqTokenizer(TOKENIZER, declare_tokenizer(TOKENIZER).init(1))),
        "run": Simulator(Model(model.run, model.declared, model.execution), tokenizer),
    }
    for one in (sim, *others.values()):
        one.reset(start(1, 1))
    kept = sim.snapshot()
    np.savez(tmp_path / "kept.npz", **as_arrays(kept))
    for name, other in others.items():
        with np.load(tmp_path / "kept.npz") as file:
            read = from_arrays(file, other.snapshot())
        for snapshot in (kept, read):
            with pytest.raises(ConfigError, match="another model") if name != "run" else nullcontext():
                other.restore(snapshot)


def test_a_snapshot_of_a_simulator_that_slides_otherwise_is_refused():
    """Past the window, a streaming simulator went on from a cache that an exact one had left behind."""
    exact, streaming = simulator(), simulator(decode=STREAMING)
    exact.reset(start(1, 1))
    with pytest.raises(ConfigError, match="another decode.slide"):
        streaming.restore(exact.snapshot())
    assert streaming.counts == (0,)
    exact.restore(simulator(decode=replace(DECODE, temperature=0.0)).snapshot())  # it changes no cache


def test_a_decoding_that_the_tokens_do_not_have_is_refused_before_an_episode_begins():
    """It was refused at the first step."""
    model, tokenizer = latent_parts()
    with pytest.raises(ConfigError, match="decode.order 'confidence' needs probabilities"):
        Simulator(model, tokenizer, decode=replace(DEFAULT_DECODE, order="confidence"))
    few = replace(model.config, diffusion=replace(model.config.diffusion, steps=8))
    with pytest.raises(ConfigError, match="sampler.steps 12 is more than .* sampler.steps in the run's decode.json"):
        Simulator(replace(model, run=replace(model.run, model=few)), tokenizer)


def test_the_frames_of_a_snapshot_cannot_be_written_to(tmp_path):
    """They were the simulator's own."""
    sim = simulator()
    before = sim.reset(start(1, 1)).copy()
    kept = sim.snapshot()
    read = from_arrays({name: x.copy() for name, x in as_arrays(kept).items()}, kept)
    for snapshot in (kept, read):
        sim.restore(snapshot)
        with pytest.raises(ValueError, match="read-only"):
            snapshot.images[:] = 0
        np.testing.assert_array_equal(sim.images, before)


@pytest.mark.parametrize("back", [1, 4, 11])
def test_what_was_taken_back_comes_again_under_the_same_actions(back: int):
    sim, plan = simulator(), chunks_of(0, 12)
    first = sim.reset(start(0, 1))[0].copy()
    made = run(sim, plan)
    shown = sim.rewind(back)[0]
    np.testing.assert_array_equal(shown, made[11 - back] if back < 12 else first)
    np.testing.assert_array_equal(run(sim, plan[12 - back :]), made[12 - back :])
    assert sim.max_rewind(0) == 12
    sim.rewind(12)
    np.testing.assert_array_equal(sim.images[0], first)


@pytest.mark.slow
def test_streaming_goes_on_in_place_after_it_was_taken_back():
    sim, plan = simulator(decode=STREAMING), chunks_of(0, 14)
    sim.reset(start(0, 1))
    made = run(sim, plan[:12])
    sim.rewind(10)  # to where the window is just full: nothing was approximated before
    np.testing.assert_array_equal(run(sim, plan[2:12]), made[2:])
    sim.rewind(5)  # the window's cache is computed anew, of frames in other slots
    (valid,) = np.asarray(sim.snapshot().state.cache.valid)
    assert sim.counts == (8,) and valid.tolist() == [True, False, True], "frame 7, the newest, belongs in slot 7 mod 3"
    run(sim, plan[7:9])


def test_history_bounds_how_far_an_episode_is_taken_back():
    sim, plan = simulator(history=2), chunks_of(0, 12)
    sim.reset(start(0, 1))
    made = run(sim, plan)
    with pytest.raises(ConfigError, match="at most 2 frames can be rewound, got 3"):
        sim.rewind(3)
    sim.rewind(2)
    np.testing.assert_array_equal(run(sim, plan[10:]), made[10:])


def test_a_whole_number_gives_each_episode_a_seed_of_its_own():
    sim, chunk, shown = simulator(episodes=2), chunks_of(1, 1)[0], []
    for seeds in (255, [255, 256], np.uint8(255)):
        sim.reset(start(1, 2), seeds=seeds)
        shown.append(sim.step([chunk, chunk]))
    for one in shown[1:]:
        np.testing.assert_array_equal(one, shown[0])
    assert (shown[0][0] != shown[0][1]).any()


def test_branches_differ_by_their_actions_alone():
    sim, plan = simulator(episodes=2), chunks_of(1, 12)
    sim.reset([start(0, 2), start(1, 2)], seeds=4)
    sim.branch([1, 1])
    for chunk in plan[:6]:
        images = sim.step([chunk, chunk])
    np.testing.assert_array_equal(images[0], images[1])
    for chunk, other in zip(plan[6:], chunks_of(1, 6, seed=10), strict=True):
        images = sim.step([chunk, other])
    assert (images[0] != images[1]).any()


def test_at_the_native_rate_a_frame_comes_with_every_stride_th_action():
    chunks = chunks_of(2, 2)
    sim = simulator()
    sim.reset(start(2, 2))
    want = run(sim, chunks)
    sim = simulator(rate="native")
    before = sim.reset(start(2, 2))
    seen = [sim.step([action]) for action in chunks.reshape(6, 3)]
    for t in (0, 1):
        np.testing.assert_array_equal(seen[t], before)
    np.testing.assert_array_equal(np.concatenate([seen[2], seen[5]]), want)


def test_an_action_is_held_for_a_frame():
    sim, action = simulator(episodes=2), chunks_of(1, 1)[0, 0]
    sim.reset(start(1, 2), seeds=[1, 1])
    images = sim.step([action, np.stack([action, action])])
    np.testing.assert_array_equal(images[0], images[1])


def test_what_lies_outside_is_clipped_and_said_or_refused(caplog):
    sim, low = simulator(), np.array(ROBOTS[0].low, np.float32)
    sim.reset(start(0, 1))
    sim.step([low])
    assert sim.clipped == [()]
    with caplog.at_level(logging.WARNING):
        outside = sim.step([low - [0.0, 2.0]])
        sim.step([low - [0.0, 2.0]])
    assert sim.clipped == [("action 1",)]
    assert [r.message for r in caplog.records] == [
        "pusher: action 1 of -7 to -7 is outside the range that its statistics allow, -5 to 7; such actions are clipped (this is said once)"
    ]
    sim.reset(start(0, 1))
    sim.step([low])
    np.testing.assert_array_equal(sim.step([low]), outside)

    strict = simulator(outside="refuse")
    before = strict.reset(start(0, 1))
    with pytest.raises(ConfigError, match="pusher: action 1 of -7"):
        strict.step([low - [0.0, 2.0]])
    np.testing.assert_array_equal(strict.images, before)
    assert strict.counts == (1,)


@pytest.mark.parametrize(
    "deed, message",
    [
        (lambda sim: sim.step([None]), "1 actions|as many actions"),
        (lambda sim: sim.step(None), "2 episodes need as many actions, got None"),
        (lambda sim: sim.step(0.5), "2 episodes need as many actions, got 0.5"),
        (lambda sim: sim.step([np.zeros(2), None]), "episode 0 has not begun"),
        (lambda sim: sim.reset(np.zeros((2, 8, 8, 3), np.uint8)), r"not at \[array\(.{,40}\Z"),
        (
            lambda sim: sim.reset("arm"),
            r"an episode begins at a Start .see the simulator's `starts`., not at \['arm'\]",
        ),
        (lambda sim: sim.reset([start(0, 2), None]), r"not at \[None\]"),
        (lambda sim: sim.reset(start(0, 2), seeds=[1]), "as many starts and seeds"),
        (lambda sim: sim.reset(start(0, 2), seeds=[0.5, 1]), r"seeds must be whole numbers, got \[0.5, 1\]"),
        (lambda sim: sim.reset(start(0, 2), seeds=None), "seeds must be whole numbers, got None"),
        (lambda sim: sim.reset(start(0, 2), episodes=[0, 2]), "numbers below 2"),
        (lambda sim: sim.reset(start(0, 2), episodes=[0.5]), "episodes must be whole numbers"),
        (lambda sim: sim.reset(start(0, 2), episodes=[True, False]), r"episodes must be whole numbers, got \[True, F"),
        (lambda sim: sim.reset(start(0, 2), seeds=True), r"seeds must be whole numbers, got \[True\]"),
        (
            lambda sim: sim.reset(start(0, 2), seeds=np.uint32(2**32 - 1)),
            r"seeds must lie in \[0, 2\^32\), got 4294967296",
        ),
        (lambda sim: sim.rewind(1.5), r"frames must be whole numbers, got \[1.5\]"),
        (lambda sim: sim.branch([1.0, 1.0]), "sources must be whole numbers"),
        (lambda sim: sim.branch([0]), r"branch needs 2 numbers of episodes to copy, each below 2, got \[0\]"),
        (lambda sim: sim.branch([-1, 0]), r"each below 2, got \[-1, 0\]"),
        (lambda sim: sim.branch([0, 2]), r"each below 2, got \[0, 2\]"),
        (lambda sim: simulator(episodes=1.5), r"episodes must be whole numbers, got \[1.5\]"),
        (lambda sim: simulator(decode={"unmask_steps": 2}), "decode must be a DecodeConfig, got dict"),
        (lambda sim: simulator(history=1.5), "history must be whole numbers"),
        (lambda sim: sim.max_rewind(-1), r"numbers below 2, got \[-1\]"),
        (lambda sim: sim.last_action(2), r"numbers below 2, got \[2\]"),
        (lambda sim: sim.compile(1.5), r"together must be whole numbers, got \[1.5\]"),
        (lambda sim: sim.restore(sim.images), "restore takes what `snapshot` returned, got ndarray"),
        (lambda sim: sim.restore(sim.snapshot()._replace(state=sim.images)), "of a simulator of another model"),
        (lambda sim: sim.robot("walker"), "the model has no robot 'walker'; it has pusher, arm, base"),
    ],
)
def test_what_cannot_be_done_is_said(deed, message: str):
    with pytest.raises(ConfigError, match=message):
        deed(simulator(episodes=2))


def test_starts_may_be_an_array():
    """As a random choice of some is."""
    sim, given = simulator(episodes=2), [start(0, 1), start(1, 1)]
    want = sim.reset(given)
    np.testing.assert_array_equal(sim.reset(np.array(given)), want)


def test_a_history_of_fewer_frames_than_none_is_refused():
    """An episode could then not be taken back by 0 frames."""
    with pytest.raises(
        ConfigError, match="history, the number of frames that can be rewound, must not be negative, got -1"
    ):
        simulator(history=-1)


@pytest.mark.parametrize(("name", "word"), [("outside", "raise"), ("rate", "Native")])
def test_another_word_is_not_taken_for_the_one_it_resembles(name: str, word: str):
    with pytest.raises(ConfigError, match=f"{name}: '{word}' is not allowed; choose one of "):
        simulator(**{name: word})


@pytest.mark.parametrize(
    "wrong", [{"episodes": 0}, {"history": -1}, {"decode": {}}, {"outside": "raise"}, {"rate": "y"}, {"episode": 2}]
)
def test_a_wrong_option_is_refused_before_a_model_is_loaded(tmp_path, wrong):
    """Loading takes minutes where the model is large; here there is none to load."""
    with pytest.raises((ConfigError, TypeError), match=next(iter(wrong))[:7]):
        Simulator.load(tmp_path, **wrong)


def test_an_action_of_another_shape_or_that_is_not_finite_is_refused():
    sim = simulator()
    sim.reset(start(1, 1))
    for action in (np.zeros(3), np.zeros((3, 7)), np.full(7, np.nan)):
        with pytest.raises(ConfigError, match="arm: "):
            sim.step([action])
    for action in (["0.1"] * 7, np.zeros(7) + 1j, [[0.0], [0.0, 1.0]], "left", object()):
        with pytest.raises(ConfigError, match="arm: an action is an array of real numbers, got "):
            sim.step([action])


DEEDS = {
    "reset_from_images": lambda sim: sim.reset(start(0, 2), episodes=[0]),
    "reset_from_tokens": lambda sim: sim.rewind(1, [0]),
    "advance": lambda sim: sim.step([chunks_of(0, 1)[0], None]),
}


@pytest.mark.parametrize("name", DEEDS)
def test_a_program_that_fails_with_the_state_in_its_hands_ends_all_episodes_and_no_more(monkeypatch, name: str):
    sim, plan = simulator(episodes=2), chunks_of(0, 3)
    sim.reset([start(0, 2), start(1, 2)])
    made = run(sim, plan)

    def failing(weights, state, *_):
        jax.tree.map(lambda x: x.delete(), state)  # as donating does
        raise RuntimeError("RESOURCE_EXHAUSTED")

    with monkeypatch.context() as broken:
        broken.setattr(sim, "_programs", copy(sim._programs))  # others share them
        broken.setattr(sim._programs, name, failing)
        with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED"):
            DEEDS[name](sim)
    assert sim.counts == (0, 0) and not sim.images.any()
    with pytest.raises(ConfigError, match="episode 1 has not begun"):
        sim.step([None, np.zeros(7)])
    sim.reset([start(0, 2), start(1, 2)])
    np.testing.assert_array_equal(run(sim, plan), made)


@pytest.mark.parametrize(
    ("name", "message"),
    [("reset_from_images", "encoding the start gives values from -1 "), ("advance", "the model gives values from -1 ")],
)
def test_what_a_program_makes_must_be_tokens(monkeypatch, name: str, message: str):
    """Images of what are none, of NaN say, are images too: black ones."""
    sim = simulator(episodes=2)
    sim.reset([start(0, 2), start(1, 2)])
    program = getattr(sim._programs, name)

    def diverged(*arguments):
        state, tokens, seen = program(*arguments)
        return state, tokens.at[0, 0].set(-1), seen

    monkeypatch.setattr(sim, "_programs", copy(sim._programs))
    monkeypatch.setattr(sim._programs, name, diverged)
    with pytest.raises(ConfigError, match=message + r"to .*; tokens must be in \[0, 16\); "):
        DEEDS[name](sim)
    assert sim.counts == (0, 0)


def test_a_program_that_fails_before_it_has_the_state_changes_nothing(monkeypatch):
    sim, plan = simulator(), chunks_of(0, 3)
    sim.reset(start(0, 2))
    made = run(sim, plan)
    sim.rewind(1)

    def failing(*_):
        raise RuntimeError("it could not be compiled")

    with monkeypatch.context() as broken:
        broken.setattr(sim, "_programs", copy(sim._programs))
        broken.setattr(sim._programs, "advance", failing)
        with pytest.raises(RuntimeError, match="could not be compiled"):
            sim.step([plan[2]])
    np.testing.assert_array_equal(sim.step([plan[2]])[0], made[2])


def test_the_last_action_is_the_one_before_the_present_frame():
    sim, plan = simulator(), chunks_of(1, 2)
    sim.reset(start(1, 1))
    assert sim.last_action(0) is None
    run(sim, plan)
    np.testing.assert_array_equal(sim.last_action(0), plan[1, -1])
    sim.rewind(1)
    np.testing.assert_array_equal(sim.last_action(0), plan[0, -1])


def test_a_window_of_the_model_is_all_of_a_start_that_is_seen():
    """So the frames before it cannot matter."""
    sim, long = simulator(), start(0, CONFIG.frames + 3)
    one = sim.reset(long).copy()
    cut = type(long)(long.robot, long.images[4:], long.actions[4:])
    np.testing.assert_array_equal(sim.reset(cut), one)
    assert sim.counts == (CONFIG.frames - 1,)


def test_a_start_may_be_given_as_lists_and_says_what_it_lacks():
    made = Start("arm", np.zeros((2, 1, 1, 3), np.uint8), [[0.0, 1.0]])
    assert made.actions.shape == (1, 2) and made.actions.dtype == np.float32
    for wrong in ([["0.1", "0.2"]], [[object()]], [[1j]], [[0.0], [0.0, 1.0]]):
        with pytest.raises(ConfigError, match="a start of arm: `actions` is an array of real numbers, got "):
            Start("arm", made.images, wrong)
    with pytest.raises(ConfigError, match="needs finite actions .* got \\(0,\\)"):
        Start("arm", made.images, [])


def test_starts_are_looked_for_by_their_values():
    """The equality of arrays is no truth value."""
    starts = [start(1, 2, seed) for seed in range(3)]
    again = start(1, 2, 2)
    assert starts.index(again) == 2 and {again: "third"}[starts[2]] == "third"
    assert start(1, 3) not in starts and again != "third" and len({*starts, again}) == 3


def test_starts_are_read_as_they_were_written(tmp_path: Path):
    """Robots' names too, and in their order where the numbers differ in length."""
    first = start(0, 2)
    starts = [replace(first, robot="lab/arm", seed=3), replace(first, robot="lab/base")]
    save_starts(starts, str(tmp_path / "few.npz"))
    assert load_starts(str(tmp_path / "few.npz")) == tuple(starts)
    given = {"images": first.images, "actions": first.actions, "seed": np.zeros(0, np.int64)}
    arrays = {f"{i}/{robot}/{name}": x for i, robot in ((10_000, "b"), (9999, "a")) for name, x in given.items()}
    write_arrays(tmp_path / "many.npz", arrays)
    assert [one.robot for one in load_starts(tmp_path / "many.npz")] == ["a", "b"]


def test_warming_up_ends_between_two_programs_when_it_is_asked_to():
    class Compiling(list):
        def compile(self, together):
            compiled.append(together)

    compiled: list[int] = []
    reached: list[int] = []
    warm_up_more(Compiling(range(16)), 1, ended=lambda: len(compiled) == 2, reached=reached.append)
    assert compiled == reached == [n for n in sizes(16) if n > 1][:2] and len(sizes(16)) > 3


@pytest.mark.parametrize("setting", ["policy", "inverse"])
def test_what_predicts_actions_alone_is_no_simulator(setting):
    model, tokenizer = parts()
    other = replace(model, run=replace(model.run, train=TrainConfig(masking=MaskingConfig(setting=setting))))
    with pytest.raises(ConfigError, match=f"'{setting}', which predicts no frames, so there are none to show"):
        Simulator(other, tokenizer)


def test_a_tokenizer_of_other_ids_is_refused_though_it_makes_as_many_tokens():
    model, tokenizer = parts()
    coarse = replace(TOKENIZER, bits=2)
    other = LfqTokenizer(coarse, declare_tokenizer(coarse).init(0))
    assert (other.tokens, other.channels) == (tokenizer.tokens, tokenizer.channels)
    with pytest.raises(ConfigError, match="of 2 factors with 4 entries .* but the tokenizer makes .* 2 entries"):
        Simulator(model, other)


@pytest.mark.slow
def test_a_model_trained_without_actions_goes_on_alike_under_all_of_them():
    model, tokenizer = parts()
    passive = replace(model.run, train=TrainConfig(masking=MaskingConfig(setting="passive")))
    first, plans = start(1, 2), (chunks_of(1, FRAMES), chunks_of(1, FRAMES, seed=10))
    other = Start(first.robot, first.images, -first.actions)

    def images(sim: Simulator) -> np.ndarray:
        sim.reset([first, other], seeds=[1, 1])
        for t in range(FRAMES):
            seen = sim.step([plan[t] for plan in plans])
        return seen

    blind = images(Simulator(replace(model, run=passive), tokenizer, decode=DECODE, episodes=2))
    sighted = images(simulator(episodes=2))
    np.testing.assert_array_equal(blind[0], blind[1])
    assert (sighted[0] != sighted[1]).any()
