"""The safety filter: whatever is wanted, what leaves it is within every limit; and nothing leaves but through it."""

import ast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.demonstrations import demonstration
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowCmd
from lerobot_demohlm.hardware.limits import ARMS, DAMPING, Limits
from lerobot_demohlm.hardware.link import LOW_CMD, Link
from lerobot_demohlm.hardware.safety import BodyCheck, SafetyFilter, Wanted
from lerobot_demohlm.hardware.wire_watch import WireWatch
from tests.helpers.paths import REPOSITORY

LIMITS = Limits()
KP, KD = np.full(NUM_JOINTS, 100.0), np.full(NUM_JOINTS, 3.0)


@pytest.fixture(scope="module")
def rubber() -> SafetyFilter:
    return SafetyFilter(LIMITS, "rubber")


numbers = st.one_of(
    st.floats(-4.0, 4.0), st.floats(allow_nan=True, allow_infinity=True, width=32), st.sampled_from([1e30, -1e30])
)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), odd=st.lists(numbers, min_size=6, max_size=6))
def test_whatever_is_wanted_the_wire_is_within_every_limit(rubber: SafetyFilter, seed: int, odd: list[float]) -> None:
    """The robot's own side of the wire, which shares no state with the filter, finds nothing beyond a limit."""
    rng = np.random.default_rng(seed)
    watch = WireWatch(LIMITS, 5)
    rubber.damp(5)
    q = g1.HOME.copy()
    for step in range(6):
        wanted_q = g1.HOME + rng.normal(scale=[0.02, 0.3, 3.0, 0.1, 1.0, 0.5][step], size=NUM_JOINTS)
        kp, kd = KP * rng.uniform(0, 8), KD * rng.uniform(0, 8)
        if seed % 2:
            wanted_q[seed % NUM_JOINTS], kp[step] = odd[step], odd[-step]
        q = q + rng.normal(scale=0.05, size=NUM_JOINTS)
        dq = rng.normal(scale=3.0, size=NUM_JOINTS)
        sent = rubber(Wanted(q=wanted_q, kp=kp, kd=kd), q, dq, 5)
        assert sent.is_sound()
        assert watch.take(sent.to_bytes(), q, dq) is not None
    assert watch.violations == 0, watch.worst


def test_torque_is_held_by_scaling_the_gains(rubber: SafetyFilter) -> None:
    rubber.damp(5)
    q = g1.HOME.copy()
    q[3] += 0.9  # a knee far from where it is sent
    sent = rubber(Wanted(q=g1.HOME, kp=3 * KP, kd=KD), q, np.zeros(NUM_JOINTS), 5)
    asked = sent.kp[:NUM_JOINTS] * (sent.q[:NUM_JOINTS] - q)
    assert "torque" not in rubber.changed  # the first target is where the joint is
    for _ in range(3):
        sent = rubber(Wanted(q=g1.HOME, kp=3 * KP, kd=KD), q, np.zeros(NUM_JOINTS), 5)
    asked = sent.kp[:NUM_JOINTS] * (sent.q[:NUM_JOINTS] - q)
    assert "torque" in rubber.changed
    assert np.abs(asked[3]) == pytest.approx(LIMITS.torque[3], rel=0.01)


def test_nan_damps_the_motors_for_that_tick(rubber: SafetyFilter) -> None:
    rubber.damp(5)
    sent = rubber(Wanted(q=np.full(NUM_JOINTS, np.nan), kp=KP, kd=KD), g1.HOME, np.zeros(NUM_JOINTS), 5)
    assert "finite" in rubber.changed
    assert not sent.kp.any() and (sent.kd[:NUM_JOINTS] == DAMPING).all() and np.isfinite(sent.q).all()


def test_damping_holds_no_joint_and_never_lets_go(rubber: SafetyFilter) -> None:
    sent = rubber.damp(5)
    assert sent.is_sound() and not sent.kp.any() and not sent.tau.any()
    assert (sent.kd[:NUM_JOINTS] == DAMPING).all() and not sent.kd[NUM_JOINTS:].any()


def test_arms_do_not_enter_the_body(rubber: SafetyFilter) -> None:
    """Both elbows are sent into the trunk, in small steps: they stop before they are there, the legs go on."""
    rubber.damp(5)
    check, into = BodyCheck("rubber"), g1.HOME.copy()
    left, right = (g1.BODY_JOINTS.index(f"{side}_shoulder_roll") for side in g1.SIDES)
    into[left], into[right] = -1.2, 1.2
    knee = g1.BODY_JOINTS.index("left_knee")
    into[knee] += 0.3
    assert check.overlap(into)[0] > 3 * LIMITS.overlap
    q = g1.HOME.copy()
    for _ in range(40):
        sent = rubber(Wanted(q=into, kp=KP, kd=KD), q, np.zeros(NUM_JOINTS), 5)
        q = sent.q[:NUM_JOINTS].astype(float)
        assert check.overlap(q)[0] <= LIMITS.overlap + 1e-3
    assert "self_collision" in rubber.changed
    assert q[left] > into[left] + 0.3 and q[knee] == pytest.approx(into[knee], abs=1e-5)
    for _ in range(10):  # and the way out is free
        sent = rubber(Wanted(q=g1.HOME, kp=KP, kd=KD), q, np.zeros(NUM_JOINTS), 5)
        q = sent.q[:NUM_JOINTS].astype(float)
    np.testing.assert_allclose(q, g1.HOME, atol=1e-5)


@pytest.mark.parametrize("name", ["LiftBox", "OpenCabinet"])
def test_demonstrations_pass_the_filter_untouched(name: str) -> None:
    """What the controller does in a packaged demonstration meets no limit but torque, and that for no tick either."""
    task = get_task(name)
    recorded = demonstration.load(demonstration.default_root(task), task)
    sim, safety, touched = Simulation(task), SafetyFilter(LIMITS, task.hands), []
    sim.restore(recorded.start)
    gains = sim.controller.settings  # pyright: ignore[reportAttributeAccessIssue]
    kp, kd = np.array(gains.stiffness), np.array(gains.damping)

    def on_tick(_worlds: np.ndarray, _commands: np.ndarray) -> None:
        wanted = Wanted(q=sim.last_control[0, :NUM_JOINTS], kp=kp, kd=kd)
        safety(wanted, sim.joint_positions[0], sim.joint_velocities[0], 5)
        touched.extend(safety.changed)

    sim.on_tick = on_tick
    for row in recorded.action[:80]:
        sim.step(row[None].astype(float))
    sim.close()
    assert touched == []


def test_no_process_gets_a_writer_of_commands(link: Link) -> None:
    with pytest.raises(RobotError, match="through it"):
        link.writer(LOW_CMD)


def test_the_wire_hands_nobody_its_writer(link: Link) -> None:
    from lerobot_demohlm.hardware.wire import CommandWire

    wire = CommandWire(link, SafetyFilter(LIMITS, "rubber"))
    public = [name for name in dir(wire) if not name.startswith("_")]
    assert sorted(public) == ["damp", "safety", "send"]


def test_no_code_but_the_wire_makes_a_writer_of_commands() -> None:
    """Who may call what makes a writer of commands, or a DDS writer at all, is in these files and in no others."""
    makers: dict[str, set[str]] = {"_writer": set(), "DataWriter": set(), "CommandWire": set()}
    for path in sorted((REPOSITORY / "lerobot_demohlm").rglob("*.py")):
        name = path.relative_to(REPOSITORY / "lerobot_demohlm").as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func).split(".")[-1]
                if called in makers:
                    makers[called].add(name)
    link = "hardware/link.py"
    assert makers["DataWriter"] == {link}
    assert makers["CommandWire"] == {"hardware/control_process.py"}
    benchmark = "benchmarks/deployment.py"  # its other side of the link has no robot
    assert makers["_writer"] == {link, "hardware/wire.py", benchmark}


def test_a_command_of_zeros_is_never_made(rubber: SafetyFilter) -> None:
    """Zero torque lets a robot fall freely; every command brakes at least."""
    for message in (rubber.damp(5), rubber(Wanted(q=g1.HOME, kp=KP, kd=KD), g1.HOME, np.zeros(NUM_JOINTS), 5)):
        assert (message.kd[:NUM_JOINTS] > 0.0).all()
    assert not LowCmd().kd.any()
    assert ARMS.start == 15
