"""Every example runs, and the number it is about is checked."""

import os
import subprocess
import sys
from pathlib import Path

import nbformat
import toy
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_every_example_is_tested():
    assert sorted(p.name for p in EXAMPLES.iterdir() if p.suffix in (".py", ".ipynb")) == [
        "ask_a_run.ipynb",
        "first_run.py",
        "own_loop.py",
        "own_simulations.ipynb",
    ]


def test_first_run(tmp_path, monkeypatch):
    """Few bumpers on a coarse mesh and few steps: shape and force are already much nearer than rest, whose errors are
    1."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import first_run

    errors = first_run.main(tmp_path, scenes=3, steps=30, nodes=500)
    assert 0 < errors["displacement"] < 0.1
    assert 0 < errors["reaction"] < 0.1


def test_own_loop(tmp_path):
    """With the three imports that it claims; the loss falls by half."""
    text = (EXAMPLES / "own_loop.py").read_text(encoding="utf-8")
    assert len([line for line in text.splitlines() if line.startswith(("import ", "from "))]) == 3
    data = toy.write(tmp_path / "toy.h5", (4, 0, 0))
    command = [sys.executable, str(EXAMPLES / "own_loop.py"), str(data)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    losses = [float(line.split()[-1]) for line in shown.splitlines()]
    assert [line.split(":")[0] for line in shown.splitlines()] == [f"step {step}" for step in range(50, 301, 50)]
    assert 0 < losses[-1] < 0.5 * losses[0]


def outputs_of(name, shorter=()):
    """What a notebook shows when it is run, and its printed text. `shorter` has texts for others in its code."""
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    for long, short in dict(shorter).items():
        (cell,) = [cell for cell in notebook.cells if cell.cell_type == "code" and long in cell.source]
        cell.source = cell.source.replace(long, short)
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(EXAMPLES)}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return outputs, "".join(output.get("text", "") for output in outputs if output.output_type == "stream")


def test_ask_a_run():
    """Each object shows a table and a picture, the error falls with the effort, and the plate from below is told."""
    outputs, text = outputs_of("ask_a_run.ipynb")
    shown = [output["data"]["text/html"] for output in outputs if "text/html" in output.get("data", {})]
    kinds = ["Run", "Scene", "Answer", "Dataset", "Split", "Trajectory", "Evaluation"]
    assert [kind for kind, table in zip(kinds, shown, strict=True) if f"{kind}</" in table] == kinds
    assert [kind for kind, table in zip(kinds, shown, strict=True) if "<svg" in table or "<img" in table] == kinds
    errors = {
        line.split(":")[0]: float(line.split(": ")[1].split()[0]) for line in text.splitlines() if "off, " in line
    }
    assert errors["exact"] == 0 < errors["error=0.02"] < 2 < errors["one call"] < 10
    assert "the network finds the scene more unusual than 97 of 97 calibration scenes" in text
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_own_simulations():
    outputs, text = outputs_of("own_simulations.ipynb", {"steps=500": "steps=200"})
    line = next(line for line in text.splitlines() if line.startswith("error "))
    error, hold = (float(part.split()[-2]) for part in line.split(","))
    assert error < 0.5 * hold, line
    assert any("image/png" in output.get("data", {}) for output in outputs)
