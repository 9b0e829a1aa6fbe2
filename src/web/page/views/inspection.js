// One inspection: the verdict in words, the worst first, the report with the part that can be turned.

import { get } from "../api.js";
import { fill, h, table } from "../dom.js";
import { bytes, count, number, said, spoken, t, time, word } from "../text.js";
import { advised, badge, because, limits, outcome, SIGNS, valued, worstFirst } from "../verdict.js";

export function inspection(view, page, [id]) {
  let shown = null;

  async function load() {
    try {
      const found = await get(`/inspections/${Number(id)}`);
      if (JSON.stringify(found) === shown) return;
      shown = JSON.stringify(found);
      await show(found);
    } catch (error) {
      await page.fail(error);
    }
  }

  async function show(found) {
    const value = outcome(found);
    const facts = [
      ["serial", found.part_serial], ["order", found.order_number || "–"], ["purpose", word("purpose", found.purpose)],
      ["operator", found.operator], ["requested", time(found.requested)], ["ended", time(found.ended)],
      ["points", count(found.points)], ["scan.seconds", number(found.scan_seconds, 1)],
      ["verdict.seconds", number(found.verdict_seconds, 1)], ["recipe", found.recipe_id ? h("a", { href: `#/recipes/${found.recipe_id}` }, `#${found.recipe_id}`) : "–"],
      ["remeasure", found.remeasure_of ? h("a", { href: `#/inspection/${found.remeasure_of}` }, `#${found.remeasure_of}`) : "–"],
      ["raw", found.scan_bytes === null ? "–" : bytes(found.scan_bytes)],
    ];
    const base = `/api/v1/inspections/${found.id}`;
    const done = found.phase === "done";
    const link = (to, name) => h("a.button", { href: `${base}/${to}`, download: "" }, name);
    fill(view,
      h("section.board.slim", { "data-verdict": value },
        h("p.big", {}, h("span.sign", { "aria-hidden": "true" }, SIGNS[value] ?? "…"), h("span", { id: "verdict" }, word("verdict.big", value))),
        h("p.part", {}, `#${found.id} · ${found.part_serial}`), h("p.reason", { id: "reason" }, because(found))),
      h("section.card", {},
        h("dl.facts", {}, facts.map(([name, fact]) => h("div", {}, h("dt", {}, t(`fact.${name}`)), h("dd", {}, fact)))),
        h("div.row", {}, done ? [link("report.json", "JSON"), link("report.csv", "CSV"), link(`report.html?language=${spoken()}`, "HTML")] : null,
          found.scan_bytes === null ? null : [link("scan.ply", "PLY"), link("scan.raw", t("raw.file"))])));
    if (!done) return;
    const frame = h("iframe", { src: `${base}/report.html?language=${spoken()}`, title: t("report.frame"), id: "report" });
    const worst = h("section.card", {});
    view.append(worst, h("section.card", {}, h("h2", {}, t("report.frame")), frame));
    const report = await get(`/inspections/${found.id}/report.json`);
    const judged = worstFirst(report);
    const rows = judged.slice(0, 40).map((one) => ({ cells: [badge(one.verdict), one.edge, word("quantity", one.quantity), valued(one), limits(one), said(one.reason)] }));
    fill(worst, h("h2", {}, t("worst.first")), report.advice ? h("p", {}, advised(report)) : null,
      table(["verdict", "edge", "quantity", "value", "limits", "reason"].map((name) => t(`column.${name}`)), rows, [3, 4]),
      judged.length > 40 ? h("p.note", {}, t("more.in.report", { count: judged.length - 40 })) : null,
      report.findings.length ? [h("h3", {}, t("findings")), h("ul", {}, report.findings.map((finding) => h("li", {}, said(finding))))] : null);
  }

  load();
  return { told: (snapshot) => { if (snapshot.last?.id === Number(id)) load(); }, again: load };
}
