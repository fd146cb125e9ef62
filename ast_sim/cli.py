"""The command line: `ast-sim COMMAND`. Errors that a user can act on are one line on stderr and exit code 2.

Everything heavy is imported by the command that needs it, so that help is immediate.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import warnings
from pathlib import Path
from typing import Any, NoReturn

from ast_sim import __version__
from ast_sim.errors import AstSimError, ConfigError, DatasetError, RolloutError


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _TrainParser(_Parser):
    """Its help ends with every setting that `--set` knows; these are imported only then."""

    def format_help(self) -> str:
        from ast_sim import config
        from ast_sim.models import MODELS
        from ast_sim.run import TrainConfig

        lines = [super().format_help(), "settings for --set, and their defaults:"]
        groups = [("training", "train.", TrainConfig), *((n, "model.", m.config) for n, m in MODELS.items())]
        for title, prefix, settings in groups:
            presets = f", presets {', '.join(MODELS[title].presets)}" if title in MODELS else ""
            lines += ["", f"{title}{presets}:"]
            for setting in config.settings(settings):
                lines.append(f"  {prefix}{setting.key}={setting.default}  ({setting.type})\n        {setting.help}")
        return "\n".join(lines) + "\n"


class _GenerateParser(_Parser):
    """Its help ends with a line for every family."""

    def format_help(self) -> str:
        from ast_sim.simulate.families import FAMILIES

        lines = [super().format_help(), "families:"]
        for name, family in FAMILIES.items():
            options = "".join(f" --{option}" for option in family.options)
            lines.append(f"  {name:17}{family.about}{f' ({options.strip()})' if options else ''}")
        return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    args = _build_parser().parse_args(argv)
    args.command_line = shlex.join(["ast-sim", *(sys.argv[1:] if argv is None else argv)])
    warnings.showwarning = _show_warning
    try:
        args.run(args)
        sys.stdout.flush()
        return 0
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of our output has gone; what Python flushes at exit must not complain either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (AstSimError, OSError) as error:
        if args.debug:
            raise
        print(f"ast-sim {args.command}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _show_warning(message: Warning | str, *_: Any) -> None:
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def _build_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="ast-sim", description="Learned simulation of deforming bodies in contact.")
    parser.add_argument("--version", action="version", version=f"ast_sim {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Any, help: str, kind: type[_Parser] = _Parser) -> _Parser:
        commands._parser_class = kind
        sub = commands.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        sub.set_defaults(run=run)
        return sub

    demo = command("demo", _demo, "generate a small dataset, train on it, roll out its test scenes, write a report")
    demo.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for everything (demo)")
    demo.add_argument("--quick", action="store_true", help="fewer scenes and steps: 90 seconds on 2 cores")
    demo.add_argument("--seed", type=_at_least(0), default=0, help="of scenes and training (0)")

    about = "simulate scenes with the bundled contact FEM; restarts where it stopped"
    generate = command("generate", _generate, about, _GenerateParser)
    generate.add_argument("family", metavar="FAMILY", help="kind of scenes, see below")
    generate.add_argument("--out", type=Path, required=True, metavar="FILE", help="dataset to write (.h5)")
    generate.add_argument("--count", type=_at_least(1), required=True, metavar="N", help="training scenes")
    generate.add_argument("--valid", type=_at_least(0), metavar="N", help="validation scenes (a tenth of N)")
    generate.add_argument("--test", type=_at_least(0), metavar="N", help="test scenes (a tenth of N)")
    generate.add_argument("--nodes", type=_at_least(1), metavar="N", help="nodes of a scene, about")
    generate.add_argument("--frames", type=_at_least(1), metavar="N", help="frames of a scene")
    generate.add_argument("--seed", type=_at_least(0), default=0, help="the scenes follow from it (0)")
    generate.add_argument("--solver", choices=("own", "calculix"), help="CalculiX in place of the bundled FEM")
    generate.add_argument("--parts", type=Path, metavar="PATH", help="own parts: a STEP, STL or mesh file, or a folder")
    where = generate.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_at_least(1), metavar="W", help="processes (one a core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers solve, as tcp://host:8786")

    _add_convert(command("convert", _convert, "import simulations (PVD, VTU) or MeshGraphNets data (TFRecord)"))

    info = command("info", _info, "tell what is in a dataset or a run, and check it")
    info.add_argument("path", type=Path, metavar="FILE_OR_RUN")
    info.add_argument("--json", action="store_true", help="as JSON")

    train = command("train", _train, "train a model", _TrainParser)
    train.add_argument("data", metavar="DATA", nargs="?", type=Path, help="dataset; not needed with --resume")
    train.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder")
    train.add_argument("--model", metavar="M", help="which model, see below (ast)")
    train.add_argument("--preset", metavar="P", help="settings to start from (tiny)")
    train.add_argument("--set", action="append", default=[], metavar="k=v", help="change a setting; may be repeated")
    train.add_argument("--resume", action="store_true", help="go on after the last checkpoint, if there is one")
    train.add_argument(
        "--profile", type=_at_least(1), metavar="N", help="print where the time of N steps goes, and end"
    )

    evaluate = command("evaluate", _evaluate, "measure a run's errors and speed on a dataset")
    evaluate.add_argument("run_folder", type=Path, metavar="RUN")
    evaluate.add_argument("data", type=Path, metavar="DATA")
    evaluate.add_argument("--split", choices=("train", "valid", "test"), default="test")
    evaluate.add_argument("--json", type=Path, metavar="FILE", help="write all figures there too")

    rollout = command("rollout", _rollout, "predict a trajectory from its first frame")
    rollout.add_argument("run_folder", type=Path, metavar="RUN")
    rollout.add_argument("data", type=Path, metavar="DATA")
    rollout.add_argument("--split", choices=("train", "valid", "test"), default="test")
    rollout.add_argument("--index", type=_at_least(0), required=True, metavar="I", help="which trajectory")
    rollout.add_argument("--out", type=Path, required=True, metavar="FILE", help="ends in .h5, .pvd or .vtkhdf")

    report = command("report", _report, "write one page that shows runs (moving scenes, errors) or a dataset")
    report.add_argument("shown", type=Path, nargs="+", metavar="RUN_OR_DATA", help="run folders, or one dataset (.h5)")
    report.add_argument("--out", type=Path, required=True, metavar="FILE.html")
    report.add_argument("--data", type=Path, metavar="DATA", help="dataset (the one that each run was trained on)")
    return parser


def _add_convert(convert: _Parser) -> None:
    convert.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="a simulation (.pvd, or a folder of .vtu), a folder of several, or one of meta.json and .tfrecord files",
    )
    convert.add_argument("--out", type=Path, required=True, metavar="FILE", help="dataset to write (.h5)")
    fields = convert.add_argument_group("names of the fields in .vtu files")
    for name, help in (
        ("displacement", "point field, from rest; without one the points themselves move"),
        ("stress", "von Mises stress, a point or a cell field"),
        ("node-type", "point field: 0 normal, 1 obstacle, 3 handle"),
        ("obstacle", "point field, not zero at the nodes of obstacles"),
        ("handle", "point field, not zero at nodes whose motion is prescribed"),
        ("body", "point field that numbers the bodies"),
    ):
        fields.add_argument(f"--{name}", metavar="NAME", help=help)
    fields.add_argument("--material", nargs="+", default=[], metavar="NAME", help="cell fields with one number each")
    kind = convert.add_argument_group("what a dataset of .vtu files says of itself")
    kind.add_argument("--shares", nargs=3, type=float, default=[0.8, 0.1, 0.1], metavar=("TRAIN", "VALID", "TEST"))
    kind.add_argument("--seed", type=_at_least(0), default=0, help="of the draw for the splits (0)")
    kind.add_argument("--dynamic", action="store_true", help="inertia matters: the acceleration is predicted")
    kind.add_argument("--contact-radius", type=float, default=0.0, metavar="R")
    kind.add_argument("--time-step", type=float, default=0.0, metavar="SECONDS")
    kind.add_argument("--length-unit", default="m", metavar="UNIT")
    records = convert.add_argument_group("what is taken of .tfrecord files (meta.json says the rest)")
    records.add_argument("--split", nargs="+", choices=("train", "valid", "test"), help="these files only (all)")
    records.add_argument("--limit", type=_at_least(1), metavar="N", help="the first N trajectories of each file (all)")
    records.add_argument("--every", type=_at_least(1), default=1, metavar="K", help="every K-th frame (1)")
    convert.set_defaults(of_series=(fields, kind), of_records=(records,))


def _at_least(least: int) -> Any:
    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is below {least}")
        return value

    number.__name__ = "whole number"
    return number


def _demo(args: argparse.Namespace) -> None:
    from ast_sim import keep_memory
    from ast_sim.demo import demo

    keep_memory()
    demo(args.out, quick=args.quick, seed=args.seed)


def _generate(args: argparse.Namespace) -> None:
    from ast_sim.simulate.generate import generate

    tenth = -(-args.count // 10)
    counts = {
        "train": args.count,
        "valid": tenth if args.valid is None else args.valid,
        "test": tenth if args.test is None else args.test,
    }
    made = generate(
        args.family,
        args.out,
        counts,
        seed=args.seed,
        nodes=args.nodes,
        frames=args.frames,
        workers=args.workers,
        solver=args.solver,
        parts=args.parts,
        scheduler=args.scheduler,
    )
    print(f"{made.path}: {', '.join(f'{count} {split}' for split, count in made.counts.items())}")
    if made.truncated:
        print(f"stopped before their last frame: {', '.join(made.truncated)}")


def _convert(args: argparse.Namespace) -> None:
    from ast_sim.data.deepmind import convert_deepmind, is_deepmind

    if is_deepmind(args.source):
        _refuse(args, args.of_series, f"{args.source}: meta.json says it")
        counts = convert_deepmind(
            args.source, args.out, splits=args.split, limit=args.limit, every=args.every, progress=print
        )
    else:
        _refuse(args, args.of_records, f"{args.source}, which holds no .tfrecord files")
        counts = _convert_series(args)
    print(f"{args.out}: {', '.join(f'{count} {split}' for split, count in counts.items())}")


def _refuse(args: argparse.Namespace, groups: tuple[Any, ...], what: str) -> None:
    """Raise ConfigError if an option of these groups was given."""
    for action in (action for group in groups for action in group._group_actions):
        if getattr(args, action.dest) != action.default:
            raise ConfigError(f"{action.option_strings[0]} has no meaning for {what}")


def _convert_series(args: argparse.Namespace) -> dict[str, int]:
    from ast_sim.data.convert import convert
    from ast_sim.data.series import FieldNames

    return convert(
        args.source,
        args.out,
        names=FieldNames(
            args.displacement, args.stress, args.node_type, args.obstacle, args.handle, args.body, tuple(args.material)
        ),
        splits=dict(zip(("train", "valid", "test"), args.shares, strict=True)),
        seed=args.seed,
        integration="dynamic" if args.dynamic else "quasi_static",
        contact_radius=args.contact_radius,
        time_step=args.time_step,
        length_unit=args.length_unit,
        progress=print,
    )


def _info(args: argparse.Namespace) -> None:
    from ast_sim.info import describe, text

    found = describe(args.path)
    print(json.dumps(found, indent=1) if args.json else text(found))


def _train(args: argparse.Namespace) -> None:
    from ast_sim import keep_memory
    from ast_sim.train import configure, train

    keep_memory()
    if args.data is None and not args.resume:
        raise ConfigError("name the dataset to train on, or --resume the run in --out")
    if args.data is None and (args.model or args.preset or args.set):
        raise ConfigError("settings are those of the run that is resumed: leave --model, --preset and --set out")
    # A run that is resumed keeps its settings; given ones are compared with them.
    config = None
    if args.data is not None:
        config = configure(args.data, args.preset or "tiny", args.set, args.model or "ast")
    train(args.out, config, resume=args.resume, profile_steps=args.profile or 0)
    if args.profile is None:
        print(f"run: {args.out}")


def _evaluate(args: argparse.Namespace) -> None:
    from ast_sim import keep_memory
    from ast_sim.evaluate import table
    from ast_sim.results import evaluate_run, open_run, write_json

    keep_memory()
    with open_run(args.run_folder, args.data) as run:
        found = evaluate_run(run, args.split, args.command_line)
    print(table(found))
    if args.json is not None:
        write_json(args.json, found)
        print(f"all figures: {args.json}")


def _rollout(args: argparse.Namespace) -> None:
    from ast_sim import keep_memory
    from ast_sim.results import SUFFIXES, open_run, predict, write_prediction

    if args.out.suffix not in SUFFIXES:
        raise ConfigError(f"--out {args.out}: a prediction is written as {', '.join(SUFFIXES)}: name it so")
    keep_memory()
    with open_run(args.run_folder, args.data) as run:
        count = run.dataset.count(args.split)
        if args.index >= count:
            raise DatasetError(f"{args.data}: there is no {args.split}/{args.index:06d}: the split has {count}")
        truth, result = predict(run, args.split, args.index)
        write_prediction(run, truth, result, f"{args.split}/{args.index:06d}", args.out)
    if result.failure is not None:
        raise RolloutError(f"{result.failure}, in {args.out}")
    steps = len(result.seconds)
    print(f"{args.out}: {steps} frames predicted, {1000 * sum(result.seconds) / steps:.3g} ms each")


def _report(args: argparse.Namespace) -> None:
    datasets = [path for path in args.shown if path.is_file() or (path.suffix == ".h5" and not path.is_dir())]
    if len(datasets) < len(args.shown) and datasets:
        raise ConfigError(
            f"{datasets[0]} is a dataset, the others are runs: a page shows runs or one dataset;"
            " name the dataset of runs with --data"
        )
    if len(datasets) > 1:
        raise ConfigError(f"a page shows one dataset, not {len(datasets)}: write one page for each")
    if datasets and args.data is not None:
        raise ConfigError(f"--data names the dataset of runs, but {datasets[0]} is a dataset itself: leave --data out")
    if datasets:
        from ast_sim.view import gallery

        gallery.write(args.out, datasets[0])
    else:
        _report_runs(args)
    print(f"report: {args.out}")


def _report_runs(args: argparse.Namespace) -> None:
    from ast_sim import keep_memory
    from ast_sim.results import evaluate_run, open_run, report_run, write_report

    keep_memory()
    shown = []
    for folder in args.shown:
        with open_run(folder, args.data) as run:
            shown.append(report_run(run, evaluate_run(run, "test", args.command_line)))
    write_report(args.out, shown, "Learned simulation: predictions and errors")


if __name__ == "__main__":
    sys.exit(main())
