"""The trace of an attempt -> one HTML page that shows and says what happened, with everything inside."""

import base64
import io
import math

import mujoco
import numpy as np
from markupsafe import Markup

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.robot import g1
from gym_demohlm.robot.hands import GRIPPER
from gym_demohlm.simulation.judge import COLLISION_N
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm import drawing
from lerobot_demohlm.demonstrations.timeline import draw_timeline
from lerobot_demohlm.generation.locomotion import LocomotionSettings
from lerobot_demohlm.reports.explain import figures, story
from lerobot_demohlm.reports.explain.figures import STAGE_COLOURS, Curve, Plan, chart
from lerobot_demohlm.reports.explain.pages import render
from lerobot_demohlm.reports.explain.trace import Trace
from lerobot_demohlm.reports.films import CAMERAS, Film, Shots, film_strip

_HANDS = {"left": figures.LEFT, "right": figures.RIGHT}
_STRIP_FRAMES, _STRIP_WIDTH = 10, 236


def attempt_page(trace: Trace, *, origin: str, again: str, pictures: bool = True) -> str:
    """Return the page.

    Args:
        trace: The attempt.
        origin: What run it is of, in words.
        again: What is known of how it agrees with the recorded one; empty where there is none.
        pictures: Whether to draw film strips, which needs graphics.
    """
    episode = trace.episode
    return render(
        "attempt.html.j2",
        title=f"{trace.task.name}, attempt {episode.index}: {episode.outcome.replace('_', ' ')}",
        trace=trace,
        episode=episode,
        origin=origin,
        again=again,
        strips=film_strips(trace) if pictures and len(trace) else [],
        plan=plan(trace),
        timeline=story.timeline(trace),
        frames=story.frames_table(trace),
        source=drawing.svg(draw_timeline(trace.demonstration)),
        charts=charts(trace) if len(trace) else [],
        tracking=story.tracking_table(trace) if len(trace) else [],
        stage_colours=STAGE_COLOURS,
        degrees=math.degrees,
        isfinite=math.isfinite,
    )


def film_strips(trace: Trace) -> list[dict[str, str]]:
    """Return strips (JPEG, base64) from each camera with their captions."""
    take, strips = trace.take(), []
    sim = take.world()
    with Renderer(sim.model, WIDTH, HEIGHT) as renderer:
        for camera, caption in CAMERAS.items():
            film = Film(frames=Shots(take, sim, camera, renderer), caption=caption)
            strips.append({"caption": caption, "jpeg": _jpeg(film_strip(film, _STRIP_FRAMES, _STRIP_WIDTH))})
    sim.close()
    return strips


def _jpeg(png: bytes) -> str:
    from PIL import Image

    stream = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(stream, "JPEG", quality=85)
    return base64.b64encode(stream.getvalue()).decode()


def plan(trace: Trace) -> Markup:
    """Return the attempt seen from above: ways of base, palms and objects, goal, anchors and things."""
    sim = trace.take().world()
    sim.mj_data()  # brings its model to the sizes that things had
    names = [entry.name for entry in trace.task.objects]
    starts = {**trace.supports, **{name: trace.objects[0, index] for index, name in enumerate(names)}}
    seen = [trace.pelvis[:, :2, 3], trace.hands[:, :, :2, 3].reshape(-1, 2), trace.objects[:, :, :2, 3].reshape(-1, 2)]
    if trace.placement is not None:
        seen.append(trace.placement.goal[None, :2])
    seen_from_above = Plan(np.concatenate(seen), width=640)
    for name, T in starts.items():
        seen_from_above.outline(footprint(sim.model, name), T, "#9a8b78" if name in trace.supports else figures.INK)
    for index, name in enumerate(names):
        seen_from_above.trail(trace.objects[:, index, :2, 3], figures.GREY, 1.2)
        if np.linalg.norm(trace.objects[-1, index, :2, 3] - trace.objects[0, index, :2, 3]) > 0.02:
            seen_from_above.outline(footprint(sim.model, name), trace.objects[-1, index], figures.INK, dashed=True)
    for stage, start, stop in trace.bands():
        steps = slice(round(start / STEP_DT), round(stop / STEP_DT) + 1)
        colour = {"locomotion": "#5b8fc7", "pre_manipulation": "#c79a2b"}.get(stage, figures.GOOD)
        seen_from_above.trail(trace.pelvis[steps, :2, 3], colour, 2.6)
    for hand, side in enumerate(g1.SIDES):
        seen_from_above.trail(trace.hands[:, hand, :2, 3], _HANDS[side], 1.2)
        seen_from_above.trail(trace.targets[:, hand, :2, 3], _HANDS[side], 1.2, dashed=True)
    seen_from_above.robot(poses.to_planar(trace.pelvis[0]), figures.GREY, "start")
    if trace.placement is not None:
        seen_from_above.robot(trace.placement.goal, figures.GOOD, "base goal", dashed=True, line=2)
    seen_from_above.robot(poses.to_planar(trace.pelvis[-1]), figures.INK, "end")
    for number, begun in enumerate(trace.started, start=1):
        first = begun.group[0]
        name = str(first.object) if first.kind == "object" else f"anchor {number}"
        seen_from_above.frame(begun.frames_now[0], name, beside=0 if first.kind == "object" else 1)
    sim.close()
    return seen_from_above.markup()


def footprint(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the corners (4, 2) of the box around a body's geoms in its own frame, seen from above [m]."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    corners = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        corners.append(poses.transform(poses.pose(model.geom_pos[geom], model.geom_quat[geom]), centre + signs * half))
    if not corners:
        return np.zeros((1, 2))
    (x0, y0), (x1, y1) = (f(np.concatenate(corners)[:, :2], axis=0) for f in (np.min, np.max))
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def charts(trace: Trace) -> list[Markup]:
    """Return the curves over time: contacts, commands against what was measured, objects."""
    action, executed = trace.episode.action, trace.episode.executed
    names = [entry.name for entry in trace.task.objects]
    bands = [(start, stop, STAGE_COLOURS[stage]) for stage, start, stop in trace.bands()]
    success = np.flatnonzero(trace.episode.success)
    marks = {"success": float(success[0] + 1) * STEP_DT} if len(success) else {}

    def drawn(title: str, *curves: Curve, marks: dict[str, float] | None = None) -> Markup:
        return chart(title, curves, trace.duration_s, bands, marks)

    def pair(name: str, wanted: np.ndarray, measured: np.ndarray, colour: str) -> tuple[Curve, ...]:
        return (
            Curve(name=f"{name} commanded".strip(), values=wanted, colour=colour, dashed=True),
            Curve(name=f"{name} measured".strip(), values=measured, colour=colour),
        )

    def carried(column: int) -> tuple[Curve, ...]:
        """The command with the noise that it carried, where it did."""
        return () if executed is None else (Curve(name="executed", values=executed[:, column], colour=figures.RIGHT),)

    demonstrated = trace.demonstration.contact_forces
    shown = []
    for column, (side, name) in enumerate(trace.task.contact_pairs):
        then = np.where(trace.ticks >= 0, demonstrated[np.maximum(trace.ticks, 0), column], np.nan)
        curves = (
            Curve(name="in the demonstration", values=then, colour=figures.GREY, dashed=True),
            Curve(name="here", values=trace.contact_forces[:, column], colour=_HANDS[side]),
        )
        shown.append(drawn(f"{side} hand on {name} [N]", *curves))
    if trace.collision_forces.max(initial=0.0) > 0.0:
        force = Curve(name=f"counts from {COLLISION_N:g} N on", values=trace.collision_forces, colour=figures.BAD)
        shown.append(drawn("robot on obstacles [N]", force))
    heights = [
        Curve(name=name, values=trace.objects[:, i, 2, 3], colour=figures.COLOURS[i % len(figures.COLOURS)])
        for i, name in enumerate(names)
    ]
    shown.append(drawn("height of objects [m]", *heights, marks=marks))
    velocity = trace.base_velocity(LocomotionSettings().window_ticks)
    for column, title in enumerate(("forward velocity [m/s]", "sideways velocity [m/s]", "yaw rate [rad/s]")):
        shown.append(drawn(title, *pair("", action[:, column], velocity[:, column], figures.LEFT), *carried(column)))
    height = pair("", action[:, command.HEIGHT], trace.pelvis[:, 2, 3], figures.LEFT)
    shown.append(drawn("torso height [m]", *height, *carried(command.HEIGHT)))
    angles = np.degrees(trace.torso_angles())
    wanted = np.degrees(action[:, [command.ROLL, command.PITCH, command.YAW]])
    curves = []
    for i, name in enumerate(("roll", "pitch", "yaw")):
        curves.append(Curve(name="", values=wanted[:, i], colour=figures.COLOURS[i], dashed=True))
        curves.append(Curve(name=name, values=angles[:, i], colour=figures.COLOURS[i]))
    shown.append(drawn("torso [deg], dashed: commanded", *curves))
    if executed is not None:
        noise = np.degrees(executed - action)
        arms = zip(g1.SIDES, (command.LEFT_ARM, command.RIGHT_ARM), strict=True)
        curves = [Curve(name=side, values=np.abs(noise[:, arm]).max(axis=1), colour=_HANDS[side]) for side, arm in arms]
        shown.append(drawn("largest noise of a joint of each arm [deg]", *curves))
    if np.isfinite(trace.targets).any():
        curves = []
        for hand, side in enumerate(g1.SIDES):
            left, measured = 1000 * trace.ik_error[:, hand], 1000 * trace.hand_errors()[:, hand]
            curves.append(Curve(name="", values=left, colour=_HANDS[side], dashed=True))
            curves.append(Curve(name=side, values=measured, colour=_HANDS[side]))
        shown.append(drawn("palms from their targets [mm], dashed: by kinematics alone", *curves))
    if trace.task.hands == "gripper":
        grippers = action[:, command.GRIPPERS]
        travel = trace.grippers / GRIPPER.stroke
        curves = []
        for hand, side in enumerate(g1.SIDES):
            curves.append(Curve(name="", values=grippers[:, hand], colour=_HANDS[side], dashed=True))
            curves.append(Curve(name=side, values=travel[:, hand], colour=_HANDS[side]))
        shown.append(drawn("grippers, 0 open, 1 closed, dashed: commanded", *curves))
    return shown
