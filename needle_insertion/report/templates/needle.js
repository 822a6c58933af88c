// SPDX-License-Identifier: Apache-2.0
'use strict';

/*
 * The needle in its tissue, to scale, in both planes; and its tip around the target, seen from
 * the base. Lengths come in m and are drawn in mm. Who uses it: `needle watch`, and reports.
 *
 * What is drawn differs in form as well as in color: solid and dashed lines, a cross, a ring and
 * a bar with ends.
 */
const needleDrawing = (() => {
  const COLORS = {
    ink: '#1c2128', faint: '#5b6570', grid: '#d5dae0', paper: '#ffffff',
    tissue: ['#f8e8de', '#efd2c2'], entry: '#8a4a33', membrane: '#5d4632',
    needle: '#0b4f8a', path: '#1c2128', target: '#b93a00',
    expected: '#00694f', tip: '#7a1f6b',
  };
  const FONT = '12px system-ui, sans-serif';

  /* Shown length outside, smallest width, and margin below the deepest point [mm]. */
  const OUTSIDE = 45, LEAST = 10, BEYOND = 12;
  /* Largest coordinate that is drawn [mm], and time for which a range is kept [ms]. */
  const FARTHEST = 1000, HOLD = 10000;
  const MARGIN = {left: 44, right: 10, top: 6, between: 12, bottom: 34};

  const mm = (value) => 1e3 * value;

  /* Make a canvas as fine as the screen; return its context with a unit of one CSS pixel. */
  function prepared(canvas, width, height) {
    const fine = window.devicePixelRatio || 1;
    const columns = Math.round(width * fine), rows = Math.round(height * fine);
    if (canvas.width !== columns || canvas.height !== rows) {
      canvas.width = columns;
      canvas.height = rows;
      canvas.style.height = `${height}px`;
    }
    const pen = canvas.getContext('2d');
    pen.setTransform(fine, 0, 0, fine, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = FONT;
    pen.lineJoin = pen.lineCap = 'round';
    return pen;
  }

  function stroke(pen, color, width, dash, points) {
    if (points.length < 2) return;
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.stroke();
    pen.setLineDash([]);
  }

  /* Text that is legible on any background. */
  function label(pen, words, x, y, color, align = 'left') {
    pen.textAlign = align;
    pen.lineWidth = 3;
    pen.strokeStyle = COLORS.paper;
    pen.strokeText(words, x, y);
    pen.fillStyle = color;
    pen.fillText(words, x, y);
  }

  function cross(pen, x, y, size) {
    for (const [color, width] of [[COLORS.paper, 6], [COLORS.target, 3]]) {
      stroke(pen, color, width, [], [[x - size, y - size], [x + size, y + size]]);
      stroke(pen, color, width, [], [[x - size, y + size], [x + size, y - size]]);
    }
  }

  function ring(pen, x, y, size) {
    for (const [color, width] of [[COLORS.paper, 5], [COLORS.tip, 2.2]]) {
      pen.strokeStyle = color;
      pen.lineWidth = width;
      pen.beginPath();
      pen.arc(x, y, size, 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  const far = (value) => Number.isFinite(value) && Math.abs(mm(value)) > FARTHEST;

  /* Return a frame without the coordinates that are too far to be drawn, and their words. */
  function plausible(frame) {
    const shown = {...frame}, left = [], {depth, tip, target, expected} = frame;
    const check = (key, words, values, none = null) => {
      const value = values.find(far);
      if (value === undefined) return;
      shown[key] = none;
      if (words) left.push(`${words} ${mm(value).toPrecision(3)} mm`);
    };
    check('depth', 'depth', [depth]);
    /* The depth of the tip is not drawn. */
    if (tip) check('tip', 'tip', [tip[0], tip[2]]);
    if (target) check('target', 'target', target);
    if (expected) check('expected', 'predicted tip', [...expected.at, ...expected.half]);
    /* A straight needle is drawn from depth and tip. */
    check('needle', left.length ? '' : 'needle', (frame.needle || []).flat());
    check('path', 'cut path', (frame.path || []).flat());
    check('other', 'other needle', (frame.other || []).flat());
    return {shown, left};
  }

  /* The larger of two ranges: end of the depth and half of the width [mm]. */
  const larger = (one, other) => one.map((value, k) => Math.max(value, other[k]));

  class Drawing {
    constructor(canvas) {
      this.canvas = canvas;
      this.lateral = 1;  /* lateral scale over the scale of the depth */
      this.plan = null;  /* path of the tip and free space around it */
      this.reset();
    }

    /* Reset the range for another recording or time. */
    reset() {
      /* Magnified, the needle needs no margin for a later motion. */
      this.least = [60, this.lateral > 1 ? 2 : LEAST];
      this.earlier = this.latest = this.least;
      [this.end, this.side] = this.least;
      this.since = performance.now();
      this.shown = null;  /* the newest frame, as drawn */
      this.left = [];  /* words about its coordinates that are not drawn */
    }

    /* Extend the smallest range for later drawings. */
    reserve(frame, scene) {
      this.least = larger(this.least, this.needs(plausible(frame).shown, scene));
    }

    /* Set the range: that of the last 10 to 20 s, without small changes. */
    room(frame, scene) {
      const now = performance.now();
      if (now - this.since > HOLD) {
        [this.earlier, this.latest, this.since] = [this.latest, this.least, now];
      }
      this.latest = larger(larger(this.latest, this.least), this.needs(frame, scene));
      const [end, side] = larger(this.earlier, this.latest);
      if (end > this.end || end < 0.75 * this.end) this.end = end;
      if (side > this.side || side < 0.75 * this.side) this.side = side;
    }

    /* Return the range that a frame needs. */
    needs(frame, scene) {
      const depths = [0], sides = [0];
      const line = (points) => {
        if (!points || !points.length) return;
        points[1].forEach((y) => depths.push(mm(y)));
        points[1].forEach((y, k) => {
          if (mm(y) > -OUTSIDE) sides.push(Math.abs(mm(points[0][k])), Math.abs(mm(points[2][k])));
        });
      };
      line(frame.needle);
      line(frame.path);
      line(frame.other);
      line(this.plan && plausible({path: this.plan.path}).shown.path);
      for (const at of [frame.target, frame.expected && frame.expected.at]) {
        if (!at) continue;
        if (at[1] !== null) depths.push(mm(at[1]));
        sides.push(Math.abs(mm(at[0] || 0)), Math.abs(mm(at[2] || 0)));
      }
      const deepest = Math.max(...depths, mm(frame.depth || 0)) + BEYOND;
      const layers = scene.tissue ? scene.tissue.layers : [];
      const last = layers.length > 1 ? mm(layers[layers.length - 1][0]) + 15 : 0;
      return [10 * Math.ceil(Math.min(FARTHEST, Math.max(deepest, last)) / 10),
        Math.ceil(Math.max(...sides) + (this.lateral > 1 ? 1 : 3))];
    }

    draw(scene, given) {
      const {shown: frame, left} = plausible(given);
      [this.shown, this.left] = [frame, left];
      this.room(frame, scene);
      const width = this.canvas.clientWidth || 600;
      const scale = (width - MARGIN.left - MARGIN.right) / (this.end + OUTSIDE);
      const aside = scale * this.lateral;
      const half = Math.max(this.side * aside, 30);
      const height = MARGIN.top + 4 * half + MARGIN.between + MARGIN.bottom;
      const pen = prepared(this.canvas, width, Math.round(height));
      const across = (y) => MARGIN.left + (mm(y) + OUTSIDE) * scale;
      [[0, 'x'], [2, 'z']].forEach(([axis, name], k) => {
        const middle = MARGIN.top + half + k * (2 * half + MARGIN.between);
        const plane = {axis, name, middle, half, scale, aside, width, across,
          up: (value) => middle - mm(value) * aside};
        this.plane(pen, plane, scene, frame, k === 1);
      });
      return {width, height, scale};
    }

    plane(pen, plane, scene, frame, last) {
      const {axis, name, middle, half, scale, aside, width, across} = plane;
      const left = MARGIN.left, right = width - MARGIN.right;
      const top = middle - half, bottom = middle + half;
      pen.save();
      pen.beginPath();
      pen.rect(left, top, right - left, 2 * half);
      pen.clip();
      this.tissue(pen, plane, scene, right);
      /* A grid with steps wide enough for the labels. */
      const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((one) => aside * one > 14) || 1000;
      pen.strokeStyle = COLORS.grid;
      pen.lineWidth = 1;
      stroke(pen, COLORS.grid, 1, [], [[left, middle], [right, middle]]);
      const high = scene.limits && scene.limits.high;
      if (high && across(high) < right) {
        stroke(pen, COLORS.faint, 1.2, [2, 4], [[across(high), top], [across(high), bottom]]);
        if (axis === 0) {
          label(pen, 'limit', across(high) - 4, top + 13, COLORS.faint, 'right');
        }
      }
      this.content(pen, plane, frame);
      pen.restore();
      pen.strokeStyle = COLORS.faint;
      pen.lineWidth = 1;
      pen.strokeRect(left, top, right - left, 2 * half);
      pen.fillStyle = COLORS.ink;
      pen.textAlign = 'right';
      const most = step * Math.floor((half / aside - 0.5) / step);
      for (let value = -most; value <= most; value += step) {
        pen.fillText(String(value), left - 6, middle - value * aside + 4);
        stroke(pen, COLORS.faint, 1, [], [[left - 3, middle - value * aside],
          [left, middle - value * aside]]);
      }
      pen.save();
      pen.translate(11, middle);
      pen.rotate(-Math.PI / 2);
      pen.textAlign = 'center';
      pen.fillText(`${name} [mm]${this.lateral > 1 ? ` × ${this.lateral}` : ''}`, 0, 0);
      pen.restore();
      if (!last) return;
      pen.textAlign = 'center';
      const gap = scale * 10 > 34 ? 10 : [20, 50, 100, 200, 500].find((one) => scale * one > 26) || 1000;
      for (let value = -gap * Math.floor(OUTSIDE / gap); value <= this.end; value += gap) {
        const x = across(value / 1e3);
        stroke(pen, COLORS.faint, 1, [], [[x, bottom], [x, bottom + 3]]);
        if (x < right - 4) pen.fillText(String(value), x, bottom + 15);
      }
      pen.fillText('depth y [mm]', (left + right) / 2, bottom + 30);
    }

    tissue(pen, {axis, middle, half, across}, scene, right) {
      const top = middle - half;
      const layers = scene.tissue && scene.tissue.layers.length ? scene.tissue.layers : [[0, null]];
      layers.forEach(([from, stiffness], k) => {
        const begin = across(from);
        const end = k + 1 < layers.length ? across(layers[k + 1][0]) : right;
        pen.fillStyle = COLORS.tissue[k % 2];
        pen.fillRect(begin, top, end - begin, 2 * half);
        if (k) stroke(pen, COLORS.entry, 1, [6, 3], [[begin, top], [begin, top + 2 * half]]);
        if (axis === 0 && layers.length > 1 && end - begin > 64) {
          label(pen, `layer ${k + 1}`, begin + 6, top + 13, COLORS.entry);
        }
      });
      (scene.tissue ? scene.tissue.membranes : []).forEach(([depth]) => {
        for (const shift of [-1.5, 1.5]) {
          const x = across(depth) + shift;
          stroke(pen, COLORS.membrane, 1.2, [4, 3], [[x, top], [x, top + 2 * half]]);
        }
        if (axis === 2) {
          label(pen, 'membrane', across(depth) + 5, top + 2 * half - 5, COLORS.membrane);
        }
      });
      stroke(pen, COLORS.entry, 3, [], [[across(0), top], [across(0), top + 2 * half]]);
      if (axis === 0) label(pen, 'entry', across(0) - 6, top + 13, COLORS.entry, 'right');
    }

    /* Planned path of the tip, and the space around it that is free of obstacles and margins. */
    planned(pen, {axis, across, up}, {path, free}) {
      const edge = (sign) => path[1].map((y, k) => [across(y), up(path[axis][k] + sign * free[k])]);
      const [above, below] = [edge(1), edge(-1)];
      pen.fillStyle = 'rgba(0, 105, 79, 0.12)';
      pen.beginPath();
      [...above, ...below.slice().reverse()].forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.fill();
      for (const side of [above, below]) stroke(pen, COLORS.expected, 1.2, [2, 3], side);
      stroke(pen, COLORS.expected, 2, [9, 3, 2, 3], path[1].map((y, k) => [across(y), up(path[axis][k])]));
    }

    content(pen, plane, frame) {
      const {axis, middle, half, across, up} = plane;
      const points = (line) => line[1].map((y, k) => [across(y), up(line[axis][k])]);
      const target = frame.target, expected = frame.expected;
      if (this.plan) this.planned(pen, plane, this.plan);
      /* Needle of another recording. */
      if (frame.other) stroke(pen, COLORS.tip, 2.5, [2, 5], points(frame.other));
      if (frame.needle && frame.needle.length) {
        const line = points(frame.needle);
        stroke(pen, COLORS.paper, 5.5, [], line);
        stroke(pen, COLORS.needle, 3.5, frame.shape === 'straight' ? [10, 5] : [], line);
      }
      /* Drawn over the needle, which would hide it. */
      if (frame.path) {
        stroke(pen, COLORS.paper, 1.6, [], points(frame.path));
        stroke(pen, COLORS.path, 1.6, [5, 4], points(frame.path));
      }
      if (target && target[axis] === null) {
        const x = across(target[1]);
        stroke(pen, COLORS.target, 2, [10, 4, 2, 4], [[x, middle - half], [x, middle + half]]);
        label(pen, 'target depth', x - 5, middle + half - 6, COLORS.target, 'right');
      } else if (target && target[1] !== null) {
        cross(pen, across(target[1]), up(target[axis]), 5);
      }
      if (expected) {
        /* Next to the target, which would hide it. */
        const x = across(expected.at[1]) + 12, wide = expected.half[axis ? 1 : 0] || 0;
        const low = up(expected.at[axis] - wide), high = up(expected.at[axis] + wide);
        for (const [color, width] of [[COLORS.paper, 4.5], [COLORS.expected, 2.2]]) {
          stroke(pen, color, width, [], [[x, low], [x, high]]);
          for (const end of [low, high]) {
            stroke(pen, color, width, [], [[x - 5, end], [x + 5, end]]);
          }
        }
      }
      if (frame.tip && frame.tip[axis] !== null && frame.depth !== null) {
        ring(pen, across(frame.depth), up(frame.tip[axis]), 5);
      }
    }
  }

  /* The tip around the target: x to the right, z up, seen along the needle from its base. */
  function aim(canvas, frame) {
    const width = canvas.clientWidth || 240, height = Math.min(width, 260);
    const pen = prepared(canvas, width, height);
    const target = frame.target, expected = frame.expected;
    const tip = frame.tip && frame.tip[0] !== null && frame.tip[2] !== null ? frame.tip : null;
    const from = (at) => [mm(at[0] - target[0]), mm(at[2] - target[2])];
    const seen = [1.2];
    if (tip) seen.push(Math.hypot(...from(tip)) + 0.5);
    if (expected) {
      seen.push(Math.hypot(...from(expected.at)) + mm(Math.max(...expected.half)));
    }
    const reach = [2, 5, 10, 20, 50].find((one) => one >= Math.max(...seen)) || 100;
    const scale = (height / 2 - 10) / reach;
    const x = (value) => width / 2 + value * scale, y = (value) => height / 2 - value * scale;
    pen.textAlign = 'left';
    for (const radius of [reach / 2, reach]) {
      pen.strokeStyle = COLORS.grid;
      pen.lineWidth = 1.2;
      pen.beginPath();
      pen.arc(x(0), y(0), radius * scale, 0, 2 * Math.PI);
      pen.stroke();
      label(pen, `${radius} mm`, x(0) + 4, y(-radius) - 4, COLORS.faint);
    }
    stroke(pen, COLORS.grid, 1, [], [[x(-reach), y(0)], [x(reach), y(0)]]);
    stroke(pen, COLORS.grid, 1, [], [[x(0), y(-reach)], [x(0), y(reach)]]);
    label(pen, 'x', x(reach) - 10, y(0) - 5, COLORS.ink);
    label(pen, 'z', x(0) + 6, y(reach) + 12, COLORS.ink);
    if (expected) {
      const [right, up] = from(expected.at);
      /* 95 % of normal samples are within 2.45 standard deviations in 2D, within 1.96 in 1D. */
      const [a, b] = expected.half.map((half) => mm(half) * 2.4477 / 1.96);
      const c = expected.correlation || 0, turned = Math.sqrt(Math.max(0, 1 - c * c));
      const edge = [...Array(65).keys()].map((k) => {
        const [cosine, sine] = [Math.cos(k * Math.PI / 32), Math.sin(k * Math.PI / 32)];
        return [x(right + a * cosine), y(up + b * (c * cosine + turned * sine))];
      });
      pen.fillStyle = 'rgba(0, 105, 79, 0.14)';
      pen.beginPath();
      edge.forEach(([u, v], k) => (k ? pen.lineTo(u, v) : pen.moveTo(u, v)));
      pen.fill();
      stroke(pen, COLORS.expected, 2, [], edge);
    }
    cross(pen, x(0), y(0), 5);
    if (tip) ring(pen, x(from(tip)[0]), y(from(tip)[1]), 5);
  }

  return {Drawing, aim, prepared, stroke, label, cross, COLORS, FARTHEST};
})();
