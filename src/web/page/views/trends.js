// Control chart of one characteristic: values with their uncertainty, limits, control limits, capability.

import { get, query } from "../api.js";
import { fill, h, svg, table } from "../dom.js";
import { number, signed, t, time } from "../text.js";
import { badge, digits, worstFirst } from "../verdict.js";

const [WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [1200, 420, 80, 130, 20, 40];

export function trends(view, page, [wanted]) {
  const which = h("select", { id: "characteristic" });
  const amount = h("select", { id: "amount" }, [25, 50, 100, 250, 500].map((value) => h("option", { value, selected: value === 100 }, String(value))));
  const everything = h("input", { type: "checkbox", id: "everything" });
  const chart = h("section.card", { id: "chart" });
  let newest = null;
  fill(view, h("h1", {}, t("nav.trends")),
    h("section.card", {}, h("div.find", {},
      h("label", {}, t("characteristic"), which), h("label", {}, t("last.values"), amount),
      h("label.check", {}, everything, t("everything")))),
    chart);
  which.addEventListener("change", () => { location.replace(`#/trends/${encodeURIComponent(which.value)}`); });
  for (const field of [amount, everything]) field.addEventListener("change", load);

  async function names() {
    try {
      const all = await get("/characteristics");
      all.sort(new Intl.Collator(undefined, { numeric: true }).compare);
      const chosen = all.includes(wanted) ? wanted : await worst();
      fill(which, all.map((name) => h("option", { value: name, selected: name === chosen }, name)));
      // Nothing of a simulated cell counts: there, everything is what there is to see.
      everything.checked = Boolean(page.snapshot?.simulated);
      await load();
    } catch (error) {
      await page.fail(error);
    }
  }

  /** Where nobody asks for another one: what is worst at the last part. */
  async function worst() {
    const last = page.snapshot?.last;
    if (last?.phase !== "done") return null;
    return worstFirst(await get(`/inspections/${last.id}/report.json`)).find((found) => found.value !== null)?.id;
  }

  async function load() {
    if (!which.value) return fill(chart, h("p", {}, t("nothing.measured")));
    try {
      show(await get(`/trends/${encodeURIComponent(which.value)}${query({ limit: amount.value, everything: everything.checked })}`));
    } catch (error) {
      await page.fail(error);
    }
  }

  function show(trend) {
    const unit = trend.unit === "deg" ? "°" : trend.unit;
    const places = digits(trend.unit);
    const s = trend.statistics;
    const facts = s && [
      ["count", String(s.count)], ["mean", `${signed(s.mean, places + 1)} ${unit}`], ["sigma", `${number(s.sigma_within, places + 1)} ${unit}`],
      ["overall", `${number(s.sigma_overall, places + 1)} ${unit}`], ["cp", number(s.cp, 2)], ["cpk", number(s.cpk, 2)], ["pp", number(s.pp, 2)], ["ppk", number(s.ppk, 2)],
      ["outside", String(s.outside)],
    ];
    const rows = trend.points.toReversed().slice(0, 50).map((point) => ({
      go: `#/inspection/${point.id}`,
      cells: [h("a", { href: `#/inspection/${point.id}` }, `#${point.id}`), badge(point.verdict), point.part_serial, time(point.ended), signed(point.value, places), number(point.u === null ? null : 2 * point.u, places)],
    }));
    fill(chart,
      trend.points.length ? drawn(trend) : h("p", {}, t(everything.checked ? "nothing.measured" : "nothing.counts")),
      facts ? h("dl.facts", {}, facts.map(([name, value]) => h("div", {}, h("dt", {}, t(`statistics.${name}`)), h("dd", { id: `statistics-${name}` }, value)))) : null,
      facts ? h("p.note", {}, t("statistics.source")) : null,
      rows.length ? table([t("column.id"), t("column.verdict"), t("column.serial"), t("column.ended"), `${t("column.value")} (${unit})`, "± U (k = 2)"], rows, [4, 5]) : null);
  }

  names();
  return {
    told(snapshot) {
      if (newest !== null && snapshot.last?.id !== newest) load();
      newest = snapshot.last?.id ?? 0;
    },
    again: load,
  };
}

function drawn(trend) {
  const points = trend.points;
  const s = trend.statistics;
  const lines = [
    ["limit", trend.upper, t("limit.upper")], ["limit", trend.lower, t("limit.lower")],
    ["control", s?.control_upper, t("control.upper")], ["control", s?.control_lower, t("control.lower")], ["mean", s?.mean, t("statistics.mean")],
  ].filter(([, value]) => value !== null && value !== undefined);
  const all = [...points.filter((point) => point.value !== null).flatMap((point) => [point.value - 2 * (point.u ?? 0), point.value + 2 * (point.u ?? 0)]), ...lines.map(([, value]) => value)];
  if (!all.length) return h("p", {}, t("nothing.measured"));
  let [low, high] = [Math.min(...all), Math.max(...all)];
  const margin = Math.max((high - low) * 0.06, 1e-6);
  [low, high] = [low - margin, high + margin];
  const x = (index) => LEFT + (index + 0.5) * (WIDTH - LEFT - RIGHT) / points.length;
  const y = (value) => TOP + (high - value) / (high - low) * (HEIGHT - TOP - BOTTOM);
  const places = digits(trend.unit);
  const ticks = Array.from({ length: 5 }, (_, index) => low + (index + 0.5) * (high - low) / 5);
  const path = points.map((point, index) => (point.value === null ? null : `${x(index)},${y(point.value)}`)).filter(Boolean).join(" ");
  const out = (point) => s && (point.value > s.control_upper || point.value < s.control_lower) || point.verdict === "not_ok";
  const radius = points.length > 120 ? 3 : 6;
  const mark = (point, index) => {
    if (point.value === null) return svg("text", { x: x(index), y: HEIGHT - BOTTOM + 2, "text-anchor": "middle", class: "soft" }, "∅");
    const spread = 2 * (point.u ?? 0);
    const [cx, cy] = [x(index), y(point.value)];
    // Outside is another shape, not another colour alone.
    const shape = out(point)
      ? svg("rect", { x: cx - radius, y: cy - radius, width: 2 * radius, height: 2 * radius, transform: `rotate(45 ${cx} ${cy})`, class: "dot out" })
      : svg("circle", { cx, cy, r: radius, class: "dot" });
    return svg("a", { href: `#/inspection/${point.id}` },
      svg("line", { x1: cx, x2: cx, y1: y(point.value - spread), y2: y(point.value + spread), class: "spread" }), shape,
      svg("title", {}, `#${point.id} ${point.part_serial}: ${signed(point.value, places)} ${trend.unit}`));
  };
  // Names of lines that would lie on each other move apart.
  const labels = lines.map(([, value, name]) => ({ at: y(value), name })).sort((a, b) => a.at - b.at);
  labels.forEach((label, index) => { if (index) label.at = Math.max(label.at, labels[index - 1].at + 15); });
  return svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, class: "chart", role: "img", "aria-label": `${t("nav.trends")}: ${trend.name}` },
    ticks.map((value) => [svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value), class: "grid" }), svg("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end", class: "soft" }, signed(value, places))]),
    lines.map(([kind, value]) => svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value), class: kind })),
    labels.map((label) => svg("text", { x: WIDTH - RIGHT + 8, y: label.at + 4 }, label.name)),
    svg("polyline", { points: path, class: "path" }),
    points.map(mark),
    svg("text", { x: LEFT, y: HEIGHT - 10, class: "soft" }, `#${points[0].id}`),
    svg("text", { x: WIDTH - RIGHT, y: HEIGHT - 10, "text-anchor": "end", class: "soft" }, `#${points.at(-1).id}`));
}
