// Boxes in 3D by WebGL 2: one unit cube, drawn once for each box. Drag turns the view, right drag moves it, the wheel zooms.
const VERTEX = `#version 300 es
layout(location=0) in vec3 corner; layout(location=1) in vec3 middle; layout(location=2) in vec3 a; layout(location=3) in vec3 b; layout(location=4) in vec3 c;
uniform mat4 view; uniform vec3 eye; out vec3 place; out vec3 offset;
void main() {
  vec3 world = middle + a * corner.x + b * corner.y + c * corner.z;
  place = corner;
  offset = world - eye;
  gl_Position = view * vec4(world, 1.0);
}`;
// The face's normal and its edges come from how places change from pixel to pixel: a cube has eight corners then, not 36.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 place; in vec3 offset; uniform vec4 color; uniform float edges; out vec4 shown;
void main() {
  vec3 facing = normalize(cross(dFdx(offset), dFdy(offset)));
  float light = 0.62 + 0.38 * clamp(dot(facing, normalize(vec3(0.35, -0.5, 0.9))), -0.4, 1.0);
  vec3 rim = (1.0 - abs(place)) / max(fwidth(place), 1e-6);  // pixels to the faces: the least is to the own one
  float second = max(min(rim.x, rim.y), min(max(rim.x, rim.y), rim.z));
  float edge = edges * (1.0 - smoothstep(0.4, 1.4, second)) * clamp(160.0 / length(offset), 0.0, 1.0);
  shown = vec4(color.rgb * light * (1.0 - 0.45 * edge), mix(color.a, min(1.0, color.a + 0.3), edge));
  shown.rgb *= shown.a;
}`;
const WIDTH = 12, STILL_MS = 250, SLOW_MS = 70, FAST_MS = 30;
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
class BoxSpace {
  // rows: 12 numbers a box, its middle and three half axes, m; kinds: [{first, count, color, opacity, shown}]; after: called when a picture is done.
  constructor(canvas, rows, kinds, bounds, after) {
    Object.assign(this, { canvas, kinds, bounds, after, yaw: -2.0, pitch: 0.75, frames: 0, size: [1, 1], share: 1, last: 0 });
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true, premultipliedAlpha: true, alpha: true });
    if (gl) this.prepare(gl, rows);
    this.fit();
    this.listen();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }
  prepare(gl, rows) {
    const program = this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.uniforms = Object.fromEntries(["view", "eye", "color", "edges"].map((name) => [name, gl.getUniformLocation(program, name)]));
    const corners = [], faces = [];
    for (const z of [-1, 1]) for (const y of [-1, 1]) for (const x of [-1, 1]) corners.push(x, y, z);
    for (const [one, two, three, four] of [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]) faces.push(one, two, three, one, three, four);
    const fillBuffer = (data) => { const buffer = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW); return buffer; };
    fillBuffer(new Float32Array(corners));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint8Array(faces), gl.STATIC_DRAW);
    this.boxes = fillBuffer(rows);
    for (const place of [1, 2, 3, 4]) { gl.enableVertexAttribArray(place); gl.vertexAttribDivisor(place, 1); }
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.CULL_FACE);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }
  fit() {
    const [low, high] = this.bounds;
    this.target = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, Math.max(0, low[2])];
    this.away = 0.85 * Math.hypot(high[0] - low[0], high[1] - low[1]) + 20;
    this.redraw();
  }
  look(target, away = this.away, moves = false) { Object.assign(this, { target, away }); this.redraw(moves); }
  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.away = Math.min(20000, Math.max(3, this.away * Math.exp(event.deltaY / 600))); this.redraw(true); }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      let last = [event.clientX, event.clientY];
      const moves = event.button !== 0 || event.shiftKey;
      const move = (now) => {
        const [dx, dy] = [now.clientX - last[0], now.clientY - last[1]];
        last = [now.clientX, now.clientY];
        if (moves) {
          const scale = this.away / this.size[1], [cos, sin] = [Math.cos(this.yaw), Math.sin(this.yaw)];
          this.target = [this.target[0] + (sin * dx - cos * dy) * scale * -1, this.target[1] + (-cos * dx - sin * dy) * scale * -1, this.target[2]];
        } else {
          this.yaw -= dx / 200;
          this.pitch = Math.min(1.56, Math.max(0.02, this.pitch + dy / 200));
        }
        this.redraw(true);
      };
      canvas.addEventListener("pointermove", move);
      canvas.addEventListener("pointerup", () => canvas.removeEventListener("pointermove", move), { once: true });
    });
  }
  resize() {
    const box = this.canvas.getBoundingClientRect(), dense = window.devicePixelRatio || 1;
    this.size = [Math.max(1, box.width), Math.max(1, box.height)];
    this.canvas.width = Math.round(this.size[0] * dense);
    this.canvas.height = Math.round(this.size[1] * dense);
    this.redraw();
  }
  matrix() {  // world to clip, by columns
    const [cp, sp] = [Math.cos(this.pitch), Math.sin(this.pitch)], back = [-Math.cos(this.yaw) * cp, -Math.sin(this.yaw) * cp, sp];
    const eye = this.eye = this.target.map((value, k) => value + back[k] * this.away), right = [Math.sin(this.yaw), -Math.cos(this.yaw), 0], up = cross(back, right);
    const f = 1 / Math.tan(0.45), near = Math.max(0.5, this.away / 200), far = this.away * 4 + 4000, p = (far + near) / (near - far), q = (2 * far * near) / (near - far), aspect = this.size[0] / this.size[1];
    const rows = [right.map((value) => (value * f) / aspect), up.map((value) => value * f), back];
    const [x, y, z] = [-dot3(rows[0], eye), -dot3(rows[1], eye), -dot3(back, eye)];
    const columns = [0, 1, 2].flatMap((k) => [rows[0][k], rows[1][k], p * back[k], -back[k]]);
    return [...columns, x, y, p * z + q, -z];
  }
  at(place) {  // pixels of a world place; null behind the eye
    const m = this.view, [x, y, , w] = [0, 1, 2, 3].map((k) => m[k] * place[0] + m[4 + k] * place[1] + m[8 + k] * place[2] + m[12 + k]);
    return w > 0.1 ? [((x / w + 1) / 2) * this.size[0], ((1 - y / w) / 2) * this.size[1]] : null;
  }
  redraw(moves = false) {  // moves: a machine that is too slow draws fewer boxes then, and all of them when the view rests
    this.moves = moves;
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame((now) => {
      this.waits = false;
      this.frames += 1;
      const since = now - this.last;
      if (this.moves && this.last) this.share = Math.max(1 / 64, Math.min(1, this.share * (since > SLOW_MS ? 0.5 : since < FAST_MS ? 1.2 : 1)));
      this.last = this.moves ? now : 0;
      clearTimeout(this.rest);
      if (this.moves && this.share < 1) this.rest = setTimeout(() => this.redraw(), STILL_MS);
      this.view = this.matrix();
      if (this.gl) this.paint(this.gl);
      this.after();
    });
  }
  paint(gl) {
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.depthMask(true);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.uniforms.view, false, this.view);
    gl.uniform3fv(this.uniforms.eye, this.eye);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.boxes);
    for (const isSolid of [true, false]) {  // what one sees through comes last and hides nothing
      gl.depthMask(isSolid);
      if (isSolid) gl.disable(gl.BLEND); else gl.enable(gl.BLEND);
      for (const kind of this.kinds) {
        if (!kind.shown || kind.opacity >= 0.99 !== isSolid) continue;
        gl.uniform4f(this.uniforms.color, ...kind.color.map((value) => value / 255), kind.opacity);
        gl.uniform1f(this.uniforms.edges, kind.count < 20000 ? 1 : 0);
        for (const place of [1, 2, 3, 4]) gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 4 * WIDTH, 4 * (WIDTH * kind.first + 3 * (place - 1)));
        gl.drawElementsInstanced(gl.TRIANGLES, 36, gl.UNSIGNED_BYTE, 0, Math.min(kind.count, Math.max(500, Math.round(kind.count * (this.moves ? this.share : 1)))));
      }
    }
  }
}
