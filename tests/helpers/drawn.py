"""A small dataset with pictures that nothing had to be simulated for."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.cameras import STREAMS, CameraSpec
from lerobot_demohlm.datasets.pictures import DrawnBlock, DrawnEpisode, features_of
from lerobot_demohlm.datasets.writer import write_dataset
from tests.helpers.synthetic import make_episode


def write_drawn(root: Path, num_episodes: int = 2, size: int = 64, streams: tuple[str, ...] = STREAMS) -> Path:
    """Write episodes with random states and pictures; returns the root."""
    camera = CameraSpec(name="head", width=size, height=size, streams=streams)
    episodes = [make_episode(index) for index in range(num_episodes)]
    rng, drawn, start = np.random.default_rng(0), [], 0
    files = {camera.key(stream): root.with_name(f"{stream}.mp4") for stream in camera.streams}
    with ExitStack() as open_files:
        writers = {
            stream: open_files.enter_context(
                videos.VideoWriter(files[camera.key(stream)], size, size, depth=stream == "depth")
            )
            for stream in camera.streams
        }
        for episode in episodes:
            length = len(episode.success)
            for step in range(length):
                pictures = {
                    "rgb": rng.integers(0, 255, (size, size, 3), dtype=np.uint8),
                    "depth": rng.uniform(0.2, 3.0, (size, size)).astype(np.float32),
                }
                for stream, writer in writers.items():
                    writer.add(pictures[stream], key=step == 0)
            stats = {}
            for stream, channels, mean in (("rgb", 3, 0.5), ("depth", 1, 1.6)):
                if stream in writers:
                    row = np.full((channels, 1, 1), mean)
                    names = ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99")
                    stats[camera.key(stream)] = {name: row.copy() for name in names} | {"count": np.array([length])}
            pose = np.tile(np.array([0, 0, 1.2, 1, 0, 0, 0], np.float32), (length, 1))
            drawn.append(DrawnEpisode(columns={camera.pose_key: pose}, stats=stats, start=start))
            start += length
    table = features_of([camera], {"head": {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 31.5}})
    write_dataset(root, "local/drawn", episodes, drawn=DrawnBlock(features=table, episodes=drawn, files=files))
    return root
