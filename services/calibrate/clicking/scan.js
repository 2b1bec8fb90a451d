const VERTEX = `#version 300 es
in vec3 place; uniform mat3 turn; uniform vec2 size; uniform vec2 shift; uniform float scale; uniform float depth;
out vec3 seen;
void main() {
  seen = turn * place;
  gl_Position = vec4((seen.xy * scale + shift) / size * 2.0, -seen.z / depth, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen; out vec4 colour;
void main() {
  vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
  float light = 0.25 + 0.75 * abs(dot(normal, normalize(vec3(-0.3, 0.5, 1.0))));
  colour = vec4(vec3(0.93, 0.89, 0.82) * light, 1.0);
}`;

/** A parallel projection of the scan: turn * (point - middle) has x to the right, y up and z towards the viewer. */
class ScanView {
  constructor(surface, canvas, { vertices, faces, turn }) {
    this.surface = surface;
    this.canvas = canvas;
    this.vertices = new Float32Array(bytes(vertices).buffer);
    this.faces = new Uint32Array(bytes(faces).buffer);
    const low = [Infinity, Infinity, Infinity];
    const high = low.map((value) => -value);
    this.vertices.forEach((value, k) => {
      low[k % 3] = Math.min(low[k % 3], value);
      high[k % 3] = Math.max(high[k % 3], value);
    });
    this.middle = low.map((value, axis) => (value + high[axis]) / 2);
    this.radius = Math.hypot(...high.map((value, axis) => value - low[axis])) / 2;
    this.vertices = this.vertices.map((value, k) => value - this.middle[k % 3]);
    /** Rows of the rotation. */
    this.turn = turn;
    this.shift = [0, 0];
    this.scale = null;
    this.gl = surface.getContext("webgl2", { antialias: true });
    if (this.gl) this.prepare();
    follow(canvas, {
      click: (place) => {
        const point = this.point(place);
        if (!point) tell("There is nothing of the scan under the click; turn it, or come nearer.");
        else
          clicked((one) => {
            one.xyz_mm = point;
          });
      },
      drag: (dx, dy, isMoved) => {
        if (isMoved) this.shift = [this.shift[0] + dx, this.shift[1] - dy];
        else this.rotate(dx, dy);
        this.draw();
      },
      zoom: (factor) => {
        this.scale *= factor;
        this.shift = this.shift.map((value) => value * factor);
        this.draw();
      },
    });
  }

  prepare() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [
      [gl.VERTEX_SHADER, VERTEX],
      [gl.FRAGMENT_SHADER, FRAGMENT],
    ]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, this.vertices, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.faces, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, "place");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    this.uniform = (name) => gl.getUniformLocation(program, name);
  }

  rotate(dx, dy) {
    if (dx === 0 && dy === 0) return;
    const angle = Math.hypot(dx, dy) / (0.6 * Math.min(this.canvas.width, this.canvas.height));
    const [x, y] = [dy, dx].map((value) => value / Math.hypot(dx, dy));
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    // Rotate about the axis (x, y, 0) by Rodrigues' formula.
    const about = [
      [c + x * x * (1 - c), x * y * (1 - c), y * s],
      [x * y * (1 - c), c + y * y * (1 - c), -x * s],
      [-y * s, x * s, c],
    ];
    this.turn = about.map((row) => [0, 1, 2].map((k) => row.reduce((sum, v, j) => sum + v * this.turn[j][k], 0)));
  }

  seen(x, y, z) {
    return this.turn.map((row) => row[0] * x + row[1] * y + row[2] * z);
  }

  /** The surface point nearest to the viewer at a canvas position, in mm in the scan; null where there is none. */
  point([left, top]) {
    const x = (left - this.canvas.width / 2 - this.shift[0]) / this.scale;
    const y = (this.canvas.height / 2 - top - this.shift[1]) / this.scale;
    const count = this.vertices.length / 3;
    const seen = new Float64Array(3 * count);
    for (let k = 0; k < count; k++) seen.set(this.seen(...this.vertices.subarray(3 * k, 3 * k + 3)), 3 * k);
    let nearest = -Infinity;
    for (let k = 0; k < this.faces.length; k += 3) {
      const [a, b, c] = [3 * this.faces[k], 3 * this.faces[k + 1], 3 * this.faces[k + 2]];
      const [ux, uy, vx, vy] = [
        seen[b] - seen[a],
        seen[b + 1] - seen[a + 1],
        seen[c] - seen[a],
        seen[c + 1] - seen[a + 1],
      ];
      const area = ux * vy - uy * vx;
      const s = ((x - seen[a]) * vy - (y - seen[a + 1]) * vx) / area;
      const t = (ux * (y - seen[a + 1]) - uy * (x - seen[a])) / area;
      if (!(s >= 0 && t >= 0 && s + t <= 1)) continue;
      nearest = Math.max(nearest, seen[a + 2] + s * (seen[b + 2] - seen[a + 2]) + t * (seen[c + 2] - seen[a + 2]));
    }
    if (nearest === -Infinity) return null;
    return this.middle.map((value, k) => value + this.turn[0][k] * x + this.turn[1][k] * y + this.turn[2][k] * nearest);
  }

  draw() {
    const [width, height] = fit(this.canvas);
    this.scale ??= Math.min(width, height) / (2.1 * this.radius);
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    if (this.gl) {
      const gl = this.gl;
      fit(this.surface);
      gl.viewport(0, 0, width, height);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix3fv(this.uniform("turn"), true, this.turn.flat());
      gl.uniform2f(this.uniform("size"), width, height);
      gl.uniform2f(this.uniform("shift"), ...this.shift);
      gl.uniform1f(this.uniform("scale"), this.scale);
      gl.uniform1f(this.uniform("depth"), 1.1 * this.radius);
      gl.drawElements(gl.TRIANGLES, this.faces.length, gl.UNSIGNED_INT, 0);
    } else {
      context.fillStyle = "#888";
      context.font = `${15 * devicePixelRatio}px system-ui, sans-serif`;
      context.fillText("This browser shows no WebGL 2; use another one, or let it use the graphics card.", 20, 40);
    }
    rings(context, (one) => {
      if (one.xyz_mm === null) return null;
      const [x, y] = this.seen(...one.xyz_mm.map((value, axis) => value - this.middle[axis]));
      return [width / 2 + this.shift[0] + this.scale * x, height / 2 - this.shift[1] - this.scale * y];
    });
  }
}
