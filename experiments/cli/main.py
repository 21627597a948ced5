"""The program `hma`: its commands, and what an error becomes.

Exit codes are those of `hma_jax.runtime.exits`. `--debug` or HMA_DEBUG=1 shows the traceback of an error.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Sequence

from tyro.extras import SubcommandApp

from experiments.cli import convert, study, tokenizer
from experiments.cli.bench import app as bench
from experiments.cli.check import check
from experiments.cli.compare import compare
from experiments.cli.data import app as data
from experiments.cli.evaluate import evaluate
from experiments.cli.fit import fit
from experiments.cli.generate import generate
from experiments.cli.judge import judge
from experiments.cli.plan import plan
from experiments.cli.play import play
from experiments.cli.tokenize import tokenize
from experiments.cli.train import adapt, train
from experiments.program import PROGRAM
from experiments.progress import errors
from experiments.run_study import TrialsFailed
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit, exit_of_interrupt, terminated_like_interrupted

app = SubcommandApp()
app.command(name="study")(study.study)
app.command(name="sweep")(study.sweep)
app.command(name="tokenize")(tokenize)
app.command(name="train")(train)
app.command(name="adapt")(adapt)
app.command(name="evaluate")(evaluate)
app.command(name="compare")(compare)
app.command(name="report")(study.report)
app.command(name="fit")(fit)
app.command(data.data_app, name="data", help=data.HELP)
app.command(tokenizer.tokenizer_app, name="tokenizer", help=tokenizer.HELP)
app.command(convert.convert_app, name="convert", help=convert.HELP)
app.command(bench.bench_app, name="bench", help=bench.HELP)
app.command(name="plan")(plan)
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
    debug = os.environ.get("HMA_DEBUG", "0") not in ("", "0")
    if "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    if own_process and not debug:
        _silence_background()
    try:
        with terminated_like_interrupted():
            app.cli(
                prog=PROGRAM,
                description="HMA-JAX: scaling studies of an action-conditioned video model over many robots.",
                args=arguments or ["--help"],
            )
            _end_together()
        return Exit.DONE
    except KeyboardInterrupt as request:
        code = exit_of_interrupt(request)
        _say(f"{'stopped by SIGTERM' if code == Exit.STOPPED else 'interrupted'}; the same command goes on from here")
        _end_together(request, code)
        return code
    except Exception as error:  # the boundary of the program
        code = _exit_code(error)
        if debug or code is None:
            _end_together(error, code or Exit.FAILED, show=True)
            raise
        _say(f"error: {_words(error)}")
        _end_together(error, code)
        return code


def _end_together(error: BaseException | None = None, code: int = Exit.DONE, show: bool = False) -> None:
    """With other processes, where there are any: none is left waiting for one that ends."""
    if "hma_jax.runtime.processes" in sys.modules:  # otherwise none was started
        from experiments.cli.hosts import end_together

        end_together(error, code, show)


def _silence_background() -> None:
    """For the rest of this process: reader tasks of a checkpoint that turns out damaged report it in
    pages of their own, from threads and destructors where nothing can catch it, until the very
    end. The error message says it once.
    """
    sys.unraisablehook = lambda _: None
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)


def _exit_code(error: Exception) -> Exit | None:
    """None for what is not the user's business: a bug, shown with its traceback."""
    from data_pipelines.errors import DataError

    if isinstance(error, ConfigError):
        return Exit.REFUSED
    if isinstance(error, (DataError, TrialsFailed, OSError)):
        return Exit.FAILED
    if "jax" in sys.modules:  # otherwise none of these can have been raised
        from hma_jax.training.divergence import DivergedError
        from hma_jax.training.loop import Interrupted

        if isinstance(error, DivergedError):
            return Exit.DIVERGED
        if isinstance(error, Interrupted):
            return error.exit
    return None


def _words(error: Exception) -> str:
    """The message of an error, and what it cannot know: how its advice is followed from here."""
    from data_pipelines.errors import EpisodeError

    if isinstance(error, EpisodeError):
        return f"{error} (Here: --set store.corrupt=skip.)"
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror}; check the path, its permissions and the space on its disk"
    return str(error)


def _say(message: str) -> None:
    errors.print(message, markup=False, soft_wrap=True)

