"""The Fetch arm: reaches, pushes, and picks and places. Actions are [dx, dy, dz, fingers] in -1..1."""

from __future__ import annotations

import numpy as np

from data_pipelines.simulators.behaviour import Expert

GAIN = 6.0  # action per metre
FAST = 0.5  # largest share of full speed: episodes last seconds, not half a second
OPEN, CLOSED = 1.0, -1.0
BEHIND = 0.09  # metres behind the block where pushing starts
ABOVE = 0.12  # metres over the block where the hand travels
HELD = 0.025  # metres between hand and block when it is between the fingers


def expert(backend) -> Expert:
    """The script for the environment that `backend` has just started."""
    script = _reach if "Reach" in backend.made else _pick if "Pick" in backend.made else _push

    def act() -> np.ndarray:
        seen = backend.observation
        return script(seen["observation"][:3], seen["achieved_goal"], seen["desired_goal"])

    return act


def _towards(hand: np.ndarray, target: np.ndarray, fingers: float) -> np.ndarray:
    move = GAIN * (target - hand)
    fastest = np.abs(move).max()
    return np.append(move * min(1.0, FAST / max(fastest, 1e-9)), fingers)


def _reach(hand: np.ndarray, _: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return _towards(hand, goal, CLOSED)


def _pick(hand: np.ndarray, block: np.ndarray, goal: np.ndarray) -> np.ndarray:
    across, over = np.linalg.norm((block - hand)[:2]), hand[2] - block[2]
    if across < HELD and abs(over) < HELD:
        return _towards(hand, goal + hand - block, CLOSED)
    height = 0.0 if across < HELD else ABOVE
    return _towards(hand, block + [0, 0, height], OPEN)


def _push(hand: np.ndarray, block: np.ndarray, goal: np.ndarray) -> np.ndarray:
    way = (goal - block)[:2]
    far = np.linalg.norm(way)
    if far < 0.02:
        return _towards(hand, hand + [0, 0, ABOVE], CLOSED)
    way = way / far
    along, lateral = (hand - block)[:2] @ way, (hand - block)[:2] @ [-way[1], way[0]]
    low = hand[2] - block[2] < HELD
    if low and along < 0 and abs(lateral) < HELD:
        target = np.append(block[:2] + 0.02 * way, block[2])  # through the block
        return _towards(hand, target, CLOSED) * (1.0 if far > 0.05 else 0.6)
    start = np.append(block[:2] - BEHIND * way, block[2])
    if np.linalg.norm((start - hand)[:2]) > HELD:
        start[2] += ABOVE  # not through the block
    return _towards(hand, start, CLOSED)
