"""The command line that experiments share: options from a dataclass, a compilation cache, errors in one line."""

from __future__ import annotations

import pathlib
import sys
import typing
from collections.abc import Callable, Sequence

import jax
import tyro


class Options(typing.Protocol):
    """Arguments of an experiment: at least the folder under which results go."""

    out: pathlib.Path


Args = typing.TypeVar("Args", bound=Options)


def run(
    work: Callable[[Args], typing.Any],
    options: type[Args],
    module: str,
    description: str | None,
    argv: Sequence[str] | None = None,
) -> int:
    """`work` with options as `python -m module` was given them; the exit status. Errors that a user can mend are
    printed, not traced."""
    args = tyro.cli(options, prog=f"python -m {module}", args=argv, description=description)
    jax.config.update("jax_compilation_cache_dir", str(args.out.absolute() / ".jax_cache"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    try:
        work(args)
    except (ValueError, FloatingPointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted: run the same command to go on", file=sys.stderr)
        return 130
    return 0
