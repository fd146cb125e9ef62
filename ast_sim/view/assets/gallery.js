// The gallery: small moving panels of many scenes. Browsers allow only a few WebGL contexts, so one context draws all
// panels, and each picture is copied to the panel's own canvas. The surface is drawn as loose triangles, which is enough
// for flat light, stress on faces and mesh lines.

const CYCLE_SECONDS = 5; // from the first to the last frame, and a moment of rest
const REST = 0.12; // share of the cycle in which the last frame stands still
const DRAW_MILLISECONDS = 33;

const VERTEX = `#version 300 es
in vec3 rest; in vec3 from; in vec3 to; in float valueFrom; in float valueTo;
uniform mat3 view; uniform vec3 center; uniform vec3 scale; uniform float moveScale, valueScale, between; uniform bool byValue;
out vec3 eye; out vec3 corner; out float value;
void main() {
  vec3 moved = moveScale * mix(from, to, between);
  eye = view * (rest + moved - center);
  value = byValue ? valueScale * mix(valueFrom, valueTo, between) : valueScale * length(moved);
  corner = vec3(gl_VertexID % 3 == 0, gl_VertexID % 3 == 1, gl_VertexID % 3 == 2);
  gl_Position = vec4(eye * scale, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 eye; in vec3 corner; in float value;
uniform vec3 ramp[10]; uniform vec4 flatColor, lineColor; uniform bool colored;
out vec4 color;
void main() {
  float place = 9.0 * clamp(value, 0.0, 1.0);
  int below = min(int(place), 8);
  vec3 base = colored ? mix(ramp[below], ramp[below + 1], place - float(below)) : flatColor.rgb;
  vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
  vec3 lit = base * (0.66 + 0.42 * abs(dot(normal, normalize(vec3(-0.35, 0.5, 0.8)))));
  vec3 width = fwidth(corner);
  vec3 near = smoothstep(vec3(0.0), 1.2 * width, corner);
  // Lines fade where triangles are only a few pixels wide.
  float line = (1.0 - min(near.x, min(near.y, near.z))) * clamp(1.4 - 4.0 * max(width.x, max(width.y, width.z)), 0.0, 1.0);
  float alpha = colored ? 1.0 : flatColor.a;
  color = vec4(mix(lit, lineColor.rgb, line * lineColor.a) * alpha, alpha);
}`;

// A colour of CSS as four numbers from 0 to 1.
const rgba = (text) => (knownColors[text] ??= readColor(text));
const knownColors = {};

function readColor(text) {
  const context = element("canvas", { width: 1, height: 1 }).getContext("2d", { willReadFrequently: true });
  context.fillStyle = text;
  context.fillRect(0, 0, 1, 1);
  return [...context.getImageData(0, 0, 1, 1).data].map((value) => value / 255);
}

// The box, in the axes of the view, of a group of triangles over all of its frames: [lows, highs].
function seenBox(axes, group, motion) {
  const rest = new Float32Array(bytes(group.rest));
  const moves = new Int16Array(bytes(motion.data));
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (let index = 0; index < moves.length; index += 3) {
    const place = [0, 1, 2].map((part) => rest[(index + part) % rest.length] + motion.scale * moves[index + part]);
    axes.forEach((axis, which) => {
      const at = axis[0] * place[0] + axis[1] * place[1] + axis[2] * place[2];
      low[which] = Math.min(low[which], at);
      high[which] = Math.max(high[which], at);
    });
  }
  return [low, high];
}

class Painter {
  constructor() {
    this.canvas = element("canvas");
    const gl = this.canvas.getContext("webgl2", { antialias: true, alpha: true });
    this.gl = gl;
    if (!gl) return;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    gl.useProgram(this.program);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.places = new Map();
  }

  get works() { return Boolean(this.gl) && !this.gl.isContextLost(); }

  uniform(name) {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name);
  }

  // The arrays of a group of triangles, one row a corner, in buffers of the graphics memory.
  upload(group, motion, stress, cells) {
    if (!group || !motion) return null;
    const triangles = new Uint32Array(bytes(group.triangles));
    const count = triangles.length;
    const spread = (values, kind, rows, size, row) => {
      const frames = values.length / (rows * size);
      const result = new kind(frames * count * size);
      for (let frame = 0, out = 0; frame < frames; frame++) {
        for (let corner = 0; corner < count; corner++) {
          const start = (frame * rows + row(corner)) * size;
          for (let part = 0; part < size; part++) result[out++] = values[start + part];
        }
      }
      return this.buffer(result);
    };
    const node = (corner) => triangles[corner];
    return {
      count,
      rest: spread(new Float32Array(bytes(group.rest)), Float32Array, group.nodes, 3, node),
      move: spread(new Int16Array(bytes(motion.data)), Int16Array, group.nodes, 3, node),
      moveScale: motion.scale,
      value: stress && spread(new Int16Array(bytes(stress.data)), Int16Array, cells ? count / 3 : group.nodes, 1,
        cells ? (corner) => Math.floor(corner / 3) : node),
      valueScale: stress ? stress.scale : 0,
    };
  }

  buffer(data) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, data, this.gl.STATIC_DRAW);
    return buffer;
  }

  attribute(name, buffer, size, kind, offset) {
    const place = this.gl.getAttribLocation(this.program, name);
    if (place < 0) return;
    if (!buffer) { this.gl.disableVertexAttribArray(place); return; }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.enableVertexAttribArray(place);
    this.gl.vertexAttribPointer(place, size, kind, false, 0, offset);
  }

  group(part, [from, to, between]) {
    const { gl } = this;
    this.attribute("rest", part.rest, 3, gl.FLOAT, 0);
    this.attribute("from", part.move, 3, gl.SHORT, 6 * part.count * from);
    this.attribute("to", part.move, 3, gl.SHORT, 6 * part.count * to);
    this.attribute("valueFrom", part.value, 1, gl.SHORT, 2 * part.count * from);
    this.attribute("valueTo", part.value, 1, gl.SHORT, 2 * part.count * to);
    gl.uniform1f(this.uniform("moveScale"), part.moveScale);
    gl.uniform1f(this.uniform("between"), between);
    gl.drawArrays(gl.TRIANGLES, 0, part.count);
  }

  // Draws a scene at `moment` (two stored frames and the place between them) and copies the picture to `target`.
  draw(target, { axes, center, extent, parts }, moment, { color, top, obstacle, line }) {
    const { gl, canvas } = this;
    const { width, height } = target;
    if (canvas.width < width) canvas.width = width;
    if (canvas.height < height) canvas.height = height;
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const zoom = Math.min(width / extent[0], height / extent[1]);
    gl.uniformMatrix3fv(this.uniform("view"), true, axes.flat());
    gl.uniform3fv(this.uniform("center"), center);
    gl.uniform3f(this.uniform("scale"), (2 * zoom) / width, (2 * zoom) / height, -2 / extent[2]);
    gl.uniform3fv(this.uniform("ramp"), COLORS[color].stops.flatMap((stop) => rgba8(stop)));
    gl.uniform4fv(this.uniform("lineColor"), line);
    gl.uniform4fv(this.uniform("flatColor"), obstacle);
    if (parts.body) {
      const byValue = color === "stress";
      gl.disable(gl.BLEND);
      gl.uniform1i(this.uniform("byValue"), byValue);
      gl.uniform1i(this.uniform("colored"), !byValue || Boolean(parts.body.value));
      gl.uniform1f(this.uniform("valueScale"), (byValue ? parts.body.valueScale : 1) / top);
      this.group(parts.body, moment);
    }
    if (parts.obstacle) {
      gl.enable(gl.BLEND);
      gl.depthMask(false);
      gl.uniform1i(this.uniform("colored"), false);
      this.group(parts.obstacle, moment);
    }
    const context = target.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.drawImage(canvas, 0, canvas.height - height, width, height, 0, 0, width, height);
  }
}

const rgba8 = (hex) => [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16) / 255);

class Tile {
  constructor(scene, units, open) {
    this.scene = scene;
    const { name, note, stopped, largest } = scene;
    const read = ["displacement", "stress"].map((color) => withUnit(largest[color], units[color])).filter(({ unit }) => unit);
    const figures = read.map(({ text, unit }) => `${text} ${unit}`).join(" · ");
    this.canvas = element("canvas", { class: "stage" });
    this.button = element("button", { type: "button", class: "tile-scene", "aria-label": `Enlarge ${name}: ${note}; up to ${figures}` },
      this.canvas, element("b", {}, name), element("span", { class: "figures" }, figures),
      stopped === null ? null : element("span", { class: "ended" }, `stopped after frame ${stopped}`));
    this.button.addEventListener("click", open);
    this.visible = true;
  }

  prepare(painter) {
    const { scene } = this;
    const { groups, truth } = scene;
    const axes = viewAxes(scene.planar ? PLANAR_VIEW : VIEW);
    const boxes = ["body", "obstacle"].filter((name) => groups[name]).map((name) => seenBox(axes, groups[name], truth[name]));
    const [low, high] = [0, 1].map((end) => axes.map((_, axis) => Math[end ? "max" : "min"](...boxes.map((box) => box[end][axis]))));
    const middle = low.map((value, axis) => (value + high[axis]) / 2);
    const center = [0, 1, 2].map((part) => axes.reduce((sum, axis, index) => sum + axis[part] * middle[index], 0));
    const extent = low.map((value, axis) => 1.12 * (high[axis] - value) || 1);
    const cells = scene.stress === "element";
    this.model = { axes, center, extent, parts: {
      body: painter.upload(groups.body, truth.body, truth.stress, cells), obstacle: painter.upload(groups.obstacle, truth.obstacle, null, false),
    } };
  }

  // The two stored frames around a frame number, and the place between them. A scene that ended earlier keeps its last.
  moment(frame) {
    const { frames } = this.scene;
    const last = frames.length - 1;
    if (frame >= frames[last]) return [last, last, 0];
    const from = Math.max(0, frames.findIndex((number) => number > frame) - 1);
    return [from, from + 1, (frame - frames[from]) / (frames[from + 1] - frames[from])];
  }

  draw(painter, frame, style) {
    const sharp = Math.min(devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(this.canvas.clientWidth * sharp), Math.round(this.canvas.clientHeight * sharp)];
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    if (!this.model) this.prepare(painter);
    this.shown = this.moment(frame ?? this.scene.frames[this.scene.peak]);
    painter.draw(this.canvas, this.model, this.shown, style);
  }
}

// All tiles: one clock, one colour scale, one button to play.
class Gallery {
  constructor(data, open) {
    this.data = data;
    this.color = "displacement";
    this.length = Math.max(...data.scenes.map((scene) => scene.frames[scene.frames.length - 1]), 1);
    this.tiles = data.scenes.map((scene, index) => new Tile(scene, data.units, () => open(index, this.color)));
    byId("gallery-tiles").append(...this.tiles.map((tile) => tile.button));
    this.painter = new Painter();
    byId("gallery-notice").hidden = this.painter.works;
    byId("gallery-obstacle").hidden = !data.scenes.some((scene) => scene.groups.obstacle);
    this.seconds = null; // since the first frame; null: every scene at its largest displacement
    this.playing = false;
    this.colorChoice();
    const watch = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.tiles.find(({ button }) => button === target).visible = isIntersecting;
      this.draw();
    });
    this.tiles.forEach(({ button }) => watch.observe(button));
    new ResizeObserver(() => this.draw()).observe(byId("gallery-tiles"));
    byId("gallery-play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    onThemeChange.push(() => this.draw());
    this.draw();
  }

  colorChoice() {
    const known = ["displacement", "stress"].filter((color) => this.data.scenes.some((scene) => scene.ranges[color]));
    byId("gallery-color").append(...known.map((color) =>
      segment("gallery-color", COLORS[color].title, null, color === this.color, () => { this.color = color; this.draw(); })));
    byId("gallery-color").hidden = known.length < 2;
  }

  // One scale for all tiles, so that scenes can be compared.
  get range() {
    const ranges = this.data.scenes.map((scene) => scene.ranges[this.color]).filter(Boolean);
    const max = Math.max(...ranges.map((range) => range.max));
    return { max, clipped: ranges.some((range) => range.clipped) };
  }

  get frame() {
    if (this.seconds === null) return null;
    return Math.min(1, ((this.seconds / CYCLE_SECONDS) % 1) / (1 - REST)) * this.length;
  }

  draw() {
    const { color, range } = this;
    drawScale(byId("gallery-scale-label"), byId("gallery-scale-bar"), color, range);
    if (!this.painter.works) return;
    const style = { color, top: range.max, obstacle: [...rgba(cssColor("obstacle")).slice(0, 3), 0.3], line: rgba(cssColor("mesh-line")) };
    this.tiles.filter(({ visible }) => visible).forEach((tile) => tile.draw(this.painter, this.frame, style));
  }

  play() {
    if (this.playing || this.length < 2) return;
    this.mark(true);
    let before = null;
    const advance = (now) => {
      if (!this.playing) return;
      if (before === null || now - before >= DRAW_MILLISECONDS) {
        this.seconds = (this.seconds ?? 0) + (before === null ? 0 : Math.min((now - before) / 1000, 0.2));
        before = now;
        if (this.tiles.some(({ visible }) => visible)) this.draw();
      }
      requestAnimationFrame(advance);
    };
    requestAnimationFrame(advance);
  }

  pause() { this.mark(false); }

  mark(playing) {
    this.playing = playing;
    byId("gallery-play").textContent = playing ? "Pause" : "Play";
  }
}
