"""The system's Chromium, headless, driven through Playwright; without either of them tests say so and are skipped."""

import os
import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

# Software rendering by name, since falling back to it is going away; no name but this machine's resolves.
_ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
]  # fmt: skip
_NAMES = ("chromium", "chromium-browser", "google-chrome")
ARTIFACTS = Path(os.environ.get("DISCO_HW_ARTIFACTS", "out/screenshots"))


@contextmanager
def chromium():
    """A browser, for the block."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = next((path for path in map(shutil.which, _NAMES) if path), None)
    if found is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver, TemporaryDirectory(prefix="disco-hw-browser-") as scratch:
        # It draws without a graphics card, and must not take the processor from a robot that is simulated beside it.
        behind = Path(scratch) / "chromium"
        behind.write_text(f'#!/bin/sh\nexec nice -n 5 {found} "$@"\n', encoding="utf-8")
        behind.chmod(0o700)
        browser = driver.chromium.launch(executable_path=behind, headless=True, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser, url, width=800, height=540, scene=True):
    """A page of the address, and what its console said is kept in `page.said`; an error of its script fails the test.

    Without its `scene` a desk is as quick as with a graphics card; with it a mouse that moves waits for frames.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(120_000)
    page.output_lines, broken = [], []
    page.on("pageerror", lambda error: broken.append(str(error)))
    page.on("console", lambda message: page.output_lines.append(message.text))
    page.on("request", lambda request: page.output_lines.append(f"request {request.url}"))
    if not scene:
        page.route("**/index.html*", lambda route: route.abort())
    page.goto(url)
    try:
        yield page
    finally:
        page.close()
    assert not broken, f"the page's script failed: {broken[:3]}"


_OPERATED = frozenset({
    "button", "checkbox", "combobox", "link", "radio", "searchbox", "slider", "spinbutton", "switch", "tab", "textbox",
})  # fmt: skip


def unnamed(page):
    """Return the controls that a screen reader has no name for, or that no key reaches; by Chromium's own tree."""
    session = page.context.new_cdp_session(page)
    found = []
    for node in session.send("Accessibility.getFullAXTree")["nodes"]:
        role, accessible_name = node.get("role", {}).get("value"), node.get("name", {}).get("value", "").strip()
        if node.get("ignored") or role not in _OPERATED:
            continue
        properties = {each["name"]: each["value"].get("value") for each in node.get("properties", [])}
        if not accessible_name:
            found.append(f"{role} without a name")
        if not properties.get("focusable") and not properties.get("disabled"):
            found.append(f"{role} {accessible_name!r} that no key reaches")
    session.detach()
    return found


def keep(page, name):
    """Keep a screenshot for a person to look at; a machine that is too busy to take one goes on without."""
    from playwright.sync_api import TimeoutError as TooBusy  # noqa: PLC0415 - a test dependency

    ARTIFACTS.mkdir(parents=True, exist_ok=True)
    with suppress(TooBusy):
        page.screenshot(path=str(ARTIFACTS / f"{name}.png"), timeout=20_000)
