from tests.hma_jax.simulator.compiled import shared_programs  # noqa: F401  a fixture
