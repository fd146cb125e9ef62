"""Figures that the README and pages of the docs repeat are the ones of the committed results."""

import json
import re
from pathlib import Path
from statistics import mean, median

import pytest

from ast_sim.trade_figures import TradeFigures
from benchmarks.studies import clip_page, example_meshes, jumps
from benchmarks.studies.clip_outcome import Outcome, errors
from benchmarks.studies.clip_variants import FINER

ROOT = Path(__file__).parents[2]
README, EFFORTS, SCENES, OWN_DATA = (
    (ROOT / page).read_text(encoding="utf-8")
    for page in (
        "README.md",
        "docs/how-to/choose-effort.md",
        "docs/how-to/predict-a-scene.md",
        "docs/how-to/own-data.md",
    )
)
QUANTITIES = ("displacement", "reaction", "stress")


def results(name: str) -> dict:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text(encoding="utf-8"))


def numbers(pattern: str, page: str) -> tuple[float, ...]:
    """The numbers in the one place of a page that a pattern describes, whatever its line breaks."""
    (place,) = re.findall(pattern, " ".join(page.split()))
    return tuple(float(text.replace(",", "")) for text in ((place,) if isinstance(place, str) else place))


def test_every_comparison_of_bands_is_counted():
    levels = [
        one for result in results("coverage").values() for row in result["rows"] for one in row["levels"].values()
    ]
    assert all(one["held_interval_99"][0] <= one["held"] <= one["held_interval_99"][1] for one in levels)
    assert numbers(r"In all (\d+) comparisons", README) == (len(levels),)


def test_bands_of_plates():
    plates = results("coverage")["plates"]
    rows = {row["effort"]: row for row in plates["rows"] if row["quantity"] == "displacement"}
    once, steps = rows["0 corrections"], rows["0 corrections, up to 10 Newton steps"]
    held = [row["levels"]["0.95"]["held"] for row in (once, steps)]
    words = r"with (\d+) new plates, the band held in (\d+) plates after one call, and in (\d+) after Newton steps"
    assert numbers(words, README) == (once["fresh_scenes"], *held)
    assert numbers(r"Exactly 95 % would be (\d+)", README) == (round(0.95 * once["fresh_scenes"]),)
    expected = (plates["calibration_scenes"], *once["levels"]["0.95"]["held_interval_99"])
    assert (
        numbers(r"calibrated on (\d+) plates; with so small a number, anything from (\d+) to (\d+)", README) == expected
    )
    shown = re.findall(r"^\| (.*?) \| (\d+) of (\d+) \|$", README, re.MULTILINE)
    rows = {
        "a plate is pressed from below": "pressed from below",
        "a plate is held at one end": "held at one end",
        "a beam instead of a plate": "a beam in place of a plate",
        "a plate is pressed sideways": "pressed sideways",
        "ordinary plates: here a warning is wrong": "fresh scenes",
    }
    told = {row: plates["told"][kind] for row, kind in rows.items()}
    assert shown == [(row, str(one["told"]), str(one["questions"])) for row, one in told.items()]


def test_errors_and_times_of_efforts():
    coverage, trade = results("coverage")["plates"], results("trade")["plates400"]["displacement"]["run"]
    rows = re.findall(r"^\| .*? \| ([\d.]+) % \| ([\d.]+) % \| ([\d.]+) % \| (\d+) ms \|$", EFFORTS, re.MULTILINE)
    in_short = [one for one in trade if "where they move" not in one["name"]]
    for row, of_trade in zip(rows, in_short, strict=True):
        place = coverage["efforts"].index(of_trade["name"])
        kept = [coverage["kept"][quantity][place] for quantity in QUANTITIES]
        shown = [float(f"{100 * error:.{2 if error > 1e-4 else 1}g}") for error in kept]
        assert [float(cell) for cell in row] == [*shown, round(1000 * median(of_trade["seconds"]))]
    ten_steps, *ended = (
        [coverage["kept"][quantity][place] for quantity in QUANTITIES]
        for place, name in enumerate(coverage["efforts"])
        if "up to 10" in name
    )
    assert len(ended) == 3 and all(kept == ten_steps for kept in ended)
    one, two = (trade[place]["errors"] for place in (1, 2))
    same = sum(first == second for first, second in zip(one, two, strict=True))
    assert numbers(r"in (\d+) of (\d+) plates the first step is small", EFFORTS) == (same, len(one))


def test_pairs_of_parts_and_where_the_solver_ends_them():
    figures = results("trade")["parts400"]["displacement"]
    tenth = len(figures["scenes"]) // 10
    kept = {one["name"]: sorted(one["errors"])[-1 - tenth] for one in figures["run"]}
    assert numbers(r"more than a tenth of (\d+) new pairs its error stays above 10 %", README) == (
        len(figures["scenes"]),
    )
    assert all(error > 0.1 for name, error in kept.items() if "solver" not in name)
    ended = "0 corrections, up to 10 Newton steps, then the solver where they move a frame by more than 10 %"
    assert "nine in ten pairs stay within 5 %" in README and kept[ended] <= 0.05
    assert {row["verdict"] for row in figures["rows"]} == {"level", "the solver alone"}


def test_both_sides_of_the_clip_pay_beside_the_same_solver():
    page = clip_page.page(results("clip"))
    counts = numbers(r"in the dataset, the run pays after (\d+) questions, the Gaussian process, .*?after (\d+)", page)
    assert numbers(r"after (\d+) predictions, the Gaussian process its simulations after (\d+)", README) == counts


def test_errors_and_times_of_the_clip():
    """As the page has them, which is made from the same results."""
    found = results("clip")
    page = clip_page.page(found)
    tables = re.findall(r"^\| the run, all frames \|(.*)$", page, re.MULTILINE)[:3]
    shown = re.findall(
        r"^\| \d+ ?(?:,|by|with).*? \| ([\d.]+ ± [\d.]+ %) \| ([\d.]+ ± [\d.]+ %) \|$", README, re.MULTILINE
    )
    assert shown == [(cells[0].strip(), cells[3].strip()) for cells in (row.split("|") for row in tables)]
    process = numbers(
        r"Its errors are ([\d.]+) % \(permanent set\) and ([\d.]+) % \(force\) on the 30 clips, ([\d.]+) % and"
        r" ([\d.]+) % on the 40: .*? there its errors are ([\d.]+) and ([\d.]+) %",
        README,
    )
    medians = [
        100 * median(errors(found[key], "gaussian_process", number))
        for key in clip_page.TABLES
        for number in Outcome._fields
    ]
    assert process == tuple(round(value, 1) for value in medians)
    told = numbers(r"frames 3 and 6 takes (\d+) ms, CalculiX ([\d.]+) s a scene: (\d+) ± (\d+) times", page)
    ours = numbers(r"CalculiX takes (\d+) s a scene .*? The run takes (\d+) ms .*? takes (\d+) ± (\d+) times", README)
    assert ours == (round(told[1]), told[0], *told[2:])
    off = [
        abs(scene["true"]["peak"] / one["peak"] - 1)
        for scene, one in zip(found["scenes"][16:19], found["variants"][FINER.name], strict=True)
    ]
    mesh = numbers(r"their peak force ([\d.]+), ([\d.]+) and ([\d.]+) % wrong", README)
    assert mesh == tuple(sorted(round(100 * value, 1) for value in off))


def test_the_meshes_of_the_examples():
    shown = numbers(r"the force is at most ([\d.]+) % \(hook\) and ([\d.]+) % \(bumper", README)
    rows = results("example_meshes")
    off = [100 * example_meshes.largest_off(rows[name]) for name in ("snap_hook", "bumper")]
    assert shown == tuple(round(value, 1) for value in off) and max(off) < 5


def test_products_at_fixed_errors():
    rows = {
        name: {row.tolerance: row for row in TradeFigures.from_json(results("trade")[name]["displacement"]).rows()}
        for name in ("bumper", "snap_hook")
    }
    hooks, five, one = rows["snap_hook"][0.01], rows["bumper"][0.05], rows["bumper"][0.01]
    words = r"for hooks within 1 %, one call is (\d+) times \((\d+) to (\d+)\)"
    assert numbers(words, README) == (round(hooks.ratio), round(hooks.low), round(hooks.high))
    words = r"for bumpers within 5 %, one call \((\d+) ms\) is (\d+) times \((\d+) to (\d+)\)"
    expected = [round(value) for value in (1000 * five.run.middle, five.ratio, five.low, five.high)]
    assert numbers(words, README) == tuple(expected)
    assert f"frame by frame ({one.solver.middle:.2g} s)" in README and one.run is None


def test_the_error_of_the_mesh_that_a_trade_estimates():
    trade = results("trade")
    estimates = [round(100 * median(trade[row]["reaction"]["mesh_errors"])) for row in ("plates400", "plates1300")]
    shown = numbers(r"of 400 nodes it is (\d+) %, where the error is 96 %; at 1,300 nodes (\d+) %", EFFORTS)
    assert list(shown) == estimates


def test_newton_steps_end_near_the_solver():
    of_scenes = [scene["relative_error"] for scene in results("jumps")["plates400_long"]["deepest"]["scenes"]]
    shown = (float(f"{100 * median(of_scenes):.1g}"), len(of_scenes))
    assert numbers(r"\(([\d.]+) % off in the median of (\d+) plates\)", SCENES) == shown


def test_the_run_that_comes_with_the_package():
    row = results("jumps")["plates400_long"]
    errors = (row["dial"][0]["relative_error"], [scene["relative_error"] for scene in row["deepest"]["scenes"]])
    shown = tuple(float(f"{100 * mean(of_scenes):.2g}") for of_scenes in errors)
    assert numbers(r"has ([\d.]+) and ([\d.]+) %, but in (\d+) other plates", README) == (*shown, len(errors[0]))


@pytest.mark.parametrize(("product", "title"), [("bumper", "Bumper, sec"), ("snap hook", "Snap hook, sec")])
def test_the_products(product, title):
    """README's table has the figures of the page, which is made from the results."""
    page = (ROOT / "docs" / "results" / "assembly.md").read_text(encoding="utf-8")
    cells = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith(f"| {title}")][0]
    solved, trained = numbers(r"\(([\d.]+) min\)", cells[1]) + numbers(r"^(\d+)$", cells[2])
    error, force, seconds, ratio = cells[4], cells[5], cells[7], cells[9].split(", ")[1].removesuffix(" as long")
    (line,) = re.findall(rf"^\| {product}, [^|]*? \| (.*) \|$", README, re.MULTILINE)
    assert line.split(" | ") == [f"{solved + trained:.0f} minutes", error, force, seconds, ratio]


@pytest.mark.parametrize(
    ("row", "scenes"),
    [("plates400_long", "plates of 400 nodes"), ("plates1300", "plates of 1,300 nodes"), ("parts400_long", "pairs of")],
)
def test_what_a_training_leads_to(row, scenes):
    dial = {(one["effort"]["corrections"], one["effort"]["newton_steps"]): one for one in results("jumps")[row]["dial"]}
    shown = [jumps.mean_percent(dial[0, steps]["relative_error"]) for steps in (0, 1, 10)]
    (line,) = re.findall(rf"^\| {scenes}[^|]*?training steps \| (.*) \|$", README, re.MULTILINE)
    assert line.split(" | ") == shown


def test_random_files_of_many_programs():
    result = results("dialects")
    counts = {name: sum(outcomes.values()) for name, outcomes in result["by dialect"].items()}
    own = sum(count for name, count in counts.items() if result["programs"].get(name) == "own text")
    shown = numbers(
        r"([\d,]+) random simulations .*? FEniCS wrote ([\d,]+) of them; the other ([\d,]+) were decks", OWN_DATA
    )
    assert shown == (result["draws"], result["draws"] - own, own)
    outcomes = result["outcomes"]
    pattern = r"([\d,]+) came back right, .*?; ([\d,]+) were refused; none came back as something else"
    assert numbers(pattern, OWN_DATA) == (outcomes["right"], outcomes["refused"])
    assert outcomes["silent"] == outcomes["crash"] == 0


def test_the_decks_of_calculix():
    result = results("ccx_decks")
    read = {name: row["elements of"] for name, row in result["rows"].items() if "read" in row}
    alone = sum(kinds == ["solids"] for kinds in read.values())
    beside = sum("solids" in kinds for kinds in read.values()) - alone
    pattern = (
        r"the (\d+) decks with which CalculiX .*? 2.11\) (\d+) are read: all (\d+) that hold solids alone, all (\d+)"
        r" with .*?, and (\d+) of shells or plane elements.*? in (\d+) of them"
    )
    counts = (result["decks"], len(read), alone, beside, len(read) - alone - beside, result["alike"])
    assert numbers(pattern, OWN_DATA) == counts and result["silent"] == []
    refused = result["refused, by elements"]
    pattern = r"Refused are (\d+) networks of fluid or heat, (\d+) of beams, three of springs or trusses, and one that"
    assert numbers(pattern, OWN_DATA) == (refused["networks"], refused["beams"])
    assert (refused["springs or trusses"], refused["none"]) == (3, 1)
