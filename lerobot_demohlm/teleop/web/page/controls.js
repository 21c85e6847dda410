// Keys, mouse, gamepad, touch and WebXR -> one message for the server; the same actions for all of them.

export const ACTIONS = [
  // action, headset or hands, phone, gamepad, keyboard and mouse
  ["move a hand", "hold squeeze; bare hand: curl three fingers", "hold “left hand”, “right hand”: sticks, or tilt; in AR the phone is the hand", "hold LB, RB: sticks", "1 left, 2 right, 3 both; arrows, PgUp, PgDn; Shift+drag"],
  ["turn a hand", "turn it", "tilt", "hold LB or RB: d-pad", "I K pitch, J L yaw, U O roll"],
  ["both hands together, apart", "move them", "hold both: right stick sideways", "hold LB and RB: right stick sideways", "comma, full stop"],
  ["close a gripper", "trigger; bare hand: pinch", "grip", "LT, RT with LB, RB", "space"],
  ["walk", "left stick (bare hands: none)", "left stick", "left stick", "W S A D"],
  ["turn", "right stick (bare hands: none)", "right stick", "right stick", "Q E"],
  ["squat, rise", "A, B on the right (bare hands: none)", "squat, rise", "d-pad", "F, R"],
  ["record, end", "X on the left; bare hands: in a second browser", "Record", "Start", "Enter"],
  ["rewind 2 s", "Y on the left; bare hands: in a second browser", "Rewind", "Back", "Backspace"],
  ["save, discard", "X, hold Y, in review; bare hands: in a second browser", "Save, Discard", "A, B, in review", "M, Delete"],
];
export const DEVICE_COLUMNS = { headset: 1, hands: 1, phone: 2, gamepad: 3, keyboard: 4 };

const KEY_RATES = {  // forward, left, up, roll, pitch, yaw
  ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [1, 1], ArrowRight: [1, -1], PageUp: [2, 1], PageDown: [2, -1],
  KeyT: [2, 1], KeyG: [2, -1], KeyU: [3, -1], KeyO: [3, 1], KeyI: [4, 1], KeyK: [4, -1], KeyJ: [5, 1], KeyL: [5, -1],
};
const KEY_WALK = { KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1], KeyQ: [2, 1], KeyE: [2, -1] };
const KEY_BUTTONS = { Enter: "record", NumpadEnter: "record", Backspace: "rewind", KeyM: "save", Delete: "discard" };
const SIDES = ["left", "right"];
const CURLED_M = 0.10;  // from wrist to fingertip
const GRIP_STEPS = 3;  // of the world, at least two of them whole: it looks ten times a second
const PINCHED_M = [0.015, 0.06];  // between thumb and index: closed, open

const unit = (x) => Math.max(-1, Math.min(1, x));

export class Controls {
  constructor(press, state) {
    this.press = press;  // a button -> nothing
    this.state = state;  // () -> the session's state
    this.keys = new Set();
    this.chosen = { left: false, right: true };
    this.grips = { left: 0, right: 0 };  // where Space and the grip button want the grippers
    this.grippers = { left: 0, right: 0 };  // where they are
    this.wished = new Set();  // sides for which these were pressed, and that have not been held since
    this.held = { left: false, right: false };  // by the last message
    this.freeAt = { left: 0, right: 0 };  // step at which they were not
    this.touch = { sticks: { left: [0, 0], right: [0, 0] }, hold: { left: false, right: false }, tilt: false, lift: 0 };
    this.drag = null;
    this.orientation = null;  // of a phone, WebXR's quaternion
    this.facing = null;  // heading in which a phone was held as its hand was taken [rad]
    this.device = "keyboard";
    this.pads = {};
    this.steps = 0;  // of the world, that the page was told of
    this.tick = 0;  // of the recording
    this.gripUntil = 0;  // step until which a gripper's key counts
    this.tracked = new Set();  // sides whose controllers have been seen by the headset's cameras
    this.sequence = 0;
    this.xr = null;  // set by the session of WebXR at each of its frames
    this.headMoves = () => true;
  }

  // Events of the page

  listen(canvas, orbit) {
    addEventListener("keydown", (e) => {
      if (["INPUT", "SELECT", "TEXTAREA"].includes(e.target.tagName) && e.target.type !== "checkbox") return;
      if (e.ctrlKey || e.altKey || e.metaKey) return;
      const known = e.code in KEY_RATES || e.code in KEY_WALK || e.code in KEY_BUTTONS
        || ["Space", "Comma", "Period", "KeyR", "KeyF", "Digit1", "Digit2", "Digit3"].includes(e.code);
      if (!known) return;
      e.preventDefault();
      if (e.repeat) return;
      this.device = "keyboard";
      if (e.code in KEY_BUTTONS) this.press(KEY_BUTTONS[e.code]);
      else if (e.code.startsWith("Digit")) this.chosen = { left: e.code !== "Digit2", right: e.code !== "Digit1" };
      else if (e.code === "Space") {
        for (const side of SIDES) { if (this.chosen[side]) this.want(side, 1 - this.grips[side]); }
        this.gripUntil = this.steps + 2 * GRIP_STEPS;
      } else this.keys.add(e.code);
    });
    addEventListener("keyup", (e) => this.keys.delete(e.code));
    addEventListener("blur", () => { this.keys.clear(); this.drag = null; });
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      canvas.focus();
      const hand = e.shiftKey && e.pointerType === "mouse";
      this.drag = { hand, x: e.clientX, y: e.clientY, moved: [0, 0, 0] };
      if (hand) this.device = "keyboard";
    });
    canvas.addEventListener("pointermove", (e) => {
      if (!this.drag) return;
      const dx = e.clientX - this.drag.x, dy = e.clientY - this.drag.y;
      Object.assign(this.drag, { x: e.clientX, y: e.clientY });
      if (this.drag.hand) {
        const metres = 2 * orbit.distance * Math.tan(0.4) / Math.max(1, canvas.clientHeight);
        this.drag.moved[0] += dx * metres;
        this.drag.moved[1] -= dy * metres;
      } else {
        orbit.yaw -= dx * 0.006;
        orbit.pitch = Math.max(-0.05, Math.min(1.5, orbit.pitch + dy * 0.006));
      }
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { this.drag = null; });
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      if (this.drag && this.drag.hand) this.drag.moved[2] += e.deltaY * 0.0005;
      else orbit.distance = Math.max(0.6, Math.min(8, orbit.distance * Math.exp(e.deltaY * 0.001)));
    }, { passive: false });
    addEventListener("deviceorientation", (e) => {
      if (e.alpha !== null) this.orientation = fromOrientation([e.alpha, e.beta, e.gamma].map((d) => d * Math.PI / 180));
    });
  }

  listenTouch(root) {
    for (const side of SIDES) {
      const stick = root.querySelector(`#stick-${side}`), knob = stick.firstElementChild;
      const set = (e) => {
        const box = stick.getBoundingClientRect(), r = box.width / 2;
        let x = (e.clientX - box.left - r) / r, y = (e.clientY - box.top - r) / r;
        const n = Math.max(1, Math.hypot(x, y));
        [x, y] = [x / n, y / n];
        this.touch.sticks[side] = [x, y];
        knob.style.transform = `translate(${x * r * 0.6}px, ${y * r * 0.6}px)`;
        this.device = "phone";
      };
      stick.addEventListener("pointerdown", (e) => { stick.setPointerCapture(e.pointerId); set(e); });
      stick.addEventListener("pointermove", (e) => { if (stick.hasPointerCapture(e.pointerId)) set(e); });
      for (const end of ["pointerup", "pointercancel"]) stick.addEventListener(end, () => {
        this.touch.sticks[side] = [0, 0];
        knob.style.transform = "";
      });
    }
    const hold = (button, down, up) => {
      button.addEventListener("pointerdown", (e) => {
        button.setPointerCapture(e.pointerId);
        button.classList.add("on");
        this.device = "phone";
        down();
      });
      for (const end of ["pointerup", "pointercancel"]) button.addEventListener(end, () => { button.classList.remove("on"); up(); });
    };
    for (const button of root.querySelectorAll("[data-hold]")) {
      const side = button.dataset.hold;
      hold(button, () => { this.touch.hold[side] = true; }, () => { this.touch.hold[side] = false; });
    }
    for (const button of root.querySelectorAll("[data-lift]")) {
      hold(button, () => { this.touch.lift = Number(button.dataset.lift); }, () => { this.touch.lift = 0; });
    }
    root.querySelector("[data-grip]").addEventListener("click", () => {
      const held = SIDES.filter((side) => this.held[side]), sides = held.length ? held : SIDES;
      const grip = sides.some((side) => this.grips[side]) ? 0 : 1;
      for (const side of sides) this.want(side, grip);
    });
    const tilt = root.querySelector("[data-tilt]");
    tilt.addEventListener("click", async () => {
      this.touch.tilt = !this.touch.tilt;
      tilt.classList.toggle("on", this.touch.tilt);
      const ask = window.DeviceOrientationEvent && DeviceOrientationEvent.requestPermission;
      if (ask) await ask.call(DeviceOrientationEvent).catch(() => {});
    });
  }

  // Grippers of keys and touch

  want(side, grip) {
    this.grips[side] = grip;
    this.wished.add(side);
  }

  heed(status) {  // a gripper that a rewind has opened stays open when its hand is held next
    this.steps++;
    if (status.tick < this.tick) this.wished.clear();
    this.tick = status.tick;
    SIDES.forEach((side, i) => {
      this.grippers[side] = status.grippers[i];
      if (!this.held[side] && !this.wished.has(side)) this.grips[side] = Math.round(status.grippers[i]);
    });
  }

  grip(side) {  // a hand takes hold of its gripper as it is, and only then moves it
    return this.steps < this.freeAt[side] + GRIP_STEPS ? this.grippers[side] : this.grips[side];
  }

  // One message

  message(now, orbit, robotYaw, drawnYaw) {  // headings of the robot as it is, and as it is drawn around an operator
    const hands = { left: idle(), right: idle() }, walk = [0, 0, 0];
    let head = null, heading = null, lift = 0;
    if (this.xr) {
      const seen = this.xr;
      head = seen.head;
      heading = Math.atan2(Math.sin(robotYaw - drawnYaw), Math.cos(robotYaw - drawnYaw));
      for (const side of SIDES) Object.assign(hands[side], seen.hands[side]);
      seen.walk.forEach((v, i) => { walk[i] = v; });
      lift = seen.lift;
    } else {
      lift += this.readKeys(hands, walk, orbit, robotYaw);
      lift += this.readSticks(hands, walk, this.touchPad());
      for (const pad of (navigator.getGamepads ? navigator.getGamepads() : [])) {
        if (pad && pad.connected && pad.mapping === "standard") lift += this.readPad(hands, walk, pad);
      }
    }
    for (const side of SIDES) {
      this.held[side] = hands[side].engaged;
      if (this.held[side]) this.wished.delete(side);
      else this.freeAt[side] = this.steps;
    }
    return { type: "input", seq: this.sequence++, t: now, device: this.device, head, heading, lean: this.headMoves(), hands,
      walk: walk.map(unit), lift: unit(lift) };
  }

  readKeys(hands, walk, orbit, robotYaw) {
    const rate = [0, 0, 0, 0, 0, 0];
    for (const code of this.keys) {
      if (code in KEY_RATES) rate[KEY_RATES[code][0]] += KEY_RATES[code][1];
      if (code in KEY_WALK) walk[KEY_WALK[code][0]] += KEY_WALK[code][1];
    }
    const closer = this.keys.has("Comma") - this.keys.has("Period");
    const moving = rate.some((v) => v) || closer || this.steps < this.gripUntil;
    for (const [side, inward] of [["left", -1], ["right", 1]]) {
      if (!this.chosen[side]) continue;
      hands[side].grip = this.grip(side);
      if (moving) {
        hands[side].engaged = true;
        hands[side].rate = rate.map((v, i) => unit(v + (i === 1 ? closer * inward : 0)));
      }
      if (this.drag && this.drag.hand) {
        const [x, y, z] = this.drag.moved, turn = orbit.yaw + Math.PI - robotYaw;  // from the robot's heading to the view's
        hands[side].engaged = true;
        hands[side].pose = [x * Math.cos(turn) - z * Math.sin(turn), y, -x * Math.sin(turn) - z * Math.cos(turn), 1, 0, 0, 0];
      }
    }
    return this.keys.has("KeyR") - this.keys.has("KeyF");
  }

  touchPad() {
    const { sticks, hold, tilt, lift } = this.touch;
    const grips = { left: this.grip("left"), right: this.grip("right") };
    return { left: sticks.left, right: sticks.right, hold, grips, turn: [0, 0, 0], lift, pose: this.tilted(hold, tilt) };
  }

  tilted(hold, tilt) {  // forward is where the top of the screen pointed as the first hand was taken
    if (!tilt || !this.orientation || !(hold.left || hold.right)) {
      this.facing = null;
      return null;
    }
    if (this.facing === null) this.facing = headingOf(this.orientation, screenAngle());
    return [0, 0, 0, ...turnedBack(this.orientation, this.facing)];
  }

  readPad(hands, walk, pad) {
    const value = (i) => pad.buttons[i] ? pad.buttons[i].value : 0, down = (i) => value(i) > 0.5;
    const before = this.pads[pad.index] || {};
    const review = this.state() === "review";
    const edges = { 9: "record", 8: "rewind", 0: review ? "save" : null, 1: review ? "discard" : null };
    for (const [i, button] of Object.entries(edges)) {
      if (button && down(i) && !before[i]) this.press(button);
    }
    this.pads[pad.index] = Object.fromEntries(Object.keys(edges).map((i) => [i, down(i)]));
    const hold = { left: down(4), right: down(5) }, any = hold.left || hold.right;
    if (any || pad.axes.some((a) => Math.abs(a) > 0.3) || pad.buttons.some((b) => b.pressed)) this.device = "gamepad";
    const steps = [value(15) - value(14), value(13) - value(12)];  // d-pad: right and down
    return this.readSticks(hands, walk, {
      left: [pad.axes[0] || 0, pad.axes[1] || 0], right: [pad.axes[2] || 0, pad.axes[3] || 0], hold,
      grips: { left: value(6), right: value(7) }, pose: null,
      turn: any ? [steps[0], steps[1], 0] : [0, 0, 0], lift: any ? 0 : -steps[1],
    });
  }

  readSticks(hands, walk, pad) {  // two sticks move hands that are held, and else the robot
    const both = pad.hold.left && pad.hold.right, dead = (v) => Math.abs(v) < 0.12 ? 0 : v;
    if (!pad.hold.left && !pad.hold.right) {
      walk[0] -= pad.left[1];
      walk[1] -= pad.left[0];
      walk[2] -= pad.right[0];
      return pad.lift;
    }
    for (const [side, inward] of [["left", -1], ["right", 1]]) {
      if (!pad.hold[side]) continue;
      const sideways = -dead(pad.left[0]) - (both ? dead(pad.right[0]) * inward : 0);
      const yaw = both ? 0 : -dead(pad.right[0]);
      const rate = [-dead(pad.left[1]), sideways, -dead(pad.right[1]), pad.turn[0], pad.turn[1], yaw].map(unit);
      Object.assign(hands[side], { engaged: true, rate, grip: pad.grips[side], pose: pad.pose });
    }
    return pad.lift;
  }

  // WebXR

  readXR(frame, space, session) {
    const viewer = frame.getViewerPose(space);
    if (!viewer) {  // tracking is lost: whatever was held or pushed then is not any more
      this.xr = { head: null, hands: { left: idle(), right: idle() }, walk: [0, 0, 0], lift: 0 };
      return;
    }
    const hands = { left: idle(), right: idle() }, walk = [0, 0, 0];
    let lift = 0;
    const buttons = Boolean(session.domOverlayState);  // a phone that shows the page's over the room: it is the held hand
    this.device = buttons ? "phone" : "headset";
    const phoneIs = (sides) => {
      this.device = "phone";
      for (const side of SIDES) {
        if (sides[side]) Object.assign(hands[side], { pose: numbers(viewer.transform), engaged: true, grip: this.grip(side) });
      }
    };
    if (buttons) phoneIs(this.touch.hold);
    for (const source of session.inputSources) {
      if (source.targetRayMode === "screen") {  // a finger on a phone's screen
        if (!buttons) phoneIs(this.chosen);
        continue;
      }
      const side = source.handedness;
      if (!SIDES.includes(side)) continue;
      if (source.hand) {
        this.device = "hands";
        const { engaged, grip } = this.xr ? this.xr.hands[side] : idle();
        Object.assign(hands[side], bareHand(frame, source.hand, space) || { engaged, grip });  // lost: as it was
        continue;
      }
      const pose = source.gripSpace && frame.getPose(source.gripSpace, space), pad = source.gamepad;
      const value = (i) => pad && pad.buttons[i] ? pad.buttons[i].value : 0;
      if (pose && !pose.emulatedPosition) this.tracked.add(side);  // some devices never say so
      const lost = !pose || (pose.emulatedPosition && this.tracked.has(side));
      Object.assign(hands[side], { pose: lost ? null : numbers(pose.transform), engaged: value(1) > 0.5, grip: value(0) });
      const [x, y] = pad ? [pad.axes[2] || 0, pad.axes[3] || 0] : [0, 0];
      if (side === "left") {
        walk[0] -= y;
        walk[1] -= x;
        this.xrButtons(value(4) > 0.5, value(5) > 0.5);
      } else {
        walk[2] -= x;
        lift += (value(5) > 0.5) - (value(4) > 0.5);
      }
    }
    const phone = this.touchPad();
    if (this.device === "phone") { walk[0] -= phone.left[1]; walk[1] -= phone.left[0]; walk[2] -= phone.right[0]; lift += phone.lift; }
    this.xr = { head: this.device === "phone" ? null : numbers(viewer.transform), hands, walk, lift };
  }

  xrButtons(x, y) {
    const review = this.state() === "review", now = performance.now();
    if (x && !this.xDown) this.press(review ? "save" : "record");
    if (y && !this.yDown) this.yAt = now;
    if (review && y && this.yAt && now - this.yAt > 1000) { this.press("discard"); this.yAt = 0; }
    if (!y && this.yDown && this.yAt && now - this.yAt <= 1000) this.press("rewind");
    [this.xDown, this.yDown] = [x, y];
  }
}

function idle() { return { pose: null, engaged: false, grip: 0, rate: [0, 0, 0, 0, 0, 0] }; }

function numbers(transform) {
  const { position: p, orientation: q } = transform;
  return [p.x, p.y, p.z, q.w, q.x, q.y, q.z];
}

function bareHand(frame, hand, space) {
  const joint = (name) => { const at = hand.get(name); const pose = at && frame.getJointPose(at, space); return pose && pose.transform; };
  const wrist = joint("wrist"), thumb = joint("thumb-tip"), index = joint("index-finger-tip");
  if (!wrist || !thumb || !index) return null;
  const apart = (a, b) => Math.hypot(a.position.x - b.position.x, a.position.y - b.position.y, a.position.z - b.position.z);
  const tips = ["middle", "ring", "pinky"].map((finger) => joint(`${finger}-finger-tip`));
  const engaged = tips.every((tip) => tip && apart(tip, wrist) < CURLED_M);
  const [closed, open] = PINCHED_M;
  const grip = Math.max(0, Math.min(1, (open - apart(thumb, index)) / (open - closed)));
  return { pose: numbers(wrist), engaged, grip };
}

function fromOrientation([alpha, beta, gamma]) {  // Z-X'-Y'' of a phone, x right, y up, z out -> quaternion wxyz of WebXR's axes
  const [a, b, c] = [alpha / 2, beta / 2, gamma / 2];
  const q = [
    Math.cos(a) * Math.cos(b) * Math.cos(c) - Math.sin(a) * Math.sin(b) * Math.sin(c),
    Math.cos(a) * Math.sin(b) * Math.cos(c) - Math.sin(a) * Math.cos(b) * Math.sin(c),
    Math.cos(a) * Math.cos(b) * Math.sin(c) + Math.sin(a) * Math.sin(b) * Math.cos(c),
    Math.sin(a) * Math.cos(b) * Math.cos(c) + Math.cos(a) * Math.sin(b) * Math.sin(c)];
  const h = Math.SQRT1_2;  // the world's z is up there, and y is up here: a quarter turn about x
  return [h * q[0] + h * q[1], h * q[1] - h * q[0], h * q[2] + h * q[3], h * q[3] - h * q[2]];
}

function screenAngle() { return (screen.orientation ? screen.orientation.angle : 0) * Math.PI / 180; }

function headingOf([w, x, y, z], angle) {  // about WebXR's y, of the way between the screen's top and its back
  const [a, b, c] = [Math.sin(angle), Math.cos(angle), -1];  // in the phone's axes: x right, y up, z out of the screen
  const right = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c;
  const back = 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c;
  return Math.atan2(-right, -back);
}

function turnedBack([w, x, y, z], heading) {
  const c = Math.cos(heading / 2), s = -Math.sin(heading / 2);
  return [c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x];
}
