"""The page in a real browser: an emulated headset, keys, a gamepad, touch, onlookers; and whole recordings."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm import poses
from lerobot_demohlm.benchmarks.teleoperation import HEADSET
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.replay import replay
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.teleop.clutch import DEAD_ZONE, WALK_SPEED
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.web import protocol
from tests.helpers.teleop import HeadsetHands, Served, opened, serving, statuses, view_of, wait_for

PAD = """
window.pad = {index: 0, connected: true, mapping: "standard", axes: [0, 0, 0, 0],
  buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))};
window.padSet = (i, v) => { pad.buttons[i] = {pressed: v > 0.5, value: v}; };
navigator.getGamepads = () => [window.pad];
"""

CAUGHT_UP_M = 0.004
BOXES = """
[...document.querySelectorAll('button, #status, #task, #stage > p, section p, section table')]
  .filter(e => e.checkVisibility() && !e.closest('#touch'))
  .map(e => { const b = e.getBoundingClientRect(); return [e.id || e.textContent, b.left, b.top, b.right, b.bottom]; })
  .filter(b => b[3] > b[1] && b[4] > b[2])
"""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving("GraspCube", tmp_path_factory.mktemp("page") / "grasp") as made:
        yield made


@pytest.fixture(autouse=True)
def fresh(request: pytest.FixtureRequest) -> None:
    """Have the session begin anew."""
    if "served" in request.fixturenames:
        server = request.getfixturevalue("served").server
        server._presses.append((next(iter(server._clients), None), "discard"))


def target(page: Any, side: str) -> np.ndarray:
    return np.array(page.evaluate(f"demohlm.status.poses.{side}_target"))


def steps(page: Any, count: int) -> None:
    """Wait until the page was told of so many steps of the world."""
    page.evaluate("demohlm.seen = 0; demohlm.before = demohlm.status; void 0")
    page.wait_for_function(
        "n => { if (demohlm.status !== demohlm.before) { demohlm.before = demohlm.status; demohlm.seen++; }"
        " return demohlm.seen > n; }",
        arg=count,
        timeout=60_000,
    )


def test_keys_move_hands_walk_grip_and_record(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page:
        steps(page, 2)
        before = target(page, "right"), target(page, "left")
        page.keyboard.down("ArrowUp")
        page.keyboard.down("PageUp")
        steps(page, 4)
        page.keyboard.up("ArrowUp")
        page.keyboard.up("PageUp")
        moved = target(page, "right")[:3] - before[0][:3]
        assert moved[0] > 0.02 and moved[2] > 0.02 and abs(moved[1]) < 0.01
        np.testing.assert_array_equal(target(page, "left"), before[1])
        page.keyboard.press("Space")
        page.wait_for_function("demohlm.controls.grips.right === 1")
        wait_for(lambda: served.session.sim.command[0, 22] == 1.0)
        steps(page, 10)  # the hand is let go
        page.keyboard.press("Space")
        wait_for(lambda: served.session.sim.command[0, 22] == 0.0)
        page.keyboard.down("KeyQ")
        wait_for(lambda: served.session.sim.command[0, 2] > 0.4)
        page.keyboard.up("KeyQ")
        wait_for(lambda: served.session.sim.command[0, 2] == 0.0)
        page.keyboard.press("Enter")
        page.wait_for_function("demohlm.status.tick > 3")
        assert page.inner_text("#status").startswith("recording")
        page.keyboard.press("Backspace")
        page.wait_for_function("demohlm.status.paused")
        while (recorded := page.evaluate("demohlm.status.tick")) > 0:  # a page that is late has recorded more than 2 s
            page.keyboard.press("Backspace")
            page.wait_for_function("tick => demohlm.status.tick < tick", arg=recorded)
        page.keyboard.press("Delete")
        page.wait_for_function("demohlm.status.state === 'idle'")


def test_a_gripper_that_a_rewind_has_opened_stays_open(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page:
        page.keyboard.press("Enter")
        page.wait_for_function("demohlm.status.state === 'recording'")
        page.click("#show-touch")
        page.keyboard.press("Space")
        wait_for(lambda: served.session.sim.command[0, 22] == 1.0)
        assert page.locator("[data-grip].on").count() == 1
        while page.evaluate("demohlm.status.grippers[1]") == 1.0 or not page.evaluate("demohlm.status.paused"):
            page.keyboard.press("Backspace")
            steps(page, 2)
        page.wait_for_function("!document.querySelector('[data-grip].on')")
        page.keyboard.down("ArrowUp")
        page.wait_for_function("!demohlm.status.paused")
        steps(page, 5)
        page.keyboard.up("ArrowUp")
        assert served.session.sim.command[0, 22] == 0.0


@pytest.mark.slow
def test_the_mouse_moves_a_hand_in_the_plane_of_the_view(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page:
        steps(page, 2)
        page.evaluate("demohlm.scene.orbit.yaw = Math.PI; demohlm.scene.orbit.pitch = 0")  # from behind the robot
        before = target(page, "right")
        page.keyboard.down("Shift")
        page.mouse.move(400, 400)
        page.mouse.down()
        steps(page, 2)
        page.mouse.move(440, 360, steps=5)
        steps(page, 2)
        page.mouse.up()
        page.keyboard.up("Shift")
        moved = target(page, "right")[:3] - before[:3]
        assert moved[1] < -0.02 and moved[2] > 0.02 and abs(moved[0]) < 0.01  # to the right, and up


def test_a_gamepad_walks_and_moves_the_hand_that_is_held(served: Served, browser: Any) -> None:
    with opened(browser, served.invite(), PAD) as page:
        steps(page, 2)
        page.evaluate("pad.axes[1] = -1")
        wait_for(lambda: served.session.sim.command[0, 0] == pytest.approx(WALK_SPEED[0][1]))
        page.evaluate("pad.axes[1] = 0")
        wait_for(lambda: served.session.sim.command[0, 0] == 0.0)
        before = target(page, "left")
        page.evaluate("padSet(4, 1); padSet(6, 1); pad.axes[3] = -1")
        steps(page, 4)
        assert target(page, "left")[2] - before[2] > 0.02
        assert served.session.sim.command[0, 21] == 1.0 and served.session.sim.command[0, 0] == 0.0
        page.evaluate("padSet(4, 0); padSet(6, 0); pad.axes[3] = 0; padSet(9, 1)")
        page.wait_for_function("demohlm.status.state === 'recording'")
        assert page.evaluate("document.getElementById('device').value") == "3"


def test_touch_sticks_walk(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page:
        page.click("#show-touch")
        box = page.locator("#stick-left").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x, y - 0.5 * box["height"])
        wait_for(lambda: served.session.sim.command[0, 0] > 0.3)
        page.mouse.up()
        wait_for(lambda: served.session.sim.command[0, 0] == 0.0)
        page.evaluate("demohlm.controls.touch.hold.right = true")
        steps(page, 2)
        page.click("[data-grip]")
        wait_for(lambda: served.session.sim.command[0, 22] == 1.0)
        page.evaluate("demohlm.controls.touch.hold.right = false")
        steps(page, 2)
        page.click("[data-grip]")  # counts once the hand is held
        steps(page, 2)
        assert served.session.sim.command[0, 22] == 1.0
        page.evaluate("demohlm.controls.touch.hold.right = true")
        wait_for(lambda: served.session.sim.command[0, 22] == 0.0)
        page.evaluate("demohlm.controls.touch.hold.right = false")


def test_a_headset_that_is_lost_lets_everything_go(served: Served, browser: Any) -> None:
    with opened(browser, served.invite(), small=True) as page:
        told = page.evaluate(
            "() => { const c = demohlm.controls; const held = { pose: [0, 1, 0, 1, 0, 0, 0], engaged: true, grip: 1 };"
            "c.xr = { head: held.pose, hands: { left: held, right: held }, walk: [1, 0, 0], lift: 1 };"
            "c.readXR({ getViewerPose: () => null }, null, null); const xr = c.xr; c.xr = null; return xr; }"
        )
        assert told["walk"] == [0, 0, 0] and told["lift"] == 0 and told["head"] is None
        assert not any(told["hands"][side]["engaged"] for side in ("left", "right"))


def test_a_bare_hand_that_is_lost_stays_as_it_was(served: Served, browser: Any) -> None:
    with opened(browser, served.invite(), small=True) as page:
        told = page.evaluate(
            "() => { const c = demohlm.controls, at = (x) => ({ position: { x, y: 0, z: 0 },"
            "  orientation: { x: 0, y: 0, z: 0, w: 1 } });"
            "const hand = new Map(['wrist', 'thumb-tip', 'index-finger-tip', 'middle-finger-tip', 'ring-finger-tip',"
            "  'pinky-finger-tip'].map((name) => [name, name])), seen = [];"
            "for (const reach of [null, 0.05, null, 0.2, null]) {"  # of the fingers, from the wrist
            "  const pose = (name) => reach && { transform: at(name === 'wrist' ? 0 : reach) };"
            "  c.readXR({ getViewerPose: () => ({ transform: at(0) }), getJointPose: pose }, null,"
            "    { inputSources: [{ targetRayMode: 'tracked-pointer', handedness: 'right', hand }] });"
            "  const { pose: p, engaged, grip } = c.xr.hands.right; seen.push([p !== null, engaged, grip]); }"
            "c.xr = null; return seen; }"
        )
        assert told == [[False, False, 0], [True, True, 1], [False, True, 1], [True, False, 1], [False, False, 1]]


PHONE = """
() => {
  const c = demohlm.controls, at = (y) => ({ position: { x: 0, y, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } });
  const frame = { getViewerPose: () => ({ transform: at(1.2) }) }, touch = { targetRayMode: "screen" };
  const look = (overlay, sides, sources) => {
    for (const side of ["left", "right"]) c.touch.hold[side] = sides.includes(side);
    c.readXR(frame, null, { inputSources: sources, ...(overlay ? { domOverlayState: { type: "screen" } } : {}) });
    const { hands, walk, head } = c.xr, { device } = c;
    return [hands.left.engaged, hands.right.engaged, walk[0], head === null, device];
  };
  c.touch.sticks.left = [0, -1];
  const seen = [look(true, [], []), look(true, [], [touch]), look(true, ["left"], [touch]), look(false, [], [touch])];
  c.touch.sticks.left = [0, 0]; c.touch.hold.left = false; c.xr = null;
  return seen;
}
"""
SEEN_THROUGH = """
() => {  // share of the screen where a phone's picture of the room shows
  document.body.classList.add("ar");
  document.getElementById("touch").hidden = false;
  let free = 0, all = 0;
  for (let x = 4; x < innerWidth; x += 12) for (let y = 4; y < innerHeight; y += 12) {
    const opaque = document.elementsFromPoint(x, y).some((e) => e.tagName === "CANVAS"
      || !/, 0\\)$|transparent/.test(getComputedStyle(e).backgroundColor));
    all++; free += !opaque;
  }
  document.body.classList.remove("ar");
  return free / all;
}
"""


def test_a_phone_in_ar_is_the_hand_whose_button_is_held_and_shows_the_room(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page:
        page.set_viewport_size({"width": 412, "height": 915})
        assert page.evaluate(PHONE) == [
            [False, False, 1, True, "phone"],
            [False, False, 1, True, "phone"],  # a finger on a stick or on the record button takes no hand
            [True, False, 1, True, "phone"],
            [False, True, 1, True, "phone"],  # without the page's buttons a finger holds the chosen hand
        ]
        assert page.evaluate(SEEN_THROUGH) > 0.6


@pytest.mark.parametrize(("screen", "flat"), [(0, True), (90, True), (0, False)])
@pytest.mark.parametrize("north", [0, 90, 200])
def test_a_phone_tilts_the_palm_as_it_is_held_wherever_north_is(
    served: Served, browser: Any, north: int, screen: int, flat: bool
) -> None:
    """The top of the screen goes down by 20 degrees: so does the palm's front."""
    with opened(browser, served.invite(), small=True) as page:
        turned = page.evaluate(
            "([north, angle, flat]) => { const c = demohlm.controls;"
            "Object.defineProperty(screen, 'orientation', { value: { angle }, configurable: true });"
            "const hold = (b, g) => { dispatchEvent(new DeviceOrientationEvent('deviceorientation',"
            "  { alpha: north, beta: b, gamma: g })); return c.touchPad().pose; };"
            "c.touch.tilt = true; c.touch.hold.right = true;"
            "const seen = flat ? (angle ? [hold(0, 0), hold(0, 20)] : [hold(0, 0), hold(-20, 0)])"
            "  : [hold(80, 0), hold(60, 0)];"
            "c.touch.hold.right = false; c.touchPad(); c.touch.tilt = false; return seen; }",
            [north, screen, flat],
        )
        first, second = (protocol._pose("pose", pose)[:3, :3] for pose in turned)
        rolled, pitched, yawed = poses.rotation_vector(second @ first.T)
        assert pitched == pytest.approx(math.radians(20.0), abs=1e-6)
        assert abs(rolled) < 1e-6 and abs(yawed) < 1e-6


def test_a_refusal_is_read_in_the_headset(served: Served, browser: Any) -> None:
    with opened(browser, served.invite(), small=True) as page:
        page.evaluate("demohlm.session = {}; demohlm.press = document.getElementById('rewind').onclick; void 0")
        page.evaluate("demohlm.socket.send(JSON.stringify({ type: 'press', button: 'rewind' }))")
        page.wait_for_function("(demohlm.scene.said || '').startsWith(\"got 'rewind'\")")
        page.evaluate("demohlm.session = null")


def test_two_browsers_and_nothing_overlaps(served: Served, browser: Any) -> None:
    with opened(browser, served.invite()) as page, opened(browser, served.addresses["spectator"]) as other:
        assert not other.is_visible("#record")
        assert page.is_visible("#record")
        frames = other.evaluate("demohlm.frames")
        other.wait_for_function(f"demohlm.frames > {frames + 10}")
        for size in ({"width": 1280, "height": 800}, {"width": 412, "height": 915}, {"width": 915, "height": 412}):
            page.set_viewport_size(size)
            boxes = page.evaluate(BOXES)
            assert len(boxes) > 8
            for i, (name, left, top, right, bottom) in enumerate(boxes):
                assert right <= size["width"] + 1, f"{name} runs out of a page of {size}"
                for other_name, *b in boxes[i + 1 :]:
                    apart = b[0] >= right - 1 or b[2] <= left + 1 or b[1] >= bottom - 1 or b[3] <= top + 1
                    assert apart, f"{name} overlaps {other_name} at {size}"


def test_a_headset_engages_again_without_a_jump_and_bare_hands_work(served: Served, browser: Any, iwer: Path) -> None:
    with opened(browser, served.invite(), iwer, HEADSET, small=True) as page:
        hands = HeadsetHands(page)
        hands.squeeze()
        page.evaluate("headset.controllers.right.position.set(0.25, 1.25, -0.4)")
        steps(page, 3)
        held = target(page, "right")
        hands.squeeze(False)
        steps(page, 2)
        jumped = [np.abs(target(page, "right") - held).max()]
        page.evaluate("headset.controllers.right.position.set(-0.1, 0.9, 0.2)")
        steps(page, 2)
        hands.squeeze()
        steps(page, 2)
        jumped.append(float(np.abs(target(page, "right") - held).max()))
        print(f"re-engaging moved the target by {1e3 * max(jumped):.3f} mm")
        assert max(jumped) <= 0.002
        hands.squeeze(False)
        page.evaluate("headset.quaternion.set(0, Math.sin(0.4), 0, Math.cos(0.4))")  # the operator looks to the left
        steps(page, 3)
        hands.squeeze()
        before, home = target(page, "right")[:3], page.evaluate("demohlm.scene.home[2]")
        for z in (0.1, 0.0, -0.1):
            page.evaluate(f"headset.controllers.right.position.set(-0.1, 0.9, {z})")  # ahead
            steps(page, 2)
        steps(page, 8)
        moved = poses.planar(0.0, 0.0, -home)[:3, :3] @ (target(page, "right")[:3] - before)
        assert moved[0] > 0.2 and np.abs(moved[1:]).max() < 0.02  # where it is seen to go, not where the operator looks
        page.evaluate("headset.controllers.right.connected = false")  # lost
        steps(page, 2)
        page.evaluate("headset.controllers.right.connected = true")
        page.evaluate("headset.controllers.right.position.set(0.3, 1.5, -0.5)")
        steps(page, 2)
        page.evaluate("headset.primaryInputMode = 'hand'")
        page.wait_for_function("demohlm.controls.device === 'hands' && demohlm.controls.xr.hands.left.pose")
        assert page.evaluate("demohlm.xrFrames") > 10
        page.evaluate("demohlm.session.end()")


def drive(served: Served, page: Any, push: tuple[float, int, int] | None = None) -> None:
    """Have the task's script move the emulated headset's controllers until its motion is over.

    Args:
        served: The server.
        page: Of an operator with a headset.
        push: Forward speed [m/s], steps to walk and steps to stand behind the motion of the hands.
    """
    operator = script_of(served.task).make_operator()
    reach = getattr(operator, "_reach", operator)
    hands = HeadsetHands(page)
    hands.squeeze()
    page.evaluate("document.getElementById('record').click()")
    page.wait_for_function("demohlm.status.state === 'recording'")
    seen, asked = 0, None
    for status in statuses(page):
        if asked is not None and hands.behind(status, asked) > CAUGHT_UP_M:
            continue  # a slow machine: the hands wait for the robot, as a person's would
        wanted = reach.poses(view_of(status))
        seen = status["tick"]
        if wanted is None:
            break
        asked = wanted
        hands.move(asked)
    if push is not None:
        speed, walk, stand = push
        stick = DEAD_ZONE + speed / WALK_SPEED[0][1] * (1 - DEAD_ZONE)
        hands.stick("left", 0.0, -stick)
        page.wait_for_function(f"demohlm.status.tick > {seen + walk}", timeout=120_000)
        hands.stick("left", 0.0, 0.0)
        page.wait_for_function(f"demohlm.status.tick > {seen + walk + stand}", timeout=120_000)
    page.wait_for_function("demohlm.status.held_s >= 1", timeout=30_000)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "push"), [("LiftBox", None), ("GraspCube", None), ("PushCart", (0.3, 38, 24))])
def test_a_recording_from_a_headset_is_an_ordinary_demonstration(
    task: str, push: tuple[float, int, int] | None, browser: Any, iwer: Path, tmp_path: Path
) -> None:
    root = tmp_path / "demonstration"
    with serving(task, root) as served:
        with opened(browser, served.addresses["operator"], iwer, HEADSET, small=True) as page:
            drive(served, page, push)
            page.evaluate("document.getElementById('record').click()")
            page.wait_for_function("demohlm.status.state === 'review'")
            assert page.evaluate("demohlm.status.verdict.refusal") == ""
            print("latency", page.evaluate("demohlm.status.latency"), "late", page.evaluate("demohlm.status.late_s"))
            page.evaluate("document.getElementById('save').click()")
            page.wait_for_function("demohlm.status.state === 'saved'", timeout=300_000)  # imports LeRobot
    saved = demonstrations.load(root, served.task)
    assert replay(saved).identical
    found = {(entry.hand, entry.kind) for entry in segment(saved, served.task)}
    assert {("right", "object"), ("right", "proprioception")} <= found
