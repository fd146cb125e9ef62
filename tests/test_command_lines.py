"""Command lines drawn at random from the parser itself: none ends in a traceback.

250 of them are drawn; AST_TEST_COMMAND_LINES=2000 draws more. Each runs in a folder of its own that holds a dataset, a
run, meshes and files of other kinds. The long work is left out: no scene is simulated, no training step is made.
"""

import argparse
import contextlib
import io
import os
import shlex
import shutil
import traceback
import warnings
from collections import Counter

import pytest
import toy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ast_sim
from ast_sim import demo
from ast_sim.cli import build_parser, main
from ast_sim.models.registry import find_model, model_names
from ast_sim.runs.train_config import TrainConfig
from ast_sim.simulate.jobs import cluster, pool
from ast_sim.support import toml_settings
from ast_sim.training import loop
from ast_sim.view import export

LINES = int(os.environ.get("AST_TEST_COMMAND_LINES", "250"))

COMMANDS = {
    "calibrate",
    "demo",
    "generate",
    "convert",
    "info",
    "plan",
    "train",
    "predict",
    "sweep",
    "evaluate",
    "report",
    "trade",
}

# Texts without a slash: an output must not leave the folder of the test.
TEXT = st.text(st.characters(exclude_characters="\0/", exclude_categories=["Cs"]), max_size=6).filter(
    lambda t: ".." not in t
)
BYTES = st.binary(min_size=1, max_size=3).map(os.fsdecode).filter(lambda t: not set(t) & set("\0/."))
WORDS = st.one_of(TEXT, BYTES)
NUMBER = st.sampled_from(
    ["-2", "-1", "0", "1", "2", "3", "7", "12", "0.5", "-0.0", "1e-9", "1000000000", str(2**63 - 1), str(2**63),
     "9" * 400, "1e400", "-1e400", "nan"]
)  # fmt: skip
PATH = st.sampled_from(
    ["toy.h5", "dynamic.h5", "run", "cases", "cases/a.pvd", "cases/a/frame_00000.vtu", "mesh.vtkhdf", "shell.stl",
     "text.txt", "my.toml", "run/config.toml", "short.h5", "folder", "absent", "absent.h5", "new.h5", "new.html",
     "new.json", "new.pvd", "new.vtkhdf", "new/deep.h5", "text.txt/below.h5", "link.h5", "pipe", "/dev/null", ""]
)  # fmt: skip
FIELD = st.sampled_from(["displacement", "von_mises", "node_type", "body", "material", "absent", ""])
OUT = {
    "convert": ["new.h5"],
    "evaluate": ["new.json"],
    "generate": ["new.h5"],
    "report": ["new.html"],
    "sweep": ["new.csv"],
    "trade": ["new.html"],
    "predict": ["new.h5", "new.pvd", "new.vtkhdf"],
}
USUAL = {  # what a user may well give, by the name that the parser has for it
    "run_folder": ["run"], "from": ["run"], "data": ["toy.h5", "toy.h5", "dynamic.h5"], "path": ["toy.h5", "run"],
    "scene": ["toy.h5", "cases/a/frame_00000.vtu"], "source": ["cases", "cases/a.pvd", "mesh.vtkhdf"],
    "shown": ["run", "toy.h5"], "config": ["my.toml", "run/config.toml"], "count": ["1", "3"],
    "index": ["0", "1"], "solver_scenes": ["0"], "nodes": ["80", "400"], "frames": ["5", "9", "-1", "1,2,3", "0"],
    "shares": ["1", "0", "0.5"], "obstacle": ["0", "1"], "corrections": ["0", "2"], "num_frames": ["2", "4"],
    "move": ["1=0,0,-0.01", "1=0,0,-0.01 then 0.02,0,-0.01", "1=rotate 30 about 0,0,1 at 0,0,0", "0=0,0,0", "9=1,1,1",
             "1=nan,0,0", "1=1e300,0,0", "1=", "=", "1=rotate 30 about 0,0,0"],
    "clamp": ["0:xmin", "0:xmin,xmax", "0:z<=0.01", "0:all", "0:field=body", "0:field=absent", "7:all", "0:z<=", ":"],
    "material": ["0=2e5,0.3", "0=", "9=1", "0=nan", "material"],
    "keep": ["1", "1,5", "2,1", "0"], "scheduler": ["tcp://127.0.0.1:1", "host"], "parts": ["folder", "shell.stl"],
    "family": ["deforming_plate", "sphere_simple", "abcd", "abcd_xl", "ball"],
    "preset": ["tiny", "tiny", "deforming_plate", "original", "tny"], "length_unit": ["m", "mm", "parsec"],
    "model": ["ast", "mgn", "bsms", "hcmt", "transolver", "mgm"],
}  # fmt: skip


def commands() -> argparse._SubParsersAction:
    (sub,) = (action for action in build_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return sub


def keys() -> list[str]:
    """The names of all settings of all models."""
    of_models = [f"model.{s.key}" for name in model_names() for s in toml_settings.settings(find_model(name).config)]
    return sorted({*of_models, *(f"train.{s.key}" for s in toml_settings.settings(TrainConfig))})


SETTING = st.builds(
    "{}={}".format, st.sampled_from(keys()), st.one_of(NUMBER, st.sampled_from(["none", "x,y", "true"]))
)


def value(command: str, action: argparse.Action) -> st.SearchStrategy[str]:
    """Values of an option or argument: most of them such as a user may give, then any of the kind, then any words."""
    kind = PATH if getattr(action.type, "__name__", "") == "_path" else NUMBER if action.type is not None else FIELD
    if action.dest == "set":
        kind = SETTING
    if action.dest == "out":
        usual = st.sampled_from(OUT.get(command, ["new"]))
    else:
        known = list(action.choices or USUAL.get(action.dest, ()))
        usual = st.sampled_from(known) if known else kind
    return st.integers(0, 19).flatmap(lambda n: usual if n < 17 else kind if n < 19 else WORDS)


@st.composite
def command_line(draw: st.DrawFn) -> list[str]:
    """A command with its arguments and up to three options, each with some value; now and then an argument is missing,
    or there is a word more."""
    parsers = commands().choices
    name = draw(st.sampled_from(sorted(parsers)))
    usual, options = [], []
    for action in parsers[name]._actions:
        if isinstance(action, argparse._HelpAction) or action.dest == "debug":  # which shows tracebacks
            continue
        given = action.required or not action.option_strings or action.dest == "index"
        (usual if given else options).append(action)
    if usual and draw(st.integers(0, 19)) == 19:
        usual.pop(draw(st.integers(0, len(usual) - 1)))
    words = [name]
    for action in usual + draw(st.lists(st.sampled_from(options), max_size=3) if options else st.just([])):
        count = {None: 1, "?": 1, "+": 1, 0: 0}.get(action.nargs, action.nargs)
        words += [*action.option_strings[:1], *(draw(value(name, action)) for _ in range(count))]
    return words + draw(st.sampled_from([[]] * 19 + [["more"]]))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The folder that each command finds."""
    folder = tmp_path_factory.mktemp("files")
    toy.write(folder / "toy.h5")
    toy.write(folder / "dynamic.h5", dynamic=True)
    ast_sim.train(
        folder / "toy.h5", folder / "run", model="mgn", model_settings={"hidden": 8, "blocks": 1}, steps=2, batch_size=2
    )
    (folder / "cases").mkdir()
    for seed, name in enumerate("abc"):
        export.write(folder / "cases" / f"{name}.pvd", toy.plate(seed))
    export.write(folder / "mesh.vtkhdf", toy.plate())
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    (folder / "shell.stl").write_text(f"solid a\n{facet}endsolid a\n")
    (folder / "text.txt").write_text("some words\n")
    (folder / "my.toml").write_text("[train]\nsteps = 3\n")
    (folder / "short.h5").write_bytes((folder / "toy.h5").read_bytes()[:5000])
    (folder / "folder").mkdir()
    return folder


@pytest.fixture
def no_long_work(monkeypatch):
    """Commands end where scenes would be simulated or training steps be made."""

    def end(*_):
        raise SystemExit(0)

    monkeypatch.setattr(pool, "run_all", end)
    monkeypatch.setattr(cluster, "run_all", end)
    monkeypatch.setattr(loop.Training, "go", loop.Training.prepare)
    monkeypatch.setattr(loop, "profile", lambda advance, steps: end())
    monkeypatch.setattr(demo, "_write_pages", end)


def outcome(words: list[str]) -> tuple[int, str]:
    """The exit code, and what stands on stderr or the traceback."""
    error = io.StringIO()
    try:
        streams = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error)
        with warnings.catch_warnings(), streams[0], streams[1]:
            warnings.simplefilter("always")  # printed, as for a user
            code = main(words)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        return 1, traceback.format_exc()
    return code, error.getvalue()


def test_no_command_line_ends_in_a_traceback(files, no_long_work, tmp_path, monkeypatch):
    ends = Counter()

    @settings(
        max_examples=LINES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(command_line())
    def run(words):
        place = tmp_path / "place"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(files, place)
        os.mkfifo(place / "pipe")
        (place / "link.h5").symlink_to("toy.h5")
        monkeypatch.chdir(place)
        code, text = outcome(words)
        lines = [line for line in text.splitlines() if not line.startswith("warning: ")]
        ends[words[0], code] += 1
        assert code in (0, 2) and len(lines) == (code == 2), f"ast-sim {shlex.join(words)}\n{text}"

    run()
    print(ends)
    assert {name for name, _ in ends} == COMMANDS and {code for _, code in ends} == {0, 2}


VALUES = {"--stress-order": "xx,yy,zz,xy,yz,xz", "--num-frames": "2"}  # where 1 is none


def options(command: str) -> list[argparse.Action]:
    """The options of a command that take one value."""
    chosen = commands().choices[command]._actions
    return [one for one in chosen if one.option_strings and one.nargs is None and one.default != []]


@pytest.mark.parametrize("command", sorted(commands().choices))
def test_an_option_that_takes_one_value_is_given_once(command, capsys):
    """The last of two was taken, and the first did nothing."""
    for option in options(command):
        name = option.option_strings[0]
        value = option.choices[0] if option.choices else VALUES.get(name, "1")
        with pytest.raises(SystemExit, match="^2$"):
            main([command, "x", f"{name}={value}", name, str(value)])
        assert f"ast-sim {command}: {name} is given twice: leave one out (see " in capsys.readouterr().err
        with pytest.raises(SystemExit, match="^2$"):
            main([command, "x", f"{name}=--"])
        assert capsys.readouterr().err == f"ast-sim: {name}=--: -- is no value (see ast-sim --help)\n"
