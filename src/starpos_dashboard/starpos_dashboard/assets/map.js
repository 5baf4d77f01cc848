// SPDX-License-Identifier: Apache-2.0
// The Earth as it is seen from above a place, from the whole globe down to centimetres: coast lines, graticule, the track
// of fixes, and the error ellipses at the scale of the map. Lengths are on a sphere, true to 0.6 %.

import { add, element, say } from "/page.js";
import { graticule, label } from "/graticule.js";
import * as text from "/text.js";

const { geoOrthographic, geoPath, geoDistance, geoRotation } = window.d3;

const EARTH_M = 6371008.8; // mean radius
const NEAREST = 0.01; // m a pixel
const COAST = { fades: 3000, ends: 600 }; // m a pixel: nearer, lines of 1:110m would tell what they do not know
const WIDE = 1000; // m a pixel, from which lines are curved and the far side of the globe is left out
const RING_95 = 2.4477; // sigmas of the ellipse that holds 95 %
const BIGGEST_M = 8e6; // of an ellipse that can be drawn
const CORNERS = 90;
const FILL = 0.62; // of the smaller half of the view, which the ellipse takes at most
const BAR_PX = 140;
const RAD = Math.PI / 180;

export class EarthMap {
  constructor(topology) {
    this.land = window.topojson.feature(topology, topology.objects.land);
    this.box = element("map");
    this.svg = element("map-view");
    this.view = { lon: 10, lat: 25, k: 200 };
    this.follow = "fix"; // or "earth"; "place" at a scale of one's own; "" where it was moved
    this.data = { track: [] };
    const layer = (name, attributes) => add(this.svg, name, attributes);
    this.sphere = layer("path", { class: "sphere" });
    this.coast = layer("path", { class: "land" });
    this.lines = layer("path", { class: "graticule" });
    this.labels = layer("g", { class: "labels", "aria-hidden": "true" });
    this.track = layer("path", { class: "track" });
    this.dots = layer("path", { class: "dots" });
    this.ellipses = {};
    for (const which of ["average", "newest"]) {
      const group = layer("g", { class: `ellipse ${which}`, id: `ellipse-${which}` });
      this.ellipses[which] = {
        group,
        outer: add(group, "path", { class: "outer" }),
        inner: add(group, "path", { class: "inner" }),
        mark: add(group, "path", { class: "mark", d: "M-7 0H7M0-7V7" }),
      };
    }
    this.gnss = layer("path", { class: "gnss", id: "map-gnss", d: "M0-8L8 0L0 8L-8 0Z" });
    this.ray = add(this.ellipses.newest.group, "path", { class: "ray", d: "M0-9V-44" });
    this._listen();
    new ResizeObserver(() => this.draw()).observe(this.box);
  }

  // {newest, average: {latitude, longitude, covariance} or null, gnss: {latitude, longitude, status} or null, old,
  // azimuth or null, track: [[number, lat, lon]]}
  show(data) {
    this.data = data;
    this.draw();
  }

  draw() {
    cancelAnimationFrame(this._due);
    this._due = requestAnimationFrame(() => this._draw());
  }

  // the view ----------------------------------------------------------------------------------------------------------

  _draw() {
    const { width, height } = this.box.getBoundingClientRect();
    if (width < 10 || height < 10) return;
    Object.assign(this, { width, height });
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this._place();
    const { lon, lat, k } = this.view;
    this.perPx = EARTH_M / k;
    this.projection = geoOrthographic().rotate([-lon, -lat]).scale(k).translate([width / 2, height / 2]).clipAngle(90);
    this.wide = this.perPx >= WIDE;
    this.path = geoPath(this.projection.clipExtent([[-20, -20], [width + 20, height + 20]]));
    this._drawEarth();
    this._drawGraticule();
    this._drawTrack();
    this._drawEllipse("newest", this.data.newest);
    this._drawEllipse("average", this.data.average);
    this._drawGnss();
    this._drawScale();
    this._describe();
  }

  get _whole() {
    return (Math.min(this.width, this.height) / 2) * 0.94;
  }

  // Where it follows: the newest fix in the middle, at the scale of its ellipse, or the whole Earth.
  _place() {
    const fix = this.data.newest;
    if (this.follow && fix) Object.assign(this.view, { lon: fix.longitude, lat: fix.latitude });
    const near = this.follow === "fix" && fix;
    if (near) this.view.k = EARTH_M / Math.max(this._scaleOf(fix), this._scaleOf(fix, this.data.gnss));
    else if (this.follow === "earth" || (this.follow && !fix)) this.view.k = this._whole;
    this.view.k = Math.min(Math.max(this.view.k, this._whole * 0.8), EARTH_M / NEAREST);
  }

  // m a pixel at which the ellipse is on the map, or another place; in round steps so that it rests while they vary.
  _scaleOf(fix, other) {
    if (other === null) return 0;
    const axis = fix.covariance ? axes(fix.covariance).major : 100;
    const reach = other ? EARTH_M * geoDistance(point(fix), point(other)) : RING_95 * axis;
    return 2 ** (Math.ceil(Math.log2(reach / (FILL * (Math.min(this.width, this.height) / 2))) * 2) / 2);
  }

  // Where a place is in the view, px; null if it is not near it, or there is none.
  _at(place) {
    return place && this._isHere(point(place)) ? this.projection(point(place)) : null;
  }

  // A line through points [lon, lat]. Near, d3 would drop points that are metres apart.
  _line(points) {
    if (this.wide) return this.path({ type: "LineString", coordinates: points }) ?? "";
    const seen = points.filter((p) => this._isHere(p)).map((p) => this.projection(p).map((v) => v.toFixed(2)).join(" "));
    return seen.length > 1 ? `M${seen.join("L")}` : "";
  }

  _isHere(point) {
    const reach = Math.hypot(this.width, this.height) / this.view.k;
    return geoDistance(point, [this.view.lon, this.view.lat]) < Math.min(Math.PI / 2, 40 * reach);
  }

  // what is drawn -----------------------------------------------------------------------------------------------------

  _drawEarth() {
    this.sphere.setAttribute("d", this.wide ? this.path({ type: "Sphere" }) ?? "" : `M0 0H${this.width}V${this.height}H0Z`);
    const shown = Math.min(1, Math.max(0, (this.perPx - COAST.ends) / (COAST.fades - COAST.ends)));
    this.coast.setAttribute("d", shown > 0 ? this.path(this.land) ?? "" : "");
    this.coast.setAttribute("opacity", shown);
  }

  _drawGraticule() {
    const g = graticule(this.view, Math.hypot(this.width, this.height) / 2);
    const between = (from, to, n) => Array.from({ length: n + 1 }, (_, i) => from + ((to - from) * i) / n);
    const [south, north] = [Math.max(g.south, -89.999), Math.min(g.north, 89.999)];
    const lines = [
      ...g.parallels.at.map((lat) => between(g.west, g.east, 72).map((lon) => [lon, lat])),
      ...g.meridians.at.map((lon) => between(south, north, 36).map((lat) => [lon, lat])),
    ];
    this.lines.setAttribute("d", lines.map((line) => this._line(line)).join(""));
    this._drawLabels(g);
  }

  _drawLabels(g) {
    this.labels.replaceChildren();
    const near = (list, value) => list.reduce((a, b) => (Math.abs(b - value) < Math.abs(a - value) ? b : a), list[0]);
    const flat = Math.hypot(this.width, this.height) / this.view.k < 0.1;
    const { lon, lat } = this.view;
    const put = (point, at, said, top) => {
      if (!this._isHere(point)) return;
      const [x, y] = this.projection(point);
      const place = at(x, y);
      if (place[0] > this.width - 270 && place[1] < 48) return; // the buttons
      if (place[0] < 0 || place[0] > this.width - 80 || place[1] < top || place[1] > this.height - 44) return;
      if (place[0] < 175 && place[1] > this.height - 135) return; // the legend
      add(this.labels, "text", { x: place[0], y: place[1] }, said);
    };
    const meridian = flat ? lon : near(g.meridians.at, lon);
    const parallel = flat ? lat : near(g.parallels.at, lat);
    for (const v of g.parallels.at) {
      put([meridian, v], (x, y) => (flat ? [8, y - 4] : [x + 4, y - 4]), label(v, g.parallels.step, "NS"), flat ? 30 : 12);
    }
    for (const v of g.meridians.at) {
      const at = flat ? (x) => [x + 4, 14] : (x, y) => [x + 4, y + 13];
      put([v, parallel], at, label(v, g.meridians.step, "EW"), 12);
    }
  }

  _drawTrack() {
    const points = this.data.track.map(([, lat, lon]) => [lon, lat]);
    this.track.setAttribute("d", points.length > 1 ? this._line(points) : "");
    this.svg.classList.toggle("old", Boolean(this.data.old));
    const dot = ([x, y]) => `M${x.toFixed(1)} ${y.toFixed(1)}h0`;
    const here = points.slice(0, -1).filter((p) => this._isHere(p)).map((p) => this.projection(p));
    const seen = here.filter(([x, y]) => x > -5 && y > -5 && x < this.width + 5 && y < this.height + 5);
    this.dots.setAttribute("d", seen.map(dot).join(""));
  }

  _drawEllipse(which, fix) {
    const { group, inner, outer, mark } = this.ellipses[which];
    const at = this._at(fix);
    group.classList.toggle("hidden", !at);
    if (!at) return;
    const move = translate(at);
    mark.setAttribute("transform", move);
    if (which === "newest") {
      this.ray.setAttribute("transform", `${move} rotate(${this.data.azimuth ?? 0})`);
      this.ray.classList.toggle("hidden", this.data.azimuth === null);
    }
    const drawn = fix.covariance && RING_95 * axes(fix.covariance).major < BIGGEST_M;
    inner.setAttribute("d", drawn ? this._line(ellipse(fix, 1)) : "");
    outer.setAttribute("d", drawn ? this._line(ellipse(fix, RING_95)) : "");
  }

  _drawGnss() {
    const { gnss } = this.data;
    const at = this._at(gnss);
    this.gnss.classList.toggle("hidden", !at);
    element("legend-gnss").classList.toggle("hidden", !gnss);
    element("legend-gnss").dataset.status = gnss?.status ?? "";
    if (!at) return;
    this.gnss.setAttribute("transform", translate(at));
    this.gnss.dataset.status = gnss.status;
  }

  _drawScale() {
    const round = (m) => [5, 2, 1].map((n) => n * 10 ** Math.floor(Math.log10(m))).find((v) => v <= m * 1.0001);
    const length = Math.min(round(BAR_PX * this.perPx), 5e6);
    this.barPx = length / this.perPx;
    element("scale-bar").style.width = `${this.barPx}px`;
    say("scale-text", length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`);
    const coarse = this.perPx < COAST.ends ? "coast lines are too coarse for this scale" : "";
    const far = this.data.newest && !this._inView(this.data.newest) ? "the newest fix is outside this view" : "";
    say("map-note", this.data.newest ? far || coarse : "no position yet");
    for (const name of ["fix", "earth"]) element(`zoom-${name}`).setAttribute("aria-pressed", this.follow === name);
  }

  _inView(fix) {
    const [x, y] = this._at(fix) ?? [-1, -1];
    return x >= 0 && y >= 0 && x <= this.width && y <= this.height;
  }

  _describe() {
    const fix = this.data.newest;
    const across = text.metres(this.width * this.perPx);
    const place = fix ? `${text.sexagesimal(fix.latitude, "NS")}, ${text.sexagesimal(fix.longitude, "EW")}` : "";
    const said = fix ? `map ${across} across, ${this.data.old ? "last" : "newest"} fix at ${place}` : "no position yet";
    this.svg.setAttribute("aria-label", said);
  }

  // hands -------------------------------------------------------------------------------------------------------------

  _zoom(factor) {
    this.follow = this.follow && this.data.newest ? "place" : "";
    this.view.k *= factor;
    this.draw();
  }

  _move(dx, dy) {
    const to = this.projection?.invert([this.width / 2 - dx, this.height / 2 - dy]);
    if (!to || to.some(Number.isNaN)) return;
    this.follow = "";
    Object.assign(this.view, { lon: to[0], lat: Math.max(-89.999, Math.min(89.999, to[1])) });
    this.draw();
  }

  _go(where) {
    this.follow = where;
    this.draw();
  }

  _listen() {
    const buttons = {
      "zoom-in": () => this._zoom(2), "zoom-out": () => this._zoom(0.5),
      "zoom-fix": () => this._go("fix"), "zoom-earth": () => this._go("earth"),
    };
    for (const [id, act] of Object.entries(buttons)) element(id).addEventListener("click", act);
    const keys = {
      ArrowLeft: () => this._move(60, 0), ArrowRight: () => this._move(-60, 0),
      ArrowUp: () => this._move(0, 60), ArrowDown: () => this._move(0, -60),
      "+": () => this._zoom(2), "=": () => this._zoom(2), "-": () => this._zoom(0.5), "0": () => this._go("fix"),
    };
    this.box.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
      keys[event.key]();
      event.preventDefault();
    });
    this.box.addEventListener("wheel", (event) => {
      this._zoom(Math.exp(-Math.max(-200, Math.min(200, event.deltaY)) * 0.003));
      event.preventDefault();
    }, { passive: false });
    this._touch();
  }

  _touch() {
    const held = new Map();
    const apart = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    this.svg.addEventListener("pointerdown", (e) => {
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      this.svg.setPointerCapture(e.pointerId);
    });
    this.svg.addEventListener("pointermove", (e) => {
      const was = held.get(e.pointerId);
      if (!was) return;
      const before = held.size === 2 ? apart() : 0;
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      if (held.size === 1) this._move(e.clientX - was.x, e.clientY - was.y);
      else if (before > 0) this._zoom(apart() / before);
    });
    for (const end of ["pointerup", "pointercancel"]) this.svg.addEventListener(end, (e) => held.delete(e.pointerId));
  }
}

const point = ({ longitude, latitude }) => [longitude, latitude];
const translate = ([x, y]) => `translate(${x.toFixed(2)} ${y.toFixed(2)})`;

// Semi-axes of one sigma [m] and the direction of the longer one, clockwise from north [rad].
export function axes([ee, en, nn]) {
  const mean = (ee + nn) / 2;
  const half = Math.hypot((ee - nn) / 2, en);
  return {
    major: Math.sqrt(mean + half),
    minor: Math.sqrt(Math.max(mean - half, 0)),
    turn: Math.atan2(2 * en, nn - ee) / 2,
  };
}

// [lon, lat] around the ellipse of so many sigmas, on the sphere.
function ellipse(fix, sigmas) {
  const { major, minor, turn } = axes(fix.covariance);
  const here = geoRotation(point(fix).map((degrees) => -degrees));
  return Array.from({ length: CORNERS + 1 }, (_, i) => {
    const t = (2 * Math.PI * i) / CORNERS;
    const [along, across] = [sigmas * major * Math.cos(t), sigmas * minor * Math.sin(t)];
    const north = along * Math.cos(turn) - across * Math.sin(turn);
    const east = along * Math.sin(turn) + across * Math.cos(turn);
    const [arc, bearing] = [Math.hypot(east, north) / EARTH_M, Math.atan2(east, north)];
    const [right, up] = [Math.sin(arc) * Math.sin(bearing), Math.sin(arc) * Math.cos(bearing)];
    return here.invert([Math.atan2(right, Math.cos(arc)) / RAD, Math.asin(up) / RAD]);
  });
}
