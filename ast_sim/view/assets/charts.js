// Curves and bars: errors over time, every test scene, training.

const CHART_CONFIG = { displayModeBar: false };

// A chart is as wide as its card. The card changes not only with the window, but also when cards beside it come or go.
const fitting = new ResizeObserver((entries) => entries.forEach(({ target }) => {
  if (target.layout && target.offsetWidth) Plotly.Plots.resize(target);
}));

function chartLayout(x, y, extra = {}) {
  const axis = {
    gridcolor: cssColor("grid"), linecolor: cssColor("line"), zeroline: false, tickfont: { size: 12, color: cssColor("soft") },
    automargin: true, fixedrange: true,
  };
  const title = (text) => ({ text, font: { size: 12.5, color: cssColor("soft") }, standoff: 8 });
  return {
    margin: { l: 8, r: 10, t: 8, b: 8 }, showlegend: false, hovermode: "x unified", hoverdistance: 30,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: getComputedStyle(document.body).fontFamily, size: 12.5, color: cssColor("ink") },
    hoverlabel: { bgcolor: cssColor("card"), bordercolor: cssColor("line"), font: { color: cssColor("ink"), size: 12.5 } },
    ...extra,
    xaxis: { ...axis, showgrid: false, ...extra.xaxis, title: title(x) },
    yaxis: { ...axis, rangemode: "tozero", ...extra.yaxis, title: title(y) },
  };
}

// `make()` gives [traces, layout]; the chart is made again when the colour scheme changes.
function chart(host, make) {
  const redraw = () => Plotly.react(host, ...make(), CHART_CONFIG);
  fitting.observe(host);
  onThemeChange.push(redraw);
  redraw();
  return redraw;
}

function legend(entries) {
  return element("ul", { class: "legend" }, ...entries.map(({ text, color, dashed }) => {
    const line = element("i", { class: dashed ? "dashed" : null });
    line.style.borderTopColor = `var(--${color})`;
    return element("li", {}, line, text);
  }));
}

const runLegend = (data) => data.runs.map((run, index) => ({ text: data.runs.length > 1 ? run.name : "Prediction", color: `run-${index % 6}` }));

const TRIVIAL = {
  displacement: { text: "Hold still", what: "the displacement at the NORMAL nodes, per coordinate; “hold still” keeps the first frame" },
  stress: { text: "Mean of the frame", what: "the von Mises stress outside the obstacle; “mean of the frame” predicts the true mean of each frame" },
};

// One small chart for each scene, all on one scale. A line marks the frame that the viewer shows.
class OverTime {
  constructor(data) {
    this.data = data;
    this.cards = data.scenes.map((scene) => {
      const plot = element("div", { class: "plot" });
      fitting.observe(plot);
      const title = element("h3", {}, `${scene.label}: ${scene.name}`);
      const key = element("div");
      return { plot, key, scene, card: element("div", { class: "chart" }, title, key, plot) };
    });
    byId("over-time-charts").append(...this.cards.map(({ card }) => card));
    onThemeChange.push(() => this.draw());
  }

  show({ scene, frame, color }) {
    this.cards.forEach(({ card }, index) => card.classList.toggle("current", index === scene && this.cards.length > 1));
    const drawn = this.color;
    this.color = color;
    this.current = scene;
    this.frame = this.data.scenes[scene].frames[frame];
    if (drawn === color) this.cards.forEach((_, index) => this.mark(index));
    else this.draw();
  }

  draw() {
    const values = this.cards.flatMap(({ scene }) => {
      const curves = scene.curves[this.color];
      return curves ? [...curves.trivial, ...curves.runs.flatMap((run) => run || [])] : [];
    });
    const largest = Math.max(...values.filter(Number.isFinite), 0);
    this.unit = niceUnit(largest, COLORS[this.color].unit);
    this.top = largest > 0 ? (1.06 * largest) / this.unit.scale : 1;
    byId("over-time-note").textContent = `Root mean square error of ${TRIVIAL[this.color].what}. All charts share one scale.`;
    this.cards.forEach((_, index) => this.drawCard(index));
  }

  drawCard(index) {
    const { plot, key, card, scene } = this.cards[index];
    const curves = scene.curves[this.color];
    card.hidden = !curves;
    if (!curves) return;
    const line = (name, values, color, dash) => ({
      x: values.map((_, frame) => frame), y: values.map((value) => (value === null ? null : value / this.unit.scale)),
      name, type: "scatter", mode: values.length > 1 ? "lines" : "markers", line: { color, width: 2, dash },
      hovertemplate: `%{y:.3g} ${this.unit.name}`,
    });
    const runs = runLegend(this.data);
    key.replaceChildren(legend([...runs, { text: TRIVIAL[this.color].text, color: "trivial", dashed: true }]));
    const traces = [
      line(TRIVIAL[this.color].text, curves.trivial, cssColor("trivial"), "dash"),
      ...curves.runs.flatMap((values, run) => (values ? [line(runs[run].text, values, runColor(run), "solid")] : [])),
    ];
    const layout = chartLayout("Frame", `RMSE (${this.unit.name})`, {
      yaxis: { range: [0, this.top] }, xaxis: { range: [0, Math.max(scene.total - 1, 1)] }, shapes: this.cursor(index),
    });
    Plotly.react(plot, traces, layout, CHART_CONFIG);
  }

  cursor(index) {
    if (index !== this.current) return [];
    return [{ type: "line", x0: this.frame, x1: this.frame, yref: "paper", y0: 0, y1: 1, line: { color: cssColor("faint"), width: 1 } }];
  }

  mark(index) {
    const { plot, card } = this.cards[index];
    if (card.hidden || (index !== this.current && !plot.layout?.shapes?.length)) return;
    Plotly.relayout(plot, { shapes: this.cursor(index) });
  }
}

// The error of every test scene as bars, ascending; the scenes shown above carry their labels.
function samplesChart(data) {
  const order = data.samples.order;
  const largest = Math.max(...data.samples.runs.flat().concat(data.samples.trivial).filter(Number.isFinite), 0);
  const unit = niceUnit(largest, data.samples.unit);
  const labels = Object.fromEntries(data.scenes.map((scene) => [scene.name, scene.label]));
  const scaled = (values) => order.map((index) => (values[index] === null ? null : values[index] / unit.scale));
  const names = order.map((index) => data.samples.names[index]);
  const plot = element("div", { class: "plot" });
  const runs = runLegend(data);
  byId("all-scenes-chart").append(legend([...runs, { text: "Hold still", color: "trivial" }]), plot);
  chart(plot, () => [
    [
      ...data.samples.runs.map((values, run) => ({
        type: "bar", x: names, y: scaled(values), name: runs[run].text, marker: { color: runColor(run) }, hovertemplate: `%{y:.3g} ${unit.name}`,
      })),
      {
        type: "scatter", mode: "markers", x: names, y: scaled(data.samples.trivial), name: "Hold still",
        marker: { symbol: "line-ew-open", size: 16, color: cssColor("trivial"), line: { width: 2.5 } }, hovertemplate: `%{y:.3g} ${unit.name}`,
      },
    ],
    chartLayout("", `RMSE (${unit.name})`, {
      bargap: 0.35,
      xaxis: { type: "category", tickvals: names, ticktext: names.map((name) => (labels[name] ? `<b>${labels[name]}</b>` : "")), tickangle: 0 },
    }),
  ]);
}

function trainingChart(title, kind, data, yTitle, log) {
  const present = data.runs.map((run, index) => ({ index, run, curves: run[kind] })).filter(({ curves }) => curves && curves.length);
  if (!present.length) return null;
  const plot = element("div", { class: "plot" });
  const several = present.length > 1;
  const names = present[0].curves.map((curve) => curve.name);
  const style = (name, which, index) => (name === TRIVIAL.displacement.text ? ["trivial", "dash"]
    : several ? [`run-${index % 6}`, ["solid", "dot", "dash"][which]] : [`run-${which}`, "solid"]);
  const entries = several
    ? present.map(({ run, index }) => ({ text: run.name, color: `run-${index % 6}` }))
    : names.map((name, which) => ({ text: name, color: style(name, which, 0)[0], dashed: style(name, which, 0)[1] !== "solid" }));
  const values = present.flatMap(({ curves }) => curves.flatMap((curve) => curve.y));
  const unit = niceUnit(log ? 0 : Math.max(...values.filter(Number.isFinite), 0), yTitle.unit);
  const card = element("div", { class: "chart" }, element("h3", {}, title), entries.length > 1 ? legend(entries) : null, plot);
  byId("training-charts").append(card);
  chart(plot, () => [
    present.flatMap(({ curves, index, run }) => curves.map((curve, which) => ({
      type: "scatter", mode: curve.x.length > 30 ? "lines" : "lines+markers", x: curve.x, y: curve.y.map((value) => (value === null ? null : value / unit.scale)),
      name: several ? `${run.name}: ${curve.name}` : curve.name, hovertemplate: `%{y:.3g} ${unit.name}`,
      line: { color: cssColor(style(curve.name, which, index)[0]), dash: style(curve.name, which, index)[1], width: 2 }, marker: { size: 6 },
    }))),
    chartLayout("Step", unit.name ? `${yTitle.text} (${unit.name})` : yTitle.text, log ? { yaxis: { type: "log", rangemode: "normal", dtick: 1 } } : {}),
  ]);
  return card;
}
