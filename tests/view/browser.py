"""A real browser without a window: Chromium, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Self

import numpy as np
import websocket
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--mute-audio",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
)
PATIENCE = 180.0  # seconds until something that should happen counts as missing


class Browser:
    """One page of a headless Chromium; a context manager.

    Attributes:
        errors: console errors and uncaught exceptions so far.
        requests: every URL that the page asked for.
    """

    def __init__(self, width: int = 1280, height: int = 900) -> None:
        program = next((found for name in NAMES if (found := shutil.which(name))), None)
        assert program, f"the tests of the report need a browser: install Debian's chromium (looked for {NAMES})"
        # The browser's own processes may still write while they end: what they leave is no failure of a test.
        self._folder = tempfile.TemporaryDirectory(prefix="ast_sim_browser_", ignore_cleanup_errors=True)
        flags = [*FLAGS, f"--window-size={width},{height}", f"--user-data-dir={self._folder.name}"]
        self._log = Path(self._folder.name, "stderr.txt")
        with open(self._log, "wb") as log:
            self._process = subprocess.Popen(
                [program, *flags, "about:blank"], stdout=log, stderr=log, start_new_session=True
            )
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._numbers = itertools.count(1)
        self._events: list[dict[str, Any]] = []
        try:
            self._connect(width, height)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._folder.cleanup()

    def _connect(self, width: int, height: int) -> None:
        port_file = Path(self._folder.name, "DevToolsActivePort")
        wait_for(lambda: port_file.exists() and port_file.read_text().count("\n"), self._why_not)
        port, path = port_file.read_text().split()
        self._socket = websocket.create_connection(f"ws://127.0.0.1:{port}{path}", timeout=PATIENCE)
        self._session = None
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def _why_not(self) -> str:
        return f"the browser did not start: {self._log.read_text(errors='replace')[-2000:]}"

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            reply = json.loads(self._socket.recv())
            if reply.get("id") == number:
                assert "error" not in reply, f"{method}: {reply['error']}"
                return reply["result"]
            self._note(reply.get("method"), reply.get("params", {}))

    def _note(self, method: str, event: dict[str, Any]) -> None:
        if method == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            details = event["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and event["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in event["args"]))
        elif method == "Log.entryAdded" and event["entry"]["level"] == "error":
            self.errors.append(event["entry"]["text"])

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        reply = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in reply, f"{expression}: {reply['exceptionDetails']}"
        return reply["result"].get("value")

    def prefer(self, **features: str) -> None:
        """Emulate CSS media features, for example `prefer(color_scheme="dark")`."""
        listed = [{"name": f"prefers-{name.replace('_', '-')}", "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", features=listed)

    def open(self, path: Path) -> None:
        """Load a page and wait until its scripts are through."""
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.readyState === 'complete'")

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        wait_for(lambda: self.evaluate(condition), lambda: f"never came true: {condition}; errors: {self.errors}")

    def picture(self, selector: str) -> np.ndarray:
        """[height, width, 3] uint8: what is seen of the element that `selector` finds, scrolled into view."""
        x, y, width, height = self._box(selector)
        clip = {"x": x, "y": y, "width": width, "height": height, "scale": 1}
        shot = self.call("Page.captureScreenshot", format="png", clip=clip)
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB"))

    def _box(self, selector: str) -> list[float]:
        """Left, top, width and height of an element on the page, scrolled into view."""
        return self.evaluate(
            f"(() => {{ const node = document.querySelector({json.dumps(selector)});"
            " node.scrollIntoView({ block: 'center', behavior: 'instant' });"
            " const { x, y, width, height } = node.getBoundingClientRect();"
            " return [x + scrollX, y + scrollY, width, height]; })()"
        )

    def click(self, selector: str) -> None:
        self.evaluate(f"document.querySelector({json.dumps(selector)}).click()")

    def drag(self, selector: str, by: tuple[int, int]) -> None:
        """Press the mouse in the middle of an element, move it, release it."""
        left, top, width, height = self._box(selector)
        scroll_x, scroll_y = self.evaluate("[scrollX, scrollY]")
        x, y = left - scroll_x + width / 2, top - scroll_y + height / 2
        way = [("mouseMoved", i / 8) for i in range(1, 9)]
        moves = [("mouseMoved", 0), ("mousePressed", 0), *way, ("mouseReleased", 1)]
        for kind, part in moves:
            pressed = {} if kind == "mouseMoved" and part == 0 else {"button": "left", "buttons": 1, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x + part * by[0], y=y + part * by[1], **pressed)
            time.sleep(0.03)

    def press(self, key: str) -> None:
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, **(text if kind == "keyDown" else {}))


def wait_for(condition: Any, complaint: Any) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, complaint()
        time.sleep(0.05)
