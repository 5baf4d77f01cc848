// SPDX-License-Identifier: Apache-2.0
// A round level: the bubble goes to the side that is high, as in a real one; the rim is the inclinometer's limit.

import { add } from "/page.js";

const LIMIT = 30; // deg
const RIM = 90;

export class Bubble {
  constructor(svg) {
    this.svg = svg;
    add(svg, "circle", { class: "face", r: RIM, id: "bubble-rim" });
    for (const ring of [10, 20]) {
      add(svg, "circle", { class: "ring", r: (RIM * ring) / LIMIT });
      add(svg, "text", { class: "ring-label", x: 3, y: (-RIM * ring) / LIMIT - 3 }, `${ring}°`);
    }
    add(svg, "text", { class: "ring-label limit", x: 3, y: -RIM - 3 }, "30°");
    add(svg, "path", { class: "ring", d: `M${-RIM} 0H${RIM}M0 ${-RIM}V${RIM}` });
    add(svg, "text", { class: "axis", x: RIM - 19, y: -5 }, "X′");
    add(svg, "text", { class: "axis", x: -18, y: -RIM + 16 }, "Y′");
    add(svg, "circle", { class: "centre", r: 14 });
    this.dot = add(svg, "circle", { class: "dot hidden", r: 11, id: "bubble-dot" });
  }

  show(tilt) {
    const known = Boolean(tilt) && tilt.x !== null && tilt.y !== null;
    this.dot.classList.toggle("hidden", !known);
    if (!known) return this.svg.setAttribute("aria-label", "no tilt");
    const out = Math.max(1, Math.hypot(tilt.x, tilt.y) / LIMIT); // beyond the rim it stays on it
    this.dot.setAttribute("cx", (RIM * tilt.x) / LIMIT / out);
    this.dot.setAttribute("cy", (-RIM * tilt.y) / LIMIT / out);
    this.dot.classList.toggle("out", Math.max(Math.abs(tilt.x), Math.abs(tilt.y)) > LIMIT || tilt.flags.length > 0);
    this.svg.setAttribute("aria-label", `tilt ${tilt.x.toFixed(2)} and ${tilt.y.toFixed(2)} degrees`);
  }
}
