"""``demohlm simulate-robot``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm simulate-robot``.

    Attributes:
        task: Name of the task whose world the robot is in.
        interface: Network interface on which it speaks, such as lo.
        domain: Of DDS; a real robot's is 0.
        region: Initial region from which starts are drawn.
        seed: Of the first start; each further one has the next seed.
        near: Begin each time where a person takes over, near the objects: a rehearsal of teleoperation.
        faults: JSON file of what goes wrong; see docs/deployment.md.
        servo_link: Path made to lead to the serial port of its neck and grippers.
        noise: Sensor noise, as a share of the usual one.
        own_controller: Name of the robot's own controller that runs at first, for a rehearsal of releasing it.
        gantry_s: Time for which its joints must be held before the gantry lets go [s].
        controller: Name, path or hash of the controller whose physics the robot has.
        variation: How each start's robot differs in strength, masses and friction, such as real:robot.
        num_episodes: Starts after which it ends; 0 for never.
    """

    task: str
    interface: str
    domain: int = 0
    region: str = DEFAULT_REGION
    seed: int = 0
    near: bool = False
    faults: Annotated[Path | None, default("none")] = None
    servo_link: Path = Path("outputs/robot/servos")
    noise: float = 1.0
    own_controller: Annotated[str | None, default("none")] = None
    gantry_s: float = 3.5
    controller: str = "default"
    variation: str = "none"
    num_episodes: int = 0


def run(options: Options) -> None:
    """Be a robot; each line on stdout is something that happens, as JSON, the last one what was counted."""
    from lerobot_demohlm.hardware.faults import Faults
    from lerobot_demohlm.hardware.simulated_g1 import SimulatedSettings, run

    start = None
    if options.near:
        from lerobot_demohlm.teleop.web.record import operators_place

        start = operators_place(get_task(options.task))
    settings = SimulatedSettings(
        task=options.task,
        interface=options.interface,
        domain=options.domain,
        region=options.region,
        seed=options.seed,
        start=start,
        faults=Faults.read(options.faults),
        servo_link=options.servo_link,
        noise=options.noise,
        own_controller=options.own_controller or "",
        gantry_s=options.gantry_s,
        controller=options.controller,
        variation=options.variation,
        episodes=options.num_episodes,
    )
    print(json.dumps({"event": "end", **run(settings)}))
