// What the page asks of the daemon, and what it is told.

/** An answer that is a problem (RFC 9457). */
export class Problem extends Error {
  constructor(details) {
    super(details.detail || details.title);
    this.details = details;
  }
}

/** Asks; gives the JSON of the answer, or nothing where it has none. Throws a Problem, or a TypeError where nobody answers. */
export async function ask(method, path, body, headers = {}) {
  const set = { method, headers: { ...headers } };
  if (body !== undefined) {
    set.headers["Content-Type"] = "application/json";
    set.body = JSON.stringify(body);
  }
  const answer = await fetch(`/api/v1${path}`, set);
  const kind = answer.headers.get("Content-Type") ?? "";
  const value = kind.includes("json") ? await answer.json() : null;
  if (!answer.ok) throw new Problem(value ?? { title: answer.statusText, status: answer.status });
  return value;
}

export const get = (path) => ask("GET", path);
export const post = (path, body, headers) => ask("POST", path, body, headers);

/** A query of what has a value. */
export function query(values) {
  const pairs = Object.entries(values).filter(([, value]) => value !== undefined && value !== null && value !== "" && value !== false);
  return pairs.length ? `?${new URLSearchParams(pairs)}` : "";
}

/** A key that no other trigger has: the same trigger sent twice measures once. */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Starts a part; where the answer gets lost the same trigger is sent once more with the same key. */
export async function start(order) {
  const headers = { "Idempotency-Key": newKey() };
  try {
    return await post("/inspections", order, headers);
  } catch (error) {
    if (error instanceof Problem) throw error;
    return post("/inspections", order, headers);
  }
}

/** So long without a word, the keep-alive included, and the connection counts as lost, ms. */
const SILENCE_MS = 25_000;
/** Between two attempts to connect, ms. */
const AGAIN_MS = 1_000;

/**
 * Follows the cell: `told` gets every snapshot, `connected` whether there is a connection. Connects again by itself for as long
 * as it takes. Gives a function that ends it.
 */
export function follow(told, connected) {
  let source = null;
  let timer = 0;
  let ended = false;
  const again = () => {
    source?.close();
    clearTimeout(timer);
    if (ended) return;
    connected(false);
    timer = setTimeout(open, AGAIN_MS);
  };
  const heard = () => {
    clearTimeout(timer);
    timer = setTimeout(check, SILENCE_MS);
  };
  // Comments that keep the stream alive are not shown to us: ask whether the daemon is there.
  const check = async () => {
    try {
      const answer = await fetch("/healthz", { signal: AbortSignal.timeout(5_000) });
      if (!answer.ok || source.readyState !== EventSource.OPEN) return again();
      heard();
    } catch {
      again();
    }
  };
  const open = () => {
    source = new EventSource("/api/v1/events");
    source.addEventListener("open", heard);
    source.addEventListener("snapshot", (event) => {
      heard();
      connected(true);
      told(JSON.parse(event.data));
    });
    source.addEventListener("error", again);
    timer = setTimeout(again, SILENCE_MS);
  };
  open();
  return () => {
    ended = true;
    clearTimeout(timer);
    source?.close();
  };
}
