"""Versions of the robot's physics: what changes the bits of every simulation, controller and data set.

A controller's file names the physics that it was trained in, and a simulation with that controller has it. So
everything recorded under a version can still be simulated under it.
"""

from dataclasses import dataclass

from gym_demohlm.errors import UnknownNameError


@dataclass(frozen=True, kw_only=True)
class Physics:
    """What of a real G1 its model has.

    Attributes:
        name: Of the version.
        self_collision: Whether arms, legs, trunk, head and feet stop one another; else hands alone stop at trunk,
            thighs and shins.
        dry_friction: Whether the joints of legs and waist have ``Motor.dry_friction``.
        peak_torque: Whether motors give no more than ``Motor.peak_torque``, else ``Motor.torque_limit``.
        islands: Whether MuJoCo solves contacts that do not concern one another apart.
        noslip_iterations: Of MuJoCo's no-slip pass, where a rubber palm touches an object.
    """

    name: str
    self_collision: bool = False
    dry_friction: bool = False
    peak_torque: bool = False
    islands: bool = True
    noslip_iterations: int = 3


FIRST = Physics(name="first")
SECOND = Physics(
    name="second",
    self_collision=True,
    dry_friction=True,
    peak_torque=True,
    islands=False,
    noslip_iterations=2,
)
VERSIONS = {version.name: version for version in (FIRST, SECOND)}
PHYSICS = SECOND
"""The physics of scenes without a controller; that of the default controller."""


def named(name: str) -> Physics:
    """Return a version.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if name not in VERSIONS:
        raise UnknownNameError("physics", name, VERSIONS)
    return VERSIONS[name]
