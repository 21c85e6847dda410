"""Vision-language models of a few thousand weights with their tokenizers, made on the spot: nothing is downloaded.

A policy that reads its tokenizer by a fixed name on the hub finds it in a folder of that name under the working folder.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

WORDS = "[UNK] [PAD] <bos> <eos> <image> <fake_token_around_image> <global-img> <end_of_utterance>".split()
PICTURE, PATCH = 32, 16  # px
PALIGEMMA, COSMOS = Path("google/paligemma-3b-pt-224"), Path("nvidia/Cosmos-Reason2-2B")
"""Where pi0 and GR00T look for their tokenizers."""
QWEN_WORDS = ("[UNK]", "[PAD]", "<|vision_start|>", "<|image_pad|>", "<|video_pad|>", "<|vision_end|>")
_QWEN_TEMPLATE = (
    "{% for message in messages %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part['text'] }}{% endif %}"
    "{% endfor %}{% endfor %}"
)


def tokenizer(words: Sequence[str], **options: Any) -> Any:
    """Return a tokenizer that knows some words and takes all others for one unknown word."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    plain = Tokenizer(models.WordLevel({word: index for index, word in enumerate(words)}, unk_token="[UNK]"))
    plain.pre_tokenizer = pre_tokenizers.Whitespace()  # pyright: ignore[reportAttributeAccessIssue]
    return PreTrainedTokenizerFast(tokenizer_object=plain, unk_token="[UNK]", pad_token="[PAD]", **options)


def write_smolvlm(folder: Path) -> Path:
    """Write configuration and processor as those of SmolVLM2, without weights; returns the folder."""
    from transformers import (
        LlamaConfig,
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
        SmolVLMVisionConfig,
    )

    named = {
        "image_token": "<image>", "fake_image_token": "<fake_token_around_image>",
        "global_image_token": "<global-img>", "end_of_utterance_token": "<end_of_utterance>",
    }  # fmt: skip
    words = tokenizer(WORDS, bos_token="<bos>", eos_token="<eos>", extra_special_tokens=named)
    text = LlamaConfig(
        vocab_size=len(WORDS), hidden_size=64, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2,
        num_key_value_heads=1, head_dim=32, pad_token_id=1, bos_token_id=2, eos_token_id=3,
    )  # fmt: skip
    seen = SmolVLMVisionConfig(
        hidden_size=32, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2, image_size=PICTURE,
        patch_size=PATCH,
    )  # fmt: skip
    SmolVLMConfig(
        text_config=text.to_dict(), vision_config=seen.to_dict(), image_token_id=4, scale_factor=2, pad_token_id=1
    ).save_pretrained(folder)
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(), tokenizer=words, video_processor=SmolVLMVideoProcessor(),
        chat_template="{{ messages }}",
    ).save_pretrained(folder)  # fmt: skip
    return folder


def write_paligemma_tokenizer(folder: Path) -> None:
    """Write the tokenizer that pi0 reads, under the working folder."""
    tokenizer(WORDS, bos_token="<bos>", eos_token="<eos>").save_pretrained(folder / PALIGEMMA)


def small_paligemma(whole: Any) -> Any:
    """Return what builds a PaliGemma as LeRobot's class does, with a small eye.

    Args:
        whole: LeRobot's class, whose text part is as large as its configuration says.
    """

    def build(config: Any) -> Any:
        eye = config.vision_config
        eye.hidden_size, eye.intermediate_size, eye.num_hidden_layers, eye.num_attention_heads = 32, 64, 1, 2
        eye.patch_size, eye.projection_dim = PATCH, config.text_config.hidden_size
        return whole(config=config)

    return build


def write_groot(folder: Path) -> Path:
    """Write a GR00T N1.7 with random weights and, under the working folder, its tokenizer; returns its folder."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config
    from transformers import Qwen2VLImageProcessor, Qwen3VLConfig, Qwen3VLVideoProcessor

    words = tokenizer(QWEN_WORDS, extra_special_tokens={"image_token": "<|image_pad|>", "video_token": "<|video_pad|>"})
    words.chat_template = _QWEN_TEMPLATE
    sizes = {"patch_size": PATCH, "temporal_patch_size": 2, "merge_size": 2}
    for part in (words, Qwen2VLImageProcessor(**sizes), Qwen3VLVideoProcessor(**sizes)):
        part.save_pretrained(folder / COSMOS)
    text = {
        "vocab_size": len(QWEN_WORDS), "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 16, "pad_token_id": 1,
        "rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [4, 2, 2]},
    }  # fmt: skip
    eye = {
        "depth": 1, "hidden_size": 32, "intermediate_size": 32, "num_heads": 2, "patch_size": PATCH,
        "out_hidden_size": 32, "deepstack_visual_indexes": [0], "num_position_embeddings": 16,
    }  # fmt: skip
    Qwen3VLConfig(
        text_config=text, vision_config=eye, image_token_id=3, video_token_id=4, vision_start_token_id=2,
        vision_end_token_id=5,
    ).save_pretrained(folder / "qwen")  # fmt: skip
    heads = {"num_layers": 2, "num_attention_heads": 2, "attention_head_dim": 16, "positional_embeddings": None}
    model = GR00TN17(
        GR00TN17Config(
            model_name=str(folder / "qwen"), backbone_embedding_dim=32, select_layer=2, hidden_size=32,
            input_embedding_dim=32, max_num_embodiments=32, action_horizon=40,
            diffusion_model_cfg={**heads, "norm_type": "ada_norm", "output_dim": 32, "interleave_self_attention": True},
            vl_self_attention_cfg={**heads, "num_layers": 1},
        ),
        load_backbone_weights=False,
    )  # fmt: skip
    model.save_pretrained(folder / "groot")
    return folder / "groot"
