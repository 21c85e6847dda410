"""What the robot sees: camera, depth, masks, a tracker, and perceivers that say where objects are."""
