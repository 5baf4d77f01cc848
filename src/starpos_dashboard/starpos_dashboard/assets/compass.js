// SPDX-License-Identifier: Apache-2.0
// A rose with north up, and a needle that points where the instrument's x axis does.

import { add } from "/page.js";
import * as text from "/text.js";

const WEDGE = 0.5; // deg of one sigma, from which it can be seen

export class Compass {
  constructor(svg) {
    this.svg = svg;
    add(svg, "circle", { class: "face", r: 92 });
    for (let a = 0; a < 360; a += 10) {
      const length = a % 90 === 0 ? 14 : a % 30 === 0 ? 10 : 5;
      add(svg, "line", { class: a % 30 ? "tick" : "tick strong", y1: -92, y2: -92 + length, transform: `rotate(${a})` });
    }
    ["N", "E", "S", "W"].forEach((letter, i) => {
      const a = (i * Math.PI) / 2;
      add(svg, "text", { class: i ? "cardinal" : "cardinal north", x: 67 * Math.sin(a), y: -67 * Math.cos(a) }, letter);
    });
    this.sun = ["past", "coming"].map((when) => add(svg, "path", { class: `sun-way ${when}` }));
    this.sun.push(add(svg, "circle", { class: "sun", r: 5 }));
    this.wedge = add(svg, "path", { class: "wedge" });
    this.needle = add(svg, "g", { class: "needle", id: "needle" });
    add(this.needle, "path", { class: "head", d: "M0-88 9-50 0-58-9-50z" });
    add(this.needle, "path", { class: "shaft", d: "M0-58V46" });
    add(this.needle, "circle", { class: "hub", r: 4 });
  }

  // The Sun's way of half a day before now and after, [azimuth, altitude] deg each, the horizon on the rim.
  showSun(way) {
    const [past, coming, sun] = this.sun;
    const middle = way ? (way.length - 1) / 2 : 0;
    past.setAttribute("d", way ? line(way.slice(0, middle + 1)) : "");
    coming.setAttribute("d", way ? line(way.slice(middle)) : "");
    const up = Boolean(way) && way[middle][1] > 0;
    sun.classList.toggle("hidden", !up);
    if (up) sun.setAttribute("transform", `translate(${at(...way[middle])})`);
  }

  show(heading) {
    this.needle.classList.toggle("hidden", !heading);
    this.wedge.setAttribute("d", "");
    if (!heading) return this.svg.setAttribute("aria-label", "no heading");
    this.needle.setAttribute("transform", `rotate(${heading.azimuth})`);
    if (heading.sigma >= WEDGE) this.wedge.setAttribute("d", sector(heading.azimuth, Math.min(heading.sigma, 179.9)));
    this.svg.setAttribute("aria-label", `heading ${text.azimuth(heading.azimuth, heading.sigma)}`);
  }
}

function at(azimuth, altitude) {
  const r = 92 * (1 - altitude / 90);
  const a = (azimuth * Math.PI) / 180;
  return `${(r * Math.sin(a)).toFixed(1)} ${(-r * Math.cos(a)).toFixed(1)}`;
}

// A path through the places above the horizon.
function line(way) {
  let pen = "M";
  return way.map(([azimuth, altitude]) => {
    const step = altitude > 0 ? `${pen}${at(azimuth, altitude)}` : "";
    pen = altitude > 0 ? "L" : "M";
    return step;
  }).join("");
}

function sector(azimuth, half) {
  const end = (a) => `${88 * Math.sin((a * Math.PI) / 180)} ${-88 * Math.cos((a * Math.PI) / 180)}`;
  return `M0 0L${end(azimuth - half)}A88 88 0 ${half > 90 ? 1 : 0} 1 ${end(azimuth + half)}Z`;
}
