"""A headless Chromium for tests of pages: what the page is once its scripts have run, and what its console said."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def opened(page: Path, folder: Path, *, script: str = "") -> str:
    """The DOM of a copy of `page` (in `folder`) after `script` has run in it. A message on the console fails the test."""
    browser = next((found for name in NAMES if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no Chromium here to look at the page with (looked for {', '.join(NAMES)})")
    copy = folder / "opened.html"
    copy.write_text(page.read_text(encoding="utf-8") + f"<script>{script}</script>", encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", f"--user-data-dir={folder}/p"]
    call = [browser, *options, "--virtual-time-budget=10000", "--dump-dom", f"file://{copy}"]
    done = subprocess.run(call, capture_output=True, text=True, timeout=120)
    console = re.findall(r"^.*CONSOLE.*$", done.stderr, flags=re.MULTILINE)
    assert not console
    return done.stdout
