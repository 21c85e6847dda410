"""Frames <-> LeRobot's video files: colour as H.264, depth as 12 bit HEVC, each a function of its frames alone.

One thread and no frames that look ahead: so a machine always makes the same bytes, and a file can be cut before any
key frame without encoding it again. The first frame of each episode is one, and at least every second of the others.
"""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np
from av.video.frame import PictureType

from gym_demohlm.errors import DatasetError
from gym_demohlm.timing import FPS

DEPTH_MIN, DEPTH_MAX = 0.1, 4.195
"""Depths [m] of the smallest and largest of 4096 codes: 1 mm a code. What is nearer, or was not measured, is the
smallest; what is farther, the largest."""
_CODES = 4095
_GOP = 2
_DEPTH_ENCODER = "lossless=1:bframes=0:pools=none:frame-threads=1:log-level=none:rc-lookahead=0:no-scenecut=1:ctu=16"
"""Small blocks and no look-ahead: two thirds of the time for files that are 1 % larger; decoded depths are the same."""
TOLERANCE = 12.0
"""Of 255: mean deviation of a colour frame from what was drawn, by compression; smooth frames show up to 4."""
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


def video_feature(width: int, height: int, depth: bool) -> dict[str, Any]:
    """Return the entry of a video in LeRobot's table of features.

    Args:
        width: [px].
        height: [px].
        depth: Whether it is a depth map.
    """
    info: dict[str, Any] = {
        "video.height": height,
        "video.width": width,
        "video.codec": "hevc" if depth else "h264",
        "video.pix_fmt": "gray12le" if depth else "yuv420p",
        "video.fps": FPS,
        "video.channels": 1 if depth else 3,
        "has_audio": False,
        "is_depth_map": depth,
    }
    if depth:
        limits = {"video.depth_min": DEPTH_MIN, "video.depth_max": DEPTH_MAX, "video.shift": 0.0}
        info |= {**limits, "video.use_log": False, "depth_unit": "m"}
    shape = (height, width, 1 if depth else 3)
    return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}


def depth_codes(depth: np.ndarray) -> np.ndarray:
    """Return the codes uint16 of depths [m] of any shape; a hole, which is 0, gets the smallest."""
    share = (depth.astype(np.float64) - DEPTH_MIN) / (DEPTH_MAX - DEPTH_MIN)
    return np.rint(np.clip(share, 0.0, 1.0) * _CODES).astype(np.uint16)


def depth_of_codes(codes: np.ndarray) -> np.ndarray:
    """Return the depths [m] float32 of codes, as LeRobot does: holes come back as the smallest depth."""
    return (DEPTH_MIN + codes.astype(np.float64) * ((DEPTH_MAX - DEPTH_MIN) / _CODES)).astype(np.float32)


class VideoWriter:
    """Writes one video, frame by frame.

    Args:
        path: The file; its folder is made.
        width: [px].
        height: [px].
        depth: Whether frames are depths.

    Attributes:
        num_frames: So far.
    """

    def __init__(self, path: Path, width: int, height: int, depth: bool) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.num_frames, self._depth = 0, depth
        self._file = av.open(str(path), "w")
        options = {"g": str(_GOP), "threads": "1", "bf": "0", "forced-idr": "1"}
        if depth:
            options["x265-params"] = _DEPTH_ENCODER
            options["preset"] = "ultrafast"
        else:
            options |= {"crf": "20", "preset": "veryfast"}
        self._stream: Any = self._file.add_stream("libx265" if depth else "libx264", FPS, options=options)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "gray12le" if depth else "yuv420p"

    def add(self, frame: np.ndarray, key: bool = False) -> None:
        """Append a frame.

        Args:
            frame: (height, width, 3) uint8, or (height, width) depths [m].
            key: Whether it must be a key frame, as the first of an episode: tools cut there.
        """
        picture = (
            av.VideoFrame.from_ndarray(depth_codes(frame), format="gray12le")
            if self._depth
            else av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        )
        picture.pts = self.num_frames
        if key:
            picture.pict_type = PictureType.I
        self._file.mux(self._stream.encode(picture))
        self.num_frames += 1

    def close(self) -> None:
        """Write what is still to come."""
        self._file.mux(self._stream.encode())
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_frames(path: Path, start: int = 0, count: int | None = None) -> Iterator[np.ndarray]:
    """Yield frames of a video: (height, width, 3) uint8, or (height, width) float32 depths [m].

    Args:
        path: The file.
        start: The first frame.
        count: How many; all that follow by default.

    Raises:
        DatasetError: The file cannot be decoded, or has fewer frames.
    """
    given = 0
    try:
        with av.open(str(path)) as file:
            stream = file.streams.video[0]
            stream.thread_count = 1
            depth = stream.codec_context.pix_fmt == "gray12le"
            if start:
                file.seek(round(start / FPS / float(stream.time_base or 1)), backward=True, stream=stream)
            for frame in file.decode(stream):
                index = round(float((frame.pts or 0) * (stream.time_base or 0)) * FPS)
                if index < start:
                    continue
                if count is not None and given == count:
                    return
                given += 1
                yield depth_of_codes(frame.to_ndarray(format="gray12le")) if depth else frame.to_ndarray(format="rgb24")
    except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
        raise _damaged(path, str(error)) from error
    if count is not None and given < count:
        raise _damaged(path, f"{given} frames from {start} on instead of {count}")


def cut(source: Path, target: Path, num_frames: int) -> None:
    """Write the first frames of a video to another file, without encoding them again.

    Raises:
        DatasetError: The file cannot be read.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with av.open(str(source)) as read, av.open(str(target), "w") as written:
            stream = read.streams.video[0]
            copied = written.add_stream_from_template(stream)
            for packet in read.demux(stream):
                if packet.pts is not None and round(float(packet.pts * (packet.time_base or 0)) * FPS) < num_frames:
                    packet.stream = copied
                    written.mux(packet)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise _damaged(source, str(error)) from error


def sampled(frames: np.ndarray) -> np.ndarray:
    """Return those of some frames (n, channels, height, width) of which statistics are made: 32 to 63, or all."""
    chosen = frames[:: max(1, len(frames) // 32)]
    return chosen[:, None] if chosen.ndim == 3 else chosen.transpose(0, 3, 1, 2)


def _damaged(path: Path, what: str) -> DatasetError:
    return DatasetError(f"the video {path}, damaged ({what})", "the file as written", "generate the dataset again")
