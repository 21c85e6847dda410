"""A served session -> pictures of the page in each of its modes, for docs/teleoperation.md.

Run as ``python -m tests.helpers.teleop_pictures docs/pictures``; it needs a browser and the emulated headset.
"""

import io
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

from lerobot_demohlm.benchmarks.teleoperation import FLAGS, HEADSET
from lerobot_demohlm.demonstrations.demonstration import load
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.session import RecordingSession, SessionSettings
from lerobot_demohlm.teleop.trial import TrialSettings
from tests.helpers.teleop import HeadsetHands, Served, fetch_iwer, find_browser, opened

PAD = """
window.pad = {index: 0, connected: true, mapping: "standard", axes: [0, 0, 0, 0],
  buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))};
navigator.getGamepads = () => [window.pad];
"""
PHONE = {"width": 412, "height": 915}


def save(page: Any, path: Path) -> None:
    """Write what a page shows, as WebP."""
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    image.thumbnail((1000, 800))
    image.save(path, quality=80)


def perform(session: RecordingSession, share: float) -> None:
    """Record a share of the script's motion and go back by 2 s; all of it, and the recording is ended."""
    operator, length = script_of(session.task).make_operator(), len(load(task=session.task))
    session.press("record")
    while len(session) < share * length and (asked := operator.poses(session.view())) is not None:
        session.carry_out(asked)
    session.press("record" if share >= 1.0 else "rewind")  # the world stands still until somebody takes hold


def main(directory: Path) -> None:
    """Write the pictures."""
    directory.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp())
    served = Served("LiftBox", scratch / "recorded")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_browser(), args=FLAGS)
        with opened(browser, served.invite()) as page:
            page.keyboard.down("ArrowUp")
            page.wait_for_function("demohlm.status.engaged[1]")
            page.wait_for_timeout(1500)
            save(page, directory / "teleop_keyboard.webp")
            page.keyboard.up("ArrowUp")
        with opened(browser, served.invite(), PAD) as page:
            page.evaluate("pad.buttons[5] = {pressed: true, value: 1}; pad.axes[1] = -0.5")
            page.wait_for_function("demohlm.status.engaged[1] && demohlm.controls.device === 'gamepad'")
            page.wait_for_timeout(1500)
            save(page, directory / "teleop_gamepad.webp")
            page.evaluate("pad.buttons[5] = {pressed: false, value: 0}; pad.axes[1] = 0")
        with opened(browser, served.invite()) as page:
            page.set_viewport_size(PHONE)
            page.click("#show-touch")
            page.wait_for_timeout(1500)
            save(page, directory / "teleop_phone.webp")
        served.close()
        served = Served("LiftBox", scratch / "half", prepare=lambda session: perform(session, 0.95))
        with opened(browser, served.addresses["operator"], fetch_iwer(scratch), HEADSET) as page:
            page.evaluate("headset.quaternion.set(-Math.sin(0.3), 0, 0, Math.cos(0.3))")  # it looks down
            HeadsetHands(page).squeeze()
            page.wait_for_timeout(4000)
            save(page, directory / "teleop_headset.webp")
            page.set_viewport_size({"width": 200, "height": 150})
            with opened(browser, served.addresses["spectator"]) as other:
                save(other, directory / "teleop_spectator.webp")
        served.close()
        settings = SessionSettings(trial=TrialSettings(attempts=10, together=5))
        served = Served("LiftBox", scratch / "whole", settings, lambda session: perform(session, 1.0))
        with opened(browser, served.addresses["operator"]) as page:
            finished = "demohlm.status.verdict.trial && demohlm.status.verdict.trial.finished"
            page.wait_for_function(finished, timeout=300_000)
            page.wait_for_timeout(1500)
            save(page, directory / "teleop_review.webp")
        browser.close()
    served.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
