"""The multiply-adds per second that this machine can do, measured by a C program that does nothing else."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path


def peak(threads: int) -> dict[str, float] | None:
    """Float32 GF/s of register-only multiply-adds on 1 and on all threads; None without a C compiler."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "peak"
        source = Path(__file__).with_name("peak.c")
        try:
            build = ["cc", "-O3", "-march=native", "-ffp-contract=fast", "-pthread", str(source), "-o", str(program)]
            subprocess.run(build, check=True)
            out = subprocess.run([str(program), str(threads)], check=True, capture_output=True, text=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return None
    one, all_threads = (float(x) for x in out.split())
    return {"1": one, str(threads): all_threads}
