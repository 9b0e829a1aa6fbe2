// Elements made of values: text never becomes markup.

/**
 * An element. `what` is a tag with classes ("p.note"), `set` its properties: `on...` listens, what the element has as a property
 * is set as one, all else becomes an attribute. Children are elements, texts, or nothing.
 */
export function h(what, set = {}, ...children) {
  const [tag, ...classes] = what.split(".");
  const element = document.createElement(tag);
  if (classes.length) element.className = classes.join(" ");
  for (const [name, value] of Object.entries(set)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && name !== "list" && name !== "form") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** The same for a drawing. */
export function svg(tag, set = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(set)) {
    if (value !== undefined && value !== null) element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter(Boolean));
  return element;
}

/** Puts `children` in the place of what `parent` has. */
export function fill(parent, ...children) {
  parent.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
}

/** Sets a text only where it is another one: a reader of the screen is not told again what it knows. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A table: `heads` are texts, `rows` arrays of cells, each a text or an element; numbers stand right. */
export function table(heads, rows, numbers = []) {
  const cell = (kind, value, index) => h(numbers.includes(index) ? `${kind}.number` : kind, kind === "th" ? { scope: "col" } : {}, value ?? "");
  return h("div.scroll", { tabIndex: 0 },
    h("table", {},
      h("thead", {}, h("tr", {}, heads.map((head, index) => cell("th", head, index)))),
      h("tbody", {}, rows.map((row) => {
        const line = h("tr", {}, row.cells.map((value, index) => cell("td", value, index)));
        if (row.go) {
          line.classList.add("go");
          line.addEventListener("click", (event) => { if (!event.target.closest("a, button")) location.hash = row.go; });
        }
        return line;
      })),
    ));
}
