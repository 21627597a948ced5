"""Python files of the user that the program runs for the functions in them: an axis, policies."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError
from hma_jax.config import require
from hma_jax.runtime import user_code


def find_function(path: Path, signature: str, what: str, page: str) -> Callable[..., Any]:
    """The function of a file, which is run by `run_file`. Raises ConfigError if there is no such function."""
    return function_of(run_file(path, signature, what, page), signature, page)


def function_of(file: types.ModuleType, signature: str, page: str) -> Callable[..., Any]:
    """A function of a file that was run. Raises ConfigError if it has none with that name."""
    found = vars(file).get(signature.partition("(")[0])
    require(callable(found), f"{file.__file__}: has no function {signature} ({page})")
    return found


def run_file(path: Path, signature: str, what: str, page: str) -> types.ModuleType:
    """The file, run as a module. For the error message: `what` the function `signature` in it is for, and the
    documentation `page`. Exceptions of the file itself are not caught. Raises ConfigError if there is no such file.

    It is compiled anew each time: Python's cached bytecode does not notice a change within the same second.
    """
    require(path.is_file(), f"{path}: no such file; {what} a Python file with {signature} ({page})")
    module = types.ModuleType(f"{signature.partition('(')[0]}_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses in the file look up their module there
    exec(compile(path.read_bytes(), path, "exec"), vars(module))
    return module


@contextmanager
def naming_line(path: Path, page: str) -> Iterator[None]:
    """Like `user_code.naming_line`; data errors too have messages of their own."""
    with user_code.naming_line(path, page, DataError):
        yield
