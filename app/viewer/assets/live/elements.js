// Building elements. Everything that comes from the server is set as text, never as markup.

export const byId = (id) => document.getElementById(id);

/** An element with properties, attributes (aria-…, role, class as className) and children (elements or text). */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (name in element) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

export const put = (place, ...children) => place.replaceChildren(...children.filter(Boolean));

/** Something to be read: a sentence and, of a refusal, where and why. */
export function told(error, kind = "bad") {
  const said = (fault) => error.message.includes(fault.location) && error.message.includes(fault.reason);
  const faults = (error.faults ?? []).filter((fault) => !said(fault))
    .map((fault) => make("li", {}, `${fault.location}: ${fault.reason}`));
  return make("div", { className: `told ${kind}`, role: kind === "bad" ? "alert" : "status" },
    typeof error === "string" ? error : error.message, faults.length ? make("ul", {}, ...faults) : null);
}

export function table(heads, rows) {
  const cells = (tag, values) => values.map((value) =>
    make(tag, { className: typeof value === "number" || /^[−\d]/.test(value) ? "n" : "" }, String(value)));
  return make("table", {}, make("thead", {}, make("tr", {}, ...cells("th", heads))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...cells("td", row)))));
}

export const number = (value, digits = 3) =>
  value === null || value === undefined ? "–" : Number(value.toPrecision(digits)).toString().replace("-", "−");

export function options(select, items, chosen) {
  const wanted = JSON.stringify(items);
  if (select.dataset.items !== wanted) {
    select.dataset.items = wanted;
    put(select, ...items.map(([value, text]) => make("option", { value }, text)));
  }
  select.value = chosen ?? "";
}

/** Let files be dropped on a place. */
export function dropZone(place, take) {
  const over = (event) => { event.preventDefault(); place.classList.add("over"); };
  place.addEventListener("dragenter", over);
  place.addEventListener("dragover", over);
  place.addEventListener("dragleave", () => place.classList.remove("over"));
  place.addEventListener("drop", (event) => {
    event.preventDefault();
    place.classList.remove("over");
    const files = [...event.dataTransfer.files];
    if (files.length) take(files);
    else if (event.dataTransfer.getData("text")) take([], event.dataTransfer.getData("text"));
  });
}
