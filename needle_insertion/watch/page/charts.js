// SPDX-License-Identifier: Apache-2.0
'use strict';

/*
 * Charts of `needle watch`: signals over time with one cursor, zoom, and export of picture and
 * table. Times are in s, values in SI units. A value of null, or a pause, is a gap.
 */
const needleCharts = (() => {
  const {prepared, stroke, label, COLORS, FARTHEST} = needleDrawing;
  const SOLID = [COLORS.needle, []], DASHED = [COLORS.target, [6, 4]];
  /* Lines of another recording, for each of the above. */
  const OTHER = new Map([[COLORS.needle, [COLORS.tip, [2, 4]]], [COLORS.target, [COLORS.expected, [9, 4, 2, 4]]]]);
  const HEIGHT = 150, LEFT = 44, RIGHT = 8, TOP = 6, BOTTOM = 20;
  /* Duration of a live chart, and shortest duration [s]; zoom factor; a drag [pixels]. */
  const SPAN = 20, SHORTEST = 0.02, ZOOM = 1.5, DRAG = 4;
  /* Pause of live rows that is a gap [s]. */
  const PAUSE = 0.5;

  /* Charts: name, unit, factor from SI, smallest range, and signals with words and line. */
  const CHARTS = [
    {name: 'Depth', unit: 'mm', si: 'm', factor: 1e3, least: 2, digits: 2,
      signals: {depth: ['measured', ...SOLID], reference: ['reference', ...DASHED]}},
    {name: 'Force', unit: 'N', si: 'N', factor: 1, least: 1, digits: 2, limit: 'load', signals: {force: ['along', ...SOLID]}},
    {name: 'Tip', unit: 'mm', si: 'm', factor: 1e3, least: 1, digits: 2,
      signals: {tip_x: ['x', ...SOLID], tip_z: ['z', ...DASHED]}},
    {name: 'Guide', unit: 'mm', si: 'm', factor: 1e3, least: 1, digits: 2, off: true,
      signals: {guide_x: ['x', ...SOLID], guide_z: ['z', ...DASHED]}},
    {name: 'Velocity', unit: 'mm/s', si: 'm/s', factor: 1e3, least: 1, digits: 1, off: true, signals: {velocity: ['measured', ...SOLID]}},
    {name: 'Tracking error', unit: 'mm', si: 'm', factor: 1e3, least: 0.1, digits: 3, off: true, signals: {error: ['along', ...SOLID]}},
    {name: 'Lateral force', unit: 'N', si: 'N', factor: 1, least: 0.2, digits: 2, off: true,
      signals: {force_x: ['x', ...SOLID], force_z: ['z', ...DASHED]}},
    {name: 'Roll', unit: '°', si: 'rad', factor: 180 / Math.PI, least: 10, digits: 1, off: true, signals: {roll: ['about y', ...SOLID]}},
  ];
  /* Columns of a row of a live frame, after the time. */
  const ROW = ['depth', 'reference', 'velocity', 'error', 'force', 'force_x', 'force_z', 'tip_x', 'tip_z', 'guide_x', 'guide_z', 'roll'];

  const fixed = (value, digits) =>
    (value === null || value === undefined ? '–' : Math.abs(value) >= 1e7 ? value.toExponential(2)
      : (value + 0).toFixed(digits).replace(/^-(0\.?0*)$/, '$1'));

  /* Whether a value of a chart is drawn: lengths up to the largest that the needle is drawn with. */
  const drawn = ({si, factor}, value) => value !== null && (si !== 'm' || Math.abs(value * factor) <= FARTHEST);

  /* Number of times up to a time, in ascending times. */
  function upTo(times, time) {
    let low = 0, high = times.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  function steps(low, high, number) {
    const rough = (high - low) / number, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((one) => one * power >= rough) * power;
    const values = [], first = Math.ceil(low / step - 1e-9);
    /* Of numbers without finite differences there are no ticks. */
    for (let k = 0; k <= 2 * number && (first + k) * step <= high; k += 1) values.push((first + k) * step);
    return {values, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9))};
  }

  function save(content, name) {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(content);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  class Charts {
    /* `changed` is called to draw again, `seek` with a time of a recording. */
    constructor(box, choices, changed, seek) {
      this.box = box;
      this.changed = changed;
      this.seek = seek;
      this.data = {};
      this.now = 0;
      this.other = {};
      this.known = new Set();  /* signals with a value so far */
      /* First and last time of a recording; null: live. */
      this.ends = null;
      this.span = SPAN;
      this.from = 0;
      this.cursor = null;
      for (const chart of CHARTS) this.add(chart, choices);
      box.addEventListener('keydown', (event) => this.key(event));
    }

    add(chart, choices) {
      const figure = document.createElement('figure'), caption = document.createElement('figcaption');
      chart.canvas = document.createElement('canvas');
      chart.canvas.setAttribute('role', 'img');
      chart.canvas.setAttribute('aria-label', `${chart.name} over time`);
      caption.append(`${chart.name} [${chart.unit}]`);
      chart.figure = figure;
      chart.values = {};
      chart.chosen = {};
      for (const [name, [words, , dash]] of Object.entries(chart.signals)) {
        chart.values[name] = ['', 'other '].map((whose) => {
          const value = document.createElement('span');
          value.className = whose + (dash.length ? 'dashed' : 'solid');
          caption.append(value);
          return value;
        });
        const choice = document.createElement('label'), tick = document.createElement('input');
        tick.type = 'checkbox';
        tick.name = name;
        tick.checked = !chart.off;
        tick.addEventListener('change', () => this.changed());
        choice.append(tick, ` ${chart.name.toLowerCase()} ${words}`);
        choices.append(choice);
        chart.chosen[name] = tick;
      }
      /* Words about values that are not drawn. */
      chart.far = document.createElement('span');
      chart.far.className = 'far';
      caption.append(chart.far);
      figure.append(caption, chart.canvas);
      this.box.append(figure);
      this.listen(chart.canvas);
    }

    /* Data. */

    /* Show a recording of a duration with its signals, {name: [times, values]}, and another. */
    record(signals, duration, other) {
      this.data = signals;
      this.known.clear();
      this.other = other ? other.signals : {};
      this.last = other ? other.end : duration;
      this.ends = other ? [Math.min(0, other.begin), Math.max(duration, other.end)] : [0, duration];
      this.whole();
    }

    /* Show live rows, which replace all earlier ones. */
    live(rows) {
      this.data = Object.fromEntries(ROW.map((name) => [name, [[], []]]));
      this.ends = null;
      this.known.clear();
      rows.forEach((row) => this.push(row));
    }

    push([time, ...values]) {
      ROW.forEach((name, k) => {
        const [times, column] = this.data[name];
        const last = times.length ? times[times.length - 1] : time - 1e-3;
        if (time <= last) return;
        if (time - last > PAUSE) {
          times.push(time);
          column.push(null);
        }
        times.push(time);
        column.push(values[k]);
        const old = upTo(times, time - SPAN - 1);
        times.splice(0, old);
        column.splice(0, old);
      });
    }

    /* Whether a signal has had a value. */
    has(name) {
      if (!this.known.has(name) && [this.data, this.other].some((data) => data[name]
        && data[name][1].some((value) => value !== null))) this.known.add(name);
      return this.known.has(name);
    }

    /* Value of a signal at a time: its newest one, null in a gap. */
    at([times, values], time) {
      const k = upTo(times, time) - 1;
      return k < 0 ? null : values[k];
    }

    /* Time range. */

    range() {
      return this.ends === null ? [this.now - this.span, this.now] : [this.from, this.from + this.span];
    }

    whole() {
      const [from, to] = this.ends || [0, SPAN];
      this.from = from;
      this.span = Math.max(to - from, SHORTEST);
    }

    /* Show a range of a recording [s]. */
    show(from, to) {
      const [first, last] = this.ends, all = Math.max(last - first, SHORTEST);
      this.span = Math.min(all, Math.max(SHORTEST, to - from));
      this.from = Math.min(Math.max(first, from), first + all - this.span);
    }

    /* Change the duration by a factor, about a time; return whether it changes. */
    zoom(factor, about) {
      const before = this.span;
      if (this.ends === null) {
        this.span = Math.min(SPAN, Math.max(1, this.span / factor));
      } else {
        const [from, to] = this.range();
        const time = about === null || about < from || about > to ? (from + to) / 2 : about;
        this.show(time - (time - from) / factor, time + (to - time) / factor);
      }
      this.changed();
      return this.span !== before;
    }

    /* Pointer and keys. */

    time(canvas, event) {
      const box = canvas.getBoundingClientRect(), [from, to] = this.range();
      const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
      return from + Math.min(1, Math.max(0, share)) * (to - from);
    }

    listen(canvas) {
      let held = null;
      canvas.addEventListener('pointerdown', (event) => {
        held = {x: event.clientX, from: this.from, moved: false};
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener('pointermove', (event) => {
        if (held && this.ends !== null) {
          held.moved = held.moved || Math.abs(event.clientX - held.x) > DRAG;
          const pixel = this.span / (canvas.clientWidth - LEFT - RIGHT);
          const from = held.from - (event.clientX - held.x) * pixel;
          if (held.moved) this.show(from, from + this.span);
        }
        this.cursor = this.time(canvas, event);
        this.changed();
      });
      canvas.addEventListener('pointerup', (event) => {
        if (held && !held.moved && this.ends !== null) this.seek(this.time(canvas, event));
        held = null;
      });
      canvas.addEventListener('pointerleave', () => {
        this.cursor = null;
        this.changed();
      });
      canvas.addEventListener('wheel', (event) => {
        /* Zoom of the browser, and scrolling: sideways, and at the end of the zoom. */
        if (event.ctrlKey || Math.abs(event.deltaX) >= Math.abs(event.deltaY)) return;
        if (this.zoom(event.deltaY < 0 ? ZOOM : 1 / ZOOM, this.time(canvas, event))) event.preventDefault();
      }, {passive: false});
    }

    key(event) {
      const [from, to] = this.range(), step = {ArrowLeft: -0.01, ArrowRight: 0.01}[event.key];
      if (step) {
        const start = this.cursor === null ? this.now : this.cursor;
        this.cursor = Math.min(to, Math.max(from, start + step * (to - from)));
        this.changed();
      } else if (event.key === 'Enter' && this.cursor !== null && this.ends !== null) {
        this.seek(this.cursor);
      } else if (event.key === '+' || event.key === '-') {
        this.zoom(event.key === '+' ? ZOOM : 1 / ZOOM, this.cursor);
      } else {
        return;
      }
      event.preventDefault();
    }

    /* Drawing. */

    draw(now, limits) {
      this.now = now;
      for (const chart of CHARTS) {
        for (const [name, tick] of Object.entries(chart.chosen)) tick.disabled = !this.has(name);
        const names = this.chosen(chart);
        chart.figure.hidden = !names.length;
        for (const [name, boxes] of Object.entries(chart.values)) {
          [this.data, this.other].forEach((data, k) => {
            boxes[k].hidden = !names.includes(name) || !data[name];
            if (boxes[k].hidden) return;
            const time = this.cursor === null ? now : this.cursor;
            /* The other recording may have ended before. */
            const value = k && time > this.last ? null : this.at(data[name], time);
            const words = `${chart.signals[name][0]}${k ? ', other' : ''}`;
            const text = `${words} ${fixed(value === null ? null : value * chart.factor, chart.digits)}`;
            if (boxes[k].textContent !== text) boxes[k].textContent = text;
          });
        }
        if (names.length) this.one(chart, this.series(chart), limits);
      }
    }

    chosen(chart) {
      return Object.keys(chart.signals).filter((name) =>
        chart.chosen[name].checked && (this.data[name] || this.other[name]));
    }

    /* Chosen signals of a chart, of both recordings: name, color, dash, and [times, values]. */
    series(chart) {
      return [this.data, this.other].flatMap((data, k) => this.chosen(chart).filter((name) => data[name])
        .map((name) => {
          const line = chart.signals[name].slice(1);
          return {name: k ? `other_${name}` : name, line: k ? OTHER.get(line[0]) : line, data: data[name]};
        }));
    }

    /* Points of a signal in a time range, without those of the same pixel between extremes. */
    lines(chart, [times, values], from, to, x, y) {
      const found = [];
      let points = [], column = NaN, low = null, high = null;
      const end = () => {
        if (low !== null) points.push(...(low[0] <= high[0] ? [low, high] : [high, low]));
        low = high = null;
      };
      const last = Math.min(times.length, upTo(times, to) + 1);
      for (let k = Math.max(0, upTo(times, from) - 1); k < last; k += 1) {
        const value = values[k];
        if (!drawn(chart, value)) {
          end();
          found.push(points);
          [points, column] = [[], NaN];
          continue;
        }
        const at = [x(times[k]), y(value * chart.factor)], pixel = Math.floor(at[0]);
        if (pixel !== column) end();
        column = pixel;
        if (low === null || at[1] < low[1]) low = at;
        if (high === null || at[1] > high[1]) high = at;
      }
      end();
      return [...found, points].filter((one) => one.length);
    }

    /* Smallest and largest value in a time range, null without values, and number not drawn. */
    extent(chart, series, from, to) {
      let low = Infinity, high = -Infinity, count = 0;
      for (const {data: [times, values]} of series) {
        for (let k = Math.max(0, upTo(times, from) - 1), last = upTo(times, to); k < last; k += 1) {
          if (values[k] === null) continue;
          if (!drawn(chart, values[k])) {
            count += 1;
            continue;
          }
          low = Math.min(low, values[k]);
          high = Math.max(high, values[k]);
        }
      }
      return {ends: low > high ? null : [low, high], count};
    }

    one(chart, series, limits) {
      const {canvas, factor, least, limit, far} = chart;
      const width = canvas.clientWidth || 300, pen = prepared(canvas, width, HEIGHT);
      const right = width - RIGHT, bottom = HEIGHT - BOTTOM, [from, to] = this.range();
      const {ends, count} = this.extent(chart, series, from, to);
      let [low, high] = (ends || [-least / factor, least / factor]).map((one) => one * factor);
      far.hidden = !count;
      far.textContent = `${count} values beyond ${FARTHEST} mm are not drawn`;
      const pad = Math.max(0.08 * (high - low), (least - (high - low)) / 2);
      [low, high] = [low - pad, high + pad];
      const x = (time) => LEFT + (time - from) * (right - LEFT) / (to - from);
      const y = (value) => bottom - (value - low) * (bottom - TOP) / (high - low);
      pen.fillStyle = COLORS.ink;
      const across = steps(low, high, 4);
      pen.textAlign = 'right';
      for (const value of across.values) {
        stroke(pen, COLORS.grid, 1, [], [[LEFT, y(value)], [right, y(value)]]);
        pen.fillText(fixed(value, across.digits), LEFT - 5, y(value) + 4);
      }
      /* Live times are relative to the present time. */
      const zero = this.ends === null ? to : 0;
      const along = steps(from - zero, to - zero, Math.max(2, Math.min(10, width / 90)));
      for (const value of along.values) {
        const at = x(zero + value);
        stroke(pen, COLORS.grid, 1, [], [[at, TOP], [at, bottom]]);
        pen.textAlign = at > right - 20 ? 'right' : 'center';
        pen.fillText(zero && value === 0 ? 'now' : `${fixed(value, along.digits)} s`, at, bottom + 15);
      }
      const most = limit && limits[limit];
      for (const value of most ? [-most, most] : []) {
        if (value > low && value < high) {
          stroke(pen, COLORS.target, 1.5, [2, 4], [[LEFT, y(value)], [right, y(value)]]);
          label(pen, 'limit', LEFT + 4, y(value) - 4, COLORS.target);
        }
      }
      pen.save();
      pen.beginPath();
      pen.rect(LEFT, 0, right - LEFT, HEIGHT);
      pen.clip();
      for (const {line: [color, dash], data} of series) {
        for (const points of this.lines(chart, data, from, to, x, y)) {
          /* A sample between two gaps is a point. */
          if (points.length === 1) points.push([points[0][0] + 1, points[0][1]]);
          stroke(pen, color, 1.8, dash, points);
        }
      }
      if (this.ends !== null) stroke(pen, COLORS.ink, 1.5, [], [[x(this.now), TOP], [x(this.now), bottom]]);
      if (this.cursor !== null) {
        stroke(pen, COLORS.tip, 1.5, [3, 3], [[x(this.cursor), TOP], [x(this.cursor), bottom]]);
      }
      pen.restore();
    }

    /* Export. */

    /* Table of the shown signals in the shown range; an empty cell has no sample at its time. */
    csv() {
      const [from, to] = this.range(), rows = new Map(), heads = ['time [s]'];
      const shown = CHARTS.flatMap((chart) => this.series(chart).map((one) => [one, chart.si]));
      shown.forEach(([{name, data: [times, values]}, unit], k) => {
        heads.push(`${name} [${unit}]`);
        times.forEach((time, i) => {
          if (values[i] === null || time < from || time > to) return;
          if (!rows.has(time)) rows.set(time, Array(shown.length).fill(''));
          rows.get(time)[k] = values[i];
        });
      });
      const lines = [...rows].sort((one, other) => one[0] - other[0]).map(([time, row]) => [time, ...row].join(','));
      return `${[heads.join(','), ...lines].join('\n')}\n`;
    }

    saveTable(name) {
      save(new Blob([this.csv()], {type: 'text/csv'}), `${name}.csv`);
    }

    /* Picture of a canvas and of all shown charts. */
    savePicture(first, name) {
      const shown = CHARTS.filter((chart) => !chart.figure.hidden), LINE = 22;
      const fine = window.devicePixelRatio || 1, sheet = document.createElement('canvas');
      const tall = (one) => one.height / fine;
      const height = tall(first) + shown.reduce((sum, {canvas}) => sum + LINE + tall(canvas), 0);
      sheet.width = Math.max(first.width, ...shown.map(({canvas}) => canvas.width));
      const pen = prepared(sheet, sheet.width / fine, height);
      pen.fillStyle = COLORS.paper;
      pen.fillRect(0, 0, sheet.width, height);
      const put = (canvas, y) => pen.drawImage(canvas, 0, y, canvas.width / fine, tall(canvas));
      put(first, 0);
      let y = tall(first);
      for (const {canvas, figure} of shown) {
        const words = [...figure.querySelector('figcaption').childNodes].filter((node) => !node.hidden);
        label(pen, words.map((node) => node.textContent).join('   '), 8, y + 15, COLORS.ink);
        put(canvas, y + LINE);
        y += LINE + tall(canvas);
      }
      sheet.toBlob((content) => save(content, `${name}.png`));
    }
  }

  Charts.all = CHARTS;
  return {Charts, fixed, ZOOM};
})();
