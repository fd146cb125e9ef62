"""The environment: the variables AST_SIM_... and what `torchrun` sets, which are read here alone; the environment of
processes of ours."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from ast_sim.support.errors import ConfigError, warn

# What each variable may be, the default first. The C core reads two of them when it is imported.
VARIABLES = {
    "AST_SIM_BACKEND": ("c", "torch"),
    "AST_SIM_ISA": ("", "base", "avx2", "avx512"),
    "AST_SIM_DEBUG": ("0", "1"),
    "AST_SIM_KEEP_MEMORY": ("1", "0"),
}
BY_TORCHRUN = ("WORLD_SIZE", "RANK", "MASTER_ADDR", "MASTER_PORT")
SINGLE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def variable(name: str) -> str:
    """A variable of ours, or its default where it is empty or not set.

    Raises:
        ConfigError: it has another value than those that it may have.
    """
    known = VARIABLES[name]
    value = os.environ.get(name) or known[0]
    if value not in known:
        raise ConfigError(f"{name}={value}: choose {' or '.join(filter(None, known))}, or unset it")
    return value


def check_variables() -> None:
    """Check all variables of ours, and warn of names that look like ours.

    Raises:
        ConfigError: as `variable`.
    """
    for name in VARIABLES:
        variable(name)
    _warn_of(tuple(name for name in sorted(os.environ) if name.startswith("AST_SIM_") and name not in VARIABLES))


@functools.cache
def _warn_of(names: tuple[str, ...]) -> None:
    """Warn of variables that are none, once in a process."""
    if names:
        warn(f"the environment has {', '.join(names)}; the variables of ast_sim are {', '.join(VARIABLES)}")


def place_among_processes() -> tuple[int, int]:
    """The number of this process among those that train together, and how many they are; 0 and 1 without `torchrun`.

    Raises:
        ConfigError: WORLD_SIZE tells of several processes, and what `torchrun` sets beside it is missing or wrong.
    """
    told = {name: os.environ[name] for name in BY_TORCHRUN if os.environ.get(name)}
    if told.get("WORLD_SIZE", "1") == "1":
        return 0, 1
    numbers = (told.get(name, "") for name in ("RANK", "WORLD_SIZE", "MASTER_PORT"))
    rank, count, port = (int(text) if text.isascii() and text.isdecimal() else -1 for text in numbers)
    if not (0 <= rank < count and 0 <= port < 1 << 16 and "MASTER_ADDR" in told):
        raise ConfigError(
            f"the environment has {', '.join(f'{name}={text}' for name, text in told.items())}: processes that train"
            f" together need {', '.join(BY_TORCHRUN)}: start them by torchrun, or unset WORLD_SIZE"
        )
    return rank, count


def processes_on_machine() -> int:
    """How many processes train together on this machine, as `torchrun` says; 1 without it."""
    text = os.environ.get("LOCAL_WORLD_SIZE", "")
    return max(1, int(text)) if text.isascii() and text.isdecimal() else 1


def c_core():  # the checker infers the module with its types
    """The C core, which reads AST_SIM_ISA and AST_SIM_DEBUG.

    Raises:
        ConfigError: one of them has a value that it cannot have here.
    """
    wanted, _ = variable("AST_SIM_ISA"), variable("AST_SIM_DEBUG")
    try:
        from ast_sim import _C
    except ImportError as error:
        if wanted and "AST_SIM_ISA" in str(error):  # this processor has no such instructions
            raise ConfigError(str(error)) from error
        raise
    return _C


def of_child(**changes: str) -> dict[str, str]:
    """The environment of a process that runs a module of ours: the one here, with changes. The package is found where
    it was imported from here."""
    root = str(Path(__file__).parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, **changes, "PYTHONPATH": path}
