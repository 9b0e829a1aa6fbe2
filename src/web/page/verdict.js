// A verdict as a sign, a word and a colour: never the colour alone.

import { h } from "./dom.js";
import { number, said, signed, t, word } from "./text.js";

export const SIGNS = { ok: "✓", not_ok: "✕", not_decidable: "?", undefined: "–", refused: "!", aborted: "!" };

/** How bad: the worst comes first. */
const ORDER = ["not_ok", "not_decidable", "undefined", "ok"];

/** What an inspection came to: its verdict, or its phase where it has none. */
export function outcome(inspection) {
  return inspection.verdict ?? inspection.phase;
}

/** A small verdict for tables. */
export function badge(value) {
  return h("span.badge", { "data-verdict": value }, h("span", { "aria-hidden": "true" }, SIGNS[value] ?? "…"), " ", word("verdict", value));
}

/** Every characteristic of a report, the worst first: by verdict, then by how far it is beyond or near its limit. */
export function worstFirst(report) {
  const all = report.edges.flatMap((edge) => edge.characteristics.map((found) => ({ ...found, edge: edge.id })));
  const strain = (found) => {
    if (found.value === null) return 0;
    const over = found.upper !== null && found.upper !== 0 ? found.value / found.upper : 0;
    const under = found.lower !== null && found.lower !== 0 ? found.value / found.lower : 0;
    return Math.max(over, under);
  };
  return all.sort((a, b) => ORDER.indexOf(a.verdict) - ORDER.indexOf(b.verdict) || strain(b) - strain(a));
}

/** Digits behind the point that mean something in this unit. */
export const digits = (unit) => (unit === "deg" ? 2 : 3);

/** Limits in words. */
export function limits(found) {
  const show = (value) => signed(value, digits(found.unit));
  if (found.lower !== null && found.upper !== null) return `${show(found.lower)} … ${show(found.upper)}`;
  if (found.upper !== null) return `≤ ${show(found.upper)}`;
  return found.lower !== null ? `≥ ${show(found.lower)}` : "–";
}

/** Value and expanded uncertainty (k = 2) in words. */
export function valued(found) {
  if (found.value === null) return t("not.measured");
  const places = digits(found.unit);
  const unit = found.unit === "deg" ? "°" : ` ${found.unit}`;
  const spread = found.u === null ? "" : ` ± ${number(2 * found.u, places)}`;
  return `${signed(found.value, places)}${spread}${unit}`;
}

/** Why a verdict is what it is, in the page's language; `found` is an inspection or a report. */
export function because(found) {
  const why = found.because;
  if (!why) return said(found.reason);
  const judged = why.characteristic;
  const values = {
    edge: why.edge,
    names: listed(why.names.map(said)),
    count: why.count,
    share: Math.round((why.coverage ?? 0) * 100),
    detail: why.detail ? t("because.detail", { detail: said(why.detail) }) : "",
    others: why.count === 0 ? "" : t(why.count === 1 ? "because.other" : "because.others", { count: why.count }),
  };
  if (judged) {
    const place = judged.s_mm === null ? "" : t("because.place", { s: number(judged.s_mm, 1) });
    const quantity = word("quantity", judged.quantity);
    if (judged.value !== null) values.said = t("because.stated", { quantity, value: valued(judged), place });
    else if (why.detail) values.said = t("because.valueless", { quantity, detail: said(why.detail) });
    else values.said = t("because.unmeasured", { quantity });
    const between = limits(judged);
    values.limits = between === "–" ? "" : t("because.limits", { limits: between });
  }
  return t(`because.${why.code}`, values);
}

/** What to do next, in the page's language. */
export function advised(found) {
  const advice = found.because ? t(`advised.${found.because.advice}`) : said(found.advice);
  return advice ? `${advice[0].toUpperCase()}${advice.slice(1)}.` : "";
}

/** At most five of them, then a count. */
function listed(names) {
  const shown = names.slice(0, 5).join(", ");
  return names.length > 5 ? t("because.more", { names: shown, count: names.length - 5 }) : shown;
}
