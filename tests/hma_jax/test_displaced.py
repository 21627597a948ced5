"""A past in which patches are displaced: what it shows where, and that the frames to learn stay true."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, MaskingConfig
from hma_jax.config.training import check_objective
from hma_jax.objective import losses
from hma_jax.objective.displaced import LARGEST, displace_patches
from hma_jax.objective.losses import noise_keys
from tests.tiny import TABLE, mask, random_batch, shallow_config

TRUE = MaskingConfig(teacher_forcing=True)
DISPLACED = MaskingConfig(teacher_forcing=True, displaced_past=1.0)


def test_rectangles_of_frames_on_end_show_what_stands_elsewhere_in_the_same_frame(monkeypatch):
    monkeypatch.setattr("hma_jax.objective.displaced.PATCHES", 1)
    rows, frames, side = 256, 7, 8
    # The id of a token says which frame and place it is of.
    past = jnp.broadcast_to(jnp.arange(frames * side**2).reshape(frames, side**2), (rows, frames, side**2))
    keys = jax.random.split(jax.random.key(0), rows)
    displace = jax.jit(displace_patches)
    shown = np.asarray(displace(past, 1.0, keys))
    assert (shown // side**2 == np.arange(frames)[:, None]).all()
    moved_BTYX = (shown != np.asarray(past)).reshape(rows, frames, side, side)
    lengths, starts = [], []
    for moved_TYX in moved_BTYX:
        if not moved_TYX.any():  # taken from its own place
            continue
        when, high, wide = (np.flatnonzero(moved_TYX.any(other)) for other in ((1, 2), (0, 2), (0, 1)))
        assert moved_TYX[np.ix_(when, high, wide)].all() and moved_TYX.sum() == len(when) * len(high) * len(wide)
        for run in (when, high, wide):
            assert (np.diff(run) == 1).all()
        lengths.append((len(when), len(high), len(wide)))
        starts.append((when[0], high[0], wide[0]))
    assert len(lengths) > 0.95 * rows and np.min(starts) == 0
    assert np.max(lengths, axis=0).tolist() == [frames, LARGEST * side, LARGEST * side]
    assert 0.45 < (np.max(starts, axis=0) / [frames, side, side]).min()
    assert 0.6 < np.mean([high != wide for _, high, wide in lengths]) < 0.9  # of four each: three in four
    ends = np.add(starts, lengths)
    assert np.max(ends, axis=0).tolist() == [frames, side, side]
    # Of frames that begin at the b-th of seven, one in 7 - b lasts to the end: of all, (1 + 1/2 + ... + 1/7) / 7.
    assert 0.27 < (ends[:, 0] == frames).mean() < 0.47
    np.testing.assert_array_equal(displace(past, 0.0, keys), past)
    touched = (np.asarray(displace(past, 0.5, keys)) != past).any((1, 2)).mean()
    assert 0.4 < touched < 0.6
    # Latents go with their places, and an example's rectangle is its own whatever stands beside it.
    latents = jax.nn.one_hot(past % side**2, side**2)
    np.testing.assert_array_equal(displace(latents, 1.0, keys).argmax(-1), shown % side**2)
    np.testing.assert_array_equal(displace(past[3:5], 1.0, keys[3:5]), shown[3:5])


def test_the_past_alone_is_displaced(monkeypatch):
    """What is shown of a frame itself stays as it is."""

    class Shown(Exception):
        pass

    def show(model, *given, **how):
        raise Shown(*given[:3])

    monkeypatch.setattr(losses, "teacher_forced_pass", show)
    config = shallow_config(action_heads=False)
    batch = random_batch(0, config, 32)
    tokens, given = jnp.asarray(batch["tokens"]), (batch["actions"], batch["embodiment"])
    keys, model = noise_keys(jax.random.key(0), len(tokens)), SimpleNamespace(table=TABLE)

    @partial(jax.jit, static_argnums=0)
    def shown(masking, tokens):
        masked = mask(jax.random.key(0), tokens, given[1], config, masking, TABLE)
        with pytest.raises(Shown) as shows:
            losses.masked_loss(model, masked, tokens, *given, masking, keys, training=True)
        return shows.value.args

    (past, *rest), (displaced, *others) = shown(TRUE, tokens), shown(DISPLACED, tokens)
    assert 0.02 < (past != displaced).mean() < 0.2
    for same, too in zip(rest, others, strict=True):
        np.testing.assert_array_equal(same, too)


def test_it_needs_a_past_that_is_shown_and_square_frames():
    with pytest.raises(ConfigError, match="displaced_past needs masking.teacher_forcing=true"):
        MaskingConfig(displaced_past=0.5)
    with pytest.raises(ConfigError, match="displaced_past .* 8 is not a square number"):
        check_objective(shallow_config(tokens=8), DISPLACED)
