"""A camera's picture -> a few numbers: four convolutions, and where in the picture each of their channels responds."""

import torch
from torch import Tensor, nn

from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig

_GROUPS = 8  # of a group normalisation, which does not depend on the other samples


class PictureEncoder(nn.Module):
    """Maps pictures (B, channels, height, width) to (B, cnn_features).

    A spatial softmax gives each channel's expected place, which tells a policy where things are (Finn et al., "Deep
    spatial autoencoders for visuomotor learning", ICRA 2016).

    Args:
        channels: Of the picture: 3, or 1 of a depth map.
        config: ``cnn_channels`` and ``cnn_features`` are read.
    """

    def __init__(self, channels: int, config: ChunkedMLPConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for index, width in enumerate(config.cnn_channels):
            size = 5 if index == 0 else 3
            groups = _GROUPS if width % _GROUPS == 0 else 1
            layers += [nn.Conv2d(channels, width, size, stride=2, padding=size // 2), nn.GroupNorm(groups, width)]
            layers.append(nn.ReLU())
            channels = width
        self.convolutions = nn.Sequential(*layers)
        self.out = nn.Linear(3 * channels, config.cnn_features)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the numbers that pictures become."""
        maps = self.convolutions(pictures)  # (B, C, h, w)
        height, width = maps.shape[-2:]
        shares = maps.flatten(2).softmax(dim=-1)  # (B, C, h w)
        rows = torch.linspace(-1.0, 1.0, height, device=maps.device, dtype=maps.dtype).repeat_interleave(width)
        columns = torch.linspace(-1.0, 1.0, width, device=maps.device, dtype=maps.dtype).repeat(height)
        places = torch.cat([shares @ rows, shares @ columns, maps.amax(dim=(2, 3))], dim=-1)
        return torch.relu(self.out(places))


def cropped(pictures: Tensor, share: float, at_random: bool) -> Tensor:
    """Return pictures (B, C, h, w) without a share of each side, cut at one random place a batch or in the middle.

    Args:
        pictures: (B, C, height, width).
        share: Of a side that is cut off.
        at_random: Whether the place is drawn.
    """
    if share <= 0:
        return pictures
    height, width = pictures.shape[-2:]
    rows, columns = round(height * share), round(width * share)
    top, left = rows // 2, columns // 2
    if at_random:
        top, left = (int(torch.randint(0, size + 1, (1,))) for size in (rows, columns))
    return pictures[..., top : top + height - rows, left : left + width - columns]
