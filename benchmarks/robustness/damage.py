"""Damaged files: what the commands make of flipped bits and of files that were cut off.

`python -m benchmarks.robustness.damage --json benchmarks/results/damage.json`. A small dataset is simulated and a run
is trained on it up to the middle. Then, again and again, one bit of one file is flipped, or one file is cut off at a
random place, and the commands that read the file are run: `info`, `evaluate`, and `train --resume` to the end. The
worst of their outcomes counts:

- `same`: the results are the same as with the intact files;
- `warned`: the command ends, and a warning tells of the damage;
- `refused`: one line tells what is wrong, and the exit code is 2;
- `silent`: other results than with the intact files, without a word;
- `traceback`: an exception that a user cannot act on, or an error of several lines.

Results are all numbers and texts of `info` and `evaluate` without times, and every bit of the last checkpoint, of
`best` and of the recorded losses. Temporary files should lie in memory (TMPDIR=/dev/shm), since training syncs often.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import random
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.cli import main as ast_sim_command
from ast_sim.runs import checkpoint
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.support.disk import write_json
from ast_sim.support.progress import Progress
from ast_sim.support.provenance import provenance

STEPS, TRAINED = 3, 2  # of the whole training, and of the run that is damaged
SETTINGS = {
    "batch_size": 2, "validate_every": 1, "log_every": 1, "statistics_pairs": 4, "rollout_pool": 0, "steps": STEPS,
    "keep": 9,
}  # fmt: skip
MODEL = {"hidden": 8, "blocks": 1, "jumps": False}
GROUPS = {
    "dataset": ["data.h5"],
    "seconds": ["data.h5.seconds.json"],
    "settings": ["run/config.toml", "run/scope.toml", "run/run.json"],
    "metrics": ["run/metrics.jsonl", "run/best"],
    "checkpoints": ["run/checkpoints/*/*"],
}
OUTCOMES = ("same", "warned", "refused", "silent", "traceback")  # from good to bad
INFO_DATA, INFO_RUN, EVALUATE, TRAIN = "info data", "info run", "evaluate", "train"
READERS = {  # the commands that read a file of the group
    "dataset": (INFO_DATA, EVALUATE, TRAIN),
    "seconds": (EVALUATE,),
    **dict.fromkeys(("settings", "metrics", "checkpoints"), (INFO_RUN, EVALUATE, TRAIN)),
}

Results = dict[str, Any]


@dataclass(frozen=True)
class Damage:
    """A bit of a file that is flipped (`bit` 0 to 7), or the length that the file is cut off to (`bit` None)."""

    group: str
    file: str
    place: int
    bit: int | None

    def apply(self, folder: Path) -> None:
        content = bytearray((folder / self.file).read_bytes())
        if self.bit is None:
            del content[self.place :]
        else:
            content[self.place] ^= 1 << self.bit
        (folder / self.file).write_bytes(content)


def prepare(folder: Path) -> None:
    """Write `data.h5` and a `run` on it that has been trained to the middle."""
    ast_sim.generate("deforming_plate", folder / "data.h5", train=1, valid=1, test=1, nodes=80, frames=4, workers=1)
    run = folder / "run"
    ast_sim.train(folder / "data.h5", run, model="mgn", model_settings=MODEL, **SETTINGS)
    for step in range(TRAINED + 1, STEPS + 1):
        shutil.rmtree(checkpoint.at_step(run, step))
    metrics = Metrics(run)
    metrics.forget_after(TRAINED)
    best = metrics.best()
    assert best is not None
    RunFolder(run).mark_best(best)


def damages(folder: Path, flips: int, cuts: int, seed: int) -> Iterator[Damage]:
    """Random damages, the groups in turn: first `flips` bits that flip, then `cuts` files that are cut off."""
    draw = random.Random(seed)
    for number in range(flips + cuts):
        group = list(GROUPS)[number % len(GROUPS)]
        files = sorted(path for pattern in GROUPS[group] for path in folder.glob(pattern))
        file = draw.choice(files)
        place, bit = draw.randrange(file.stat().st_size), draw.randrange(8)
        yield Damage(group, str(file.relative_to(folder)), place, bit if number < flips else None)


def run_command(name: str, folder: Path) -> tuple[str, Results, str]:
    """The outcome of a command, as far as it can be told without the intact results; the results; what it said."""
    data, run, out = (str(folder / part) for part in ("data.h5", "run", "evaluation.json"))
    words = {
        INFO_DATA: ["info", "--json", data],
        INFO_RUN: ["info", "--json", run],
        EVALUATE: ["evaluate", run, data, "--solver-scenes", "0", "--out", out, "--overwrite"],
        TRAIN: ["train", "--out", run, "--resume"],
    }[name]
    said, told = io.StringIO(), io.StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(said), redirect_stderr(told):
            warnings.simplefilter("always")
            code = ast_sim_command(words)
        text = told.getvalue()
        lines = [line for line in text.splitlines() if not line.startswith("warning: ")]
        if code:
            return ("refused" if code == 2 and len(lines) == 1 else "traceback"), {}, text
        values = results(name, folder, said.getvalue())
    except Exception:
        return "traceback", {}, traceback.format_exc()
    return ("warned" if text else "same"), values, text


def results(name: str, folder: Path, said: str) -> Results:
    """What the command gave, as flat names and values."""
    if name in (INFO_DATA, INFO_RUN):
        return dict(flat(json.loads(said)))
    if name == EVALUATE:
        return dict(flat(json.loads((folder / "evaluation.json").read_text())))
    last, run = checkpoint.at_step(folder / "run", STEPS), folder / "run"
    files = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*last.iterdir(), run / "best")}
    digests = {str(path.relative_to(folder)): value for path, value in files.items()}
    return {**digests, **dict(flat(list(Metrics(run)), "metrics"))}


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The names and values of all leaves of a JSON value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        yield name, value
    for key, member in inner or ():
        yield from flat(member, f"{name}.{key}")


class Bench:
    """A folder of intact files, a copy of it to damage, and what the commands give on intact files."""

    def __init__(self, folder: Path) -> None:
        self.intact, self.copy = folder / "intact", folder / "copy"
        self.copy.mkdir()
        with redirect_stdout(io.StringIO()):
            prepare(self.copy)  # under the name of each later copy: a run holds the path of its dataset
        self.copy.rename(self.intact)
        self.expected: dict[str, Results] = {}
        for name in (INFO_DATA, INFO_RUN, EVALUATE, TRAIN):
            first, *others = [self._intact(name) for _ in range(3)]
            times = {key for other in others for key in first if other[key] != first[key]} | {
                ".commit",
                ".origin.commit",
            }
            self.expected[name] = {key: value for key, value in first.items() if key not in times}

    def _intact(self, name: str) -> Results:
        self.renew()
        outcome, values, text = run_command(name, self.copy)
        assert outcome == "same", text
        return values

    def renew(self) -> None:
        shutil.rmtree(self.copy, ignore_errors=True)
        shutil.copytree(self.intact, self.copy)

    def outcome(self, damage: Damage) -> tuple[str, str]:
        """The worst outcome of the commands that read the file, and what that command said or gave."""
        self.renew()
        damage.apply(self.copy)
        worst = ("same", "")
        for name in READERS[damage.group]:
            outcome, values, text = run_command(name, self.copy)
            expected = self.expected[name]
            wrong = [key for key in expected if values.get(key) != expected[key]]
            if outcome == "same" and wrong:
                outcome, text = "silent", f"{name}: {wrong[0]}: {values.get(wrong[0])!r}, not {expected[wrong[0]]!r}"
            worst = max(worst, (outcome, text), key=lambda pair: OUTCOMES.index(pair[0]))
        return worst


def measure(flips: int, cuts: int, seed: int, folder: Path) -> dict[str, Any]:
    """The number of each outcome by group and kind of damage, and every bad one in full."""
    bench = Bench(folder)
    counts: dict[str, dict[str, Counter[str]]] = {g: {"flips": Counter(), "cuts": Counter()} for g in GROUPS}
    bad = []
    with Progress(flips + cuts, "damages", True) as progress:
        for damage in damages(bench.intact, flips, cuts, seed):
            outcome, text = bench.outcome(damage)
            counts[damage.group]["cuts" if damage.bit is None else "flips"][outcome] += 1
            if outcome in ("silent", "traceback"):
                bad.append({**vars(damage), "outcome": outcome, "text": text.replace(str(folder), "")})
                progress.line(f"{damage}: {outcome}: {text.strip().splitlines()[-1]}")
            progress.advance(str(damage))
    shown = {g: {kind: {o: c[o] for o in OUTCOMES} for kind, c in kinds.items()} for g, kinds in counts.items()}
    totals = {o: sum(c[o] for kinds in counts.values() for c in kinds.values()) for o in OUTCOMES}
    sizes = {str(p.relative_to(bench.intact)): p.stat().st_size for p in sorted(bench.intact.rglob("*")) if p.is_file()}
    return {"flips": flips, "cuts": cuts, "seed": seed, "totals": totals, "groups": shown, "bad": bad, "bytes": sizes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write the figures here")
    parser.add_argument("--flips", type=int, default=10_000, help="bits that are flipped (%(default)s)")
    parser.add_argument("--cuts", type=int, default=1_000, help="files that are cut off (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the damages (%(default)s)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        record = measure(arguments.flips, arguments.cuts, arguments.seed, Path(folder))
    command = " ".join(["python -m benchmarks.robustness.damage", *sys.argv[1:]])
    write_json(arguments.json, {**provenance(command), **record})
    print(json.dumps(record["totals"]))
    if record["bad"]:
        sys.exit(1)


if __name__ == "__main__":
    main()
