"""The commands that judge a trained run, each with its arguments: evaluate, calibrate, trade, report."""

from __future__ import annotations

import argparse

from ast_sim.command_line.commands import SPLITS, check_output, open_run
from ast_sim.inference.evaluation import SOLVER_SCENES
from ast_sim.support.argument_types import Parser, add_each, add_out, add_overwrite, at_least, path
from ast_sim.support.errors import ConfigError


def _add_made_from(to: Parser) -> None:
    about = "the specification or the parts of your own of which DATA was made; the solver needs them"
    add_each(to, {"--made-from PATH": about}, type=path)


def add_evaluate(evaluate: Parser) -> None:
    """The arguments of `evaluate`."""
    evaluate.add_argument("run_folder", type=path, metavar="RUN", help="run: a folder or a file (.ast)")
    evaluate.add_argument("data", type=path, metavar="DATA", help="dataset")
    evaluate.add_argument("--split", choices=SPLITS, default="test", help="split (default: test)")
    about = (
        "number of scenes that the solver solves, too, for comparison, each to its deepest frame (default:"
        f" {SOLVER_SCENES}; 0: none)"
    )
    add_each(evaluate, {"--solver-scenes N": about}, type=at_least(0), default=SOLVER_SCENES)
    _add_made_from(evaluate)
    add_out(evaluate, "FILE.json", "also write all figures to this file", required=False)


def evaluate(args: argparse.Namespace) -> None:
    """Measure the errors and the speed of a run on a dataset."""
    if args.out is not None:
        check_output(args, args.out, [args.data])
        if args.out.suffix != ".json":
            raise ConfigError(f"--out {args.out}: the name of a file of figures must end in .json")
    run = open_run(args.run_folder)
    evaluation = run.evaluate(args.data, args.split, args.command_line, args.solver_scenes, args.made_from)
    print(evaluation)
    if args.out is not None:
        evaluation.save(args.out)
        print(f"all figures: {args.out}")


def add_calibrate(calibrate: Parser) -> None:
    """The arguments of `calibrate`."""
    calibrate.add_argument("run_folder", type=path, metavar="RUN", help="run folder; the result is kept there")
    calibrate.add_argument(
        "data", type=path, metavar="DATA", help="dataset with 19 or more scenes that RUN has not seen"
    )
    about = "split (default: calibration)"
    calibrate.add_argument("--split", choices=SPLITS, default="calibration", help=about)


def calibrate(args: argparse.Namespace) -> None:
    """Measure on new scenes how far answers are from the truth, so that each has a band."""
    from ast_sim.inference.calibrate import calibrate as measure

    print(measure(open_run(args.run_folder), args.data, args.split).text)


def add_trade(trade: Parser) -> None:
    """The arguments of `trade`."""
    trade.add_argument("run_folder", type=path, metavar="RUN", help="run: a folder or a file (.ast)")
    trade.add_argument("data", type=path, metavar="DATA", help="dataset with scenes that RUN has not seen (.h5)")
    add_out(trade, "FILE.html", "page to write; a file with all figures is written beside it (.json)")
    trade.add_argument("--split", choices=SPLITS, default="test", help="split (default: test)")
    about = "other runs that have learned from the same dataset as RUN"
    add_each(trade, {"--beside OTHER_RUN": about}, type=path, nargs="+", action="extend", default=[])
    add_each(trade, {"--scenes N": "largest number of scenes (default: 20)"}, type=at_least(1), default=20)
    about = "seconds that another program takes for a scene; then our solver is not run"
    add_each(trade, {"--solver-seconds S": about}, type=float)
    _add_made_from(trade)


def trade(args: argparse.Namespace) -> None:
    """Measure what each error costs, by the run, the solver and other runs: a table and a page."""
    from ast_sim import trade as measure
    from ast_sim.view.page import page_name

    page_name(args.out)
    figures = args.out.with_suffix(".json")
    for out in (args.out, figures):
        check_output(args, out, [args.data])
    result = measure(
        open_run(args.run_folder),
        args.data,
        args.split,
        beside=[open_run(other) for other in args.beside],
        scenes=args.scenes,
        solver_seconds=args.solver_seconds,
        made_from=args.made_from,
        command=args.command_line,
    )
    print(result)
    result.report(args.out)
    result.save(figures)
    print(f"page: {args.out}, all figures: {figures}")


def add_report(report: Parser) -> None:
    """The arguments of `report`."""
    report.add_argument("shown", type=path, nargs="+", metavar="RUN_OR_DATA", help="runs, or one dataset (.h5)")
    add_each(report, {"--out FILE.html": "page to write"}, type=path, required=True)
    add_each(report, {"--data DATA": "dataset for all runs (default: the training data of each run)"}, type=path)
    add_overwrite(report)


def report(args: argparse.Namespace) -> None:
    """Write a page that shows runs (moving scenes, errors), or a dataset."""
    from ast_sim.view.page import page_name

    page_name(args.out)
    check_output(args, args.out, [*args.shown, *filter(None, [args.data])])
    no_runs = (path for path in args.shown if not path.is_dir() and path.suffix != ".ast")
    datasets = [path for path in no_runs if path.is_file() or path.suffix == ".h5"]
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
        from ast_sim.view.dataset_page import gallery

        gallery.write(args.out, datasets[0])
    else:
        from ast_sim.inference.evaluation.evaluated_run import report_evaluations

        evaluations = [open_run(folder).evaluate(args.data, command=args.command_line) for folder in args.shown]
        report_evaluations(args.out, evaluations)
    print(f"report: {args.out}")
