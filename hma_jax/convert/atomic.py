"""Directories that appear whole or not at all, even after a loss of power."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import naming, sync, sync_tree
from hma_jax.runtime.locks import Held, exclusive
from hma_jax.runtime.outputs import writing_to


def require_free(directory: Path) -> None:
    """Raises ConfigError if there is something at `directory` that an output would replace."""
    directory = Path(directory)
    empty = directory.is_dir() and not any(directory.iterdir())
    require(
        empty or not directory.exists(),
        f"{directory} exists already; choose another output directory or remove it",
    )


@contextmanager
def atomic_directory(directory: Path) -> Iterator[Path]:
    """A temporary directory to write into, which is renamed to `directory` (or to its target, if that is a link) when
    the block succeeds. A temporary directory that a killed process left behind is removed.

    Raises ConfigError if something is there already, if nothing can be written there, or while another process writes
    there.
    """
    directory = Path(directory).resolve()
    temporary, lock = (directory.with_name(f".{directory.name}.{kind}") for kind in ("tmp", "lock"))
    with ExitStack() as stack:
        try:
            with writing_to(directory):
                directory.parent.mkdir(parents=True, exist_ok=True)
                stack.enter_context(exclusive(lock, remove=True))
                require_free(directory)
                shutil.rmtree(temporary, ignore_errors=True)
                temporary.mkdir()
        except Held as held:
            raise ConfigError(f"{directory} is being written ({held.who}); choose another output directory") from None
        stack.callback(shutil.rmtree, temporary, ignore_errors=True)
        with naming(directory):
            yield temporary
            sync_tree(temporary)
        os.replace(temporary, directory)
        sync(directory.parent)
