"""A script of commands -> what one robot makes of it on the deployment model, tick by tick, and a film of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gym_demohlm.control import command
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.envs.rendering import Renderer
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT, STEP_DT, TICKS
from gym_demohlm.wbc.evaluation.trial import trial_task
from gym_demohlm.wbc.evaluation.trial_commands import ARM_MIRROR

FRAMES_PER_SECOND = 25
ARM_SPEED = 2.0  # rad/s, of the script


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A part of the script: what is commanded for how long; all else is at rest.

    Attributes:
        label: What a viewer reads.
        seconds: How long.
        told: Column of the command -> value.
        arms: Seven angles of the left arm, mirrored for the right one [rad]; home by default.
        push: Sudden velocity of the base (forward, sideways) at the start [m/s].
    """

    label: str
    seconds: float
    told: Mapping[int, float] = field(default_factory=dict)
    arms: tuple[float, ...] | None = None
    push: tuple[float, float] = (0.0, 0.0)


_REACH, _SPREAD = (-0.9, 0.1, 0.0, 0.9, 0.0, 0.0, 0.0), (-0.3, 1.2, 0.0, 1.2, 0.0, 0.0, 0.0)
SCRIPT = (
    Scene(label="stand", seconds=1.5),
    Scene(label="forward 0.6 m/s", seconds=3.5, told={0: 0.6}),
    Scene(label="back 0.4 m/s", seconds=3.0, told={0: -0.4}),
    Scene(label="left 0.3 m/s", seconds=2.5, told={1: 0.3}),
    Scene(label="right 0.3 m/s", seconds=2.5, told={1: -0.3}),
    Scene(label="turn 0.8 rad/s", seconds=2.5, told={2: 0.8}),
    Scene(label="turn -0.8 rad/s", seconds=2.5, told={2: -0.8}),
    Scene(label="stand", seconds=2.0),
    Scene(label="squat to 0.40 m", seconds=3.5, told={command.HEIGHT: 0.40}),
    Scene(label="rise", seconds=2.0),
    Scene(label="bend by 1.0 rad", seconds=3.0, told={command.PITCH: 1.0}),
    Scene(label="squat and bend", seconds=3.0, told={command.HEIGHT: 0.45, command.PITCH: 0.8}),
    Scene(label="upright", seconds=2.0),
    Scene(label="roll 0.3 rad", seconds=2.0, told={command.ROLL: 0.3}),
    Scene(label="roll -0.3 rad", seconds=2.5, told={command.ROLL: -0.3}),
    Scene(label="yaw 0.8 rad", seconds=2.5, told={command.YAW: 0.8}),
    Scene(label="yaw -0.8 rad", seconds=3.0, told={command.YAW: -0.8}),
    Scene(label="arms forward", seconds=2.0, arms=_REACH),
    Scene(label="arms aside, walking", seconds=3.0, told={0: 0.4}, arms=_SPREAD),
    Scene(label="stand", seconds=2.0),
    Scene(label="push of 0.6 m/s from the side", seconds=2.5, push=(0.0, 0.6)),
    Scene(label="push of 0.6 m/s while walking", seconds=3.0, told={0: 0.4}, push=(0.0, -0.6)),
    Scene(label="stand", seconds=1.5),
)


@dataclass(frozen=True, kw_only=True)
class Take:
    """One robot's way through a script, at every control tick.

    Attributes:
        labels: (ticks,) what was going on.
        commands: (ticks, 23).
        states: (ticks, size) of the physics.
        fell: Whether the robot fell.
    """

    labels: tuple[str, ...]
    commands: np.ndarray
    states: np.ndarray
    fell: bool


class Recorder(Simulation):
    """One world that keeps the physics state and the command of every control tick."""

    def __init__(self, weights: Path | None) -> None:
        super().__init__(trial_task(), controller=WholeBodyController(1, weights))
        self.states: list[np.ndarray] = []
        self.told: list[np.ndarray] = []
        self.on_tick = self._keep

    def _keep(self, _rows: np.ndarray, commands: np.ndarray) -> None:
        self.states.append(self.snapshot()["physics"][0])
        self.told.append(commands[0].copy())

    def push(self, forward: float, sideways: float) -> None:
        """Change the velocity of the base suddenly, in its heading frame [m/s]."""
        T_world_pelvis = self.pose("pelvis")[0]
        heading = np.arctan2(T_world_pelvis[1, 0], T_world_pelvis[0, 0])
        velocity = self.velocity("pelvis")
        velocity[0, 0] += np.cos(heading) * forward - np.sin(heading) * sideways
        velocity[0, 1] += np.sin(heading) * forward + np.cos(heading) * sideways
        self.set_velocity("pelvis", velocity)

    def show(self, state: np.ndarray) -> None:
        """Bring the world to a recorded physics state."""
        self.restore({**self.snapshot(), "physics": state[None]})


def perform(recorder: Recorder, script: Sequence[Scene] = SCRIPT) -> Take:
    """Lead one robot through a script, until its end or a fall."""
    recorder.reset([recorder.task.default_state()])
    recorder.states.clear()
    recorder.told.clear()
    labels: list[str] = []
    now = command.rest()
    for scene in script:
        recorder.push(*scene.push)
        goal = command.rest()
        goal[list(scene.told)] = list(scene.told.values())
        if scene.arms is not None:
            goal[command.ARMS] = [*scene.arms, *np.array(scene.arms) * ARM_MIRROR]
        for _ in range(round(scene.seconds / STEP_DT)):
            step = ARM_SPEED * STEP_DT
            arms = now[command.ARMS] + np.clip(goal[command.ARMS] - now[command.ARMS], -step, step)
            now = goal.copy()
            now[command.ARMS] = arms
            recorder.step(now[None])
            labels.extend([scene.label] * TICKS)
            if recorder.fallen()[0]:
                break
        if recorder.fallen()[0]:
            break
    return Take(
        labels=tuple(labels),
        commands=np.array(recorder.told),
        states=np.array(recorder.states),
        fell=bool(recorder.fallen()[0]),
    )


def film(recorder: Recorder, take: Take, path: Path, *, shadows: bool = True) -> None:
    """Film a take with a camera that follows the robot, 640x480.

    Args:
        recorder: Its world.
        take: What to film.
        path: An ``.mp4`` file.
        shadows: Drawn shadows, which take most of the time of an image.
    """
    every = round(1 / (FRAMES_PER_SECOND * CONTROL_DT))
    camera = mujoco.MjvCamera()
    camera.type, camera.distance, camera.azimuth, camera.elevation = mujoco.mjtCamera.mjCAMERA_FREE, 2.3, 130.0, -12.0
    recorder.show(take.states[0])
    camera.lookat[:] = *recorder.pose("pelvis")[0, :2, 3], 0.62
    font = ImageFont.load_default(size=22)
    recorder.model.vis.quality.shadowsize = 1024  # px: an image takes a quarter less time than with the scene's 4096
    with Renderer(recorder.model, shadows=shadows) as renderer, av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND, options={"crf": "30", "preset": "slow"})
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for tick in range(0, len(take.labels), every):
            recorder.show(take.states[tick])
            lag = 1 - every * CONTROL_DT / 0.5  # follows within half a second
            camera.lookat[:2] = lag * camera.lookat[:2] + (1 - lag) * recorder.pose("pelvis")[0, :2, 3]
            image = Image.fromarray(renderer.render(recorder.mj_data(), camera))
            ImageDraw.Draw(image).text((16, 12), take.labels[tick], fill=(20, 20, 20), font=font)
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
