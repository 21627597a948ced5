"""One attempt at a trial in a child process of an engine's process (Slurm's or Ray's), on whichever machine it runs.

The child's memory, signals and accelerators are its own, and it ends with this process however that ends. The
engine's SIGTERM is handed on as SIGINT: some engines send it to the child too, and a trial takes the second one
of a kind for impatience.
"""

from __future__ import annotations

import secrets
import signal
import subprocess
import threading
import time
from pathlib import Path

from experiments.running.attempts import OUTPUT
from experiments.running.children import child_environment
from experiments.running.launchers.base import GRACE_SECONDS, Command
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.files import write_file

POLL_SECONDS = 0.1
"""Seconds between two checks of whether the child has ended, or should end."""

WANTED_SECONDS = 1.0
"""Seconds between two checks of whether the attempt is still wanted."""

WANTED = "wanted"
"""A file in the trial's directory with the token of the one attempt that may run: any other attempt stops, and one that
an earlier command left in the queue does not begin."""


def unwant(directory: Path) -> None:
    """Asks a trial's attempt to stop, for engines whose own request does not always arrive."""
    (directory / WANTED).unlink(missing_ok=True)


class Attempt:
    """`directory` is the trial's, `cache` that of compiled programs; both are on the shared disk. `accelerator`: the
    kind that it is given, if any; `grace`: seconds to save. The newest attempt made for a directory is the one that is
    wanted."""

    def __init__(
        self, directory: Path, cache: Path, command: Command, accelerator: str = "", grace: float = GRACE_SECONDS
    ):
        self.directory, self.cache, self.command, self.grace = directory, cache, command, grace
        self.accelerator, self.token = accelerator, secrets.token_hex(4)
        write_file(directory / WANTED, self.token)
        self._child: subprocess.Popen | None = None
        self._code: int | None = None
        self._stop_requested = False

    def __getstate__(self) -> dict[str, object]:
        return vars(self) | {"_child": None, "_code": None, "_stop_requested": False}

    def run(self) -> int:
        """Runs the attempt and returns its exit code, as in `subprocess`."""
        if self.directory.is_dir() and not self._is_wanted():  # without the shared disk, the code below fails
            return Exit.STOPPED
        with open(self.directory / OUTPUT, "a") as output:
            self._child = subprocess.Popen(
                self.command(self.directory),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=child_environment(self.cache, accelerator=self.accelerator),
                start_new_session=True,  # signals come through here, once
            )
        # Engines stop us by calls from signal handlers in this thread. It must hold no lock then, such as those of
        # `subprocess`, so another thread waits for the child.
        threading.Thread(target=self._wait, daemon=True).start()
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, lambda *_: self._request_stop())
        try:
            while self._code is None and self._is_wanted():
                until = time.monotonic() + WANTED_SECONDS
                while self._code is None and time.monotonic() < until:
                    time.sleep(POLL_SECONDS)
            self.end()
            return self._code
        finally:  # the engine interrupts the call
            self.end()

    def _is_wanted(self) -> bool:
        try:
            return (self.directory / WANTED).read_text() == self.token
        except FileNotFoundError:
            return False
        except OSError:  # a shared disk that does not answer for a while
            return True

    def _wait(self) -> None:
        self._code = self._child.wait()

    def _request_stop(self) -> None:
        if not self._stop_requested:  # the engine may ask by a signal, by interrupting the call and by the file
            self._stop_requested = True
            self._child.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Asks the child to save and waits until it has ended; kills it after the grace period."""
        if self._code is not None:
            return
        self._request_stop()
        deadline = time.monotonic() + self.grace
        while self._code is None and time.monotonic() < deadline:
            time.sleep(POLL_SECONDS)
        if self._code is None:
            self._child.kill()
        while self._code is None:
            time.sleep(POLL_SECONDS)
