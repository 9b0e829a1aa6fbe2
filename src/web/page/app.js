// The page as a whole: who looks, where they are, whether the daemon is there.

import { follow, get, post, Problem } from "./api.js";
import { fill, h, say } from "./dom.js";
import { loadTexts, said, switchLanguage, t, word } from "./text.js";
import { audit } from "./views/audit.js";
import { devices } from "./views/devices.js";
import { history } from "./views/history.js";
import { inspection } from "./views/inspection.js";
import { measure } from "./views/measure.js";
import { people } from "./views/people.js";
import { recipes } from "./views/recipes.js";
import { trends } from "./views/trends.js";

const ROLES = ["operator", "setter", "metrologist", "administrator"];

// Where one can go, and the least role for it. The daemon checks it again; here it only decides what is shown.
const PLACES = {
  measure: { view: measure, least: "operator" },
  history: { view: history, least: "operator" },
  inspection: { view: inspection, least: "operator", hidden: true },
  trends: { view: trends, least: "operator" },
  devices: { view: devices, least: "operator" },
  recipes: { view: recipes, least: "operator" },
  audit: { view: audit, least: "metrologist" },
  people: { view: people, least: "administrator" },
};

const at = (id) => document.getElementById(id);

/** What the views share. */
const page = {
  me: null,
  snapshot: null,
  connected: false,
  may: (role) => page.me?.role && ROLES.indexOf(page.me.role) >= ROLES.indexOf(role),
  ask: dialog,
  fail,
};

let shown = null;
let unfollow = null;

/** Shows the place that the address names. */
function go() {
  const [, name = "measure", ...rest] = location.hash.split(/[/?]/);
  const place = PLACES[name] ?? PLACES.measure;
  shown?.end?.();
  shown = null;
  drawBar(PLACES[name] ? name : "measure");
  const view = at("view");
  if (!page.may(place.least)) {
    fill(view, h("section.card", {}, h("h1", {}, t("login.needed")), h("p", {}, t("login.why")),
      h("button.main", { type: "button", id: "login-here", onclick: login }, t("login.do"))));
    return;
  }
  fill(view);
  shown = place.view(view, page, rest.map(decodeURIComponent)) ?? {};
  if (page.snapshot) shown.told?.(page.snapshot);
}

function drawBar(current) {
  fill(at("nav"), Object.entries(PLACES)
    .filter(([, place]) => !place.hidden && page.may(place.least))
    .map(([name]) => h("a", { href: `#/${name}`, "aria-current": name === current ? "page" : null }, t(`nav.${name}`))));
  say(at("person"), page.me?.logged_in ? page.me.name : t("login.do"));
  at("person").title = page.me?.role ? word("role", page.me.role) : "";
  say(at("language"), t("language.other"));
  say(at("skip"), t("skip"));
}

function told(snapshot) {
  page.snapshot = snapshot;
  say(at("cell"), snapshot.cell);
  document.title = `${word("state", snapshot.state)} · ${snapshot.cell}`;
  at("state").dataset.state = snapshot.state;
  say(at("state"), word("state", snapshot.state));
  at("simulated").hidden = !snapshot.simulated;
  say(at("simulated"), t("simulated"));
  shown?.told?.(snapshot);
}

function connected(is) {
  const before = page.connected;
  page.connected = is;
  at("lost").hidden = is;
  say(at("lost"), t("lost"));
  document.body.classList.toggle("lost", !is);
  if (is && !before && page.snapshot) refresh();
}

/** After a restart the session may be another one, and lists may have changed. */
async function refresh() {
  const before = JSON.stringify(page.me);
  try { page.me = await get("/me"); } catch { return; }
  if (JSON.stringify(page.me) !== before) go();
  else shown?.again?.();
}

function listen() {
  unfollow?.();
  unfollow = page.may("operator") ? follow(told, connected) : null;
}

/** Shows an error in words: what was seen, and what to do. */
function fail(error) {
  const details = error instanceof Problem ? error.details : { title: t("lost"), detail: "", what_to_do: "" };
  return dialog(said(details.title), [
    h("p", { id: "problem" }, said(details.detail)),
    details.what_to_do ? h("p.note", {}, said(details.what_to_do)) : null,
  ]);
}

/**
 * Asks in a dialog; gives the values of its fields by name, or null. Where `send` is given, it gets the values first; while it
 * throws the dialog stays and shows why.
 */
function dialog(title, content, { yes = null, send = null } = {}) {
  const box = at("dialog");
  return new Promise((resolve) => {
    const wrong = h("p.bad", { role: "alert", hidden: true });
    const close = (value) => { box.close(); fill(box); resolve(value); };
    const form = h("form", {
      method: "dialog",
      onsubmit: async (event) => {
        event.preventDefault();
        const values = Object.fromEntries(new FormData(form));
        if (!yes) return close(values);
        try {
          close(send ? (await send(values)) ?? values : values);
        } catch (error) {
          wrong.hidden = false;
          const details = error.details ?? { detail: t("lost") };
          say(wrong, [details.detail ?? details.title, details.what_to_do].filter(Boolean).map(said).join(". "));
        }
      },
    }, h("h2", {}, title), content, wrong, h("div.row", {},
      yes ? h("button.main", { type: "submit" }, yes) : null,
      h("button", { type: yes ? "button" : "submit", onclick: yes ? () => close(null) : null }, yes ? t("cancel") : t("close"))));
    fill(box, form);
    box.oncancel = (event) => { event.preventDefault(); close(null); };
    if (box.open) box.close();
    box.showModal();
  });
}

async function login() {
  const done = await dialog(t("login.do"), [
    h("label", {}, t("login.name"), h("input", { name: "name", autocomplete: "username", required: true, autofocus: true })),
    h("label", {}, t("login.password"), h("input", { name: "password", type: "password", autocomplete: "current-password", required: true })),
  ], { yes: t("login.do"), send: (values) => post("/login", values) });
  if (done) await whoChanged();
}

async function whoChanged() {
  page.me = await get("/me");
  listen();
  go();
}

async function person() {
  if (!page.me?.logged_in) return login();
  const out = await dialog(page.me.name, [h("p", {}, word("role", page.me.role))], { yes: t("logout") });
  if (!out) return;
  await post("/logout");
  await whoChanged();
}

async function begin() {
  await loadTexts();
  at("person").addEventListener("click", () => person().catch(fail));
  at("language").addEventListener("click", () => { switchLanguage(); go(); if (page.snapshot) told(page.snapshot); });
  at("skip").addEventListener("click", (event) => { event.preventDefault(); at("view").focus(); });
  for (;;) {
    try {
      page.me = await get("/me");
      break;
    } catch {
      connected(false);
      await new Promise((resolve) => setTimeout(resolve, 1_000));
    }
  }
  at("lost").hidden = true;
  addEventListener("hashchange", go);
  listen();
  go();
}

begin();
