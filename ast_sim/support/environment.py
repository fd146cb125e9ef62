"""The environment: the variables AST_SIM_..., which are read here alone, and the environment of processes of ours."""

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
