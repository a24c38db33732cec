"""The report in a real browser (Chromium): no request, no error, the viewer plays, tables sort, phones fit."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate.comparison.comparison import compare
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.report.report import write_report
from surrogate.comparison.rows.rows import Options

WIDTHS = {"desktop": (1280, 900), "phone": (390, 844)}
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


class Browser:
    """Headless Chromium, spoken to over a pipe in its own protocol; `events` is what a page reported since `open`."""

    def __init__(self, binary: str, profile: Path) -> None:
        for number in (3, 4):
            try:
                os.fstat(number)
            except OSError:
                # What is passed on must be open on this side too, if only to nothing.
                os.dup2(os.open(os.devnull, os.O_RDONLY), number)
        their_in, our_out = os.pipe()
        our_in, their_out = os.pipe()
        switches = ["--headless=new", "--remote-debugging-pipe", "--disable-gpu", "--no-first-run", "--disable-sync",
                    "--disable-background-networking", "--hide-scrollbars", f"--user-data-dir={profile}"]  # fmt: skip
        if os.geteuid() == 0:
            switches.append("--no-sandbox")

        def connect() -> None:
            # The protocol is spoken on descriptors 3 and 4, which may be in use until here.
            free = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (their_in, their_out)]
            for number, end in zip((3, 4), free, strict=True):
                os.dup2(end, number)

        self.process = subprocess.Popen([binary, *switches, "about:blank"], preexec_fn=connect, pass_fds=(3, 4),
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        os.close(their_in)
        os.close(their_out)
        self._in, self._out, self._buffer, self._n = our_in, our_out, b"", 0
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []

    def _receive(self, limit_s: float) -> dict[str, Any]:
        end = time.monotonic() + limit_s
        while b"\0" not in self._buffer:
            if not select.select([self._in], [], [], max(end - time.monotonic(), 0.0))[0]:
                raise TimeoutError("the browser does not answer")
            read = os.read(self._in, 1 << 20)
            if not read:
                raise ConnectionError("the browser has ended")
            self._buffer += read
        message, self._buffer = self._buffer.split(b"\0", 1)
        return dict(json.loads(message))

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._n += 1
        message = {"id": self._n, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive(90.0)
            if answer.get("id") == self._n:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self.events.append(answer)

    def open(self, page: Path, size: tuple[int, int], *, dark: bool = False) -> None:
        """Load a page in a new tab of this size, and wait until it is there."""
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        width, height = size
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                  mobile=width < 600)  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.events.clear()
        self.call("Page.navigate", url=page.as_uri())
        while not any(e["method"] == "Page.loadEventFired" for e in self.events):
            self.events.append(self._receive(90.0))

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression, awaited."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def click(self, selector: str) -> None:
        """Click with the mouse, in the middle of an element."""
        find = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{find}.scrollIntoView({{block: 'center'}})")
        x, y = self.run(f"(r => [r.x + r.width / 2, r.y + r.height / 2])({find}.getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def requests(self) -> list[str]:
        """Every address asked for, except the page itself and what it carries in itself."""
        asked = [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]
        return [url for url in asked if not url.startswith(("data:", "blob:", "file:"))]

    def complaints(self) -> list[dict[str, Any]]:
        """Every error or warning that reached the console, and every exception."""
        return [
            e["params"]
            for e in self.events
            if e["method"] == "Runtime.exceptionThrown"
            or (e["method"] == "Runtime.consoleAPICalled" and e["params"]["type"] in ("error", "warning", "assert"))
            or (e["method"] == "Log.entryAdded" and e["params"]["entry"]["level"] in ("error", "warning"))
        ]

    def screenshot(self) -> bytes:
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def close(self) -> None:
        os.close(self._in)
        os.close(self._out)
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    found = os.environ.get("SURROMD_BROWSER") or next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None or os.name != "posix":
        pytest.skip("no Chromium on this machine (SURROMD_BROWSER names one)")
    started = Browser(found, tmp_path_factory.mktemp("profile"))
    yield started
    started.close()


def _real(shared_data: Path) -> list[Ensemble]:
    folder = shared_data / "alanine-dipeptide"
    loaded = [load_ensemble([folder / f"trajectory-{k}.dcd"], top=folder / "ala2.pdb", lag_ps=1.0) for k in range(3)]
    return [replace(e, segments=[np.asarray(s[:1_000]) for s in e.segments]) for e in loaded]


@pytest.fixture(scope="module")
def page(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real MD against real MD, and against the same with broken frames."""
    reference, good, replicate = _real(shared_data)
    frames = good.segments[0].copy()
    frames[::40] = np.nan
    frames[5:50] *= 1.3
    bad = replace(good, label="bad </script><b>", segments=[frames], chunk_idx=[np.repeat(np.arange(25), 40)])
    found = compare(reference, [good, bad], replicate, options=Options(peptide_recipe=False))
    return write_report(found, tmp_path_factory.mktemp("page") / "report.html")


PICTURE = """(() => {
  const canvas = document.querySelectorAll('.viewer canvas')[%d];
  const copy = Object.assign(document.createElement('canvas'), {width: canvas.width, height: canvas.height});
  const context = copy.getContext('2d', {willReadFrequently: true});
  context.drawImage(canvas, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
  let drawn = 0, orange = 0, sum = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    if (pixels[i + 3] < 128) continue;
    drawn++;
    sum = (sum * 31 + pixels[i] + 7 * pixels[i + 2]) %% 1000000007;
    if (pixels[i] > pixels[i + 2] + 80) orange++;
  }
  return [drawn / (pixels.length / 4), orange / drawn, sum];
})()"""
PAUSE = "new Promise(done => setTimeout(done, {}))"


@pytest.mark.parametrize("name", WIDTHS)
def test_page_opens_without_request_or_complaint_and_fits(browser: Browser, page: Path, name: str) -> None:
    browser.open(page, WIDTHS[name])
    browser.run(PAUSE.format(300))
    assert browser.requests() == []
    assert browser.complaints() == []
    assert browser.run("document.documentElement.scrollWidth") <= WIDTHS[name][0]
    assert len(browser.screenshot()) > 10_000
    # The three lines of the verdict are on the first screen.
    assert browser.run("document.querySelector('.verdict p').getBoundingClientRect().bottom") < WIDTHS[name][1]


@pytest.mark.parametrize("name", WIDTHS)
def test_viewer_plays_both_trajectories(browser: Browser, page: Path, name: str) -> None:
    browser.open(page, WIDTHS[name])
    drawn, orange, before = browser.run(PICTURE % 0)
    assert drawn > 0.02 and 0.2 < orange < 0.8
    browser.click(".viewer [data-viewer=play]")
    browser.run(PAUSE.format(1500))
    browser.click(".viewer [data-viewer=play]")
    frame = int(browser.run("document.querySelector('.viewer').dataset.frame"))
    assert 3 <= frame < 60
    assert browser.run(PICTURE % 0)[2] != before
    browser.run(PAUSE.format(400))
    assert int(browser.run("document.querySelector('.viewer').dataset.frame")) == frame
    browser.click(".viewer [data-viewer=candidate]")
    drawn_alone, orange_alone, _ = browser.run(PICTURE % 0)
    assert orange_alone < 0.01 and 0.01 < drawn_alone < drawn
    assert browser.complaints() == []


def test_viewer_names_faults_and_draws_no_broken_frame(browser: Browser, page: Path) -> None:
    browser.open(page, WIDTHS["desktop"])
    show = """(() => {{ const v = document.querySelectorAll('.viewer')[1], s = v.querySelector('[data-viewer=frame]');
    const c = v.querySelector('[data-viewer=clip]'); c.value = '1'; c.dispatchEvent(new Event('change')); s.value =
    '{}'; s.dispatchEvent(new Event('input')); return [v.querySelector('[data-viewer=fault]').textContent,
    v.querySelector('[data-viewer=time]').textContent]; }})()"""
    fault, when = browser.run(show.format(80))
    assert "candidate: cannot be drawn" in fault and "not finite" in fault
    assert when == "81 ps, chunk 2"
    assert browser.run(PICTURE % 1)[1] < 0.01
    fault, _ = browser.run(show.format(10))
    assert fault == "candidate: bond more than 20 % off"
    assert browser.run(show.format(60))[0] == ""


def test_tables_sort_and_filter(browser: Browser, page: Path) -> None:
    browser.open(page, WIDTHS["desktop"])
    read = """[...document.querySelectorAll('#candidate-2 table.sortable')][0]"""
    values = f"""[...{read}.tBodies[0].rows].filter(r => r.offsetParent && !r.matches('.group'))
      .map(r => r.cells[2].dataset.value).filter(v => v !== '').map(Number)"""
    heads = f"{read}.tHead.rows[0].cells[2]"
    listed = browser.run(values)
    assert len(listed) > 15 and listed != sorted(listed)
    for expected, direction in ((sorted(listed), "ascending"), (sorted(listed, reverse=True), "descending"),
                                (listed, "none")):  # fmt: skip
        browser.run(f"{heads}.querySelector('button').click()")
        assert browser.run(values) == expected
        assert browser.run(f"{heads}.getAttribute('aria-sort')") == direction
    browser.run(f"{read}.previousElementSibling.querySelector('input').click()")
    assert 0 < len(browser.run(values)) < len(listed)
    words = f"""[...{read}.tBodies[0].rows].filter(r => r.offsetParent && r.querySelector('.word'))
      .map(r => r.querySelector('.word').textContent.slice(2))"""
    assert "agrees" not in browser.run(words)


def test_phone_sorts_by_a_menu(browser: Browser, page: Path) -> None:
    browser.open(page, WIDTHS["phone"])
    menu = "document.querySelector('#candidate-2 .sorter select')"
    assert browser.run(f"{menu}.offsetParent !== null")
    browser.run(f"{menu}.value = '6:descending'; {menu}.dispatchEvent(new Event('change'))")
    first = browser.run(
        "document.querySelector('#candidate-2 table.sortable tbody tr:not(.unlisted) .word').textContent"
    )
    assert first == "‼ fails"


def test_dark_mode_changes_the_page_and_the_pictures(browser: Browser, page: Path) -> None:
    colours = """['body', 'figure svg', '.verdict p'].map(s => getComputedStyle(document.querySelector(s)))
      .map((style, k) => k ? style.color : style.backgroundColor)"""
    browser.open(page, WIDTHS["desktop"])
    light = browser.run(colours)
    browser.open(page, WIDTHS["desktop"], dark=True)
    dark = browser.run(colours)

    def brightness(colour: str) -> float:
        return float(np.mean([float(x) for x in colour[4:-1].split(",")]))

    assert [brightness(c) > 128 for c in light] == [True, False, False]
    assert [brightness(c) > 128 for c in dark] == [False, True, True]


def test_watch_sees_requests_and_errors(browser: Browser, tmp_path: Path) -> None:
    """Negative control: a page that asks for something and complains is seen to."""
    bad = tmp_path / "bad.html"
    bad.write_text("<p>x</p><img src='http://127.0.0.1:9/x.png'><script>console.error('no'); undefined.x</script>")
    browser.open(bad, WIDTHS["desktop"])
    browser.run(PAUSE.format(300))
    assert browser.requests() == ["http://127.0.0.1:9/x.png"]
    assert len(browser.complaints()) >= 2


def test_a_request_slipped_into_the_page_is_refused(browser: Browser, page: Path, tmp_path: Path) -> None:
    """The page's own policy keeps it offline even if something in it asks."""
    altered = tmp_path / "altered.html"
    image = '<img src="http://127.0.0.1:9/x.png">'
    altered.write_text(page.read_text("utf-8").replace("</header>", f"{image}</header>", 1), "utf-8")
    browser.open(altered, WIDTHS["desktop"])
    browser.run(PAUSE.format(300))
    assert any("Content Security Policy" in json.dumps(c) for c in browser.complaints())
