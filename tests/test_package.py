"""The package as users get it: a wheel with everything in it, imported without a compiler; what an import loads."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from checks import run_python

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """A wheel built from a copy of the sources."""
    folder = tmp_path_factory.mktemp("build")
    for name in ("csrc", "ast_sim"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder / "dist")]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    complaints = [line for line in result.stdout.splitlines() if line.startswith("csrc/") and "warning:" in line]
    assert not complaints, complaints
    (path,) = (folder / "dist").glob("*.whl")
    return path


def test_wheel_is_one_for_all_pythons_and_whole(wheel):
    assert "-cp311-abi3-" in wheel.name
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, _, files in os.walk(ROOT / "ast_sim"):
        for name in files:
            path = Path(folder, name).relative_to(ROOT).as_posix()
            if path.endswith((".py", ".html", ".css", ".js")):
                assert path in names, path
    assert not [name for name in names if name.startswith(("tests", "csrc", "benchmarks"))]


def test_wheel_works_without_a_compiler(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import shutil, ast_sim, torch
assert ast_sim.__file__.startswith({str(tmp_path)!r}), ast_sim.__file__
assert not any(map(shutil.which, ("cc", "gcc", "clang")))
from ast_sim.ops.segment import segment_sum
print(segment_sum(torch.ones(3, 2), torch.arange(3), torch.tensor([0, 1, 3])).tolist())
ast_sim.show_config()
"""
    out = run_python(code, PATH=str(tmp_path))
    assert out.startswith("[[1.0, 1.0], [2.0, 2.0]]") and "instruction_set" in out


def test_import_loads_little():
    code = "import sys, ast_sim; print([m for m in ('torch', 'scipy', 'h5py', 'meshio', 'ipctk') if m in sys.modules])"
    assert run_python(code).strip() == "[]"
    assert run_python("import ast_sim; print(ast_sim.Scene.__name__, 'MODELS' in dir(ast_sim))").strip() == "Scene True"


def test_unknown_instruction_set_and_backend_are_named():
    for name, value in (("AST_SIM_ISA", "avx9"), ("AST_SIM_BACKEND", "cuda")):
        result = subprocess.run(
            [sys.executable, "-c", "import ast_sim.ops.segment"],
            env=os.environ | {name: value},
            capture_output=True,
            text=True,
        )
        assert result.returncode == 1 and f"{name}={value}" in result.stderr.splitlines()[-1]


def test_backend_torch_needs_no_extension():
    code = "import sys; import ast_sim.ops.segment; print('ast_sim._C' in sys.modules)"
    assert run_python(code, AST_SIM_BACKEND="torch").strip() == "False"
    assert run_python(code, AST_SIM_BACKEND="c").strip() == "True"


def test_debug_mode_notices_a_changed_input():
    """The binding compares inputs with copies; here another thread plays the kernel that writes to one."""
    code = """
import threading, torch
from ast_sim.ops import library
from ast_sim.ops.segment import segment_sum
assert library.configuration()["debug"]
x, order, offsets = torch.ones(400_000, 16), torch.arange(400_000), torch.tensor([0, 400_000])
stop = threading.Event()
def write():
    while not stop.is_set():
        x.add_(1)
thread = threading.Thread(target=write)
thread.start()
try:
    for _ in range(50):
        segment_sum(x, order, offsets)
except AssertionError as error:
    print(error)
stop.set()
thread.join()
"""
    assert "segment_sum: the kernel changed its input x" in run_python(code, AST_SIM_DEBUG="1")


def test_keep_memory_can_be_turned_off():
    code = "import ast_sim; print(ast_sim.keep_memory())"
    assert run_python(code, AST_SIM_KEEP_MEMORY="0").strip() == "False"
    assert run_python(code).strip() == str(sys.platform == "linux")
