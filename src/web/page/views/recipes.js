// Recipes: what parts are judged by. A new version is checked, kept, and activated with a reason.

import { get, post, query } from "../api.js";
import { fill, h, say, table } from "../dom.js";
import { said, t, time } from "../text.js";

export function recipes(view, page, [id]) {
  const list = h("section.card", { id: "list" });
  const detail = h("section.card", { id: "recipe", hidden: true });
  const file = h("input", { type: "file", accept: "application/json,.json", hidden: true, onchange: () => brought(file.files[0]) });
  fill(view, h("h1", {}, t("nav.recipes")), list, detail, file);

  async function load() {
    try {
      const all = await get("/recipes");
      const rows = all.map((one) => ({
        go: `#/recipes/${one.id}`,
        cells: [h("a", { href: `#/recipes/${one.id}` }, `#${one.id}`), one.active ? h("span.badge", { "data-verdict": "ok" }, "✓ ", t("active")) : "", `${one.name} v${one.version}`, one.nominal_name, one.author, time(one.created), said(one.why)],
      }));
      fill(list, table(["id", "active", "recipe", "nominal", "author", "created", "why"].map((name) => t(`column.${name}`)), rows),
        page.may("setter") ? h("div.row", {}, h("button", { type: "button", onclick: () => file.click() }, t("import")),
          h("button", { type: "button", id: "reload", onclick: reload }, t("reload"))) : null);
      if (id) await show(Number(id));
    } catch (error) {
      await page.fail(error);
    }
  }

  async function reload() {
    try { await post("/reload"); await load(); } catch (error) { await page.fail(error); }
  }

  async function show(number) {
    const one = await get(`/recipes/${number}`);
    const setter = page.may("setter");
    const text = h("textarea", { id: "text", value: one.text, readOnly: !setter, spellcheck: false, "aria-label": t("recipe.text") });
    const found = h("div", { id: "checked", role: "status" });
    detail.hidden = false;
    fill(detail, h("h2", {}, `${one.name} v${one.version} `, one.active ? h("span.badge", { "data-verdict": "ok" }, "✓ ", t("active")) : null),
      h("p.note", {}, `SHA-256 ${one.sha256}`), text, found,
      h("div.row", {},
        setter ? h("button", { type: "button", id: "check", onclick: check }, t("check")) : null,
        setter ? h("button", { type: "button", id: "keep", onclick: keep }, t("keep")) : null,
        setter && !one.active ? h("button.main", { type: "button", id: "activate", onclick: activate }, t("activate")) : null,
        h("a.button", { href: `/api/v1/recipes/${number}/file`, download: "" }, t("export.file"))));

    async function check() {
      try {
        const result = await post("/recipes/check", { text: text.value, nominal_of: number });
        fill(found, result.ok
          ? h("p", {}, h("span.badge", { "data-verdict": "ok" }, "✓ ", t("check.ok", { edges: result.sharp_edges })))
          : h("pre", {}, result.mistakes.map(said).join("\n")));
      } catch (error) {
        await page.fail(error);
      }
    }

    async function keep() {
      const kept = await page.ask(t("keep"), why(), { yes: t("keep"), send: (values) => post("/recipes", { name: one.name, text: text.value, nominal_of: number, why: values.why }) });
      if (kept) location.hash = `#/recipes/${kept.id}`;
    }

    async function activate() {
      const done = await page.ask(t("activate"), [h("p", {}, `${one.name} v${one.version}`), why()], { yes: t("activate"), send: (values) => post(`/recipes/${number}/activate`, { why: values.why }) });
      if (done) await load();
    }
  }

  const why = () => h("label", {}, t("why"), h("input", { name: "why", id: "why", required: true, maxLength: 500, autocomplete: "off", autofocus: true }));

  async function brought(chosen) {
    if (!chosen) return;
    try {
      const sent = JSON.parse(await chosen.text());
      const kept = await page.ask(t("import"), why(), { yes: t("import"), send: (values) => post(`/recipes/import${query({ why: values.why })}`, sent) });
      if (kept) location.hash = `#/recipes/${kept.id}`;
    } catch (error) {
      if (error instanceof SyntaxError) say(list.appendChild(h("p.bad", { role: "alert" })), t("no.recipe.file"));
      else await page.fail(error);
    } finally {
      file.value = "";
    }
  }

  load();
  return { again: load };
}
