"""Names that options choose among, without what it takes to import where they are defined; a test compares them."""

from typing import Literal

Policy = Literal["mlp", "act", "diffusion"]
"""Of ``policies.presets.POLICIES``."""
Preset = Literal["paper", "cpu", "vision-cpu", "vision-paper"]
"""Of ``policies.presets.NAMES``."""
Perception = Literal["exact", "model", "rgbd", "apriltag", "remote"]
"""Of ``gym_demohlm.perception.settings.SOURCES``."""
Masks = Literal["oracle", "color", "server"]
"""Of ``gym_demohlm.perception.settings.MASKS``."""
Backend = Literal["tracker"]
"""Of ``gym_demohlm.perception.pose_server.BACKENDS``."""
Table = Literal["main", "architectures", "regions", "worlds", "perception", "robustness"]
"""Of ``experiments.plan.TABLES``."""
Variant = Literal["plain", "noise", "starts", "stances", "noise_stances", "real", "model"]
"""Of ``experiments.variants.VARIANTS``."""
Protocol = Literal["whole", "arms", "velocity"]
"""Of ``wbc.evaluation.contest.PROTOCOLS``."""
Peer = Literal["holosoma", "holosoma-ppo"]
"""Of ``wbc.evaluation.peer.PEERS``."""
