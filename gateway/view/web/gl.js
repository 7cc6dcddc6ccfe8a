// Helpers for WebGL2: contexts, programs, buffers.

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

// A context, and true if the processor renders it. Edges are then not smoothed, which is the most expensive step in
// software.
export function context(canvas) {
  // Without transparency the browser does not have to blend the picture with the page.
  const plain = { alpha: false, antialias: false };
  let gl = canvas.getContext("webgl2", { ...plain, antialias: true, failIfMajorPerformanceCaveat: true });
  let software = !gl;
  gl ??= canvas.getContext("webgl2", plain);
  if (!gl) throw new Error("WebGL2 is not available");
  const name = gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER;
  software ||= SOFTWARE.test(gl.getParameter(name));
  return { gl, software };
}

// A program of a vertex and a fragment shader, with the locations of its uniforms; `defines` lists names for its
// `#ifdef`s.
export function program(gl, sources, ...defines) {
  const head = defines.map((name) => `#define ${name}\n`).join("");
  const it = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((type, at) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${head}${sources[at]}`);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(it, shader);
  });
  gl.linkProgram(it);
  if (!gl.getProgramParameter(it, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(it));
  const places = { program: it };
  for (let i = 0; i < gl.getProgramParameter(it, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(it, i);
    places[name] = gl.getUniformLocation(it, name);
  }
  return places;
}

// A buffer of floats for the bound vertex array; layout: [attribute, number of floats] in their order.
export function floats(gl, data, layout) {
  const stride = layout.reduce((sum, [, n]) => sum + n, 0) * 4;
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  let offset = 0;
  for (const [at, n] of layout) {
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, n, gl.FLOAT, false, stride, offset);
    offset += n * 4;
  }
}

// A buffer of the corners of triangles, as their indices, for the bound vertex array.
export function elements(gl, data) {
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, data, gl.STATIC_DRAW);
}

// The different corners among those of triangles, each a number of floats, and the index of each triangle's corners.
// A corner then need not be computed for each triangle.
export function shared(data, floats) {
  const known = new Map(), corners = [], all = new Uint32Array(data.length / floats);
  for (let k = 0; k < all.length; k++) {
    const corner = data.slice(k * floats, (k + 1) * floats), key = corner.join();
    if (!known.has(key)) {
      known.set(key, known.size);
      corners.push(...corner);
    }
    all[k] = known.get(key);
  }
  return { corners: new Float32Array(corners), indices: all };
}
