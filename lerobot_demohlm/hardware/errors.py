"""What goes wrong between this project and a robot."""

from gym_demohlm.errors import DemoHLMError


class RobotError(DemoHLMError):
    """A network, a robot, a servo or a deployment that cannot be used as asked; nothing has moved."""
