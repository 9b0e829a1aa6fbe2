// Devices and health: who answers, since when, what was lost, when calibration is due, how full the disk is.

import { get, post } from "../api.js";
import { fill, h } from "../dom.js";
import { bytes, count, number, said, t, time, word } from "../text.js";

const SIGNS = { ready: "✓", busy: "…", connecting: "…", failed: "✕" };

export function devices(view, page) {
  const list = h("div", { id: "devices" });
  const health = h("dl.facts", { id: "health" });
  const backup = h("button", { type: "button", id: "backup", onclick: make }, t("backup"));
  fill(view, h("h1", {}, t("nav.devices")), list,
    h("section.card", {}, h("h2", {}, t("health")), health,
      h("div.row", {}, page.may("administrator") ? backup : null,
        h("button", { type: "button", onclick: () => post("/reset").catch(page.fail) }, t("command.reset")))));

  async function make() {
    backup.disabled = true;
    try {
      const made = await post("/backup");
      await page.ask(t("backup.made"), [h("p.secret", {}, made.folder)]);
    } catch (error) {
      await page.fail(error);
    } finally {
      backup.disabled = false;
    }
  }

  const fact = ([name, value]) => h("div", {}, h("dt", {}, t(`fact.${name}`)), h("dd", {}, value));

  function told(snapshot) {
    fill(list, snapshot.devices.map((device) => {
      const until = device.calibrated_until ?? (device.calibrated ? t("for.ever") : t("nobody.says"));
      const calibration = device.calibration_due
        ? h("span.badge", { "data-verdict": "due" }, `! ${t("calibration.due")} `, time(device.calibrated_until))
        : device.calibrated_until ? time(device.calibrated_until) : until;
      return h("section.card.device", {},
        h("div", {}, h("h2", {}, device.name), h("p.note", {}, word("kind", device.kind)),
          h("span.badge", { "data-verdict": device.state }, h("span", { "aria-hidden": "true" }, SIGNS[device.state]), " ", word("device", device.state))),
        h("div", {},
          device.error ? h("p.bad", {}, said(device.error)) : null,
          h("dl.facts", {}, [
            ["identity", device.identity ?? "–"], ["since", time(device.since)], ["opened", count(device.opened)], ["failures", count(device.failures)],
            ["received", count(device.received)], ["lost", device.received ? `${count(device.lost)} (${number(100 * device.lost / (device.received + device.lost), 2)} %)` : count(device.lost)],
            ["calibrated", device.calibrated ? time(device.calibrated) : t("nobody.says")], ["calibrated_until", calibration],
          ].map(fact))));
    }));
    const storage = snapshot.storage;
    fill(health, [
      ["state", `${word("state", snapshot.state)} (${snapshot.state_number})`], ["cause", said(snapshot.cause) || "–"], ["version", snapshot.version], ["started", time(snapshot.started)],
      ["recipe", snapshot.recipe ? `${snapshot.recipe.name} v${snapshot.recipe.version}` : "–"], ["recipe_problem", said(snapshot.recipe_problem) || "–"],
      ["inspections", count(storage?.inspections)], ["scans", storage ? `${count(storage.scans)}, ${bytes(storage.scan_bytes)}` : "–"], ["database", bytes(storage?.database_bytes)], ["free", bytes(storage?.free_bytes)],
    ].map(fact));
  }

  return { told, again: () => get("/status").then(told).catch(() => {}) };
}
