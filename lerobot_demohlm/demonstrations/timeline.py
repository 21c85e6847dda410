"""A demonstration -> a figure of its timeline: contact forces, gripper commands and what each hand follows when."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.timing import FPS
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import events, segment

WIDTH, MARGIN, TOP = 1200, 190, 60  # px
ROW, BAR = 90, 40  # px: height of a curve and of a bar
INK, PALE, WHITE = (40, 44, 52), (205, 210, 218), (255, 255, 255)
FOLLOWS = {"object": (122, 178, 222), "proprioception": (244, 190, 120)}
CURVES = {"left": (54, 104, 172), "right": (186, 74, 62)}


def draw_timeline(demonstration: Demonstration) -> Image.Image:
    """Return the figure: for each hand its forces on objects [N], its gripper where it has one, and its segments."""
    task = get_task(demonstration.task)
    segments = segment(demonstration, task)
    rows: list[tuple[str, str, np.ndarray | None]] = []
    for hand in g1.SIDES:
        for column, (side, name) in enumerate(task.contact_pairs):
            if side == hand:
                rows.append((hand, f"{hand} on {name} [N]", demonstration.contact_forces[:, column]))
        if task.hands == "gripper":
            closed = demonstration.action[:, command.GRIPPERS][:, g1.SIDES.index(hand)]
            rows.append((hand, f"{hand} gripper, closed", closed))
        rows.append((hand, f"{hand} follows", None))
    heights = [BAR + 24 if curve is None else ROW for _, _, curve in rows]
    image = Image.new("RGB", (WIDTH, TOP + sum(heights) + 50), WHITE)
    pen, font, small = ImageDraw.Draw(image), ImageFont.load_default(20), ImageFont.load_default(14)
    pen.text((MARGIN, 18), f"{task.name}: {len(demonstration)} ticks of {1 / FPS:g} s", INK, font)
    bottom = TOP + sum(heights)

    def x(tick: float) -> float:
        return MARGIN + (WIDTH - MARGIN - 30) * tick / len(demonstration)

    for second in range(len(demonstration) // FPS + 1):
        pen.line([(x(second * FPS), TOP - 6), (x(second * FPS), bottom)], PALE if second % 5 else (160, 166, 176))
        if second % 5 == 0:
            pen.text((x(second * FPS) - 4, bottom + 6), f"{second} s", INK, small)
    y = TOP
    for (hand, title, curve), height in zip(rows, heights, strict=True):
        pen.text((12, y + height / 2 - 12), title, INK, small)
        if curve is None:
            for entry in (entry for entry in segments if entry.hand == hand):
                box = [x(entry.start) + 1, y + 8, x(entry.stop) - 1, y + 8 + BAR]
                pen.rectangle(box, FOLLOWS[entry.kind])
                words = entry.object if entry.kind == "object" else f"itself ({entry.anchor})"
                if pen.textlength(str(words), small) < box[2] - box[0] - 8:
                    pen.text((box[0] + 6, y + 19), str(words), INK, small)
        else:
            top = max(1.0, float(curve.max()))
            points = [
                (x(tick + 0.5), y + height - 14 - (height - 38) * value / top) for tick, value in enumerate(curve)
            ]
            pen.line([(x(0), y + height - 14), (x(len(curve)), y + height - 14)], PALE)
            pen.line(points, CURVES[hand], 2, joint="curve")
            pen.text((MARGIN - 44, y + 6), f"{top:.3g}", INK, small)
            for event in events(demonstration, task):
                of_curve = title.startswith(f"{hand} on {event.object}") or (
                    event.object is None and "gripper" in title
                )
                if event.hand == hand and of_curve:
                    pen.line([(x(event.tick), y + 4), (x(event.tick), y + height - 14)], INK)
                    pen.text((x(event.tick) + 4, y + 2), event.kind, INK, small)
        y += height
    return image


def write_timeline(demonstration: Demonstration, path: Path) -> None:
    """Write the figure as a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_timeline(demonstration).save(path)
