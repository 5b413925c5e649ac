"""Pages in a headless browser: what the tests of pages need of Chromium and of axe-core."""

import json
import os
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
FLAGS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--hide-scrollbars"]


def axe_source():
    """Return the source of axe-core where npm has it: in the repository, or in the folder that AXE_CORE names."""
    root = Path(__file__).resolve().parents[2]
    for folder in filter(None, (os.environ.get("AXE_CORE"), root / "node_modules" / "axe-core")):
        path = Path(folder) / "axe.min.js"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    return None


def needed(axe=False):
    """Skip the test where there is no browser, or no axe-core, with what to install."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    if axe and axe_source() is None:
        pytest.skip("no axe-core here: npm install axe-core in the repository, or AXE_CORE=its folder")


def violations(page, folder, dark=False):
    """Return what axe-core finds wrong with a page (HTML text): rules and places."""
    script = axe_source().replace("</script", "<\\/script") + (
        ";const told = await axe.run(document,"
        "{runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'best-practice']});"
        "return {dark: matchMedia('(prefers-color-scheme: dark)').matches, wrong: told.violations.map("
        "v => [v.id, v.nodes.map(n => n.html.slice(0, 160)).slice(0, 3)])};"
    )
    told = run_in_page(page, script, folder, dark=dark)
    assert told["dark"] == dark
    return told["wrong"]


def run_in_page(page, script, folder, width=1280, dark=False):
    """Open a page (HTML text), run an async function body in it once it has loaded, and return its JSON result."""
    ending = (
        "<script id=asked>window.addEventListener('load', async () => {const result = await (async () => {SCRIPT})();"
        "const box = document.createElement('pre'); box.id = 'result'; box.textContent = JSON.stringify(result);"
        "document.body.append(box);});</script></body>"
    ).replace("SCRIPT", script)
    path = Path(folder) / "page.html"
    path.write_text(page.replace("</body>", ending), encoding="utf-8")
    flags = [*FLAGS, f"--window-size={width},1400", *(["--force-dark-mode"] if dark else [])]
    done = subprocess.run(
        [CHROMIUM, *flags, f"--user-data-dir={folder}/profile", "--dump-dom", path.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.S)
    assert found, done.stderr[-500:]
    return json.loads(unescape(found[1]))
