"""Python files of the user that the program runs for the functions in them: an axis, policies."""

from __future__ import annotations

import sys
import traceback
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError
from hma_jax.config import ConfigError, require


def find_function(path: Path, signature: str, what: str, page: str) -> Callable[..., Any]:
    """The function of a file, which is run as `run_file` says. Raises ConfigError where there is no such function."""
    return function_of(run_file(path, signature, what, page), signature, page)


def function_of(file: types.ModuleType, signature: str, page: str) -> Callable[..., Any]:
    """A function of a file that was run. Raises ConfigError where it has none of that name."""
    found = vars(file).get(signature.partition("(")[0])
    require(callable(found), f"{file.__file__}: has no function {signature} ({page})")
    return found


def run_file(path: Path, signature: str, what: str, page: str) -> types.ModuleType:
    """The file, run as a module; `what` it has the function `signature` for, and the `page` that says so, are of the
    message. What the file raises is its author's, and not caught. Raises ConfigError where there is no such file.

    Compiled anew each time: Python's cached bytecode cannot tell a file from what it was in the same second.
    """
    require(path.is_file(), f"{path}: no such file; {what} a Python file with {signature} ({page})")
    module = types.ModuleType(f"{signature.partition('(')[0]}_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses of the file look themselves up there
    exec(compile(path.read_bytes(), path, "exec"), vars(module))
    return module


@contextmanager
def naming_line(path: Path, page: str) -> Iterator[None]:
    """What the file at `path`, or what it calls, raises becomes a ConfigError in the exception's own words that names
    the line of the file. Errors of data and of the system have a message of their own."""
    try:
        yield
    except (DataError, OSError):
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
