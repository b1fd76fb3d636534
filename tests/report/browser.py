"""A headless Chromium over its debugging protocol: opens a page, evaluates, prints."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
import patience

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--remote-debugging-port=0",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--no-first-run",
    # A mouse, which machines without a screen do not have.
    "--blink-settings=primaryHoverType=2,availableHoverTypes=2,primaryPointerType=4,"
    "availablePointerTypes=4",
]
FUNCTIONS = Path(__file__).with_name("browser.js").read_text(encoding="utf-8")


def placed_vertices(solids) -> np.ndarray:
    """Vertices in the frame of the ground [m], (frames, vertices, 3)."""
    ground = np.broadcast_to(np.eye(3, 4), (len(solids.places), 1, 3, 4))
    # Body -1, the ground, is the last one.
    places = np.concatenate([solids.places, ground], axis=1)[:, solids.bodies]
    rotated = np.einsum("fvij,vj->fvi", places[..., :3], solids.vertices)
    return rotated + places[..., 3]


class Browser:
    """One page of a browser; all messages of errors are kept in `errors`."""

    def __init__(self):
        from websockets.sync.client import connect

        self.open_things = contextlib.ExitStack()
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        flags = [*FLAGS, f"--user-data-dir={self.folder.name}", "about:blank"]
        self.process = subprocess.Popen([CHROMIUM, *flags], stderr=subprocess.DEVNULL)
        port = self._port()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            address = next(x for x in json.load(answer) if x["type"] == "page")
        socket = connect(address["webSocketDebuggerUrl"], max_size=None)
        self.socket = self.open_things.enter_context(socket)
        self.numbers, self.errors = itertools.count(1), []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def _port(self) -> str:
        file = Path(self.folder.name) / "DevToolsActivePort"
        for _ in range(20 * patience.SECONDS):
            if file.is_file() and (lines := file.read_text().split()):
                return lines[0]
            time.sleep(0.05)
        raise RuntimeError("the browser does not start")

    def call(self, method: str, **params):
        number = next(self.numbers)
        self.socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            answer = json.loads(self.socket.recv(timeout=patience.SECONDS))
            params = answer.get("params", {})
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(params["exceptionDetails"])
            if params.get("entry", {}).get("level") == "error":
                self.errors.append(params["entry"])
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                return answer["result"]

    def evaluate(self, expression: str):
        found = self.call(
            "Runtime.evaluate",
            expression=expression,
            returnByValue=True,
            awaitPromise=True,
        )
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"])
        return found["result"].get("value")

    def look(self, width: int, scheme: str = "light", media: str = "") -> None:
        """Choose the width of the window [px], and light, dark or print."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", media=media, features=features)

    def open(self, path: Path) -> None:
        """Open a file, wait for its figures, and add the functions of the tests."""
        self.errors.clear()
        self.call("Page.navigate", url=path.resolve().as_uri())
        ready = (
            "document.documentElement.dataset.ready === '' || "
            "!document.querySelector('.chart')"
        )
        self.wait(f"document.readyState === 'complete' && ({ready})")
        self.call("Runtime.evaluate", expression=FUNCTIONS)

    def wait(self, condition: str) -> None:
        for _ in range(20 * patience.SECONDS):
            if self.evaluate(condition):
                return
            time.sleep(0.05)
        raise RuntimeError(f"waited in vain for {condition}")

    def screenshot(self, path: Path, height: int | None = None) -> None:
        """Write a picture of the whole page."""
        box = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {
            "x": 0,
            "y": 0,
            "width": box["width"],
            "height": height or box["height"],
            "scale": 1,
        }
        shot = self.call(
            "Page.captureScreenshot", captureBeyondViewport=True, clip=clip
        )
        path.write_bytes(base64.b64decode(shot["data"]))

    def pdf(self, path: Path) -> None:
        path.write_bytes(
            base64.b64decode(
                self.call("Page.printToPDF", preferCSSPageSize=True)["data"]
            )
        )

    def close(self) -> None:
        self.open_things.close()
        self.process.terminate()
        self.process.wait(30)
        self.folder.cleanup()
