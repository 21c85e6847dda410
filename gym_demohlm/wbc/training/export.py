"""A trained actor -> ``weights.npz``: arrays and JSON metadata that the run-time controller loads without torch."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization

from gym_demohlm.control import features, reference
from gym_demohlm.control.settings import Settings
from gym_demohlm.control.whole_body import WEIGHTS_FORMAT, read_arrays
from gym_demohlm.errors import SceneError
from gym_demohlm.files import replacing
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.training.mirror_model import MirrorModel

_SEEN = 30_000_000  # samples that the normaliser of imported weights is taken to have seen


def import_weights(actor: MLPModel, path: Path) -> None:
    """Set an actor's network and normaliser to those of exported weights, to go on learning from there.

    Inputs that the file does not know begin with a weight of zero.

    Raises:
        SceneError: As ``read_arrays``.
    """
    _, metadata, arrays = read_arrays(path)
    more = features.OBSERVATION_SIZE - len(arrays["mean"])
    scale = np.pad(arrays["scale"], (0, more), constant_values=1.0)
    normaliser = cast(EmpiricalNormalization, actor.obs_normalizer)
    std = 1.0 / scale - normaliser.eps
    values = {"_mean": np.pad(arrays["mean"], (0, more)), "_std": std, "_var": std**2}
    arrays["weight_0"] = np.pad(arrays["weight_0"], ((0, more), (0, 0)))
    linear = [layer for layer in actor.mlp if isinstance(layer, torch.nn.Linear)]
    if len(linear) != metadata["layers"]:
        got = f"weights of {metadata['layers']} layers"
        raise SceneError(got, f"{len(linear)}, as the network that is trained", "train a network of that size")
    with torch.no_grad():
        for name, numbers in values.items():
            cast(torch.Tensor, getattr(normaliser, name)).copy_(torch.from_numpy(numbers)[None])
        cast(torch.Tensor, normaliser.count).fill_(_SEEN)
        for index, layer in enumerate(linear):
            layer.weight.copy_(torch.from_numpy(arrays[f"weight_{index}"].T))
            layer.bias.copy_(torch.from_numpy(arrays[f"bias_{index}"]))


def export_weights(
    actor: MLPModel, pose: reference.Reference, settings: Settings, path: Path, facts: dict[str, Any]
) -> None:
    """Write the actor.

    Args:
        actor: The actor with its normaliser.
        pose: The reference that it corrects, for its quasi-static tables.
        settings: Gait, slew and trim at run time.
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
        "format": WEIGHTS_FORMAT,
        "layers": len(linear),
        "activation": "elu",
        "observation_size": features.OBSERVATION_SIZE,
        "history": features.HISTORY,
        "action_scale": features.ACTION_SCALE.tolist(),
        "driven_joints": list(features.DRIVEN_JOINTS),
        "control_dt_s": CONTROL_DT,
        "symmetric": cast(MirrorModel, actor).symmetric,
        "use_reference": not isinstance(pose, reference.Rest),
        **settings.metadata(),
        **facts,
    }
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
