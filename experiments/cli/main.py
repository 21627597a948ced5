"""The program `hma`: its commands. `--debug` or HMA_DEBUG=1 shows the traceback of an error."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from experiments.cli import convert, study, tokenizer
from experiments.cli.bench import app as bench
from experiments.cli.branch import branch
from experiments.cli.check import check
from experiments.cli.compare import compare
from experiments.cli.coord_check import coord_check
from experiments.cli.data import app as data
from experiments.cli.evaluate import evaluate
from experiments.cli.fit import fit
from experiments.cli.generate import generate
from experiments.cli.judge import judge
from experiments.cli.plan import plan
from experiments.cli.play import play
from experiments.cli.status import status
from experiments.cli.tokenize import tokenize
from experiments.cli.train import adapt, train
from experiments.terminal.command_line import Commands
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.program import PROGRAM

BEGIN_ANEW = tuple("compare report status fit convert bench plan coord-check play check branch".split())
"""Commands that keep no unfinished work when they are stopped."""

app = Commands()
app.command(name="study")(study.study)
app.command(name="sweep")(study.sweep)
app.command(name="tokenize")(tokenize)
app.command(name="train")(train)
app.command(name="adapt")(adapt)
app.command(name="branch")(branch)
app.command(name="evaluate")(evaluate)
app.command(name="compare")(compare)
app.command(name="status")(status)
app.command(name="report")(study.report)
app.command(name="fit")(fit)
app.command(data.data_app, name="data", help=data.HELP)
app.command(tokenizer.tokenizer_app, name="tokenizer", help=tokenizer.HELP)
app.command(convert.convert_app, name="convert", help=convert.HELP)
app.command(bench.bench_app, name="bench", help=bench.HELP)
app.command(name="plan")(plan)
app.command(name="coord-check")(coord_check)
app.command(name="play")(play)
app.command(name="check")(check)
app.command(name="generate")(generate)
app.command(name="judge")(judge)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit code; errors become one message on stderr.

    Without `arguments`, those of the process, which is then taken to be this program's own.
    """
    own_process = arguments is None
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    if debug:
        arguments.remove("--debug")

    def work() -> None:
        app.run(
            PROGRAM,
            arguments or ["--help"],
            "HMA-JAX: scaling studies of an action-conditioned video model over many robots.",
        )

    resumes = not set(arguments[:1]) & set(BEGIN_ANEW)
    return exit_code_of(
        work, debug, own_process, arguments=arguments, resumes=resumes, skipping="--set store.corrupt=skip"
    )
