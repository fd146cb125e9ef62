"""Python processes that begin as copies of one that has imported torch and the package: in a tenth of a second, not in
three seconds of the processor.

A copy has streams, an environment, a folder and signals of its own, and ends as any Python process does. What is about
how Python starts, what it imports or what it is linked to needs a new process.
"""

from __future__ import annotations

import atexit
import functools
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Thread
from typing import IO

OPS = ("ast_sim", "torch", "pytest", "hypothesis", "ast_sim.ops")
COMMANDS = [f"ast_sim.command_line.{name}commands" for name in ("", "judging_", "planning_")]
ALL = (*OPS, "torch.distributed", "ast_sim.training.start", "ast_sim.inference.trained_run", *COMMANDS)
DEFAULTS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
TEXT = {"encoding": "utf-8", "errors": "backslashreplace"}


class Forked:
    """`python WORDS` in a copy, with the part of a `subprocess.Popen` that tests use; both outputs are pipes of text.

    Args:
        words: `-c` and code, `-m` and a module, or a script; then its arguments.
        cwd: the folder; by default the one of this process.
        env: all variables; those that libraries read while they are loaded hold, too.
        path: folders that come first in `sys.path`.
        ignored: signals that it ignores from the start, as under `nohup`.
        imported: modules that the model has imported before.
    """

    def __init__(
        self,
        words: Sequence[str | os.PathLike],
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
        path: Sequence[str | os.PathLike] = (),
        ignored: Sequence[signal.Signals] = (),
        imported: Sequence[str] = ALL,
    ) -> None:
        environment = dict(os.environ if env is None else env)
        self.returncode: int | None = None
        out, error = os.pipe(), os.pipe()
        self._told, told = socket.socketpair()
        request = {
            "words": [os.fspath(word) for word in words],
            "cwd": os.fspath(cwd or os.getcwd()),
            "env": environment,
            "path": [os.fspath(folder) for folder in path],
            "ignored": list(ignored),
            "imported": list(imported),
        }
        theirs = [out[1], error[1], told.fileno()]
        socket.send_fds(_server(_read_while_loading(environment)), [json.dumps(request).encode()], theirs)
        os.close(out[1])
        os.close(error[1])
        told.close()
        self.stdout: IO[str] = open(out[0], **TEXT)  # noqa: SIM115
        self.stderr: IO[str] = open(error[0], **TEXT)  # noqa: SIM115
        self.pid = self._next_number(None)

    def _next_number(self, timeout: float | None) -> int:
        self._told.settimeout(timeout)
        number = self._told.recv(8)
        assert len(number) == 8, "what copies processes has ended"
        return int.from_bytes(number, signed=True)

    def wait(self, timeout: float | None = None) -> int:
        """The exit code, negative for a signal; raises TimeoutError."""
        if self.returncode is None:
            self.returncode = self._next_number(timeout)
            self._told.close()
        return self.returncode

    def poll(self) -> int | None:
        """The exit code; None while it runs."""
        try:
            return self.wait(0.0)
        except BlockingIOError:
            return None

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """What is left of both outputs, after its end."""
        shown = {}
        readers = [
            Thread(target=lambda name, stream: shown.update({name: stream.read()}), args=one, daemon=True)
            for one in (("out", self.stdout), ("error", self.stderr))
        ]
        for reader in readers:
            reader.start()
        self.wait(timeout)
        for reader in readers:
            reader.join(timeout)
        self.stdout.close()
        self.stderr.close()
        return shown["out"], shown["error"]

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def run(words: Sequence[str | os.PathLike], **options) -> subprocess.CompletedProcess[str]:
    """A copy to its end, with its outputs; the arguments of `Forked`."""
    copy = Forked(words, **options)
    shown = copy.communicate(300)
    return subprocess.CompletedProcess(list(words), copy.wait(), *shown)


def _read_while_loading(environment: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """The variables that libraries may read while they are loaded, and not again."""
    names = ("AST_SIM_", "OMP_", "MKL_", "GOMP_", "KMP_", "OPENBLAS_")
    return tuple(sorted((key, value) for key, value in environment.items() if key.startswith(names)))


@functools.cache
def _server(variables: tuple[tuple[str, str], ...]) -> socket.socket:
    """Where to ask for copies; their model ends with the process of the tests."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    environment = {key: value for key, value in os.environ.items() if not _read_while_loading({key: value})}
    subprocess.Popen(
        [sys.executable, __file__, str(theirs.fileno())],
        env={**environment, **dict(variables)},
        pass_fds=[theirs.fileno()],
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )
    theirs.close()
    atexit.register(ours.close)
    return ours


def _serve(requests: socket.socket) -> dict:
    """Make a copy for each request; returns in the copy, with its request."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that wait
    while True:
        message, files, *_ = socket.recv_fds(requests, 1 << 20, 3)
        if not message:
            os._exit(0)
        request = json.loads(message)
        for module in request["imported"]:
            importlib.import_module(module)
        gc.freeze()  # what is there is not searched for garbage in each copy
        if os.fork():
            for file in files:
                os.close(file)
            continue
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        requests.close()
        *streams, told = files
        pid = os.fork()
        if not pid:
            for number, file in enumerate(streams, start=1):
                os.dup2(file, number)
            for file in files:
                os.close(file)
            return request
        for file in streams:
            os.close(file)
        os.write(told, pid.to_bytes(8))
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        os.write(told, code.to_bytes(8, signed=True))
        os._exit(0)


def _become(request: dict) -> None:
    """Run the words of a request as Python would."""
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, closefd=False, **TEXT)  # noqa: SIM115
    for number, action in DEFAULTS.items():
        signal.signal(number, signal.SIG_IGN if number in request["ignored"] else action)
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    kind, *rest = request["words"]
    sys.path[:1] = ["" if kind in ("-c", "-m") else os.path.dirname(os.path.abspath(kind)), *request["path"]]
    if kind == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(compile(rest[0], "<code>", "exec"), {"__name__": "__main__"})
    elif kind == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = request["words"]
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    _become(_serve(socket.socket(fileno=int(sys.argv[1]))))
