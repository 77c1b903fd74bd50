"""A headless Chromium, driven over the WebDriver protocol of Debian's package chromium-driver."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


def lacking() -> str:
    """Why there is no browser; empty if there is one."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return (
        f"no {' and no '.join(missing)}: apt-get install chromium chromium-driver"
        if missing
        else ""
    )


class Browser:
    """One page of a browser, closed at the end of a ``with`` block.

    Args:
        width, height: Of the window [pixels].
    """

    def __init__(self, width: int = 1280, height: int = 760):
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        log = Path(self.profile.name) / "driver.log"
        with open(log, "wb") as file:
            self.driver = subprocess.Popen(
                ["chromedriver", "--port=0"], stdout=file, stderr=subprocess.STDOUT
            )
        mark, deadline = "on port ", time.monotonic() + 20
        while mark not in (text := log.read_text()).replace("on port 0", ""):
            if time.monotonic() > deadline:
                raise RuntimeError(f"chromedriver does not start: {text}")
            time.sleep(0.05)
        self.url = f"http://127.0.0.1:{int(text.rsplit(mark, 1)[1].split('.')[0])}/session"
        options = [
            *FLAGS,
            f"--window-size={width},{height}",
            f"--user-data-dir={self.profile.name}/profile",
        ]
        wanted = {"goog:chromeOptions": {"args": options}, "goog:loggingPrefs": {"browser": "ALL"}}
        self.url += "/" + self.ask("", capabilities={"alwaysMatch": wanted})["sessionId"]

    def __enter__(self) -> "Browser":
        return self

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            urlopen(Request(self.url, method="DELETE"), timeout=20)
        except URLError:
            pass  # the browser has crashed
        self.driver.terminate()
        self.driver.wait()
        self.profile.cleanup()

    def ask(self, command: str, **body: Any) -> Any:
        """The value of a command of the W3C's WebDriver."""
        request = Request(
            self.url + command, json.dumps(body).encode(), {"Content-Type": "application/json"}
        )
        try:
            with urlopen(request, timeout=120) as answer:
                return json.load(answer)["value"]
        except HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from None

    def open(self, url: str) -> None:
        self.ask("/url", url=url)

    def run(self, script: str) -> Any:
        """The value that a script returns."""
        return self.ask("/execute/sync", script=script, args=[])

    def wait(self, condition: str, seconds: float = 60) -> None:
        """Waits until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{condition} is not true after {seconds} s: {self.log()}")
            time.sleep(0.05)

    def drag(self, *places: tuple[float, float], pause: int = 0) -> None:
        """Presses the mouse at the first place [pixels], moves it on, and releases it."""
        moves = [
            {"type": "pointerMove", "duration": pause, "x": round(x), "y": round(y)}
            for x, y in places
        ]
        down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
        self.ask(
            "/actions",
            actions=[
                {"type": "pointer", "id": "mouse", "actions": [moves[0], down, *moves[1:], up]}
            ],
        )

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.ask_get("/screenshot")))

    def ask_get(self, command: str) -> Any:
        with urlopen(self.url + command, timeout=60) as answer:
            return json.load(answer)["value"]

    def log(self) -> list[str]:
        """Messages of the console since the last call."""
        return [
            f"{entry['level']}: {entry['message']}" for entry in self.ask("/se/log", type="browser")
        ]
