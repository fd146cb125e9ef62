"""The program `ccx` of CalculiX: where it is, its version, one run of it.

It is licensed under the GPL and runs as a program of its own. Debian and Ubuntu have it as `calculix-ccx`. The
environment variable CCX_BIN names another binary.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from time import monotonic

from ast_sim.support.errors import MissingExtra, SimulationError

JOB = "case"  # name of the deck and of all files that ccx writes
BEST_GUESS = "best solution and residuals are in the frd file"
FAILED = 201  # what ccx returns when it gives up, for whatever reason
HEADING = 4  # lines above the iterations
SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_OF_SILENCE = 600.0  # without an iteration, at least, before ccx is taken to hang
LONGEST = 30  # the same, in times of the longest iteration


def find_ccx() -> str:
    """Path of the binary: CCX_BIN if set, else `ccx` in PATH.

    Raises:
        MissingExtra: there is no such program.
    """
    wanted = os.environ.get("CCX_BIN")
    program = shutil.which(wanted or "ccx")
    if program is None:
        where = f"CCX_BIN={wanted} is no program" if wanted else "ccx is not in PATH and CCX_BIN is not set"
        raise MissingExtra(f"CalculiX is needed here but {where}: apt install calculix-ccx")
    return os.path.abspath(program)  # ccx runs in another folder


def version(ccx: str) -> str:
    """Version that the binary reports, such as "2.20".

    Raises:
        SimulationError: the binary does not run, or reports no version.
    """
    try:
        answer = subprocess.run([ccx, "-v"], capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SimulationError(f"{ccx} does not run: {error}") from error
    match = re.search(r"[Vv]ersion (\d[\w.]*)", answer.stdout)
    if not match:
        raise SimulationError(f"{ccx} -v reports no version; is it CalculiX? {_last_line(answer.stdout)}")
    return match[1]


class Ended(SimulationError):
    """A run crashed or took too long, which other increments may mend. What it wrote may be cut off."""


def run(ccx: str, folder: Path, timeout: float) -> str:
    """Run the deck `JOB` in the folder; return why it ended early, or "".

    Raises:
        Ended: ccx did not end in time, hangs, or crashed.
        SimulationError: ccx failed for another reason than missing convergence.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CCX_NPROC_EQUATION_SOLVER": "1", "CCX_NPROC_RESULTS": "1"}
    log = folder / f"{JOB}.log"
    with open(log, "w") as output:
        try:
            program = subprocess.Popen(
                [ccx, "-i", JOB],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        except OSError as error:
            raise SimulationError(f"{ccx} does not run: {error}") from error
        with program:
            try:
                code = _code(program, folder / f"{JOB}.cvg", timeout)
            except BaseException:
                program.kill()
                raise
    if code == 0:
        return ""
    if code < 0:
        raise Ended(f"ccx was killed by {signal.Signals(-code).name}")
    reason = _error(_read(log))
    if code == FAILED and re.match(r"too many|increment size smaller", reason):
        return f"no convergence in CalculiX: {reason}"
    raise SimulationError(f"ccx ended with code {code}: {reason}")


def _code(program: subprocess.Popen[bytes], iterations: Path, timeout: float) -> int:
    """What the program returns when it has ended.

    The search of CalculiX for contact may never end where bodies begin to touch. It is taken to hang if an iteration
    takes `LONGEST` times as long as the longest before it, and at least `SECONDS_OF_SILENCE`. The first has no limit
    but the timeout. Each iteration adds a line to the file `iterations`, below a heading.

    Raises:
        Ended: it takes longer than the timeout, or hangs.
    """
    start = monotonic()
    last = start
    longest = 0.0
    ended = 0
    while True:
        with suppress(subprocess.TimeoutExpired):
            return program.wait(min(timeout, SECONDS_BETWEEN_LOOKS))
        now = monotonic()
        if now - start >= timeout:
            raise Ended(f"ccx did not end within {timeout:g} s")
        before = ended
        ended = len(_read(iterations).splitlines()[HEADING:]) if iterations.exists() else 0
        if ended > before:
            longest = max(longest, now - last)
            last = now
        elif before and now - last > max(SECONDS_OF_SILENCE, LONGEST * longest):
            raise Ended(f"ccx hangs: no iteration has ended for {now - last:.0f} s, the longest took {longest:.0f} s")


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _error(log: str) -> str:
    """The last message that ccx marks as an error, on one line; else its last words."""
    errors = re.findall(r"\*ERROR:? *(.*(?:\n(?! *\n| *\*).*)*)", log)
    return " ".join(errors[-1].split()).removesuffix(" " + BEST_GUESS) if errors else _last_line(log)


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it printed nothing"])[-1].strip()
