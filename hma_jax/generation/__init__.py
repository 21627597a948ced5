"""Generation: whole rollouts, one frame at a time, teacher-forced passes, and policies.

There is one way to fill a frame (`decoding`), one cache of finished frames (`cache`), and there are three ways to make
the next frame (`steps`). The other modules decide which frames are made.
"""

from hma_jax.generation.policy import predict_actions, predict_next_actions, read_actions
from hma_jax.generation.rollout import rollout, rollout_naive
from hma_jax.generation.session import Session, advance, start
from hma_jax.generation.teacher import next_frame_outputs, next_frames

__all__ = [
    "Session",
    "advance",
    "next_frame_outputs",
    "next_frames",
    "predict_actions",
    "predict_next_actions",
    "read_actions",
    "rollout",
    "rollout_naive",
    "start",
]
