"""The command line `ast-sim COMMAND`: its commands and their arguments; `command_line` has what they do.

An error that a user can act on is printed as one line on stderr, and the exit code is 2.
"""

from __future__ import annotations

import argparse
import io
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from ast_sim import __version__
from ast_sim.command_line import commands, help_lines, judging_commands, planning_commands
from ast_sim.command_line.effort_options import add_effort
from ast_sim.support.argument_types import (
    Parser,
    add_each,
    add_out,
    at_least,
    path,
    read_by,
    whole_numbers,
)
from ast_sim.support.environment import check_variables
from ast_sim.support.errors import AstSimError, LooksWrong, printable
from ast_sim.support.stop_signals import Interrupted

NODES = "approximate number of nodes (default: as the sizes in the specification say)"
CORNERS = "take only the corners of second-order tetrahedra: the mesh is then stiffer, and its forces are wrong"


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    if sys.stdout is None:  # closed, as by `>&-`; the next file to be opened would take its place
        print("ast-sim: standard output is closed: send it to /dev/null instead", file=sys.stderr)
        return 2
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may hold bytes that are no text
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, until the process ends
    words = sys.argv[1:] if argv is None else argv
    args = argparse.Namespace(command=None, debug=False)
    warnings.showwarning = lambda message, category, *_: _show(message, category)
    try:
        build_parser().read(words, args)
        args.command_line = shlex.join(["ast-sim", *words])
        check_variables()
        args.run(args)
        sys.stdout.flush()
        return 0
    except KeyboardInterrupt as error:
        _flush()
        return 128 + (error.number if isinstance(error, Interrupted) else signal.SIGINT)
    except (BrokenPipeError, SystemExit) as error:
        unwritten = _flush()
        if isinstance(error, SystemExit) and (unwritten is None or error.code):
            raise
        if isinstance(unwritten or error, BrokenPipeError):
            return 141
        _tell("ast-sim", unwritten)
        return 2
    except (AstSimError, OSError, Warning) as error:  # a warning under PYTHONWARNINGS=error
        if args.debug:
            raise
        _tell(f"ast-sim {args.command or ''}".rstrip(), error)
        return 2


def _flush() -> OSError | None:
    """Write what standard output still holds; the error if it cannot be written, as where a reader is gone."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _silence(sys.stdout)
        return error
    return None


def _silence(stream: TextIO) -> None:
    """Redirect a stream that cannot be written, so that Python's flush at exit does not fail, too."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _show(message: object, category: type[Warning]) -> None:
    """Show a warning; what looks wrong in data is a table."""
    if category is LooksWrong:
        print(printable(str(message)))
    else:
        _tell("warning", message)


def _tell(what: str, message: object) -> None:
    try:
        print(f"{what}: {printable(' '.join(str(message).split()))}", file=sys.stderr, flush=True)
    except OSError:  # nobody can be told that a line on stderr was not written
        _silence(sys.stderr)


def build_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(prog="ast-sim", description="Learned simulation of deforming bodies in contact.")
    parser.add_argument("--version", action="version", version=f"ast_sim {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(fill: Callable[[Parser], None], run: Callable[[argparse.Namespace], None]) -> None:
        about = run.__doc__ or ""
        sub = subparsers.add_parser(run.__name__, help=about[:1].lower() + about[1:-1], description=about)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        sub.set_defaults(run=run, parser=sub)
        fill(sub)

    add(_add_demo, commands.demo)
    add(_add_generate, commands.generate)
    add(_add_convert, commands.convert)
    add(_add_info, commands.info)
    add(_add_train, commands.train)
    add(_add_predict, commands.predict)
    add(_add_sweep, commands.sweep)
    add(planning_commands.add_plan, planning_commands.plan)
    add(judging_commands.add_evaluate, judging_commands.evaluate)
    add(judging_commands.add_calibrate, judging_commands.calibrate)
    add(judging_commands.add_trade, judging_commands.trade)
    add(judging_commands.add_report, judging_commands.report)
    return parser


def _add_demo(demo: Parser) -> None:
    demo.add_argument("--out", type=path, default=Path("demo"), metavar="DIR", help="result folder (default: demo)")
    demo.add_argument("--quick", action="store_true", help="fewer scenes and steps: 1.5 to 2.5 minutes on 2 cores")
    demo.add_argument("--seed", type=at_least(0), default=0, help="seed of scenes and training (default: 0)")


def _add_generate(generate: Parser) -> None:
    generate.more = help_lines.families
    generate.add_argument("family", metavar="FAMILY", help="kind of scenes; the list is below")
    about = "specification of the assembly (.toml); only for the family assembly"
    generate.add_argument("spec", type=path, nargs="?", metavar="SPEC", help=about)
    add_each(generate, {"--out FILE": "dataset to write (.h5)"}, type=path)
    add_each(generate, {"--count N": "number of training scenes"}, type=at_least(1))
    about = (
        "make no dataset, but a picture of the first scenes of an assembly; print what --count scenes will cost, and"
        " the error of the force that is due to the mesh"
    )
    generate.add_argument("--look", action="store_true", help=about)
    splits = {
        "--valid N": "number of validation scenes (default: a tenth of --count)",
        "--test N": "number of test scenes (default: a tenth of --count)",
    }
    add_each(generate, splits, type=at_least(0))
    about = "number of scenes for `ast-sim calibrate`, which measures the errors of a trained run (default: 0)"
    add_each(generate, {"--calibration N": about}, type=at_least(0), default=0)
    sizes = {"--nodes N": "approximate number of nodes of a scene", "--frames N": "number of frames of a scene"}
    add_each(generate, sizes, type=at_least(1))
    about = "frames to solve and store beside frame 0, such as 1,5,20; none between them are solved (default: all)"
    generate.add_argument("--keep", type=whole_numbers, metavar="K,K,...", help=about)
    about = "order of the tetrahedra: 1 (four nodes), or 2 (ten nodes, with better forces) (default: 1)"
    generate.add_argument("--order", type=int, choices=(1, 2), help=about)
    generate.add_argument("--seed", type=at_least(0), default=0, help="seed of the scenes (default: 0)")
    about = "the bundled solver (own) or CalculiX (default: own; CalculiX if a part is elastoplastic)"
    generate.add_argument("--solver", choices=("own", "calculix"), help=about)
    add_each(generate, {"--parts PATH": "your parts: a STEP, STL or mesh file, or a folder of them"}, type=path)
    about = "never give up a frame (default: a scene ends before a frame that needs more than 500 Newton iterations)"
    generate.add_argument("--patient", action="store_true", help=about)
    where = generate.add_mutually_exclusive_group()
    add_each(where, {"--workers W": "number of processes (default: one per core)"}, type=at_least(1))
    add_each(where, {"--scheduler ADDRESS": "solve on the workers of a Dask scheduler, such as tcp://host:8786"})


def _add_convert(convert: Parser) -> None:
    about = (
        "a simulation (a .vtkhdf, .frd, .xdmf, .exo or d3plot file, a .pvd or .series file, or a folder of .vtu,"
        " .pvtu, .vtm or .vtk files), a folder that holds several simulations, or a folder of meta.json and .tfrecord"
        " files"
    )
    convert.add_argument("source", type=path, metavar="SOURCE", help=about)
    about = "if SOURCE is a deck of CalculiX (.inp): its results (.frd); the deck gives prescribed nodes and materials"
    convert.add_argument("results", type=path, nargs="?", metavar="RESULTS", help=about)
    add_out(convert, "FILE", "dataset to write (.h5)")
    fields = convert.add_argument_group("names of the fields in the files")
    names = {
        "--displacement NAME": "point field with the displacement from rest (default: displacement; without it, the"
        " points themselves move)",
        "--stress NAME": "point or cell field with the von Mises stress or a stress tensor; S stands for the fields"
        " S11, S22, ... (default: von_mises, if it is there)",
        "--node-type NAME": "point field: 0 normal, 1 obstacle, 3 handle",
        "--obstacle NAME": "nodes of obstacles: a point field that is not zero there, a group of nodes, or BODY:all",
        "--handle NAME": "prescribed nodes of deforming bodies: a field or group likewise, or BODY:PLACE, as 0:zmin",
        "--body NAME": "point or cell field with the numbers of the bodies",
    }
    add_each(fields, names)
    about = "order of the stress components, such as xx,xy,xz,yy,yz,zz (default: as in the file, else xx,yy,zz,...)"
    add_each(
        fields, {"--stress-order XX,YY,...": about}, type=read_by("ast_sim.importers.stress:parse_order"), default=()
    )
    about = "cell fields with the material, one number a cell; young=E: the field E is Young's modulus (column young)"
    add_each(fields, {"--material NAME": about}, nargs="+", action="extend", default=[])
    about = "another field to keep, such as PEEQ, or CPRESS=MPa with its unit; may be repeated"
    add_each(fields, {"--field NAME[=UNIT]": about}, action="append", default=[])
    about = "point field with the reaction forces, such as RF, in newton (from a deck: in its unit of force)"
    add_each(fields, {"--reaction NAME": about})
    kind = convert.add_argument_group("properties of a dataset made from such files")
    about = "share of the simulations in each split, drawn at random (default: 0.8 0.1 0.1 from three simulations on)"
    kind.add_argument("--shares", nargs=3, type=float, metavar=("TRAIN", "VALID", "TEST"), help=about)
    about = "number of simulations for `ast-sim calibrate`; --shares divides the others (default: 0)"
    add_each(kind, {"--calibration N": about}, type=at_least(0), default=0)
    kind.add_argument("--seed", type=at_least(0), default=0, help="seed of the random draw of the splits (default: 0)")
    kind.add_argument("--corners", action="store_true", help=CORNERS)
    kind.add_argument("--incomplete", action="store_true", help="convert even if nothing moves or is prescribed")
    kind.add_argument("--strict", action="store_true", help="refuse simulations in which something looks wrong")
    kind.add_argument("--dynamic", action="store_true", help="scenes with inertia: models predict the acceleration")
    numbers = {
        "--contact-radius R": "distance below which surfaces are in contact (default: 0)",
        "--time-step SECONDS": "time from frame to frame; 0 if frames have no time (default: 0)",
    }
    add_each(kind, numbers, type=float, default=0.0)
    add_each(kind, {"--length-unit UNIT": "unit of length: m, cm, mm, um or in (default: m; a deck needs it)"})
    about = "unit of stress, of young and of yield_stress: Pa, kPa, MPa, GPa or psi (default: Pa; a deck needs it)"
    add_each(kind, {"--stress-unit UNIT": about})
    records = convert.add_argument_group("options for .tfrecord files (meta.json says the rest)")
    about = "convert only these files (default: all)"
    records.add_argument("--split", nargs="+", action="extend", choices=commands.SPLITS, help=about)
    add_each(records, {"--limit N": "convert the first N trajectories of each file (default: all)"}, type=at_least(1))
    add_each(records, {"--every K": "keep every K-th frame (default: 1)"}, type=at_least(1), default=1)
    convert.set_defaults(of_series=(fields, kind), of_records=(records,))


def _add_info(info: Parser) -> None:
    info.add_argument("path", type=path, metavar="FILE_OR_RUN", help="dataset (.h5), or run: a folder or a file (.ast)")
    info.add_argument("--json", action="store_true", help="print JSON")
    info.add_argument("--strict", action="store_true", help="exit with an error if something looks wrong")


def _add_train(train: Parser) -> None:
    train.more = help_lines.all_settings
    train.add_argument("data", metavar="DATA", nargs="?", type=path, help="dataset (.h5); not needed with --resume")
    add_each(train, {"--out RUN": "run folder"}, type=path, required=True)
    add_each(train, {"--model M": "name of the model; the list is below (default: ast)"})
    add_each(train, {"--preset P": "ready-made settings; the list is below (default: tiny)"})
    files = {
        "--config FILE": "TOML file with settings, such as config.toml of a run; --set and options override it",
        "--from RUN": "start with the weights and the settings of another run (a folder or a .ast file), to train it"
        " longer or on other data",
    }
    add_each(train, files, type=path)
    states = {"--state NAME": "field of the dataset to predict, such as PEEQ, or reaction; may be repeated"}
    add_each(train, {**states, "--set k=v": "change a setting; may be repeated"}, action="append", default=[])
    add_each(
        train,
        {"--minutes M": "length of the training in minutes; the number of steps follows from the time of the first 50"},
        type=float,
    )
    about = "number of processes that share the training (default: the setting train.processes)"
    add_each(train, {"--processes N": about}, type=at_least(1))
    train.add_argument("--resume", action="store_true", help="continue from the last checkpoint, if there is one")
    add_each(train, {"--profile N": "do not train: time N steps, and print where the time goes"}, type=at_least(1))


def _add_predict(predict: Parser) -> None:
    predict.add_argument("run_folder", type=path, metavar="RUN", help="run: a folder or a file (.ast)")
    about = "a mesh (.vtu, .msh, .inp, .stl, ...), a dataset (.h5), or the specification of an assembly (.toml)"
    predict.add_argument("scene", type=path, metavar="SCENE", help=about)
    add_out(predict, "FILE", "file to write: .h5, .pvd or .vtkhdf for ParaView, or .csv")
    moves = {
        "--move BODY=MOTION": 'motion of the prescribed nodes of a body: a translation "1=0,0,-0.01", a path'
        ' "1=0,0,-0.01 then 0.02,0,-0.01", or a rotation "1=rotate 30 about 0,0,1 at 0,0,0"; may be repeated'
    }
    add_each(predict, moves, action="append", default=[])
    about = "frames to predict: --frames=-1 for the last one, --frames 5,10,20 for some (default: all)"
    add_each(predict, {"--frames I,...": about}, type=whole_numbers)
    add_effort(predict)
    about = "in place of the same options: compute the most accurate answer that takes at most T milliseconds"
    add_each(predict, {"--ms T": about}, type=float)
    about = "number of frames of the motion (default: so that nodes move as far in a frame as in training)"
    add_each(predict, {"--num-frames N": about}, type=at_least(2))
    about = "report what is physically impossible: elements turned over, penetration, forces out of balance"
    predict.add_argument("--check", action="store_true", help=about)
    about = "also write the force and the torque on each body, frame by frame, and a permanent set, as a table"
    add_each(predict, {"--forces FILE.csv": about}, type=path)
    mesh = predict.add_argument_group("if SCENE is a mesh")
    about = "number of a rigid body; may be repeated"
    add_each(mesh, {"--obstacle BODY": about}, type=int, action="append", default=[])
    marks = {
        "--clamp BODY:PLACE": "where a deforming body is held or moved, such as 0:xmin (its nodes of lowest x),"
        " 0:xmin,xmax, 0:z<=0.01, 0:all, 0:field=NAME; may be repeated",
        "--material BODY=NUMBERS": "material of a body, such as young and poisson: 0=2e5,0.3; may be repeated",
    }
    add_each(mesh, marks, action="append", default=[])
    fields = {
        "--body-field NAME": "field with the numbers of the bodies (default: body; else each connected part is a body)",
        "--type-field NAME": "point field: 0 normal, 1 obstacle, 3 handle (default: node_type)",
    }
    add_each(mesh, fields)
    mesh.add_argument("--corners", action="store_true", help=CORNERS)
    data = predict.add_argument_group("if SCENE is a dataset")
    data.add_argument("--split", choices=commands.SPLITS, default="test", help="split (default: test)")
    add_each(data, {"--index I": "number of the trajectory in the split"}, type=at_least(0))
    spec = predict.add_argument_group("if SCENE is the specification of an assembly")
    about = "value of a parameter, such as travel=4.2 or bumper.young=1.5e6; may be repeated"
    add_each(spec, {"--set NAME=VALUE": about}, action="append", default=[])
    add_each(spec, {"--nodes N": NODES}, type=at_least(1))
    predict.set_defaults(of_mesh=(mesh,), of_data=(data,), of_spec=(spec,))


def _add_sweep(sweep: Parser) -> None:
    sweep.add_argument("run_folder", type=path, metavar="RUN", help="run: a folder or a file (.ast)")
    sweep.add_argument("spec", type=path, metavar="SPEC", help="specification of the assembly (.toml)")
    add_out(sweep, "FILE", "table to write (.csv); a picture with the same name is written beside it (.png)")
    about = "values of a parameter: travel=1:7:13 (13 values from 1 to 7), young=1e6,2e6; repeated: all combinations"
    add_each(sweep, {"--set NAME=VALUES": about}, action="append", default=[])
    add_each(sweep, {"--table FILE": "in place of --set: a CSV file, whose first line names the parameters"}, type=path)
    about = "what the picture shows (default: reaction)"
    quantities = ("reaction", "largest_stress", "permanent_set")
    sweep.add_argument("--quantity", choices=quantities, default="reaction", help=about)
    add_effort(sweep, "as for predict")
    add_each(sweep, {"--nodes N": NODES}, type=at_least(1))


if __name__ == "__main__":
    sys.exit(main())
