"""Where the program starts: before anything large is imported, it sets how the process manages memory."""

import faulthandler
import sys

from experiments.terminal.program import is_program, prepare_output
from hma_jax.runtime.exits import exit_of_interrupt, sigterm_as_interrupt
from hma_jax.runtime.host_memory import collect_rarely, restart_keeping_pages


def start() -> None:
    prepare_output()
    faulthandler.enable()  # shows what each thread did if a library ends the process by a signal
    own_process = is_program()
    if own_process:
        restart_keeping_pages()
    collect_rarely()
    try:
        with sigterm_as_interrupt():
            from experiments.cli.main import main

            code = main(None if own_process else sys.argv[1:])
    except KeyboardInterrupt as request:
        code = exit_of_interrupt(request)
    sys.exit(code)
