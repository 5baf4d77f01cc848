// SPDX-License-Identifier: Apache-2.0
// The place for other programs: a link that opens a map (geo:, RFC 5870, on WGS 84), and a button that copies it.

import { element, say } from "/page.js";

const TOLD_MS = 2000;
const DECIMALS = 6; // of a degree: 0.1 m
let place = null;

// fix: {latitude, longitude} [deg] of the place that the page shows, or null.
export function offerPlace(fix) {
  element("place-tools").hidden = !fix;
  place = fix && [fix.latitude, fix.longitude].map((degrees) => degrees.toFixed(DECIMALS));
  if (place) element("geo").setAttribute("href", `geo:${place.join(",")}`);
}

// navigator.clipboard is missing where the page comes over plain HTTP from another machine; this works there too.
function copy() {
  getSelection().selectAllChildren(element("decimal"));
  const fill = (event) => {
    event.clipboardData.setData("text/plain", place.join(", "));
    event.preventDefault();
  };
  document.addEventListener("copy", fill, { once: true });
  const done = document.execCommand("copy");
  document.removeEventListener("copy", fill);
  say("copy", done ? "Copied" : "Selected: copy it by hand");
  setTimeout(() => say("copy", "Copy"), TOLD_MS);
}

element("copy").addEventListener("click", copy);
