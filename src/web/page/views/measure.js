// The operator's place: a state and a verdict that are read from three metres, Start, and the scan as it comes.

import { get, post, start } from "../api.js";
import { fill, h, say } from "../dom.js";
import { livePictures } from "../live.js";
import { said, t, time, word } from "../text.js";
import { advised, badge, because, limits, outcome, SIGNS, valued, worstFirst } from "../verdict.js";

/** Lines of the short table; the whole one is a click away. */
const WORST = 6;
/** So long a verdict may take before the bar begins to move, ms. */
const PATIENCE_MS = 1000;

export function measure(view, page) {
  const sign = h("span.sign", { "aria-hidden": "true" });
  const big = h("span", { id: "verdict" });
  const part = h("p.part", { id: "verdict-part" });
  const reason = h("p.reason", { id: "reason" });
  const advice = h("p.note", { id: "advice" });
  const bar = h("progress", { max: 1, value: 0, id: "progress", "aria-label": t("progress") });
  const step = h("p.note", { id: "step" });
  const board = h("section.board", { "aria-live": "polite" }, h("p.big", {}, sign, big), part, reason, advice, bar, step);

  const serial = h("input", { id: "serial", name: "part_serial", autocomplete: "off", autofocus: true, maxLength: 200, spellcheck: false });
  const order = h("input", { id: "order", name: "order_number", autocomplete: "off", maxLength: 200, spellcheck: false });
  const purpose = h("select", { id: "purpose", name: "purpose" },
    ["series", "setup", "audit", "master"].map((value) => h("option", { value }, word("purpose", value))));
  const continuous = h("input", { type: "checkbox", id: "continuous" });
  const go = h("button.main.large", { type: "submit", id: "start" }, t("start"));
  const wrong = h("p.bad", { role: "alert", id: "refused", hidden: true });
  const form = h("form.card.start", { onsubmit: begin },
    h("label", {}, t("serial"), serial),
    h("div.two", {}, h("label", {}, t("order"), order), h("label", {}, t("purpose"), purpose)),
    h("label.check", {}, continuous, t("continuous")),
    go, wrong);
  const button = (name, kind = "") => h(`button${kind}`, { type: "button", id: name, onclick: () => command(name) }, t(`command.${name}`));
  const stop = button("stop");
  const abort = button("abort");
  const halt = button("halt");
  const reset = button("reset");
  const waiting = h("p.note", { id: "waiting" });
  const live = livePictures();
  let patience = 0;
  const result = h("section.card", { id: "result", hidden: true });
  fill(view, h("div.measure", {},
    h("div.left", {}, board, result),
    h("div.right", {}, form, h("div.row.commands", {}, stop, abort, halt, reset), waiting, h("section.card", {}, live.element))));
  serial.focus();

  let detailed = null;

  async function begin(event) {
    event.preventDefault();
    wrong.hidden = true;
    const wanted = { part_serial: serial.value, order_number: order.value, purpose: purpose.value, mode: continuous.checked ? "continuous" : "single" };
    go.disabled = true;
    try {
      await start(wanted);
      serial.value = "";
    } catch (error) {
      wrong.hidden = false;
      const details = error.details ?? { detail: t("lost") };
      say(wrong, [details.detail, details.what_to_do].filter(Boolean).map(said).join(". "));
      serial.select();
    } finally {
      go.disabled = !page.snapshot?.accepts;
      serial.focus();
    }
  }

  async function command(name) {
    try { await post(`/${name}`); } catch (error) { await page.fail(error); }
    serial.focus();
  }

  /** The bar is full; it moves only where the verdict is long in coming, because drawing that takes from the computing. */
  function computes() {
    if (patience) return;
    bar.value = 1;
    patience = setTimeout(() => bar.removeAttribute("value"), PATIENCE_MS);
  }

  function told(snapshot) {
    if ((snapshot.acquiring ?? snapshot.computing.at(-1))?.step !== "inspecting") {
      clearTimeout(patience);
      patience = 0;
    }
    const running = snapshot.acquiring;
    const computing = snapshot.computing.at(-1);
    const ready = snapshot.state === "ready";
    go.disabled = !snapshot.accepts;
    stop.disabled = !running && !snapshot.queue.length;
    abort.disabled = !running && !snapshot.queue.length;
    halt.hidden = snapshot.state === "halted";
    reset.hidden = ready || Boolean(running);
    bar.hidden = !running && !computing;
    step.hidden = bar.hidden;
    live.run(Boolean(running));
    const queue = snapshot.queue.map((job) => job.part_serial).join(", ");
    say(waiting, queue ? t("waiting", { parts: queue }) : "");
    if (running || computing) {
      const job = running ?? computing;
      board.dataset.verdict = "busy";
      say(sign, "⋯");
      say(big, word("step.big", job.step));
      say(part, job.part_serial);
      say(reason, said(job.findings.at(-1)));
      say(advice, "");
      if (job.step === "inspecting") computes();
      else bar.value = job.step === "touching" && job.touches ? job.touches[0] / job.touches[1] : job.share;
      say(step, job.step === "touching" && job.touches ? t("touches", { done: job.touches[0], of: job.touches[1] }) : t("profiles", { count: job.profiles }));
    } else if (snapshot.cause) {
      board.dataset.verdict = snapshot.state === "preoperational" ? "busy" : "stopped";
      say(sign, snapshot.state === "preoperational" ? "⋯" : "!");
      say(big, word("state", snapshot.state));
      say(part, "");
      say(reason, said(snapshot.cause));
      say(advice, said(snapshot.advice));
    } else if (snapshot.last) {
      showLast(snapshot.last);
    } else {
      board.dataset.verdict = "idle";
      say(sign, "");
      say(big, word("state", snapshot.state));
      say(part, "");
      say(reason, t("first"));
      say(advice, "");
    }
    detail(snapshot.last);
  }

  function showLast(last) {
    const value = outcome(last);
    board.dataset.verdict = value;
    say(sign, SIGNS[value] ?? "");
    say(big, word("verdict.big", value));
    say(part, last.part_serial);
    say(reason, because(last));
    say(advice, time(last.ended));
  }

  async function detail(last) {
    if (!last || last.id === detailed) return;
    detailed = last.id;
    result.hidden = true;
    if (last.phase !== "done") return;
    try {
      const report = await get(`/inspections/${last.id}/report.json`);
      if (detailed !== last.id) return;
      const worst = worstFirst(report).filter((found) => found.verdict !== "undefined").slice(0, WORST);
      fill(result,
        h("h2", {}, t("result.of", { part: last.part_serial })),
        report.advice ? h("p", {}, advised(report)) : null,
        h("ul.worst", {}, worst.map((found) => h("li", {}, badge(found.verdict),
          h("strong", {}, found.edge), h("span", {}, word("quantity", found.quantity)),
          h("span.number", {}, valued(found)), h("span.note", {}, t("limits.are", { limits: limits(found) }))))),
        h("a.button", { href: `#/inspection/${last.id}`, id: "report-link" }, t("result.whole")));
      result.hidden = false;
    } catch { detailed = null; }
  }

  return { told, end: () => live.end() };
}
