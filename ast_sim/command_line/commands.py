"""The commands of `ast-sim`: each calls the API and prints the result. Its help begins with its docstring.

A command imports what it needs when it runs, so that `ast-sim --help` is fast.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ast_sim.command_line.effort_options import effort_of, error_of
from ast_sim.runs import CONFIG, SCOPE
from ast_sim.support.argument_types import by_name
from ast_sim.support.disk import output_file
from ast_sim.support.errors import ConfigError, DatasetError, RolloutError, counted, printable

SPLITS = ("train", "valid", "test", "calibration")


def demo(args: argparse.Namespace) -> None:
    """Simulate some plates, train on them, predict other plates, write a report."""
    from ast_sim import keep_memory
    from ast_sim.demo import demo as run_demo

    keep_memory()
    run_demo(args.out, quick=args.quick, seed=args.seed)


def generate(args: argparse.Namespace) -> None:
    """Simulate scenes with the bundled contact solver; a second call resumes a stopped one."""
    from ast_sim.simulate.jobs.failures import failures
    from ast_sim.simulate.jobs.generate import generate as simulate

    if args.look:
        _look(args)
        return
    for option, value in (("--out FILE", args.out), ("--count N", args.count)):
        if value is None:
            raise ConfigError(f"give {option}" + (", or --look" if args.spec is not None else ""))
    chosen = ("valid", "test", "calibration", "seed", "nodes", "frames", "keep", "order", "workers", "solver", "parts")
    options = {name: getattr(args, name) for name in (*chosen, "spec", "patient", "scheduler")}
    made = simulate(args.family, args.out, train=args.count, **options)
    print(f"{made.path}: {_counts(made.counts)}")
    if made.truncated:
        print("\n".join(map(printable, failures(made.path, args.spec))))


def _look(args: argparse.Namespace) -> None:
    """`ast-sim generate assembly SPEC --look`."""
    from ast_sim.simulate.jobs.generate import checked_counts, checked_workers
    from ast_sim.simulate.jobs.look import look
    from ast_sim.support.progress import duration
    from ast_sim.view import scene_picture

    if args.family != "assembly" or args.spec is None:
        raise ConfigError("--look is for a specification: ast-sim generate assembly SPEC.toml --look")
    if args.order is not None:
        raise ConfigError("a specification says the order of its elements (order = 1): leave out --order")
    drawn = look(args.spec, seed=args.seed, nodes=args.nodes, frames=args.frames, solver=args.solver)
    picture = (args.out or args.spec).with_suffix(".look.png")
    shown = [(case.scene, case.farthest) for case in drawn.cases]
    scene_picture.write(picture, shown, drawn.titles, drawn.unit)
    print("\n".join(map(printable, drawn.lines)))
    each = drawn.mesh_seconds + drawn.solve_seconds
    print(f"one scene: {each:.3g} s ({drawn.mesh_seconds:.2g} s to mesh), {printable(drawn.status)}")
    print("\n".join(map(printable, filter(None, [drawn.outcome, drawn.mesh_line]))))
    scenes = sum(checked_counts(args.count or 100, args.valid, args.test, args.calibration).values())
    workers = checked_workers(args.workers, None)
    cost = duration(each * scenes / workers)
    print(
        f"--count {args.count or 100}: {counted(scenes, 'scene')}, about {cost} with"
        f" {counted(workers, 'process', 'processes')}"
    )
    print(f"picture: {picture}")


def _counts(counts: dict[str, int]) -> str:
    """What was made; most datasets have no scenes for calibration, so these are told of only where there are some."""
    return ", ".join(f"{count} {split}" for split, count in counts.items() if count or split != "calibration")


def convert(args: argparse.Namespace) -> None:
    """Make a dataset from simulations of other programs (VTK, CalculiX, Exodus, LS-DYNA, XDMF, TFRecord)."""
    from ast_sim.importers.convert import SHARES
    from ast_sim.importers.convert import convert as import_files
    from ast_sim.importers.deepmind import is_deepmind
    from ast_sim.importers.series import FieldNames

    source, deck = (args.source, None) if args.results is None else (args.results, args.source)
    if source.suffix.lower() == ".inp":
        raise ConfigError(f"{source}: a deck holds no results; name them after it: ast-sim convert JOB.inp JOB.frd")
    read = args.source.rglob("*") if args.source.is_dir() else filter(None, [source, deck])
    check_output(args, args.out, (path for path in read if path.suffix != ".h5"), "a dataset", ".h5")
    if is_deepmind(source):
        refuse(args, args.of_series, f"{args.source}: its meta.json has the facts")
        options = {"splits": args.split, "limit": args.limit, "every": args.every}
    else:
        refuse(args, args.of_records, f"{args.source}, which holds no .tfrecord files")
        fields = (args.displacement, args.stress, args.node_type, args.obstacle, args.handle, args.body)
        more = (args.stress_order, args.stress_unit, tuple(args.field), args.reaction)
        options = {
            "names": FieldNames(*fields, tuple(args.material), *more),
            "splits": None if args.shares is None else dict(zip(SHARES, args.shares, strict=True)),
            "calibration": args.calibration,
            "seed": args.seed,
            "integration": "dynamic" if args.dynamic else "quasi_static",
            "contact_radius": args.contact_radius,
            "time_step": args.time_step,
            "length_unit": args.length_unit,
            "deck": deck,
            "corners": args.corners,
            "incomplete": args.incomplete,
            "strict": args.strict,
        }
    counts = import_files(source, args.out, progress=lambda done, total, line: print(printable(line)), **options)
    print(f"{args.out}: {_counts(counts)}")


def refuse(args: argparse.Namespace, groups: tuple[Any, ...], what: str) -> None:
    """Raise ConfigError if an option of these groups was given."""
    for action in (action for group in groups for action in group._group_actions):
        if getattr(args, action.dest) != action.default:
            raise ConfigError(f"{action.option_strings[0]} has no meaning for {what}")


def check_output(
    args: argparse.Namespace, out: Path, inputs: Iterable[Path], what: str = "", *suffixes: str, option: str = "--out"
) -> None:
    """Raise ConfigError if the name of the output does not end as a name of `what` must, or if the output is an input,
    lies in a run, or exists and --overwrite was not given."""
    if suffixes and out.suffix not in suffixes:
        one_of = "one of " if len(suffixes) > 1 else ""
        raise ConfigError(f"{option} {out}: the name of {what} must end in {one_of}{', '.join(suffixes)}")
    output_file(out)
    real = Path(os.path.realpath(out))
    for folder in real.parents:
        if (folder / CONFIG).is_file() and (folder / SCOPE).is_file():
            raise ConfigError(f"{out} lies in the run {folder}, which it could damage: name another place")
    # Beside NAME.pvd, a folder NAME holds the frames; a prediction replaces the whole folder.
    outputs = [real, real.with_suffix("")] if out.suffix == ".pvd" else [real]
    there = [path for path in outputs if path.exists()]
    for path in inputs if there else ():
        if any(output.samefile(place) for output in there for place in (path, path.resolve().parent) if place.exists()):
            raise ConfigError(f"{out} would overwrite the input {path}: name another output")
    if there and not args.overwrite:
        raise ConfigError(f"{there[0]} exists: name another output, or give --overwrite")


def info(args: argparse.Namespace) -> None:
    """Check a dataset or a run and show what it holds."""
    from ast_sim.dataset.contents import describe_dataset, text

    if args.path.is_dir() or args.path.suffix == ".ast":
        from ast_sim.runs.run_file import open_run

        facts = open_run(args.path).describe()
    else:
        facts = describe_dataset(args.path)
    print(json.dumps(facts, indent=1) if args.json else text(_with_answers_in_words(facts)))
    wrong = [one for one in facts.get("looks_wrong", ()) if not one["may_be_meant"]]
    if args.strict and wrong:
        raise DatasetError(f"{args.path}: {counted(len(wrong), 'thing looks', 'things look')} wrong in it")


def _with_answers_in_words(facts: dict[str, Any]) -> dict[str, Any]:
    """The facts; what a run knows of its answers, thousands of numbers, by quantity and effort."""
    from ast_sim.inference.effort import Effort, EffortErrors
    from ast_sim.inference.promises.calibration import Calibration
    from ast_sim.number_arrays import percent

    known = facts.get("answers")
    if not known:
        return facts
    calibration = Calibration.of_run(Path(facts["path"]), known)
    measured = [EffortErrors.from_json(one) for one in known.get("valid_by_effort", ())]
    errors = {one.effort.text: percent(one.error) for one in measured if one.error is not None}
    answers = {
        "effort": Effort(**known["effort"]).text if "effort" in known else None,
        "mean error of the displacement": errors,
        "calibration": None if calibration is None else calibration.by_quantity(),
    }
    return {**facts, "answers": answers}


def train(args: argparse.Namespace) -> None:
    """Train a model on a dataset."""
    from ast_sim import keep_memory
    from ast_sim.training.configure import configure
    from ast_sim.training.start import start_training

    keep_memory()
    if args.data is None and not args.resume:
        raise ConfigError("name the dataset to train on, or give --resume to go on with the run in --out")
    files = {"config": args.config, "from_run": getattr(args, "from")}
    given = {"train.minutes": args.minutes, "train.processes": args.processes, "model.state": tuple(args.state)}
    changes = {key: value for key, value in given.items() if value not in (None, ())}
    if args.data is None and (args.model or args.preset or args.set or changes or any(files.values())):
        raise ConfigError("a resumed run keeps its settings: leave out --set and all options but --out and --resume")
    # A resumed run keeps its settings; with a dataset, the given settings are compared with them.
    config = None
    if args.data is not None:
        config = configure(args.data, args.preset, args.set, args.model, **files, changes=changes)
    start_training(args.out, config, args.resume, profile_steps=args.profile or 0, from_run=files["from_run"])
    if args.profile is None:
        print(f"run: {args.out}")


def predict(args: argparse.Namespace) -> None:
    """Predict a new scene from a mesh or a specification, or a scene of a dataset."""
    from ast_sim.inference.answer import SUFFIXES
    from ast_sim.prescribed_motion import parse_move

    check_output(args, args.out, [args.scene], "a prediction", *SUFFIXES)
    if args.forces is not None:
        check_output(args, args.forces, [args.scene], "a table of forces", ".csv", option="--forces")
        if os.path.realpath(args.forces) == os.path.realpath(args.out):
            raise ConfigError(f"--forces {args.forces} would overwrite the prediction of --out: name another file")
    moves = by_name("--move", map(parse_move, args.move))
    run = open_run(args.run_folder)
    effort = effort_of(args, run.effort)
    wanted = {"frames": args.frames, "effort": effort, "error": error_of(args), "ms": args.ms, "throw": False}
    if args.scene.suffix == ".toml":
        _predict_spec(run, args, wanted)
        return
    refuse(args, args.of_spec, f"{args.scene}, which is no specification")
    shown = printable(str(args.scene))
    if args.scene.suffix == ".h5":
        refuse(args, args.of_mesh, f"{args.scene}, which is a dataset")
        truth = _truth(run, args)
        name = f"{shown}: {args.split}/{args.index:06d}"
    else:
        refuse(args, args.of_data, f"{args.scene}, which is a mesh")
        truth = None
        name = shown
    if truth is not None and not moves:
        answer = run.predict(truth, num_frames=args.num_frames, name=name, **wanted)
    else:
        scene = _scene(args) if truth is None else truth.scene
        truth = None
        answer = run.predict(scene, moves, num_frames=args.num_frames, name=name, **wanted)
    _save(answer, args, truth)


def _predict_spec(run: Any, args: argparse.Namespace, wanted: dict[str, Any]) -> None:
    """`ast-sim predict RUN SPEC.toml`."""
    from ast_sim.simulate.own_assembly.grid import grid, parse_settings

    for group in (args.of_mesh, args.of_data):
        refuse(args, group, f"{args.scene}, which is a specification")
    if args.move:
        raise ConfigError(f"{args.scene} says what moves: change its parameters with --set, or leave --move out")
    rows = grid(parse_settings(args.set))
    if len(rows) > 1:
        raise ConfigError("--set gives several values: ast-sim sweep predicts them all")
    options = {"nodes": args.nodes, "num_frames": args.num_frames, "name": printable(str(args.scene))}
    answer = run.predict(spec=args.scene, parameters=rows[0], **options, **wanted)
    _save(answer, args, None)
    units = {"travel_of_nodes": run.scope.length_unit, "reaction": "N", "largest_stress": "Pa"}
    for frame, row in zip(answer.frames, answer.figures(answer.source["origin"]), strict=True):
        bands = {name: f" (+- {row[f'{name}_band']:.2g})" for name in units if f"{name}_band" in row}
        parts = [f"{name} {row[name]:.4g} {unit}{bands.get(name, '')}" for name, unit in units.items() if name in row]
        print(f"frame {frame}: {', '.join(parts)}")


def sweep(args: argparse.Namespace) -> None:
    """Predict an assembly for many values of its parameters: a table and a picture."""
    from ast_sim.number_arrays import measured_time
    from ast_sim.simulate.own_assembly.grid import parse_settings

    picture = args.out.with_suffix(".png")
    part = args.out.with_suffix(".part.csv")
    for out, what, suffix in ((args.out, "a table", ".csv"), (picture, "a picture", ".png"), (part, "a table", ".csv")):
        check_output(args, out, [args.spec, *filter(None, [args.table])], what, suffix)
    run = open_run(args.run_folder)
    values = parse_settings(args.set)
    swept = run.sweep(
        args.spec,
        values,
        table=args.table,
        nodes=args.nodes,
        effort=effort_of(args, run.effort),
        error=error_of(args),
        part=part,
    )
    swept.save(args.out)
    for old in (part, picture):  # a picture of other rows
        old.unlink(missing_ok=True)
    print(f"{args.out}: {counted(len(swept.rows), 'row')}, {measured_time(swept.seconds / len(swept.rows))} each")
    if swept.not_converged:
        print(
            f"not converged: {swept.not_converged} of {counted(len(swept.rows), 'row')}, where last_newton_step is too"
            " large"
        )
    if swept.varied:
        swept.picture(picture, args.quantity)
        print(f"picture: {picture}")


def _save(answer: Any, args: argparse.Namespace, truth: Any) -> None:
    """Write an answer; say how long it took, or why it ended early."""
    from ast_sim.inference.quantities.forces_and_figures import told_sets
    from ast_sim.number_arrays import measured_time

    answer.save(args.out, truth)
    if answer.failure is not None:
        raise RolloutError(f"{answer.failure}, in {args.out}")
    steps = len(answer.step_seconds)
    print(f"{args.out}: {steps} frame{'' if steps == 1 else 's'} predicted in {measured_time(answer.seconds)}")
    print("".join(f"{line}\n" for line in (*answer.how_far, *told_sets(answer))), end="")
    if args.forces is not None:
        answer.save_forces(args.forces)
    if args.check:
        print("\n".join(map(printable, str(answer.check()).splitlines())))


def _truth(run: Any, args: argparse.Namespace) -> Any:
    """The trajectory of a dataset that the arguments select."""
    if args.index is None:
        raise ConfigError(f"{args.scene} is a dataset: say which trajectory with --index")
    with run.open(args.scene) as dataset:
        if args.index >= dataset.count(args.split):
            count = dataset.count(args.split)
            raise DatasetError(f"{args.scene}: there is no {args.split}/{args.index:06d}: the split has {count}")
        return dataset[args.split][args.index]


def _scene(args: argparse.Namespace) -> Any:
    """The scene of a mesh; prints its description."""
    from ast_sim.importers.scene_mesh import parse_material, read_scene
    from ast_sim.inference.predict_arguments import doubts_at_rest

    marks = {"obstacles": args.obstacle, "clamps": args.clamp, "corners": args.corners}
    fields = {"body_field": args.body_field, "type_field": args.type_field}
    materials = by_name("--material", map(parse_material, args.material))
    read = read_scene(args.scene, **marks, **fields, materials=materials or None)
    told_later = {f"warning: {doubt}" for doubt in doubts_at_rest(read.scene)}  # by the prediction
    print("\n".join(printable(line) for line in read.description if line not in told_later))
    return read.scene


def open_run(folder: Path) -> Any:
    """A run whose predictions keep their memory."""
    from ast_sim import Run, keep_memory

    keep_memory()
    return Run(folder)
