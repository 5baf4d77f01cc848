// SPDX-License-Identifier: Apache-2.0
// Which meridians and parallels a view shows, from the whole Earth to hundredths of an arcsecond.

import { parts } from "/text.js";

const SECOND = 1 / 3600;
const STEPS = [30, 15, 10, 5, 2, 1, ...[30, 20, 10, 5, 2, 1].map((m) => m / 60)].concat(
  [30, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001].map((s) => s * SECOND),
);
const WIDE = 0.9; // rad from the centre to a corner, from which all there are are drawn
const MIN_PX = { parallels: 80, meridians: 130 };
const MAX_LINES = 80;

const finest = (pxPerDegree, leastPx) => STEPS.filter((s) => s * pxPerDegree >= leastPx).pop() ?? STEPS[0];

function multiples(step, from, to) {
  const list = [];
  for (let i = Math.ceil(from / step - 1e-9); i * step <= to + 1e-9 * step && list.length < MAX_LINES; i++) list.push(i * step);
  return list;
}

// view: {lon, lat, k (px a radian)}, corner: px from the centre to a corner.
// Steps and places [deg] of the lines, and how far they reach: south, north, west, east.
export function graticule(view, corner) {
  const pxPerDegree = (view.k * Math.PI) / 180;
  const reach = corner / view.k;
  const degrees = (reach * 180) / Math.PI;
  const whole = reach > WIDE;
  const south = whole ? -90 : Math.max(-90, view.lat - degrees);
  const north = whole ? 90 : Math.min(90, view.lat + degrees);
  const narrowest = Math.cos((Math.max(Math.abs(south), Math.abs(north)) * Math.PI) / 180);
  const round = whole || degrees / Math.max(narrowest, 1e-12) > 180;
  const half = round ? 180 : degrees / narrowest;
  const latStep = finest(pxPerDegree, MIN_PX.parallels);
  const lonStep = finest(pxPerDegree * Math.cos((view.lat * Math.PI) / 180), MIN_PX.meridians);
  return {
    parallels: { step: latStep, at: multiples(latStep, south, north).filter((v) => Math.abs(v) < 90) },
    meridians: { step: lonStep, at: multiples(lonStep, view.lon - half, view.lon + half - (round ? 1e-6 : 0)) },
    south, north, west: view.lon - half, east: view.lon + half,
  };
}

// A line's name, as fine as its step.
export function label(degrees, step, signs) {
  const turned = signs === "EW" ? ((((degrees + 180) % 360) + 360) % 360) - 180 : degrees;
  const middle = Math.abs(Math.abs(turned) - 90) > 90 - 1e-9; // the equator, Greenwich or 180°
  const places = Math.max(0, Math.ceil(-Math.log10(step * 3600) - 1e-9));
  const finest = [3600, 60].find((seconds) => step * 3600 > seconds - 1e-6) ?? 1;
  return parts(turned, finest, places) + (middle ? "" : turned < 0 ? signs[1] : signs[0]);
}
