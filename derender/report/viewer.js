// A scene to turn with the mouse: solids as triangles, the observed points, outlines of draws. WebGL 2, nothing else.
// Drag turns, wheel or pinch zooms, shift-drag or right-drag moves, double click goes back to the camera's view.
"use strict";
function showScene(canvas, scene, switches) {
  const gl = canvas.getContext("webgl2", {antialias: true, preserveDrawingBuffer: true});
  if (!gl) return false;
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const floats = text => new Float32Array(bytes(text).buffer);
  const integers = text => new Uint32Array(bytes(text).buffer);

  const vertexSource = `#version 300 es
    uniform mat4 view, projection; uniform float pointSize;
    in vec3 position; in vec3 colour; out vec3 seen; out vec3 tint;
    void main() { vec4 p = view * vec4(position, 1.0); seen = p.xyz; tint = colour;
                  gl_Position = projection * p; gl_PointSize = pointSize; }`;
  const fragmentSource = `#version 300 es
    precision highp float; uniform float lit, alpha; in vec3 seen; in vec3 tint; out vec4 result;
    void main() { float light = 1.0;
      if (lit > 0.5) { vec3 n = normalize(cross(dFdx(seen), dFdy(seen)));
        light = 0.55 + 0.42 * max(dot(n, normalize(vec3(-0.4, 0.8, 0.5))), 0.0) + 0.25 * max(dot(n, normalize(vec3(0.6, 0.1, 0.8))), 0.0); }
      result = vec4(tint * light, alpha); }`;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false;
  gl.useProgram(program);
  const place = name => gl.getUniformLocation(program, name);
  const where = {view: place("view"), projection: place("projection"), pointSize: place("pointSize"), lit: place("lit"), alpha: place("alpha")};
  const slots = {position: gl.getAttribLocation(program, "position"), colour: gl.getAttribLocation(program, "colour")};

  function upload(positions, colour, colours, triangles) {
    const array = gl.createVertexArray(); gl.bindVertexArray(array);
    const attach = (slot, data, size, kind, normalised) => {
      const buffer = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(slot); gl.vertexAttribPointer(slot, size, kind, normalised, 0, 0);
    };
    attach(slots.position, positions, 3, gl.FLOAT, false);
    if (colours) attach(slots.colour, colours, 3, gl.UNSIGNED_BYTE, true);
    if (triangles) { const buffer = gl.createBuffer(); gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer); gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW); }
    return {array, colour, coloured: !!colours, count: triangles ? triangles.length : positions.length / 3};
  }
  const solids = scene.solids.map(s => Object.assign(upload(floats(s.vertices), s.colour, null, integers(s.triangles)), {name: s.name}));
  const points = scene.points ? upload(floats(scene.points.positions), null, bytes(scene.points.colours), null) : null;
  const ghosts = scene.ghosts ? upload(floats(scene.ghosts.positions), null, bytes(scene.ghosts.colours), null) : null;

  const forces = scene.forces ? upload(floats(scene.forces.positions), null, bytes(scene.forces.colours), null) : null;

  const add = (a, b, s) => a.map((x, i) => x + s * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = a => { const l = Math.hypot(...a) || 1; return a.map(x => x / l); };
  const up = unit(scene.up);
  // Two level axes; the first points from the target to the camera, so that azimuth 0 is the camera's own. The image's
  // downward axis points there too, and does so still where the camera looks straight down.
  const toCamera = add([0, 0, 0], scene.target, -1);
  let level = add(unit(toCamera), [0, 1, 0], 1);
  level = add(level, up, -dot(level, up));
  level = unit(Math.hypot(...level) > 1e-6 ? level : cross(up, [1, 0, 0]));
  const side = cross(up, level);
  const home = {azimuth: 0, elevation: Math.asin(Math.max(-1, Math.min(1, dot(unit(toCamera), up)))), distance: Math.hypot(...toCamera), target: scene.target};
  let state = {...home};

  // The page's own background, light or dark.
  const paper = () => getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).slice(0, 3).map(c => c / 255);
  let chosen = null;
  const tint = solid => chosen && solid.name && solid.name !== chosen ? solid.colour.map(c => 0.3 * c + 110) : solid.colour;

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth * ratio, height = canvas.clientHeight * ratio;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...paper(), 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const {azimuth: a, elevation: e, distance: d} = state;
    let back = add(add(up.map(x => x * Math.sin(e)), level, Math.cos(e) * Math.cos(a)), side, Math.cos(e) * Math.sin(a));
    const right = unit(cross(up, back)), top = cross(back, right), eye = add(state.target, back, d);
    state.right = right; state.top = top;
    const view = [right[0], top[0], back[0], 0, right[1], top[1], back[1], 0, right[2], top[2], back[2], 0, -dot(right, eye), -dot(top, eye), -dot(back, eye), 1];
    const f = 1 / Math.tan(0.5 * scene.fov), near = d * 0.02, far = d * 30 + 10;
    const projection = [f * height / width, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
    gl.uniformMatrix4fv(where.view, false, view); gl.uniformMatrix4fv(where.projection, false, projection);
    const paint = (item, mode, indexed) => {
      gl.bindVertexArray(item.array);
      if (!item.coloured) { gl.disableVertexAttribArray(slots.colour); gl.vertexAttrib3f(slots.colour, ...tint(item).map(c => c / 255)); }
      if (indexed) gl.drawElements(mode, item.count, gl.UNSIGNED_INT, 0); else gl.drawArrays(mode, 0, item.count);
    };
    gl.uniform1f(where.pointSize, 2 * ratio); gl.uniform1f(where.lit, 0); gl.uniform1f(where.alpha, 1);
    if (points && switches.points.checked) paint(points, gl.POINTS, false);
    gl.uniform1f(where.alpha, 0.6);
    if (ghosts && switches.ghosts.checked) paint(ghosts, gl.LINES, false);
    gl.uniform1f(where.lit, 1); gl.uniform1f(where.alpha, 1);
    if (switches.solids.checked) for (const solid of solids) paint(solid, gl.TRIANGLES, true);
    // forces act between solids: they are seen through them
    gl.disable(gl.DEPTH_TEST); gl.uniform1f(where.alpha, 0.8);
    if (forces && switches.forces.checked) paint(forces, gl.TRIANGLES, false);
  }
  let queued = false;
  const redraw = () => { if (!queued) { queued = true; requestAnimationFrame(() => { queued = false; draw(); }); } };

  const fingers = new Map();
  canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const x = event.clientX - before[0], y = event.clientY - before[1];
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const spread = (p, q) => Math.hypot(p[0] - q[0], p[1] - q[1]) || 1;
      state.distance *= spread(before, other) / spread([event.clientX, event.clientY], other);
    } else if (event.shiftKey || event.buttons === 2) {
      const scale = state.distance * 2 * Math.tan(0.5 * scene.fov) / canvas.clientHeight;
      state.target = add(add(state.target, state.right, -x * scale), state.top, y * scale);
    } else {
      state.azimuth -= x * 0.008;
      state.elevation = Math.max(-1.55, Math.min(1.55, state.elevation + y * 0.008));
    }
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    redraw();
  });
  canvas.addEventListener("wheel", event => { event.preventDefault(); state.distance *= Math.exp(event.deltaY * 0.001); redraw(); }, {passive: false});
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("dblclick", () => { state = {...home}; redraw(); });
  canvas.addEventListener("choose", event => { chosen = event.detail; redraw(); });
  canvas.addEventListener("keydown", event => {
    const turn = {ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1]}[event.key];
    if (turn) { state.azimuth += turn[0]; state.elevation = Math.max(-1.55, Math.min(1.55, state.elevation + turn[1])); }
    else if (event.key === "+" || event.key === "=") state.distance *= 0.9;
    else if (event.key === "-") state.distance /= 0.9;
    else if (event.key === "0") state = {...home};
    else return;
    event.preventDefault(); redraw();
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  for (const name of ["points", "ghosts", "solids", "forces"]) switches[name].addEventListener("change", redraw);
  if (window.ResizeObserver) new ResizeObserver(redraw).observe(canvas);
  draw();
  return true;
}
