// SPDX-License-Identifier: Apache-2.0
// A round level: the bubble goes to the side that is high, as in a real one; its scale follows the lean.

import { add } from "/page.js";

const SCALES = [30, 90]; // deg at the rim
const RIM = 90;

export class Bubble {
  constructor(svg) {
    this.svg = svg;
    add(svg, "circle", { class: "face", r: RIM, id: "bubble-rim" });
    this.labels = [1, 2, 3].map((third) => {
      const r = (RIM * third) / 3;
      if (third < 3) add(svg, "circle", { class: "ring", r });
      return add(svg, "text", { class: "ring-label", x: 4, y: -r + 14 }, "");
    });
    this.scale(SCALES[0]);
    add(svg, "path", { class: "ring", d: `M${-RIM} 0H${RIM}M0 ${-RIM}V${RIM}` });
    add(svg, "text", { class: "axis", x: RIM - 22, y: -6 }, "X′");
    add(svg, "text", { class: "axis", x: -20, y: -RIM + 20 }, "Y′");
    add(svg, "circle", { class: "centre", r: 14 });
    this.dot = add(svg, "circle", { class: "dot hidden", r: 11, id: "bubble-dot" });
  }

  scale(limit) {
    this.limit = limit;
    this.labels.forEach((label, k) => (label.textContent = `${(limit * (k + 1)) / 3}°`));
  }

  show(tilt) {
    const known = Boolean(tilt) && tilt.x !== null && tilt.y !== null;
    this.dot.classList.toggle("hidden", !known);
    if (!known) return this.svg.setAttribute("aria-label", "no tilt");
    const lean = Math.hypot(tilt.x, tilt.y);
    this.scale(SCALES.find((limit) => lean <= limit) ?? SCALES.at(-1));
    const out = Math.max(1, lean / this.limit); // beyond the rim it stays on it
    this.dot.setAttribute("cx", (RIM * tilt.x) / this.limit / out);
    this.dot.setAttribute("cy", (-RIM * tilt.y) / this.limit / out);
    this.dot.classList.toggle("out", tilt.flags.length > 0);
    this.svg.setAttribute("aria-label", `tilt ${tilt.x.toFixed(2)} and ${tilt.y.toFixed(2)} degrees`);
  }
}
