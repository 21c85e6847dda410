"""Several controllers under the same commands, loads and pushes -> what each does beside the first of them.

A controller is one of ours or a public one (``peer.PEERS``). Robot i gets the same with all of them, so the intervals
of the differences are those of pairs (``paired``).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gym_demohlm.control import controllers
from gym_demohlm.control.settings import UNTRIMMED, Gait, Settings
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot.physics import PHYSICS, Physics, named
from gym_demohlm.simulation import Simulation
from gym_demohlm.wbc.evaluation import paired, peer
from gym_demohlm.wbc.evaluation.benchmark import LARGEST_HAND_LOAD
from gym_demohlm.wbc.evaluation.episodes import Maker, Trials, trials
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What robots are asked for.

    Attributes:
        ranges: What commands are drawn from.
        largest_hand_load: [kg].
        rows: What is compared, names of ``Trials.rows``.
        takes_peers: Whether a public velocity policy can follow these commands.
    """

    ranges: CommandRange
    largest_hand_load: float
    rows: tuple[str, ...]
    takes_peers: bool


_WALKING = (
    "linear_velocity_error",
    "yaw_rate_error",
    "linear_velocity_error_cycle",
    "yaw_rate_error_cycle",
    "standing_drift",
    "walking_power",
    "walking_slip",
    *paired.HIGHER_IS_BETTER,
)
PROTOCOLS = {
    "whole": Protocol(
        ranges=CommandRange(), largest_hand_load=LARGEST_HAND_LOAD, rows=paired.ACCEPTED, takes_peers=False
    ),
    "arms": Protocol(
        ranges=CommandRange().upright(), largest_hand_load=LARGEST_HAND_LOAD, rows=_WALKING, takes_peers=True
    ),
    "velocity": Protocol(ranges=CommandRange().velocity_only(), largest_hand_load=0.0, rows=_WALKING, takes_peers=True),
}
"""``whole``: all commands. ``arms``: velocities, and moving arms with loads. ``velocity``: velocities alone."""


def contest(
    names: Sequence[str],
    protocol: str,
    num_worlds: int,
    seconds: float,
    seed: int = 0,
    num_threads: int = 2,
    *,
    num_seeds: int = 3,
    physics: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Compare controllers with the first one of them.

    Args:
        names: Two or more controllers: of ours (name, path, hash), or keys of ``peer.PEERS``.
        protocol: A key of ``PROTOCOLS``.
        num_worlds: Robots of each controller, shared among seeds and pairs of hand loads.
        seconds: Of each of their episodes [s].
        seed: The first, of loads, commands and pushes.
        num_threads: Threads of the physics.
        num_seeds: Seeds, one after another.
        physics: Name of the robots' physics; by default that of the first controller, or, where that is a public one,
            that of scenes without a controller.

    Yields:
        For each controller after the first: ``protocol``, ``controller``, ``beside``, ``rows`` (``paired.Row``, whose
        ``new`` is of the controller and ``old`` of the first one), ``physics``, and the size.

    Raises:
        SceneError: Fewer than two controllers, or a public one where the protocol asks for more than velocities.
        UnknownNameError: No protocol, controller or physics is called so.
        SceneError: A weights file is damaged, or the package of a public controller is not installed.
    """
    if protocol not in PROTOCOLS:
        raise UnknownNameError("protocol", protocol, PROTOCOLS)
    if len(names) < 2:
        raise SceneError(f"{len(names)} controllers", "two or more", "name them after --controllers")
    asked = PROTOCOLS[protocol]
    public = [name for name in names if name in peer.PEERS]
    if public and not asked.takes_peers:
        able = " or ".join(name for name, known in PROTOCOLS.items() if known.takes_peers)
        raise SceneError(
            f"{public[0]} under the protocol {protocol!r}",
            "a public controller under one that asks for velocities alone",
            f"pass --protocol {able}",
        )
    own = PHYSICS if names[0] in peer.PEERS else controllers.load(names[0]).settings.physics
    chosen = named(physics) if physics else own
    labels = [_label(name) for name in names]
    makers = [_maker(name, chosen, moving_arms=protocol == "arms") for name in names]
    ranges = asked.ranges
    for name in public:
        ranges = _common(ranges, peer.load_policy(name))
    run = _Run(protocol=protocol, ranges=ranges, size=(num_worlds, seconds, seed, num_threads), num_seeds=num_seeds)
    yield from run.compare(labels, makers, chosen)


ABLATIONS: dict[str, Callable[[Settings], Settings]] = {
    "velocity-map": lambda own: replace(own, velocity_map=()),
    "trim": lambda own: replace(own, trim=UNTRIMMED),
    "recovery": lambda own: _walking(own, recovery_s=0.0),
    "inward": lambda own: _walking(own, inward=Gait.inward),
    "capture": lambda own: _walking(own, capture=Gait.capture),
    "swing-upright": lambda own: _walking(own, swing_upright=Gait.swing_upright),
    "turn": lambda own: _walking(own, turn=Gait.turn),
    "sway": lambda own: _walking(own, sway=Gait.sway),
    "spread": lambda own: _walking(own, spread=Gait.spread),
    "placement": lambda own: _walking(own, placement_s=Gait.placement_s),
}
"""Part of the settings of ``control.settings`` -> a controller's settings with that part as it was at first, or without
the trim, which the first controller has, too."""


def _walking(own: Settings, **changed: Any) -> Settings:  # noqa: ANN401
    return replace(own, gait=replace(own.gait, **changed))


def ablate(
    name: str,
    parts: Sequence[str],
    num_worlds: int,
    seconds: float,
    seed: int = 0,
    num_threads: int = 2,
    *,
    num_seeds: int = 3,
) -> Iterator[dict[str, Any]]:
    """Compare a controller with itself without parts of its settings, over the whole command range.

    Args:
        name: Of the controller: name, path or hash.
        parts: Keys of ``ABLATIONS``. A part that is as it was at first in this controller is skipped.
        num_worlds: Robots of each controller, shared among seeds and pairs of hand loads.
        seconds: Of each of their episodes [s].
        seed: The first, of loads, commands and pushes.
        num_threads: Threads of the physics.
        num_seeds: Seeds, one after another.

    Yields:
        As ``contest``; ``controller`` is "without" and the part.

    Raises:
        UnknownNameError: No controller or part is called so.
    """
    for part in parts:
        if part not in ABLATIONS:
            raise UnknownNameError("ablation", part, ABLATIONS)
    own = controllers.load(name).settings
    found = {part: ABLATIONS[part](own) for part in parts}
    left = {part: settings for part, settings in found.items() if settings != own}
    asked, weights = PROTOCOLS["whole"], controllers.find(name)
    makers = [_worlds(weights, settings) for settings in (own, *left.values())]
    labels = [_label(name), *(f"without {part}" for part in left)]
    run = _Run(
        protocol="whole", ranges=asked.ranges, size=(num_worlds, seconds, seed, num_threads), num_seeds=num_seeds
    )
    yield from run.compare(labels, makers, own.physics)


def worlds_in(weights: Path, physics: Physics) -> Maker:
    """Return what makes worlds of a controller in a physics that need not be its own."""
    return _worlds(weights, replace(controllers.load(str(weights)).settings, physics=physics))


def _worlds(weights: Path, settings: Settings) -> Maker:
    def make(count: int, disturbance: Disturbance, num_threads: int) -> Simulation:
        controller = WholeBodyController(count, weights)
        controller.settings = settings
        return Simulation(trial_task(disturbance), count, num_threads, controller)

    return make


def _maker(name: str, physics: Physics, moving_arms: bool) -> Maker:
    if name not in peer.PEERS:
        return worlds_in(controllers.find(name), physics)
    policy = peer.load_policy(name)
    return lambda count, disturbance, threads: peer.PeerSimulation(
        count, policy, disturbance, threads, moving_arms=moving_arms, physics=physics
    )


def _label(name: str) -> str:
    return name if name in peer.PEERS else controllers.load(name).hash[: controllers.HASH_DIGITS]


def _common(ranges: CommandRange, policy: peer.PeerPolicy) -> CommandRange:
    """Return the velocities that a public policy was trained for, too."""

    def both(ours: tuple[float, float], theirs: tuple[float, float]) -> tuple[float, float]:
        return max(ours[0], theirs[0]), min(ours[1], theirs[1])

    return replace(
        ranges,
        forward=both(ranges.forward, policy.forward),
        sideways=both(ranges.sideways, policy.sideways),
        yaw_rate=both(ranges.yaw_rate, policy.yaw_rate),
    )


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One protocol for several controllers; ``size`` is worlds, seconds, seed and threads."""

    protocol: str
    ranges: CommandRange
    size: tuple[int, float, int, int]
    num_seeds: int

    def compare(self, labels: Sequence[str], makers: Sequence[Maker], physics: Physics) -> Iterator[dict[str, Any]]:
        """Try the first controller, then the others, each of which yields its comparison."""
        first, num_worlds, seconds, seed = self._try(makers[0]), *self.size[:3]
        for label, make in zip(labels[1:], makers[1:], strict=True):
            rows = paired.compare(self._try(make), first, rows=PROTOCOLS[self.protocol].rows)
            yield {
                "protocol": self.protocol,
                "controller": label,
                "beside": labels[0],
                "physics": physics.name,
                "rows": [asdict(row) for row in rows],
                "num_worlds": num_worlds,
                "num_seeds": self.num_seeds,
                "seconds": seconds,
                "seed": seed,
            }

    def _try(self, make: Maker) -> Trials:
        load = PROTOCOLS[self.protocol].largest_hand_load
        return trials(*self.size, self.ranges, num_seeds=self.num_seeds, largest_hand_load=load, make=make)
