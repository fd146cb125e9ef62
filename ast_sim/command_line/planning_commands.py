"""The command that looks ahead: plan."""

from __future__ import annotations

import argparse

from ast_sim.command_line.commands import refuse
from ast_sim.support.argument_types import Parser, add_each, at_least, path


def add_plan(plan: Parser) -> None:
    """The arguments of `plan`."""
    about = "dataset with training and validation scenes (.h5), or the specification of an assembly (.toml)"
    plan.add_argument("data", type=path, metavar="DATA_OR_SPEC", help=about)
    add_each(plan, {"--minutes M": "length of the planned training in minutes"}, type=float, required=True)
    about = "folder for the trials; a second call continues with the trials that are there"
    add_each(plan, {"--out FOLDER": about}, type=path, required=True)
    train = plan.add_argument_group("if DATA_OR_SPEC is a dataset")
    add_each(train, {"--model M": "as for train", "--preset P": "as for train"})
    add_each(train, {"--state NAME": "as for train", "--set k=v": "as for train"}, action="append", default=[])
    spec = plan.add_argument_group("if DATA_OR_SPEC is the specification of an assembly")
    sizes = {
        "--nodes N": "approximate number of nodes (default: the sizes in the specification decide)",
        "--frames N": "number of frames of a scene",
    }
    add_each(spec, sizes, type=at_least(1))
    spec.add_argument("--solver", choices=("own", "calculix"), help="as for generate")
    plan.set_defaults(of_data=(train,), of_spec=(spec,))


def plan(args: argparse.Namespace) -> None:
    """Forecast by short trials the error that a training will reach, or when a model of a specification pays."""
    from ast_sim import keep_memory
    from ast_sim.planning.plan import planned
    from ast_sim.planning.worth import worth
    from ast_sim.training.configure import configure

    keep_memory()
    if args.data.suffix == ".toml":
        refuse(args, args.of_data, f"{args.data}, which is a specification")
        print(worth(args.data, args.out, args.minutes, nodes=args.nodes, frames=args.frames, solver=args.solver))
        return
    refuse(args, args.of_spec, f"{args.data}, which is no specification")
    changes = {"model.state": tuple(args.state)} if args.state else {}
    config = configure(args.data, args.preset, args.set, args.model, changes=changes)
    print(planned(config, args.out, args.minutes, args.preset or "tiny", args.command_line))
