"""The options that choose how much is computed for an answer; `predict` and `sweep` have the same."""

from __future__ import annotations

import argparse
from dataclasses import replace

from ast_sim.inference.effort import DIALS, Effort, option
from ast_sim.support.argument_types import Parser, add_each, at_least, by_name, read_by
from ast_sim.support.errors import ConfigError
from ast_sim.support.precisions import PRECISIONS

PRECISION = (
    "in which the model multiplies: bfloat16 keeps 8 binary digits of each factor and saves time in"
    " large scenes on some processors (default: float32)"
)
EXACT = "let the solver continue from the answer of the run (with friction: from rest) until its stop test holds"


def add_effort(parser: Parser, about: str | None = None) -> None:
    """An option for each number of an effort, --exact and --error; `about` is the help of all but the last."""
    options = {f"{option(dial)} N": about or text for dial, text in DIALS.items()}
    add_each(parser, options, type=at_least(0))
    parser.add_argument("--exact", action="store_true", help=about or EXACT)
    parser.add_argument("--precision", choices=PRECISIONS, help=about or PRECISION)
    error = (
        "instead: the cheapest effort that keeps this error of the displacement, such as 2%%, or of another quantity,"
        " such as reaction=5%% or stress=10%%, in 90 %% of scenes (`calibrate` first); may be repeated"
    )
    place = "ast_sim.inference.promises.chosen_effort:parse_error"
    add_each(parser, {"--error E": error}, type=read_by(place), action="append", default=[])


def effort_of(args: argparse.Namespace, default: Effort) -> Effort | None:
    """The effort of the options: a number that is not given is the default one, but Newton steps are made only if their
    number is given. None: no option is given.

    Raises:
        ConfigError: numbers are given for an exact answer.
    """
    numbers = {dial: getattr(args, dial) for dial in DIALS if getattr(args, dial) is not None}
    if args.exact and numbers:
        raise ConfigError(f"an exact answer needs no numbers: leave {' and '.join(map(option, numbers))} out")
    effort = Effort.exact() if args.exact else None
    if numbers:
        effort = replace(default, **{"newton_steps": 0, "solved": False, **numbers})
    return replace(effort or default, precision=args.precision) if args.precision else effort


def error_of(args: argparse.Namespace) -> dict[str, float] | None:
    """The errors that --error asks for, by quantity; None: none is given.

    Raises:
        ConfigError: two are given for a quantity.
    """
    return by_name("--error", args.error) or None
