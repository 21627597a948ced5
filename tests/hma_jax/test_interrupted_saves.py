"""A save that does not come to its end is never the latest, and the next one of the same step is made."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from orbax.checkpoint._src.path.atomicity import AtomicRenameTemporaryPath

from hma_jax.training.checkpoints import Checkpoints, SaveError
from hma_jax.training.loop import FitResult, LoopOptions
from hma_jax.training.reading import find_damage, list_steps
from tests.toy import fit_toy, toy_state

EVERY_TWO = LoopOptions(checkpoint_every=2, log_every=1)
EVERY_TWO_KEEP_ONE = LoopOptions(checkpoint_every=2, log_every=1, keep_checkpoints=1)


@pytest.fixture
def dies_in_save(monkeypatch: pytest.MonkeyPatch):
    """The save of a step ends before it gets its name: everything is written, and lies under a temporary one."""
    real = AtomicRenameTemporaryPath.finalize

    def at(step: int) -> None:
        async def finalize(self, *arguments, **options):
            if self.get_final().name == f"{step}.unfinished":
                raise OSError(28, "No space left on device")
            await real(self, *arguments, **options)

        monkeypatch.setattr(AtomicRenameTemporaryPath, "finalize", finalize)

    return at


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> FitResult:
    """Eight steps that nothing interrupted."""
    return fit_toy(tmp_path_factory.mktemp("whole"), 8, options=LoopOptions(log_every=1))


@pytest.mark.parametrize("options", [EVERY_TWO, EVERY_TWO_KEEP_ONE], ids=["two kept", "one kept"])
def test_a_death_inside_a_save_falls_back_to_the_checkpoint_before(
    options, whole: FitResult, tmp_path: Path, dies_in_save, monkeypatch
):
    run, checkpoints = tmp_path / "run", tmp_path / "run" / "checkpoints"
    dies_in_save(6)
    with pytest.raises(SaveError, match="step 6 could not be written .* it continues from step 4, the last complete"):
        fit_toy(run, 8, options=options)
    assert list_steps(checkpoints)[-1] == 4 and find_damage(checkpoints / "4") is None
    assert [p.name for p in checkpoints.iterdir() if not p.name.isdigit()], "nothing was left half-written"
    monkeypatch.undo()
    resumed = fit_toy(run, 8, options=options)
    assert resumed.resumed_from == 4
    kept = options.keep_checkpoints
    assert sorted(p.name for p in checkpoints.iterdir()) == ["6", "8"][-kept:], (
        "step 6 was skipped, or remains lie about"
    )
    assert resumed.losses == whole.losses
    for a, b in zip(jax.tree.leaves(resumed.state), jax.tree.leaves(whole.state), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_the_same_step_is_saved_again_by_the_process_whose_save_failed(tmp_path: Path, dies_in_save, monkeypatch):
    with Checkpoints(tmp_path, {"toy": 1}) as checkpoints:
        checkpoints.save(2, toy_state())
        checkpoints.wait()
        dies_in_save(4)
        checkpoints.save(4, toy_state())
        with pytest.raises(SaveError, match="step 4"):
            checkpoints.wait()
        assert checkpoints.latest_step == 2
        monkeypatch.undo()
        checkpoints.save(4, toy_state())
        checkpoints.wait()
        assert checkpoints.latest_step == 4 and find_damage(tmp_path / "4") is None


def test_a_directory_that_vanishes_keeps_what_it_had_and_is_not_made_anew(tmp_path: Path):
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"

    def vanish(step: int, steps: int, values: dict) -> None:
        if step == 3:
            while not (run / "checkpoints" / "2" / "sha256.json").exists():
                pass  # it is saved in the background
            time.sleep(0.2)  # that file's directory is synchronised after it
            run.rename(elsewhere)

    with pytest.raises(SaveError, match=f"{run} was removed or replaced, so nothing was saved at step 4. Restore it"):
        fit_toy(run, 8, options=EVERY_TWO, progress=vanish)
    assert not run.exists() and list_steps(elsewhere / "checkpoints") == [2]
    shutil.move(elsewhere, run)
    assert fit_toy(run, 8, options=EVERY_TWO).resumed_from == 2
