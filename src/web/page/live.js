// The scan as it grows: the newest profile of every device, and the points seen from the side. Drag to turn.

import { get } from "./api.js";
import { h } from "./dom.js";
import { t } from "./text.js";

/** Between two looks at the daemon, ms: quick enough to look alive, slow enough for a tablet. */
const EVERY_MS = 250;
/** And so many times as long as drawing took, which takes the browser as long again: an eighth of a processor, which may be the one that computes the verdict. */
const REST = 15;
/** After the scan the verdict is computed, perhaps on the machine that shows the page: the last look waits for it, ms. */
const LAST_MS = 600;
/** A frame of numbers does not move when nothing new came: the picture is drawn only then. */
const HUES = ["--line-1", "--line-2", "--line-3", "--line-4"];

/** Both pictures; `run(true)` begins to follow, `end()` ends it. */
export function livePictures() {
  const profile = h("canvas", { role: "img", "aria-label": t("live.profile") });
  const cloud = h("canvas", { role: "img", "aria-label": t("live.points") });
  const amount = h("span.note", { id: "live-points" });
  const element = h("div.live", {},
    h("figure", {}, profile, h("figcaption", {}, t("live.profile"))),
    h("figure", {}, cloud, h("figcaption", {}, t("live.points"), " ", amount)));
  const points = new Points(cloud);
  const edges = edgesSoFar();
  element.append(edges.element);
  let timer = 0;
  let ended = false;
  // Nothing yet: the first look shows the scan that ran last.
  let running = null;
  const look = async () => {
    let busy = 0;
    try {
      const [profiles, stations] = await Promise.all([get("/live/profiles"), edges.fetch(), points.fetch()]);
      const began = performance.now();
      // What is measured in the end stands in the result.
      edges.element.hidden = !running || stations.length === 0;
      points.stations = running ? stations : [];
      drawProfiles(profile, profiles);
      points.draw();
      amount.textContent = t("live.amount", { count: points.shown.toLocaleString(document.documentElement.lang) });
      busy = performance.now() - began;
    } catch { /* the banner says that the daemon is away */ }
    if (!ended && running) timer = setTimeout(look, Math.max(EVERY_MS, REST * busy));
  };
  return {
    element,
    run(now) {
      if (now === running) return;
      const before = running;
      running = now;
      clearTimeout(timer);
      // Once more at the end: the last points came after the last look.
      if (before && !now) timer = setTimeout(look, LAST_MS);
      else look();
    },
    end() {
      ended = true;
      clearTimeout(timer);
    },
  };
}

/** The edges as they are measured so far, those farthest off first; `fetch()` gives the places of their stations. */
function edgesSoFar() {
  const rows = h("tbody");
  const head = ["edge", "coverage", "mean", "worst"].map((key) => h("th", { scope: "col" }, t(`live.${key}`)));
  const element = h("table.edges", { id: "live-edges", hidden: true },
    h("caption", {}, t("live.edges")), h("thead", {}, h("tr", {}, ...head)), rows);
  let known = { inspection: 0, number: 0 };
  let stations = [];
  const digits = (value) => value.toLocaleString(document.documentElement.lang, { minimumFractionDigits: 3, maximumFractionDigits: 3 });
  const share = (value) => value.toLocaleString(document.documentElement.lang, { style: "percent" });
  const row = (edge) => h("tr", {},
    h("th", { scope: "row" }, edge.id),
    h("td.number", {}, share(edge.coverage)),
    h("td.number", {}, edge.mean_d_mm ? edge.mean_d_mm.map(digits).join(" / ") : "–"),
    h("td.number", {}, edge.worst_d_mm === null || edge.worst_d_mm === undefined ? "–" : digits(edge.worst_d_mm)));
  return {
    element,
    async fetch() {
      const now = await get(`/live/edges?inspection=${known.inspection}&number=${known.number}`);
      if (now.inspection === known.inspection && now.number === known.number) return stations;
      known = now;
      const seen = now.edges.filter((edge) => edge.coverage > 0);
      seen.sort((a, b) => Math.abs(b.worst_d_mm) - Math.abs(a.worst_d_mm));
      rows.replaceChildren(...seen.map(row));
      stations = seen.flatMap((edge) => edge.stations);
      return stations;
    },
  };
}

/** A canvas as large as it is shown; gives its context and size in pixels of the screen. */
function surface(canvas) {
  const scale = Math.min(devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(canvas.clientWidth * scale));
  const height = Math.max(1, Math.round(canvas.clientHeight * scale));
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  return { context: canvas.getContext("2d"), width, height, scale };
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function drawProfiles(canvas, profiles) {
  const { context, width, height, scale } = surface(canvas);
  const seen = profiles.filter((profile) => profile.z_mm.some((z) => z !== null));
  // Behind the part nothing is in view: the last profile of the part stays.
  if (!seen.length) return;
  context.clearRect(0, 0, width, height);
  const strip = height / seen.length;
  context.font = `${13 * scale}px system-ui, sans-serif`;
  seen.forEach((profile, index) => {
    const xs = profile.x_mm.filter((_, column) => profile.z_mm[column] !== null);
    const zs = profile.z_mm.filter((z) => z !== null);
    const [left, right] = [Math.min(...xs), Math.max(...xs)];
    const [near, far] = [Math.min(...zs), Math.max(...zs)];
    const edge = 10 * scale;
    const zoom = Math.min((width - 2 * edge) / Math.max(right - left, 1e-3), (strip - 3 * edge) / Math.max(far - near, 1e-3));
    const x = (value) => width / 2 + (value - (left + right) / 2) * zoom;
    const y = (value) => strip * index + strip / 2 + edge / 2 + (value - (near + far) / 2) * zoom;
    context.fillStyle = colour("--text");
    context.fillText(profile.device, edge, strip * index + 15 * scale);
    context.fillStyle = colour(HUES[index % HUES.length]);
    const size = 1.5 * scale;
    profile.z_mm.forEach((z, column) => {
      if (z !== null) context.fillRect(x(profile.x_mm[column]) - size / 2, y(z) - size / 2, size, size);
    });
  });
}

/** The points, drawn into pixels by height. */
class Points {
  constructor(canvas) {
    this.canvas = canvas;
    this.generation = 0;
    this.shown = 0;
    this.values = new Float32Array(3 * 1024);
    this.low = [];
    this.high = [];
    this.turn = -0.6;
    this.tilt = 0.9;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.from = [event.clientX, event.clientY];
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.from || !event.buttons) return;
      this.turn += (event.clientX - this.from[0]) / 150;
      this.tilt = Math.min(Math.PI / 2, Math.max(0, this.tilt + (event.clientY - this.from[1]) / 150));
      this.from = [event.clientX, event.clientY];
      this.draw();
    });
  }

  async fetch() {
    const answer = await fetch(`/api/v1/live/points?generation=${this.generation}&from=${this.shown}`);
    if (!answer.ok) return;
    const from = Number(answer.headers.get("Acies-From"));
    this.generation = Number(answer.headers.get("Acies-Generation"));
    const bytes = await answer.arrayBuffer();
    const view = new DataView(bytes);
    const count = bytes.byteLength / 4;
    if (this.values.length < from * 3 + count) {
      const larger = new Float32Array(2 * (from * 3 + count));
      larger.set(this.values.subarray(0, from * 3));
      this.values = larger;
    }
    if (from === 0) [this.low, this.high] = [Array(3).fill(Infinity), Array(3).fill(-Infinity)];
    for (let index = 0; index < count; index += 1) {
      const value = view.getFloat32(4 * index, true);
      const axis = index % 3;
      this.values[from * 3 + index] = value;
      if (value < this.low[axis]) this.low[axis] = value;
      if (value > this.high[axis]) this.high[axis] = value;
    }
    this.shown = from + count / 3;
  }

  draw() {
    const { context, width, height, scale } = surface(this.canvas);
    context.clearRect(0, 0, width, height);
    if (!this.shown) return;
    const { values, shown, low, high } = this;
    const middle = low.map((value, axis) => (value + high[axis]) / 2);
    const zoom = 0.92 * Math.min(width, height * 1.2) / Math.max(Math.hypot(...high.map((value, axis) => value - low[axis])), 1e-3);
    const [sine, cosine] = [Math.sin(this.turn), Math.cos(this.turn)];
    const [rise, flat] = [Math.sin(this.tilt), Math.cos(this.tilt)];
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const depth = new Float32Array(width * height).fill(-Infinity);
    const tall = Math.max(high[2] - low[2], 1e-3);
    const size = Math.max(1, Math.round(scale));
    for (let index = 0; index < shown; index += 1) {
      const x = values[3 * index] - middle[0];
      const y = values[3 * index + 1] - middle[1];
      const z = values[3 * index + 2] - middle[2];
      const across = x * cosine - y * sine;
      const along = x * sine + y * cosine;
      const towards = -along * flat + z * rise;
      const px = Math.round(width / 2 + across * zoom);
      const py = Math.round(height / 2 - (along * rise + z * flat) * zoom);
      const shade = SHADES[Math.round((values[3 * index + 2] - low[2]) / tall * (SHADES.length - 1))];
      for (let dy = 0; dy < size; dy += 1) {
        for (let dx = 0; dx < size; dx += 1) {
          const place = (py + dy) * width + px + dx;
          if (px + dx < 0 || px + dx >= width || py + dy < 0 || py + dy >= height || depth[place] > towards) continue;
          depth[place] = towards;
          pixels[place] = shade;
        }
      }
    }
    context.putImageData(image, 0, 0);
    // The measured stations lie over the points: an edge is seen where it is thin.
    context.fillStyle = colour("--accent");
    for (const [sx, sy, sz] of this.stations ?? []) {
      const [x, y, z] = [sx - middle[0], sy - middle[1], sz - middle[2]];
      const along = x * sine + y * cosine;
      const px = width / 2 + (x * cosine - y * sine) * zoom;
      const py = height / 2 - (along * rise + z * flat) * zoom;
      context.fillRect(px - 1.5 * scale, py - 1.5 * scale, 3 * scale, 3 * scale);
    }
  }
}

// From dark blue over teal to yellow: lighter is higher, also where colours cannot be told apart.
const STOPS = [[49, 78, 140], [38, 130, 142], [60, 170, 110], [222, 200, 60]];

const SHADES = Uint32Array.from({ length: 256 }, (_, index) => hue(index / 256));

function hue(share) {
  const place = share * (STOPS.length - 1);
  const [below, above] = [STOPS[Math.floor(place)], STOPS[Math.floor(place) + 1]];
  const part = place % 1;
  const [r, g, b] = below.map((value, index) => Math.round(value + (above[index] - value) * part));
  return (255 << 24) | (b << 16) | (g << 8) | r;
}
