// Draws the robot and its cells with WebGL2.

import { FLOATS as ARROW_FLOATS } from "./arrows.js";
import { colourOf, css, isDark, rgb, shapeOf } from "./colours.js";
import { context, elements, floats, program, shared } from "./gl.js";
import { ground } from "./ground.js";
import { atlas } from "./numbers.js";
import { cellOf } from "./snapshot.js";
import { add } from "./math.js";
import { axes, cylinders, neighbors, triangles } from "./robot.js";
import { CUT, FLOATS, MOVED, ribbons } from "./wires.js";

// Lighting is computed per vertex, not per pixel: for a software renderer, vertices are few and pixels are many.
const LIGHT = "float light(vec3 n) { return max(dot(normalize(n), normalize(vec3(.4, -.5, .77))), 0.); }";

// The share of ink of the cell's number at a point in its hexagon. The values of the pixels to the right and above tell
// the direction on the screen: numbers stand upright however the cell is turned. The numbers of small hexagons fade.
const NUMBERS = `#ifdef NUMBERS
uniform highp sampler2D numbers; uniform float legible;
float written(vec2 dx, vec2 dy) {
  float size = 1. / max(max(length(dx), length(dy)), 1e-6), turned = dx.x * dy.y - dx.y * dy.x;
  if (size < legible || abs(turned) < 1e-12) return 0.;
  vec2 far = vec2(place.x * dy.y - place.y * dy.x, dx.x * place.y - dx.y * place.x) / turned;
  // The texture of all numbers has letters 48 pixels high, in tiles of 128 by 64.
  float scale = min(size * (node > 99 ? .58 : .74), 2.4 * legible) / 48.;
  vec2 in_tile = vec2(far.x, -far.y) / (scale * vec2(128., 64.)) + .5;
  if (min(in_tile.x, in_tile.y) < 0. || max(in_tile.x, in_tile.y) > 1.) return 0.;
  vec2 tile = vec2(node % 16, node / 16);
  return textureLod(numbers, (tile + in_tile) / 16., max(0., -log2(scale) - .5)).r * smoothstep(legible, 1.1 * legible, size);
}
#endif`;

const SOLID = [`layout(location=0) in vec3 at; layout(location=1) in vec3 n; uniform mat4 view, m; uniform vec3 colour; out vec3 c;
${LIGHT}
void main() { c = colour * (.58 + .42 * light(mat3(m) * n)); gl_Position = view * (m * vec4(at, 1.)); }`,
`in vec3 c; out vec4 o;
void main() { o = vec4(c, 1.); }`];

// uv: the point in the hexagon, whose corners are at 1; kind: the shape, plus 16 if chosen, 32 if pressed, 64 if a
// root.
const CELL = [`layout(location=0) in vec3 at; layout(location=1) in vec3 n; layout(location=2) in vec2 uv; layout(location=3) in vec4 look; layout(location=4) in float number;
uniform mat4 view, m; uniform vec3 edge; out vec2 place; flat out vec3 inner, rim, ink; flat out int kind, node;
${LIGHT}
void main() {
  float l = .62 + .38 * light(mat3(m) * n);
  place = uv; inner = look.rgb * l; rim = edge * l; kind = int(look.w * 255. + .5); node = int(number + .5);
  ink = dot(look.rgb, vec3(.299, .587, .114)) > .38 ? vec3(.06, .08, .09) : vec3(1.);
  gl_Position = view * (m * vec4(at, 1.));
}`,
`in vec2 place; flat in vec3 inner, rim, ink; flat in int kind, node; uniform vec3 mark, chosen; out vec4 o;
${NUMBERS}
void main() {
#ifdef NUMBERS
  vec2 dx = dFdx(place), dy = dFdy(place);
#endif
  vec2 p = abs(place);
  float hex = max(p.x + p.y * .57735, p.y * 1.1547);
  if (hex > 1.001) discard;
  vec3 c = hex > .86 ? rim : inner;
  if (kind != 0) {
    int shape = kind & 15;
    float r = length(place);
    if (shape == 1 && min(abs(place.x - place.y), abs(place.x + place.y)) < .2 && r < .8) c = mark;
    if (shape == 2 && hex < .72) discard;
    if (shape == 3 && r < .4) discard;
    if (shape == 4 && place.x > 0. && hex < .86) c = mark;
    if (shape == 5 && p.y < .16 && p.x < .66) c = mark;
    if (shape == 7 && r < .34) c = mark;
    if (shape == 6 && max(p.x, p.y) < .26) c = mix(c, mark, .5);
    if ((kind & 64) != 0 && hex > .52 && hex < .62) c = ink;
    if ((kind & 48) != 0 && hex > .72) c = (kind & 32) != 0 && hex < .84 ? mark : chosen;
  }
#ifdef NUMBERS
  // The colours of buses are similar to that of the chosen cell.
  if ((kind & 16) != 0 && hex > .66 && hex < .76) c = ink;
  c = mix(c, ink, written(dx, dy));
#endif
  o = vec4(c, 1.);
}`];

// A ribbon. Wires that are cut are dashed. Ribbons are drawn a little nearer than the cells that they cross.
const WIRE = [`layout(location=0) in vec3 at; layout(location=1) in vec2 how; uniform mat4 view; out vec2 kind;
void main() { kind = how; gl_Position = view * vec4(at, 1.); gl_Position.z -= .0006 * gl_Position.w; }`,
`in vec2 kind; uniform vec3 mark, alarm; out vec4 o;
void main() {
  int it = int(kind.y + .5);
  if (it == ${CUT} && fract(kind.x * 3. + .25) > .5) discard;
  o = vec4(it == ${CUT} || it == ${MOVED} ? alarm : mark, 1.);
}`];

// Lines and arrows, whose corners have colours of their own.
const PLAIN = [`layout(location=0) in vec3 at; layout(location=1) in vec3 colour; uniform mat4 view; out vec3 c;
void main() { c = colour; gl_Position = view * vec4(at, 1.); }`,
`in vec3 c; out vec4 o;
void main() { o = vec4(c, 1.); }`];

// The form of a cell: its hexagon, or a triangle around it. A software renderer fills only the pixels of the hexagon.
const corner = (degrees, far) => [far * Math.cos(degrees * Math.PI / 180), far * Math.sin(degrees * Math.PI / 180)];
const HEXAGON = { corners: [0, 60, 120, 180, 240, 300].map((at) => corner(at, 1)), fan: [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 5] };
const TRIANGLE = { corners: [90, 210, 330].map((at) => corner(at, Math.sqrt(3))), fan: [0, 1, 2] };

// The minimum radius of a hexagon with a number, in pixels of the page.
const LEGIBLE = 12;

export class Picture {
  // With `numbers`, hexagons that are large enough show their cells' node ids.
  constructor(canvas, numbers = false) {
    Object.assign(this, { canvas, numbers, size: [canvas.clientWidth, canvas.clientHeight] }, context(canvas));
    // Reading the size in each frame would have the page laid out in each.
    new ResizeObserver(() => {
      this.size = [canvas.clientWidth, canvas.clientHeight];
      window.dispatchEvent(new Event("sized"));
    }).observe(canvas);
  }

  // Sets the scene, which does not change.
  set(scene) {
    const { gl } = this;
    [this.scene, this.before, this.laid] = [scene, null, null];
    this.solid = program(gl, SOLID);
    this.cell = program(gl, CELL, ...(this.numbers ? ["NUMBERS"] : []));
    this.wire = program(gl, WIRE);
    this.plain = program(gl, PLAIN);
    this.wires = [];
    this.ground = this.buffer([[0, 3, 0], [1, 3, 12]], 24);
    this.arrows = this.buffer([[0, 3, 0], [1, 3, 12]], 4 * ARROW_FLOATS);
    this.pointed = null;
    if (this.numbers) atlas(gl);
    this.ribbon = this.buffer([[0, 3, 0], [1, 2, 12]], FLOATS * 4);
    this.round = this.solids(cylinders(scene));
    this.shells = null;
    // Cells by frame: `order` has their indices in the scene.
    const order = scene.cells.map((_, i) => i);
    const key = (i) => { const c = scene.cells[i]; return scene.buses[c.bus].chain * 64 + c.row; };
    order.sort((i, j) => key(i) - key(j) || i - j);
    this.order = order;
    this.groups = [];
    order.forEach((i, at) => {
      const cell = scene.cells[i], chain = scene.buses[cell.bus].chain, last = this.groups[this.groups.length - 1];
      if (last && last.chain === chain && last.row === cell.row) last.count++;
      else this.groups.push({ chain, row: cell.row, first: at, count: 1, around: scene.tubes.some((tube) => tube.chain === chain && tube.row === cell.row) });
    });
    const nearest = neighbors(scene), { corners, fan } = this.software ? TRIANGLE : HEXAGON;
    [this.vertices, this.indices] = [corners.length, fan.length];
    const data = new Float32Array(order.length * corners.length * 9), size = scene.pitch * 0.56;
    const fans = new Uint32Array(order.length * fan.length);
    order.forEach((i, at) => {
      const { node, position, normal } = scene.cells[i], [x, y] = axes(scene, nearest, i);
      const middle = add(position, normal, 0.0012);
      corners.forEach(([u, v], k) => data.set([...add(add(middle, x, u * size), y, v * size), ...normal, u, v, node], (at * corners.length + k) * 9));
      fan.forEach((corner, k) => { fans[at * fan.length + k] = at * corners.length + corner; });
    });
    this.cells = gl.createVertexArray();
    gl.bindVertexArray(this.cells);
    floats(gl, data, [[0, 3], [1, 3], [2, 2], [4, 1]]);
    elements(gl, fans);
    this.looks = new Uint32Array(order.length * corners.length);
    this.look = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.look);
    gl.bufferData(gl.ARRAY_BUFFER, this.looks, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribPointer(3, 4, gl.UNSIGNED_BYTE, true, 0, 0);
    this.colours();
  }

  // A buffer of corners that change, with its attributes as [location, number of floats, offset].
  buffer(layout, stride) {
    const { gl } = this, it = { vao: gl.createVertexArray(), buffer: gl.createBuffer(), count: 0 };
    gl.bindVertexArray(it.vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, it.buffer);
    for (const [at, size, offset] of layout) {
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, stride, offset);
    }
    return it;
  }

  fill(it, corners, floats) {
    const { gl } = this;
    it.count = corners.length / floats;
    gl.bindBuffer(gl.ARRAY_BUFFER, it.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
    this.changed = true;
  }

  // Lays the ground at a height below a robot of this size.
  lay(size, height) {
    this.laid = [size, height];
    this.fill(this.ground, ground(size, height, this.theme.back, this.theme.grid), 6);
  }

  // Sets the arrows to draw.
  point(corners) {
    // Snapshots of a robot at rest repeat its arrows; a picture that changes never becomes sharp.
    const before = this.pointed;
    if (before?.length === corners.length && corners.every((v, i) => v === before[i])) return;
    this.pointed = corners;
    if (corners.length || this.arrows.count) this.fill(this.arrows, corners, ARROW_FLOATS);
  }

  // All cells of one frame are drawn at once.
  solids(all) {
    const { gl } = this, parts = new Map();
    for (const it of all) {
      const key = `${it.chain} ${it.row}`, part = parts.get(key) ?? { chain: it.chain, row: it.row, data: [] };
      part.data.push(...triangles(it));
      parts.set(key, part);
    }
    return [...parts.values()].map(({ chain, row, data }) => {
      const vao = gl.createVertexArray();
      gl.bindVertexArray(vao);
      const { corners, indices } = shared(data, 6);
      floats(gl, corners, [[0, 3], [1, 3]]);
      elements(gl, indices);
      return { chain, row, vao, first: 0, count: indices.length };
    });
  }

  // Sets the robot's surface, which is then drawn instead of cylinders.
  surface(corners) {
    const { gl } = this, vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    floats(gl, corners, [[0, 3], [1, 3]]);
    this.shells = this.scene.shells.map((shell) => ({ ...shell, vao }));
    this.changed = true;
  }

  // Sets the ribbons to draw.
  ribbons(wires) {
    if (JSON.stringify(wires) === JSON.stringify(this.wires)) return;
    [this.wires, this.changed] = [wires, true];
  }

  // Reads the colours again, after a change between light and dark.
  colours() {
    this.changed = true;
    const colour = (name) => rgb(css(name)).map((v) => v / 255);
    this.theme = { back: colour("--back"), robot: colour("--robot"), unlit: rgb(css("--unlit")), mark: colour("--mark"), edge: colour("--edge"), chosen: colour("--chosen"), alarm: colour("--alarm"), grid: colour("--grid"), torque: colour("--torque"), dark: isDark() };
    if (this.laid) this.lay(...this.laid);
  }

  // Sets the cells of a snapshot, in the scene's order. Unchanged cells are skipped.
  update(words, shows, chosen) {
    const { gl, looks, order, scene, theme, vertices } = this, before = this.before;
    const same = before && before.shows === shows && before.theme === theme && before.words.length === words.length;
    let [first, end] = [order.length, 0];
    order.forEach((i, at) => {
      const one = same && (i === chosen) === (i === before.chosen);
      if (one && words[2 * i] === before.words[2 * i] && words[2 * i + 1] === before.words[2 * i + 1]) return;
      const cell = cellOf(words, i), [r, g, b] = colourOf(shows, cell, scene.cells[i], theme.dark) ?? theme.unlit;
      const kind = shapeOf(cell).shape | (i === chosen ? 16 : 0) | (cell.flags & 16 ? 32 : 0) | (scene.cells[i].root ? 64 : 0);
      looks.fill((r | g << 8 | b << 16 | kind << 24) >>> 0, at * vertices, (at + 1) * vertices);
      [first, end] = [Math.min(first, at), at + 1];
    });
    this.before = { shows, theme, words, chosen };
    if (first >= end) return;
    this.changed = true;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.look);
    gl.bufferSubData(gl.ARRAY_BUFFER, first * vertices * 4, looks, first * vertices, (end - first) * vertices);
  }

  // Draws if anything has changed since the last time, or if a finer picture is due. Returns true if it drew.
  draw(view, frames, ratio) {
    const { gl, canvas, theme, solid, cell } = this;
    const [width, height] = this.size, seen = [width, height, ...view, ...frames.flat(2)];
    const same = !this.changed && this.seen?.length === seen.length && seen.every((v, i) => v === this.seen[i]);
    if (same && ratio <= this.ratio) return false;
    Object.assign(this, { seen, ratio, changed: false });
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(...theme.back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    // Cells first, so that anything below them is not drawn. The backs of cells around a link are not seen.
    gl.useProgram(cell.program);
    gl.bindVertexArray(this.cells);
    gl.uniformMatrix4fv(cell.view, false, view);
    gl.uniform3fv(cell.mark, theme.mark);
    gl.uniform3fv(cell.edge, theme.edge);
    gl.uniform3fv(cell.chosen, theme.chosen);
    if (this.numbers) gl.uniform1f(cell.legible, LEGIBLE * ratio);
    for (const { chain, row, first, count, around } of this.groups) {
      gl[around ? "enable" : "disable"](gl.CULL_FACE);
      gl.uniformMatrix4fv(cell.m, false, frames[chain][row]);
      gl.drawElements(gl.TRIANGLES, count * this.indices, gl.UNSIGNED_INT, first * this.indices * 4);
    }
    gl.disable(gl.CULL_FACE);
    if (this.wires.length) {
      const { wire, ribbon } = this, corners = ribbons(this.scene, frames, this.wires);
      gl.useProgram(wire.program);
      gl.bindVertexArray(ribbon.vao);
      gl.bindBuffer(gl.ARRAY_BUFFER, ribbon.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
      gl.uniformMatrix4fv(wire.view, false, view);
      gl.uniform3fv(wire.mark, theme.mark);
      gl.uniform3fv(wire.alarm, theme.alarm);
      gl.drawArrays(gl.TRIANGLES, 0, corners.length / FLOATS);
    }
    gl.useProgram(solid.program);
    gl.uniformMatrix4fv(solid.view, false, view);
    gl.uniform3fv(solid.colour, theme.robot);
    // The faces of other meshes may have either orientation.
    if (!this.shells) gl.enable(gl.CULL_FACE);
    for (const { chain, row, vao, first, count } of this.shells ?? this.round) {
      gl.bindVertexArray(vao);
      gl.uniformMatrix4fv(solid.m, false, frames[chain][row]);
      if (this.shells) gl.drawArrays(gl.TRIANGLES, first, count);
      else gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, first * 4);
    }
    gl.enable(gl.CULL_FACE);
    gl.useProgram(this.plain.program);
    gl.uniformMatrix4fv(this.plain.view, false, view);
    for (const [{ vao, count }, kind] of [[this.arrows, gl.TRIANGLES], [this.ground, gl.LINES]]) {
      if (!count) continue;
      gl.bindVertexArray(vao);
      gl.drawArrays(kind, 0, count);
    }
    gl.disable(gl.CULL_FACE);
    return true;
  }
}
