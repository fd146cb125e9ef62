"""The variables AST_SIM_... take what is documented and nothing else; processes of ours find the package."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from checks import run_python

from ast_sim.cli import main
from ast_sim.support import environment
from ast_sim.support.environment import (
    BY_TORCHRUN,
    VARIABLES,
    check_variables,
    of_child,
    place_among_processes,
    processes_on_machine,
    variable,
)
from ast_sim.support.errors import ConfigError

WRONG = [
    ("AST_SIM_ISA", "avx9", "choose base or avx2 or avx512, or unset it"),
    ("AST_SIM_ISA", "AVX2", "choose base or avx2 or avx512, or unset it"),
    ("AST_SIM_BACKEND", "cuda", "choose c or torch, or unset it"),
    ("AST_SIM_DEBUG", "yes", "choose 0 or 1, or unset it"),
    ("AST_SIM_KEEP_MEMORY", "no", "choose 1 or 0, or unset it"),
]


@pytest.mark.parametrize(("name", "value", "advice"), WRONG)
def test_a_wrong_value_is_one_line_of_every_command(monkeypatch, capsys, tmp_path, name, value, advice):
    monkeypatch.setenv(name, value)
    for command in (["info", "d.h5"], ["predict", "r.ast", "d.h5", "--out", str(tmp_path / "o.h5")]):
        assert main(command) == 2
        assert capsys.readouterr().err == f"ast-sim {command[0]}: {name}={value}: {advice}\n"


@pytest.mark.parametrize(("name", "value", "advice"), [WRONG[0], WRONG[3]])
@pytest.mark.parametrize("module", ["ops.library", "mechanics.elements.elasticity"])
def test_a_wrong_value_is_an_error_where_the_core_is_loaded(module, name, value, advice):
    command = [sys.executable, "-c", f"import ast_sim.{module}"]
    done = subprocess.run(command, env=os.environ | {name: value}, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"ast_sim.support.errors.ConfigError: {name}={value}: {advice}"


def test_an_empty_variable_is_as_good_as_none(monkeypatch):
    for name, (default, *_) in VARIABLES.items():
        monkeypatch.setenv(name, "")
        assert variable(name) == default
        monkeypatch.delenv(name)
        assert variable(name) == default
    check_variables()


def test_names_that_look_like_ours_are_told_once(monkeypatch):
    environment._warn_of.cache_clear()
    monkeypatch.setenv("AST_SIM_ISAS", "avx2")
    with pytest.warns(UserWarning, match="the environment has AST_SIM_ISAS; the variables of ast_sim are AST_SIM_BA"):
        check_variables()
    with warnings.catch_warnings(action="error"):
        check_variables()


def of_torchrun(monkeypatch, text: str) -> str:
    """The environment "WORLD_SIZE RANK MASTER_ADDR MASTER_PORT", where - is nothing; what an error says of it."""
    told = []
    for name, value in zip(BY_TORCHRUN, text.split(), strict=True):
        monkeypatch.delenv(name, raising=False)
        if value != "-":
            monkeypatch.setenv(name, value)
            told.append(f"{name}={value}")
    return f"the environment has {', '.join(told)}: processes that train together need"


@pytest.mark.parametrize("text", ["- - - -", "- 1 - -", "1 0 - -", "1 - x y", "1 7 - -"])
def test_a_process_is_alone_without_torchrun(monkeypatch, text):
    of_torchrun(monkeypatch, text)
    assert place_among_processes() == (0, 1)


def test_a_process_of_torchrun_knows_its_place(monkeypatch):
    of_torchrun(monkeypatch, "3 2 localhost 29500")
    assert place_among_processes() == (2, 3)


@pytest.mark.parametrize("text", ["2 1 - -", "2 2 h 1", "2 -1 h 1", "2 x h 1", "y 0 h 1", "0 0 h 1", "2 0 h 70000"])
def test_processes_without_a_place_are_refused(monkeypatch, text):
    told = of_torchrun(monkeypatch, text)
    with pytest.raises(ConfigError, match=told):
        place_among_processes()


@pytest.mark.parametrize(("text", "count"), [("", 1), ("0", 1), ("x", 1), ("-2", 1), ("4", 4)])
def test_the_processes_of_a_machine(monkeypatch, text, count):
    monkeypatch.setenv("LOCAL_WORLD_SIZE", text)
    assert processes_on_machine() == count


def test_instructions_that_the_processor_does_not_have():
    code = """
from ast_sim.support import environment
environment.VARIABLES["AST_SIM_ISA"] = ("", "avx4096")
try:
    environment.c_core()
except environment.ConfigError as error:
    print(error)
"""
    assert "AST_SIM_ISA=avx4096 is not supported by this processor" in run_python(code, AST_SIM_ISA="avx4096")


def test_a_process_finds_the_package_that_is_imported_here(tmp_path, monkeypatch):
    root = str(Path(environment.__file__).parents[2])
    monkeypatch.setenv("PYTHONPATH", "before")
    assert of_child(A="1")["PYTHONPATH"] == f"{root}{os.pathsep}before" and of_child(A="1")["A"] == "1"
    monkeypatch.delenv("PYTHONPATH")
    assert of_child()["PYTHONPATH"] == root
    code = [sys.executable, "-P", "-c", "import ast_sim; print(ast_sim.__file__)"]
    shown = subprocess.run(code, env=of_child(), cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert shown.strip() == f"{root}/ast_sim/__init__.py"


def test_no_other_module_reads_a_variable_of_ours():
    package = Path(environment.__file__).parents[1]
    readers = [
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if "os.environ" in (text := path.read_text()) and ('"AST_SIM_' in text or '"PYTHONPATH"' in text)
    ]
    assert readers == ["support/environment.py"]


def test_the_error_is_one_of_configuration(monkeypatch):
    monkeypatch.setenv("AST_SIM_DEBUG", "yes")
    with pytest.raises(ConfigError, match="^AST_SIM_DEBUG=yes: choose 0 or 1, or unset it$"):
        variable("AST_SIM_DEBUG")
