"use strict";
// The episodes of a report as a list and as a table. All data are in the page; nothing is fetched.

const { figures, rows, judged } = JSON.parse(document.getElementById("figures").textContent);
// Where no task ran and nobody marked an episode, no success is no failure.
document.body.classList.toggle("unjudged", !judged);
document.body.classList.toggle("single", rows.length === 1);
const place = Object.fromEntries(figures.map((figure, i) => [figure.name, i]));
const MOST_ROWS = 1000;

const get = (row, name) => row[0][place[name]];
const stateOf = (row) => ({ true: "good", false: judged ? "bad" : "unknown" })[get(row, "success")]
  || "unknown";
const find = (id) => document.getElementById(id);
const say = (name) => name.replaceAll("_", " ");

function make(kind, options = {}, ...children) {
  const element = Object.assign(document.createElement(kind), options);
  element.append(...children);
  return element;
}

function format(value, figure) {
  if (value === null) return "-";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value !== "number" || (Number.isInteger(value) && !figure.unit)) return String(value);
  const digits = /^(plan|solve)/.test(figure.name) ? 3 : { m: 3, rad: 2, s: 1 }[figure.unit] ?? 1;
  return value.toFixed(digits);
}

// Which episodes are shown, and in which order.

const selected = new Set(); // rows whose points are chosen in the plots
const CHOICES = {
  "all episodes": () => true,
  "success": (row) => get(row, "success") === true,
  "no success": (row) => get(row, "success") === false,
  "falls": (row) => get(row, "fall") === true,
  "collisions": (row) => get(row, "collision") === true,
  "gaps in tracking": (row) => get(row, "gaps") > 0,
  "what cannot be read": (row) => row[1].length > 0,
  "chosen in the plots": (row) => selected.has(row),
};
const order = { sort: "episode", descending: false, all: false, choice: "all episodes", most: MOST_ROWS };

function compare(a, b) {
  const x = get(a, order.sort), y = get(b, order.sort);
  // What is not known comes last, whichever way.
  if (x === null || y === null) return (x === null) - (y === null);
  const sign = typeof x === "string" ? x.localeCompare(y) : x - y;
  return (order.descending ? -sign : sign) || get(a, "episode") - get(b, "episode");
}

function showChoice(changes = {}) {
  Object.assign(order, changes);
  const found = rows.filter(CHOICES[order.choice]).sort(compare);
  showTable(found);
  for (const row of rows) if (row.section) row.section.hidden = true;
  for (const { section } of found) {
    if (!section) continue;
    section.hidden = false;
    section.parentNode.append(section);
  }
  find("count").textContent = `${found.length} of ${rows.length} episodes`;
  find("sort").value = order.sort;
  find("choice").value = order.choice;
  find("descending").checked = order.descending;
}

function showTable(found) {
  const columns = figures.filter((figure) => figure.shown || order.all || figure.name === order.sort);
  const head = make("tr");
  for (const figure of columns) {
    const button = make("button", { type: "button", textContent: say(figure.name), title: figure.text });
    const sorted = figure.name === order.sort, descending = sorted && !order.descending;
    button.addEventListener("click", () => showChoice({ sort: figure.name, descending }));
    const arrow = sorted ? (order.descending ? " ▼" : " ▲") : "";
    const cell = make("th", { className: figure.kind, scope: "col" }, button, arrow,
      make("small", { textContent: figure.unit }));
    cell.dataset.name = figure.name;
    cell.setAttribute("aria-sort", sorted ? (order.descending ? "descending" : "ascending") : "none");
    head.append(cell);
  }
  const lines = found.slice(0, order.most).map((row) => {
    const line = make("tr");
    for (const figure of columns) {
      const value = get(row, figure.name);
      const cell = make("td", { className: figure.kind });
      if (figure.name === "episode" && row.section) {
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
  const more = find("more");
  more.hidden = found.length <= order.most;
  more.textContent = `show all ${found.length} rows`;
}

function fill(select, options, chosen) {
  select.replaceChildren(...options.map((name) => make("option", { value: name, textContent: say(name) })));
  select.value = chosen;
}

function showView(view) {
  document.body.dataset.view = view;
  for (const button of find("views").children) {
    button.setAttribute("aria-pressed", button.dataset.view === view);
  }
  if (view === "plots") showPlots();
}

function unfold(section) {
  section.querySelector(".timelines").open = true;
  return section.timeline ??= new Timeline(section);
}

function follow() { // where the address points to
  const section = /^#episode-\d+$/.test(location.hash) && find(location.hash.slice(1));
  if (!section) return;
  if (section.hidden) showChoice({ choice: "all episodes" });
  showView("episodes");
  unfold(section);
  section.scrollIntoView();
}

addEventListener("DOMContentLoaded", () => {
  for (const row of rows) row.section = row[2] ? find(`episode-${get(row, "episode")}`) : null;
  fill(find("choice"), Object.keys(CHOICES), order.choice);
  fill(find("sort"), figures.map((figure) => figure.name), order.sort);
  const inputs = { choice: "value", sort: "value", descending: "checked", all: "checked" };
  for (const [id, key] of Object.entries(inputs)) {
    find(id).addEventListener("change", ({ target }) => showChoice({ [id]: target[key] }));
  }
  find("more").addEventListener("click", () => showChoice({ most: Infinity }));
  for (const button of find("views").children) {
    button.addEventListener("click", () => showView(button.dataset.view));
  }
  addEventListener("hashchange", follow);
  for (const section of document.querySelectorAll(".episode")) {
    section.querySelector(".timelines").addEventListener("toggle", () => {
      section.timeline ??= new Timeline(section);
    });
    for (const picture of section.querySelectorAll(".strip figure")) {
      picture.addEventListener("click", () => unfold(section).point(Number(picture.dataset.t)));
    }
  }
  showView("episodes");
  showChoice();
  follow();
  if (rows.length === 1) document.querySelectorAll(".episode").forEach(unfold);
});
