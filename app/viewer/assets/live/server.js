// Asking this server: the page's own endpoints and the API behind the session.

export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail ?? `the server answered ${status}`);
    this.status = status;
    this.faults = problem.errors ?? [];
  }
}

/** One request; the answer's JSON (null when there is none). Throws Refused with the server's own sentence. */
export async function ask(method, path, { json, body, headers = {}, raw = false } = {}) {
  const options = { method, headers: { ...headers }, cache: "no-store", credentials: "same-origin" };
  if (json !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(json);
  } else if (body !== undefined) {
    options.body = body;
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Refused(0, { detail: "The server cannot be reached. Is it still running?" });
  }
  if (answer.status === 401) location.reload(); // the session ended: the sign-in page comes
  if (!answer.ok) throw new Refused(answer.status, await answer.json().catch(() => ({})));
  if (raw) return answer;
  return answer.status === 204 ? null : answer.json();
}

/** Every item of a list, page after page. */
export async function all(path) {
  const items = [];
  let next = path;
  while (next) {
    const page = await ask("GET", next);
    items.push(...page.items);
    next = page.links.next ? `v1${page.links.next.split("/v1")[1]}` : null;
  }
  return items;
}

const FORMATS = { csv: "csv", parquet: "parquet", ndjson: "ndjson", txt: "indoor-location-2020" };

/** How a survey file's bytes are to be sent, by its name: format, and encoding of a .gz. Throws for an unknown ending. */
export function howToSend(file) {
  const parts = file.name.toLowerCase().split(".");
  const packed = parts.at(-1) === "gz";
  const format = FORMATS[packed ? parts.at(-2) : parts.at(-1)];
  if (!format) throw new Error(`${file.name}: the ending says nothing; known are .csv, .parquet, .ndjson, .txt, each also .gz`);
  return { format, headers: { "Content-Type": "application/octet-stream", ...(packed ? { "Content-Encoding": "gzip" } : {}) } };
}
