"""The problems with known answers that take seconds, with the tolerances of docs/results/verification.md."""

import json

import numpy as np
import pytest

from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from benchmarks.verification import __main__ as verification
from benchmarks.verification import elasticity as verification_elasticity
from benchmarks.verification.problem import Row, at_most, more_than, observed_order, relative

QUICK = {name: problem for name, problem in verification.PROBLEMS.items() if problem.quick}


@pytest.mark.parametrize("name", QUICK)
def test_every_row_is_within_its_tolerance(name):
    outcome = QUICK[name].quick()
    assert outcome.rows
    missed = [f"{row.quantity}: {row.error:.3g} of {row.tolerance:.3g}" for row in outcome.rows if not row.holds]
    assert not missed


def test_a_wrong_material_is_noticed(monkeypatch):
    right = NeoHookean.lam.fget
    monkeypatch.setattr(NeoHookean, "lam", property(lambda self: 1.0001 * right(self)))
    states = [row for row in verification_elasticity.uniaxial().rows if "force" in row.quantity]
    assert states and not any(row.holds for row in states)


def test_rows_hold_only_within_their_tolerance():
    assert relative("x", 2.0, 2.02, 0.011, "").holds and not relative("x", 2.0, 2.02, 0.009, "").holds
    assert at_most("x", -1e-3, 1e-2, "").holds and not at_most("x", np.nan, 1e-2, "").holds
    assert more_than("x", 1e-9, 0.0, "").holds
    assert not more_than("x", 0.0, 0.0, "").holds and not more_than("x", -1.0, 0.0, "").holds
    assert not more_than("x", np.nan, 0.0, "").holds


def test_order_and_limit_of_a_sequence():
    sizes = [0.4, 0.2, 0.1]
    order, limit = observed_order(sizes, [3 + 5 * h**1.5 for h in sizes])
    assert order == pytest.approx(1.5) and limit == pytest.approx(3)
    with pytest.raises(AssertionError):
        observed_order([0.4, 0.3, 0.1], [1.0, 2.0, 4.0])


def test_the_document_shows_a_row_that_fails():
    row = Row("a quantity", 1.0, 2.0, 1.0, 0.1, "a reason", "N")
    found = {
        "made": {"commit": "c" * 40, "processor": "p", "versions": {"numpy": "2"}},
        "seconds": 1.0,
        "rows": [{**row.__dict__, "holds": row.holds}],
        "remarks": ["a remark"],
        "pictures": {"name": {"title": "a title"}},
    }
    text = verification.document({"patch": found})
    assert "| a quantity | 1 N | 2 N | 1.0e+00 | 1.0e-01 | **NO** | a reason |" in text
    assert "0 of 1 rows hold" in text and "verification/patch_name.svg" in text and "a remark" in text
    assert "Not solved yet at this state: `derivatives`" in text
    elsewhere = {**found, "made": {**found["made"], "processor": "q"}}
    text = verification.document({"patch": found, "strip": found, "cost": elsewhere})
    assert "at commit cccccccccc on p (`cost`: q), one thread" in text


def test_the_document_in_the_tree_follows_from_the_records():
    records = json.loads(verification.RECORDS.read_text())
    assert records and list(records) == [name for name in verification.PROBLEMS if name in records]
    assert verification.DOCUMENT.read_text(encoding="utf-8") == verification.document(records)
    for name, record in records.items():
        assert all((verification.PICTURES / f"{name}_{picture}.svg").exists() for picture in record["pictures"])
