"""python -m tests.stress.fuzz --inputs 1000000 [--parser NAME ...]: hostile input for every parser.

Each input may be refused with a DataError or ConfigError that names the file, and nothing else: no other
exception, no end of the process, at most SECONDS of computing, at most 64 MB and ten times the input of
memory. Inputs come from `mutate`; where atheris is installed (the extra `fuzz`), it keeps those that reach new lines
of the program and goes on from them. The count so far and the kept inputs lie in --state, so that a run
of hours can be made in pieces (--seconds).
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from data_pipelines.errors import DataError
from hma_jax.config import ConfigError
from tests.stress.mutate import blow_up, make_input
from tests.stress.targets import TARGETS, Target, make_target

SECONDS = 5.0
"""Of computing, for one input."""

EXTRA_MEMORY = 64 * 2**20
PAGE = os.sysconf("SC_PAGE_SIZE")
SAVE_EVERY, BLOW_UP_EVERY = 1000, 29_999


class Hang(BaseException):
    """Not an Exception, so that no parser takes it for damage."""


class Checker:
    """Feeds inputs to one parser and writes down each that breaks a promise, once per place in the program."""

    def __init__(self, target: Target, failures: Path | None = None):
        self.target, self.failures = target, failures
        self.count = self.accepted = 0
        self.found: dict[str, str] = {}
        signal.signal(signal.SIGVTALRM, _hang)

    def __call__(self, data: bytes) -> None:
        self.count += 1
        before, resident = _peak(), _resident()  # what made the input may have taken more than what reads it
        signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
        try:
            self.target.parse(data)
            self.accepted += 1
        except (DataError, ConfigError) as error:
            if str(self.target.root) not in str(error):
                self._note("a rejection that names no file", error, data)
            elif len(str(error)) > 4000:
                self._note("a rejection of more than 4000 characters", error, data)
        except (Exception, Hang) as error:  # what is looked for
            self._note(type(error).__name__, error, data)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        peak = _peak()
        if peak > before and peak - resident > EXTRA_MEMORY + 10 * len(data):
            self._note(f"{(peak - resident) / 2**20:.0f} MB for {len(data)} bytes", None, data)

    def _note(self, what: str, error: BaseException | None, data: bytes) -> None:
        frames = traceback.extract_tb(error.__traceback__) if error else []
        ours = [f for f in frames if "data_pipelines" in f.filename or "hma_jax" in f.filename] or frames
        place = f"{what.split(' MB')[0]} at {Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else what
        if place in self.found or len(self.found) > 50:
            return
        self.found[place] = f"{what}: {str(error)[:300] if error else ''}"
        if self.failures is not None:
            self.failures.mkdir(parents=True, exist_ok=True)
            name = hashlib.sha256(place.encode()).hexdigest()[:8]
            (self.failures / name).write_bytes(data)


def fuzz(target: Target, inputs: int, seed: int = 0, failures: Path | None = None, start: int = 0) -> Checker:
    """Inputs `start` to `start + inputs` of the series `seed`, from the target's seeds alone."""
    check = Checker(target, failures)
    for data in target.seeds if start == 0 else ():
        check(data)
    for n in range(start, start + inputs):
        check(make_input(random.Random(f"{seed}:{n}"), target.seeds, target.structured))
    return check


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _resident() -> int:
    with open("/proc/self/statm", "rb") as file:
        return int(file.read().split()[1]) * PAGE


def _hang(*_) -> None:
    raise Hang(f"more than {SECONDS} s")


# --- runs of hours ----------------------------------------------------------------------------


def _work(name: str, inputs: int, seconds: float, state: Path) -> None:
    """One piece of one parser's run, in a process of its own; the record is written as it goes on."""
    home, record = state / name, state / f"{name}.json"
    (home / "kept").mkdir(parents=True, exist_ok=True)
    done = (
        json.loads(record.read_text()) if record.exists() else {"inputs": 0, "accepted": 0, "seconds": 0, "found": {}}
    )
    scratch = Path(tempfile.mkdtemp(prefix=f"hma-fuzz-{name}-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    target = make_target(name, scratch)
    check = Checker(target, home / "failures")
    begin, last = time.perf_counter(), inputs - done["inputs"]

    def save() -> None:
        spent = time.perf_counter() - begin
        now = {
            "inputs": done["inputs"] + check.count,
            "accepted": done["accepted"] + check.accepted,
            "seconds": round(done["seconds"] + spent, 1),
            "found": done["found"] | check.found,
        }
        record.write_text(json.dumps(now, indent=1))

    def one(data: bytes) -> None:
        check(data)
        if check.count % BLOW_UP_EVERY == 0:  # not left to libFuzzer, which would go on from large inputs
            check(blow_up(random.Random(check.count), data))
        if check.count % SAVE_EVERY == 0 or check.count >= last:
            save()
            if check.count >= last or time.perf_counter() - begin > seconds:
                os._exit(0)  # libFuzzer has no other end

    if last <= 0:
        return
    if importlib.util.find_spec("atheris") is None:
        for n in range(last):  # `one` ends the process
            one(make_input(random.Random(f"{name}:{done['inputs'] + n}"), target.seeds, target.structured))
    import atheris

    for n, seed in enumerate(target.seeds):
        (home / "kept" / f"seed-{n}").write_bytes(seed)

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.4:
            return atheris.Mutate(data, most)
        return make_input(rng, [data, rng.choice(target.seeds)], target.structured, large=0.0)[:most]

    _instrument(atheris)
    atheris.Setup(
        [sys.argv[0], "-timeout=1000", "-rss_limit_mb=0", "-max_len=16384", "-print_final_stats=0", "-verbosity=0",
         f"-seed={done['inputs'] + 1}", f"-artifact_prefix={home}/", str(home / "kept")],
        one, custom_mutator=mutate,
    )  # fmt: skip
    atheris.Fuzz()


def _instrument(atheris) -> None:
    """The parsers' functions report the lines that they reach."""
    for module in list(sys.modules.values()):
        name = getattr(module, "__name__", "")
        if not name.startswith(("data_pipelines", "hma_jax.config")):
            continue
        for key, value in list(vars(module).items()):
            if callable(value) and getattr(value, "__module__", "") == name and hasattr(value, "__code__"):
                setattr(module, key, atheris.instrument_func(value))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="inputs per parser, over all runs")
    parser.add_argument("--parser", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seconds", type=float, default=1e9, help="stop each parser's piece after this time")
    parser.add_argument("--state", type=Path, default=Path("runs/fuzz"), help="counts, kept inputs, failures")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        _work(args.work, args.inputs, args.seconds, args.state)
        return
    wrong = 0
    for name in args.parser:
        command = [sys.executable, "-m", "tests.stress.fuzz", "--work", name, "--inputs", str(args.inputs)]
        args.state.mkdir(parents=True, exist_ok=True)
        with open(args.state / f"{name}.log", "ab") as log:
            ended = subprocess.run(
                [*command, "--seconds", str(args.seconds), "--state", str(args.state)], stdout=log, stderr=log
            )
        record = args.state / f"{name}.json"
        done = (
            json.loads(record.read_text())
            if record.exists()
            else {"inputs": 0, "accepted": 0, "seconds": 0, "found": {}}
        )
        wrong += len(done["found"]) + (ended.returncode != 0)
        rate = done["inputs"] / max(done["seconds"], 1e-9)
        print(f"{name}: {done['inputs']:,} inputs, {done['accepted']:,} accepted, {rate:,.0f} per second", flush=True)
        if ended.returncode:
            print(f"  the process ended with {ended.returncode}: see {args.state / name}.log")
        for place, message in done["found"].items():
            print(f"  {place}: {message}")
    engine = "atheris, coverage-guided" if importlib.util.find_spec("atheris") else "mutation alone"
    print(f"{engine}: {wrong} broken promises")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
