"""Opens a report in headless Chromium: lists its complaints, its requests to the network, and when it was drawn.

    python tools/browse_report.py runs/demo/report.html                 what was seen, one line each
    python tools/browse_report.py runs/demo/report.html --out pictures  light.png, dark.png, zoomed.png, print.pdf, and
                                                                        phone.png, 420 px wide
    python tools/browse_report.py runs/demo/report.html --limit-s 2     fails when it takes longer to be drawn

Chromium has no network but its own process, and a profile that is thrown away. Drawn: everything in view has been
painted, and all traces if the page has any, counted from the beginning of the navigation. Exit status: 0 nothing to
complain of, 1 an error on the console, a request, traces that were not drawn or too late, a page or a table wider than
a phone, 2 wrong usage or no Chromium.
"""

import argparse
import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path
from typing import Any, NamedTuple

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe", "--window-size=1280,900",
)  # fmt: skip
DRAWN = """new Promise(async (resolve) => {
  if (document.readyState !== "complete") await new Promise((loaded) => addEventListener("load", loaded));
  const root = document.documentElement;
  const painted = () => requestAnimationFrame(() => requestAnimationFrame(() => resolve(performance.now())));
  if (!document.getElementById("trace-plan") || root.dataset.traces) return painted();
  new MutationObserver(painted).observe(root, { attributeFilter: ["data-traces"] });
})"""
CLOSER = """new Promise((resolve) => {
  const began = performance.now();
  const contact = document.querySelector(".cards [data-from]") || document.querySelector("[data-move=in]");
  contact.click();
  requestAnimationFrame(() => requestAnimationFrame(() => resolve(performance.now() - began)));
})"""
SETTLED = "new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)))"
REHEARSAL = "for (const when of ['beforeprint', 'afterprint']) dispatchEvent(new Event(when))"
"""What a page does to be printed and after it, without the printing."""
PHONE_PX = 420
WIDER = """(() => {
  const most = document.documentElement.clientWidth;
  const tables = [...document.querySelectorAll("table, .scroll:has(table)")];
  const wide = tables.filter((box) => box.scrollWidth > box.clientWidth + 1);
  const page = document.documentElement.scrollWidth;
  const boxes = wide.map((box) => `a table ${box.scrollWidth} px wide: ${box.innerText.slice(0, 40).split("\\n")[0]}`);
  return (page > most ? [`the page ${page} px wide`] : []).concat(boxes);
})()"""
"""What is wider than the screen, and not a figure in a box of its own."""
TOP_OF_TRACES = """(() => {
  const box = document.querySelector(".bar").getBoundingClientRect();
  return [box.left + scrollX, box.top + scrollY];
})()"""


class Seen(NamedTuple):
    """What a browser made of a page. closer_ms: from a click on a contact to the traces there, None without traces."""

    drawn_s: float
    closer_ms: float | None
    complaints: list[str]
    requests: list[str]
    megabytes: float


class Tab:
    """A page in a browser, spoken to in Chromium's DevTools protocol, one command at a time."""

    def __init__(self, commands: int, answers: RawIOBase) -> None:
        self._commands = commands
        self._answers = answers
        self._rest = b""
        self._session: str | None = None
        self._count = 0
        self.events: list[dict[str, Any]] = []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def ask(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result; what happens meanwhile goes to `events`."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            self.events.append(answer)

    def evaluate(self, expression: str) -> Any:
        """Evaluate an expression in the page, wait for it if it is a promise, and return its value."""
        done = self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        return done["result"].get("value")

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            piece = self._answers.read(1 << 20)
            if not piece:
                raise RuntimeError("Chromium has ended")
            self._rest += piece
        line, self._rest = self._rest.split(b"\0", 1)
        found: dict[str, Any] = json.loads(line)
        return found


def chromium() -> str | None:
    """Find Chromium."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def open_tab(program: str) -> Iterator[Tab]:
    """Start Chromium with a profile of its own, and end it with the block."""
    command_end, commands = os.pipe()
    answers, answer_end = os.pipe()
    # Chromium reads commands from descriptor 3 and answers on 4; the shell puts them there.
    plumbing = f'exec "$@" 3<&{command_end} 4>&{answer_end}'
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        started = ["/bin/bash", "-c", plumbing, "bash", program, *FLAGS, f"--user-data-dir={profile}"]
        process = subprocess.Popen(
            started, pass_fds=(command_end, answer_end), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(command_end)
        os.close(answer_end)
        try:
            with os.fdopen(answers, "rb", buffering=0) as told:
                yield Tab(commands, told)
        finally:
            os.close(commands)  # Chromium ends when nobody speaks to it
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def browse(page: Path, out: Path | None = None) -> Seen:
    """Open a page and look at it; pictures go to `out`. Raises RuntimeError without Chromium."""
    program = chromium()
    if program is None:
        raise RuntimeError(f"there is none of {', '.join(NAMES)}")
    with open_tab(program) as tab:
        for domain in ("Page", "Runtime", "Log", "Network"):
            tab.ask(f"{domain}.enable")
        size = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        tab.ask("Emulation.setDeviceMetricsOverride", **size)
        _colours(tab, "light")
        tab.ask("Page.navigate", url=page.resolve().as_uri())
        drawn_s = 1e-3 * tab.evaluate(DRAWN)
        has_traces = tab.evaluate("document.documentElement.dataset.traces === 'drawn'")
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            _take_pictures(tab, out)
        tab.evaluate(REHEARSAL)
        closer_ms = tab.evaluate(CLOSER) if has_traces else None
        if out is not None and has_traces:
            left, top = tab.evaluate(TOP_OF_TRACES)
            clip = {"x": left - 20, "y": top - 60, "width": 1160, "height": 2000, "scale": 1}
            _save(tab, out / "zoomed.png", clip)
        tab.ask("Emulation.setDeviceMetricsOverride", **{**size, "width": PHONE_PX, "mobile": True})
        tab.evaluate(SETTLED)
        wider = [f"on {PHONE_PX} px: {what}" for what in tab.evaluate(WIDER)]
        if out is not None:
            _save(tab, out / "phone.png", _whole(tab, PHONE_PX))
        complaints, requests = [*_complaints(tab.events), *wider], _requests(tab.events)
    if not has_traces and 'id="trace-plan"' in page.read_text(encoding="utf-8"):
        complaints.append("the traces were not drawn")
    return Seen(drawn_s, closer_ms, complaints, requests, page.stat().st_size * 1e-6)


def _colours(tab: Tab, scheme: str) -> None:
    tab.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])


def _take_pictures(tab: Tab, out: Path) -> None:
    for scheme in ("light", "dark"):
        _colours(tab, scheme)
        tab.evaluate(SETTLED)
        _save(tab, out / f"{scheme}.png", _whole(tab, 1280))
    printed = tab.ask("Page.printToPDF", printBackground=True, preferCSSPageSize=True)["data"]  # while it is dark
    (out / "print.pdf").write_bytes(base64.b64decode(printed))
    _colours(tab, "light")


def _whole(tab: Tab, width: int) -> dict[str, float]:
    """Return the whole page as a clip, of a long one its beginning."""
    box = tab.ask("Page.getLayoutMetrics")["cssContentSize"]
    return {"x": 0, "y": 0, "width": width, "height": min(box["height"], 16_000), "scale": 1}


def _save(tab: Tab, path: Path, clip: dict[str, float]) -> None:
    shot = tab.ask("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
    path.write_bytes(base64.b64decode(shot["data"]))


def _complaints(events: list[dict[str, Any]]) -> list[str]:
    """List what the page put on the console, its exceptions, and what Chromium says of it."""
    lines = []
    for event in events:
        told = event.get("params", {})
        if event["method"] == "Runtime.consoleAPICalled":
            lines.append(" ".join(str(argument.get("value", argument)) for argument in told["args"]))
        elif event["method"] == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            lines.append(details.get("exception", {}).get("description", details["text"]).splitlines()[0])
        elif event["method"] == "Log.entryAdded":
            lines.append(f"{told['entry']['level']}: {told['entry']['text']}")
    return lines


def _requests(events: list[dict[str, Any]]) -> list[str]:
    """List what was asked for besides the page itself."""
    sent = [event["params"] for event in events if event["method"] == "Network.requestWillBeSent"]
    return [request["request"]["url"] for request in sent if request.get("type") != "Document"]


def main() -> int:
    """Browse the reports that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--out", type=Path, help="folder for pictures")
    parser.add_argument("--limit-s", type=float, default=float("inf"))
    arguments = parser.parse_args()
    if not arguments.page.is_file():
        parser.error(f"there is no {arguments.page}")
    try:
        seen = browse(arguments.page, arguments.out)
    except RuntimeError as error:
        print(f"browse_report: {error}", file=sys.stderr)
        return 2
    closer = "no traces" if seen.closer_ms is None else f"{seen.closer_ms:.0f} ms from a contact to its traces"
    print(f"{arguments.page}: {seen.megabytes:.2f} MB, drawn after {seen.drawn_s:.2f} s, {closer}")
    for complaint in seen.complaints:
        print(f"  complains: {complaint}")
    for request in seen.requests:
        print(f"  asks for: {request}")
    print(f"  {len(seen.complaints)} complaints, {len(seen.requests)} requests")
    is_late = seen.drawn_s > arguments.limit_s
    return 1 if seen.complaints or seen.requests or is_late else 0


if __name__ == "__main__":
    sys.exit(main())
