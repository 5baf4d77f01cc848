// SPDX-License-Identifier: Apache-2.0
// What the page shows of the newest state, again twice a second: what nobody renews grows old by itself.

import { Bubble } from "/bubble.js";
import { Compass } from "/compass.js";
import { showBudget, showLights } from "/lists.js";
import { EarthMap } from "/map.js";
import { dress, element, say } from "/page.js";
import { offerPlace } from "/place.js";
import * as text from "/text.js";

const TICK_MS = 500;
const SILENT_MS = 5000; // the node speaks every second
const AGAIN_MS = 3000;
const AHEAD_S = 1; // a stamp further in the future is told
const MAX_TRACK = 10000;
const OWN_SOLUTION = /^[^/]+: Solution$/; // another instrument's name has its namespace

let state = { lights: [], old_after: { slow: 15, fast: 5 } };
let received = -Infinity; // when the state came
let track = [];
let full = 0;
let map = null;
const compass = new Compass(element("compass"));
const bubble = new Bubble(element("bubble"));

// the line to the node ------------------------------------------------------------------------------------------------

let line = null;
let again = 0;

const alive = () => performance.now() - received < SILENT_MS;

function listen() {
  hangUp();
  line = new EventSource("/events");
  line.addEventListener("state", (event) => {
    [state, received, full] = [JSON.parse(event.data), performance.now(), 0];
    showFrame();
    render();
  });
  line.addEventListener("track", (event) => {
    const { begin, points } = JSON.parse(event.data);
    track = (begin ? points : track.concat(points)).slice(-MAX_TRACK);
  });
  line.addEventListener("full", (event) => {
    full = Number(event.data);
    render();
  });
  line.addEventListener("error", () => {
    if (line.readyState !== EventSource.CLOSED) return; // the browser comes again by itself
    clearTimeout(again);
    again = setTimeout(listen, AGAIN_MS);
  });
}

function hangUp() {
  clearTimeout(again);
  line?.close();
}

// ages --------------------------------------------------------------------------------------------------------------

const elapsed = () => (performance.now() - received) / 1000;
const heardAgo = (told) => told.age + elapsed();
const stampAge = (told) => (told.stamp === null ? heardAgo(told) : state.now + elapsed() - told.stamp);

// Of what comes with a frame: neither the message nor what it tells of may be old.
const oldness = (told) => Math.max(heardAgo(told), stampAge(told));
const isOld = (told) => oldness(told) > state.old_after.slow || !alive();
const fresh = (told) => (told && !isOld(told) ? told : null);

function dressByAge(name, told, none) {
  const old = Boolean(told) && isOld(told);
  dress(name, told ? (old ? "old" : "") : "missing", told ? (old ? `${text.age(oldness(told))} old` : "") : none);
}

// the cards -----------------------------------------------------------------------------------------------------------

function render() {
  const { fix } = state;
  showStatus(fix);
  showPosition(fix);
  showTime();
  showHeading();
  showTilt();
  showErrors();
  const lights = state.lights.map((light) => ({ ...light, age: heardAgo(light) }));
  showLights(element("lights"), lights, state.old_after.fast);
  showLights(element("clocks"), lights.filter((l) => l.name.endsWith(": Clock")), state.old_after.fast);
  const deflections = lights.filter((l) => l.name.endsWith(": Deflection"));
  element("deflection-card").hidden = !deflections.length;
  showLights(element("deflection"), deflections, state.old_after.fast);
  say("lights-note", lights.length ? "" : "no diagnostics yet");
  dressFrame();
}

function verdict(fix) {
  const solution = fresh(state.solution);
  const said = solution && !solution.good ? solution.sentence : "";
  const solver = state.lights.find((l) => OWN_SOLUTION.test(l.name) && heardAgo(l) < state.old_after.fast);
  const why = said || (solver && solver.level > 0 ? solver.sentence : "");
  if (full) return ["lost", "No place", `${full} pages are open already, as many as the parameter clients allows`];
  if (!alive()) return ["lost", "No connection", "the dashboard node is silent: what is shown is of the past"];
  if (!fix) return ["none", "No fix yet", why || "nothing has come on the topic fix"];
  if (isOld(fix) && heardAgo(fix) <= state.old_after.slow) {
    return ["old", "Old fix", `it was taken ${text.age(stampAge(fix))} ago: a replay, or a clock that is wrong`];
  }
  if (isOld(fix)) return ["old", "No fix now", why || `nothing has come on the topic fix for ${text.age(heardAgo(fix))}`];
  if (!fix.good) return ["none", "No fix", why || fix.trouble];
  if (stampAge(fix) < -AHEAD_S) {
    return ["old", "Fix", `its time lies ${text.age(-stampAge(fix))} ahead of this machine's clock`];
  }
  return ["good", "Fix", fix.trouble || summary(fix)];
}

function summary(fix) {
  const { east, north } = sigmas(fix);
  const solution = fresh(state.solution);
  const stars = solution?.good ? `, ${solution.stars_matched} stars` : "";
  return `± ${text.metres(east)} east, ± ${text.metres(north)} north${stars}`;
}

function showStatus(fix) {
  const [kind, word, sentence] = verdict(fix);
  element("status").className = kind;
  say("status-word", word);
  say("status-sentence", sentence);
  say("clock", alive() ? `${text.utcTime(state.now).slice(0, 8)} UTC` : "");
}

function sigmas(fix) {
  const [east, north] = fix?.covariance ? [Math.sqrt(fix.covariance[0]), Math.sqrt(fix.covariance[2])] : [null, null];
  const degree = 111195; // m
  const across = degree * Math.max(Math.cos((fix?.latitude * Math.PI) / 180), 1e-6);
  return { east, north, latitude: north && north / degree, longitude: east && east / across };
}

function showPosition(fix) {
  const good = fix?.good ? fix : null;
  const s = sigmas(good);
  const last = good || state.last_fix || null;
  dressByAge("position", good, "no fix");
  say("latitude", text.sexagesimal(good?.latitude, "NS", s.latitude));
  say("longitude", text.sexagesimal(good?.longitude, "EW", s.longitude));
  say("sigma-east", good ? `± ${text.metres(s.east)}` : text.UNKNOWN);
  say("sigma-north", good ? `± ${text.metres(s.north)}` : text.UNKNOWN);
  say("altitude", text.metres(good?.altitude));
  say("decimal", good ? plain(good, s) : last ? `last fix ${plain(last, sigmas(last))}, ${text.age(stampAge(last))} ago` : "");
  offerPlace(good);
  const average = fresh(good) && fresh(state.averaged)?.good ? state.averaged : null;
  const a = sigmas(average);
  const both = ["latitude", "longitude"].map((n, i) => text.sexagesimal(average?.[n], ["NS", "EW"][i], a[n]));
  say("average", average ? both.join("  ") : text.UNKNOWN);
  say("average-sigma", average ? `± ${text.metres(a.east)} east, ± ${text.metres(a.north)} north` : "");
  const azimuth = fresh(state.heading)?.azimuth ?? null;
  map?.show({ newest: last, average, gnss: showGnss(), old: !fresh(good), azimuth, track });
}

// The GNSS place of the newest frame, null without one, and what the guard says of it.
function showGnss() {
  const gnss = fresh(state.gnss);
  element("gnss").hidden = !gnss;
  if (!gnss) return null;
  element("gnss").dataset.status = gnss.status;
  say("gnss-word", gnss.status);
  say("gnss-place", `${text.decimal(gnss.latitude)} ${text.decimal(gnss.longitude)}`);
  say("gnss-sentence", gnss.sentence);
  return gnss.latitude === null || gnss.longitude === null ? null : gnss;
}

const plain = (fix, s) => `${text.decimal(fix.latitude, s.latitude)} ${text.decimal(fix.longitude, s.longitude)}`;

function showTime() {
  const last = state.last_fix ?? null;
  const solution = fresh(state.solution);
  element("time-card").classList.toggle("old", !fresh(last));
  say("fix-time", text.utcTime(last?.stamp));
  say("fix-date", text.utcDate(last?.stamp));
  const age = last && stampAge(last);
  say("fix-age", !last ? text.UNKNOWN : age < -AHEAD_S ? `${text.age(-age)} ahead` : text.age(age));
  say("stars", solution ? `${solution.stars_matched} of ${solution.stars_detected}` : text.UNKNOWN);
  say("residual", solution?.residual != null ? `${solution.residual.toFixed(2)}″` : text.UNKNOWN);
  say("warnings", solution?.warnings.length ? `identification: ${solution.warnings.join(", ")}` : "");
}

function showHeading() {
  const { heading } = state;
  dressByAge("heading", heading, "none");
  compass.show(heading);
  compass.showSun(state.sun);
  say("heading", text.azimuth(heading?.azimuth, heading?.sigma));
  say("heading-sigma", heading ? ` ± ${text.angle(heading.sigma)}` : "");
  say("heading-frame", heading ? `of ${heading.frame}` : "");
}

function showTilt() {
  const { tilt } = state;
  const old = Boolean(tilt) && (heardAgo(tilt) > state.old_after.fast || !alive());
  const missing = !tilt || tilt.x === null || tilt.y === null;
  dress("tilt", old ? "old" : missing ? "missing" : "", old ? `${text.age(heardAgo(tilt))} old` : "");
  bubble.show(tilt);
  for (const axis of ["x", "y"]) {
    const sigma = tilt?.[`sigma_${axis}`];
    const error = sigma ? ` ± ${text.angle(sigma)}` : "";
    say(`theta-${axis}`, tilt?.[axis] == null ? text.UNKNOWN : text.decimal(tilt[axis], sigma ?? 0.005, 4) + error);
  }
  say("tilt-warmth", tilt?.temperature != null ? `${tilt.temperature.toFixed(1)} °C` : text.UNKNOWN);
  say("tilt-flags", tilt?.flags.join(", ") ?? "");
}

function showErrors() {
  const solution = state.solution?.good ? state.solution : null;
  dressByAge("budget", solution, "none");
  showBudget(solution?.budget ?? []);
  say("budget-note", solution ? "plain: new in every frame; striped: stays, however long the average" : "");
}

// the frame -----------------------------------------------------------------------------------------------------------

const picture = element("frame");
let frameNumber = 0;

function showFrame() {
  const number = state.frame && !state.frame.trouble ? state.frame.number : 0;
  if (!number) {
    frameNumber = 0;
    picture.hidden = true;
  } else if (number !== frameNumber) {
    frameNumber = number;
    picture.src = `/frame.jpg?${number}`;
    picture.alt = `annotated frame of ${text.utcTime(state.frame.stamp)} UTC`;
  }
}

picture.addEventListener("load", () => (picture.hidden = !frameNumber));
picture.addEventListener("error", () => (picture.hidden = true));

function dressFrame() {
  const { frame } = state;
  dressByAge("frame", frame, "");
  say("frame-note", frame ? frame.trouble : "no frame yet: the detector draws the next one");
}

// A page that nobody sees hears nothing, and the detector draws no frame for it.
function look() {
  if (document.hidden) hangUp();
  else listen();
}

// night ---------------------------------------------------------------------------------------------------------------

let night = localStorage.getItem("night") === "on";

element("night").addEventListener("click", () => {
  night = !night;
  localStorage.setItem("night", night ? "on" : "off");
  dressNight();
});

function dressNight() {
  document.documentElement.classList.toggle("night", night);
  element("night").setAttribute("aria-pressed", night);
}

// the beginning -------------------------------------------------------------------------------------------------------

dressNight();
render();
document.addEventListener("visibilitychange", look);
look();
setInterval(render, TICK_MS);
const answer = await fetch("/land-110m.json");
map = new EarthMap(await answer.json());
render();
