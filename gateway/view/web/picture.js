// Draws the robot and its cells with WebGL2.

import { css, ramp, rgb, shapeOf } from "./colours.js";
import { add, cross, unit } from "./math.js";
import { cylinders, triangles } from "./robot.js";

const SOLID = [`layout(location=0) in vec3 at; layout(location=1) in vec3 n; uniform mat4 view, m; out vec3 facing;
void main() { facing = mat3(m) * n; gl_Position = view * m * vec4(at, 1.); }`,
`in vec3 facing; uniform vec3 colour; out vec4 o;
void main() { float l = .58 + .42 * max(dot(normalize(facing), normalize(vec3(.4, -.5, .77))), 0.); o = vec4(colour * l, 1.); }`];

// uv: the place in the hexagon, whose corners are at 1; kind: shape, and 16 if chosen, 32 if pressed, 64 if a root.
const CELL = [`layout(location=0) in vec3 at; layout(location=1) in vec3 n; layout(location=2) in vec2 uv; layout(location=3) in vec4 look;
uniform mat4 view, m; out vec3 facing; out vec2 place; flat out vec4 shown;
void main() { facing = mat3(m) * n; place = uv; shown = look; gl_Position = view * m * vec4(at, 1.); }`,
`in vec3 facing; in vec2 place; flat in vec4 shown; uniform vec3 mark, edge, chosen; out vec4 o;
void main() {
  int kind = int(shown.w * 255. + .5), shape = kind & 15;
  float l = .62 + .38 * max(dot(normalize(facing), normalize(vec3(.4, -.5, .77))), 0.);
  vec3 c = shown.rgb * l;
  vec2 p = abs(place);
  float hex = max(p.x * .866 + p.y * .5, p.y) / .866, r = length(place);
  if (shape == 1 && min(abs(place.x - place.y), abs(place.x + place.y)) < .2 && r < .8) c = mark;
  if (shape == 2 && hex < .72) discard;
  if (shape == 3 && r < .4) discard;
  if (shape == 4 && place.x > 0. && hex < .86) c = mark;
  if (shape == 5 && p.y < .16 && p.x < .66) c = mark;
  if (shape == 6 && max(p.x, p.y) < .34) c = mark;
  if ((kind & 64) != 0 && hex > .5 && hex < .6) c = mark;
  if (hex > .86) c = edge * l;
  if ((kind & 48) != 0 && hex > .72) c = (kind & 32) != 0 && hex < .84 ? mark : chosen;
  o = vec4(c, 1.);
}`];

const CORNERS = [0, 1, 2, 3, 4, 5].map((k) => [Math.cos(k * Math.PI / 3), Math.sin(k * Math.PI / 3)]);
const VERTICES = 12; // four triangles of three
const FAN = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]];

export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: false });
    if (!this.gl) throw new Error("WebGL2 is not available");
  }

  program([vertex, fragment]) {
    const { gl } = this, program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${source}`);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const place = (name) => gl.getUniformLocation(program, name);
    return { program, view: place("view"), m: place("m"), colour: place("colour"), mark: place("mark"), edge: place("edge"), chosen: place("chosen") };
  }

  buffer(data, layout, usage) {
    const { gl } = this, buffer = gl.createBuffer(), stride = layout.reduce((sum, [, n]) => sum + n, 0) * 4;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, usage);
    let offset = 0;
    for (const [at, n] of layout) {
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, n, gl.FLOAT, false, stride, offset);
      offset += n * 4;
    }
    return buffer;
  }

  // Takes a scene: what does not change.
  set(scene) {
    const { gl } = this;
    this.scene = scene;
    this.solid = this.program(SOLID);
    this.cell = this.program(CELL);
    // What has one frame is drawn at once.
    const parts = new Map();
    for (const it of cylinders(scene)) {
      const key = `${it.chain} ${it.row}`;
      const part = parts.get(key) ?? { chain: it.chain, row: it.row, data: [] };
      part.data.push(...triangles(it));
      parts.set(key, part);
    }
    this.parts = [...parts.values()].map(({ chain, row, data }) => {
      const vao = gl.createVertexArray();
      gl.bindVertexArray(vao);
      this.buffer(new Float32Array(data), [[0, 3], [1, 3]], gl.STATIC_DRAW);
      return { chain, row, vao, count: data.length / 6 };
    });
    // Cells by frame: `order` has their places in the scene.
    const order = scene.cells.map((_, i) => i);
    const key = (i) => { const c = scene.cells[i]; return scene.buses[c.bus].chain * 64 + c.row; };
    order.sort((i, j) => key(i) - key(j) || i - j);
    this.order = order;
    this.groups = [];
    order.forEach((i, at) => {
      const cell = scene.cells[i], chain = scene.buses[cell.bus].chain, last = this.groups[this.groups.length - 1];
      if (last && last.chain === chain && last.row === cell.row) last.count++;
      else this.groups.push({ chain, row: cell.row, first: at, count: 1 });
    });
    const data = new Float32Array(order.length * VERTICES * 8), size = scene.pitch * 0.56;
    let k = 0;
    for (const i of order) {
      const { position, normal } = scene.cells[i];
      const x = unit(cross(normal, Math.abs(normal[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), y = cross(normal, x);
      const middle = add(position, normal, 0.0012);
      for (const corner of FAN.flat()) {
        const [u, v] = CORNERS[corner];
        data.set([...add(add(middle, x, u * size), y, v * size), ...normal, u, v], k);
        k += 8;
      }
    }
    this.cells = gl.createVertexArray();
    gl.bindVertexArray(this.cells);
    this.buffer(data, [[0, 3], [1, 3], [2, 2]], gl.STATIC_DRAW);
    this.looks = new Uint8Array(order.length * VERTICES * 4);
    this.look = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.look);
    gl.bufferData(gl.ARRAY_BUFFER, this.looks, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribPointer(3, 4, gl.UNSIGNED_BYTE, true, 0, 0);
    this.colours();
  }

  // Reads the colours again: light and dark differ.
  colours() {
    const colour = (name) => rgb(css(name)).map((v) => v / 255);
    this.theme = { back: colour("--back"), robot: colour("--robot"), unlit: rgb(css("--unlit")), mark: colour("--mark"), edge: colour("--edge"), chosen: colour("--chosen") };
  }

  // Takes the cells of a snapshot, in the scene's order.
  update(cells, shows, chosen) {
    const { gl, looks, order, scene, theme } = this, words = new Uint32Array(looks.buffer);
    order.forEach((i, at) => {
      const cell = cells[i], value = shows.of(cell);
      const [r, g, b] = shows.rest(value) ? theme.unlit : ramp((value - shows.low) / (shows.high - shows.low));
      const kind = shapeOf(cell).shape | (i === chosen ? 16 : 0) | (cell.flags & 16 ? 32 : 0) | (scene.cells[i].root ? 64 : 0);
      words.fill((r | g << 8 | b << 16 | kind << 24) >>> 0, at * VERTICES, (at + 1) * VERTICES);
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, this.look);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, looks);
  }

  draw(view, frames) {
    const { gl, canvas, theme, solid, cell } = this;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const [w, h] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(...theme.back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(solid.program);
    gl.uniformMatrix4fv(solid.view, false, view);
    gl.uniform3fv(solid.colour, theme.robot);
    for (const { chain, row, vao, count } of this.parts) {
      gl.bindVertexArray(vao);
      gl.uniformMatrix4fv(solid.m, false, frames[chain][row]);
      gl.drawArrays(gl.TRIANGLES, 0, count);
    }
    gl.useProgram(cell.program);
    gl.bindVertexArray(this.cells);
    gl.uniformMatrix4fv(cell.view, false, view);
    gl.uniform3fv(cell.mark, theme.mark);
    gl.uniform3fv(cell.edge, theme.edge);
    gl.uniform3fv(cell.chosen, theme.chosen);
    for (const { chain, row, first, count } of this.groups) {
      gl.uniformMatrix4fv(cell.m, false, frames[chain][row]);
      gl.drawArrays(gl.TRIANGLES, first * VERTICES, count * VERTICES);
    }
  }
}
