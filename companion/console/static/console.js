import * as maplibre from "./vendor/maplibre-gl.mjs";
import { toMgrs } from "./mgrs.js";
import { Plots } from "./plots.js";
import { MapView } from "./map.js";
import { VideoView } from "./video.js";

const $ = (id) => document.getElementById(id);
const page = { about: null, state: null, connected: false, earlier: [], heardAt: 0 };
const SILENT_MS = 3000; // states come twice a second

export async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST", body: JSON.stringify(body),
    headers: { "Content-Type": "application/json", "X-Console": "1" },
  };
  try {
    const answer = await fetch(path, options);
    return await answer.json();
  } catch {
    return { ok: false, text: "the console does not answer" };
  }
}

// --- views ---------------------------------------------------------------------------------------

const opened = {
  records: showRecords, settings: showSettings, doctor: showDoctor,
  plots: () => plots.resize(), map: () => map?.resize(),
};

function open(view) {
  document.body.dataset.view = view;
  document.querySelectorAll("nav button").forEach((button) => {
    const chosen = button.dataset.view === view;
    button.setAttribute("aria-current", String(chosen));
    if (chosen) button.scrollIntoView({ block: "nearest", inline: "nearest" });
  });
  wish();
  opened[view]?.();
}
document.querySelectorAll("nav button").forEach((button) => {
  button.addEventListener("click", () => open(button.dataset.view));
});

// --- state ---------------------------------------------------------------------------------------

const text = (value, digits, unit = "") =>
  value === null || value === undefined ? "-" : `${value.toFixed(digits)}${unit}`;

function showState() {
  const { state, connected } = page;
  const about = page.hello ?? {};
  const health = state?.health ?? {};
  const header = $("state");
  if (!connected || !state) {
    header.dataset.level = "off";
    $("word").textContent = page.gone ? "no console" : page.about?.replay ? "record" : "no flight";
    $("reason").textContent = page.gone
      ? "the console does not answer: it ended with the flight; `companion console` shows the records"
      : "the companion is not running; records, doctor and settings are at hand";
    if (!state) return;
  } else if (silentMs() > SILENT_MS) {
    header.dataset.level = "off";
    $("word").textContent = "silent";
    $("reason").textContent = `nothing heard for ${Math.round(silentMs() / 1000)} s: all here is as old`;
  } else {
    header.dataset.level = health.level ?? "off";
    const word = state.estimate?.state ?? health.level ?? "-";
    $("word").textContent = health.level === "failed" && word === "tracking" ? "withheld" : word;
    $("reason").textContent = health.text ?? "";
  }
  const estimate = state.estimate;
  const fixNs = estimate?.last_fix_ns;
  const age = fixNs ? (state.time_ns - fixNs) * 1e-9 : null;
  const latency = health.stages_ms?.latency?.p95;
  const vehicle = state.vehicle ?? {};
  const limit = about.delay_ms;
  figures([
    ["fix age", text(age, 1, " s"), age !== null && age > 2],
    ["rate", text(health.rate_hz, 1, " Hz")],
    ["sigma", text(estimate?.accepted ? estimate.sigma_m : null, 2, " m")],
    ["HPL", text(health.guardian?.hpl_m, 1, " m"), health.guardian?.hpl_m > about.alert_limit_m],
    ["latency p95", `${text(latency, 0)}/${text(limit, 0, " ms")}`, latency > limit],
    ["mode", mode(about.mode, state.injecting), false, true],
    ["EKF", ekf(vehicle, state.follows), state.follows?.used === false, true],
    ["vehicle", aboutVehicle(vehicle), !vehicle.connected && !page.about?.replay, true],
    ["shadow", state.shadow ? (state.shadow.go ? "ready" : "not ready") : "-", false, true],
  ]);
  $("figures").title = state.shadow?.line ?? "";
}

// A flight or console that hangs says nothing, and what it said last looks as good as new.
function silentMs() {
  return page.connected && !page.about?.replay ? performance.now() - page.heardAt : 0;
}
setInterval(() => { if (silentMs() > SILENT_MS) showState(); }, 500);

// What happens, not what is allowed: lost, nothing is sent, whatever the gate says.
function mode(name, injecting) {
  if (name !== "inject" || page.about?.replay) return name ?? "-";
  return injecting ? "inject: sends positions" : "inject: sends none";
}

function aboutVehicle(vehicle) {
  if (vehicle.connected) return `${vehicle.mode || "?"}${vehicle.armed ? ", armed" : ", disarmed"}`;
  return page.about?.replay ? "-" : "not heard";
}

function ekf(vehicle, follows) {
  if (follows) return follows.used ? "follows" : `not: ${follows.reason}`;
  const ratio = vehicle.ekf_horizontal_variance;
  return ratio === null || ratio === undefined ? "-" : `ratio ${ratio.toFixed(2)}`;
}

function figures(rows) {
  const list = $("figures");
  while (list.children.length < rows.length) {
    const row = document.createElement("div");
    row.append(document.createElement("dt"), document.createElement("dd"));
    list.append(row);
  }
  rows.forEach(([name, value, bad, word], i) => {
    const [dt, dd] = list.children[i].children;
    dt.textContent = name;
    dd.textContent = value;
    dd.className = `${bad ? "bad" : ""} ${word ? "word" : ""}`;
  });
}

// --- targets, events -----------------------------------------------------------------------------

function showTargets(targets) {
  const body = $("targets").tBodies[0];
  $("no-targets").hidden = targets.length > 0;
  while (body.rows.length > targets.length) body.deleteRow(-1);
  targets.forEach((target, i) => {
    const row = body.rows[i] ?? newTargetRow(body);
    const place = `${target.latitude_deg.toFixed(7)}, ${target.longitude_deg.toFixed(7)}`;
    const geoid = page.about?.map?.geoid_separation_m;
    const amsl = target.amsl_m ?? (geoid === undefined ? null : target.height_m - geoid);
    const cells = [target.name, place, toMgrs(target.latitude_deg, target.longitude_deg),
      text(amsl, 1), text(target.height_m, 1), text(target.sigma_m, 2)];
    cells.forEach((value, k) => { row.cells[k].textContent = value; });
    row.dataset.place = `${target.name} ${place} ${cells[2]} AMSL ${cells[3]} m`;
  });
}

function newTargetRow(body) {
  const row = body.insertRow();
  for (let k = 0; k < 7; k += 1) row.insertCell();
  const button = document.createElement("button");
  button.textContent = "Copy";
  button.addEventListener("click", async () => {
    try { await navigator.clipboard.writeText(row.dataset.place); button.textContent = "Copied"; }
    catch { button.textContent = "cannot copy"; }
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
  row.cells[6].append(button);
  return row;
}

const eventsSeen = new Set();
function addEvents(events, state) {
  const list = $("events");
  for (const event of events ?? []) {
    if (eventsSeen.has(event.number)) continue;
    eventsSeen.add(event.number);
    const item = document.createElement("li");
    item.className = event.level === "warning" ? "warning" : "info";
    const time = document.createElement("time");
    const utc = new Date((state.utc_ns - (state.time_ns - event.time_ns)) / 1e6);
    time.textContent = utc.toISOString().slice(11, 19);
    item.append(time, document.createTextNode(event.text));
    list.prepend(item);
    while (list.children.length > 300) list.lastChild.remove();
  }
}

// --- doctor, records, settings -------------------------------------------------------------------

let doctorTimer = null;
async function showDoctor() {
  const report = await ask("/api/doctor");
  if (report.lines) {
    $("doctor").textContent = report.lines.join("\n");
    const words = { 0: "good", 1: "advice", 2: "not fit to fly" };
    $("doctor-told").textContent = report.running ? "at work" : words[report.code] ?? "";
  } else $("doctor-told").textContent = report.text;
  clearTimeout(doctorTimer);
  if (report.running) doctorTimer = setTimeout(showDoctor, 500);
}
$("examine").addEventListener("click", async () => {
  const report = await ask("/api/doctor", {});
  if (report.ok === false) $("doctor-told").textContent = report.text;
  else showDoctor();
});

async function showRecords() {
  const records = await ask("/api/records");
  const body = $("records").tBodies[0];
  body.replaceChildren();
  for (const record of Array.isArray(records) ? records : []) {
    const row = body.insertRow();
    const began = record.started_utc_ns ? new Date(record.started_utc_ns / 1e6).toISOString().slice(0, 19) : "-";
    for (const value of [record.name, began, record.ended]) row.insertCell().textContent = value;
    const cell = row.insertCell();
    for (const [kind, label] of [["report", "report"], ["tar", "download"]]) {
      const link = document.createElement("a");
      link.href = `/api/records/${encodeURIComponent(record.name)}/${kind}`;
      link.textContent = label;
      if (kind === "report") { link.target = "_blank"; link.rel = "noopener"; }
      cell.append(link, " ");
    }
  }
}

let help = [];
async function showSettings() {
  if ($("settings-text").value) return;
  const shown = await ask("/api/deployment");
  if (!shown.path) { $("settings-told").textContent = shown.text; return; }
  $("settings-path").textContent = shown.path;
  $("settings-text").value = shown.text;
  $("settings-text").readOnly = !shown.editable;
  help = shown.help;
  showHelp();
}
function showHelp() {
  const wanted = $("find").value.toLowerCase();
  const body = $("help").tBodies[0];
  body.replaceChildren();
  for (const line of help.filter((h) => `${h.key} ${h.text}`.toLowerCase().includes(wanted))) {
    const row = body.insertRow();
    for (const value of [line.key, line.default, line.text]) row.insertCell().textContent = value;
  }
}
$("find").addEventListener("input", showHelp);
for (const [id, write] of [["check", false], ["write", true]]) {
  $(id).addEventListener("click", async () => {
    const answer = await ask("/api/deployment", { text: $("settings-text").value, write });
    $("settings-told").textContent = answer.text;
  });
}

// --- the line to the server ----------------------------------------------------------------------

let socket = null;
let shown = 0; // pictures; the server holds back what would come too late
function wish() {
  if (socket?.readyState !== WebSocket.OPEN) return;
  const narrow = matchMedia("(max-width: 800px)").matches;
  const frames = !document.hidden && (!narrow || ["map", "video"].includes(document.body.dataset.view));
  socket.send(JSON.stringify({ frames, map: video.needsMap, shown, width: video.widthPx }));
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { shown = 0; page.gone = false; wish(); };
  socket.onclose = () => { page.connected = false; page.gone = true; showState(); setTimeout(connect, 1000); };
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") { video.show(data).finally(() => { shown += 1; wish(); }); return; }
    const message = JSON.parse(data);
    Object.assign(page, { state: message.state, hello: message.about, connected: message.connected });
    page.heardAt = performance.now();
    showState();
    if (!message.state) return;
    window.consoleLinkS = message.state.machine?.console_link_s;
    showTargets(message.state.targets ?? []);
    addEvents([...page.earlier.splice(0), ...(message.state.events ?? [])], message.state);
    map?.update(message.state);
    if (message.sample) { plots.add(message.sample); map?.addSample(message.sample); }
    if (page.about?.replay) showTime(message.state.replay);
  };
}
document.addEventListener("visibilitychange", wish);
addEventListener("resize", wish);

// --- replay --------------------------------------------------------------------------------------

let held = false;
function showTime(replay) {
  if (!replay) return;
  if (!held) $("seek").value = Math.round((1000 * replay.at_s) / Math.max(replay.length_s, 1e-6));
  $("clock").textContent = `${replay.at_s.toFixed(1)} of ${replay.length_s.toFixed(1)} s`;
  $("play").textContent = replay.playing ? "Pause" : "Play";
}
let asked = 0;
$("seek").addEventListener("input", async () => {
  held = true;
  const number = (asked += 1);
  await ask("/api/seek", { share: $("seek").value / 1000 });
  if (number !== asked) return; // the bar went on
  await showHistory();
  held = false;
});
$("play").addEventListener("click", () => ask("/api/seek", { play: $("play").textContent === "Play" }));

// --- begin ---------------------------------------------------------------------------------------

const plots = new Plots($("plots"));
const video = new VideoView($, ask, () => page, wish);
let map = null;

async function showHistory() {
  const history = await ask("/api/history");
  page.earlier = history.events ?? [];
  plots.clear(); map?.clear();
  (history.samples ?? []).forEach((sample) => { plots.add(sample, false); map?.addSample(sample); });
  plots.draw(); map?.draw();
}

async function begin() {
  open("map");
  page.about = await ask("/api/about");
  document.body.classList.toggle("reads", !page.about.control);
  document.body.classList.toggle("record", Boolean(page.about.replay));
  $("time").hidden = !page.about.replay;
  if (page.about.map) {
    try { map = new MapView(maplibre, $, ask, page.about.map); }
    catch (error) { $("map-note").textContent = `no map: ${error.message}`; }
  } else $("map-note").textContent = page.about.text ?? "no map";
  window.consoleMap = map;
  await showHistory();
  connect();
}
begin();
