"""A task -> errors of ``rgbd`` in generated episodes, the model fitted to them, and how it does on fresh ones."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from gym_demohlm.perception.error_fit import ErrorTrack, fit_model, pose_errors
from gym_demohlm.perception.error_model import ErrorModel
from gym_demohlm.perception.estimate import Perceiver
from gym_demohlm.perception.exact import ExactPerceiver
from gym_demohlm.perception.model import ModelPerceiver
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.visibility import Visibility
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from lerobot_demohlm.checks import portability
from lerobot_demohlm.reports.films import Snapshot, generated_take

FITTED = "rgbd"
_REPEATS = 3  # of the model on each fresh episode
_QUANTILES = (0.5, 0.9)


def error_track(sim: Simulation, snapshots: Sequence[Snapshot], perceiver: Perceiver, seed: int) -> ErrorTrack:
    """Return how a perceiver errs in an episode.

    Args:
        sim: One world of the task; it is moved about.
        snapshots: The episode.
        perceiver: What looks at it.
        seed: Of what is random in what it sees.
    """
    row, exact, visibility, task = np.array([0]), ExactPerceiver(), Visibility(sim), sim.task
    perceiver.begin(row, [seed])
    frames: dict[str, list[np.ndarray]] = {name: [] for name in ("told", "truth", "visible", "valid")}
    for snapshot in snapshots:
        sim.restore(snapshot)
        estimate, truth = perceiver.observe(sim, row), exact.observe(sim, row).T_camera_object
        frames["told"].append(estimate.T_camera_object[0])
        frames["truth"].append(truth[0])
        frames["valid"].append(estimate.valid[0])
        frames["visible"].append(visibility.shares(sim, row, truth)[0])
    told, truth, visible, valid = (np.array(frames[name]) for name in ("told", "truth", "visible", "valid"))
    errors = [pose_errors(told[:, k], truth[:, k], entry) for k, entry in enumerate(task.objects)]
    return ErrorTrack(
        distance=np.linalg.norm(truth[..., :3, 3], axis=-1),
        visible=visible,
        valid=valid,
        shift=np.stack([shift for shift, _ in errors], axis=1),
        turn=np.stack([turn for _, turn in errors], axis=1),
    )


def fit(
    task: Task, region: str, seed: int, num_episodes: int, num_checks: int
) -> tuple[ErrorModel, list[dict[str, Any]]]:
    """Fit a task's error model and compare it with episodes that it was not fitted to.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        num_episodes: Attempts that it is fitted to, from the first on.
        num_checks: Attempts after these that it is compared with.

    Returns:
        The model, and a line an object with the quantiles of both; none without checks.
    """
    task = task.at(region)
    sim = Simulation(task, 1)
    seen: list[tuple[list[Snapshot], ErrorTrack]] = []
    perceiver = make_perceiver(FITTED, task, 1)
    for index in tqdm(range(num_episodes + num_checks), desc=f"{task.name} {FITTED}", unit="episode"):
        snapshots = list(generated_take(task, region, seed, index).snapshots)
        seen.append((snapshots, error_track(sim, snapshots, perceiver, seed * 1000 + index)))
    perceiver.close()
    tracks = [track for _, track in seen[:num_episodes]]
    origin = {
        "perception": FITTED,
        "region": region,
        "seed": seed,
        "attempts": num_episodes,
        "frames": sum(len(track.valid) for track in tracks),
    }
    model = fit_model(task, tracks, origin)
    lines = _compared(task, model, sim, seen[num_episodes:]) if num_checks else []
    sim.close()
    return model, lines


def _compared(
    task: Task, model: ErrorModel, sim: Simulation, fresh: Sequence[tuple[list[Snapshot], ErrorTrack]]
) -> list[dict[str, Any]]:
    """Return the quantiles of ``rgbd`` and of the model on fresh episodes, a line an object."""
    perceiver = ModelPerceiver(task, 1, model=model)
    again = [
        error_track(sim, snapshots, perceiver, 10_000 * repeat + index)
        for index, (snapshots, _) in enumerate(fresh)
        for repeat in range(_REPEATS)
    ]
    measured = [track for _, track in fresh]
    lines = []
    for k, entry in enumerate(task.objects):
        found, modelled = _quantiles(measured, k), _quantiles(again, k)
        ratios = [modelled[name] / max(found[name], 1e-9) for name in found]
        lines.append(
            {
                "task": task.name,
                "stamp": portability.stamp(task),
                "object": entry.name,
                "fitted_to": model.origin,
                "fit": model.hash[:12],
                "fresh_attempts": len(fresh),
                "rgbd": {name: round(value, 3) for name, value in found.items()},
                "model": {name: round(value, 3) for name, value in modelled.items()},
                "largest_deviation": round(max(abs(ratio - 1.0) for ratio in ratios), 3),
                "valid_share": {
                    "rgbd": round(float(np.mean(np.concatenate([t.valid[:, k] for t in measured]))), 4),
                    "model": round(float(np.mean(np.concatenate([t.valid[:, k] for t in again]))), 4),
                },
            }
        )
    return lines


def _quantiles(tracks: Sequence[ErrorTrack], k: int) -> dict[str, float]:
    """Return quantiles of the lengths of the errors of an object in the frames that showed it."""
    found = {}
    for name, unit in (("shift", 1e3), ("turn", np.degrees(1.0))):
        errors = np.concatenate([getattr(track, name)[track.valid[:, k], k] for track in tracks])
        lengths = unit * np.linalg.norm(errors, axis=1)
        for share in _QUANTILES:
            found[f"{name}_{'mm' if name == 'shift' else 'deg'}_q{round(100 * share)}"] = float(
                np.quantile(lengths, share) if len(lengths) else np.nan
            )
    return found
