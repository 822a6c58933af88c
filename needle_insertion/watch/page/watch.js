// SPDX-License-Identifier: Apache-2.0
'use strict';

/* Page of `needle watch`: draws the newest frame, acknowledges it, and sends commands. */

const find = (id) => document.getElementById(id);
const mm = (value) => (value === null ? null : 1e3 * value);

/* Period of text, numbers and charts [ms]. */
const WORDS = 120;
const LEVELS = ['fine', 'warning', 'error', 'silent'];
const SIGNS = {fine: '●', warning: '▲', error: '■', silent: '○', none: '○'};

const link = new URLSearchParams(location.hash.slice(1));
const token = link.get('token') || '';
const calm = matchMedia('(prefers-reduced-motion: reduce)');
const drawing = new needleDrawing.Drawing(find('needle'));

/* State for tests. */
const seen = {frames: 0, drawn: 0, connected: false};
window.needleWatch = seen;

let scene = {limits: {}, tissue: null, steered: false}, setting = null;
let frame = null, playback = null, waiting = false, worded = 0, drawnAt = 0;
let anatomy = null, other = null, dragging = false, unseen = 0, saying = 0, changed = true;

/* Text. */

const {fixed} = needleCharts;

function put(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function level(node, name) {
  if (node.dataset.level !== name) node.dataset.level = name;
}

function make(tag, text = '', kind = '') {
  const node = document.createElement(tag);
  if (text) node.textContent = text;
  if (kind) node.className = kind;
  return node;
}

/* Numbers with their limits. */

const QUANTITIES = [
  {name: 'Insertion depth', signal: 'depth', unit: 'mm', digits: 2, of: (f) => mm(f.depth), stream: 'joint_states',
    range: (l) => ('low' in l && 'high' in l ? [mm(l.low), mm(l.high)] : null)},
  {name: 'Velocity', signal: 'velocity', unit: 'mm/s', digits: 1, of: (f) => mm(f.velocity), stream: 'joint_states',
    range: (l) => ('speed' in l ? [-mm(l.speed), mm(l.speed)] : null)},
  {name: 'Force', signal: 'force', unit: 'N', digits: 2, of: (f) => f.force, stream: 'base_wrench',
    range: (l) => ('load' in l ? [-l.load, l.load] : null),
    marks: (l) => ('force' in l ? [-l.force, l.force] : []),
    more: (l) => ('force' in l ? `, commanded ±${fixed(l.force, 0)}` : '')},
  {name: 'Tracking error', signal: 'error', unit: 'mm', digits: 3, of: (f) => mm(f.error), stream: 'tracking_error',
    range: (l) => ('error' in l ? [-mm(l.error), mm(l.error)] : null)},
  {name: 'Tip x', signal: 'tip_x', unit: 'mm', digits: 2, of: (f) => (f.tip ? mm(f.tip[0]) : null), stream: 'tip_deflection',
    range: (l) => ('deflection' in l ? [-mm(l.deflection), mm(l.deflection)] : null)},
  {name: 'Tip z', signal: 'tip_z', unit: 'mm', digits: 2, of: (f) => (f.tip ? mm(f.tip[2]) : null), stream: 'tip_deflection',
    range: (l) => ('deflection' in l ? [-mm(l.deflection), mm(l.deflection)] : null)},
];

for (const one of QUANTITIES) {
  one.box = make('div');
  one.value = make('span', '–');
  one.limit = make('dd', '', 'limit');
  one.meter = make('div', '', 'meter');
  one.bar = make('i');
  one.meter.append(one.bar);
  one.meter.setAttribute('role', 'meter');
  one.meter.setAttribute('aria-label', one.name);
  const value = make('dd', '', 'value'), bar = make('dd');
  value.append(one.value, make('small', ` ${one.unit}`));
  bar.append(one.meter);
  one.box.append(make('dt', one.name), value, bar, one.limit);
  find('numbers').querySelector('dl').append(one.box);
}

/* Why a number is missing or not to be trusted: level and words, null if it is fine. */
function doubt(one) {
  const trouble = connection.trouble();
  if (trouble) return ['silent', `○ ${trouble.split(':')[0]}`];
  const fault = frame.faults[one.signal];
  /* Without a force sensor the force is the effort in joint_states. */
  const stream = one.signal === 'force' && !frame.sensed ? 'joint_states' : one.stream;
  const age = frame.silent[stream];
  const silent = age === undefined ? '' : `silent for ${fixed(age, 0)} s`;
  if (fault) return ['error', `■ ${silent}${silent && ': '}${fault}`];
  return silent ? ['silent', `○ ${silent}`] : null;
}

function show(one) {
  const value = one.of(frame), range = one.range(scene.limits), doubted = doubt(one);
  put(one.value, fixed(value, one.digits));
  one.meter.hidden = range === null;
  if (range === null) {
    const [state, words] = doubted || ['fine', 'limit unknown'];
    put(one.limit, words);
    level(one.box, state);
    return;
  }
  const [low, high] = range, share = (at) => 100 * Math.min(1, Math.max(0, (at - low) / (high - low)));
  const zero = share(0), at = share(value === null ? 0 : value);
  one.bar.style.left = `${Math.min(zero, at)}%`;
  one.bar.style.width = `${Math.max(Math.abs(at - zero), value === null ? 0 : 0.7)}%`;
  one.meter.setAttribute('aria-valuemin', low);
  one.meter.setAttribute('aria-valuemax', high);
  one.meter.setAttribute('aria-valuenow', fixed(value, one.digits));
  const marks = one.marks ? one.marks(scene.limits) : [];
  if (one.meter.children.length !== 1 + marks.length) {
    one.meter.replaceChildren(one.bar, ...marks.map(() => make('b')));
  }
  marks.forEach((mark, k) => { one.meter.children[k + 1].style.left = `${share(mark)}%`; });
  let words = low === -high ? `limit ±${fixed(high, 0)}` : `${fixed(low, 0)} to ${fixed(high, 0)}`;
  words += one.more ? one.more(scene.limits) : '';
  /* No warning near the ends of the depth range; the other limits stop the needle. */
  const used = value === null || low !== -high ? 0 : Math.abs(value) / high;
  let state = 'fine';
  if (value !== null && (value < low || value > high)) {
    state = 'error';
    words = `■ beyond ${words}`;
  } else if (used > 0.8) {
    state = 'warning';
    words = `▲ near ${words}`;
  }
  if (doubted) [state, words] = doubted;
  put(one.limit, words);
  level(one.box, state);
}

/* What the page does not show. */
function tellInvalid() {
  const words = [frame.robot];
  if (frame.invalid) words.push(`${frame.invalid} invalid messages received, which are not shown`);
  put(find('invalid'), words.filter((one) => one).join('; '));
  find('invalid').hidden = !find('invalid').textContent;
}

/* Charts. */

const charts = new needleCharts.Charts(find('strips'), find('signals'), () => frame && later(), seek);

/* The address of the page is a link to the moment and the range that it shows. */
function remember() {
  const [from, to] = charts.range().map((time) => fixed(time, 3));
  link.set('at', fixed(frame.time, 3));
  link.set('from', from);
  link.set('to', to);
  if (location.hash !== `#${link}`) window.history.replaceState(null, '', `#${link}`);
}

/* Show the moment and the range of the address. */
function follow() {
  const [at, from, to] = ['at', 'from', 'to'].map((name) => parseFloat(link.get(name)));
  if (to > from) charts.show(from, to);
  if (at >= 0) seek(at);
}

function seek(time) {
  send({play: false});
  send({at: time});
}

/* Name of exported files: recording and time. */
const named = () => `${setting.recording ? setting.recording.name : 'live'}${other ? `_and_${other.name}` : ''}_${fixed(frame.time, 2)}s`;

find('zoom-in').addEventListener('click', () => charts.zoom(needleCharts.ZOOM, frame.time));
find('zoom-out').addEventListener('click', () => charts.zoom(1 / needleCharts.ZOOM, frame.time));
find('whole').addEventListener('click', () => { charts.whole(); later(); });
find('save-picture').addEventListener('click', () => charts.savePicture(find('needle'), named()));
find('save-table').addEventListener('click', () => charts.saveTable(named()));
find('lateral').addEventListener('change', (event) => {
  drawing.lateral = Number(event.target.value);
  drawing.reset();
  later();
});

/* Status of the nodes. */

function tell(node) {
  const name = node.silent ? 'silent' : LEVELS[node.level] || 'silent';
  const item = make('li'), line = make('p');
  const state = make('strong', `${SIGNS[name]} ${node.name.replace(/^\//, '')}`);
  level(state, name);
  const words = node.silent ? `silent for ${fixed(node.age, 0)} s; last: ` : name === 'fine' ? '' : `${name}: `;
  line.append(state, words + node.words);
  item.append(line);
  if (node.steps) item.append(make('p', `step: ${node.step} of ${node.steps}`, 'more'));
  if (node.last_rejection) item.append(make('p', `last rejection: ${node.last_rejection}`, 'more'));
  return item;
}

let told = '';
function tellNodes() {
  const text = JSON.stringify(frame.nodes.map((node) => [node, Math.round(node.silent ? node.age : 0)]),
    (key, value) => (key === 'age' ? undefined : value));
  if (text !== told && frame.nodes.length) {
    told = text;
    find('nodes').querySelector('ul').replaceChildren(...frame.nodes.map(tell));
  }
}

/* The worst state of the nodes, or the state of the connection, which hides it. */
function tellState() {
  const trouble = connection.trouble();
  if (trouble || !frame) {
    level(find('state'), trouble ? 'error' : 'none');
    put(find('state'), trouble ? `■ ${trouble}` : 'no data yet');
    return;
  }
  const worst = frame.nodes.reduce((state, node) => {
    const name = node.silent ? 'silent' : LEVELS[node.level];
    const rank = ['fine', 'silent', 'warning', 'error'];
    return rank.indexOf(name) > rank.indexOf(state.name) ? {name, node} : state;
  }, {name: frame.nodes.length ? 'fine' : 'none', node: null});
  const of = worst.node ? worst.node.name.replace(/^\//, '') : '';
  const words = {
    fine: 'all nodes OK', none: 'no status received', silent: `${of} is silent`,
    warning: `warning: ${of}`, error: `error: ${of}`,
  }[worst.name];
  level(find('state'), worst.name);
  put(find('state'), `${SIGNS[worst.name]} ${words}`);
}

function tellAim() {
  const target = frame.target && frame.target[0] !== null ? frame.target : null;
  find('aimed').hidden = target === null;
  if (!target) return;
  needleDrawing.aim(find('aim'), {...frame, ...drawing.shown, target: frame.target});
  const parts = [`Target x ${fixed(mm(target[0]), 2)}, y ${fixed(mm(target[1]), 1)}, z ${fixed(mm(target[2]), 2)} mm.`];
  if (frame.expected) {
    const {at, half} = frame.expected;
    parts.push(`Predicted tip if the guide stays: x ${fixed(mm(at[0]), 2)} ± ${fixed(mm(half[0]), 2)}, z ${fixed(mm(at[2]), 2)} ± ${fixed(mm(half[1]), 2)} mm (95 %).`);
  }
  if (frame.hit_probability !== null) {
    parts.push(`Probability that moves of the guide can still hit within 1 mm: ${fixed(frame.hit_probability, 3)}.`);
  }
  put(find('reach'), parts.join(' '));
}

function tellShape() {
  const of = scene.tissue ? ` Tissue from the configuration of the node ${scene.tissue.of}.` : ' No configuration of needle and tissue received.';
  const words = frame.shape === 'straight'
    ? `The shape of the needle is not measured: the dashed line is straight from the guide to the tip.${of}`
    : frame.shape === null ? `Needle position unknown: ${frame.faults.depth || 'no joint_states received'}.` : '';
  find('shape').hidden = words === '';
  put(find('shape'), words);
  const far = drawing.left.join(', ');
  find('far').hidden = far === '';
  put(find('far'), `Not drawn, beyond ${needleDrawing.FARTHEST} mm: ${far}.`);
}

function tellCursor() {
  const of = setting.recording ? 'The recording' : 'The last 20 s';
  const time = charts.cursor === null ? null : charts.cursor - (setting.recording ? 0 : frame.time);
  put(find('span'), time === null ? of : `${of}: values at ${fixed(time, 3)} s`);
}

/* Text, numbers and charts, at a readable rate. */
function say() {
  clearTimeout(saying);
  saying = 0;
  changed = false;
  worded = performance.now();
  QUANTITIES.forEach(show);
  tellInvalid();
  tellNodes();
  tellState();
  tellAim();
  tellShape();
  tellCursor();
  charts.draw(frame.time, scene.limits);
  if (anatomy) anatomy.show(drawing.shown && drawing.shown.needle);
  if (playback) tellPlayback();
}

/* Frames. */

function draw(now) {
  waiting = false;
  if (!frame) return;
  drawnAt = now;
  drawing.draw(scene, frame);
  if (changed || now - worded > WORDS) say();
  /* Text of the last frame, too. */
  else if (!saying) saying = setTimeout(say, WORDS);
  seen.drawn += 1;
  if (unseen) send({seen: unseen});
  unseen = 0;
}

/* Draw soon; what the user has changed, in all parts. */
function later(all = true) {
  changed = changed || all;
  if (waiting) return;
  waiting = true;
  /* Two frames per second with prefers-reduced-motion. */
  const pause = calm.matches ? Math.max(0, 500 - (performance.now() - drawnAt)) : 0;
  if (pause) setTimeout(() => requestAnimationFrame(draw), pause);
  else requestAnimationFrame(draw);
}

function take(message) {
  if (message.answer) return answered(message.answer);
  if (message.setting) settle(message.setting);
  if (message.scene) scene = message.scene;
  if (message.playback) playback = message.playback;
  if (message.history) charts.live(message.history);
  if (message.signals) {
    other = message.other || null;
    find('compared').hidden = find('other').hidden = other === null;
    if (other) put(find('compared'), `Compared with ${other.words}.`);
    charts.record(message.signals, setting.recording.duration, other);
    follow();
    /* The speed of a page that was open before. */
    const speed = Number(find('speed').value);
    if (speed !== playback.speed) send({speed});
  }
  if (!message.frame) return undefined;
  frame = message.frame;
  seen.frames += 1;
  unseen += 1;
  /* Rows since the previous frame, of a page in the background. */
  (message.missed || []).forEach((row) => charts.push(row));
  if (frame.row) charts.push(frame.row);
  later(false);
  return undefined;
}

function settle(given) {
  setting = given;
  drawing.plan = setting.plan;
  for (const part of document.querySelectorAll('.plan')) part.parentElement.hidden = !setting.plan;
  drawing.reset();
  find('playback').hidden = setting.recording === null;
  find('control').hidden = !(setting.control && token);
  if (setting.control && token) send({ask: 'check', token});
  find('looking').hidden = setting.recording !== null || (setting.control && token !== '');
  // Without the token, or without --control.
  const [plain, opened] = find('looking').children;
  [plain.hidden, opened.hidden] = [setting.control, !setting.control];
  put(find('source'), setting.recording ? `recording ${setting.recording.name}` : 'live');
  if (!setting.recording) return;
  find('at').max = setting.recording.duration;
  find('at').step = 'any';
  find('losses').hidden = !setting.recording.losses.length;
  put(find('losses'), setting.recording.losses.join('; '));
}

/* Playback. */

function tellPlayback() {
  put(find('play'), playback.playing ? 'Pause' : 'Play');
  put(find('clock'), `${fixed(frame.time, 1)} of ${fixed(setting.recording.duration, 1)} s`);
  if (!dragging) find('at').value = frame.time;
  if (!playback.playing) remember();
}

find('play').addEventListener('click', () => playback && send({play: !playback.playing}));
find('speed').addEventListener('change', (event) => send({speed: Number(event.target.value)}));
find('at').addEventListener('pointerdown', () => { dragging = true; });
for (const kind of ['change', 'pointerup', 'pointercancel']) {
  find('at').addEventListener(kind, () => { dragging = false; });
}
find('at').addEventListener('input', (event) => send({at: Number(event.target.value)}));

/* Control. */

/* Commands without an answer; whether the server has accepted the token. */
const asked = new Set();
let allowed = false;

function answered({asked: what, success, words}) {
  if (what === 'check') {
    allowed = success;
    tellControl();
    if (success) return;
  }
  asked.delete(what);
  const node = find('answer'), named = what === 'check' ? '' : what;
  level(node, success ? 'fine' : 'error');
  put(node, `${success ? '●' : '■ refused'} ${named}${named && words ? ': ' : ''}${words}`);
}

/* Send a command with the time of the click: the server refuses an old one. */
function ask(what, more = {}) {
  if (!send({ask: what, token, clicked: connection.now(), ...more})) {
    answered({asked: what, success: false, words: `not sent, ${connection.trouble()}`});
    return;
  }
  asked.add(what);
  level(find('answer'), 'none');
  put(find('answer'), `○ sending ${what} …`);
}

/* Buttons that would have no effect are disabled, except Stop, which then states the reason. */
function tellControl() {
  const works = connection.open && allowed && connection.now() !== null;
  for (const button of find('control').querySelectorAll('button')) {
    button.disabled = !works && button.id !== 'stop';
  }
}

for (const button of document.querySelectorAll('[data-ask]')) {
  button.addEventListener('click', () => ask(button.dataset.ask));
}

find('target').addEventListener('submit', (event) => {
  event.preventDefault();
  const {x, y, z} = event.target.elements;
  ask('target', {at: [x, y, z].map((input) => Number(input.value) / 1e3)});
});

window.addEventListener('hashchange', () => {
  const given = new URLSearchParams(location.hash.slice(1));
  for (const name of ['at', 'from', 'to']) {
    if (given.has(name)) link.set(name, given.get(name));
  }
  if (playback) follow();
});

/* Connection. */

const send = (message) => connection.send(message);

/* The connection has opened, ended, stopped to send, or sent again. */
function connected() {
  const {open} = connection, lost = seen.connected && !open;
  if (open !== seen.connected) {
    seen.connected = open;
    unseen = 0;
    allowed = false;
    if (open) put(find('answer'), '');
  }
  document.body.classList.toggle('quiet', connection.trouble() !== '');
  tellState();
  tellControl();
  if (lost) {
    const words = [...asked].map((what) => `${what}: no answer, it may have been executed`);
    asked.clear();
    level(find('answer'), 'error');
    put(find('answer'), `■ ${[...words, connection.trouble()].join('; ')}`);
  }
  if (frame) QUANTITIES.forEach(show);
}

const connection = new needleConnection.Connection(`ws://${location.host}/frames`, take, connected);

/* The surfaces come once; null without an anatomy. */
fetch('anatomy.json').then((answer) => answer.json()).then((content) => {
  if (content) seen.anatomy = anatomy = new needleAnatomy.View(find('anatomy'), content, true);
});

new ResizeObserver(() => frame && later()).observe(document.querySelector('main'));
