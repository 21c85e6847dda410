"""The name of a policy and of a preset -> LeRobot's training configuration: the paper's hyperparameters, or a CPU's.

``paper`` is the paper's appendix. What it does not say, or what LeRobot's policies cannot do, is marked at its place.
``cpu`` is smaller: a task trains in about a quarter of an hour on a core, or less. ``vision-cpu`` and ``vision-paper``
see pictures and the robot's state, but not where objects are; the latter is for a GPU, and not the paper's. All of a
preset is here and nowhere else.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gym_demohlm.errors import PolicyError, UnknownNameError
from lerobot_demohlm.datasets.facts import INFO_PATH, read_info

if TYPE_CHECKING:  # importing them takes seconds, which `demohlm --help` does not have
    from lerobot.configs import PolicyFeature, PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig

CHUNK = {"chunk_size": 20, "n_action_steps": 10}
"""Steps of 0.1 s. The paper names the 10 carried out for Diffusion Policy; here all three look again as often."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How one policy is trained.

    Attributes:
        type: The policy's name in LeRobot.
        batch_size: Samples a step.
        steps: Steps; the paper does not say how many.
        options: Fields of the policy's configuration.
        cosine: Whether the learning rate falls to zero after a warmup of a twentieth of the steps.
        bfloat16: Fields of the policy's configuration that are set where the processor has instructions for bfloat16.
        sees: Whether it is given pictures instead of the objects' poses.
    """

    type: str
    batch_size: int
    steps: int
    options: Mapping[str, Any] = field(default_factory=dict)
    cosine: bool = False
    bfloat16: Mapping[str, Any] = field(default_factory=dict)
    sees: bool = False


_MEAN_STD = {"normalization_mapping": {"STATE": "MEAN_STD", "ENV": "MEAN_STD", "ACTION": "MEAN_STD"}}
_MIN_MAX_STATE_ACTIONS = {"normalization_mapping": {"STATE": "MIN_MAX", "ENV": "MEAN_STD", "ACTION": "MIN_MAX"}}
_MIN_MAX_STATE = {"normalization_mapping": {"STATE": "MIN_MAX", "ENV": "MEAN_STD", "ACTION": "MEAN_STD"}}
"""Diffusion hands its inputs to Mish, which tells numbers far below -1 apart no more: the state does not lie there.

An object's place is measured by deviations all the same, or millimetres of it would be small: docs/trials.md.
"""
_TO_THE_END = {"drop_n_last_frames": 0, "do_mask_loss_for_padding": True}
"""Diffusion learns the last steps of an episode too, as the other two do, and nothing of what lies behind them."""

PRESETS: Mapping[tuple[str, str], Preset] = {
    ("mlp", "paper"): Preset(type="chunked_mlp", batch_size=512, steps=50_000, options={**CHUNK, "optimizer_lr": 5e-5}),
    ("mlp", "cpu"): Preset(
        type="chunked_mlp",
        batch_size=512,
        steps=8_000,
        options={**CHUNK, "optimizer_lr": 1e-3},
        cosine=True,
        bfloat16={"dtype": "bfloat16"},  # in training only
    ),
    ("act", "paper"): Preset(
        type="act",
        batch_size=2048,
        steps=10_000,
        options={
            **CHUNK,
            **_MEAN_STD,
            "n_encoder_layers": 2,
            "n_vae_encoder_layers": 2,  # the original ACT builds both encoders with as many layers
            "n_decoder_layers": 3,
            "n_heads": 8,
            "dim_model": 512,
            "dim_feedforward": 3200,
            "latent_dim": 32,
            "kl_weight": 10.0,
            "optimizer_lr": 5e-5,
        },
    ),
    ("act", "cpu"): Preset(
        type="act",
        batch_size=128,
        steps=8_000,
        options={
            **CHUNK,
            **_MEAN_STD,
            "n_encoder_layers": 2,
            "n_decoder_layers": 1,  # as in the original ACT, where the others are never used
            "n_heads": 4,
            "dim_model": 256,
            "dim_feedforward": 512,
            "use_vae": False,  # half the work, for a latent that is zero whenever the policy acts
            "dropout": 0.0,  # a quarter of the time on a CPU; the data do not run out
            "optimizer_lr": 1e-3,
        },
        cosine=True,
        bfloat16={"use_amp": True},
    ),
    ("diffusion", "paper"): Preset(
        type="diffusion",
        batch_size=4096,
        steps=10_000,
        options={
            **_MIN_MAX_STATE_ACTIONS,  # its samples are clipped to +-1
            **_TO_THE_END,
            "n_obs_steps": 1,
            "horizon": 24,  # the paper's 20; LeRobot wants a multiple of 2 ** len(down_dims)
            "n_action_steps": 10,
            "down_dims": (256, 512, 1024),
            "kernel_size": 5,
            "diffusion_step_embed_dim": 256,
            "num_train_timesteps": 100,
            "optimizer_lr": 5e-5,
        },
        cosine=True,
    ),
    ("diffusion", "cpu"): Preset(
        type="diffusion",
        batch_size=128,
        steps=8_000,
        options={
            **_MIN_MAX_STATE,
            **_TO_THE_END,
            "n_obs_steps": 1,
            "horizon": 16,  # the 10 that are carried out, and what they need to be a multiple of 8
            "n_action_steps": 10,
            "down_dims": (128, 128, 128),
            "kernel_size": 3,
            "diffusion_step_embed_dim": 128,
            "prediction_type": "sample",  # noise asks for a longer training: docs/trials.md
            "clip_sample": False,  # actions go beyond +-1 deviation
            "noise_scheduler_type": "DDIM",
            "num_train_timesteps": 2,  # all are made to act: of a hundred, LeRobot's DDIM would begin below full noise
            "num_inference_steps": 2,
            "optimizer_lr": 1e-3,
        },
        cosine=True,
        bfloat16={"use_amp": True},
    ),
    ("mlp", "vision-cpu"): Preset(
        type="chunked_mlp",
        batch_size=64,
        steps=10_000,
        options={**CHUNK, "hidden_dims": [512, 512], "crop": 0.08, "optimizer_lr": 5e-4},
        cosine=True,
        sees=True,
    ),
    ("act", "vision-paper"): Preset(
        type="act",
        batch_size=64,
        steps=100_000,
        options={
            **CHUNK,
            "normalization_mapping": {"STATE": "MEAN_STD", "VISUAL": "MEAN_STD", "ACTION": "MEAN_STD"},
            "pretrained_backbone_weights": None,  # nothing is downloaded
            "optimizer_lr": 5e-5,
        },
        sees=True,
    ),
    ("diffusion", "vision-paper"): Preset(
        type="diffusion",
        batch_size=64,
        steps=100_000,
        options={
            "normalization_mapping": {"STATE": "MIN_MAX", "VISUAL": "MEAN_STD", "ACTION": "MIN_MAX"},
            **_TO_THE_END,
            "n_obs_steps": 1,
            "horizon": 24,
            "n_action_steps": 10,
            "down_dims": (256, 512, 1024),
            "pretrained_backbone_weights": None,  # nothing is downloaded; group norms instead
            "use_group_norm": True,
            "optimizer_lr": 1e-4,
        },
        cosine=True,
        sees=True,
    ),
}
POLICIES = tuple(dict.fromkeys(policy for policy, _ in PRESETS))
NAMES = tuple(dict.fromkeys(name for _, name in PRESETS))


def get_preset(policy: str, name: str) -> Preset:
    """Return a preset.

    Args:
        policy: "mlp", "act" or "diffusion".
        name: One of ``NAMES``.

    Raises:
        UnknownNameError: No such policy or preset, or the policy has no such preset.
    """
    for kind, got, known in (("policy", policy, POLICIES), ("preset", name, NAMES)):
        if got not in known:
            raise UnknownNameError(kind, got, known)
    if (policy, name) not in PRESETS:
        raise UnknownNameError(f"preset of {policy}", name, [preset for kind, preset in PRESETS if kind == policy])
    return PRESETS[policy, name]


def input_features(dataset_root: Path, sees: bool) -> "dict[str, PolicyFeature] | None":
    """Return what a policy is given of a dataset; None for all there is, as of a dataset without pictures.

    Args:
        dataset_root: The dataset.
        sees: Whether it is given colour pictures and the robot's state, or poses and the robot's state.

    Raises:
        PolicyError: It is to see, and there are no colour pictures.
        DatasetError: The dataset is damaged.
    """
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

    table = read_info(dataset_root)["features"] if (dataset_root / INFO_PATH).exists() else {}
    pictures = {key: entry for key, entry in table.items() if entry["dtype"] == "video"}
    if not pictures and not sees:
        return None
    colour = {key: entry for key, entry in pictures.items() if not entry["info"]["is_depth_map"]}
    if sees and not colour:
        raise PolicyError(
            f"{dataset_root} without colour pictures",
            "a dataset with pictures",
            "demohlm generate --cameras head:96x96:rgb",
        )
    chosen = {OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=tuple(table[OBS_STATE]["shape"]))}
    if not sees:
        chosen[OBS_ENV_STATE] = PolicyFeature(type=FeatureType.ENV, shape=tuple(table[OBS_ENV_STATE]["shape"]))
        return chosen
    for key, entry in colour.items():
        height, width, channels = entry["shape"]
        chosen[key] = PolicyFeature(type=FeatureType.VISUAL, shape=(channels, height, width))
    return chosen


def policy_config(preset: Preset, steps: int, device: str = "cpu") -> "PreTrainedConfig":
    """Return the configuration of a preset's policy.

    Args:
        preset: Which.
        steps: Training steps, of which a twentieth warms up.
        device: Where it is trained, such as "cpu" or "cuda".
    """
    from lerobot.configs import NormalizationMode
    from lerobot.policies.factory import make_policy_config

    import lerobot_demohlm

    lerobot_demohlm.register()
    quick = preset.bfloat16 if device == "cpu" and has_bfloat16() else {}
    options = {**quick, **preset.options}
    if "normalization_mapping" in options:
        modes = options["normalization_mapping"].items()
        options["normalization_mapping"] = {key: NormalizationMode[mode] for key, mode in modes}
    if preset.cosine and preset.type != "act":  # ACT's configuration knows no schedule
        options["scheduler_warmup_steps"] = warmup_steps(steps)
    config = make_policy_config(preset.type, device=device, push_to_hub=False, **options)
    config.device = device  # LeRobot names another one where this machine has none such; the training may be elsewhere
    return config


def has_bfloat16() -> bool:
    """Tell whether this processor multiplies matrices of bfloat16 by instructions of their own."""
    import torch

    return any(torch.cpu.get_capabilities().get(name, False) for name in ("avx512_bf16", "amx_bf16"))


def warmup_steps(steps: int) -> int:
    """Return how many of the steps the learning rate rises."""
    return max(1, steps // 20)


def train_config(
    dataset_root: Path,
    output: Path,
    policy: str = "mlp",
    preset: str = "cpu",
    *,
    steps: int | None = None,
    seed: int = 0,
    num_episodes: int | None = None,
    device: str = "cpu",
    batch_size: int | None = None,
    options: Mapping[str, Any] | None = None,
) -> "TrainPipelineConfig":
    """Return what ``lerobot-train`` is to be given.

    Args:
        dataset_root: The dataset; with pictures for the presets that see.
        output: Directory of the training.
        policy: "mlp", "act" or "diffusion".
        preset: One of ``NAMES``.
        steps: Training steps; the preset's by default.
        seed: Of the weights and of the order of the samples.
        num_episodes: Train on so many episodes from the first on; on all by default.
        device: Where it is trained.
        batch_size: Samples a step; the preset's by default.
        options: Fields of the policy's configuration that replace the preset's.

    Raises:
        UnknownNameError: No such policy or preset.
        PolicyError: Fewer than one step or episode, or a seed out of range.
        DatasetError: The dataset is damaged.
    """
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

    chosen = get_preset(policy, preset)
    chosen = replace(chosen, options={**chosen.options, **(options or {})})
    steps = chosen.steps if steps is None else steps
    if steps < 1 or (num_episodes is not None and num_episodes < 1):
        raise PolicyError(f"steps={steps}, num_episodes={num_episodes}", "1 or more", "correct them")
    if not 0 <= seed < 2**32:
        raise PolicyError(f"seed={seed}", "0 to 4294967295", "correct --seed")
    config = policy_config(chosen, steps, device)
    given = input_features(dataset_root, chosen.sees)
    if given is not None:
        config.input_features = given
    own_schedule = chosen.cosine and chosen.type == "act"
    return TrainPipelineConfig(
        dataset=DatasetConfig(
            repo_id=f"local/{dataset_root.name}",
            root=str(dataset_root),
            episodes=None if num_episodes is None else list(range(num_episodes)),
        ),
        policy=config,
        output_dir=output,
        steps=steps,
        batch_size=chosen.batch_size if batch_size is None else batch_size,
        num_workers=0,  # a batch from memory is made sooner than handed over by another process
        save_freq=0,  # the last checkpoint only
        env_eval_freq=0,
        seed=seed,
        use_policy_training_preset=not own_schedule,
        optimizer=config.get_optimizer_preset() if own_schedule else None,
        scheduler=CosineAnnealingWithWarmupSchedulerConfig(warmup_steps(steps)) if own_schedule else None,
    )
