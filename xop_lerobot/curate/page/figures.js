"use strict";
// The figures of a report: plots over all episodes, and timelines of one. Bokeh draws them.

const COLOURS = ["#2166ac", "#d6604d", "#1b7837", "#9970ab", "#b8860b", "#17a0a8", "#c51b7d",
  "#555555", "#7fbc41", "#e08214", "#4d4dff"];
const BANDS = { good: "#8cc49a", bad: "#d9534f", plain: "#9db4cc" };
const STATES = {
  good: { colour: "#1b7837", marker: "circle", sign: "●", text: "success" },
  bad: { colour: "#b2182b", marker: "triangle", sign: "▲", text: "no success" },
  unknown: { colour: "#777777", marker: "circle", sign: "●", text: "not known" },
  fall: { colour: "#111111", marker: "x", sign: "✕", text: "fall" },
};
const MOST_BARS = 20;
const LEAST_SPAN = { m: 0.05, rad: 0.05 }; // a tremble is not to fill a figure

function startBokeh() { // with the first figure, so that a page opens sooner
  if (window.Bokeh) return;
  document.head.append(make("script", { textContent: find("bokeh").textContent }));
  Bokeh.logger.set_level("warn");
}

/** Figures that share ranges, marks and data. Each is drawn when its element comes near the view. */
class Sheet {
  constructor() {
    startBokeh();
    this.document = new Bokeh.Document();
    this.hosts = [];
    this.waiting = new Map();
    this.watcher = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) if (isIntersecting) this.draw(target);
    }, { rootMargin: "300px" });
    Bokeh.embed.add_document_standalone(this.document, document.body, this.hosts);
  }

  add(host, attributes, addGlyphs) {
    host.style.minHeight = `${attributes.height}px`;
    this.waiting.set(host, [attributes, addGlyphs]);
    this.watcher.observe(host);
  }

  draw(host) {
    this.watcher.unobserve(host);
    const [attributes, addGlyphs] = this.waiting.get(host);
    const figure = new Bokeh.Plotting.figure({ sizing_mode: "stretch_width", toolbar_location: null,
      tools: [], min_border_right: 14, background_fill_color: null, border_fill_color: null,
      outline_line_color: null, ...attributes });
    figure.axis.axis_label_text_font_style = "normal";
    figure.axis.axis_label_text_font_size = "11px";
    figure.axis.minor_tick_line_color = null;
    figure.axis.axis_line_color = figure.axis.major_tick_line_color = "#999999";
    figure.grid.grid_line_color = "#e8e8e8";
    addGlyphs(figure);
    this.hosts.push(host);
    this.document.add_root(figure);
  }
}

const makeSource = (data) => new Bokeh.ColumnDataSource({ data });
const makeHover = (glyphs, tooltips) => new Bokeh.HoverTool({ renderers: [glyphs], tooltips });

function makeRange(values, least = 0) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (low > high) [low, high] = [0, 1];
  const middle = (low + high) / 2, positive = low >= 0;
  const constant = high - low <= 1e-6 * Math.abs(middle); // but for rounding
  const span = Math.max(high - low, least, constant ? 0.1 * Math.abs(middle) || 1 : 0);
  [low, high] = [Math.min(low, middle - span / 2), Math.max(high, middle + span / 2)];
  if (positive && low < 0) [low, high] = [0, high - low];
  return new Bokeh.Range1d({ start: low - 0.07 * span, end: high + 0.07 * span });
}

// Plots over all episodes.

const numbers = figures.filter((figure) => figure.kind === "number"
  && rows.some((row) => get(row, figure.name) !== null)).map((figure) => figure.name);
const PLOTTED = ["duration", "tracking_mean", "tracking_p95", "tracking_angle_p95",
  "command_roughness", "command_ldlj", "hand_jerk", "gap_time", "plan_age_p95", "solve_time_p95",
  "idle_time", "engaged_time"].filter((name) => numbers.includes(name));
const unitOf = (name) => figures[place[name]].unit;
const label = (name) => say(name) + (unitOf(name) && ` [${unitOf(name)}]`);
let plots = null;

function showPlots() {
  if (plots) return;
  plots = new Sheet();
  const states = rows.map((row) => STATES[get(row, "fall") === true ? "fall" : stateOf(row)]);
  plots.source = makeSource({
    ...Object.fromEntries(numbers.map((name) => [name, rows.map((row) => get(row, name) ?? NaN)])),
    ...Object.fromEntries(["colour", "marker", "text"].map((key) => [key, states.map((state) => state[key])])),
  });
  plots.source.selected.properties.indices.change.connect(() => {
    const { indices } = plots.source.selected;
    selected.clear();
    for (const i of indices) selected.add(rows[i]);
    showChoice({ choice: indices.length ? "chosen in the plots" : "all episodes" });
  });
  for (const { colour, sign, text } of Object.values(STATES).filter((state) => states.includes(state))) {
    const key = make("span", { className: "key", textContent: `${sign} ${text}` });
    key.style.color = colour;
    find("key").append(key);
  }
  for (const name of PLOTTED) addPlot(find("plots"), "episode", name, 210, true);
  fill(find("plot-x"), numbers, numbers.includes("duration") ? "duration" : numbers[0]);
  fill(find("plot-y"), numbers, numbers.includes("tracking_p95") ? "tracking_p95" : numbers.at(-1));
  for (const id of ["plot-x", "plot-y"]) find(id).addEventListener("change", showScatter);
  showScatter();
}

function showScatter() {
  find("scatter").replaceChildren();
  addPlot(find("scatter"), find("plot-x").value, find("plot-y").value, 360, false);
}

function addPlot(box, xName, yName, height, bars) {
  const host = make("div"), values = rows.map((row) => get(row, yName)).filter((value) => value !== null);
  host.dataset.plot = `${yName} over ${xName}`;
  box.append(host);
  const x_range = makeRange(rows.map((row) => get(row, xName))), y_range = makeRange(values);
  const { start, end } = x_range;
  if (bars) x_range.end += 0.3 * (end - start); // room for them, right of the points
  const axes = { x_range, y_range, x_axis_label: label(xName), y_axis_label: label(yName) };
  plots.add(host, { height, ...axes }, (figure) => {
    if (bars) {
      figure.xaxis.bounds = [start, end];
      figure.xaxis.ticker = new Bokeh.BasicTicker({ min_interval: 1 });
      addBars(figure, values, (end - start) / 4);
    }
    const points = figure.scatter({ x: { field: xName }, y: { field: yName }, source: plots.source,
      size: rows.length > 200 ? 5 : 8, color: { field: "colour" }, marker: { field: "marker" },
      line_width: 1.5, fill_alpha: 0.7, nonselection_alpha: 0.15 });
    const told = [...new Set(["episode", xName, yName])].map((name) =>
      [say(name), `@${name}{0.[0000]} ${unitOf(name)}`]);
    const visit = (tool, { source }) => {
      const row = rows[source.inspected.indices[0]];
      if (row?.section) location.hash = `episode-${get(row, "episode")}`;
    };
    figure.add_tools(makeHover(points, [...told, ["outcome", "@text"]]),
      new Bokeh.TapTool({ renderers: [points], behavior: "inspect", callback: visit }),
      new Bokeh.BoxSelectTool({ renderers: [points] }));
    figure.on_event("doubletap", () => { plots.source.selected.indices = []; });
  });
}

function addBars(figure, values, room) {
  const { start, end } = figure.y_range, right = figure.x_range.end;
  const bins = Math.min(MOST_BARS, Math.ceil(Math.sqrt(values.length))), step = (end - start) / bins;
  const count = new Array(bins).fill(0);
  for (const value of values) count[Math.min(bins - 1, Math.floor((value - start) / step))]++;
  const most = Math.max(...count), bottom = count.map((_, i) => start + i * step);
  const bar = figure.quad({ left: { field: "left" }, right, bottom: { field: "bottom" }, top: { field: "top" },
    source: makeSource({ count, bottom, top: bottom.map((low) => low + step),
      left: count.map((number) => right - room * number / most) }),
    fill_color: "#c9d3de", line_color: "#ffffff" });
  figure.add_tools(makeHover(bar,
    [["episodes", "@count"], ["from", "@bottom{0.[0000]}"], ["to", "@top{0.[0000]}"]]));
}

// Timelines of an episode.

function decode(series) {
  const bytes = Uint8Array.from(atob(series.data), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float32Array.from({ length: bytes.length / 2 }, (_, i) => {
    const step = view.getUint16(2 * i, true);
    return step === 65535 ? NaN : series.lo + (series.hi - series.lo) * step / 65534;
  });
}

class Timeline {
  constructor(section) {
    const { duration, bands, changes, groups } = JSON.parse(section.querySelector("script").textContent);
    this.sheet = new Sheet();
    this.duration = duration || 1;
    this.range = new Bokeh.Range1d({ start: 0, end: this.duration, bounds: [0, this.duration] });
    this.cursor = new Bokeh.Span({ dimension: "height", line_color: "#d6604d", location: NaN });
    this.cursor.properties.location.change.connect(() => this.tell(this.cursor.location));
    this.pictures = [...section.querySelectorAll(".strip figure")];
    this.curves = [];
    const host = section.querySelector(".timeline");
    this.clock = make("p", { className: "clock note" });
    host.append(this.clock);
    if (bands.length || changes.length) this.addBands(host, bands, changes);
    for (const { title, panels } of groups) {
      const box = make("div", { className: "panels" });
      host.append(make("h4", { textContent: title }), box);
      for (const panel of panels) this.addPanel(box, panel);
    }
    this.tell(NaN);
  }

  addFigure(host, attributes, addGlyphs) {
    this.sheet.add(host, { x_range: this.range, x_axis_label: "time [s]", ...attributes }, (figure) => {
      addGlyphs(figure);
      figure.add_tools(new Bokeh.CrosshairTool({ overlay: this.cursor }),
        new Bokeh.BoxZoomTool({ dimensions: "width" }));
      figure.on_event("doubletap", () => this.range.setv({ start: 0, end: this.duration }));
    });
  }

  addBands(host, bands, changes) {
    const runs = bands.flatMap(({ name, kind, runs: found }) => found.map(([left, right, text], i) =>
      ({ name, left, right, text, colour: text ? COLOURS[i % COLOURS.length] : BANDS[kind] })));
    runs.push(...changes.map(({ t, text }) =>
      ({ name: "changes", left: t, right: t, text, colour: COLOURS[3] })));
    const lines = bands.map(({ name }) => name);
    if (changes.length) lines.push("changes");
    const box = make("div", { className: "bands" });
    host.append(box);
    this.addFigure(box, { height: 45 + 17 * lines.length, y_range: lines.reverse() }, (figure) => {
      const source = makeSource(Object.fromEntries(["name", "left", "right", "text", "colour"].map((key) =>
        [key, runs.map((run) => run[key])])));
      const bar = figure.hbar({ y: { field: "name" }, left: { field: "left" }, right: { field: "right" },
        height: 0.7, source, fill_color: { field: "colour" }, line_color: { field: "colour" } });
      figure.text({ x: { field: "left" }, y: { field: "name" }, text: { field: "text" }, source,
        x_offset: 4, text_baseline: "middle", text_font_size: "11px" });
      figure.ygrid.grid_line_color = null;
      figure.yaxis.axis_line_color = figure.yaxis.major_tick_line_color = null;
      figure.add_tools(makeHover(bar,
        [["", "@name @text"], ["from", "@left{0.00} s"], ["to", "@right{0.00} s"]]));
    });
  }

  addPanel(box, { title, unit, series }) {
    const curves = series.map((each) =>
      ({ ...each, values: decode(each), colour: COLOURS[each.colour % COLOURS.length] }));
    const legend = make("div", { className: "legend" }), host = make("div");
    box.append(make("div", { className: curves.length > 8 ? "panel wide" : "panel" },
      make("div", { className: "title", textContent: title }), legend, host));
    const y_range = makeRange(curves.flatMap(({ values }) => [...values]), LEAST_SPAN[unit]);
    const digits = Math.min(Math.max(Math.ceil(2.3 - Math.log10(y_range.end - y_range.start)), 0), 6);
    for (const curve of curves) {
      const mark = make("b"), sign = curve.style === "goal" ? "┅" : "━";
      const key = make("button", { type: "button", title: "show or hide" }, `${sign} ${curve.name} `, mark);
      key.style.color = curve.colour;
      key.addEventListener("click", () => {
        curve.hidden = key.classList.toggle("off");
        if (curve.line) curve.line.visible = !curve.hidden;
      });
      legend.append(key);
      this.curves.push(Object.assign(curve, { mark, digits }));
    }
    this.addFigure(host, { height: 170, y_range, y_axis_label: `[${unit || 1}]` }, (figure) => {
      for (const curve of curves) {
        const t = curve.values.map((_, i, all) => i * this.duration / all.length);
        curve.line = figure.line({ x: { field: "t" }, y: { field: "value" },
          source: makeSource({ t, value: curve.values }), line_color: curve.colour, line_width: 1.5,
          line_dash: curve.style === "goal" ? [5, 3] : [], visible: !curve.hidden });
      }
    });
  }

  /** Put the cursor of all figures at a time [s]. */
  point(time) {
    this.cursor.location = time;
  }

  /** Tell what all curves are at a time [s], and mark the nearest images; NaN is no time. */
  tell(time) {
    const known = Number.isFinite(time);
    this.clock.textContent = known ? `${time.toFixed(2)} s`
      : "Point at a curve or click an image to read values. Drag to zoom, double-click for all.";
    const gap = (picture) => Math.abs(Number(picture.dataset.t) - time);
    const least = known ? Math.min(...this.pictures.map(gap)) : -1;
    for (const picture of this.pictures) picture.classList.toggle("near", gap(picture) === least);
    for (const { values, mark, digits } of this.curves) {
      const place = Math.floor(time / this.duration * values.length);
      const value = values[Math.min(Math.max(place, 0), values.length - 1)];
      mark.textContent = known && Number.isFinite(value) ? value.toFixed(digits) : "";
    }
  }
}
