'use strict';
// The edges in three dimensions: drag or arrow keys turn, + and - zoom, 0 resets. Without this script the drawing stays.
(() => {
  const box = document.getElementById('view');
  const drawing = document.getElementById('drawing');
  const data = JSON.parse(document.getElementById('view-data').textContent);
  const canvas = document.createElement('canvas');
  const pen = canvas.getContext && canvas.getContext('2d');
  if (!pen || !data.edges.length) return;
  canvas.tabIndex = 0;
  canvas.setAttribute('role', 'img');
  canvas.setAttribute('aria-label', drawing.getAttribute('aria-label') +
    ' ' + data.words.keys);
  canvas.className = 'live';
  box.prepend(canvas);
  drawing.setAttribute('hidden', '');
  document.getElementById('view-factor').hidden = true;
  const tools = document.getElementById('view-tools');
  tools.hidden = false;
  const readout = document.getElementById('view-readout');
  const slider = document.getElementById('view-scale');
  const shown = document.getElementById('view-scale-shown');

  // Yaw and pitch of the drawing, so that nothing jumps.
  const HOME = { yaw: data.yaw, pitch: data.pitch, zoom: 1 };
  const VIEWS = { home: HOME, front: { yaw: 0, pitch: 0, zoom: 1 }, side: { yaw: Math.PI / 2, pitch: 0, zoom: 1 },
    top: { yaw: 0, pitch: Math.PI / 2, zoom: 1 } };
  let eye = { ...HOME }, factor = data.factor, picked = null;
  const words = data.words;
  const filled = (text, values) => text.replace(/\{(\w+)\}/g, (_, name) => values[name]);
  const looks = { ok: [2.4, []], not_ok: [4.6, []], not_decidable: [3.2, [7, 5]], undefined: [2.4, []], gap: [2, [1, 5]] };
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();

  // Right, up and away of a direction, as seen from yaw and pitch.
  function seen(x, y, z) {
    const cy = Math.cos(eye.yaw), sy = Math.sin(eye.yaw), cp = Math.cos(eye.pitch), sp = Math.sin(eye.pitch);
    const away = cy * y - sy * x;
    return [cy * x + sy * y, cp * z + sp * away, cp * away - sp * z];
  }

  // Half the width and height of the part from its centre, as first shown: at zoom 1 it fills the canvas.
  const reach = data.edges.flatMap(edge => edge.xyz).reduce((most, p) => {
    const [right, up] = seen(...p.map((v, i) => v - data.centre[i]));
    return [Math.max(most[0], Math.abs(right)), Math.max(most[1], Math.abs(up))];
  }, [1e-9, 1e-9]);

  function projection() {
    const w = canvas.clientWidth, h = canvas.clientHeight, c = data.centre;
    const k = eye.zoom * Math.min((w / 2 - 36) / reach[0], (h / 2 - 36) / reach[1]);
    return (x, y, z) => {
      const [right, up, away] = seen(x - c[0], y - c[1], z - c[2]);
      return [w / 2 + k * right, h / 2 - k * up, away];
    };
  }

  function path(points) {
    pen.beginPath();
    points.forEach((p, i) => (i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
    pen.stroke();
  }

  function drawEdge(edge, at, ink) {
    const near = edge.xyz.map(p => at(...p));
    const depth = near.reduce((sum, p) => sum + p[2], 0) / near.length / data.radius;
    const fade = Math.max(0.45, Math.min(1, 0.8 - 0.35 * depth));
    pen.globalAlpha = 0.55 * fade;
    pen.strokeStyle = ink; pen.lineWidth = 0.8; pen.setLineDash([]);
    let tips = [];
    const flush = () => { if (tips.length > 1) { pen.globalAlpha = 0.9 * fade; path(tips); } tips = []; pen.globalAlpha = 0.55 * fade; };
    edge.off.forEach((off, i) => {
      if (!off) { flush(); return; }
      const p = edge.xyz[i + edge.first];
      const tip = at(p[0] + factor * off[0], p[1] + factor * off[1], p[2] + factor * off[2]);
      path([near[i + edge.first], tip]);
      tips.push(tip);
    });
    flush();
    pen.globalAlpha = fade;
    edge.runs.forEach(([state, from, to]) => {
      const [width, dash] = looks[state];
      pen.strokeStyle = colour(state === 'undefined' ? 'line' : state); pen.lineWidth = width; pen.setLineDash(dash);
      path(near.slice(from, to + 1));
    });
    pen.globalAlpha = 1; pen.setLineDash([]);
    return near[near.length >> 1];
  }

  function drawAxes(ink) {
    const x0 = 38, y0 = canvas.clientHeight - 38;
    pen.lineWidth = 1.5; pen.strokeStyle = pen.fillStyle = ink; pen.font = '12px system-ui, sans-serif';
    [['x', 1, 0, 0], ['y', 0, 1, 0], ['z', 0, 0, 1]].forEach(([name, x, y, z]) => {
      const [right, up] = seen(x, y, z);
      path([[x0, y0], [x0 + 26 * right, y0 - 26 * up]]);
      pen.fillText(name, x0 + 34 * right - 3, y0 - 34 * up + 4);
    });
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * ratio)) canvas.width = Math.round(w * ratio);
    if (canvas.height !== Math.round(h * ratio)) canvas.height = Math.round(h * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    pen.lineCap = pen.lineJoin = 'round';
    const at = projection(), ink = colour('ink'), card = colour('card');
    const labels = data.edges.map(edge => [edge, drawEdge(edge, at, ink)]);
    pen.strokeStyle = colour('not_ok'); pen.lineWidth = 2; pen.setLineDash([2, 4]);
    data.unexpected.forEach(line => path(line.map(p => at(...p))));
    pen.setLineDash([]);
    pen.font = '700 14px system-ui, sans-serif'; pen.textAlign = 'center';
    labels.forEach(([edge, p]) => {
      pen.strokeStyle = card; pen.lineWidth = 4; pen.strokeText(edge.name, p[0], p[1] - 8);
      pen.fillStyle = colour(edge.verdict === 'undefined' ? 'line' : edge.verdict);
      pen.fillText(edge.name, p[0], p[1] - 8);
    });
    pen.textAlign = 'start';
    drawAxes(colour('soft'));
    if (picked) {
      const p = at(...picked.xyz);
      pen.strokeStyle = ink; pen.lineWidth = 2; pen.beginPath(); pen.arc(p[0], p[1], 7, 0, 7); pen.stroke();
    }
    shown.textContent = '× ' + factor;
  }

  function pick(x, y) {
    const at = projection();
    let best = 18, found = null;
    data.edges.forEach(edge => edge.off.forEach((off, i) => {
      const xyz = edge.xyz[i + edge.first], p = at(...xyz), gap = Math.hypot(p[0] - x, p[1] - y);
      if (gap < best) { best = gap; found = { edge, i, xyz }; }
    }));
    picked = found;
    if (!found) { readout.textContent = words.point; return; }
    const said = found.edge.say[found.i];
    const run = found.edge.runs.find(r => found.i + found.edge.first >= r[1] && found.i + found.edge.first < r[2]) || found.edge.runs.at(-1);
    readout.textContent = filled(words.at, { edge: found.edge.id, s: said[0] }) +
      (said.length > 1 ? filled(words.values, { d1: said[1], d2: said[2] }) : '') + words[run[0]];
  }

  let held = null;
  canvas.addEventListener('pointerdown', e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener('pointerup', () => { held = null; });
  canvas.addEventListener('pointercancel', () => { held = null; });
  canvas.addEventListener('pointermove', e => {
    if (held) {
      turn((e.clientX - held[0]) * 0.008, (e.clientY - held[1]) * 0.008);
      held = [e.clientX, e.clientY];
    } else {
      const r = canvas.getBoundingClientRect();
      pick(e.clientX - r.left, e.clientY - r.top);
    }
    draw();
  });
  function turn(yaw, pitch) {
    eye.yaw -= yaw;
    eye.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, eye.pitch + pitch));
  }
  const zoom = by => { eye.zoom = Math.max(0.3, Math.min(12, eye.zoom * by)); };
  canvas.addEventListener('wheel', e => {
    if (document.activeElement !== canvas) return;
    e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015)); draw();
  }, { passive: false });
  const KEYS = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1),
    ArrowDown: () => turn(0, 0.1), '+': () => zoom(1.2), '=': () => zoom(1.2), '-': () => zoom(1 / 1.2), '0': () => { eye = { ...HOME }; } };
  canvas.addEventListener('keydown', e => { if (KEYS[e.key]) { KEYS[e.key](); e.preventDefault(); draw(); } });
  tools.addEventListener('click', e => {
    const view = VIEWS[e.target.dataset.view];
    if (view) { eye = { ...view }; draw(); }
    if (e.target.dataset.zoom) { zoom(Number(e.target.dataset.zoom)); draw(); }
  });
  const steps = [0, ...data.factors];
  slider.max = steps.length - 1; slider.value = steps.indexOf(data.factor);
  slider.addEventListener('input', () => { factor = steps[slider.value]; draw(); });
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', draw);
  new ResizeObserver(draw).observe(canvas);
  readout.textContent = words.point;
  draw();
})();
