// The two languages, and numbers and times as they are written in each.

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
