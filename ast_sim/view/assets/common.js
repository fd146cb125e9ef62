// Shared by all parts of the page: numbers with units, packed arrays, the theme, and a way to make elements.

const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"]];
// Of the units that take a prefix; all others ("mm", "in", "mm²") are shown as they are.
const PREFIXED = {
  "m": PREFIXES, "m²": [[1, ""], [1e-4, "c"], [1e-6, "m"], [1e-12, "µ"]], "s": PREFIXES.slice(3), "Pa": PREFIXES.slice(0, 4),
};

// The factor and the name of the unit in which `largest` reads well: {scale, name}.
function niceUnit(largest, unit) {
  const prefixes = PREFIXED[unit];
  if (!prefixes || !(largest > 0)) return { scale: 1, name: unit || "" };
  const [scale, prefix] = prefixes.find(([size]) => largest >= 0.9995 * size) || prefixes[prefixes.length - 1];
  return { scale, name: prefix + unit };
}

// Three significant digits, never fewer than the integer part; an absent number is a dash.
function digits(value, significant = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.floor(Math.log10(Math.abs(value) * (1 + 0.5 * 10 ** -significant)));
  if (size < -4) return value.toExponential(significant - 1).replace("-", "−");
  return value.toFixed(Math.max(0, significant - 1 - size)).replace("-", "−");
}

function withUnit(value, unit) {
  const nice = niceUnit(Math.abs(value), unit);
  const text = digits(value === null ? null : value / nice.scale);
  return { text, unit: text === "–" ? "" : nice.name };
}

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === false) continue;
    node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

// "1 scene", "2 scenes"
const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

const byId = (id) => document.getElementById(id);

// Little-endian arrays in base64. `packed` are int16 with one scale: value = scale * integer.
function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
}

function unpack(packed) {
  return Float32Array.from(new Int16Array(bytes(packed.data)), (value) => value * packed.scale);
}

function cssColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

const runColor = (index) => cssColor(`run-${index % 6}`);

const onThemeChange = [];
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => onThemeChange.forEach((redraw) => redraw()));
