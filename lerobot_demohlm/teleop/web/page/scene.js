// Scene description and body poses -> pictures, on the page and in a headset, with plain WebGL 2.

const VERTEX = `#version 300 es
in vec3 position; in vec3 normal;
uniform mat4 model, view, projection;
out vec3 vNormal, vWorld;
void main() {
  vec4 world = model * vec4(position, 1.0);
  vWorld = world.xyz; vNormal = mat3(model) * normal;
  gl_Position = projection * view * world;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 vNormal, vWorld;
uniform vec4 color; uniform vec3 eye; uniform int checker;
out vec4 outColor;
void main() {
  vec3 base = color.rgb;
  vec3 n = normalize(vNormal);
  if (checker == 1) {
    vec2 square = floor(vWorld.xy * 2.0);
    base = mix(vec3(0.60, 0.62, 0.64), vec3(0.54, 0.56, 0.58), mod(square.x + square.y, 2.0));
  } else if (dot(n, eye - vWorld) < 0.0) n = -n;
  vec3 light = normalize(vec3(0.5, -0.7, 1.3));
  float lit = 0.42 + 0.45 * max(dot(n, light), 0.0) + 0.18 * max(dot(n, normalize(eye - vWorld)), 0.0);
  vec3 shown = base * lit;
  if (checker == 1) shown = mix(shown, vec3(0.86, 0.90, 0.94), clamp(length(vWorld.xy) / 9.0 - 0.2, 0.0, 1.0));
  outColor = vec4(shown, color.a);
}`;
const TEXT_VERTEX = `#version 300 es
in vec3 position; in vec2 at; uniform mat4 view, projection; out vec2 vAt;
void main() { vAt = at; gl_Position = projection * view * vec4(position, 1.0); }`;
const TEXT_FRAGMENT = `#version 300 es
precision mediump float; in vec2 vAt; uniform sampler2D words; out vec4 outColor;
void main() { outColor = texture(words, vAt); }`;

// Matrices are column-major arrays of 16, as WebGL has them.
export function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[k * 4 + r] * b[c * 4 + k];
    out[c * 4 + r] = sum;
  }
  return out;
}

export function poseMatrix(p, at = 0) {  // x y z qw qx qy qz -> matrix
  const [x, y, z, w, i, j, k] = [0, 1, 2, 3, 4, 5, 6].map((n) => p[at + n]);
  return new Float32Array([
    1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j), 0,
    2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i), 0,
    2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j), 0, x, y, z, 1]);
}

export function rigidInverse(m) {
  const out = new Float32Array(16);
  for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) out[c * 4 + r] = m[r * 4 + c];
  for (let r = 0; r < 3; r++) out[12 + r] = -(m[r * 4] * m[12] + m[r * 4 + 1] * m[13] + m[r * 4 + 2] * m[14]);
  out[15] = 1;
  return out;
}

export function yawOf(p) {  // heading of x y z qw qx qy qz
  return Math.atan2(2 * (p[3] * p[6] + p[4] * p[5]), 1 - 2 * (p[5] * p[5] + p[6] * p[6]));
}

// WebXR has x right, y up, z back; the world has x forward, y left, z up.
const ROOM_FROM_ROBOT = new Float32Array([0, 0, -1, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]);

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.bindAttribLocation(made, 0, "position");
  gl.linkProgram(made);
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

function drawnInSoftware() {  // there a triangle costs a thousand times as much
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const found = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : gl ? gl.getParameter(gl.RENDERER) : "";
  if (gl && gl.getExtension("WEBGL_lose_context")) gl.getExtension("WEBGL_lose_context").loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(found);
}

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.coarse = drawnInSoftware();  // coarse meshes, smaller pictures, hard edges
    this.gl = canvas.getContext("webgl2", { antialias: !this.coarse, alpha: false, xrCompatible: true });
    if (!this.gl) throw new Error("this browser has no WebGL 2");
    const gl = this.gl;
    this.shader = program(gl, VERTEX, FRAGMENT);
    this.textShader = program(gl, TEXT_VERTEX, TEXT_FRAGMENT);
    this.bodies = null;  // Float32Array of 7 a body, then the palms' two targets
    this.engaged = [false, false];
    this.colors = {};
    this.orbit = { yaw: -2.3, pitch: 0.35, distance: 2.9, target: [0.1, 0, 0.75] };
    this.words = [];
    this.home = null;  // where the operator of a headset stands: x, y, yaw in the world
  }

  async load() {
    const [description, buffers] = await Promise.all(
      [fetch("scene.json").then((r) => r.json()), fetch("scene.bin").then((r) => r.arrayBuffer())]);
    this.description = description;
    const gl = this.gl, split = description.vertices * 24;
    const marker = octahedron();
    const vertices = new Float32Array(description.vertices * 6 + marker.vertices.length + 24);
    vertices.set(new Float32Array(buffers, 0, description.vertices * 6));
    vertices.set(marker.vertices, description.vertices * 6);
    vertices.set([-12, -12, 0, 0, 0, 1, 12, -12, 0, 0, 0, 1, 12, 12, 0, 0, 0, 1, -12, 12, 0, 0, 0, 1],
      description.vertices * 6 + marker.vertices.length);
    const floor = description.vertices + marker.vertices.length / 6;
    const indices = new Uint32Array(description.indices + marker.indices.length + 6);
    indices.set(new Uint32Array(buffers, split, description.indices));
    indices.set(marker.indices.map((i) => i + description.vertices), description.indices);
    indices.set([0, 1, 2, 0, 2, 3].map((i) => i + floor), description.indices + marker.indices.length);
    this.marker = { first: description.indices, count: marker.indices.length };
    this.floor = { first: this.marker.first + this.marker.count, count: 6 };
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    const normal = gl.getAttribLocation(this.shader.made, "normal");
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 24, 0);
    gl.enableVertexAttribArray(normal);
    gl.vertexAttribPointer(normal, 3, gl.FLOAT, false, 24, 12);
    this.makePanel();
  }

  makePanel() {
    const gl = this.gl;
    this.panelCanvas = Object.assign(document.createElement("canvas"), { width: 1024, height: 256 });
    this.panelTexture = gl.createTexture();
    this.panel = gl.createVertexArray();
    gl.bindVertexArray(this.panel);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const x = 0.6, y = 0.15;
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(
      [-x, -y, 0, 0, 1, x, -y, 0, 1, 1, x, y, 0, 1, 0, -x, -y, 0, 0, 1, x, y, 0, 1, 0, -x, y, 0, 0, 0]), gl.STATIC_DRAW);
    const at = gl.getAttribLocation(this.textShader.made, "at");
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 2, gl.FLOAT, false, 20, 12);
    gl.bindVertexArray(null);
  }

  say(lines) {  // on the panel in the headset
    const text = lines.join("\n");
    if (text === this.said || !this.panelCanvas) return;
    this.said = text;
    const gl = this.gl, pen = this.panelCanvas.getContext("2d"), font = "36px system-ui, sans-serif";
    pen.fillStyle = "#20242ce6";
    pen.fillRect(0, 0, 1024, 256);
    pen.fillStyle = "#ffffff";
    pen.font = font;
    lines.flatMap((line) => wrapped(pen, line, 976)).slice(0, 5).forEach((line, i) => {
      pen.font = i === 0 ? `bold ${font}` : font;
      pen.fillText(line, 24, 46 + 47 * i, 976);
    });
    gl.bindTexture(gl.TEXTURE_2D, this.panelTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.panelCanvas);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  eye() {
    const { yaw, pitch, distance, target } = this.orbit;
    return [target[0] + distance * Math.cos(pitch) * Math.cos(yaw), target[1] + distance * Math.cos(pitch) * Math.sin(yaw),
      target[2] + distance * Math.sin(pitch)];
  }

  drawPage() {
    const gl = this.gl, { canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.86, 0.90, 0.94, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = this.eye(), { target } = this.orbit;
    const back = normalized([0, 1, 2].map((i) => eye[i] - target[i]));
    const right = normalized([-back[1], back[0], 0]);
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]];
    const view = new Float32Array([right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1]);
    const f = 1 / Math.tan(0.4), near = 0.05, far = 40;
    const [fx, fy] = width > height ? [f * height / width, f] : [f, f * width / height];
    const projection = new Float32Array([fx, 0, 0, 0, 0, fy, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
    this.draw(view, projection, eye);
  }

  drawXR(session, frame, space, shows) {
    const gl = this.gl, layer = session.renderState.baseLayer, pose = frame.getViewerPose(space);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.clearColor(0.86, 0.90, 0.94, shows ? 1 : 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!pose || !this.home) return;
    const room = multiply(ROOM_FROM_ROBOT, rigidInverse(this.homeMatrix()));
    for (const one of pose.views) {
      const port = layer.getViewport(one);
      gl.viewport(port.x, port.y, port.width, port.height);
      const view = multiply(one.transform.inverse.matrix, room);
      const eye = rigidInverse(view).slice(12, 15);
      this.draw(view, one.projectionMatrix, eye, shows);
      this.drawPanel(one.transform.inverse.matrix, one.projectionMatrix);
    }
  }

  homeMatrix() {
    const [x, y, yaw] = this.home;
    return poseMatrix([x, y, 0, Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)]);
  }

  drawPanel(view, projection) {
    const gl = this.gl, place = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 1.95, -1.6, 1]);
    gl.useProgram(this.textShader.made);
    gl.bindVertexArray(this.panel);
    gl.bindTexture(gl.TEXTURE_2D, this.panelTexture);
    gl.uniformMatrix4fv(this.textShader.uniforms.view, false, multiply(view, place));
    gl.uniformMatrix4fv(this.textShader.uniforms.projection, false, projection);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 6);
    gl.disable(gl.BLEND);
  }

  draw(view, projection, eye, floor = true) {
    if (!this.bodies || !this.array) return;
    const gl = this.gl, { uniforms } = this.shader, { geoms, head } = this.description;
    gl.useProgram(this.shader.made);
    gl.bindVertexArray(this.array);
    gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(uniforms.view, false, view);
    gl.uniformMatrix4fv(uniforms.projection, false, projection);
    gl.uniform3fv(uniforms.eye, eye);
    const paint = (part, matrix, rgba, checker = 0) => {
      gl.uniformMatrix4fv(uniforms.model, false, matrix);
      gl.uniform4fv(uniforms.color, rgba);
      gl.uniform1i(uniforms.checker, checker);
      gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, part.first * 4);
    };
    const identity = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    if (floor) paint(this.floor, identity, [1, 1, 1, 1], 1);
    const matrices = this.description.bodies.map((_, i) => poseMatrix(this.bodies, 7 * i));
    const hidden = new Set(head.filter((i) => Math.hypot(...[0, 1, 2].map((k) => this.bodies[7 * i + k] - eye[k])) < 0.4));
    const glassy = [];
    geoms.forEach((geom, i) => {
      const rgba = this.colors[i] || geom.rgba;
      if (rgba[3] === 0 || hidden.has(geom.body)) return;
      const part = this.coarse && geom.coarse ? geom.coarse : geom;
      if (rgba[3] < 1) glassy.push([part, matrices[geom.body], rgba]);
      else paint(part, matrices[geom.body], rgba);
    });
    for (const side of [0, 1]) {
      const matrix = poseMatrix(this.bodies, 7 * (this.description.bodies.length + side));
      paint(this.marker, matrix, this.engaged[side] ? [0.18, 0.75, 0.35, 1] : [0.25, 0.45, 0.75, 1]);
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    for (const [part, matrix, rgba] of glassy) paint(part, matrix, rgba);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }
}

function wrapped(pen, text, width) {  // lines that are no wider
  const lines = [];
  for (const word of text.split(" ")) {
    const longer = lines.length ? `${lines[lines.length - 1]} ${word}` : word;
    if (lines.length && pen.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}

function octahedron(size = 0.018) {
  const vertices = [], indices = [];
  for (const x of [1, -1]) for (const y of [1, -1]) for (const z of [1, -1]) {
    const first = vertices.length / 6, n = [x, y, z].map((v) => v / Math.sqrt(3));
    for (const corner of [[x, 0, 0], [0, y, 0], [0, 0, z]]) vertices.push(...corner.map((v) => v * size), ...n);
    indices.push(first, first + 1, first + 2);
  }
  return { vertices, indices };
}

function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function normalized(a) { const n = Math.hypot(...a); return a.map((v) => v / n); }
