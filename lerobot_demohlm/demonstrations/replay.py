"""A demonstration -> the same commands sent to the same start, compared with the recording bit for bit."""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.demonstrations.demonstration import Demonstration, load, measure
from lerobot_demohlm.reproducibility import provenance


@dataclass(frozen=True, kw_only=True)
class Replay:
    """How a replay compares with the recording.

    Attributes:
        num_ticks: Commands replayed.
        first_difference: First tick whose measurements differ in any bit; None where none does.
        end_identical: Whether the simulation's whole state after the last command is bit for bit the recorded one.
        largest_difference: Of all joint positions [rad].
        remarks: What differs in the installation: controller, model, versions.
    """

    num_ticks: int
    first_difference: int | None
    end_identical: bool
    largest_difference: float
    remarks: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether every bit agrees."""
        return self.first_difference is None and self.end_identical


def replay(demonstration: Demonstration, frame: Callable[[Simulation], None] | None = None) -> Replay:
    """Send the recorded commands to the recorded start and compare, bit for bit.

    Args:
        demonstration: The recording.
        frame: Called with the simulation before every command, for pictures.
    """
    task = get_task(demonstration.task)
    sim = Simulation(task)
    remarks = tuple(_installation_differences(demonstration, sim))
    sim.restore(demonstration.start)
    first, largest = None, 0.0
    for tick in range(len(demonstration)):
        if frame is not None:
            frame(sim)
        row = measure(sim)
        differs = any(row[name].tobytes() != getattr(demonstration, name)[tick].tobytes() for name in row)
        if differs and first is None:
            first = tick
        joints = row["state"][: len(g1.BODY_JOINTS)] - demonstration.joint_positions[tick]
        largest = max(largest, float(np.abs(joints).max()))
        sim.step(demonstration.action[tick][None].astype(np.float64))
    end = sim.snapshot()
    same = all(end[name].tobytes() == demonstration.end[name].tobytes() for name in end)
    sim.close()
    return Replay(
        num_ticks=len(demonstration),
        first_difference=first,
        end_identical=same,
        largest_difference=largest,
        remarks=remarks,
    )


def _installation_differences(demonstration: Demonstration, sim: Simulation) -> Iterator[str]:
    now = {"controller_hash": provenance.controller_hash(), "model_hash": provenance.model_hash(sim.model)}
    for key, value in now.items():
        if demonstration.metadata.get(key) != value:
            yield f"{key.replace('_', ' ')} {str(demonstration.metadata.get(key))[:12]} recorded, {value[:12]} now"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm replay``."""
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument("--root", type=Path, help="directory of the demonstration (default: the packaged one)")


def main(arguments: argparse.Namespace) -> int:
    """Replay a demonstration; exit code 1 where any bit differs."""
    outcome = replay(load(arguments.root, get_task(arguments.task)))
    for remark in outcome.remarks:
        print(remark)
    if outcome.identical:
        print(f"{outcome.num_ticks} ticks replayed: every bit as recorded")
        return 0
    where = (
        "in the final state only" if outcome.first_difference is None else f"from tick {outcome.first_difference} on"
    )
    print(
        f"{outcome.num_ticks} ticks replayed: different {where}, joints by up to {outcome.largest_difference:.2e} rad; "
        "bits hold for one version of MuJoCo and one family of processors"
    )
    return 1
