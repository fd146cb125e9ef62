// The page of a trade: one chart of all settings, with the front of each side, and two tables.

function tradeChart(part, sides, mesh) {
  const entries = sides.map(({ name }, side) => ({ text: name, color: `run-${side}` }));
  if (mesh !== null) entries.push({ text: "The mesh itself", color: "soft", dashed: true });
  const host = element("div", { class: "plot", role: "img", "aria-label": "Error against seconds of an answer, both on logarithmic scales" });
  part.append(element("div", { class: "chart" }, legend(entries), host));
  const times = sides.flatMap(({ points }) => points.map((point) => 1000 * point.seconds));
  const meshLine = () => mesh === null ? [] : [{
    x: [Math.min(...times), Math.max(...times)], y: [100 * mesh, 100 * mesh], name: "The mesh itself", mode: "lines",
    line: { color: cssColor("soft"), width: 2, dash: "dash" }, hovertemplate: "The mesh itself<br>%{y:.3g} %<extra></extra>",
  }];
  const traces = () => sides.flatMap(({ name, points }, side) => {
    const part = (kept, extra) => ({
      x: kept.map((point) => 1000 * point.seconds), y: kept.map((point) => 100 * Math.max(point.error, 1e-4)),
      text: kept.map((point) => point.name), name, hovertemplate: "%{text}<br>%{x:.3g} ms, %{y:.3g} %<extra></extra>", ...extra,
    });
    return [
      part(points.filter((point) => !point.front), { mode: "markers", marker: { color: runColor(side), size: 6, opacity: 0.4 } }),
      part(points.filter((point) => point.front), { mode: "lines+markers", line: { color: runColor(side), width: 2 }, marker: { color: runColor(side), size: 9 } }),
    ];
  }).concat(meshLine());
  const steps = Array.from({ length: 12 }, (_, power) => [1, 2, 5].map((digit) => digit * 10 ** (power - 4))).flat();
  const log = (spare) => ({ type: "log", rangemode: "normal", showgrid: true, tickvals: steps, ticktext: steps.map((step) => (spare && String(step).match(/[25]/) ? "" : String(step))) });
  chart(host, () => [traces(), chartLayout("Milliseconds of an answer (median)", "Error of the displacement (%)", { hovermode: "closest", xaxis: log(false), yaxis: log(true) })]);
}

// "20 ms: a setting" has its setting below, smaller.
function textCell(text) {
  const [value, ...setting] = text.split(": ");
  return element("td", {}, value, setting.length ? element("br") : null, setting.length ? element("small", {}, setting.join(": ")) : null);
}

function textRows(rows, cell = (text) => element("td", {}, text)) {
  return rows.map(([first, ...others]) => element("tr", {}, element("th", { scope: "row" }, first), ...others.map(cell)));
}

function showTrade(data) {
  byId("trade-note").textContent = data.note;
  data.tables.forEach(({ name, columns, rows, notes }) => byId("trade-tables").append(
    table(columns, textRows(rows, textCell), { title: name, className: "prices" }), ...notes.map((note) => element("p", {}, note)),
  ));
  tradeChart(byId("trade-chart"), data.sides.filter(({ points }) => points.length), data.mesh);
  const all = table(data.settings.columns, textRows(data.settings.rows), { className: "dense words" });
  byId("trade-settings").append(element("details", {}, element("summary", {}, `All ${data.settings.rows.length} settings`), all));
}
