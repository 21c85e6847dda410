"""A demonstration -> the same commands sent to the same start, compared with the recording bit for bit."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gym_demohlm.control import controllers
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.demonstrations.demonstration import Demonstration, measure
from lerobot_demohlm.reproducibility import provenance

JOINT_BOUND = 0.02
"""Largest difference of a joint [rad] that a replay may have under other versions or on another kind of processor.

Arithmetic that rounds otherwise has changed joints by up to 0.003 rad over a demonstration (EraseBoard)."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """How a replay compares with the recording.

    Attributes:
        num_ticks: Commands replayed.
        first_difference: First tick whose measurements differ in any bit; None where none does.
        end_identical: Whether the simulation's whole state after the last command is bit for bit the recorded one.
        largest_difference: Of all joint positions [rad].
        success: Whether the task's condition held after the last command.
        recorded_success: Whether it did so when it was recorded.
        remarks: Which of controller and model are others than when it was recorded, a line each.
        other_versions: What else may change bits: versions of libraries, kind of processor, a line each.
    """

    num_ticks: int
    first_difference: int | None
    end_identical: bool
    largest_difference: float
    success: bool
    recorded_success: bool
    remarks: tuple[str, ...]
    other_versions: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether every bit agrees."""
        return self.first_difference is None and self.end_identical

    @property
    def within_bounds(self) -> bool:
        """Whether joints stay within ``JOINT_BOUND`` and the recording's end is reached."""
        return self.largest_difference <= JOINT_BOUND and self.success == self.recorded_success

    @property
    def agrees(self) -> bool:
        """Whether every bit agrees or, under versions that may change bits, all is within bounds."""
        return self.identical or (bool(self.other_versions) and self.within_bounds)

    def lines(self) -> list[str]:
        """Return the verdict in words, after what differs in the installation."""
        said = [*self.remarks, *self.other_versions]
        if self.identical:
            return [*said, f"{self.num_ticks} ticks replayed: every bit as recorded"]
        tick = self.first_difference
        where = "in the final state only" if tick is None else f"from tick {tick} on"
        end = "success" if self.success else "no success"
        text = (
            f"{self.num_ticks} ticks replayed: different {where}, joints by up to {self.largest_difference:.2e} rad, "
            f"{end} at the end{'' if self.success == self.recorded_success else ', unlike the recording'}"
        )
        if not self.other_versions:
            return [*said, f"{text}; bits must agree under equal versions"]
        verdict = "within" if self.within_bounds else "outside"
        bounds = f"the bounds for other versions: joints within {JOINT_BOUND} rad, success at the end as recorded"
        return [*said, f"{text}; {verdict} {bounds}"]


def replay(
    demonstration: Demonstration,
    frame: Callable[[Simulation], None] | None = None,
    controller: str | None = None,
) -> Replay:
    """Send the recorded commands to the recorded start and compare, bit for bit.

    The robot has the controller that it was recorded with, where that is installed, and else the default one.

    Args:
        demonstration: The recording.
        frame: Called with the simulation before every command, for pictures.
        controller: Name, path or hash of another controller.
    """
    task = get_task(demonstration.task)
    used = controller or controllers.recorded(demonstration.metadata.get("controller_hash")) or controllers.DEFAULT
    sim = Simulation(task, controller=used)
    remarks = tuple(_changed_hashes(demonstration, sim, used))
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
    end, success = sim.snapshot(), bool(sim.success()[0])
    same = all(end[name].tobytes() == demonstration.end[name].tobytes() for name in end)
    sim.close()
    return Replay(
        num_ticks=len(demonstration),
        first_difference=first,
        end_identical=same,
        largest_difference=largest,
        success=success,
        recorded_success=bool(demonstration.success[-1]),
        remarks=remarks,
        other_versions=provenance.bit_differences(demonstration.metadata.get("versions") or {}),
    )


def _changed_hashes(demonstration: Demonstration, sim: Simulation, controller: str) -> Iterator[str]:
    now = {"controller_hash": provenance.controller_hash(controller), "model_hash": provenance.model_hash(sim.model)}
    for key, value in now.items():
        if demonstration.metadata.get(key) != value:
            yield f"{key.replace('_', ' ')} {str(demonstration.metadata.get(key))[:12]} recorded, {value[:12]} now"
