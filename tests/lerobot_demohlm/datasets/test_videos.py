"""Videos: depth there and back, cut without encoding again, damaged; names of cameras."""

from pathlib import Path

import av
import numpy as np
import pytest
from lerobot.configs.video import DepthEncoderConfig, encoder_config_from_video_info
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.datasets.video_utils import decode_video_frames, decode_video_frames_pyav

from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.timing import FPS
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.cameras import CameraSpec, PictureFacts

SIZE = 64, 48  # px


def _depth(rng: np.random.Generator) -> np.ndarray:
    depth = rng.uniform(0.15, 4.1, SIZE[::-1]).astype(np.float32)
    depth[rng.random(depth.shape) < 0.05] = 0.0  # holes
    depth[0, :5] = 6.0  # beyond the largest
    return depth


def _color(index: int) -> np.ndarray:
    """Return a smooth picture that tells its index."""
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.stack([rows * 3 + index * 9, columns * 2, np.full(rows.shape, 90)], axis=-1).astype(np.uint8)


def _write(path: Path, frames: list[np.ndarray]) -> Path:
    with videos.VideoWriter(path, *SIZE, depth=frames[0].ndim == 2) as writer:
        for frame in frames:
            writer.add(frame)
    return path


def test_depth_comes_back_within_half_a_millimetre_also_through_lerobot(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [_depth(rng) for _ in range(7)]
    path = _write(tmp_path / "depth.mp4", frames)
    config = encoder_config_from_video_info(videos.video_feature(*SIZE, depth=True)["info"])
    assert isinstance(config, DepthEncoderConfig)
    stamps = [index / FPS for index in range(7)]
    codes = decode_video_frames_pyav(path, stamps, 1e-3, is_depth=True)
    read = dequantize_depth(codes, config.depth_min, config.depth_max, config.shift, config.use_log, output_unit="m")
    for theirs, ours, frame in zip(np.asarray(read), videos.read_frames(path), frames, strict=True):
        measured = (frame > 0) & (frame < videos.DEPTH_MAX)
        assert np.abs(theirs[0] - frame)[measured].max() <= 0.00051
        np.testing.assert_allclose(ours, theirs[0], atol=1e-6)
        assert (ours[frame == 0] == np.float32(videos.DEPTH_MIN)).all()  # a hole is the smallest depth
        np.testing.assert_allclose(ours[0, :5], videos.DEPTH_MAX)


def test_colour_comes_back_nearly_and_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    frames = [_color(index) for index in range(9)]
    first, again = (_write(tmp_path / name, frames).read_bytes() for name in ("a.mp4", "b.mp4"))
    assert first == again
    read = list(videos.read_frames(tmp_path / "a.mp4"))
    assert len(read) == 9
    for mine, frame in zip(read, frames, strict=True):
        assert np.abs(mine.astype(int) - frame).mean() < 4.0
    (theirs,) = decode_video_frames(tmp_path / "a.mp4", [5 / FPS], 1e-3, "pyav", return_uint8=True)
    assert np.abs(theirs.permute(1, 2, 0).numpy().astype(int) - read[5]).max() <= 2


def test_any_frame_can_be_read_alone(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mp4", [_color(index) for index in range(10)])
    everything = list(videos.read_frames(path))
    for start in (0, 3, 8):
        np.testing.assert_array_equal(list(videos.read_frames(path, start, 2)), everything[start : start + 2])
    with pytest.raises(DatasetError, match="frames from 9"):
        list(videos.read_frames(path, 9, 2))


@pytest.mark.parametrize("kept", [1, 4, 5])
def test_a_video_is_cut_without_another_loss(tmp_path: Path, kept: int) -> None:
    for name, frames in (
        ("rgb", [_color(index) for index in range(8)]),
        ("depth", [_depth(np.random.default_rng(index)) for index in range(8)]),
    ):
        source = _write(tmp_path / f"{name}.mp4", frames)
        videos.cut(source, tmp_path / "cut" / f"{name}.mp4", kept)
        cut = list(videos.read_frames(tmp_path / "cut" / f"{name}.mp4"))
        assert len(cut) == kept
        for mine, expected in zip(cut, videos.read_frames(source), strict=False):
            np.testing.assert_array_equal(mine, expected)


def test_an_episode_begins_with_a_key_frame_also_after_one_of_odd_length(tmp_path: Path) -> None:
    for name, frames in (("rgb", [_color(i) for i in range(9)]), ("depth", [_depth(np.random.default_rng(0))] * 9)):
        with videos.VideoWriter(tmp_path / f"{name}.mp4", *SIZE, depth=name == "depth") as writer:
            for index, frame in enumerate(frames):
                writer.add(frame, key=index in (0, 5))
        with av.open(str(tmp_path / f"{name}.mp4")) as file:
            packets = [packet for packet in file.demux(video=0) if packet.pts is not None]
            keys = [round(float(packet.pts * packet.time_base) * FPS) for packet in packets if packet.is_keyframe]
        assert {0, 5} <= set(keys) and max(np.diff(keys)) <= 2
        assert len(list(videos.read_frames(tmp_path / f"{name}.mp4"))) == 9


def test_a_damaged_video_is_an_error(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mp4", [_color(index) for index in range(10)])
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match="damaged"):
        list(videos.read_frames(path, 0, 10))


def test_names_of_cameras_are_read_and_written_back() -> None:
    camera = CameraSpec.read("head:128x96:depth,rgb")
    assert camera.streams == ("rgb", "depth") and str(camera) == "head:128x96:rgb,depth"
    assert camera.key("depth") == "observation.images.head_depth"
    facts = PictureFacts.of(["head:96x96:rgb", "overview:64x64:rgb"], light=0.5, texture=0.0, camera_shift=1.0)
    assert PictureFacts.read(facts.content()) == facts
    assert PictureFacts().content() == {} and PictureFacts.read({}) == PictureFacts()


@pytest.mark.parametrize("text", ["head", "head:97x96:rgb", "head:8x8:rgb", "head:1280x720:rgb", "head:96x96:"])
def test_a_camera_that_cannot_be_is_an_error(text: str) -> None:
    with pytest.raises(DatasetError):
        CameraSpec.read(text)


@pytest.mark.parametrize(("text", "near"), [("haed:96x96:rgb", "head"), ("head:96x96:rgb,dept", "depth")])
def test_an_unknown_camera_or_stream_names_the_nearest(text: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=near):
        CameraSpec.read(text)
