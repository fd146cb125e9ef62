// The moving scenes: one panel for the truth and one for every run, which share camera, frame, colours and scale.

const medianScene = ({ scenes }) => Math.max(0, scenes.findIndex((scene) => scene.label === "Median"));

// The colours of a quantity and its numbers in the unit that reads well.
function drawScale(label, bar, color, { max, clipped }) {
  const unit = niceUnit(max, COLORS[color].unit);
  label.textContent = `${COLORS[color].label} (${unit.name})`;
  const ticks = [0, 0.25, 0.5, 0.75, 1].map((part) => {
    const tick = element("b", {}, `${part === 1 && clipped ? "≥ " : ""}${digits((part * max) / unit.scale)}`);
    tick.style.left = `${100 * part}%`;
    return tick;
  });
  const ramp = element("i");
  ramp.style.background = `linear-gradient(90deg, ${COLORS[color].stops.join(", ")})`;
  bar.replaceChildren(ramp, ...ticks);
}

class Viewer {
  constructor(data, onChange, first = medianScene(data), color = "displacement") {
    this.data = data;
    this.onChange = onChange;
    this.decoded = new Map();
    this.state = { scene: 0, frame: 0, color, lines: true, playing: false };
    this.panels = [new Panel(data.runs.length ? "Truth" : "Simulation", "the truth"), ...data.runs.map((run) =>
      new Panel(data.runs.length > 1 ? `Prediction of ${run.name}` : "Prediction", "the prediction"))];
    byId("panels").append(...this.panels.map((panel) => panel.figure));
    this.panels.forEach((panel, index) => this.follow(panel, index));
    COLORS.displacement.unit = data.units.displacement;
    COLORS.stress.unit = data.units.stress;
    this.controls(first);
    onThemeChange.push(() => this.draw());
    this.choose(first);
  }

  get scene() {
    const { scene } = this.state;
    if (!this.decoded.has(scene)) this.decoded.set(scene, decodeScene(this.data.scenes[scene]));
    return this.decoded.get(scene);
  }

  choose(index) {
    this.state.scene = index;
    const scene = this.scene;
    if (!scene.ranges[this.state.color]) this.state.color = "displacement";
    this.tracked = null;
    this.camera = this.startView();
    this.state.frame = Math.min(this.state.frame, scene.frames.length - 1);
    byId("frame").max = scene.frames.length - 1;
    for (const control of [byId("frame"), byId("play")]) control.disabled = scene.frames.length < 2;
    byId("obstacle-key").hidden = !scene.groups.obstacle;
    this.colorChoice();
    this.draw();
  }

  startView() {
    const { clientWidth, clientHeight } = this.panels[0].stage;
    return fittingView(this.scene, clientWidth && clientHeight ? clientWidth / clientHeight : 1);
  }

  // As if the user had chosen the scene and the colour.
  select(index, color) {
    byId("scene-choice").querySelectorAll("input")[index].checked = true;
    Object.assign(this.state, { color, frame: 0 });
    this.choose(index);
  }

  // Draws all panels; while a drawing is under way the last request waits.
  async draw() {
    this.scale();
    this.labels();
    this.onChange(this.state);
    if (this.drawing) { this.waiting = true; return this.drawing; }
    this.drawing = (async () => {
      do {
        this.waiting = false;
        const { frame, color, lines } = this.state;
        await Promise.all(this.panels.map((panel, index) => panel.draw(this.scene, index, frame, color, lines, this.camera)));
      } while (this.waiting);
      this.drawing = null;
    })();
    return this.drawing;
  }

  labels() {
    const { frames, total } = this.scene;
    const shown = frames[this.state.frame];
    byId("frame").value = this.state.frame;
    byId("frame").setAttribute("aria-valuetext", `frame ${shown} of ${total - 1}`);
    byId("frame-label").textContent = `frame ${shown} of ${total - 1}`;
    byId("play").classList.toggle("playing", this.state.playing);
    byId("play").setAttribute("aria-label", this.state.playing ? "Pause" : "Play");
  }

  scale() {
    drawScale(byId("scale-label"), byId("scale-bar"), this.state.color, this.scene.ranges[this.state.color]);
  }

  // The camera of one panel moves all the others.
  follow(panel, index) {
    panel.stage.addEventListener("keydown", (event) => this.cameraKey(event));
    panel.stage.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.zoom(Math.exp(0.004 * event.deltaY));
    }, { passive: false });
    panel.stage.addEventListener("pointerdown", () => this.track(panel, index));
  }

  // Follows the camera of a panel while the mouse holds it, and until it has come to rest: plotly's events end earlier.
  track(panel, index) {
    let held = true;
    let moved = performance.now();
    this.tracked = index;
    window.addEventListener("pointerup", () => { held = false; moved = performance.now(); }, { once: true });
    const look = (now) => {
      if (this.tracked !== index) return;
      const camera = panel.camera();
      if (JSON.stringify(camera) !== JSON.stringify(this.camera)) {
        moved = now;
        this.setCamera(camera, index);
      }
      if (held || now - moved < 500) requestAnimationFrame(look);
      else this.tracked = null;
    };
    requestAnimationFrame(look);
  }

  // Moves all panels but `source`; while a move is under way the last request waits.
  async setCamera(camera, source = null) {
    if (source === null) this.tracked = null;
    this.camera = structuredClone(camera);
    this.wanted = { camera: this.camera, source };
    if (this.moving) return;
    this.moving = true;
    while (this.wanted) {
      const { camera: next, source: from } = this.wanted;
      this.wanted = null;
      const others = this.panels.filter((panel, index) => index !== from && !panel.figure.hidden && panel.drawn);
      await Promise.all(others.map((panel) => Plotly.relayout(panel.stage, { "scene.camera": structuredClone(next) })));
    }
    this.moving = false;
  }

  zoom(factor) {
    const { eye, ...rest } = this.camera;
    this.setCamera({ ...rest, eye: { x: eye.x * factor, y: eye.y * factor, z: eye.z * factor } });
  }

  resetView() {
    this.setCamera(this.startView());
  }

  turn(right, up) {
    const { eye, ...rest } = this.camera;
    const radius = Math.hypot(eye.x, eye.y, eye.z);
    const azimuth = Math.atan2(eye.y, eye.x) + right;
    const elevation = Math.max(-1.5, Math.min(1.5, Math.asin(eye.z / radius) + up));
    const flat = radius * Math.cos(elevation);
    this.setCamera({ ...rest, eye: { x: flat * Math.cos(azimuth), y: flat * Math.sin(azimuth), z: radius * Math.sin(elevation) } });
  }

  cameraKey(event) {
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    if (!turns[event.key] || this.scene.planar) return;
    event.preventDefault();
    event.stopPropagation();
    this.turn(...turns[event.key]);
  }

  step(by) {
    this.pause();
    this.state.frame = Math.max(0, Math.min(this.scene.frames.length - 1, this.state.frame + by));
    this.draw();
  }

  pause() {
    this.state.playing = false;
    this.labels();
  }

  play() {
    if (this.state.playing || this.scene.frames.length < 2) return;
    this.state.playing = true;
    let due = performance.now();
    const advance = async (now) => {
      if (!this.state.playing) return;
      if (now >= due) {
        const wait = 1000 / (FRAMES_PER_SECOND * Number(byId("speed").value));
        due = Math.max(due + wait, now);
        this.state.frame = (this.state.frame + 1) % this.scene.frames.length;
        await this.draw();
      }
      requestAnimationFrame(advance);
    };
    this.labels();
    requestAnimationFrame(advance);
  }

  controls(first) {
    byId("play").addEventListener("click", () => (this.state.playing ? this.pause() : this.play()));
    byId("frame").addEventListener("input", (event) => this.step(Number(event.target.value) - this.state.frame));
    byId("mesh-lines").addEventListener("change", (event) => { this.state.lines = event.target.checked; this.draw(); });
    byId("zoom-in").addEventListener("click", () => this.zoom(1 / 1.2));
    byId("zoom-out").addEventListener("click", () => this.zoom(1.2));
    byId("reset-view").addEventListener("click", () => this.resetView());
    byId("scene-choice").append(...this.data.scenes.map((scene, index) => {
      const error = withUnit(scene.error, this.data.units.displacement);
      return segment("scene", scene.label, error.unit ? `${error.text} ${error.unit}` : null, index === first, () => this.choose(index));
    }));
    const keys = {
      " ": () => byId("play").click(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1),
      Home: () => this.step(-Infinity), End: () => this.step(Infinity),
      "+": () => this.zoom(1 / 1.2), "-": () => this.zoom(1.2), 0: () => this.resetView(),
    };
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
      if (event.target.closest("button, input, select, summary, a") || !byId("viewer").getClientRects().length) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  colorChoice() {
    const known = Object.keys(COLORS).filter((color) => this.scene.ranges[color]);
    const choice = byId("color-choice");
    choice.replaceChildren(choice.firstElementChild, ...known.map((color) =>
      segment("color", COLORS[color].title, null, color === this.state.color, () => { this.state.color = color; this.draw(); })));
    choice.hidden = known.length < 2;
  }
}

// One of several choices: a radio button that looks like a pill.
function segment(group, title, detail, checked, choose) {
  const input = element("input", { type: "radio", name: group, checked });
  input.addEventListener("change", choose);
  const text = element("span", {}, title, ...(detail ? [" ", element("small", {}, detail)] : []));
  return element("label", {}, input, text);
}
