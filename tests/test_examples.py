"""Every example runs, and the number it is about is checked."""

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_every_example_is_tested():
    assert sorted(p.name for p in EXAMPLES.iterdir() if p.suffix in (".py", ".ipynb")) == [
        "own_simulations.ipynb",
        "plates.py",
    ]


def test_plates(tmp_path, monkeypatch):
    """Small plates and few steps: the prediction is already better than holding still."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import plates

    errors = plates.main(tmp_path, scenes=6, nodes=200, steps=300)
    assert 0 < errors["model"] < 0.9 * errors["hold_still"]
    assert 1e-4 < errors["hold_still"] < 0.1


def test_own_simulations():
    notebook = nbformat.read(EXAMPLES / "own_simulations.ipynb", as_version=4)
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(EXAMPLES)}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    text = "".join(output.get("text", "") for output in outputs if output.output_type == "stream")
    line = next(line for line in text.splitlines() if line.startswith("error "))
    error, hold = (float(part.split()[-2]) for part in line.split(","))
    assert error < 0.5 * hold, line
    assert any("image/png" in output.get("data", {}) for output in outputs)
