"""Options of the teleoperators ``demohlm_script``, ``demohlm_web``, ``demohlm_keyboard`` and ``demohlm_gamepad``."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("demohlm_script")
@dataclass(kw_only=True)
class DemoHLMScriptConfig(TeleoperatorConfig):
    """The scripted operator of the robot's task."""


@dataclass(kw_only=True)
class _PageConfig(TeleoperatorConfig):
    """A person at the page that the teleoperator serves.

    Attributes:
        host: Where to listen; names other than of this machine alone get https.
        port: Where to listen; 0 for any that is free.
        scale: Metres of a palm for a metre of a hand.
    """

    host: str = "localhost"
    port: int = 8012
    scale: float = 1.0


@TeleoperatorConfig.register_subclass("demohlm_web")
@dataclass(kw_only=True)
class DemoHLMWebConfig(_PageConfig):
    """A person with any device of the page: headset, phone, gamepad, keyboard and mouse."""


@TeleoperatorConfig.register_subclass("demohlm_keyboard")
@dataclass(kw_only=True)
class DemoHLMKeyboardConfig(_PageConfig):
    """A person at the page's keys: they need no X11, unlike LeRobot's own ``keyboard``."""


@TeleoperatorConfig.register_subclass("demohlm_gamepad")
@dataclass(kw_only=True)
class DemoHLMGamepadConfig(_PageConfig):
    """A person with a gamepad at the page: the browser reads it."""
