"""Pages in a browser, and measurements of them."""

from contextlib import contextmanager
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
WIDTHS = {"phone": 390, "desk": 1280}

_CONTRASTS = """(texts) => {
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255).map(
    (v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4
  ).reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const numbers = (text) => text.match(/[\\d.]+/g).map(Number);
  const ground = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const [r, g, b, a] = numbers(getComputedStyle(e).backgroundColor);
      if (a === undefined || a === 1) return [r, g, b];
    }
  };
  return [...document.querySelectorAll(texts)]
    .filter((e) => e.getClientRects().length).map((e) => {
      const [a, b] = [light(numbers(getComputedStyle(e).color)), light(ground(e))];
      return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), e.className || e.tagName];
    }).sort((one, other) => one[0] - other[0]);
}"""


@contextmanager
def chromium():
    """Start a browser, and close it; skip a test where none is installed."""
    driver = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (./dev test installs it)"
    )
    if not CHROMIUM.exists():
        pytest.skip(f"no browser: {CHROMIUM} is missing (Debian's package chromium)")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(CHROMIUM), args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


def shown(browser, path, screen="desk", scheme="light"):
    """Open a page; return it with a list of its complaints and requests."""
    context = browser.new_context(
        viewport={"width": WIDTHS[screen], "height": 900},
        color_scheme=scheme,
        has_touch=screen == "phone",
    )
    page, noise = context.new_page(), []
    page.on("console", lambda message: noise.append(message.text))
    page.on("pageerror", lambda error: noise.append(str(error)))
    page.on("request", lambda request: noise.append(request.url))
    page.goto(path.as_uri())
    return page, noise


def contrasts(page, texts):
    """Return the contrast of text and background of the selected elements, lowest first.

    The accessibility guidelines require at least 4.5 to 1.
    """
    return page.evaluate(_CONTRASTS, texts)
