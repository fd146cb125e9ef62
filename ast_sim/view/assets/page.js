// The page: reads the data, fills every section that has some, hides the others.

function table(columns, rows, { title = null, className = null } = {}) {
  const head = columns.length ? element("thead", {}, element("tr", {}, ...columns.map((text) => element("th", { scope: "col" }, text)))) : null;
  const body = element("tbody", {}, ...rows);
  return element("div", { class: "table-card" }, title ? element("h3", {}, title) : null,
    element("table", { class: className }, head, body));
}

// A table of errors: rows are conventions, columns predictors; the lowest of a row is bold.
function measureTable({ title, unit, columns, rows, runs }) {
  const finite = rows.flatMap((row) => row.values || []).filter(Number.isFinite);
  const nice = niceUnit(Math.max(...finite, 0), unit);
  const lines = rows.map(({ group, label, note, values }) => {
    if (group) return element("tr", { class: "group" }, element("th", { scope: "rowgroup", colspan: columns.length + 1 }, group));
    const best = Math.min(...values.filter(Number.isFinite));
    const others = Math.min(...values.slice(runs).filter(Number.isFinite));
    const cells = values.map((value, index) => {
      const ratio = index < runs && Number.isFinite(others) && others > 0 && Number.isFinite(value) ? `${digits(value / others, 2)}×` : null;
      const kind = [index < runs ? "run" : "", value === best ? "best" : ""].join(" ").trim();
      return element("td", { class: kind || null }, digits(value === null ? null : value / nice.scale), ...(ratio ? [" ", element("small", {}, ratio)] : []));
    });
    return element("tr", {}, element("th", { scope: "row" }, label, ...(note ? [" ", element("small", {}, note)] : [])), ...cells);
  });
  return table(["", ...columns], lines, { title: nice.name ? `${title} (${nice.name})` : title });
}

function tiles(data) {
  byId("tiles").append(...data.tiles.map(({ label, value, unit, suffix, detail, upTo }) => {
    const most = upTo === undefined ? null : withUnit(upTo, unit);
    const text = most ? `median; up to ${most.text} ${most.unit}` : detail;
    const read = typeof value === "number" || value === null ? withUnit(value, unit) : { text: value, unit: "" };
    const number = element("dd", { class: "value" }, read.text + (suffix || ""), ...(read.unit ? [" ", element("small", {}, read.unit)] : []));
    return element("div", { class: "tile" }, element("dt", {}, label), number, text ? element("dd", { class: "detail" }, text) : null);
  }));
  byId("tiles").hidden = !data.tiles.length;
}

// For several runs: one row each, the best figure of a column in bold.
function comparisonTable({ names, columns }) {
  const lowest = columns.map(({ unit, values }) => (unit === "×" ? Math.max : Math.min)(...values.filter(Number.isFinite)));
  const rows = names.map((name, run) => element("tr", {}, element("th", { scope: "row" }, swatch(run), name),
    ...columns.map(({ unit, values }, column) => {
      const read = unit === "×" ? { text: digits(values[run]), unit: "×" } : withUnit(values[run], unit);
      return element("td", { class: values[run] === lowest[column] ? "best" : null }, read.text, ...(read.text === "–" ? [] : [" ", element("small", {}, read.unit)]));
    })));
  return table(["Run", ...columns.map(({ label }) => label)], rows);
}

function swatch(run) {
  const mark = element("i", { class: "swatch" });
  mark.style.background = `var(--run-${run % 6})`;
  return mark;
}

function samplesTable({ names, order, table: columns }, scenes, summary) {
  const labels = Object.fromEntries(scenes.map((scene) => [scene.name, scene.label === scene.name ? "" : `: ${scene.label.toLowerCase()}`]));
  const units = columns.map(({ values, unit }) => niceUnit(Math.max(...values.filter(Number.isFinite), 0), unit));
  const rows = order.map((index) => element("tr", {},
    element("th", { scope: "row" }, names[index], ...(names[index] in labels ? [" ", element("small", {}, `shown above${labels[names[index]]}`)] : [])),
    ...columns.map(({ values, unit }, column) => {
      const value = values[index];
      return element("td", {}, unit ? digits(value === null ? null : value / units[column].scale) : (value === null ? "–" : String(value)));
    })));
  const heads = columns.map(({ label, unit }, column) => (unit ? `${label} (${units[column].name})` : label));
  return element("details", {}, element("summary", {}, summary), table(["Scene", ...heads], rows, { className: "dense" }));
}

function factTables(runs) {
  const several = runs.length > 1;
  const keys = [...new Set(runs.flatMap((run) => run.facts.map(([key]) => key)))];
  const facts = runs.map((run) => Object.fromEntries(run.facts));
  const rows = keys.map((key) => element("tr", {}, element("th", { scope: "row" }, key),
    ...facts.map((fact) => element("td", { class: /^(.*[Cc]ommand|Commit|Run|Data file)$/.test(key) ? "code" : null }, fact[key] ?? "–"))));
  return table(several ? ["", ...runs.map((run) => run.name)] : [], rows, { className: "facts" });
}

function showTraining(data) {
  const charts = [
    trainingChart("Training loss", "training", data, { text: "Mean square error, normalised" }, true),
    trainingChart("Rollout error on the validation scenes", "validation", data, { text: "RMSE", unit: data.units.displacement }, false),
  ].filter(Boolean);
  byId("training").hidden = !charts.length;
}

function showAccuracy(data) {
  byId("accuracy").hidden = !data.tables.length;
  byId("accuracy-tables").append(...data.tables.map(measureTable));
}

function showSamples(data) {
  byId("all-scenes").hidden = !data.samples;
  if (!data.samples) return;
  byId("all-scenes-note").textContent = "RMSE of the displacement over the full rollout, NORMAL nodes, in ascending order.";
  samplesChart(data);
  byId("all-scenes-tables").append(samplesTable(data.samples, data.scenes, `The figures of ${plural(data.samples.names.length, "scene")}`));
}

function showScenes(data) {
  for (const id of ["scenes", "over-time"]) byId(id).hidden = !data.scenes.length;
  if (!data.scenes.length) return;
  byId("scenes-note").textContent = data.scenesNote;
  const overTime = new OverTime(data);
  const viewer = new Viewer(data, (state) => overTime.show(state));
  window.report = { viewer, overTime };
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  // Start to play once the scenes are in sight; stop while they are not.
  let resume = true;
  new IntersectionObserver(([entry]) => {
    if (entry.isIntersecting && resume) viewer.play();
    else if (!entry.isIntersecting) {
      resume = viewer.state.playing;
      viewer.pause();
    }
  }, { threshold: 0.15 }).observe(byId("viewer"));
}

function showRuns(data) {
  if (data.comparison) byId("comparison").append(comparisonTable(data.comparison));
  showScenes(data);
  showAccuracy(data);
  showSamples(data);
  showTraining(data);
}

const data = JSON.parse(byId("report-data").textContent);
byId("lead").textContent = data.lead;
byId("footer").textContent = data.footer;
tiles(data);
// The pages of runs, of a dataset and of a trade share the template. When it is filled, sections of the other kinds go.
const facts = data.kind === "runs" ? data.runs : [{ facts: data.facts }];
({ runs: showRuns, dataset: showDataset, trade: showTrade })[data.kind](data);
document.querySelectorAll("[data-kind]").forEach((part) => { if (part.dataset.kind !== data.kind) part.remove(); });
byId("facts").hidden = !facts.some((run) => run.facts.length);
byId("facts-tables").append(factTables(facts));
document.documentElement.dataset.ready = "true";
