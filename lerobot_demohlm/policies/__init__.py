"""LeRobot policies of this package; importing it registers them."""

from lerobot_demohlm.policies import chunked_mlp as chunked_mlp
