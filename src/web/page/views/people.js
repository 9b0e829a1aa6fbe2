// People, their sessions, and tokens for programs: the administrator's.

import { ask, get, post } from "../api.js";
import { fill, h, table } from "../dom.js";
import { t, time, word } from "../text.js";

const ROLES = ["operator", "setter", "metrologist", "administrator"];

export function people(view, page) {
  const list = h("section.card", { id: "list" });
  const keys = h("section.card", { id: "keys" });
  fill(view, h("h1", {}, t("nav.people")), list, keys);

  const role = (chosen) => h("label", {}, t("column.role"), h("select", { name: "role" }, ROLES.map((value) => h("option", { value, selected: value === chosen }, word("role", value)))));
  const password = (required) => h("label", {}, t(required ? "password.new" : "password.change"), h("input", { name: "password", type: "password", minLength: 8, maxLength: 256, required, autocomplete: "new-password" }));

  async function load() {
    try {
      const [all, sessions] = await Promise.all([get("/people"), get("/sessions")]);
      fill(list, table(["name", "role", "enabled", "changed", ""].map((name) => name && t(`column.${name}`)), all.map((one) => ({
        cells: [one.name, word("role", one.role), one.enabled ? t("yes") : t("no"), time(one.changed), h("button", { type: "button", onclick: () => change(one) }, t("change"))],
      }))), h("div.row", {}, h("button.main", { type: "button", id: "add", onclick: add }, t("person.add"))));
      fill(keys, h("h2", {}, t("sessions")), table(["person", "kind", "label", "created", "expires", ""].map((name) => name && t(`column.${name}`)), sessions.map((one) => ({
        cells: [one.person, word("session", one.kind), one.label, time(one.created), time(one.expires), h("button", { type: "button", onclick: () => end(one) }, t("revoke"))],
      }))), h("div.row", {}, h("button", { type: "button", id: "token", onclick: () => token(all) }, t("token.add"))));
    } catch (error) {
      await page.fail(error);
    }
  }

  async function add() {
    const done = await page.ask(t("person.add"), [
      h("label", {}, t("login.name"), h("input", { name: "name", required: true, maxLength: 64, autocomplete: "off", autofocus: true })), role("operator"), password(true),
    ], { yes: t("person.add"), send: (values) => post("/people", values) });
    if (done) await load();
  }

  async function change(one) {
    const enabled = h("label.check", {}, h("input", { type: "checkbox", name: "enabled", checked: one.enabled }), t("may.log.in"));
    const done = await page.ask(one.name, [role(one.role), password(false), enabled], {
      yes: t("change"),
      send: (values) => ask("PATCH", `/people/${encodeURIComponent(one.name)}`, {
        role: values.role === one.role ? undefined : values.role,
        password: values.password || undefined,
        enabled: (values.enabled === "on") === one.enabled ? undefined : values.enabled === "on",
      }),
    });
    if (done) await load();
  }

  async function end(one) {
    try { await ask("DELETE", `/sessions/${one.id}`); await load(); } catch (error) { await page.fail(error); }
  }

  async function token(all) {
    const made = await page.ask(t("token.add"), [
      h("label", {}, t("column.person"), h("select", { name: "person" }, all.filter((one) => one.enabled).map((one) => h("option", { value: one.name }, one.name)))),
      h("label", {}, t("column.label"), h("input", { name: "label", required: true, maxLength: 100, autofocus: true })),
      h("label", {}, t("days"), h("input", { name: "days", type: "number", min: 1, max: 3650, value: 365, required: true })),
    ], { yes: t("token.add"), send: (values) => post("/tokens", { ...values, days: Number(values.days) }) });
    if (!made) return;
    await page.ask(t("token.once"), [h("p.secret", {}, made.secret)]);
    await load();
  }

  load();
  return { again: load };
}
