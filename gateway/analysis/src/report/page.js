// Shows the values of a figure under the pointer, a finger, or the cursor of the keyboard, and copies commands. Without this script the
// page lacks only that.
(() => {
  const SVG = "http://www.w3.org/2000/svg", PREFIXES = ["p", "n", "µ", "m", "", "k", "M"], POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  // A point this close to the pointer is read in both directions, in pixels; else only the time counts.
  const NEAR = 5;
  const element = (tag, text, className) => Object.assign(document.createElement(tag), { textContent: text ?? "", className: className ?? "" });
  const shape = (tag, attributes) => {
    const it = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) it.setAttribute(name, value);
    return it;
  };

  // A number with three digits, and a value with the prefix that leaves 1 to 999, as elsewhere on the page.
  function number(value) {
    const [digits, power] = String(Number(value.toPrecision(3))).replace("-", "−").split("e");
    return power ? `${digits}·10${[...power.replace("+", "")].map((it) => POWERS[it] ?? "⁻").join("")}` : digits;
  }
  function quantity(value, { unit, base, size, most }) {
    if (!base) return number(value) + (unit ? `\u00a0${unit}` : "");
    const scaled = Number((value * size).toPrecision(3));
    const power = scaled === 0 ? 0 : Math.max(-4, Math.min(most, Math.floor(Math.log10(Math.abs(scaled)) / 3 + 1e-9)));
    return `${number(value * size / 1000 ** power)}\u00a0${PREFIXES[power + 4]}${base}`;
  }

  // Values and places along an axis, with as many digits as can be seen.
  const valueAt = ({ at: [a, b], ends: [from, to], log }, place) => {
    const part = (place - a) / (b - a);
    if (log) return from * (to / from) ** part;
    const grain = 10 ** Math.round(Math.log10(Math.abs((to - from) / (b - a))));
    return Math.round((from + part * (to - from)) / grain) * grain;
  };
  function placeText(axis, place) {
    if (axis.unit !== "s" || axis.log) return quantity(valueAt(axis, place), axis);
    const digits = Math.max(0, Math.min(3, Math.ceil(-Math.log10((axis.ends[1] - axis.ends[0]) / 1000))));
    return `${valueAt(axis, place).toFixed(digits).replace("-", "−")}\u00a0s`;
  }

  // Readers of the three kinds of drawings. Each finds the spot for a point of the drawing and moves a spot; a spot has its place, a
  // heading, and rows of a colour, a name and a value.
  function plotReader(svg) {
    const drawn = [...svg.querySelectorAll("[class^=c]")].filter((it) => /^c\d/.test(it.getAttribute("class")));
    let next = 0;
    const plots = JSON.parse(svg.dataset.plots).map((plot) => {
      const series = plot.series.map(([name, count]) => {
        const parts = drawn.slice(next, next += count), of = (tag) => parts.filter((it) => it.tagName === tag);
        const lines = of("polyline").map((it) => it.getAttribute("points").trim().split(" ").map((pair) => pair.split(",").map(Number)));
        const dots = of("circle").map((it) => ["cx", "cy"].map((name) => Number(it.getAttribute(name))));
        return { name, like: parts[0], lines, dots };
      });
      next += plot.keys;
      return { ...plot, series };
    });
    const all = plots.flatMap(({ series }) => series.flatMap(({ lines, dots }) => [...lines.flat(), ...dots])).sort((a, b) => a[0] - b[0]);
    const scale = svg.viewBox.baseVal.width / 960, { x } = plots[0];
    // The height of a series at a place: the point that was found, else on the line between two points.
    function heightAt({ lines, dots }, [place, found]) {
      const points = [...lines, ...dots.map((dot) => [dot])];
      for (const line of points) if (line.some((it) => it === found)) return found[1];
      for (const line of points) {
        if (place < line[0][0] || place > line.at(-1)[0]) continue;
        const i = line.findLastIndex((it) => it[0] <= place), [a, b] = [line[i], line[i + 1] ?? line[i]];
        return b[0] === a[0] ? a[1] : a[1] + (b[1] - a[1]) * (place - a[0]) / (b[0] - a[0]);
      }
      return null;
    }
    function spot(point) {
      const rows = [], marks = plots.map(({ y }) => shape("line", { x1: point[0], x2: point[0], y1: y.at[0], y2: y.at[1] }));
      for (const { y, series } of plots) {
        for (const one of series) {
          const height = heightAt(one, [point[0], point]);
          if (height === null) continue;
          rows.push({ like: one.like, name: one.name, value: quantity(valueAt(y, height), y) });
          const dot = shape("circle", { cx: point[0], cy: height, r: 4 * scale * 0.7 });
          dot.setAttribute("class", one.like.getAttribute("class").replace(/s$/, "f"));
          marks.push(dot);
        }
      }
      return { point, now: valueAt(x, point[0]), head: placeText(x, point[0]), rows, marks };
    }
    return {
      range: x.ends,
      find(px, py, unit) {
        const far = ([a, b]) => (Math.abs(a - px) > NEAR * unit ? 1e12 + (a - px) ** 2 : (a - px) ** 2 + (b - py) ** 2);
        const inside = px >= x.at[0] - NEAR * unit && px <= x.at[1] + NEAR * unit;
        return inside && all.length ? spot(all.reduce((best, it) => (far(it) < far(best) ? it : best))) : null;
      },
      move(from, dx) {
        if (!from || !all.length) return all.length ? spot(all[0]) : null;
        const least = dx * (x.at[1] - x.at[0]) / 300, goal = from.point[0] + least;
        const beyond = all.filter((it) => (dx > 0 ? it[0] >= goal : it[0] <= goal));
        return spot((dx > 0 ? beyond[0] : beyond.at(-1)) ?? (dx > 0 ? all.at(-1) : all[0]));
      },
    };
  }

  function stripReader(svg) {
    const { x, rows, legend } = JSON.parse(svg.dataset.strip), values = JSON.parse(svg.closest("figure").dataset.values);
    const spot = (index, place) => {
      const [top, height, name] = rows[index], at = valueAt(x, place);
      const run = values[index].find(([from, step, of]) => at >= from && at < from + step * of.length);
      const value = run ? run[2][Math.floor((at - run[0]) / run[1])] : 0;
      const marks = [shape("line", { x1: place, x2: place, y1: rows[0][0], y2: rows.at(-1)[0] + height }), shape("rect", { x: x.at[0], y: top, width: x.at[1] - x.at[0], height, fill: "none" })];
      return { point: [place, top], index, now: index, head: `${name}, ${placeText(x, place)}`, rows: [{ name: legend.caption, value: quantity(value, legend) }], marks };
    };
    const clamped = (place) => Math.max(x.at[0], Math.min(x.at[1], place));
    return {
      range: [0, rows.length - 1],
      find(px, py) {
        const index = rows.findIndex(([top, height]) => py >= top && py < top + height);
        return index < 0 || px < x.at[0] || px > x.at[1] ? null : spot(index, px);
      },
      move: (from, dx, dy) => spot(Math.max(0, Math.min(rows.length - 1, (from?.index ?? 0) + dy)), from ? clamped(from.point[0] + dx * (x.at[1] - x.at[0]) / 300) : x.at[0]),
    };
  }

  function mapReader(svg) {
    // The script shows the titles at once, and a browser would show them again later.
    const cells = [...svg.querySelectorAll("path")].filter((it) => it.firstElementChild).map((cell) => {
      const text = cell.firstElementChild.textContent, at = text.lastIndexOf(": ");
      cell.firstElementChild.remove();
      return { cell, name: text.slice(0, at), value: text.slice(at + 2) };
    });
    const spot = (index) => {
      const { cell, name, value } = cells[index], box = cell.getBBox();
      const mark = shape("path", { d: cell.getAttribute("d"), fill: "none" });
      return { point: [box.x + box.width / 2, box.y], index, now: index, head: name, rows: [{ like: cell, name: "", value }], marks: [mark] };
    };
    return {
      range: [0, cells.length - 1],
      find(px, py, unit, target) {
        const index = cells.findIndex(({ cell }) => cell === target);
        return index < 0 ? null : spot(index);
      },
      move: (from, dx, dy) => (cells.length ? spot(Math.max(0, Math.min(cells.length - 1, from ? from.index + Math.sign(dx + dy) : 0))) : null),
    };
  }

  // Makes a drawing readable.
  function listen(svg, reader) {
    const figure = svg.closest("figure"), box = element("div", "", "reading"), aim = shape("g", { class: "aim", "aria-hidden": "true" });
    let made = null, shown = null;
    function read() {
      if (!made) {
        made = reader(svg);
        ["aria-valuemin", "aria-valuemax"].forEach((name, end) => svg.setAttribute(name, made.range[end]));
      }
      return made;
    }
    function show(spot) {
      shown = spot;
      box.hidden = !spot;
      aim.replaceChildren(...(spot?.marks ?? []));
      if (!spot) return;
      box.replaceChildren(element("b", spot.head), ...spot.rows.map(({ like, name, value }) => {
        const row = element("div"), key = shape("svg", { viewBox: "0 0 10 10", "aria-hidden": "true" }), colour = like?.getAttribute("class").replace(/s$/, "f");
        const dot = shape("circle", { cx: 5, cy: 5, r: 4, fill: [like?.getAttribute("stroke"), like?.getAttribute("fill")].find((it) => it?.startsWith("#")) ?? "none" });
        if (colour) dot.setAttribute("class", colour);
        key.append(dot);
        row.append(...(like ? [key] : []), element("span", name), element("span", value, "n"));
        return row;
      }));
      const [outer, inner] = [figure, svg].map((it) => it.getBoundingClientRect()), scale = inner.width / svg.viewBox.baseVal.width;
      const left = inner.left - outer.left + spot.point[0] * scale, isLeft = left > outer.width / 2;
      box.style.left = isLeft ? "" : `${left + 12}px`;
      box.style.right = isLeft ? `${outer.width - left + 12}px` : "";
      box.style.top = `${inner.top - outer.top + Math.min(spot.marks.length > 1 && svg.dataset.plots ? 36 : spot.point[1] * scale, inner.height - 30)}px`;
      svg.setAttribute("aria-valuenow", spot.now);
      svg.setAttribute("aria-valuetext", [spot.head, ...spot.rows.map(({ name, value }) => `${name} ${value}`)].join("; ").trim());
    }
    const point = (event) => {
      const inner = svg.getBoundingClientRect(), unit = svg.viewBox.baseVal.width / inner.width;
      show(read().find((event.clientX - inner.left) * unit, (event.clientY - inner.top) * unit, unit, event.target));
    };
    const move = (dx, dy) => show(read().move(shown, dx, dy));
    svg.addEventListener("pointermove", point);
    svg.addEventListener("pointerdown", point);
    svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") show(null); });
    svg.addEventListener("focus", () => { if (!shown && svg.matches(":focus-visible")) move(0, 0); });
    svg.addEventListener("blur", () => show(null));
    svg.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1], PageUp: [-30, 0], PageDown: [30, 0], Home: [-1e6, 0], End: [1e6, 0] }[event.key];
      if (event.key === "Escape") return show(null);
      if (!by) return;
      event.preventDefault();
      move(...by);
    });
    for (const [name, value] of [["role", "slider"], ["tabindex", "0"], ["aria-valuemin", "0"], ["aria-valuenow", "0"], ["aria-valuetext", "arrow keys read values"]]) svg.setAttribute(name, value);
    svg.append(aim);
    box.hidden = true;
    box.setAttribute("aria-hidden", "true");
    figure.append(box);
  }
  for (const [name, reader] of [["plots", plotReader], ["strip", stripReader], ["map", mapReader]]) {
    for (const svg of document.querySelectorAll(`svg[data-${name}]`)) listen(svg, reader);
  }

  for (const code of document.querySelectorAll("code")) {
    const button = element("button");
    const say = (word) => { button.textContent = word; button.setAttribute("aria-label", `${word}: ${code.textContent}`); };
    button.type = "button";
    say("Copy");
    button.onclick = async () => {
      getSelection().selectAllChildren(code);
      let done = true;
      try { await navigator.clipboard.writeText(code.textContent); } catch { done = document.execCommand("copy"); }
      say(done ? "Copied" : "Selected");
      setTimeout(() => say("Copy"), 1500);
    };
    code.after(" ", button);
  }
})();
