"""The walking controller, on a body that obeys it with a lag and sways as it walks, comes to stand at its goal."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command, gait_clock
from lerobot_demohlm.generation.locomotion import BaseEstimate, LocomotionSettings, OffCourseError, walk, walk_velocity

SETTINGS = LocomotionSettings()


class Body:
    """A base whose velocity follows the command with a time constant, swaying with the gait while it walks."""

    def __init__(self, start: np.ndarray, lag_s: float = 0.3, sway: float = 0.02) -> None:
        self.base, self.lag_s, self.sway = start.copy(), lag_s, sway
        self.velocity, self.time = np.zeros(3), 0.0
        self.path = [start.copy()]

    def pelvis(self) -> np.ndarray:
        """Return the measured pose (4, 4)."""
        moving = np.abs(self.velocity).max() > 0.02
        phase = 2 * np.pi * self.time / 0.72
        sway = poses.planar(0.0, self.sway * np.sin(phase) * moving, 0.05 * np.cos(phase) * moving)
        return poses.planar(*self.base) @ sway

    def step(self, wanted: np.ndarray) -> None:
        """Obey a velocity command (3,) for 0.1 s; slow ones mean to stand."""
        wanted = np.where((np.abs(wanted) < gait_clock.WALK_THRESHOLD).all(), 0.0, wanted)
        self.velocity += (wanted - self.velocity) * 0.1 / self.lag_s
        self.base = poses.to_planar(poses.planar(*self.base) @ poses.planar(*(0.1 * self.velocity)))
        self.time += 0.1
        self.path.append(self.base.copy())


@pytest.mark.parametrize("seed", range(30))
def test_it_comes_to_stand_at_its_goal(seed: int) -> None:
    """From anywhere in the widest region, within ten seconds, and never past the goal by more than 5 cm."""
    rng = np.random.default_rng(seed)
    goal = np.array([0.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.8, 0.8)])
    body = Body(np.array([*rng.uniform([-1.2, -0.3], [-0.3, 0.3]), rng.uniform(-0.8, 0.8)]))
    for wanted in walk(body.pelvis, goal):
        assert (np.abs(wanted[command.VELOCITY]) <= [0.45, 0.25, 0.5]).all()
        np.testing.assert_array_equal(wanted[3:], command.rest()[3:])
        body.step(wanted[command.VELOCITY])
    assert np.hypot(*(body.base - goal)[:2]) < SETTINGS.accept_m
    assert abs(poses.wrap_angle(body.base[2] - goal[2])) < SETTINGS.accept_rad
    assert body.time < 10.0
    ahead = [poses.transform(poses.invert(poses.planar(*goal)), [*base[:2], 0.0])[0] for base in body.path]
    assert max(ahead) < 0.05


def test_it_lines_up_before_it_steps_in() -> None:
    """Beside the goal it holds back; in line with it, it does not."""
    goal = np.zeros(3)
    assert walk_velocity(np.array([-0.1, 0.3, 0.0]), np.zeros(3), goal, SETTINGS)[0] < 0.0
    assert walk_velocity(np.array([-0.1, 0.0, 0.0]), np.zeros(3), goal, SETTINGS)[0] > 0.05


def test_the_command_is_in_the_heading_frame() -> None:
    """A planar motion of body and goal together changes nothing."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        here, goal = rng.uniform(-1, 1, size=3), rng.uniform(-1, 1, size=3)
        velocity = rng.uniform(-0.3, 0.3, size=3)
        turn = rng.uniform(-3, 3)
        M = poses.planar(*rng.uniform(-1, 1, size=2), turn)
        moved = [poses.to_planar(M @ poses.planar(*base)) for base in (here, goal)]
        turned = np.append(M[:2, :2] @ velocity[:2], velocity[2])
        np.testing.assert_allclose(
            walk_velocity(moved[0], turned, moved[1], SETTINGS),
            walk_velocity(here, velocity, goal, SETTINGS),
            atol=1e-9,
        )


def test_limits_bend_the_way_unless_it_is_to_be_straight() -> None:
    """A goal far ahead and aside: with limits a axis the base goes sideways as fast as ahead."""
    here, goal = np.zeros(3), np.array([3.0, 1.0, 0.0])
    bent = walk_velocity(here, np.zeros(3), goal, replace(SETTINGS, standoff=0.0))
    straight = walk_velocity(here, np.zeros(3), goal, replace(SETTINGS, standoff=0.0, straight=True))
    assert bent[:2] == pytest.approx([0.45, 0.25])
    assert straight[:2] == pytest.approx([0.45, 0.15])
    slow = np.array([0.1, 0.05, 0.0])
    assert walk_velocity(here, np.zeros(3), slow, replace(SETTINGS, straight=True))[:2] == pytest.approx([0.12, 0.06])


def test_sway_is_averaged_out() -> None:
    """At constant speed the estimate follows the body, not its sway, also across the jump of the yaw angle."""
    base = BaseEstimate(window_ticks=7)
    body = Body(np.array([0.0, 0.0, 3.0]), sway=0.03)
    for _ in range(60):
        body.step(np.array([0.3, 0.0, 0.4]))
        base.update(body.pelvis())
    assert np.hypot(*(base.position - body.base)[:2]) < 0.02
    assert abs(poses.wrap_angle(base.position[2] - body.base[2])) < 0.02
    assert base.velocity[2] == pytest.approx(0.4, abs=0.03)
    assert np.hypot(*base.velocity[:2]) == pytest.approx(0.3, abs=0.03)


def test_a_body_that_does_not_move_is_off_course() -> None:
    here = poses.planar(0.0, 0.0, 0.0)
    with pytest.raises(OffCourseError):
        list(walk(lambda: here, np.array([0.5, 0.0, 0.0])))
    commands = []
    with pytest.raises(OffCourseError):
        for wanted in walk(lambda: here, np.array([0.5, 0.0, 0.0]), LocomotionSettings(max_ticks=20)):
            commands.append(wanted)
    assert 20 <= len(commands) <= 20 + SETTINGS.settle_ticks
