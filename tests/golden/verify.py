"""python -m tests.golden.verify CASE_DIR...: compares this implementation with reference cases.

Any folder of the format is taken, whatever its sizes, robots and seeds; `case.json` says its kind. It may hold some
of the outputs of its kind only: images of any size, or only ids to decode; schedules at any points; parameters after
training whole, as changes or as norms (`final`, `final_norm`, `final_change`, `final_change_norm`), with muP or
without. Every output is compared, or named as not compared; the exit code is 1 on any failure.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.golden import continuous, data, discrete, discrete_actions, tables, tokenizers, training
from tests.golden.case import Case

KINDS: dict[str, Callable[[Case], None]] = {
    "discrete_logits": discrete.check_logits,
    "discrete_loss": discrete.check_loss,
    "discrete_generation": discrete.check_generation,
    "discrete_joint": discrete_actions.check_joint,
    "discrete_train": training.check_train_steps,
    "mar_forward": continuous.check_forward,
    "mar_loss": continuous.check_loss,
    "mar_generation": continuous.check_generation,
    "mar_joint": continuous.check_joint,
    "key_shapes": data.check_key_shapes,
    "tables": tables.check_tables,
    "metrics": data.check_metrics,
    "collators": data.check_collators,
    "windows": data.check_windows,
    "tokenizer": tokenizers.check_magvit2,
    "vae": tokenizers.check_vae,
    "vae_decoder": tokenizers.check_vae_decoder,
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden.verify", description=__doc__)
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE_DIR")
    options = parser.parse_args(arguments)
    failed = 0
    for folder in options.cases:
        case = Case(folder)
        kind = kind_of(case)
        print(f"{case.name}: {kind}")
        if kind not in KINDS:
            print(f"  FAIL unknown; known kinds are {', '.join(KINDS)}")
            failed += 1
        else:
            failed += not verify(case, kind)
    count = len(options.cases)
    print(f"{count} cases: {count - failed} good, {failed} failed")
    return 1 if failed else 0


def verify(case: Case, kind: str) -> bool:
    """Runs a case and prints what it finds."""
    try:
        KINDS[kind](case)
    except Exception:  # the boundary of the program: the other cases are still to be run
        traceback.print_exc(file=sys.stdout)
        print("  FAIL the comparison broke off")
        return False
    for finding in case.findings:
        print(finding)
    left = case.unchecked()
    if left:
        print(f"  FAIL not compared: {', '.join(left)}")
    good, bad = (sum(finding.good is verdict for finding in case.findings) for verdict in (True, False))
    print(f"  {good} comparisons good, {bad + len(left)} bad")
    return good > 0 and not bad and not left


def kind_of(case: Case) -> str:
    """As the case says, or by the file that only one kind has."""
    if not case.folder.is_dir():
        return "no folder"
    if "kind" in case.info:
        return case.info["kind"]
    if {"discrete", "continuous"} <= case.settings.keys():
        return "collators"
    marks = {"parameter_counts": "key_shapes", "outputs": "metrics", "windows": "windows"}
    for name, kind in marks.items():
        if (case.folder / f"{name}.json").exists():
            return kind
    known = any((case.folder / f"{name}.json").exists() for name in tables.TABLES)
    return "tables" if known else "unknown"


if __name__ == "__main__":
    sys.exit(main())
