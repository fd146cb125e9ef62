"""The package as users get it: a wheel with everything in it, imported without a compiler; what an import loads."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
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
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    setup, kernels = (ROOT / "setup.py").read_text(), "FLAGS + flags"
    assert kernels in setup  # `make check` compiles them with -O3 and all warnings, a minute and a half
    (folder / "setup.py").write_text(setup.replace(kernels, f'{kernels} + ["-O0"]'))
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder / "dist")]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    told = (result.stdout + result.stderr).splitlines()
    complaints = [line for line in told if line.startswith("csrc/") and "warning:" in line]
    assert not complaints, complaints
    (path,) = (folder / "dist").glob("*.whl")
    return path


def test_make_installs_system_packages_only_if_asked():
    environment = {name: value for name, value in os.environ.items() if name != "MAKEFLAGS"}

    def steps(target: str) -> str:
        command = ["make", "--dry-run", target]
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout

    installing = "apt-get update"
    assert installing not in steps("check") and installing not in steps("test") and installing in steps("install-tools")
    assert "make install-tools" in (ROOT / ".ci" / "run").read_text()


def test_wheel_is_one_for_all_pythons_and_whole(wheel):
    assert "-cp311-abi3-" in wheel.name
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, _, files in os.walk(ROOT / "ast_sim"):
        for name in files:
            path = Path(folder, name).relative_to(ROOT).as_posix()
            if path.endswith((".py", ".pyi", ".typed", ".html", ".css", ".js", ".ast")):
                assert path in names, path
    assert not [name for name in names if name.startswith(("tests", "csrc", "benchmarks"))]


def test_wheel_installs_in_a_fresh_environment_and_answers(wheel, tmp_path):
    """The environment sees the dependencies that are installed here, and no compiler."""
    fresh = tmp_path / "fresh"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", fresh], check=True)
    (site,) = fresh.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = [sys.executable, "-m", "pip", "--python", fresh / "bin" / "python", "install"]
    subprocess.run([*pip, "--quiet", "--no-index", "--no-deps", "--ignore-installed", wheel], check=True)
    where = """
import shutil, sys, ast_sim
assert ast_sim.__file__.startswith(sys.prefix), ast_sim.__file__
assert not any(map(shutil.which, ("cc", "gcc", "clang")))
"""
    question = """
import ast_sim
plate = ast_sim.plate((0.48, 0.32, 0.03), cells=(11, 8, 2))
punch = ast_sim.box((-0.05, -0.05, 0.023), (0.05, 0.05, 0.123), cells=(2, 2, 2))
mesh = ast_sim.read_scene(ast_sim.Scene.join(plate, punch).to_meshio(), obstacles=[1], clamps=["0:xmin,xmax"])
answer = ast_sim.example_run("plates").predict(mesh.scene, {1: (0, 0, -0.03)}, frames=[-1], effort=ast_sim.Effort())
middle = abs(mesh.scene.rest_position[:, :2]).max(1) < 0.03
under = middle & (mesh.scene.body == 0)
print(1000 * (answer.position[-1] - mesh.scene.rest_position)[under, 2].mean())
with ast_sim.Dataset(clips) as data:
    clip = data["test"][0]
(left,) = ast_sim.example_run("clip").predict(clip).permanent_set()
print(left.largest / ((clip.position[-1] - clip.position[0]) ** 2).sum(1).max() ** 0.5)
"""
    question = f"clips = {str(ROOT / 'examples' / 'clip' / 'test_scenes.h5')!r}{question}"
    python = [fresh / "bin" / "python", "-c", where + question]
    result = subprocess.run(python, env={"PATH": str(fresh / "bin")}, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    # The punch starts 8 mm above the plate, whose middle it bends farther down. The clip keeps the set of CalculiX.
    millimetres, share_of_set = map(float, result.stdout.split())
    here = [float(line) for line in run_python(question).split()]
    assert [millimetres, share_of_set] == pytest.approx(here, abs=1e-3)
    assert -30 < millimetres < -20 and share_of_set == pytest.approx(1, abs=0.1)


def test_import_loads_little():
    code = "import sys, ast_sim; print([m for m in ('torch', 'scipy', 'h5py', 'meshio', 'ipctk') if m in sys.modules])"
    assert run_python(code).strip() == "[]"
    code = "import ast_sim; print(ast_sim.Scene.__name__, 'new_model' in dir(ast_sim))"
    assert run_python(code).strip() == "Scene True"


def test_training_and_predicting_need_no_extra(tmp_path, monkeypatch):
    """Newton steps of the solver belong to an answer, so what they import is installed with the package. Torch's
    compiler, which imports SymPy, would take two seconds of each training."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = (project["optional-dependencies"][name] for name in ("simulate", "cad", "cluster", "view"))
    modules = [re.split("[<>=;]", requirement)[0] for extra in extras for requirement in extra]
    code = f"""
import sys
sys.modules.update(dict.fromkeys({modules!r}))
import toy, ast_sim
from ast_sim.dataset.writer import DatasetWriter
with DatasetWriter("toy.h5", toy.info()) as writer:
    for seed, split in enumerate(("train", "valid", "test")):
        plate = toy.plate(seed)
        plate.attributes.update(young=1e6, poisson=0.4, dhat=0.001)
        writer.add(split, plate)
run = ast_sim.train("toy.h5", "run", steps=2)
with ast_sim.Dataset("toy.h5") as data:
    answer = run.predict(data["test"][0], frames=[-1], effort=ast_sim.Effort(newton_steps=1))
print(answer.failure, len(answer.last_steps), [name for name in ("torch._dynamo", "sympy") if name in sys.modules])
"""
    monkeypatch.chdir(tmp_path)
    assert run_python(code, PYTHONPATH=str(ROOT / "tests")).splitlines()[-1] == "None 1 []"


def test_every_extra_asks_for_what_its_code_imports():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert "google-crc32c" not in project["dependencies"] and extras["tfrecord"] == ["google-crc32c"]
    assert extras["view"] == ["plotly", "matplotlib"]  # no VTK, which only tests of the files for ParaView need
    assert "pyvista" in extras["test"]


def test_idle_threads_soon_sleep_unless_told_otherwise():
    """OpenMP reads its variables when torch is imported, so they must be there before."""
    unset = {key: value for key, value in os.environ.items() if key not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}

    def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env={**unset, **variables}, capture_output=True, text=True, check=True)

    show = "; print(os.environ.get('GOMP_SPINCOUNT'))"
    for code in ("import os, ast_sim", "import os, ast_sim.cli"):
        found = run(code + show)
        assert (found.stdout, found.stderr) == ("10000\n", "")
        assert run(code + show, OMP_WAIT_POLICY="active").stdout == "None\n"
        assert run(code + show, GOMP_SPINCOUNT="9").stdout == "9\n"
    late = "import os, torch, ast_sim, ast_sim.ops" + show
    found = run(late)
    assert found.stdout == "None\n" and found.stderr.count("Warning") == 1
    assert "Import ast_sim first, or set GOMP_SPINCOUNT=10000" in found.stderr
    assert run(late, OMP_WAIT_POLICY="passive").stderr == ""


def test_backend_torch_needs_no_extension():
    code = "import sys; import ast_sim.ops._segment; print('ast_sim._C' in sys.modules)"
    assert run_python(code, AST_SIM_BACKEND="torch").strip() == "False"
    assert run_python(code, AST_SIM_BACKEND="c").strip() == "True"


def test_debug_mode_notices_a_changed_input():
    """The binding compares inputs with copies; here another thread plays the kernel that writes to one."""
    code = """
import threading, torch
from ast_sim.ops import library
from ast_sim.ops._segment import segment_sum
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
