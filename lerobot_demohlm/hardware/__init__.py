"""A policy's commands <-> the motors of a Unitree G1, real or simulated, over its own DDS topics."""
