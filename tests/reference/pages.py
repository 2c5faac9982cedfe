"""What a browser says of a page."""

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
    """Contrasts of what is written in the elements of a selector, the least first, and on what.

    At least 4.5 to 1 is what the accessibility guidelines ask for.
    """
    return page.evaluate(_CONTRASTS, texts)
