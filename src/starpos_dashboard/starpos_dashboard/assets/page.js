// SPDX-License-Identifier: Apache-2.0
// The page's elements. Text is only ever set as text.

const SVG = "http://www.w3.org/2000/svg";

export const element = (id) => document.getElementById(id);

export function write(e, text) {
  if (e.textContent !== text) e.textContent = text;
}

export const say = (id, text) => write(element(id), text);

export function add(parent, name, attributes = {}, text = "") {
  const e = document.createElementNS(parent.namespaceURI === SVG || name === "svg" ? SVG : parent.namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  if (text) e.textContent = text;
  parent.append(e);
  return e;
}

// As many children as there are rows; make(parent) makes one, fill(child, row) says what it shows.
export function rows(parent, list, make, fill) {
  while (parent.children.length > list.length) parent.lastElementChild.remove();
  while (parent.children.length < list.length) make(parent);
  list.forEach((row, i) => fill(parent.children[i], row));
}

// A card whose data is old, or missing, looks so; its badge says how old.
export function dress(name, state, badge) {
  for (const kind of ["old", "missing"]) element(`${name}-card`).classList.toggle(kind, state === kind);
  say(`${name}-age`, badge);
}
