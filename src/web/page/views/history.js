// All inspections, newest first; found by part, order and verdict.

import { get, query } from "../api.js";
import { fill, h, table } from "../dom.js";
import { t, time, word } from "../text.js";
import { badge, because, outcome } from "../verdict.js";

export function history(view, page) {
  const serial = h("input", { name: "part_serial", id: "find-serial", type: "search", autocomplete: "off" });
  const order = h("input", { name: "order_number", id: "find-order", type: "search", autocomplete: "off" });
  const verdict = h("select", { name: "verdict", id: "find-verdict" }, h("option", { value: "" }, t("all")),
    ["ok", "not_ok", "not_decidable", "undefined"].map((value) => h("option", { value }, word("verdict", value))));
  const list = h("section.card", { id: "list" });
  // The ends of the pages before this one: going back is reading them again.
  let ends = [];
  let newest = null;

  const asked = () => ({ serial_prefix: serial.value.trim(), order_number: order.value.trim(), verdict: verdict.value });
  const find = (event) => { event?.preventDefault(); ends = []; load(); };
  const exported = (form) => { location.href = `/api/v1/export${query({ ...asked(), form })}`; };
  fill(view, h("h1", {}, t("nav.history")),
    h("form.card.find", { role: "search", onsubmit: find },
      h("label", {}, t("serial"), serial), h("label", {}, t("order"), order), h("label", {}, t("column.verdict"), verdict),
      h("button.main", { type: "submit" }, t("find")),
      h("button", { type: "button", onclick: () => exported("csv") }, t("export.csv")),
      h("button", { type: "button", onclick: () => exported("jsonl") }, t("export.jsonl"))),
    list);
  verdict.addEventListener("change", find);

  async function load() {
    try {
      const found = await get(`/inspections${query({ ...asked(), before: ends.at(-1), limit: 25 })}`);
      const rows = found.items.map((one) => ({
        go: `#/inspection/${one.id}`,
        cells: [h("a", { href: `#/inspection/${one.id}` }, `#${one.id}`), badge(outcome(one)), one.part_serial, one.order_number, time(one.requested), word("purpose", one.purpose), one.operator, because(one)],
      }));
      const heads = ["id", "verdict", "serial", "order", "requested", "purpose", "operator", "reason"].map((name) => t(`column.${name}`));
      fill(list, rows.length ? table(heads, rows) : h("p", {}, t("nothing.found")),
        h("div.row", {},
          h("button", { type: "button", id: "newer", disabled: !ends.length, onclick: () => { ends.pop(); load(); } }, t("newer")),
          h("button", { type: "button", id: "older", disabled: found.next === null, onclick: () => { ends.push(found.next); load(); } }, t("older"))));
    } catch (error) {
      await page.fail(error);
    }
  }

  load();
  return {
    told(snapshot) {
      const last = snapshot.last ? `${snapshot.last.id} ${snapshot.last.phase}` : "";
      if (newest !== null && newest !== last && !ends.length) load();
      newest = last;
    },
    again: load,
  };
}
