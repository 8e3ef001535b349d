"""The page in a real browser; needs Debian's chromium, which ``make test`` does not install."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from drawing_here import needs_renderer
from midway.reports import report

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")

LOOK = """<script>
addEventListener("load", () => {
  const images = [...document.images];
  const loaded = images.filter(i => i.complete && i.naturalWidth > 500 && i.alt).length;
  const fetched = performance.getEntriesByType("resource").filter(e => !e.name.startsWith("data:"));
  const wide = document.body.scrollWidth - document.body.clientWidth;
  document.title = `images ${images.length} loaded ${loaded} fetched ${fetched.length}` +
    ` wide ${wide}`;
});
</script>"""


FORBIDDEN = "default-src &#39;none&#39;"
"""The page lets no script run."""

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium on this machine: apt-get install chromium to run it"
)


def title_after_loading(page: Path, profile: Path, width: int) -> str:
    """Return what the page found out about itself; nothing may be written to the console."""
    text = page.read_text()
    assert FORBIDDEN in text
    text = text.replace(FORBIDDEN, "script-src &#39;unsafe-inline&#39;")  # for LOOK alone
    page.write_text(text.replace("</body>", LOOK + "</body>"))
    command = [
        BROWSER,
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
    ]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}"]
    command += [f"--window-size={width},900", "--virtual-time-budget=5000", "--dump-dom"]
    done = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, check=True)
    assert "CONSOLE" not in done.stderr
    title = re.search("<title>(.*?)</title>", done.stdout)
    assert title is not None
    return title[1]


@needs_browser
@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_opens_in_a_browser(ris_run, tmp_path, width):
    page, *_ = report([ris_run], tmp_path / "out")
    title = title_after_loading(page, tmp_path / "profile", width)
    assert title == "images 7 loaded 7 fetched 0 wide 0"


@needs_browser
@needs_renderer
def test_the_page_of_images_opens_in_a_browser(image_run, tmp_path, quick_decoder):
    page, *_ = report([image_run], tmp_path / "out")
    title = title_after_loading(page, tmp_path / "profile", 1280)
    assert title == "images 5 loaded 5 fetched 0 wide 0"
