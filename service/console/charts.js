// Small charts as SVG. Lines differ by dash as well as by colour, and name themselves.

const SVG = "http://www.w3.org/2000/svg";
const DASHES = ["", "6 3", "2 3", "9 3 2 3", "1 4", "12 4"];

/** Return a new element with attributes and children. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function makeSvg(tag, attributes = {}) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

/** Set an element's text, only if it differs. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Return a number with about three digits. */
export function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1000) return value.toLocaleString("en", { maximumFractionDigits: 0 });
  if (size >= 100) return value.toFixed(0);
  if (size >= 10) return value.toFixed(1);
  return size >= 0.1 || size === 0 ? value.toFixed(2) : value.toPrecision(2);
}

/** Return a probability for people. */
export function percent(probability) {
  return probability > 0 && probability < 0.005 ? "<1 %" : `${Math.round(probability * 100)} %`;
}

/** Return the smallest of 1, 2, 5 · 10^n that is not less than a number. */
export function niceCeiling(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  for (const factor of [1, 2, 5, 10]) if (factor * power >= value) return factor * power;
  return 10 * power;
}

/** Lines over time. */
export class LineChart {
  /**
   * @param {HTMLElement} place
   * @param {{title: string, unit: string, window: number, height?: number, scale?: number, end?: string, gap?: number}} options
   *   window: s that the chart shows; scale: factor of the values, as 1000 for ms;
   *   end: what to call the time at the right edge; gap: s without a value that break a line.
   */
  constructor(place, { title, unit, window, height = 84, scale = 1, end = "now", gap = 5 }) {
    this._title = title;
    this._unit = unit;
    this._window = window;
    this._height = height;
    this._scale = scale;
    this._end = end;
    this._gap = gap;
    this._names = "";
    this._svg = makeSvg("svg", { class: "chart", role: "img", preserveAspectRatio: "none" });
    this._legend = make("div", { class: "legend" });
    this._empty = make("p", { class: "nothing" });
    this._empty.hidden = true;
    place.append(make("h4", {}, title, " ", make("span", { class: "unit" }, unit)), this._svg, this._empty, this._legend);
  }

  /**
   * Show lines.
   * @param {{name: string, points: (number | null)[][]}[]} lines points: [time in s, value or null] by ascending time.
   * @param {number} end time at the right edge, s.
   * @param {{cursor?: number | null, empty?: string}} [more] cursor: a time to mark; empty: said when nothing is there.
   */
  show(lines, end, { cursor = null, empty = "" } = {}) {
    const width = this._svg.clientWidth || 280;
    const inside = { left: 30, right: width - 4, top: 6, bottom: this._height - 14 };
    const begin = end - this._window;
    const values = lines.flatMap(({ points }) => points.map(([, value]) => value).filter((value) => value !== null));
    this._empty.hidden = values.length > 0 || !empty;
    setText(this._empty, empty);
    this._svg.style.display = this._empty.hidden ? "" : "none";
    this._legend.hidden = !this._empty.hidden;
    const top = niceCeiling(Math.max(...values, 0) * this._scale);
    const x = (time) => inside.left + ((time - begin) / this._window) * (inside.right - inside.left);
    const y = (value) => inside.bottom - ((value * this._scale) / top) * (inside.bottom - inside.top);
    this._frame(lines, width, inside, top);
    lines.forEach(({ points }, i) => this._paths[i].setAttribute("d", pathOf(points, begin, this._gap, x, y)));
    const shown = cursor !== null && cursor >= begin && cursor <= end;
    this._cursor.style.display = shown ? "" : "none";
    if (shown) for (const end of ["x1", "x2"]) this._cursor.setAttribute(end, x(cursor));
    lines.forEach(({ name, points }, i) => {
      const last = points.findLast(([, value]) => value !== null)?.[1] ?? null;
      setText(this._values[i], last === null ? "–" : short(last * this._scale));
      this._said[i] = `${name} ${this._values[i].textContent} ${this._unit}`;
    });
    this._svg.setAttribute("aria-label", `${this._title}: ${this._said.join(", ")}`);
  }

  /** Make axes, paths and legend anew where lines, size or scale have changed. */
  _frame(lines, width, inside, top) {
    const key = `${width} ${top} ${lines.map(({ name }) => name).join("|")}`;
    if (key === this._names) return;
    this._names = key;
    this._svg.setAttribute("viewBox", `0 0 ${width} ${this._height}`);
    this._svg.style.height = `${this._height}px`;
    this._svg.replaceChildren();
    for (const [share, text] of [[0, "0"], [0.5, ""], [1, `${top}`]]) {
      const level = inside.bottom - share * (inside.bottom - inside.top);
      this._svg.append(makeSvg("line", { class: "grid", x1: inside.left, x2: inside.right, y1: level, y2: level }));
      const label = makeSvg("text", { x: inside.left - 4, y: level + 4, "text-anchor": "end" });
      label.textContent = text;
      this._svg.append(label);
    }
    for (const [anchor, at, text] of [["start", inside.left, `−${this._window} s`], ["end", inside.right, this._end]]) {
      const label = makeSvg("text", { x: at, y: this._height - 1, "text-anchor": anchor });
      label.textContent = text;
      this._svg.append(label);
    }
    this._cursor = makeSvg("line", { class: "cursor", y1: inside.top, y2: inside.bottom });
    this._paths = lines.map((_, i) => makeSvg("path", { class: `line line-${i % 6}`, "stroke-dasharray": DASHES[i % 6] }));
    this._svg.append(...this._paths, this._cursor);
    this._values = lines.map(() => make("b"));
    this._said = lines.map(() => "");
    this._legend.replaceChildren(...lines.map(({ name }, i) => make("span", {}, swatch(i), `${name} `, this._values[i])));
  }
}

function swatch(i) {
  const svg = makeSvg("svg", { width: 22, height: 8, "aria-hidden": "true" });
  const line = { class: `line line-${i % 6}`, d: "M0 4 H22", "stroke-dasharray": DASHES[i % 6] };
  svg.append(makeSvg("path", line));
  return svg;
}

function pathOf(points, begin, gap, x, y) {
  let path = "";
  let last = -Infinity;
  for (const [time, value] of points) {
    if (time < begin || value === null) continue;
    const place = `${x(time).toFixed(1)} ${y(value).toFixed(1)}`;
    path += time - last > gap ? `M${place}h.01` : `L${place}`; // the stub shows a point that stands alone
    last = time;
  }
  return path;
}

/**
 * Show numbers as horizontal bars.
 * @param {HTMLElement} place a list; its items are reused.
 * @param {{name: string, value: number, text: string, note?: string}[]} bars
 * @param {{limit: number, signed?: boolean}} range value at full length; signed: zero is in the middle.
 */
export function showBars(place, bars, { limit, signed = false }) {
  while (place.children.length > bars.length) place.lastElementChild.remove();
  while (place.children.length < bars.length)
    place.append(
      make(
        "li",
        { class: "bar" },
        make("span", { class: "bar-name" }),
        make("span", { class: "bar-track" }, make("span", { class: "bar-fill" })),
        make("span", { class: "bar-value" }),
      ),
    );
  bars.forEach(({ name, value, text, note }, i) => {
    const [label, track, number] = place.children[i].children;
    const share = Math.min(Math.abs(value) / limit, 1);
    const fill = track.firstElementChild;
    setText(label, name);
    place.children[i].title = note ?? name;
    setText(number, text);
    track.classList.toggle("signed", signed);
    fill.classList.toggle("negative", value < 0);
    fill.style.width = `${(signed ? 50 : 100) * share}%`;
    fill.style.left = signed ? `${value < 0 ? 50 - 50 * share : 50}%` : "0";
  });
}
