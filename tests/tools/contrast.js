// Returns each visible text of the page whose contrast with what is behind it is below 4.5, as "text: contrast". Evaluated in the page
// by tests/tests/tools/tools_view.rs, which also forces the states of buttons.
(() => {
  const parse = (text) => {
    const [r, g, b, a = 1] = text.match(/[\d.]+/g).map(Number), unit = text.startsWith("color(") ? 255 : 1;
    return [r * unit, g * unit, b * unit, a];
  };
  const over = ([r, g, b, a], [r2, g2, b2]) => [r * a + r2 * (1 - a), g * a + g2 * (1 - a), b * a + b2 * (1 - a), 1];
  const light = (colour) => colour.slice(0, 3).reduce((sum, v, k) => {
    const c = v / 255;
    return sum + [0.2126, 0.7152, 0.0722][k] * (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  }, 0);
  const behind = (it) => {
    if (!it) return [255, 255, 255, 1];
    const own = parse(getComputedStyle(it).backgroundColor);
    return own[3] >= 1 ? own : over(own, behind(it.parentElement));
  };
  const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const text = walker.currentNode.textContent.trim(), it = walker.currentNode.parentElement;
    if (!text || it.closest("script, style, noscript, option, .unseen, svg") || !it.checkVisibility()) continue;
    // WCAG exempts what cannot be used.
    if (it.closest("button:disabled, select:disabled")) continue;
    const back = behind(it), [a, b] = [light(over(parse(getComputedStyle(it).color), back)), light(back)].sort((x, y) => y - x);
    const contrast = (a + 0.05) / (b + 0.05);
    if (contrast < 4.5) found.push(`${text.slice(0, 40)}: ${contrast.toFixed(2)}`);
  }
  return found;
})()
