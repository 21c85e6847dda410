// The page: talks to the server, draws, and shows what the session says.

import { ACTIONS, Controls, DEVICE_COLUMNS } from "./controls.js";
import { Scene, yawOf } from "./scene.js";

const SEND_MS = 16;  // between messages
const $ = (id) => document.getElementById(id);

const app = {
  status: null, role: null, frames: 0, drawn: 0, errors: [], offset: 0, bestTrip: Infinity, xrFrames: 0,
  applied: null, socket: null, closed: false, failures: 0,
};
window.demohlm = app;  // for other programs that look at this page

const scene = new Scene($("view"));
const controls = new Controls((button) => press(button), () => app.status ? app.status.state : "idle");
controls.headMoves = () => $("head-moves").checked;
app.scene = scene;
app.controls = controls;

// The connection

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.binaryType = "arraybuffer";
  app.socket = socket;
  socket.onmessage = (event) => typeof event.data === "string" ? hear(JSON.parse(event.data)) : see(event.data);
  socket.onclose = () => {
    app.failures++;
    show("link", "the connection is lost" + (app.failures > 3 ? ": open the address that the command has printed last" : ""));
    if (app.status && app.status.state === "saved") return;
    setTimeout(connect, Math.min(1000 * app.failures, 15000));
  };
  socket.onopen = () => { app.bestTrip = Infinity; app.failures = 0; show("link", ""); };
}

function send(content) {
  if (app.socket && app.socket.readyState === WebSocket.OPEN && app.socket.bufferedAmount < 65536) app.socket.send(JSON.stringify(content));
}

function press(button) { if (app.role === "operator") send({ type: "press", button }); }

function hear(message) {
  if (message.type === "hello") {
    app.role = message.role;
    app.grippers = message.grippers;
    document.body.classList.toggle("spectator", app.role !== "operator");
    show("task", `${message.task}: ${message.description}`);
    $("enter-vr").textContent = app.role === "operator" ? "Enter VR" : "Watch in VR";
  } else if (message.type === "status") {
    app.status = message;
    controls.heed(message);
    scene.engaged = message.engaged;
    scene.colors = message.colors;
    render(message);
  } else if (message.type === "pong") {
    const now = Date.now() / 1000, trip = now - message.t;
    if (trip < app.bestTrip) { app.bestTrip = trip; app.offset = message.server - (message.t + trip / 2); }
  } else if (message.type === "error") {
    app.errors.push(message.message);
    show("message", message.message);
    app.errorUntil = performance.now() + 4000;
  } else if (message.type === "invite") {
    $("invitation").hidden = false;
    show("invitation", `open once on the other device: ${message.operator}`);
  }
}

function see(buffer) {
  const count = new DataView(buffer).getUint32(12, true);
  const numbers = new Float32Array(buffer, 16);
  if (!scene.description || count !== scene.description.bodies.length) return;
  scene.bodies = numbers;
  app.frames++;
  if (!scene.home) {
    const p = numbers.subarray(7, 14);  // the pelvis is the first body
    scene.home = [p[0], p[1], yawOf(p)];
    scene.orbit.yaw = scene.home[2] - 2.4;
    scene.orbit.target = [p[0] + 0.25, p[1], 0.75];
  }
}

// What is shown

function show(id, text) { const at = $(id); if (at.textContent !== text) at.textContent = text; }

function list(id, lines, make) {
  const at = $(id), key = JSON.stringify(lines);
  if (at.dataset.key === key) return;
  at.dataset.key = key;
  at.replaceChildren(...lines.map(make));
}

function element(tag, text, className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  made.className = className;
  return made;
}

function render(s) {
  const recording = s.state === "recording", review = s.state === "review";
  $("status").className = s.state;
  const time = (s.tick / 10).toFixed(1);
  show("status", recording ? `recording ${time} s${s.paused ? ", waiting" : ""}` : review ? `review, ${time} s` : s.state);
  show("link", `${s.clients} watching · ${Math.round(100 * s.factor)} % of real time`
    + (s.latency.count ? ` · ${s.latency.p99_ms} ms` : ""));
  show("record", recording ? "End" : "Record");
  $("record").classList.toggle("on", recording);
  $("record").disabled = !["idle", "engaged", "recording"].includes(s.state);
  $("rewind").disabled = !(recording || review);
  $("save").disabled = !review || Boolean(s.verdict && s.verdict.refusal);
  $("discard").disabled = s.state === "saved";
  $("recover").hidden = s.unfinished === 0;
  show("recover", `Take up ${(s.unfinished / 10).toFixed(0)} s unfinished`);
  document.querySelector("[data-grip]").classList.toggle("on", Boolean(controls.grips.left || controls.grips.right));
  if (!(app.errorUntil > performance.now())) show("message", words(s));
  list("warnings", s.warnings, (text) => element("li", text));
  forces(s.forces);
  list("contacts", s.contacts, ([tick, hand, kind, object]) =>
    element("li", `${(tick / 10).toFixed(1)} s: ${hand} ${kind} ${object || "gripper"}`));
  timeline(s);
  $("review").hidden = !review;
  if (review) verdict(s);
  const panel = [...(app.errorUntil > performance.now() ? [$("message").textContent] : []), $("status").textContent + (s.success ? " · success" : ""), words(s), ...s.warnings];
  if (review && s.verdict && s.verdict.trial) panel.splice(1, 0, $("trial-words").textContent);
  if (app.session) scene.say(panel);
  const column = DEVICE_COLUMNS[controls.device] || 4;
  if (app.column !== column) { app.column = column; actions(column); }
}

function words(s) {
  const parts = [];
  if (s.message) parts.push(s.message);
  if (s.success) parts.push(`success for ${s.held_s.toFixed(1)} s`);
  if (s.engaged.some(Boolean)) parts.push(`${["left", "right"].filter((_, i) => s.engaged[i]).join(" and ")} hand engaged`);
  return parts.join(" · ");
}

function forces(values) {
  const table = $("forces"), names = Object.keys(values);
  if (table.rows.length !== names.length) {
    table.replaceChildren(...names.map((name) => {
      const row = document.createElement("tr"), meter = Object.assign(document.createElement("meter"), { max: 40 });
      const middle = document.createElement("td");
      middle.append(meter);
      row.append(element("td", name), middle, element("td", ""));
      return row;
    }));
  }
  names.forEach((name, i) => {
    table.rows[i].cells[1].firstChild.value = values[name];
    table.rows[i].cells[2].textContent = `${values[name].toFixed(1)} N`;
  });
}

function timeline(s) {
  list("timeline", s.segments.length ? [s.tick, ...s.segments] : [], (_, i, all) => {
    if (i > 1) return document.createTextNode("");
    const side = ["left", "right"][i], track = element("div", "", "track");
    const length = Math.max(1, ...s.segments.map((segment) => segment[3]));
    for (const [hand, kind, start, stop, object] of s.segments) {
      if (hand !== side) continue;
      const bar = element("span", object ? `${side}: ${object}` : side, kind);
      bar.style.left = `${100 * start / length}%`;
      bar.style.width = `${100 * (stop - start) / length}%`;
      track.append(bar);
    }
    return track;
  });
}

function verdict(s) {
  const v = s.verdict;
  list("checks", [
    [v.contacts > 0, `${v.contacts} touches found`], [v.held, "success held for 1 s"],
    ...(v.refusal ? [[false, v.refusal]] : [])], ([good, text]) => element("li", text, good ? "good" : "bad"));
  $("trial").hidden = !v.trial;
  if (!v.trial) { show("trial-words", ""); list("reasons", [], () => null); return; }
  $("trial").max = v.trial.attempts;
  $("trial").value = v.trial.done;
  const rate = v.trial.done ? Math.round(100 * v.trial.successes / v.trial.done) : 0;
  show("trial-words", v.trial.error || `trial: ${v.trial.successes} of ${v.trial.done} generated attempts succeed (${rate} %)`
    + (v.trial.finished ? "" : `, ${v.trial.attempts - v.trial.done} to come`));
  list("reasons", v.trial.reasons, ([reason, count]) => element("li", `${count} × ${reason}`));
}

function actions(column) {
  const choice = document.createElement("select");
  choice.id = "device";
  ["headset or hands", "phone", "gamepad", "keyboard and mouse"].forEach((name, i) => choice.append(new Option(name, i + 1, false, i + 1 === column)));
  choice.onchange = () => actions(Number(choice.value));
  const head = document.createElement("tr"), right = document.createElement("th");
  right.append(choice);
  head.append(element("th", "action"), right);
  const rows = ACTIONS.filter((row) => app.grippers || row[0] !== "close a gripper").map((row) => {
    const made = document.createElement("tr");
    made.append(element("td", row[0]), element("td", row[column]));
    return made;
  });
  $("actions").replaceChildren(head, ...rows);
}

// WebXR

async function enter(mode) {
  const phone = mode === "immersive-ar";
  const session = await navigator.xr.requestSession(mode, {
    optionalFeatures: ["local-floor", "hand-tracking", ...(phone ? ["dom-overlay"] : [])],
    ...(phone ? { domOverlay: { root: document.body } } : {}),
  });
  const { gl } = scene;
  if (gl.makeXRCompatible) await gl.makeXRCompatible();
  const quality = scene.coarse ? { antialias: false, framebufferScaleFactor: 0.5 } : {};
  session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, quality) });
  const space = await session.requestReferenceSpace("local-floor").catch(() => session.requestReferenceSpace("local"));
  app.session = session;
  scene.home = null;
  document.body.classList.toggle("ar", phone);
  if (phone) $("touch").hidden = false;
  const frame = (_, seen) => {
    session.requestAnimationFrame(frame);
    app.xrFrames++;
    controls.readXR(seen, space, session);
    if (app.status && app.status.poses) follow(app.status);
    scene.drawXR(session, seen, space, !phone);
    tick();
  };
  session.requestAnimationFrame(frame);
  session.addEventListener("end", () => {
    app.session = null;
    controls.xr = null;
    document.body.classList.remove("ar");
    requestAnimationFrame(loop);
  });
}

function follow(s) {  // the operator goes with a robot that walks, and stands still while it sways
  if (!scene.home) return;
  const p = s.poses.pelvis, turned = Math.atan2(Math.sin(yawOf(p) - scene.home[2]), Math.cos(yawOf(p) - scene.home[2]));
  const away = Math.hypot(p[0] - scene.home[0], p[1] - scene.home[1]);
  if (away > 0.15 || Math.abs(turned) > 0.3) scene.home = [
    scene.home[0] + 0.05 * (p[0] - scene.home[0]), scene.home[1] + 0.05 * (p[1] - scene.home[1]), scene.home[2] + 0.05 * turned];
}

async function offer(id, mode) {
  const possible = navigator.xr && await navigator.xr.isSessionSupported(mode).catch(() => false);
  $(id).disabled = !possible;
  $(id).title = possible ? "" : "this browser has no such device";
  $(id).onclick = () => enter(mode).catch((error) => { app.errors.push(String(error)); show("message", String(error)); });
}

// The clockwork

let sent = 0, pinged = 0;

function tick() {
  const now = performance.now();
  if (app.role === "operator" && now - sent >= SEND_MS - 2 && !app.silent) {
    sent = now;
    const yaw = app.status ? yawOf(app.status.poses.pelvis) : 0;
    send(controls.message(Date.now() / 1000 + app.offset, scene.orbit, yaw, scene.home ? scene.home[2] : yaw));
  }
  if (now - pinged > 1000) { pinged = now; send({ type: "ping", t: Date.now() / 1000 }); }
}

function loop() {
  if (app.session) return;
  requestAnimationFrame(loop);
  if (app.frames !== app.shown || controls.drag || scene.canvas.width !== app.width) {
    app.shown = app.frames;
    scene.drawPage();
    app.width = scene.canvas.width;
    app.drawn++;
  }
}

for (const id of ["record", "rewind", "save", "discard", "recover"]) $(id).onclick = (event) => { press(id); event.target.blur(); };
$("invite").onclick = () => send({ type: "invite" });
$("show-touch").onclick = () => { $("touch").hidden = !$("touch").hidden; if (!$("touch").hidden) controls.device = "phone"; };
if (matchMedia("(pointer: coarse)").matches) $("show-touch").click();
controls.listen($("view"), scene.orbit);
controls.listenTouch($("touch"));
offer("enter-vr", "immersive-vr");
offer("enter-ar", "immersive-ar");
setInterval(() => { if (!app.session) tick(); }, SEND_MS);
await scene.load();
connect();
requestAnimationFrame(loop);
