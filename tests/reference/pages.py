"""Measurements of a rendered page in a browser."""

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


def contrasts(page, texts):
    """Return the contrast of text and background of the selected elements, lowest first.

    The accessibility guidelines require at least 4.5 to 1.
    """
    return page.evaluate(_CONTRASTS, texts)
