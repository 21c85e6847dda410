"""PushCart: walk to a platform cart, grip its push bar with both grippers and push the cart ahead.

Source: the paper's "Task Settings" and "Success Conditions": both grippers are closed and hold the crossbar. Changed:
the cart must also have moved; yaw is limited to +-45 degrees, because a cart is pushed from behind; the floor under it
cannot be lowered, so the region's z offset lowers the bar on telescopic posts. Fixed wheels in front, casters behind.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import WORLD_BIT
from gym_demohlm.scene import aim_overview
from gym_demohlm.scene.furniture import CARDBOARD, STEEL, add_picture, add_shape
from gym_demohlm.task import REGIONS, ObjectSpec, Task, limit_yaw

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CART_POSITION = (0.82, 0.0, 0.0)  # m, the floor under the middle of the deck
BAR_HEIGHT, BAR_X, BAR_HALF_LENGTH, BAR_RADIUS = 0.92, -0.42, 0.26, 0.014  # m
DECK, DECK_HEIGHT = (0.30, 0.21, 0.012), 0.15  # m, half lengths; its middle's height
POST_X, POST_Y, POST_TOP = -0.27, 0.09, 0.56  # m
WHEEL_RADIUS, WHEEL_X, WHEEL_Y, TRAIL = 0.05, 0.23, 0.17, 0.03  # m
LOCK_FORCE = 400.0  # N, of the clamps that hold the telescopic posts
MOVED = 0.3  # m
_DECK, _RUBBER, _GRIP = (0.24, 0.36, 0.55, 1), (0.10, 0.10, 0.11, 1), (0.85, 0.45, 0.10, 1)


def _build(spec: mujoco.MjSpec) -> None:
    aim_overview(spec, (0.5, -2.7, 1.45), (0.15, 0.0, 0.55))
    cart = spec.worldbody.add_body(name="cart", pos=CART_POSITION)
    cart.add_freejoint(name="cart")
    for y in (-WHEEL_Y, WHEEL_Y):
        add_picture(cart, "box", [DECK[0] - 0.02, 0.012, 0.015], [0, y, DECK_HEIGHT - 0.027], STEEL, 0.5)
    bed = cart.add_body(name="bed")
    add_shape(bed, "deck", "box", DECK, [0, 0, DECK_HEIGHT], _DECK, 6.0)
    for index, (half, x, y) in enumerate((((0.12, 0.14, 0.11), 0.12, 0.03), ((0.09, 0.09, 0.08), -0.12, -0.08))):
        add_shape(bed, f"load_{index}", "box", half, [x, y, DECK_HEIGHT + DECK[2] + half[2]], CARDBOARD, 2.0)
    handle = cart.add_body(name="handle", pos=[POST_X, 0, BAR_HEIGHT])
    slide = handle.add_joint(name="bar_height", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    slide.limited, slide.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-0.25, 0.05]
    slide.frictionloss, slide.solref_friction, slide.solimp_friction[:3] = LOCK_FORCE, [0.004, 1], [0.99, 0.999, 0.001]
    for side, y in (("left", POST_Y), ("right", -POST_Y)):
        half = (POST_TOP - DECK_HEIGHT) / 2
        add_shape(bed, f"post_{side}", "cylinder", [0.015, half], [POST_X, y, DECK_HEIGHT + half], STEEL, 0.4)
        add_picture(handle, "cylinder", [0.011, 0.24], [0, y, -0.24], STEEL, 0.3)
        add_picture(handle, "box", [(POST_X - BAR_X) / 2, 0.011, 0.011], [(BAR_X - POST_X) / 2, y, 0], STEEL, 0.2)
    bar = handle.add_body(name="bar", pos=[BAR_X - POST_X, 0, 0])
    grip = add_shape(bar, "bar", "capsule", [BAR_RADIUS, BAR_HALF_LENGTH], rgba=_GRIP, mass=0.4)
    grip.quat = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]  # along y
    for side, y in (("left", WHEEL_Y), ("right", -WHEEL_Y)):
        _add_wheel(cart, f"front_{side}", (WHEEL_X, y))
        caster = cart.add_body(name=f"caster_{side}", pos=[-WHEEL_X + TRAIL, y, 0])
        swivel = caster.add_joint(name=f"caster_{side}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        swivel.damping[0], swivel.armature = 0.005, 1e-3
        add_picture(caster, "box", [0.022, 0.02, 0.012], [-TRAIL / 2, 0, 2 * WHEEL_RADIUS + 0.012], STEEL, 0.1)
        _add_wheel(caster, f"rear_{side}", (-TRAIL, 0.0))


def _add_wheel(body: mujoco.MjsBody, name: str, position: tuple[float, float]) -> None:
    """Add a wheel that turns about y. It touches the floor as a ball, in one point, and looks like a disc."""
    wheel = body.add_body(name=f"wheel_{name}", pos=[*position, WHEEL_RADIUS])
    axle = wheel.add_joint(name=f"wheel_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    axle.damping[0], axle.frictionloss, axle.armature = 0.005, 0.001, 1e-4
    tyre = add_shape(wheel, f"wheel_{name}", "sphere", [WHEEL_RADIUS], mass=0.3)
    tyre.contype, tyre.conaffinity, tyre.condim, tyre.group = WORLD_BIT, 0, 3, 3
    for radius, half_width, rgba in ((WHEEL_RADIUS, 0.015, _RUBBER), (0.022, 0.017, STEEL)):
        disc = add_picture(wheel, "cylinder", [radius, half_width], rgba=rgba)
        disc.quat = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]


def _pushed(sim: "Worlds") -> np.ndarray:
    moved = (sim.pose("cart") - sim.start_pose("cart"))[:, :2, 3]
    held = sim.holds("left", "bar") & sim.holds("right", "bar")
    return held & (np.sqrt((moved**2).sum(axis=1)) > MOVED)


TASK = Task(
    name="PushCart",
    description="Walk to the cart, grip its bar with both grippers and push it ahead.",
    hands="gripper",
    build=_build,
    objects=(
        ObjectSpec(name="bar", position=(CART_POSITION[0] + BAR_X, 0.0, BAR_HEIGHT), placed=False),
        ObjectSpec(name="cart", position=CART_POSITION, height_joint="bar_height"),
    ),
    success=_pushed,
    gaze_target="bar",
    obstacles=("bed",),
    contact_pairs=(("left", "bar"), ("right", "bar")),
    regions=limit_yaw(REGIONS, math.pi / 4),
    highest_z=0.05,  # the posts end
    motion_frame="hands",
    episode_length_s=35.0,
)
