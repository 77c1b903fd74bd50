// Strokes, surfaces and Gaussians in WebGL 2. Positions are in metres, z up; colours are r, g, b, a from 0 to 1.
"use strict";

const VERTEX = {
  // Triangles, a colour a vertex.
  surface: `
    in vec3 place; in vec4 colour; out vec4 tint;
    void main() { tint = colour; gl_Position = projection * view * vec4(place, 1.0); }`,
  // Lines with round ends, a width in pixels; of length 0 a disc.
  stroke: `
    in vec3 start, end; in vec4 colour; in float width;
    out vec4 tint; out vec2 at; out vec2 shape;
    void main() {
      vec4 p = projection * view * vec4(start, 1.0), q = projection * view * vec4(end, 1.0);
      const float near = 0.02;
      if (p.w < near && q.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
      if (p.w < near) p = mix(p, q, (near - p.w) / (q.w - p.w));
      if (q.w < near) q = mix(q, p, (near - q.w) / (p.w - q.w));
      vec2 s = 0.5 * size * p.xy / p.w, t = 0.5 * size * q.xy / q.w, along = t - s;
      float span = length(along), pad = 0.5 * width + 1.0;
      along = span > 0.0 ? along / span : vec2(1.0, 0.0);
      bool first = (gl_VertexID & 1) == 0;
      float side = (gl_VertexID & 2) == 0 ? -pad : pad;
      vec2 pixel = (first ? s - pad * along : t + pad * along) + side * vec2(-along.y, along.x);
      tint = colour; shape = vec2(span, 0.5 * width); at = vec2(first ? -pad : span + pad, side);
      gl_Position = vec4(2.0 * pixel / size, first ? p.z / p.w : q.z / q.w, 1.0);
    }`,
  // Gaussians by the upper triangle of their covariance, projected to first order; as ellipsoids
  // of one standard deviation with a pale rim.
  splat: `
    in vec3 place; in vec3 upper; in vec3 lower; in vec4 colour;
    out vec4 tint; out vec2 at; flat out vec3 conic;
    void main() {
      vec3 c = (view * vec4(place, 1.0)).xyz;
      float d = -c.z, f = 0.5 * size.y * projection[1][1];
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      if (d < 0.1) return;
      mat3 sigma = mat3(upper.x, upper.y, upper.z, upper.y, lower.x, lower.y, upper.z, lower.y, lower.z);
      mat3 turned = mat3(view) * sigma * transpose(mat3(view));
      vec3 jx = f * vec3(1.0 / d, 0.0, c.x / (d * d)), jy = f * vec3(0.0, 1.0 / d, c.y / (d * d));
      float xx = dot(jx, turned * jx) + 0.3, xy = dot(jx, turned * jy), yy = dot(jy, turned * jy) + 0.3;
      float area = xx * yy - xy * xy;
      if (area <= 0.0) return;
      conic = vec3(yy, -xy, xx) / area;
      at = 1.1 * vec2((gl_VertexID & 1) == 0 ? -sqrt(xx) : sqrt(xx), (gl_VertexID & 2) == 0 ? -sqrt(yy) : sqrt(yy));
      vec4 middle = projection * vec4(c, 1.0);
      tint = colour;
      gl_Position = vec4(middle.xy / middle.w + 2.0 * at / size, middle.z / middle.w, 1.0);
    }`,
};

const FRAGMENT = {
  surface: `in vec4 tint; void main() { shade = tint; }`,
  stroke: `
    in vec4 tint; in vec2 at; in vec2 shape;
    void main() {
      float away = length(vec2(at.x - clamp(at.x, 0.0, shape.x), at.y));
      shade = vec4(tint.rgb, tint.a * clamp(shape.y + 0.5 - away, 0.0, 1.0));
      if (shade.a < 0.02) discard;
    }`,
  splat: `
    in vec4 tint; in vec2 at; flat in vec3 conic;
    void main() {
      float square = conic.x * at.x * at.x + 2.0 * conic.y * at.x * at.y + conic.z * at.y * at.y;
      float radius = sqrt(square), inside = clamp(0.5 + (1.0 - radius) / fwidth(radius), 0.0, 1.0);
      float rim = clamp(1.5 - abs(1.0 - radius) / fwidth(radius), 0.0, 1.0);
      shade = vec4(mix(tint.rgb, vec3(1.0), 0.8 * rim), inside * tint.a * max(1.0 - 0.5 * square, 0.9 * rim));
      if (shade.a < 0.004) discard;
    }`,
};

const LAYOUT = {  // numbers of each attribute
  surface: {place: 3, colour: 4},
  stroke: {start: 3, end: 3, colour: 4, width: 1},
  splat: {place: 3, upper: 3, lower: 3, colour: 4},
};
const SIZE = {surface: 7, stroke: 11, splat: 13};

class Camera {
  constructor(low, high) {
    this.target = low.map((x, k) => (x + high[k]) / 2);
    this.distance = 1.3 * Math.hypot(...low.map((x, k) => high[k] - x));
    this.azimuth = -1.05; this.elevation = 0.62;
    this.span = this.distance;
  }
  get axes() {  // right, up, and back towards the eye
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap(x => [Math.cos(x), Math.sin(x)]);
    return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
  }
  get eye() { return this.target.map((x, k) => x + this.distance * this.axes[2][k]); }
  matrices(width, height) {  // column by column
    const axes = this.axes, eye = this.eye, near = 0.01 * this.span, far = 30 * this.span, f = 2.6;
    const view = [];
    for (let k = 0; k < 3; k++) view.push(axes[0][k], axes[1][k], axes[2][k], 0);
    view.push(...axes.map(axis => -axis.reduce((sum, x, k) => sum + x * eye[k], 0)), 1);
    const depth = [(near + far) / (near - far), 2 * near * far / (near - far)];
    return {view, projection: [f * height / width, 0, 0, 0, 0, f, 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0]};
  }
  project(place, width, height) {  // pixels from the upper left, and depth
    const axes = this.axes, eye = this.eye;
    const [x, y, z] = axes.map(axis => axis.reduce((sum, a, k) => sum + a * (place[k] - eye[k]), 0));
    const f = 1.3 * height;
    return [width / 2 - f * x / z, height / 2 + f * y / z, -z];
  }
  ray(x, y, width, height) {  // direction through a pixel
    const [right, up, back] = this.axes, f = 1.3 * height;
    return [0, 1, 2].map(k => right[k] * (x - width / 2) / f - up[k] * (y - height / 2) / f - back[k]);
  }
}

class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = this.gl = canvas.getContext("webgl2", {antialias: false});
    if (!gl) throw new Error("this browser has no WebGL 2; take a current one");
    this.programs = {}; this.layers = new Map();
    for (const kind in LAYOUT) {
      const program = gl.createProgram();
      const common = "#version 300 es\nprecision highp float;\n";
      const uniforms = "uniform mat4 view, projection; uniform vec2 size;";
      for (const [type, text] of [[gl.VERTEX_SHADER, common + uniforms + VERTEX[kind]],
                                  [gl.FRAGMENT_SHADER, common + "out vec4 shade;" + FRAGMENT[kind]]]) {
        const shader = gl.createShader(type);
        gl.shaderSource(shader, text); gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      this.programs[kind] = program;
    }
    gl.enable(gl.BLEND);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }
  // A layer is drawn in the order of its first set. `depth` is "write", "test" or "none".
  set(name, kind, numbers, depth) {
    const gl = this.gl;
    let layer = this.layers.get(name);
    if (!layer) {
      layer = {kind, depth, visible: true, buffer: gl.createBuffer(), array: gl.createVertexArray()};
      this.layers.set(name, layer);
      gl.bindVertexArray(layer.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, layer.buffer);
      let offset = 0;
      for (const [attribute, count] of Object.entries(LAYOUT[kind])) {
        const place = gl.getAttribLocation(this.programs[kind], attribute);
        gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, count, gl.FLOAT, false, 4 * SIZE[kind], offset);
        gl.vertexAttribDivisor(place, kind === "surface" ? 0 : 1);
        offset += 4 * count;
      }
    }
    layer.numbers = new Float32Array(numbers);
    layer.fresh = true;
  }
  draw(camera) {
    const gl = this.gl, ratio = window.devicePixelRatio || 1, canvas = this.canvas;
    const width = Math.round(ratio * canvas.clientWidth), height = Math.round(ratio * canvas.clientHeight);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(1, 1, 1, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const {view, projection} = camera.matrices(width, height);
    for (const layer of this.layers.values()) {
      if (!layer.visible || !layer.numbers.length) continue;
      const program = this.programs[layer.kind];
      gl.useProgram(program);
      gl.uniformMatrix4fv(gl.getUniformLocation(program, "view"), false, view);
      gl.uniformMatrix4fv(gl.getUniformLocation(program, "projection"), false, projection);
      gl.uniform2f(gl.getUniformLocation(program, "size"), width, height);
      gl.depthMask(layer.depth === "write");
      if (layer.depth === "none") gl.disable(gl.DEPTH_TEST); else gl.enable(gl.DEPTH_TEST);
      gl.bindVertexArray(layer.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, layer.buffer);
      if (layer.kind === "splat") gl.bufferData(gl.ARRAY_BUFFER, sorted(layer.numbers, camera), gl.DYNAMIC_DRAW);
      else if (layer.fresh) gl.bufferData(gl.ARRAY_BUFFER, layer.numbers, gl.DYNAMIC_DRAW);
      layer.fresh = false;
      const count = layer.numbers.length / SIZE[layer.kind];
      if (layer.kind === "surface") gl.drawArrays(gl.TRIANGLES, 0, count);
      else gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    }
    gl.bindVertexArray(null);
  }
}

function sorted(numbers, camera) {  // Gaussians, the farthest first
  const size = SIZE.splat, back = camera.axes[2], count = numbers.length / size;
  const depths = Array.from({length: count}, (_, k) =>
    back[0] * numbers[k * size] + back[1] * numbers[k * size + 1] + back[2] * numbers[k * size + 2]);
  const order = depths.map((_, k) => k).sort((a, b) => depths[a] - depths[b]);
  const result = new Float32Array(numbers.length);
  order.forEach((from, to) => result.set(numbers.subarray(from * size, (from + 1) * size), to * size));
  return result;
}
