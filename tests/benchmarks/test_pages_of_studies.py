"""Pages of studies are the ones that their committed results make, whose figures are read as they were written."""

import json
from dataclasses import asdict

import pytest

from benchmarks.studies import assembly, jumps


@pytest.mark.parametrize(("study", "record"), [(assembly, assembly.MeasuredProduct), (jumps, jumps.MeasuredRow)])
def test_the_page_is_the_one_that_the_results_make(study, record):
    results = json.loads(study.RESULTS.read_text())
    assert study.page(results) + "\n" == study.PAGE.read_text()
    for values in results.values():
        deepest = record.from_json(values).deepest
        assert json.loads(json.dumps(asdict(deepest))) == values["deepest"]
