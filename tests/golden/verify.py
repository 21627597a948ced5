"""python -m tests.golden.verify CASE_DIR...: compares this implementation with reference cases.

Any folder of the format is taken, whatever its sizes, robots and seeds; `case.json` says its kind.
Every output is compared, or named as not compared; the exit code is 1 on any failure.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hma_jax.config import ConfigError
from tests.golden import continuous, discrete
from tests.golden.case import Case

KINDS: dict[str, Callable[[Case], None]] = {
    "discrete_logits": discrete.check_logits,
    "discrete_loss": discrete.check_loss,
    "discrete_generation": discrete.check_generation,
    "discrete_joint": discrete.check_joint,
    "discrete_train": discrete.check_train_steps,
    "mar_forward": continuous.check_forward,
    "mar_loss": continuous.check_loss,
    "mar_generation": continuous.check_generation,
    "mar_joint": continuous.check_joint,
}

NOT_SUPPORTED = ("tokenizer", "vae", "vae_decoder")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden.verify", description=__doc__)
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE_DIR")
    parser.add_argument(
        "--skip-unsupported", action="store_true", help="do not fail on cases of a kind that is not supported yet"
    )
    options = parser.parse_args(arguments)
    failed = skipped = 0
    for folder in options.cases:
        case = Case(folder)
        kind = kind_of(case)
        if kind not in KINDS:
            print(f"{case.name}: {kind}: not supported yet")
            skipped += 1
            continue
        print(f"{case.name}: {kind}")
        good = verify(case, kind)
        failed += not good
    count = len(options.cases)
    print(f"{count} cases: {count - failed - skipped} good, {failed} failed, {skipped} not supported")
    return 1 if failed or (skipped and not options.skip_unsupported) else 0


def verify(case: Case, kind: str) -> bool:
    """Runs a case and prints what it finds."""
    try:
        KINDS[kind](case)
    except (ConfigError, KeyError) as error:
        print(f"  FAIL {type(error).__name__}: {error}")
        return False
    for finding in case.findings:
        print(finding)
    left = case.unchecked()
    if left:
        print(f"  FAIL not checked: {', '.join(left)}")
    bad = sum(not finding.good for finding in case.findings)
    print(f"  {len(case.findings) - bad} of {len(case.findings)} comparisons good")
    return not bad and not left and bool(case.findings)


def kind_of(case: Case) -> str:
    return case.info.get("kind", "unknown")


if __name__ == "__main__":
    sys.exit(main())
