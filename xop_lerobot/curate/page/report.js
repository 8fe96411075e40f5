"use strict";
// Table, plots and timelines of a report. All data are in the page; nothing is fetched.

const { figures, rows, judged } = JSON.parse(document.getElementById("figures").textContent);
// Where no task ran and nobody marked an episode, no success is no failure.
document.body.classList.toggle("unjudged", !judged);
document.body.classList.toggle("single", rows.length === 1);
const place = Object.fromEntries(figures.map((figure, i) => [figure.name, i]));
const COLOURS = ["#2166ac", "#d6604d", "#1b7837", "#9970ab", "#b8860b", "#17a0a8", "#c51b7d",
  "#555555", "#7fbc41", "#e08214", "#4d4dff"];
const STATE = { good: "#1b7837", bad: "#b2182b", unknown: "#777777" };
const MOST_ROWS = 1000, MOST_POINTS = 1500, BINS = 20;

const get = (row, name) => row[0][place[name]];
const stateOf = (row) => ({ true: "good", false: judged ? "bad" : "unknown" })[get(row, "success")] || "unknown";
const find = (id) => document.getElementById(id);

function make(kind, options = {}, ...children) {
  const element = Object.assign(document.createElement(kind), options);
  element.append(...children);
  return element;
}

function draw(kind, attributes = {}, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.textContent = text;
  return element;
}

function format(value, figure) {
  if (value === null) return "-";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value !== "number" || (Number.isInteger(value) && !figure.unit)) return String(value);
  const digits = /^(plan|solve)/.test(figure.name) ? 3 : { m: 3, rad: 2, s: 1 }[figure.unit] ?? 1;
  return value.toFixed(digits);
}

function short(value, span = 0) {
  const size = Math.abs(value);
  if (size <= span * 1e-3) return "0"; // as good as 0 beside the range of the axis
  if (size >= 1e6 || size < 1e-4) return value.toExponential(1);
  if (span > 1e-3 && span < 10) return String(Number(value.toFixed(Math.ceil(2 - Math.log10(span)))));
  return String(Number(value.toPrecision(3)));
}

// Table.

const names = figures.map((figure) => figure.name);
const CHOICES = {
  "all episodes": () => true,
  "success": (row) => get(row, "success") === true,
  "no success": (row) => get(row, "success") === false,
  "falls": (row) => get(row, "fall") === true,
  "collisions": (row) => get(row, "collision") === true,
  "gaps in tracking": (row) => get(row, "gaps") > 0,
  "what cannot be read": (row) => row[1].length > 0,
};
const table = { sort: "episode", descending: false, all: false, choice: "all episodes", most: MOST_ROWS };

function compare(a, b) {
  const x = get(a, table.sort), y = get(b, table.sort);
  // What is not known comes last, whichever way.
  if (x === null || y === null) return (x === null) - (y === null);
  const order = typeof x === "string" ? x.localeCompare(y) : x - y;
  return (table.descending ? -order : order) || get(a, "episode") - get(b, "episode");
}

function showTable() {
  const columns = figures.filter((figure) => figure.shown || table.all || figure.name === table.sort);
  const head = make("tr");
  for (const figure of columns) {
    const button = make("button", { type: "button", textContent: figure.name.replaceAll("_", " "),
      title: figure.text });
    const sorted = figure.name === table.sort;
    button.addEventListener("click", () => sortBy(figure.name, sorted && !table.descending));
    const arrow = sorted ? (table.descending ? " ▼" : " ▲") : "";
    const cell = make("th", { className: figure.kind, scope: "col" }, button, arrow,
      make("small", { textContent: figure.unit }));
    cell.dataset.name = figure.name;
    cell.setAttribute("aria-sort", sorted ? (table.descending ? "descending" : "ascending") : "none");
    head.append(cell);
  }
  const found = rows.filter(CHOICES[table.choice]).sort(compare);
  const lines = found.slice(0, table.most).map((row) => {
    const line = make("tr");
    for (const figure of columns) {
      const value = get(row, figure.name);
      const cell = make("td", { className: figure.kind });
      if (figure.name === "episode" && row[2]) {
        cell.append(make("a", { href: `#episode-${value}`, textContent: value }));
      } else {
        cell.textContent = format(value, figure);
      }
      if (figure.kind === "text") cell.title = value ?? "";
      if (figure.name === "success" && value !== null) cell.classList.add(stateOf(row));
      if (["fall", "collision", "trouble", "late"].includes(figure.name) && value) cell.classList.add("bad");
      line.append(cell);
    }
    if (row[1].length) {
      line.firstChild.append(make("span", { className: "problem", textContent: " !",
        title: row[1].join("\n") }));
    }
    return line;
  });
  find("table").tHead.replaceChildren(head);
  find("table").tBodies[0].replaceChildren(...lines);
  find("count").textContent = `${found.length} of ${rows.length} episodes`;
  const more = find("more");
  more.hidden = found.length <= table.most;
  more.textContent = `show all ${found.length} rows`;
  find("sort").value = table.sort;
  find("descending").checked = table.descending;
}

function sortBy(name, descending) {
  Object.assign(table, { sort: name, descending });
  showTable();
}

function fill(select, options, chosen) {
  select.replaceChildren(...options.map((name) => make("option", { value: name,
    textContent: name.replaceAll("_", " ") })));
  select.value = chosen;
}

// Plots over all episodes.

const numbers = figures.filter((figure) => figure.kind === "number"
  && rows.some((row) => get(row, figure.name) !== null)).map((figure) => figure.name);
const PLOTTED = ["duration", "tracking_mean", "tracking_p95", "tracking_angle_p95",
  "command_roughness", "command_ldlj", "hand_jerk", "gap_time", "plan_age_p95", "solve_time_p95",
  "idle_time", "engaged_time"].filter((name) => numbers.includes(name));

function goTo(row) {
  location.hash = row[2] ? `episode-${get(row, "episode")}` : "episodes";
}

function range(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) { low = Math.min(low, value); high = Math.max(high, value); }
  if (low === high && low === 0) return [0, 1];
  if (low === high) { const pad = Math.abs(low) * 0.1 || 1; return [low - pad, high + pad]; }
  return [low, high];
}

function makeAxes(svg, box, [low, high], side) {
  const text = { class: "tick" };
  for (const share of side === "up" ? [0, 0.5, 1] : [0, 1]) {
    const value = short(low + share * (high - low), high - low);
    if (side === "up") {
      const y = box.bottom + share * (box.top - box.bottom);
      svg.append(draw("line", { class: "grid", x1: box.left, x2: box.right, y1: y, y2: y }),
        draw("text", { ...text, x: box.left - 4, y: y + 4, "text-anchor": "end" }, value));
    } else {
      const x = box.left + share * (box.right - box.left);
      svg.append(draw("text", { ...text, x, y: box.bottom + 14,
        "text-anchor": share === 0 ? "start" : share === 1 ? "end" : "middle" }, value));
    }
  }
}

function thinOut(points) {
  // Of too many points, the lowest and the highest of each piece remain.
  if (points.length <= MOST_POINTS) return points;
  const pieces = MOST_POINTS / 2, kept = new Set();
  for (let i = 0; i < pieces; i++) {
    const piece = points.slice(Math.floor(i * points.length / pieces),
      Math.floor((i + 1) * points.length / pieces));
    if (!piece.length) continue;
    kept.add(piece.reduce((a, b) => (b.y < a.y ? b : a)));
    kept.add(piece.reduce((a, b) => (b.y > a.y ? b : a)));
  }
  return [...kept];
}

function plot(xName, yName, width, height, bars) {
  const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": `${yName} over ${xName}` });
  const box = { left: 62, right: width - (bars ? 66 : 14), top: 24, bottom: height - 34 };
  const all = rows.map((row) => ({ row, x: get(row, xName), y: get(row, yName) }))
    .filter((point) => point.x !== null && point.y !== null);
  const unit = figures[place[yName]].unit;
  svg.append(draw("text", { class: "title", x: 4, y: 14 },
    `${yName.replaceAll("_", " ")}${unit ? ` [${unit}]` : ""}`));
  if (!all.length) {
    svg.append(draw("text", { x: box.left, y: 50 }, "not known of both in any episode"));
    return svg;
  }
  const spanX = range(all.map((point) => point.x)), spanY = range(all.map((point) => point.y));
  const toX = (x) => box.left + (x - spanX[0]) / (spanX[1] - spanX[0]) * (box.right - box.left);
  const toY = (y) => box.bottom + (y - spanY[0]) / (spanY[1] - spanY[0]) * (box.top - box.bottom);
  makeAxes(svg, box, spanY, "up");
  makeAxes(svg, box, spanX, "across");
  const across = figures[place[xName]];
  svg.append(draw("text", { x: (box.left + box.right) / 2, y: height - 6, "text-anchor": "middle" },
    across.name.replaceAll("_", " ") + (across.unit ? ` [${across.unit}]` : "")));
  if (bars) {
    const counts = new Array(BINS).fill(0);
    for (const { y } of all) {
      counts[Math.min(BINS - 1, Math.floor((y - spanY[0]) / (spanY[1] - spanY[0]) * BINS))]++;
    }
    const most = Math.max(...counts), step = (box.bottom - box.top) / BINS;
    counts.forEach((count, i) => svg.append(draw("rect", { class: "bar", x: box.right + 8,
      y: box.bottom - (i + 1) * step + 0.5, width: 50 * count / most, height: step - 1 })));
    svg.append(draw("text", { x: width - 4, y: box.bottom + 14, "text-anchor": "end" }, `max ${most}`));
  }
  const shown = thinOut(all);
  for (const { row, x, y } of shown) {
    const state = STATE[stateOf(row)], fell = get(row, "fall") === true;
    const circle = draw("circle", { cx: toX(x), cy: toY(y), r: shown.length > 200 ? 2.5 : 4,
      fill: fell ? "none" : state, stroke: fell ? state : "none", "pointer-events": "all" });
    circle.dataset.episode = get(row, "episode");
    circle.append(draw("title", {}, `episode ${get(row, "episode")}: ${short(y)} ${unit}`));
    circle.addEventListener("click", () => goTo(row));
    svg.append(circle);
  }
  if (shown.length < all.length) {
    svg.append(draw("text", { x: width - 4, y: 14, "text-anchor": "end" },
      `${shown.length} of ${all.length} points`));
  }
  return svg;
}

function showScatter() {
  find("scatter").replaceChildren(plot(find("plot-x").value, find("plot-y").value, 640, 320, false));
}

// Timelines of an episode.

function decode(series) {
  const bytes = Uint8Array.from(atob(series.data), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Array.from({ length: bytes.length / 2 }, (_, i) => {
    const step = view.getUint16(2 * i, true);
    return step === 65535 ? NaN : series.lo + (series.hi - series.lo) * step / 65534;
  });
}

function fit(canvas, height) {
  const ratio = window.devicePixelRatio || 1, width = canvas.parentElement.clientWidth || 300;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  canvas.style.height = `${height}px`;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "10px system-ui, sans-serif";
  return { pen, width, height };
}

const LEAST_SPAN = { m: 0.05, rad: 0.05 };
const PANEL = { height: 110, left: 42, right: 6, top: 6, bottom: 14 };

class Timeline {
  constructor(section) {
    this.section = section;
    this.data = JSON.parse(section.querySelector("script").textContent);
    this.duration = this.data.duration || 1;
    this.cursor = null;
    this.panels = [];
    this.pictures = [...section.querySelectorAll(".strip figure")];
    const host = section.querySelector(".timeline");
    this.clock = make("p", { className: "clock" });
    host.append(this.clock);
    this.addBands(host);
    for (const group of this.data.groups) this.addGroup(host, group);
    for (const picture of this.pictures) {
      picture.addEventListener("click", () => this.point(Number(picture.dataset.t)));
    }
    new ResizeObserver(() => this.show()).observe(host);
    this.point(null);
  }

  addBands(host) {
    if (!this.data.bands.length && !this.data.changes.length) return;
    const box = make("div", { className: "bands" });
    this.bands = make("canvas");
    this.listen(this.bands, 96, 6);
    box.append(this.bands);
    host.append(box);
  }

  addGroup(host, group) {
    host.append(make("h4", { textContent: group.title }));
    const box = make("div", { className: "panels" });
    for (const panel of group.panels) {
      const canvas = make("canvas"), legend = make("div", { className: "legend" });
      const curves = panel.series.map((series) => ({ ...series, values: decode(series) }));
      const known = curves.filter((curve) => curve.values.some(Number.isFinite));
      let [low, high] = known.length ? range(known.flatMap((curve) => [curve.lo, curve.hi])) : [0, 1];
      const least = LEAST_SPAN[panel.unit] ?? 0, middle = (low + high) / 2;
      if (high - low < least && known.length) { // a tremble is not to fill the panel
        [low, high] = low === 0 ? [0, least] : [middle - least / 2, middle + least / 2];
      }
      const marks = curves.map((curve) => {
        const mark = make("b");
        const name = make("span", { textContent: `${curve.style === "goal" ? "┄" : "—"} ${curve.name} ` });
        name.style.color = COLOURS[curve.colour % COLOURS.length];
        name.append(mark);
        legend.append(name);
        return mark;
      });
      const title = make("div", { textContent: panel.title + (panel.unit ? ` [${panel.unit}]` : "") });
      const width = curves.length > 4 ? "panel wide" : "panel";
      box.append(make("div", { className: width }, title, canvas, legend));
      this.panels.push({ canvas, curves, low, high, marks });
      this.listen(canvas, PANEL.left, PANEL.right);
    }
    host.append(box);
  }

  listen(canvas, left, right) {
    canvas.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - left) / (box.width - left - right);
      this.point(Math.min(Math.max(share, 0), 1) * this.duration);
    });
  }

  point(time) {
    this.cursor = time;
    this.clock.textContent = time === null ? "Point at a curve or click a picture to read values."
      : `${time.toFixed(2)} s`;
    const gap = (picture) => Math.abs(Number(picture.dataset.t) - time);
    const least = time === null ? -1 : Math.min(...this.pictures.map(gap));
    for (const picture of this.pictures) picture.classList.toggle("near", gap(picture) === least);
    this.show();
  }

  show() {
    if (this.waits) return;
    this.waits = requestAnimationFrame(() => {
      this.waits = 0;
      if (this.bands) this.showBands();
      for (const panel of this.panels) this.showPanel(panel);
    });
  }

  drawCursor(pen, toX, top, bottom) {
    if (this.cursor === null) return;
    pen.strokeStyle = "#d6604d";
    pen.setLineDash([]);
    pen.beginPath();
    pen.moveTo(toX(this.cursor), top);
    pen.lineTo(toX(this.cursor), bottom);
    pen.stroke();
  }

  showBands() {
    const { bands, changes } = this.data, row = 15;
    const lines = bands.length + (changes.length ? 1 : 0);
    const { pen, width } = fit(this.bands, lines * row + 4);
    const left = 96, toX = (time) => left + time / this.duration * (width - left - 6);
    bands.forEach((band, i) => {
      pen.fillStyle = "#444";
      pen.fillText(band.name, 0, i * row + 11);
      pen.fillStyle = "#f0f0f0";
      pen.fillRect(left, i * row + 2, width - left - 6, row - 4);
      band.runs.forEach(([first, last, text], k) => {
        pen.fillStyle = text ? COLOURS[k % COLOURS.length]
          : { good: "#8cc49a", bad: "#d9534f", plain: "#9db4cc" }[band.kind];
        pen.fillRect(toX(first), i * row + 2, Math.max(toX(last) - toX(first), 1.5), row - 4);
        pen.fillStyle = "#fff";
        if (text) pen.fillText(text, toX(first) + 3, i * row + 11);
      });
    });
    if (changes.length) {
      const y = bands.length * row;
      pen.fillStyle = "#444";
      pen.fillText("changes", 0, y + 11);
      for (const change of changes) {
        pen.fillStyle = "#9970ab";
        pen.fillRect(toX(change.t), y + 2, 2, row - 4);
        pen.fillText(change.text.slice(0, 60), toX(change.t) + 4, y + 11);
      }
    }
    this.drawCursor(pen, toX, 0, lines * row);
  }

  showPanel({ canvas, curves, low, high, marks }) {
    const { pen, width, height } = fit(canvas, PANEL.height);
    const right = width - PANEL.right, bottom = height - PANEL.bottom;
    const toX = (time) => PANEL.left + time / this.duration * (right - PANEL.left);
    const toY = (value) => bottom + (value - low) / (high - low) * (PANEL.top - bottom);
    pen.strokeStyle = "#e4e4e4";
    pen.fillStyle = "#666";
    for (const share of [0, 0.5, 1]) {
      const value = low + share * (high - low);
      pen.beginPath();
      pen.moveTo(PANEL.left, toY(value));
      pen.lineTo(right, toY(value));
      pen.stroke();
      pen.textAlign = "right";
      pen.fillText(short(value, high - low), PANEL.left - 3, toY(value) + 3);
      pen.textAlign = share === 0 ? "left" : share === 1 ? "right" : "center";
      pen.fillText(`${short(share * this.duration)} s`, toX(share * this.duration), height - 3);
    }
    curves.forEach((curve, k) => {
      const { values } = curve, step = this.duration / values.length;
      pen.strokeStyle = COLOURS[curve.colour % COLOURS.length];
      pen.setLineDash(curve.style === "goal" ? [4, 3] : []);
      pen.lineWidth = 1.2;
      pen.beginPath();
      let pending = true;
      values.forEach((value, i) => {
        if (!Number.isFinite(value)) { pending = true; return; }
        if (pending) pen.moveTo(toX(i * step), toY(value));
        else pen.lineTo(toX(i * step), toY(value));
        pending = false;
      });
      pen.stroke();
      const index = Math.min(Math.floor((this.cursor ?? 0) / step), values.length - 1);
      const value = this.cursor === null ? NaN : values[index];
      marks[k].textContent = Number.isFinite(value) ? short(value) : "";
    });
    pen.lineWidth = 1;
    this.drawCursor(pen, toX, PANEL.top, bottom);
  }
}

// Begin.

fill(find("choice"), Object.keys(CHOICES), table.choice);
fill(find("sort"), names, table.sort);
fill(find("plot-x"), numbers, numbers.includes("duration") ? "duration" : numbers[0]);
fill(find("plot-y"), numbers, PLOTTED.includes("tracking_p95") ? "tracking_p95"
  : PLOTTED.at(-1) ?? numbers[0]);
find("choice").addEventListener("change", (event) => { table.choice = event.target.value; showTable(); });
find("sort").addEventListener("change", (event) => sortBy(event.target.value, table.descending));
find("descending").addEventListener("change", (event) => sortBy(table.sort, event.target.checked));
find("all").addEventListener("change", (event) => { table.all = event.target.checked; showTable(); });
find("more").addEventListener("click", () => { table.most = Infinity; showTable(); });
for (const id of ["plot-x", "plot-y"]) find(id).addEventListener("change", showScatter);
showTable();
if (rows.length) {
  find("plots").append(...PLOTTED.map((name) => plot("episode", name, 320, 180, true)));
  showScatter();
}
// A timeline is made when its episode comes near the view.
const watcher = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (!isIntersecting) continue;
    watcher.unobserve(target);
    target.timeline = new Timeline(target);
  }
}, { rootMargin: "600px" });
for (const section of document.querySelectorAll(".episode")) watcher.observe(section);
