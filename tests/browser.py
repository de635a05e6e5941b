"""A headless Chromium for tests of pages: what the page is once its scripts have run, and what its console said."""

import base64
import hashlib
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
    allowed = f"script-src 'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}' "
    text = page.read_text(encoding="utf-8").replace("script-src ", allowed, 1)
    copy.write_text(f"{text}<script>{script}</script>", encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", f"--user-data-dir={folder}/p"]
    call = [browser, *options, "--virtual-time-budget=10000", "--dump-dom", f"file://{copy}"]
    done = subprocess.run(call, capture_output=True, text=True, timeout=120)
    console = re.findall(r"^.*CONSOLE.*$", done.stderr, flags=re.MULTILINE)
    assert not console, console
    return done.stdout
