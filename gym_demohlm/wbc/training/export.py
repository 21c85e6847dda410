"""A trained actor -> ``weights.npz``: arrays and JSON metadata that the run-time controller loads without torch."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization

from gym_demohlm.control import features, reference
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

FORMAT = 4


def export_weights(actor: MLPModel, pose: reference.Reference, path: Path, facts: dict[str, Any]) -> None:
    """Write the actor.

    Args:
        actor: The symmetric actor with its normaliser.
        pose: The reference, for its quasi-static tables.
        path: Of the file to write, replaced at once.
        facts: How it was trained, kept in the metadata.
    """
    arrays: dict[str, np.ndarray] = {
        "posture_table": pose.posture_table,
        "arm_table": pose.arm_load.table,
    }
    normaliser = cast(EmpiricalNormalization, actor.obs_normalizer)
    arrays["mean"] = normaliser.mean.detach().cpu().numpy().astype(np.float32)
    arrays["scale"] = (1.0 / (normaliser.std + normaliser.eps)).detach().cpu().numpy().astype(np.float32)
    linear = [layer for layer in actor.mlp if isinstance(layer, torch.nn.Linear)]
    for index, layer in enumerate(linear):
        arrays[f"weight_{index}"] = layer.weight.detach().cpu().numpy().T.astype(np.float32)
        arrays[f"bias_{index}"] = layer.bias.detach().cpu().numpy().astype(np.float32)
    metadata = {
        "format": FORMAT,
        "layers": len(linear),
        "activation": "elu",
        "observation_size": features.OBSERVATION_SIZE,
        "history": features.HISTORY,
        "action_scale": features.ACTION_SCALE.tolist(),
        "driven_joints": list(features.DRIVEN_JOINTS),
        "control_dt_s": CONTROL_DT,
        "gait": vars(reference.GAIT),
        "stiffness": {joint: g1.motor(joint).stiffness for joint in g1.BODY_JOINTS},
        "damping": {joint: g1.motor(joint).damping for joint in g1.BODY_JOINTS},
        **facts,
    }
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, allow_pickle=False, **arrays)
    partial.replace(path)
