"""The options that choose how much is computed for an answer; `predict` and `sweep` have the same."""

from __future__ import annotations

import argparse
from dataclasses import replace

from ast_sim.inference.effort import DIALS, MOST_NEWTON_STEPS, Effort, option
from ast_sim.support.argument_types import Parser, add_each, at_least, by_name, read_by
from ast_sim.support.errors import ConfigError
from ast_sim.support.precisions import PRECISIONS

PRECISION = (
    "number format of the factors when the model multiplies: bfloat16 keeps 8 binary digits of each and saves time in"
    " large scenes on some processors (default: float32)"
)
BEYOND = (
    "let the solver continue where Newton steps move a frame by more than this share of its displacement, such as 0.1"
)
EXACT = (
    "after the model, run the solver from its answer (with friction: from rest) until the solver's own stop test holds"
)


def add_effort(parser: Parser, about: str | None = None) -> None:
    """An option for each number of an effort, --solved-beyond, --exact, --precision and --error; `about` is the help of
    all but the last."""
    options = {f"{option(dial)} N": about or text for dial, text in DIALS.items()}
    add_each(parser, options, type=at_least(0))
    add_each(parser, {"--solved-beyond SHARE": about or BEYOND}, type=float)
    parser.add_argument("--exact", action="store_true", help=about or EXACT)
    parser.add_argument("--precision", choices=PRECISIONS, help=about or PRECISION)
    error = (
        "in place of --corrections, --newton-steps and --exact: compute as little as keeps this error in 90 %% of"
        " scenes: of the displacement (2%%) or of another quantity (reaction=5%%, stress=10%%); run `calibrate` first;"
        " may be repeated"
    )
    place = "ast_sim.inference.promises.chosen_effort:parse_error"
    add_each(parser, {"--error E": error}, type=read_by(place), action="append", default=[])


def effort_of(args: argparse.Namespace, default: Effort) -> Effort | None:
    """The effort of the options: a number that is not given is the default one, but Newton steps are made only if their
    number is given, or up to `MOST_NEWTON_STEPS` before the solver. None: no option is given.

    Raises:
        ConfigError: numbers are given for an exact answer.
    """
    numbers = {name: getattr(args, name) for name in (*DIALS, "solved_beyond") if getattr(args, name) is not None}
    if args.exact and numbers:
        raise ConfigError(f"an exact answer needs no numbers: leave {' and '.join(map(option, numbers))} out")
    if "solved_beyond" in numbers:
        numbers = {"newton_steps": MOST_NEWTON_STEPS, "solved": True, **numbers}
    effort = Effort.exact() if args.exact else None
    if numbers:
        effort = replace(default, **{"newton_steps": 0, "solved": False, "solved_beyond": 0.0, **numbers})
    return replace(effort or default, precision=args.precision) if args.precision else effort


def error_of(args: argparse.Namespace) -> dict[str, float] | None:
    """The errors that --error asks for, by quantity; None: none is given.

    Raises:
        ConfigError: two are given for a quantity.
    """
    return by_name("--error", args.error) or None
