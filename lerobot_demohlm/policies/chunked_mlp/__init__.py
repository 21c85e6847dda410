"""The paper's MLP with action chunking as a LeRobot policy; LeRobot imports model and processors when it needs them."""

from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig

__all__ = ["ChunkedMLPConfig"]
