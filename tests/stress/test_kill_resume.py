"""The stress program, small: every subject is killed, and what it leaves is compared."""

from __future__ import annotations

import pytest

from tests.stress import kill_resume
from tests.stress.kill_resume import Stress


@pytest.mark.slow
def test_kills_leave_no_trace_and_the_program_itself_goes_on(tmp_path, capsys):
    kills = ["--seed", "1", "--state", str(tmp_path)]
    assert kill_resume.main(["--kills", "4", *kills]) == 0
    first = capsys.readouterr().out
    assert "4 of 4 kills left no trace" in first and first.count("training") >= 2, first
    rounds = Stress(tmp_path, 4, 1).rounds
    assert kill_resume.main(["--kills", "5", *kills]) == 0  # one more, as if it had been killed itself
    assert Stress(tmp_path, 5, 1).rounds[: len(rounds)] == rounds
    assert "5 of 5 kills left no trace" in capsys.readouterr().out
