"""Headless Chromium at the other end of two pipes: the DevTools protocol, as much of it as the tests of the report need."""

from __future__ import annotations

import base64
import json
import os
import select
import subprocess
import tempfile
import time
from pathlib import Path

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--mute-audio",
    "--remote-debugging-pipe",
)


class Browser:
    """One page in a browser of its own. `console` collects errors, warnings and requests that leave the file."""

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="browser", ignore_cleanup_errors=True)
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        script = (
            f'exec chromium {" ".join(FLAGS)} --user-data-dir="{self.folder.name}" about:blank 3<&{commands}'
            f" 4>&{answers}"
        )
        self.log = open(Path(self.folder.name) / "log", "w+")
        self.process = subprocess.Popen(
            ["bash", "-c", script], pass_fds=(commands, answers), stdout=self.log, stderr=self.log
        )
        os.close(commands), os.close(answers)
        self._buffer, self._count, self._session = b"", 0, None
        self.console: list[str] = []
        self.requests: list[str] = []
        page = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *exc: object) -> None:
        self.process.terminate()
        self.process.wait()
        os.close(self._commands), os.close(self._answers)
        self.log.close()
        self.folder.cleanup()

    def call(self, method: str, **parameters: object) -> dict:
        """Send a command and return its result; events that come first are kept."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def _receive(self, seconds: float = 120.0) -> dict:
        """The next message; an event is noted where it matters."""
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._answers], [], [], seconds)
            chunk = os.read(self._answers, 1 << 20) if ready else b""
            if not chunk:
                self.log.seek(0)
                raise RuntimeError("chromium does not answer:\n" + self.log.read()[-2000:])
            self._buffer += chunk
        line, self._buffer = self._buffer.split(b"\0", 1)
        message = json.loads(line)
        kind, detail = message.get("method"), message.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.console.append(str(detail["exceptionDetails"].get("exception", {}).get("description", detail)))
        elif kind == "Runtime.consoleAPICalled" and detail["type"] in ("error", "warning", "assert"):
            self.console.append(str(detail["args"]))
        elif kind == "Log.entryAdded" and detail["entry"]["level"] in ("error", "warning"):
            self.console.append(detail["entry"]["text"])
        elif kind == "Network.requestWillBeSent":
            self.requests.append(detail["request"]["url"][:100])
        return message

    def open(self, path: Path, width: int, height: int = 900, dark: bool = False) -> None:
        """Load a file in a window of that size and wait until it and its media are there."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}],
        )
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait(
            "document.readyState === 'complete' && [...document.images].every((i) => i.complete && i.naturalWidth)"
        )

    def run(self, expression: str) -> object:
        """The value of a JavaScript expression in the page; promises are awaited."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Until the expression is true in the page."""
        end = time.monotonic() + seconds
        while not self.run(condition):
            assert time.monotonic() < end, f"never true: {condition}"
            time.sleep(0.05)

    def press(self, name: str, code: int, text: str = "") -> None:
        """One key, down and up."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=name,
                code=name if name != " " else "Space",
                windowsVirtualKeyCode=code,
                text=text,
            )

    def click(self, selector: str) -> None:
        """The left button on the middle of an element, scrolled into view."""
        x, y = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); e.scrollIntoView({{block:"
            " 'center'}); const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self, path: Path) -> None:
        """The whole page as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]))

    def pdf(self) -> bytes:
        """The page as the printer gets it."""
        return base64.b64decode(self.call("Page.printToPDF", printBackground=True)["data"])
