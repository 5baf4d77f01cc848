// SPDX-License-Identifier: Apache-2.0
// The lights of the links, and the bars of the error budget.

import { add, element, rows, write } from "/page.js";
import * as text from "/text.js";

const LEVELS = ["ok", "warn", "error", "stale"];
const WORDS = ["OK", "WARN", "ERROR", "STALE"];

// lights: [{name, level, sentence, age}]; one that was not heard for longer than `limit` s is grey.
export function showLights(list, lights, limit) {
  rows(list, lights, makeLight, (item, light) => {
    const silent = !(light.age < limit);
    item.className = silent ? "silent" : LEVELS[light.level];
    const [, name, sentence, level] = item.children;
    write(name, light.name);
    write(level, silent ? "SILENT" : WORDS[light.level]);
    write(sentence, silent ? `nothing heard for ${text.age(light.age)}` : light.sentence);
  });
}

function makeLight(parent) {
  const item = add(parent, "li");
  add(item, "i", { class: "lamp", "aria-hidden": "true" });
  for (const part of ["name", "sentence", "level"]) add(item, "span", { class: part });
}

const LEAST = 0.01; // of the largest; smaller ones are told together

// terms: [{name, position, heading, common}]
export function showBudget(terms) {
  const known = terms.filter((t) => t.position !== null).sort((a, b) => b.position - a.position);
  const most = Math.max(...known.map((t) => t.position), 1e-9);
  const small = known.filter((t) => t.position < LEAST * most);
  const shown = small.length < 2 ? known : [...known.slice(0, -small.length), together(small)];
  rows(element("budget"), shown, makeBar, (item, term) => {
    const [name, bar, metres, heading] = item.children;
    item.className = term.common ? "common" : "random";
    write(name, term.name);
    bar.firstElementChild.style.width = `${(100 * term.position) / most}%`;
    write(metres, text.metres(term.position));
    write(heading, text.angle(term.heading));
  });
}

function together(terms) {
  const sum = (what) => Math.hypot(...terms.map((t) => t[what] ?? 0));
  const name = `${terms.length} smaller ones`;
  return { name, position: sum("position"), heading: sum("heading"), common: terms.every((t) => t.common) };
}

function makeBar(parent) {
  const item = add(parent, "li");
  add(item, "span", { class: "name" });
  add(add(item, "span", { class: "bar", "aria-hidden": "true" }), "i");
  add(item, "span", { class: "metres numbers" });
  add(item, "span", { class: "turn numbers" });
}
