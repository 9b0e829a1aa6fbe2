// The two languages, sentences of the program, and numbers and times as they are written in each.

let texts = {};
let language = "en";

/** Reads the texts and chooses the language: the one chosen before, or the browser's. */
export async function loadTexts() {
  const answer = await fetch("/page/texts.json");
  texts = await answer.json();
  const wanted = [remembered(), ...navigator.languages.map((name) => name.slice(0, 2)), "en"];
  language = wanted.find((name) => name && texts[name]);
  document.documentElement.lang = language;
}

function remembered() {
  // Where a browser keeps nothing, its own language is taken.
  try { return localStorage.getItem("language"); } catch { return null; }
}

/** The other language becomes the page's. */
export function switchLanguage() {
  language = language === "de" ? "en" : "de";
  document.documentElement.lang = language;
  try { localStorage.setItem("language", language); } catch { /* then it holds until the page is closed */ }
}

/** The language of the page, as the API knows it. */
export const spoken = () => language;

/** The text of `key`, with {names} filled in. */
export function t(key, values = {}) {
  const text = texts[language]?.[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}

/** The text of one of our words, or the word itself. */
export function word(kind, value) {
  const key = `${kind}.${value}`;
  return texts[language]?.[key] ?? String(value ?? "");
}

/** What stands between sentences that were joined. */
const SEPARATORS = /; |: |, /g;
/** Longer than any sentence of the program: what is longer came from outside. */
const LONGEST = 2_000;
const NUMBER = "[-+−]?\\d+(?:\\.\\d+)?";

let sentences = null;

/** The rows `said.*` as patterns of their English; the row that says most of itself is the one that was meant. */
function known(text) {
  sentences ??= Object.entries(texts.en).filter(([key]) => key.startsWith("said.")).map(([key, english]) => {
    const parts = english.split(/\{([\w.]+)\}/);
    const pattern = parts.map((part, index) => {
      if (index % 2) return part.startsWith("number.") ? `(${NUMBER})` : "(.+?)";
      return part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
    });
    const own = parts.filter((_, index) => index % 2 === 0).join("").length;
    return { key, names: parts.filter((_, index) => index % 2), pattern: new RegExp(`^${pattern.join("")}$`, "s"), own };
  }).sort((a, b) => b.own - a.own || (a.key < b.key ? -1 : 1));
  for (const sentence of sentences) {
    const values = sentence.pattern.exec(text)?.slice(1);
    if (values) return { sentence, values };
  }
  return null;
}

function retold({ sentence, values }) {
  return texts[language][sentence.key].replace(/\{([\w.]+)\}/g, (_, name) => {
    const value = values[sentence.names.indexOf(name)] ?? "";
    if (name.startsWith("said.")) return told(value) ?? value;
    return name.startsWith("number.") ? value.replace(".", t("decimal")) : value;
  });
}

/** Two sentences or more with semicolons between them, all of them known. */
function joined(text) {
  const found = [];
  let rest = text;
  for (let at = rest.indexOf("; "); at >= 0; at = rest.indexOf("; ", at + 1)) {
    const front = known(rest.slice(0, at));
    if (!front) continue;
    found.push(front);
    rest = rest.slice(at + 2);
    at = -1;
  }
  const last = found.length ? known(rest) : null;
  return last ? [...found, last].map(retold).join("; ") : null;
}

/** Of a text of which only parts are known: first where its front is, then where only its rest is. */
function pieces(text) {
  const cuts = [...text.matchAll(SEPARATORS)].map((cut) => [text.slice(0, cut.index), cut[0], text.slice(cut.index + 2)]);
  for (const [front, between, rest] of cuts) {
    const found = known(front);
    if (found) return retold(found) + between + (told(rest) ?? rest);
  }
  if (!cuts.length) return null;
  const [front, between, rest] = cuts[0];
  const end = told(rest);
  return end === null ? null : front + between + end;
}

/** Nothing where nothing of it is known. */
function told(text) {
  const all = joined(text);
  if (all) return all;
  const one = known(text);
  return one ? retold(one) : pieces(text);
}

/** What the program says in English, in the page's language, line by line; what is not the program's (a device's error, a name) stays as it is. */
export function said(english) {
  if (language === "en" || !english) return english ?? "";
  return english.split("\n").map((line) => (line.length > LONGEST ? line : told(line) ?? line)).join("\n");
}

/** A number with so many digits behind the point. */
export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: digits }).format(value);
}

/** A value with its sign: a deviation says its direction. */
export function signed(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: digits, signDisplay: "exceptZero" }).format(value);
}

/** A whole number with its thousands apart. */
export function count(value) {
  return value === null || value === undefined ? "–" : new Intl.NumberFormat(language).format(value);
}

/** Bytes, in the unit that fits. */
export function bytes(value) {
  if (value === null || value === undefined) return "–";
  const units = ["byte", "kilobyte", "megabyte", "gigabyte", "terabyte"];
  const power = Math.min(Math.floor(Math.log10(Math.max(value, 1)) / 3), units.length - 1);
  const digits = power > 1 ? 1 : 0;
  return new Intl.NumberFormat(language, { style: "unit", unit: units[power], unitDisplay: "short", maximumFractionDigits: digits }).format(value / 1000 ** power);
}

/** A time that the API gave. */
export function time(text) {
  if (!text) return "–";
  // Days before months: 11/12 is read in two ways, and German and British agree on one.
  return new Intl.DateTimeFormat(language === "en" ? "en-GB" : language, { dateStyle: "short", timeStyle: "medium" }).format(new Date(text));
}
