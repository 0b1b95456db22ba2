// A point cloud that turns under the mouse: WebGL 2, nothing else. Points come as the API tells them (12 bytes each).

const POINT_BYTES = 12;

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;      // tenths of a millimetre
layout(location = 1) in vec3 normal;     // 127ths
layout(location = 2) in float intensity; // 0 to 1
layout(location = 3) in float sigma;     // hundredths of a millimetre; 0: not known
uniform mat4 view;
uniform float size;
uniform int paint;                       // a place in PAINTS
out vec3 colour;
void main() {
  vec4 at = view * vec4(place * 1e-4, 1.0);
  gl_Position = at;
  gl_PointSize = clamp(size / at.w, 1.0, 6.0);
  // Lit from the upper left of the room, as bright as the cameras saw it.
  float light = 0.55 + 0.45 * max(0.0, dot(normalize(normal), normalize(vec3(0.5, -0.6, 0.7))));
  colour = mix(vec3(0.5, 0.7, 0.9), vec3(1.0, 0.97, 0.93), clamp(2.0 * sqrt(intensity), 0.0, 1.0)) * light;
  if (paint == 1) colour = 0.5 + 0.5 * normalize(normal);
  // From blue, none, over yellow to red, half a millimetre and more; grey where it is not known.
  float share = clamp(sigma / 50.0, 0.0, 1.0);
  vec3 warm = share < 0.5 ? mix(vec3(0.2, 0.4, 0.9), vec3(0.95, 0.9, 0.4), 2.0 * share) : mix(vec3(0.95, 0.9, 0.4), vec3(0.9, 0.2, 0.15), 2.0 * share - 1.0);
  if (paint == 2) colour = (sigma > 0.0 ? warm : vec3(0.5)) * light;
}`;

const PAINTS = ["intensity", "normals", "uncertainty"];

const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 colour;
out vec4 pixel;
void main() { pixel = vec4(colour, 1.0); }`;

/**
 * Draws clouds on a canvas; the mouse, a finger or the arrow keys turn it, the wheel, + and - move it.
 * `onPick` gets the point (metres) under a click, or null; `onDraw` is called after each picture.
 */
export class CloudView {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: false, powerPreference: "low-power", preserveDrawingBuffer: true });
    this.points = 0;
    this.azimuth = 0.6;
    this.height = 0.15;
    this.distance = 2.5;
    this.middle = [0, 0, 1];
    this.painted = 0;
    this.onPick = this.onDraw = () => {};
    if (this.gl) this.prepare();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  /** Whether this browser can draw clouds. */
  get works() {
    return Boolean(this.gl);
  }

  /** Shows these arrays of points, one a node, together; from where the last cloud was seen, if so wanted. */
  show(arrays, fromThere = false) {
    if (!this.gl) return 0;
    const length = arrays.reduce((sum, array) => sum + array.byteLength, 0);
    const bytes = new Uint8Array(length);
    let end = 0;
    for (const array of arrays) {
      bytes.set(new Uint8Array(array), end);
      end += array.byteLength;
    }
    this.points = Math.floor(length / POINT_BYTES);
    this.places = new DataView(bytes.buffer);
    if (!fromThere) this.middle = middleOf(this.places, this.points) ?? this.middle;
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
    this.draw();
    return this.points;
  }

  prepare() {
    const { gl } = this;
    const shader = (kind, text) => {
      const made = gl.createShader(kind);
      gl.shaderSource(made, text);
      gl.compileShader(made);
      return made;
    };
    const program = gl.createProgram();
    gl.attachShader(program, shader(gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, shader(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.uniforms = Object.fromEntries(["view", "size", "paint"].map((name) => [name, gl.getUniformLocation(program, name)]));
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    const attribute = (place, count, kind, normalized, offset) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, count, kind, normalized, POINT_BYTES, offset);
    };
    attribute(0, 3, gl.SHORT, false, 0);
    attribute(1, 3, gl.BYTE, false, 6);
    attribute(2, 1, gl.UNSIGNED_BYTE, true, 9);
    attribute(3, 1, gl.UNSIGNED_BYTE, false, 11);
    gl.enable(gl.DEPTH_TEST);
    // A hole in the body is lighter than the body's shadows, so that nobody takes it for dark cloth.
    gl.clearColor(0.2, 0.23, 0.27, 1);
  }

  draw() {
    const { gl, canvas } = this;
    if (!gl || this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const scale = Math.min(window.devicePixelRatio || 1, 2);
      canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
      canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix4fv(this.uniforms.view, false, this.matrix(canvas.width / canvas.height));
      gl.uniform1f(this.uniforms.size, canvas.height * 0.009);
      gl.uniform1i(this.uniforms.paint, this.painted);
      if (this.points) gl.drawArrays(gl.POINTS, 0, this.points);
      this.onDraw();
    });
  }

  /** World (metres, z up) to clip space, column by column. */
  matrix(aspect) {
    const [ca, sa, ch, sh] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.height), Math.sin(this.height)];
    const back = [ca * ch, sa * ch, sh];
    const right = [-sa, ca, 0];
    const up = [-ca * sh, -sa * sh, ch];
    const eye = back.map((x, i) => this.middle[i] + this.distance * x);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const [near, far, focal] = [0.05, 20, 1.9];
    const rows = [
      [...right.map((x) => (x * focal) / aspect), (-dot(right, eye) * focal) / aspect],
      [...up.map((x) => x * focal), -dot(up, eye) * focal],
      [0, 0, 0, 0],
      // The distance along the line of sight.
      [...back.map((x) => -x), dot(back, eye)],
    ];
    // Depth -1 at `near`, 1 at `far`, after division by that distance.
    rows[2] = rows[3].map((x) => (x * (far + near)) / (far - near));
    rows[2][3] -= (2 * far * near) / (far - near);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  /** Colours points by one of PAINTS. */
  paint(what) {
    this.painted = Math.max(0, PAINTS.indexOf(what));
    this.draw();
  }

  /** Where a point (metres) is seen, CSS pixels from the canvas's upper left corner; null behind the eye. */
  project(point) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const m = this.matrix(width / height);
    const row = (i) => m[i] * point[0] + m[4 + i] * point[1] + m[8 + i] * point[2] + m[12 + i];
    const away = row(3);
    return away > 0 ? [(width * (1 + row(0) / away)) / 2, (height * (1 - row(1) / away)) / 2] : null;
  }

  /** The nearest to the eye of the points within a few pixels of a place on the canvas, metres; null where there is none. */
  pointAt(x, y) {
    const reach = 6;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const m = this.matrix(width / height).map((value, i) => value * (i < 12 ? 1e-4 : 1));
    let [best, found] = [Infinity, null];
    for (let i = 0; i < this.points; i++) {
      const [a, b, c] = [0, 2, 4].map((byte) => this.places.getInt16(i * POINT_BYTES + byte, true));
      const away = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (away <= 0 || away >= best) continue;
      const u = (width * (1 + (m[0] * a + m[4] * b + m[8] * c + m[12]) / away)) / 2;
      const v = (height * (1 - (m[1] * a + m[5] * b + m[9] * c + m[13]) / away)) / 2;
      if (Math.hypot(u - x, v - y) > reach) continue;
      [best, found] = [away, [a, b, c].map((value) => value * 1e-4)];
    }
    return found;
  }

  turn(azimuth, height) {
    this.azimuth += azimuth;
    this.height = Math.min(1.5, Math.max(-1.5, this.height + height));
    this.draw();
  }

  /** Looks from a side: azimuth about the vertical from +x, and height above the horizon, rad. */
  look(azimuth, height) {
    Object.assign(this, { azimuth, height });
    this.draw();
  }

  zoom(factor) {
    this.distance = Math.min(12, Math.max(0.4, this.distance * factor));
    this.draw();
  }

  listen() {
    const { canvas } = this;
    let moved = 0;
    canvas.addEventListener("pointerdown", (event) => {
      moved = 0;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointerup", (event) => {
      if (moved < 4) this.onPick(this.points ? this.pointAt(event.offsetX, event.offsetY) : null);
    });
    canvas.addEventListener("pointermove", (event) => {
      moved += Math.abs(event.movementX) + Math.abs(event.movementY);
      if (event.buttons & 1) this.turn(-event.movementX * 0.008, event.movementY * 0.008);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY > 0 ? 1.1 : 1 / 1.1);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (!this.key(event.key)) return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  /** Does what a key stands for; false: it stands for nothing. */
  key(name) {
    const act = KEYS[name];
    act?.(this);
    return Boolean(act);
  }
}

const KEYS = {
  ArrowLeft: (view) => view.turn(0.1, 0), ArrowRight: (view) => view.turn(-0.1, 0),
  ArrowUp: (view) => view.turn(0, 0.1), ArrowDown: (view) => view.turn(0, -0.1),
  "+": (view) => view.zoom(1 / 1.15), "-": (view) => view.zoom(1.15),
};

/** The middle of the points in metres; null without any. */
function middleOf(view, points) {
  if (!points) return null;
  const sum = [0, 0, 0];
  for (let i = 0; i < points; i++) {
    for (let axis = 0; axis < 3; axis++) sum[axis] += view.getInt16(i * POINT_BYTES + 2 * axis, true);
  }
  return sum.map((x) => (x / points) * 1e-4);
}
