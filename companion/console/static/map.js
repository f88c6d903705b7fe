// The map from above, with everything that has a place.
const EMPTY = { type: "FeatureCollection", features: [] };
// Tracks that coincide are seen one inside the other, the rim of each narrower than the one below.
const TRACKS = [["gnss", "#ffffff", 10], ["autopilot", "#1fd1ff", 6.5], ["vision", "#ff8c1a", 2.5]];
const CHI95 = 2.4477; // of two dimensions
const KEPT = 600;
// Each drawing of a map by the processor takes it from the flight, and holds the page up meanwhile.
const BY_GPU = { everyMs: 500, offCentre: 0 };
const BY_PROCESSOR = { everyMs: 4000, offCentre: 0.25 };

// Whether WebGL here is the processor's work.
export function isDrawnByProcessor() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return true;
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

export class MapView {
  constructor(maplibre, $, ask, about) {
    this.$ = $;
    this.ask = ask;
    this.about = about;
    this.samples = [];
    this.following = true;
    this.hinting = false;
    this.pins = new Map();
    this.moving = new Map(); // name: its features; of one source, so that a change is drawn once
    this.pace = isDrawnByProcessor() ? BY_PROCESSOR : BY_GPU;
    this.drawnAt = -Infinity;
    this.drawings = 0;
    maplibre.setWorkerUrl("/static/vendor/maplibre-gl-worker.mjs");
    this.maplibre = maplibre;
    this.map = new maplibre.Map({
      container: "map", style: style(about), bounds: about.bounds, fitBoundsOptions: { padding: 20 },
      attributionControl: false, dragRotate: false, pitchWithRotate: false, maxZoom: 21, fadeDuration: 0,
    });
    this.map.addControl(new maplibre.ScaleControl());
    this.map.addControl(new maplibre.AttributionControl({ compact: true, customAttribution: about.attribution }));
    this.map.on("load", () => { this.loaded = true; this.draw(); });
    this.map.on("render", () => { this.drawings += 1; });
    this.map.on("dragstart", () => this.follow(false));
    this.map.on("click", (event) => this.clicked(event.lngLat));
    this.craft = this.marker(craftSvg(), "craft");
    $("follow").addEventListener("click", () => this.follow(!this.following));
    $("hint").addEventListener("click", () => {
      this.hinting = true;
      $("map-note").textContent = "click where you are";
    });
  }

  marker(content, name) {
    const element = document.createElement("div");
    element.className = name;
    if (typeof content === "string") element.textContent = content; else element.append(content);
    return new this.maplibre.Marker({ element, anchor: name === "pin" ? "bottom-left" : "center", rotationAlignment: "map" });
  }

  follow(on) {
    this.following = on;
    this.$("follow").setAttribute("aria-pressed", String(on));
  }

  async clicked({ lat, lng }) {
    if (!this.hinting) return;
    this.hinting = false;
    const radius = Number(this.$("radius").value);
    this.put("hint", polygon([lng, lat], circle(lat, radius)));
    this.draw();
    const answer = await this.ask("/api/order", { do: "hint", latitude_deg: lat, longitude_deg: lng, radius_m: radius });
    this.$("map-note").textContent = answer.text;
  }

  addSample(sample) {
    this.samples.push(sample);
    while (this.samples.length > KEPT) this.samples.shift();
  }

  clear() { this.samples = []; }

  update(state) {
    this.state = state;
    if (!this.loaded) return;
    const at = state.estimate;
    if (at) {
      const place = [at.longitude_deg, at.latitude_deg];
      this.craft.setLngLat(place).setRotation(at.heading_deg).addTo(this.map);
      if (this.following) this.centre(place);
    }
    this.pin(state.targets ?? []);
    this.plan(state.mission ?? []);
    if (performance.now() - this.drawnAt >= this.pace.everyMs) this.draw();
  }

  // The aircraft's sign moves by itself; the map under it is drawn anew for every move of its own.
  centre(place) {
    const zoomed = this.zoomed || this.map.getZoom() >= 16;
    this.zoomed = true;
    if (!zoomed) { this.map.jumpTo({ center: place, zoom: 17 }); return; }
    const at = this.map.project(place), box = this.map.getContainer();
    const off = Math.max(Math.abs(at.x / box.clientWidth - 0.5), Math.abs(at.y / box.clientHeight - 0.5));
    if (off > this.pace.offCentre) this.map.jumpTo({ center: place });
  }

  pin(targets) {
    const names = new Set(targets.map((t) => t.name));
    for (const [name, pin] of this.pins) if (!names.has(name)) { pin.remove(); this.pins.delete(name); }
    for (const t of targets) {
      if (!this.pins.has(t.name)) this.pins.set(t.name, this.marker(t.name, "pin").setLngLat([t.longitude_deg, t.latitude_deg]).addTo(this.map));
      this.pins.get(t.name).setLngLat([t.longitude_deg, t.latitude_deg]);
    }
  }

  // The mission's way: from place to place, each with the number of its item.
  plan(places) {
    const key = JSON.stringify(places);
    if (key === this.planned) return;
    this.planned = key;
    this.missionLength = places.length;
    const points = places.map(([, lat, lon]) => [lon, lat]);
    this.put("mission", points.length < 2 ? [] : feature({ type: "LineString", coordinates: points }));
    this.stations?.forEach((station) => station.remove());
    this.stations = places.map(([number, lat, lon]) => this.marker(String(number), "station").setLngLat([lon, lat]).addTo(this.map));
  }

  // Drawn with what is drawn next, not with every picture.
  footprint(points) { this.seen = points; }

  fromEnu(east, north) {
    const [lat, lon] = this.about.origin;
    const [perLat, perLon] = metresPerDegree(lat);
    return [lon + east / perLon, lat + north / perLat];
  }

  draw() {
    if (!this.loaded) return;
    this.drawnAt = performance.now();
    for (const [name] of TRACKS) {
      const points = this.samples.map((s) => s[name]).filter(Boolean).map(([lat, lon]) => [lon, lat]);
      this.put(name, points.length < 2 ? [] : feature({ type: "LineString", coordinates: points }));
    }
    const { estimate, targets } = this.state ?? {};
    if (estimate) {
      const outline = ellipse(estimate.covariance_m2, estimate.latitude_deg);
      this.put("ellipse", polygon([estimate.longitude_deg, estimate.latitude_deg], outline));
    }
    this.put("targets", (targets ?? []).flatMap((t) =>
      polygon([t.longitude_deg, t.latitude_deg], ellipse(t.covariance_m2, t.latitude_deg, 1))));
    if (this.seen) {
      const ring = this.seen.map(([e, n]) => this.fromEnu(e, n));
      this.put("footprint", ring.length < 3 ? [] : feature({ type: "Polygon", coordinates: [[...ring, ring[0]]] }));
      this.seen = null;
    }
    const features = [...this.moving].flatMap(([kind, some]) => some.map((one) => ({ ...one, properties: { kind } })));
    const text = JSON.stringify(features);
    if (text === this.drawn) return;
    this.drawn = text;
    this.map.getSource("moving").setData({ type: "FeatureCollection", features });
  }

  put(name, features) { this.moving.set(name, features); }

  resize() { this.map.resize(); }
}

// Tiles are counted from the 180th meridian on: a map across it has some at either end.
function onEarth([[west, south], [east, north]]) {
  return west < -180 || east > 180 ? [-180, south, 180, north] : [west, south, east, north];
}

function style(about) {
  const sources = {
    top: { type: "raster", tiles: [`${location.origin}/tiles/{z}/{x}/{y}.jpg`], tileSize: 256, minzoom: 8, maxzoom: 21, bounds: onEarth(about.bounds) },
    coverage: { type: "geojson", data: about.outline.length > 2 ? { type: "Polygon", coordinates: [[...about.outline, about.outline[0]]] } : EMPTY },
    moving: { type: "geojson", data: EMPTY },
  };
  const layers = [
    { id: "ground", type: "background", paint: { "background-color": "#9aa3ad" } },
    { id: "top", type: "raster", source: "top", paint: { "raster-fade-duration": 0 } },
    { id: "coverage", type: "line", source: "coverage", paint: { "line-color": "#101418", "line-width": 2, "line-dasharray": [3, 2] } },
  ];
  const layer = (kind, id, type, paint) => layers.push({ id, type, source: "moving", filter: ["==", ["get", "kind"], kind], paint });
  layer("mission", "mission-rim", "line", { "line-color": "#101418", "line-width": 4 });
  layer("mission", "mission", "line", { "line-color": "#7dff5c", "line-width": 2, "line-dasharray": [4, 2] });
  for (const [name, colour, width] of TRACKS) {
    layer(name, `${name}-rim`, "line", { "line-color": "#101418", "line-width": width + 1.5 });
    layer(name, name, "line", { "line-color": colour, "line-width": width });
  }
  for (const [name, colour] of [["footprint", "#ffe14d"], ["ellipse", "#ff8c1a"], ["targets", "#ff2fd0"], ["hint", "#0b4f9e"]]) {
    layer(name, `${name}-fill`, "fill", { "fill-color": colour, "fill-opacity": 0.18 });
    layer(name, name, "line", { "line-color": colour, "line-width": 2 });
  }
  return { version: 8, sources, layers };
}

const feature = (geometry) => [{ type: "Feature", geometry }];

export function metresPerDegree(latitude) {
  const phi = (latitude * Math.PI) / 180;
  return [111132.95 - 559.85 * Math.cos(2 * phi) + 1.18 * Math.cos(4 * phi), 111412.88 * Math.cos(phi) - 93.5 * Math.cos(3 * phi)];
}

function polygon([lon, lat], offsets) {
  const [perLat, perLon] = metresPerDegree(lat);
  return feature({ type: "Polygon", coordinates: [offsets.map(([e, n]) => [lon + e / perLon, lat + n / perLat])] });
}

function circle(_, radius) {
  return Array.from({ length: 49 }, (__, i) => [radius * Math.cos((i * Math.PI) / 24), radius * Math.sin((i * Math.PI) / 24)]);
}

// The 95 % ellipse of a covariance [[ee, en], [en, nn]], never smaller than can be seen.
function ellipse([[a, b], [, c]], _, least = 0.3) {
  const mean = (a + c) / 2, spread = Math.hypot((a - c) / 2, b);
  const major = Math.max(CHI95 * Math.sqrt(Math.max(mean + spread, 0)), least);
  const minor = Math.max(CHI95 * Math.sqrt(Math.max(mean - spread, 0)), least);
  const angle = 0.5 * Math.atan2(2 * b, a - c);
  return circle(0, 1).map(([x, y]) => [
    major * x * Math.cos(angle) - minor * y * Math.sin(angle), major * x * Math.sin(angle) + minor * y * Math.cos(angle)]);
}

function craftSvg() {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "-15 -15 30 30");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", "M0 -14 L9 11 L0 5 L-9 11 Z");
  path.setAttribute("fill", "#ff8c1a");
  path.setAttribute("stroke", "#101418");
  path.setAttribute("stroke-width", "2");
  svg.append(path);
  return svg;
}
