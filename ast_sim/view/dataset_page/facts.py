"""The facts of a dataset as rows of text: its origin, its settings and its sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ast_sim.dataset.layout import FORMAT, VERSION
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import SolverSeconds
from ast_sim.view.dataset_page.survey import SampleFigures

# Records of the samples that are settings, not results: attribute -> (name, unit). The unit "" means none, and "length"
# means the dataset's unit of length.
SETTINGS = {
    "solver": ("Solver", ""),
    "young": ("Young’s modulus", "Pa"),
    "poisson": ("Poisson’s ratio", ""),
    "dhat": ("Contact distance dhat", "length"),
    "kappa": ("Contact stiffness", "Pa"),
    "friction": ("Friction", ""),
}
KNOWN = ("program", "versions", "family", "command", "seed", "licence")


def dataset_facts(dataset: Dataset, samples: Sequence[SampleFigures], seconds: SolverSeconds) -> list[list[str]]:
    """Rows of name and text: file, generator, settings and sizes. "not recorded" stands where the file is silent."""
    info = dataset.info
    generator = dataset.info.generator
    unit = info.length_unit
    element = (
        {3: "triangles", 4: "tetrahedra", 10: "second-order tetrahedra"}[dataset.element_size] if samples else "none"
    )
    center = ", ".join(f"{number:g}" for number in info.domain_center)
    integration = {"quasi_static": "quasi-static: increments are predicted", "dynamic": "accelerations are predicted"}
    stress = {"none": "none", "node": "von Mises, at nodes", "element": "von Mises, one value per element"}
    rows = {
        "Family": info.family,
        "Data file": f"{dataset.path.name}, {dataset.path.stat().st_size / 1e6:,.1f} MB, {FORMAT} version {VERSION}",
        "Command": generator.get("command"),
        "Program": generator.get("program"),
        "Versions": _text(generator.get("versions")),
        "Seed": generator.get("seed"),
        "Licence": generator.get("licence"),
        **{f"Generator: {key}": _text(value) for key, value in generator.items() if key not in KNOWN},
        "Integration": integration[info.integration],
        "Time step": f"{info.time_step:g} s" if info.time_step else "none",
        "Stress": stress[info.stress_location],
        "Length unit": unit,
        "Contact radius": f"{info.contact_radius:g} {unit}",
        "Domain": f"cube around ({center}), half width {info.domain_half_width:g} {unit}",
        **{name: _spread(samples, key, unit if u == "length" else u) for key, (name, u) in SETTINGS.items()},
        "Elements": element,
        "Material columns": ", ".join(dataset.material.columns) or "none" if samples else None,
        "Sizes": _sizes(samples),
        "Solved on": ", ".join(seconds.processors) or None,
    }
    return [[name, "not recorded" if value in (None, "") else str(value)] for name, value in rows.items()]


def _text(value: Any) -> str:
    """A setting as a line: mappings as "key value", lists with commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return "" if value is None else str(value)


def _spread(samples: Sequence[SampleFigures], key: str, unit: str) -> str:
    """The one value of all samples, or the range of their values."""
    words = sorted({str(s.attributes[key]) for s in samples if isinstance(s.attributes.get(key), str)})
    if words:
        return ", ".join(words)
    numbers = [number for sample in samples for number in sample.numbers(key)]
    if not numbers:
        return ""
    low = min(numbers)
    high = max(numbers)
    return f"{low:,.9g}{'' if low == high else f' to {high:,.9g}'} {unit}".strip()


def _sizes(samples: Sequence[SampleFigures]) -> str:
    def span(name: str) -> str:
        values = [getattr(sample, name) for sample in samples]
        low = min(values)
        high = max(values)
        return f"{low:,}{'' if low == high else f' to {high:,}'} {name}"

    return ", ".join(map(span, ("nodes", "elements", "frames", "bodies"))) if samples else ""
