"""A vision-language model of a few thousand weights with its tokenizer, made on the spot: nothing is downloaded."""

from pathlib import Path

WORDS = "[UNK] [PAD] <bos> <eos> <image> <fake_token_around_image> <global-img> <end_of_utterance>".split()
PICTURE, PATCH = 32, 16  # px


def write_smolvlm(folder: Path) -> Path:
    """Write configuration and processor as those of SmolVLM2, without weights; returns the folder."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import (
        LlamaConfig,
        PreTrainedTokenizerFast,
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
        SmolVLMVisionConfig,
    )

    plain = Tokenizer(models.WordLevel({word: index for index, word in enumerate(WORDS)}, unk_token="[UNK]"))
    plain.pre_tokenizer = pre_tokenizers.Whitespace()  # pyright: ignore[reportAttributeAccessIssue]
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=plain, unk_token="[UNK]", pad_token="[PAD]", bos_token="<bos>", eos_token="<eos>",
        extra_special_tokens={
            "image_token": "<image>", "fake_image_token": "<fake_token_around_image>",
            "global_image_token": "<global-img>", "end_of_utterance_token": "<end_of_utterance>",
        },
    )  # fmt: skip
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
        image_processor=SmolVLMImageProcessor(), tokenizer=tokenizer, video_processor=SmolVLMVideoProcessor(),
        chat_template="{{ messages }}",
    ).save_pretrained(folder)  # fmt: skip
    return folder
