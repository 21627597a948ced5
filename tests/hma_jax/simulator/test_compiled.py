"""When a simulator compiles. The first of its tests' files, whose programs the others then share."""

import jax.monitoring

from hma_jax.simulator.warm_up import warm_up
from tests.hma_jax.simulator.compiled import forget
from tests.hma_jax.simulator.small import chunks_of, simulator, start


def test_nothing_is_compiled_once_an_episode_is_under_way():
    forget(episodes=2)  # what another test compiled would hide what warming up forgets
    sim, compiled = simulator(episodes=2), []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, _, **more: compiled.append(name) if name.endswith("backend_compile_duration") else None
    )

    def everything(frames: int) -> None:
        sim.reset([start(0, frames), start(1, frames)], seeds=frames)
        kept = sim.snapshot()
        for t in range(8):
            sim.step([chunks_of(0, 8)[t], None if t == 3 else chunks_of(1, 8)[t][0]])
        sim.rewind(2)
        sim.branch([1, 1])
        sim.restore(kept)

    told = []
    warm_up(sim, progress=lambda *step: told.append(step))
    assert [(done, total) for done, total, _ in told] == [(i, len(told)) for i in range(len(told))]
    assert sim.counts == (0, 0) and not sim.images.any(), "warming up leaves nothing behind"
    everything(1)
    assert compiled, "the listener hears nothing"
    compiled.clear()
    everything(4)
    everything(9)
    assert not compiled, f"{len(compiled)} programs were compiled again"
