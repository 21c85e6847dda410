"""``demohlm robot-check``."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm robot-check``.

    Attributes:
        interface: Network interface of the robot.
        domain: Of DDS; a real robot's is 0.
        seconds: How long to listen [s].
    """

    interface: str
    domain: int = 0
    seconds: float = 3.0


def run(options: Options) -> int:
    """Listen to a robot; the last line on stdout is what was heard, as JSON, and the code 1 if it would be refused."""
    from lerobot_demohlm.cli.printing import print_json
    from lerobot_demohlm.hardware.robot_check import check_robot

    found = check_robot(options.interface, options.seconds, options.domain)
    for line in found["refused"]:
        print(f"refused: {line}")
    print_json(found)
    return 1 if found["refused"] else 0
