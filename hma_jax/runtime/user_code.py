"""Python code of the user: which code may be run, and errors that name its line, even from inside compiled programs."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import cache_directory

_raised: list[BaseException] = []
"""The last exception that ended a call from a compiled program."""


@contextmanager
def naming_line(path: Path, page: str, *others: type[Exception]) -> Iterator[None]:
    """Turns an exception raised by the file at `path`, or by what it calls, into a ConfigError with the exception's own
    text and the line of the file. Errors of the system, and `others`, keep their own message."""
    try:
        yield
    except (OSError, *others):
        raise
    except Exception as error:  # the boundary of somebody else's code
        syntax = isinstance(error, SyntaxError) and error.filename == str(path)
        lines = [at.lineno for at in traceback.extract_tb(error.__traceback__) if at.filename == str(path)]
        line = error.lineno if syntax else lines[-1] if lines else None
        where = f"{path}, line {line}" if line else str(path)
        if isinstance(error, ConfigError):  # it says what to do
            raise ConfigError(f"{where}: {error}" if line else str(error)) from error
        words = ": ".join(filter(None, (type(error).__name__, error.msg if syntax else str(error))))
        raise ConfigError(
            f"{where}: {words}; correct the file ({page}), or add --debug to see the traceback"
        ) from error


@contextmanager
def called_from_program() -> Iterator[None]:
    """Used around code that a compiled program calls on the host: keeps its exception, of which JAX passes on only the
    text."""
    try:
        yield
    except BaseException as error:  # an interrupt by the user too
        _raised[:] = [error]
        raise


@contextmanager
def raising_as_called() -> Iterator[None]:
    """Used around compiled programs: raises the exception of a call on the host instead of JAX's, whose text is the
    traceback."""
    try:
        yield
    except Exception as error:
        for original in _raised:
            if original is not error and (str(original) or type(original).__name__) in str(error):
                _raised.clear()
                raise original from original.__cause__  # the traceback in the code itself
        raise


def trust(identity: str) -> None:
    """Allows code with this hash to run for this user, in every process. Raises OSError."""
    _trusted(identity).parent.mkdir(parents=True, exist_ok=True)
    _trusted(identity).touch()


def require_trusted(identity: str, code: Path, how: str) -> None:
    """Raises ConfigError, which ends with `how` (how to trust it), for code that this user has neither made nor
    trusted."""
    require(
        _trusted(identity).exists(),
        f"{code} is Python code that would be run, and it was not made a tokenizer here; if you trust it: {how}",
    )


def _trusted(identity: str) -> Path:
    return cache_directory() / "trusted" / identity
