"""LeRobot's robots and teleoperators <-> this project's worlds and operators.

Importing this registers their configurations; LeRobot finds the devices themselves, in ``g1`` and ``operators``, when
they are asked for.
"""

from lerobot_demohlm.devices.config_g1 import DemoHLMG1Config as DemoHLMG1Config
from lerobot_demohlm.devices.config_operators import DemoHLMGamepadConfig as DemoHLMGamepadConfig
from lerobot_demohlm.devices.config_operators import DemoHLMKeyboardConfig as DemoHLMKeyboardConfig
from lerobot_demohlm.devices.config_operators import DemoHLMScriptConfig as DemoHLMScriptConfig
from lerobot_demohlm.devices.config_operators import DemoHLMWebConfig as DemoHLMWebConfig
