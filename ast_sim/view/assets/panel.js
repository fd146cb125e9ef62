// One panel: the surface of a scene at a frame, coloured, with its mesh and the obstacle.

const COLORS = {
  displacement: {
    title: "Displacement", label: "Displacement magnitude", unit: "m",
    stops: ["#440154", "#482878", "#3e4a89", "#31688e", "#26838f", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"],
  },
  stress: {
    title: "von Mises stress", label: "von Mises stress", unit: "Pa",
    stops: ["#0d0887", "#46039f", "#7201a8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a", "#fdca26", "#f0f921"],
  },
};
const PLOT_CONFIG = { displayModeBar: false, responsive: true, scrollZoom: false };
const FRAMES_PER_SECOND = 12;
const VIEW = { eye: { x: -0.62, y: -1.32, z: 0.78 }, up: { x: 0, y: 0, z: 1 }, center: { x: 0, y: 0, z: -0.07 } };
const PLANAR_VIEW = { eye: { x: 0, y: 0, z: 1.6 }, up: { x: 0, y: 1, z: 0 }, center: { x: 0, y: 0, z: 0 } };

const TAN_HALF_ANGLE = Math.tan(Math.PI / 8); // of plotly's camera, vertically; horizontally it is `aspect` times as much

// Rows of a camera's axes: right, up, and from what it looks at to the eye.
function viewAxes({ eye, up, center }) {
  const unit = (v) => v.map((x) => x / Math.hypot(...v));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const back = unit(["x", "y", "z"].map((axis) => eye[axis] - center[axis]));
  const right = unit(cross([up.x, up.y, up.z], back));
  return [right, cross(back, right), back];
}

// The first camera of a scene. It is so far away that the whole box fits into a panel with width / height = `aspect`.
function fittingView(scene, aspect) {
  const view = structuredClone(scene.planar ? PLANAR_VIEW : VIEW);
  const { eye, center } = view;
  const axes = viewAxes(view);
  let distance = Math.hypot(eye.x - center.x, eye.y - center.y, eye.z - center.z);
  for (let corner = 0; corner < 8; corner++) {
    const place = ["x", "y", "z"].map((axis, which) => // in plotly's units, see Panel.layout
      ((corner >> which) & 1 ? 1 : -1) * (scene.high[which] - scene.low[which]) / scene.size - center[axis]);
    const [across, up, towards] = axes.map((axis) => axis.reduce((sum, part, which) => sum + part * place[which], 0));
    distance = Math.max(distance, towards + Math.max(Math.abs(across) / aspect, Math.abs(up)) / TAN_HALF_ANGLE);
  }
  ["x", "y", "z"].forEach((axis, which) => { eye[axis] = center[axis] + distance * axes[2][which]; });
  return view;
}

// The arrays that do not change of one group of triangles (the deforming bodies, or the obstacle).
function decodeGroup(group) {
  if (!group) return null;
  const triangles = new Uint32Array(bytes(group.triangles));
  const corners = [0, 1, 2].map((corner) => triangles.filter((_, index) => index % 3 === corner));
  const edges = new Map();
  for (let index = 0; index < triangles.length; index += 3) {
    for (const [a, b] of [[0, 1], [1, 2], [2, 0]]) {
      const pair = [triangles[index + a], triangles[index + b]].sort((p, q) => p - q);
      edges.set(pair[0] * group.nodes + pair[1], pair);
    }
  }
  return { rest: new Float32Array(bytes(group.rest)), nodes: group.nodes, corners, edges: [...edges.values()] };
}

function decodeMotion(motion) {
  if (!motion) return null;
  const arrays = { frames: motion.frames };
  for (const group of ["body", "obstacle"]) arrays[group] = motion[group] ? unpack(motion[group]) : null;
  arrays.stress = motion.stress ? unpack(motion.stress) : null;
  return arrays;
}

function decodeScene(scene) {
  return {
    ...scene,
    size: Math.hypot(...[0, 1, 2].map((axis) => scene.high[axis] - scene.low[axis])),
    groups: { body: decodeGroup(scene.groups.body), obstacle: decodeGroup(scene.groups.obstacle) },
    motions: [scene.truth, ...scene.predictions].map(decodeMotion),
  };
}

// The coordinates of a group at a frame, one array an axis.
function coordinates(group, displacement, frame) {
  const axes = [0, 1, 2].map(() => new Float32Array(group.nodes));
  const start = frame * group.nodes * 3;
  for (let node = 0; node < group.nodes; node++) {
    for (let axis = 0; axis < 3; axis++) {
      axes[axis][node] = group.rest[3 * node + axis] + displacement[start + 3 * node + axis];
    }
  }
  return axes;
}

function magnitudes(group, displacement, frame) {
  const start = frame * group.nodes * 3;
  return Float32Array.from({ length: group.nodes }, (_, node) =>
    Math.hypot(...displacement.subarray(start + 3 * node, start + 3 * node + 3)));
}

// The coordinates moved outward by `distance` along the mean normal of the triangles around each node.
function lifted([x, y, z], [i, j, k], distance) {
  const normals = [x, y, z].map((axis) => new Float32Array(axis.length));
  for (let triangle = 0; triangle < i.length; triangle++) {
    const [a, b, c] = [i[triangle], j[triangle], k[triangle]];
    const [ux, uy, uz, vx, vy, vz] = [x[b] - x[a], y[b] - y[a], z[b] - z[a], x[c] - x[a], y[c] - y[a], z[c] - z[a]];
    [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx].forEach((value, axis) => {
      for (const node of [a, b, c]) normals[axis][node] += value;
    });
  }
  const [p, q, r] = normals;
  return [x, y, z].map((axis, which) => axis.map((value, node) =>
    value + (distance * normals[which][node]) / (Math.hypot(p[node], q[node], r[node]) || 1)));
}

// The edges as one broken line: both ends of each, then a gap.
function edgeLines(edges, position) {
  const line = position.map(() => new Float32Array(3 * edges.length).fill(NaN));
  edges.forEach(([a, b], index) => {
    position.forEach((axis, which) => {
      line[which][3 * index] = axis[a];
      line[which][3 * index + 1] = axis[b];
    });
  });
  return line;
}

class Panel {
  constructor(title, subject) {
    this.title = title;
    this.subject = subject;
    this.note = element("span");
    this.ended = element("p", { class: "ended", hidden: true });
    this.stage = element("div", { class: "stage", tabindex: "0", role: "img" });
    this.figure = element("figure", { class: "panel" }, element("figcaption", {}, element("b", {}, title), this.note), this.stage, this.ended);
  }

  traces(scene, motion, frame, color, lines) {
    const { body, obstacle } = scene.groups;
    const traces = [];
    if (body) {
      const position = coordinates(body, motion.body, frame);
      traces.push(this.surface(scene, motion, frame, color, position));
      // Just above the surface: otherwise the surface would hide half of each line.
      const [x, y, z] = lines ? edgeLines(body.edges, lifted(position, body.corners, 0.0011 * scene.size)) : [[], [], []];
      traces.push({ type: "scatter3d", mode: "lines", x, y, z, line: { color: cssColor("mesh-line"), width: 1.5 }, hoverinfo: "skip" });
    }
    if (obstacle) {
      const [x, y, z] = coordinates(obstacle, motion.obstacle, frame);
      const [i, j, k] = obstacle.corners;
      traces.push({
        type: "mesh3d", x, y, z, i, j, k, color: cssColor("obstacle"), opacity: 0.34, hoverinfo: "skip",
        lighting: { ambient: 0.62, diffuse: 0.5, specular: 0.15, roughness: 0.5, fresnel: 0.1, facenormalsepsilon: 0 },
      });
    }
    return traces;
  }

  surface(scene, motion, frame, color, [x, y, z]) {
    const { body } = scene.groups;
    const [i, j, k] = body.corners;
    const unit = niceUnit(scene.ranges[color].max, COLORS[color].unit);
    const trace = {
      type: "mesh3d", x, y, z, i, j, k, flatshading: true, showscale: false,
      lighting: { ambient: 0.72, diffuse: 0.42, specular: 0.06, roughness: 0.7, fresnel: 0.05, facenormalsepsilon: 0, vertexnormalsepsilon: 0 },
      lightposition: { x: -2000, y: -4000, z: 9000 },
      hovertemplate: `%{intensity:.3g} ${unit.name}<extra></extra>`,
    };
    if (color === "stress" && !motion.stress) return { ...trace, color: cssColor("obstacle"), hoverinfo: "skip" };
    const cells = color === "stress" && scene.stress === "element";
    const rows = cells ? i.length : body.nodes;
    const values = color === "stress" ? motion.stress.slice(frame * rows, (frame + 1) * rows) : magnitudes(body, motion.body, frame);
    const stops = COLORS[color].stops;
    return {
      ...trace,
      intensitymode: cells ? "cell" : "vertex",
      intensity: values.map((value) => value / unit.scale),
      cmin: 0, cmax: scene.ranges[color].max / unit.scale,
      colorscale: stops.map((stop, index) => [index / (stops.length - 1), stop]),
    };
  }

  layout(scene, camera) {
    const axis = (which) => ({ visible: false, range: [scene.low[which], scene.high[which]], autorange: false, showspikes: false });
    const extent = [0, 1, 2].map((which) => scene.high[which] - scene.low[which]);
    const [x, y, z] = extent.map((length) => (2 * length) / scene.size);
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", showlegend: false, uirevision: scene.name,
      font: { family: "inherit", color: cssColor("ink") },
      hoverlabel: { bgcolor: cssColor("card"), bordercolor: cssColor("line"), font: { color: cssColor("ink"), size: 13 } },
      scene: {
        xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: "manual", aspectratio: { x, y, z }, camera,
        dragmode: scene.planar ? "pan" : "turntable", bgcolor: cssColor("stage"),
      },
    };
  }

  // Draws stored frame number `shown`. A prediction that ended earlier keeps its last frame and says so.
  draw(scene, which, shown, color, lines, camera) {
    const motion = scene.motions[which];
    this.figure.hidden = !motion;
    if (!motion) return Promise.resolve();
    const frame = Math.min(shown, motion.frames - 1);
    this.ended.hidden = shown < motion.frames && !(color === "stress" && !motion.stress);
    this.ended.textContent = shown >= motion.frames
      ? `ended after frame ${scene.frames[motion.frames - 1]}` : `${this.subject} has no stress`;
    const error = which === 0 ? null : scene.curves[color]?.runs[which - 1]?.[scene.frames[shown]];
    const read = error === null || error === undefined ? null : withUnit(error, COLORS[color].unit);
    this.note.textContent = read ? `RMSE ${read.text} ${read.unit}` : (which === 0 && scene.note) || "";
    this.stage.setAttribute("aria-label", `${this.title}, ${scene.name}, frame ${scene.frames[shown]}, coloured by ${COLORS[color].label}`);
    this.drawn = true;
    return Plotly.react(this.stage, this.traces(scene, motion, frame, color, lines), this.layout(scene, camera), PLOT_CONFIG);
  }

  // The camera as it is now, in the form of plotly's layout.
  camera() {
    const { eye, up, center } = this.stage._fullLayout.scene._scene.getCamera();
    return { eye, up, center };
  }
}
