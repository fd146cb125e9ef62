"""How published figures were made: by which command and commit, on which processor, with which versions."""

from __future__ import annotations

import contextlib
import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

_PACKAGES = ("ast_sim", "torch", "numpy")


def provenance(command: str) -> dict[str, Any]:
    """The command, the commit, the processor, the number of cores and the versions: what to keep beside figures."""
    return {
        "command": command,
        "commit": commit_of(Path(__file__).resolve().parents[2]),
        "processor": processor(),
        "cores": os.cpu_count(),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
    }


def commit_of(root: Path) -> str | None:
    """The commit of a source tree; None if the folder is none, as where the package is installed."""
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def processor() -> str:
    """The name of this machine's processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
