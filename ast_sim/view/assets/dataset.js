// The page of a dataset: gallery with its enlarged view, histograms, yield, bounds, samples.

function showGallery(data) {
  byId("gallery").hidden = !data.scenes.length;
  if (!data.scenes.length) return;
  byId("gallery-note").textContent = data.scenesNote;
  for (const color of ["displacement", "stress"]) COLORS[color].unit = data.units[color];
  const dialog = byId("enlarged");
  dialog.append(byId("viewer"));
  byId("viewer").tabIndex = -1;
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let viewer = null;
  let resume = false;
  const gallery = new Gallery(data, (index, color) => {
    resume = gallery.playing;
    gallery.pause();
    dialog.showModal();
    if (viewer) viewer.select(index, color);
    else window.report.viewer = viewer = new Viewer(data, () => {}, index, color);
    byId("viewer").focus(); // not the button to close: so the keys step and play at once
    byId("scene-choice").querySelector("input:checked").parentElement.scrollIntoView({ block: "nearest", inline: "center" });
    if (!still) viewer.play();
  });
  byId("enlarged-close").addEventListener("click", () => dialog.close());
  // A click beside the dialog closes it, as Escape does.
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener("close", () => {
    viewer.pause();
    if (resume) gallery.play();
  });
  window.report = { gallery, viewer };
  if (!still) gallery.play();
}

// One chart: bars stacked by split, with the figures in words above. Without figures, a line says so.
function histogramCard(found, splits) {
  const { title, what, unit, counted, recorded, count, counts, edges, summary } = found;
  const heading = element("h3", {}, title, " ", element("small", {}, what));
  if (!count) return { card: element("div", { class: "chart" }, heading, element("p", { class: "absent" }, "Not recorded in this file.")) };
  const nice = niceUnit(summary.largest, unit);
  const scaled = (value) => value / nice.scale;
  const read = (value) => (found.whole ? String(Math.round(10 * value) / 10) : digits(scaled(value)));
  const total = splits.map((split) => (counts[split] || []).reduce((sum, number) => sum + number, 0));
  const parts = summary.smallest === summary.largest ? [`All ${read(summary.largest)}${nice.name && ` ${nice.name}`}`] : [
    `Median ${read(summary.median)}${nice.name && ` ${nice.name}`}`, `90 % in ${read(summary.low)} to ${read(summary.high)}`,
    `largest ${read(summary.largest)}`,
  ];
  if (found.not_finite) parts.push(`${found.not_finite} not finite`);
  const plot = element("div", { class: "plot", role: "img", "aria-label": `Histogram of ${title} ${what}: ${parts.join(", ")}` });
  const last = edges.length - 2;
  const label = (bin) => (found.open && bin === last ? `${read(edges[bin])} and more`
    : found.whole && edges[bin + 1] - edges[bin] === 1 ? `${edges[bin]}` : `${read(edges[bin])} to ${read(edges[bin + 1])}`);
  const card = element("div", { class: "chart" }, heading, element("p", { class: "figures" }, parts.join(" · ")), plot);
  card.dataset.recorded = recorded;
  // If each bin holds one whole number, the bar stands above this number.
  const shift = found.whole && edges[1] - edges[0] === 1 ? 0.5 : 0;
  const tallest = Math.max(...edges.slice(1).map((_, bin) => splits.reduce((sum, split) => sum + (counts[split]?.[bin] || 0), 0)));
  // A single bar does not fill the chart.
  const [low, high] = last ? [edges[0], edges[last + 1]] : [edges[0] - 3 * (edges[1] - edges[0]), edges[1] + 3 * (edges[1] - edges[0])];
  const make = () => [
    splits.map((split, index) => ({
      type: "bar", name: split, marker: { color: runColor(index) }, visible: total[index] > 0,
      x: edges.slice(0, -1).map((edge, bin) => scaled((edge + edges[bin + 1]) / 2 - shift)),
      width: edges.slice(0, -1).map((edge, bin) => scaled(0.94 * (edges[bin + 1] - edge))),
      y: counts[split] || [], customdata: edges.slice(0, -1).map((_, bin) => label(bin)),
      hovertemplate: `%{customdata}${nice.name && ` ${nice.name}`}: %{y}<extra>%{fullData.name}</extra>`,
    })),
    chartLayout(nice.name ? `${title} (${nice.name})` : title, counted === "frames" ? "Frames" : "Samples", {
      barmode: "stack", hovermode: "closest",
      xaxis: { range: [scaled(low - shift), scaled(high - shift)], ...tailTicks(found, scaled, read) }, yaxis: { tickformat: ",d", dtick: tallest <= 5 ? 1 : null },
    }),
  ];
  return { card, plot, make };
}

// Where the last bin holds everything above, its tick says so.
function tailTicks({ open, edges }, scaled, read) {
  if (!open) return {};
  const last = edges.length - 2;
  const every = Math.max(1, Math.ceil(last / 4));
  const places = edges.slice(0, last).filter((_, bin) => bin % every === 0 && bin <= last - every / 2);
  return { tickangle: 0, tickvals: [...places, edges[last]].map(scaled), ticktext: [...places.map(read), `≥ ${read(edges[last])}`] };
}

function showHistograms({ histograms, splits, samples }) {
  byId("histograms").hidden = !samples.count;
  if (!samples.count) return;
  if (splits.length > 1) byId("histograms-legend").append(legend(splits.map((split, index) => ({ text: split, color: `run-${index}` }))));
  const partly = histograms.filter(({ recorded }) => recorded && recorded < samples.count)
    .map(({ title, recorded }) => `${title} for ${recorded} of ${samples.count}`);
  byId("histograms-note").textContent = partly.length ? `Recorded: ${[...new Set(partly)].join(", ")}.` : "";
  // All cards are placed before the first chart is drawn, because a chart takes the width of its card at that moment.
  const cards = histograms.map((found) => histogramCard(found, splits));
  byId("histograms-charts").append(...cards.map(({ card }) => card));
  for (const { plot, make } of cards) if (plot) chart(plot, make);
}

function showYield({ complete, count, splits, reasons, stopped, left_out: leftOut }) {
  byId("yield").hidden = !count;
  if (!count) return;
  byId("yield-note").textContent = complete === count ? "Every sample has all of its frames."
    : `${count - complete} of ${plural(count, "sample")} stopped before their last frame; their stored frames converged.`;
  const row = (name, [done, all]) => {
    const bar = element("span", { class: "share" }, element("i"));
    bar.firstChild.style.width = `${(100 * done) / all}%`;
    return element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, String(done)), element("td", {}, String(all - done)),
      element("td", {}, `${digits((100 * done) / all)} %`, bar));
  };
  byId("yield-tables").append(table(["Split", "Complete", "Truncated", "Share complete"], Object.entries(splits).map(([name, numbers]) => row(name, numbers))));
  if (!stopped.length) return;
  const texts = (rows) => rows.map(([name, ...rest]) => element("tr", {}, element("th", { scope: "row" }, name), ...rest.map((text) => element("td", {}, String(text)))));
  byId("yield-tables").append(table(["Reason to stop", "Samples"], texts(reasons), { className: "words" }));
  byId("yield-tables").append(element("details", {},
    element("summary", {}, `${stopped.length === 1 ? "The truncated sample" : `The ${stopped.length} truncated samples`}${leftOut ? ` (${leftOut} more are left out)` : ""}`),
    table(["Sample", "Frames", "Stopped by"], texts(stopped), { className: "dense words" })));
}

function showChecks(checks) {
  byId("bounds").hidden = !checks.length;
  const rows = checks.map(({ title, what, bound, range, unit, worst, recorded, failed, passed }) => {
    const nice = niceUnit(range ? Math.max(...range.map(Math.abs)) : 0, unit);
    const read = (value) => (!unit && Number.isInteger(value) ? String(value) : digits(value / nice.scale));
    const span = !range ? "–" : range[0] === range[1] ? read(range[0]) : `${read(range[0])} to ${read(range[1])}`;
    const [mark, words] = passed === null ? ["none", "not recorded"] : passed ? ["pass", "✓ pass"] : ["fail", `✗ fail: ${failed}`];
    return element("tr", {}, element("th", { scope: "row" }, title, " ", element("small", {}, what)),
      element("td", {}, element("span", { class: `verdict ${mark}` }, words)), element("td", {}, bound),
      element("td", {}, nice.name && range ? `${span} ${nice.name}` : span), element("td", {}, worst || "–"), element("td", {}, String(recorded)));
  });
  byId("bounds-tables").append(table(["Figure", "Verdict", "Bound", "Range over the samples", "Worst sample", "Recorded"], rows));
}

function showDatasetSamples({ samples, scenes }) {
  byId("samples").hidden = !samples.names.length;
  if (!samples.names.length) return;
  const part = samples.names.length < samples.count ? `${samples.names.length} of ${samples.count} samples, at even steps` : plural(samples.count, "sample");
  byId("samples-note").textContent = `In ascending order of the largest displacement: ${part}.`;
  byId("samples-tables").append(samplesTable(samples, scenes, `The figures of ${part.split(",")[0]}`));
}

function showDataset(data) {
  showGallery(data);
  showHistograms(data);
  showYield(data.yields);
  showChecks(data.checks);
  showDatasetSamples(data);
  byId("facts-title").textContent = "Facts of the dataset";
}
