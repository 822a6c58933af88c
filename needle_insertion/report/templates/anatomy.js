// SPDX-License-Identifier: Apache-2.0
'use strict';

/*
 * Surfaces of an anatomy with the needle of a plan, turned by mouse, touch or keys, in WebGL.
 * Lengths are in mm, axes R, A, S. Who uses it: the page of `needle plan`, and `needle watch`.
 */
const needleAnatomy = (() => {
  const {prepared, stroke, label, cross, COLORS} = needleDrawing;

  /* Opacity by role: the needle is visible behind tissue. */
  const OPACITY = {obstacle: 1, target: 0.45, entry: 0.3, tissue: 0.13, free: 0.3};
  /* Colors from no clearance to much: from dark to light (viridis). */
  const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const MOST = 20;  /* clearance with the last color [mm] */
  const SIDES = 14, TURN = 0.01, KEY = 0.15, ZOOM = 1.25;
  const NEAR = 0.2, FAR = 20;  /* range of the zoom */

  const VERTEX = `
    attribute vec3 at, normal, color;
    uniform mat3 turn;
    uniform vec3 scale;
    varying vec3 shade;
    varying float facing;
    void main() {
      vec3 seen = turn * at;
      gl_Position = vec4(seen * scale, 1.0);
      facing = abs((turn * normal).z);
      shade = color;
    }`;
  const FRAGMENT = `
    precision mediump float;
    uniform float opacity, lit;
    varying vec3 shade;
    varying float facing;
    void main() {
      vec3 color = shade * mix(1.0, 0.4 + 0.6 * facing, lit);
      float a = opacity < 1.0 ? mix(min(1.0, 3.0 * opacity), opacity, facing) : 1.0;
      gl_FragColor = vec4(color * a, a);
    }`;

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const minus = (a, b) => a.map((one, k) => one - b[k]);
  const times = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const size = Math.hypot(...a) || 1; return a.map((one) => one / size); };

  function numbers(text, kind) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new kind(bytes.buffer);
  }

  function rgb(color) {
    return [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16) / 255);
  }

  /* Color of a clearance [mm] up to a largest one. */
  function shade(value, most) {
    const at = Math.min(1, Math.max(0, value / most)) * (SCALE.length - 1), k = Math.min(Math.floor(at), SCALE.length - 2);
    return SCALE[k].map((one, axis) => (one + (at - k) * (SCALE[k + 1][axis] - one)) / 255);
  }

  /* Normals of points, weighted by the areas of their triangles. */
  function normals(points, triangles) {
    const sums = new Float32Array(points.length);
    for (let k = 0; k < triangles.length; k += 3) {
      const ends = [0, 1, 2].map((one) => [...points.subarray(3 * triangles[k + one], 3 * triangles[k + one] + 3)]);
      const area = times(minus(ends[1], ends[0]), minus(ends[2], ends[0]));
      for (const one of [0, 1, 2]) area.forEach((part, axis) => { sums[3 * triangles[k + one] + axis] += part; });
    }
    for (let k = 0; k < sums.length; k += 3) sums.set(unit([...sums.subarray(k, k + 3)]), k);
    return sums;
  }

  /* Tube around a line of points with a radius and a color at each. */
  function tube(line, radii, colors) {
    const points = [], directions = [], shades = [], triangles = [];
    let side = null;
    line.forEach((at, k) => {
      const along = unit(minus(line[Math.min(k + 1, line.length - 1)], line[Math.max(k - 1, 0)]));
      const start = side || (Math.abs(along[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0]);
      /* The side of the last ring: the tube does not twist. */
      side = unit(minus(start, along.map((one) => one * dot(start, along))));
      const other = times(along, side);
      for (let one = 0; one < SIDES; one += 1) {
        const angle = 2 * Math.PI * one / SIDES;
        const out = side.map((part, axis) => Math.cos(angle) * part + Math.sin(angle) * other[axis]);
        points.push(...at.map((part, axis) => part + radii[k] * out[axis]));
        directions.push(...out);
        shades.push(...colors[k]);
        if (!k) continue;
        const now = SIDES * k, next = (one + 1) % SIDES;
        triangles.push(now + one, now - SIDES + one, now + next, now + next, now - SIDES + one, now - SIDES + next);
      }
    });
    return {points: new Float32Array(points), normals: new Float32Array(directions),
      colors: new Float32Array(shades), triangles: new Uint16Array(triangles)};
  }

  class View {
    /* Show a content in an element, with a needle of `show` if it is live; without WebGL, a line of text. */
    constructor(box, content, live = false) {
      this.box = box;
      this.content = content;
      box.hidden = false;
      this.canvas = document.createElement('canvas');
      this.gl = this.canvas.getContext('webgl', {antialias: true});
      if (!this.gl) {
        box.prepend('The anatomy in 3D is not shown: this browser has no WebGL.');
        return;
      }
      this.middle = content.entry.map((one, axis) => (one + content.target[axis]) / 2);
      this.half = Math.hypot(...minus(content.target, content.entry));
      this.zoom = 1;
      this.waiting = false;
      this.most = Math.min(MOST, Math.max(...content.needle.clearance, 1));
      this.prepare();
      this.now = live ? this.add('needle now', 'needle', rgb(COLORS.needle), tube([], [], [])) : null;
      this.layout();
      this.listen();
      this.look('side');
      new ResizeObserver(() => this.later()).observe(this.stage);
    }

    /* Meshes. */

    prepare() {
      const {gl, content} = this;
      const program = gl.createProgram();
      for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      gl.useProgram(program);
      this.places = Object.fromEntries(['at', 'normal', 'color'].map((name) => [name, gl.getAttribLocation(program, name)]));
      this.values = Object.fromEntries(['turn', 'scale', 'opacity', 'lit'].map((name) => [name, gl.getUniformLocation(program, name)]));
      this.meshes = [];
      for (const one of content.structures) {
        const points = Float32Array.from(numbers(one.points, Int16Array), (value) => value * content.unit);
        const triangles = numbers(one.triangles, Uint16Array);
        this.add(one.name, one.role, rgb(one.color), {points, triangles, normals: normals(points, triangles)});
      }
      const {points, radius, clearance} = content.needle, line = points.map((at) => this.local(at));
      const free = (part) => clearance.map((one) => radius + Math.max(0, part * one));
      this.add('needle', 'needle', null, tube(line, free(0), clearance.map((one) => shade(one, this.most))));
      this.add('free of margins', 'free', rgb(COLORS.expected),
        tube(line, free(1), clearance.map(() => rgb(COLORS.expected))), false);
      for (const [name, color, wanted] of [['inserted, success', COLORS.needle, true], ['inserted, failure', COLORS.target, false]]) {
        const shown = (content.inserted || []).filter((one) => one.success === wanted);
        if (shown.length) this.add(name, 'lines', rgb(color), this.lines(shown.map((one) => one.points)));
      }
    }

    /* Show the needle of a frame: columns x, y, z in `needle_entry` [m], null if unknown. */
    show(columns) {
      const key = JSON.stringify(columns);
      if (!this.now || key === this.shown) return;
      this.shown = key;
      const {gl, now, content} = this, {entry, axes, needle} = content;
      const line = (columns && columns.length ? columns[1] : []).map((_, k) => this.local(entry.map((one, axis) =>
        one + 1e3 * (columns[0][k] * axes[0][axis] + columns[1][k] * axes[1][axis] + columns[2][k] * axes[2][axis]))));
      const {points, normals: directions, triangles} = tube(line, line.map(() => needle.radius), line.map(() => [0, 0, 0]));
      for (const [kind, buffer, values] of [[gl.ARRAY_BUFFER, now.at, points], [gl.ARRAY_BUFFER, now.normal, directions],
        [gl.ELEMENT_ARRAY_BUFFER, now.index, triangles]]) {
        gl.bindBuffer(kind, buffer);
        gl.bufferData(kind, values, gl.DYNAMIC_DRAW);
      }
      now.shades = null;
      now.count = triangles.length;
      this.later();
    }

    local(at) {
      return minus(at, this.middle);
    }

    lines(all) {
      const points = all.flatMap((line) => line.slice(1).flatMap((at, k) => [...this.local(line[k]), ...this.local(at)]));
      return {points: new Float32Array(points), normals: null, triangles: null};
    }

    add(name, role, color, {points, normals: directions, colors, triangles}, shown = true) {
      const {gl} = this;
      const buffer = (values, kind = gl.ARRAY_BUFFER) => {
        if (!values) return null;
        const made = gl.createBuffer();
        gl.bindBuffer(kind, made);
        gl.bufferData(kind, values, gl.STATIC_DRAW);
        return made;
      };
      const mesh = {name, role, color, shown, opacity: OPACITY[role] || 1, at: buffer(points), normal: buffer(directions),
        shades: buffer(colors), index: buffer(triangles, gl.ELEMENT_ARRAY_BUFFER), count: (triangles || points).length};
      mesh.size = Math.max(...[0, 1, 2].map((axis) => points.reduce((most, one, k) => (k % 3 === axis ? Math.max(most, Math.abs(one)) : most), 0)));
      this.meshes.push(mesh);
      return mesh;
    }

    /* Elements. */

    layout() {
      const make = (tag, kind, parent, text = '') => {
        const node = document.createElement(tag);
        if (kind) node.className = kind;
        if (text) node.textContent = text;
        parent.append(node);
        return node;
      };
      const whole = document.createElement('div');
      this.stage = make('div', 'stage', whole);
      this.stage.append(this.canvas);
      this.overlay = make('canvas', '', this.stage);
      Object.assign(this.canvas, {tabIndex: 0});
      this.canvas.setAttribute('role', 'img');
      this.canvas.setAttribute('aria-label', 'Anatomy and needle in 3D: drag or arrow keys turn, plus and minus zoom');
      const tools = make('p', 'tools', whole);
      for (const [words, action] of [['Side', 'side'], ['Front', 'front'], ['Right', 'right'], ['Below', 'below'], ['Along', 'along']]) {
        make('button', '', tools, words).addEventListener('click', () => this.look(action));
      }
      for (const [words, factor] of [['+', ZOOM], ['−', 1 / ZOOM]]) {
        make('button', '', tools, words).addEventListener('click', () => this.closer(factor));
      }
      const legend = make('p', 'tools', whole);
      for (const mesh of this.meshes) {
        const choice = make('label', '', legend), tick = make('input', '', choice), swatch = make('i', 'swatch', choice);
        Object.assign(tick, {type: 'checkbox', checked: mesh.shown});
        swatch.style.background = mesh.color ? `rgb(${mesh.color.map((one) => 255 * one)})` : COLORS.ink;
        choice.append(mesh.role in OPACITY && mesh.role !== mesh.name && mesh.role !== 'free' ? `${mesh.name} (${mesh.role})` : mesh.name);
        tick.addEventListener('change', () => {
          mesh.shown = tick.checked;
          this.later();
        });
      }
      this.box.prepend(whole);
    }

    listen() {
      const held = new Map();
      this.canvas.addEventListener('pointerdown', (event) => {
        held.set(event.pointerId, event);
        this.canvas.setPointerCapture(event.pointerId);
      });
      this.canvas.addEventListener('pointermove', (event) => {
        const before = held.get(event.pointerId);
        if (!before) return;
        this.turn(TURN * (event.clientX - before.clientX), TURN * (event.clientY - before.clientY));
        held.set(event.pointerId, event);
      });
      for (const kind of ['pointerup', 'pointercancel']) this.canvas.addEventListener(kind, (event) => held.delete(event.pointerId));
      this.canvas.addEventListener('wheel', (event) => {
        /* Before a click, the wheel scrolls the page. */
        if (document.activeElement !== this.canvas) return;
        event.preventDefault();
        this.closer(event.deltaY < 0 ? ZOOM : 1 / ZOOM);
      }, {passive: false});
      const keys = {ArrowLeft: [-KEY, 0], ArrowRight: [KEY, 0], ArrowUp: [0, -KEY], ArrowDown: [0, KEY]};
      this.canvas.addEventListener('keydown', (event) => {
        if (event.key in keys) this.turn(...keys[event.key]);
        else if (event.key === '+' || event.key === '-') this.closer(event.key === '+' ? ZOOM : 1 / ZOOM);
        else return;
        event.preventDefault();
      });
    }

    /* Direction of view: angle about S from the front, and height above the horizon [rad]. */

    look(from) {
      const [x, y, z] = unit(minus(this.content.target, this.content.entry));
      const side = Math.atan2(x, y) + Math.PI / 2;
      const [angle, height] = {
        side: [Math.cos(side) < 0 ? side + Math.PI : side, 0.35], front: [0, 0], right: [Math.PI / 2, 0],
        below: [0, -Math.PI / 2], along: [Math.atan2(-x, -y), Math.asin(-z)],
      }[from];
      Object.assign(this, {angle, height});
      this.later();
    }

    turn(angle, height) {
      this.angle += angle;
      this.height = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, this.height + height));
      this.later();
    }

    closer(factor) {
      this.zoom = Math.min(FAR, Math.max(NEAR, this.zoom * factor));
      this.later();
    }

    /* Axes of the screen in the patient: to the right, up, and toward the viewer. */
    axes() {
      const [c, s] = [Math.cos(this.height), Math.sin(this.height)];
      const toward = [Math.sin(this.angle) * c, Math.cos(this.angle) * c, s];
      const right = [-Math.cos(this.angle), Math.sin(this.angle), 0];
      return [right, times(toward, right), toward];
    }

    /* Drawing. */

    later() {
      if (this.waiting) return;
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        this.draw();
      });
    }

    draw() {
      const {gl, canvas} = this, width = this.stage.clientWidth || 600, height = Math.round(Math.min(0.7 * width, 560));
      const fine = window.devicePixelRatio || 1;
      const columns = Math.round(width * fine), rows = Math.round(height * fine);
      if (canvas.width !== columns || canvas.height !== rows) {
        Object.assign(canvas, {width: columns, height: rows});
        canvas.style.height = this.stage.style.height = `${height}px`;
      }
      const axes = this.axes(), scale = this.zoom * Math.min(width, height) / (2 * this.half);
      gl.viewport(0, 0, columns, rows);
      gl.clearColor(1, 1, 1, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.uniformMatrix3fv(this.values.turn, false, [0, 1, 2].flatMap((axis) => axes.map((one) => one[axis])));
      /* No part is nearer or farther than the largest size. */
      const deep = 1 / (2 * Math.max(...this.meshes.map((mesh) => mesh.size)));
      gl.uniform3f(this.values.scale, 2 * scale / width, 2 * scale / height, -deep);
      const shown = this.meshes.filter((mesh) => mesh.shown);
      const clear = shown.filter((mesh) => mesh.opacity < 1).sort((a, b) => b.size - a.size);
      gl.disable(gl.BLEND);
      gl.depthMask(true);
      gl.disable(gl.CULL_FACE);
      shown.filter((mesh) => mesh.opacity === 1).forEach((mesh) => this.one(mesh));
      /* Far sides from the outermost one inward, then near sides outward. */
      gl.enable(gl.BLEND);
      gl.depthMask(false);
      gl.enable(gl.CULL_FACE);
      gl.cullFace(gl.FRONT);
      clear.forEach((mesh) => this.one(mesh));
      gl.cullFace(gl.BACK);
      clear.reverse().forEach((mesh) => this.one(mesh));
      this.marks(width, height, axes, scale);
      this.box.dataset.drawn = String(1 + Number(this.box.dataset.drawn || 0));
    }

    one(mesh) {
      const {gl, places, values} = this;
      for (const [name, buffer] of [['at', mesh.at], ['normal', mesh.normal], ['color', mesh.shades]]) {
        if (buffer) {
          gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
          gl.enableVertexAttribArray(places[name]);
          gl.vertexAttribPointer(places[name], 3, gl.FLOAT, false, 0, 0);
        } else {
          gl.disableVertexAttribArray(places[name]);
          gl.vertexAttrib3f(places[name], ...(mesh.color || [0, 0, 0]));
        }
      }
      gl.uniform1f(values.opacity, mesh.opacity);
      gl.uniform1f(values.lit, mesh.normal ? 1 : 0);
      if (mesh.index) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.index);
        gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0);
      } else {
        gl.drawArrays(gl.LINES, 0, mesh.count / 3);
      }
    }

    /* Entry, target, directions of the patient, length and colors, over the picture. */
    marks(width, height, axes, scale) {
      const pen = prepared(this.overlay, width, height);
      const at = (place) => {
        const local = this.local(place);
        return [width / 2 + scale * dot(local, axes[0]), height / 2 - scale * dot(local, axes[1])];
      };
      const [x, y] = at(this.content.entry);
      label(pen, 'entry', x + 8, y - 8, COLORS.ink);
      cross(pen, ...at(this.content.target), 5);
      const size = 26, middle = [46, height - 46];
      [['R', 'L'], ['A', 'P'], ['S', 'I']].forEach((letters, axis) => letters.forEach((letter, k) => {
        const end = [axes[0][axis], -axes[1][axis]].map((one) => (k ? -size : size) * one);
        if (Math.hypot(...end) < 0.3 * size) return;
        stroke(pen, COLORS.faint, k ? 1 : 2, [], [middle, [middle[0] + end[0], middle[1] + end[1]]]);
        label(pen, letter, middle[0] + 1.35 * end[0], middle[1] + 1.35 * end[1] + 4, COLORS.ink, 'center');
      }));
      const bar = [1, 2, 5, 10, 20, 50, 100].find((one) => one * scale > 50) || 200, right = width - 16;
      stroke(pen, COLORS.ink, 3, [], [[right - bar * scale, height - 14], [right, height - 14]]);
      label(pen, `${bar} mm`, right, height - 22, COLORS.ink, 'right');
      const wide = 120, left = right - wide;
      for (let k = 0; k < wide; k += 1) {
        pen.fillStyle = `rgb(${shade(k / wide * this.most, this.most).map((one) => 255 * one)})`;
        pen.fillRect(left + k, 26, 1.5, 10);
      }
      label(pen, 'clearance of the needle [mm]', right, 18, COLORS.ink, 'right');
      label(pen, '0', left, 52, COLORS.ink);
      label(pen, this.most.toFixed(1), right, 52, COLORS.ink, 'right');
    }
  }

  return {View};
})();
