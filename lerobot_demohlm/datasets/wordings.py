"""A task -> its sentence in several wordings, for policies that read; an episode has one of them."""

from collections.abc import Mapping

from gym_demohlm.task import Task

WORDINGS: Mapping[str, tuple[str, ...]] = {
    "LiftBox": (
        "Lift the box with both hands.",
        "Go to the box and raise it between your palms.",
        "Pick the box up with two hands.",
    ),
    "PressCube": (
        "Press down on the cube with your right hand.",
        "Go to the cube and push down on it.",
        "Put your right palm on the cube and press.",
    ),
    "PushCube": (
        "Push the cube to the left until it is on the green field.",
        "Slide the cube onto the green part of the table with your right hand.",
        "Move the cube onto the green area.",
    ),
    "Handover": (
        "Push the cube off the table and catch it with your left hand.",
        "Hand the cube from the table to your left palm.",
        "With your right hand, push the cube into your left hand.",
    ),
    "GraspCube": (
        "Grasp the cube with the right gripper and lift it.",
        "Pick up the cube from the table.",
        "Go to the table, take the cube and raise it.",
    ),
    "OpenCabinet": (
        "Open the cabinet.",
        "Pull the cabinet's door open with the right gripper.",
        "Go to the cabinet, take the handle and open the door.",
    ),
    "PushCart": (
        "Push the cart forward.",
        "Take the cart by its bar and push it.",
        "Go to the cart, hold its bar with both grippers and move it ahead.",
    ),
    "EraseBoard": (
        "Wipe the board.",
        "Take the eraser and clean the writing off the board.",
        "Erase what is written on the board.",
    ),
    "PourWater": (
        "Pour the water into the bowl.",
        "Take the bottle and empty it into the bowl.",
        "Grasp the bottle with the right gripper and fill the bowl.",
    ),
    "ExchangeCube": (
        "Pass the cube from the right gripper to the left one.",
        "Take the cube with the right gripper and hand it over to the left.",
        "Move the cube from one gripper to the other.",
    ),
    "StackCube": (
        "Stack the red cube on the blue one.",
        "Pick up the red cube and put it on top of the blue cube.",
        "Take the red cube with the right gripper and set it on the blue cube.",
    ),
    "CarryBox": (
        "Carry the box to the other table.",
        "Take the box with both hands and put it down on the other table.",
        "Lift the box between your palms, walk to the other table and set it down.",
    ),
}


def wordings(task: Task) -> tuple[str, ...]:
    """Return a task's description, then other wordings of it; a task of somebody else's may have none."""
    return (task.description, *WORDINGS.get(task.name, ()))
