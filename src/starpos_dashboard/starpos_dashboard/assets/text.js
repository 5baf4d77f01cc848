// SPDX-License-Identifier: Apache-2.0
// Numbers as people read them, with no more digits than their error leaves. What is not known is a dash.

export const UNKNOWN = "—";
const known = (value) => typeof value === "number" && Number.isFinite(value);

// Decimals whose last digit is half of the error at most.
const decimals = (sigma, unknown, most = 6) =>
  known(sigma) && sigma > 0 ? Math.min(most, Math.max(0, Math.ceil(-Math.log10(sigma / 2)))) : unknown;

// The size of an angle as degrees, minutes and seconds, rounded to `finest` arcseconds, 3600, 60 or 1, or to decimals of one.
export function parts(degrees, finest, places) {
  const units = 10 ** places;
  const exact = Math.round((Math.abs(degrees) * 3600 * units) / finest) * finest;
  const pad = (n, width = 2) => String(n).padStart(width, "0");
  const seconds = ((exact % (60 * units)) / units).toFixed(places);
  let said = `${Math.floor(exact / (3600 * units))}°`;
  if (finest < 3600) said += `${pad(Math.floor(exact / (60 * units)) % 60)}′`;
  if (finest < 60) said += `${pad(seconds, places ? 3 + places : 2)}″`;
  return said;
}

// The same with the hemisphere; sigma in degrees says how far down.
export function sexagesimal(degrees, signs, sigma) {
  if (!known(degrees)) return UNKNOWN;
  const finest = known(sigma) && sigma > 1 ? 3600 : known(sigma) && sigma > 1 / 12 ? 60 : 1;
  const places = decimals(known(sigma) ? sigma * 3600 : null, 1, 3);
  return `${parts(degrees, finest, places)} ${degrees < 0 ? signs[1] : signs[0]}`;
}

// An angle with a sign, in degrees.
export function decimal(degrees, sigma, most = 6) {
  return known(degrees) ? `${degrees.toFixed(decimals(sigma, 5, most)).replace("-", "−")}°` : UNKNOWN;
}

// An azimuth from 000 to 360.
export function azimuth(degrees, sigma) {
  if (!known(degrees)) return UNKNOWN;
  const places = decimals(sigma, 2, 4);
  const turned = Number(degrees.toFixed(places)) % 360;
  return `${turned.toFixed(places).padStart(places ? 4 + places : 3, "0")}°`;
}

// Three digits at most, in the unit that fits; steps: [[smallest, unit, factor], ...].
function scaled(value, steps) {
  if (!known(value)) return UNKNOWN;
  const [, unit, factor] = steps.find(([least]) => value >= least) ?? steps[steps.length - 1];
  const shown = value * factor;
  const places = shown >= 99.5 || shown === 0 ? 0 : shown >= 9.95 ? 1 : 2;
  return `${shown.toFixed(places)}${unit}`;
}

export const metres = (value) =>
  scaled(value, [[999.5, " km", 1e-3], [0.9995, " m", 1], [0, " cm", 100]]);
export const angle = (degrees) => scaled(degrees, [[1, "°", 1], [1 / 60, "′", 60], [0, "″", 3600]]);

// How long ago.
export function age(seconds) {
  if (!known(seconds)) return UNKNOWN;
  const s = Math.max(0, Math.round(seconds));
  if (s < 100) return `${s} s`;
  if (s < 6000) return `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
  if (s < 172800) return `${Math.floor(s / 3600)} h ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")} min`;
  return `${Math.floor(s / 86400)} days`;
}

const iso = (unix) => new Date(unix * 1000).toISOString();
export const utcTime = (unix) => (known(unix) ? iso(unix).slice(11, 21) : UNKNOWN);
export const utcDate = (unix) => (known(unix) ? iso(unix).slice(0, 10) : UNKNOWN);
