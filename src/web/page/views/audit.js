// The audit log: who did what, and what it was before. Nothing in it can be changed.

import { get, query } from "../api.js";
import { fill, h, table } from "../dom.js";
import { t, time } from "../text.js";

export function audit(view, page) {
  const list = h("section.card", { id: "list" });
  let ends = [];
  fill(view, h("h1", {}, t("nav.audit")), list);

  /** The beginning of a hash tells it from others; the whole is in the hint. */
  const short = (text) => h("span", { title: text }, text.replace(/[0-9a-f]{64}/g, (hash) => `${hash.slice(0, 12)}…`) || "–");

  async function load() {
    try {
      const found = await get(`/audit${query({ before: ends.at(-1), limit: 50 })}`);
      const rows = found.items.map((one) => ({ cells: [String(one.id), time(one.at), one.person, one.action, one.subject, short(one.old), short(one.new), one.why || "–"] }));
      fill(list, table(["id", "at", "person", "action", "subject", "old", "new", "why"].map((name) => t(`column.${name}`)), rows),
        h("div.row", {},
          h("button", { type: "button", id: "newer", disabled: !ends.length, onclick: () => { ends.pop(); load(); } }, t("newer")),
          h("button", { type: "button", id: "older", disabled: found.next === null, onclick: () => { ends.push(found.next); load(); } }, t("older"))));
    } catch (error) {
      await page.fail(error);
    }
  }

  load();
  return { again: load };
}
