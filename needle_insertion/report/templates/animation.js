// SPDX-License-Identifier: Apache-2.0
'use strict';

/* Plays the frames of a report in real time. */
(() => {
  const box = document.querySelector('.animation');
  const {scene, frames, path} = JSON.parse(document.getElementById('frames').textContent);
  const [play, slider, clock] = ['button', 'input', 'output'].map((tag) => box.querySelector(tag));
  const last = frames[frames.length - 1].time;
  let playing = false, time = last, before = 0;

  box.hidden = false;
  const drawing = new needleDrawing.Drawing(box.querySelector('canvas'));
  /* Reserve the range of all frames from the start. */
  frames.forEach((frame) => drawing.reserve({...frame, path}, scene));

  function draw() {
    const frame = frames.reduce((found, one) => (one.time <= time ? one : found));
    /* The cut path only grows: length at this frame. */
    const deepest = Math.max(...frames.filter((one) => one.time <= frame.time)
      .map((one) => Math.max(...one.needle[1])));
    const count = path[1].filter((y) => y <= deepest).length;
    drawing.draw(scene, {...frame, path: path.map((column) => column.slice(0, count))});
    slider.value = time;
    clock.textContent = `${time.toFixed(1)} of ${last.toFixed(1)} s`;
    play.textContent = playing ? 'Pause' : 'Play';
  }

  function step(now) {
    if (!playing) return;
    time = Math.min(last, time + (now - before) / 1e3);
    before = now;
    playing = time < last;
    draw();
    requestAnimationFrame(step);
  }

  play.addEventListener('click', () => {
    playing = !playing;
    if (playing && time >= last) time = 0;
    before = performance.now();
    draw();
    requestAnimationFrame(step);
  });
  slider.max = last;
  slider.addEventListener('input', () => {
    time = Number(slider.value);
    draw();
  });
  new ResizeObserver(draw).observe(box);
})();
