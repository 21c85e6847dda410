"""``head:96x96:rgb,depth`` <-> what a generation draws of each episode; without torch or lerobot."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gym_demohlm.errors import DatasetError, UnknownNameError

CAMERAS = ("head", "overview")
STREAMS = ("rgb", "depth")
LARGEST = (640, 480)  # px, the scene's image buffer
SMALLEST = 16  # px
_PATTERN = re.compile(r"([a-z]+):(\d+)x(\d+):([a-z,]+)")


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """One camera of a dataset.

    Attributes:
        name: One of ``CAMERAS``.
        width: [px], even, as videos need.
        height: [px], even.
        streams: Of ``STREAMS``, in that order.

    Raises:
        UnknownNameError: No such camera or stream.
        DatasetError: The size is odd, or too small or large.
    """

    name: str
    width: int
    height: int
    streams: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check names and size."""
        if self.name not in CAMERAS:
            raise UnknownNameError("camera", self.name, CAMERAS)
        for stream in self.streams:
            if stream not in STREAMS:
                raise UnknownNameError("stream", stream, STREAMS)
        fits = all(SMALLEST <= size <= limit for size, limit in zip((self.width, self.height), LARGEST, strict=True))
        if not fits or self.width % 2 or self.height % 2 or not self.streams:
            raise DatasetError(
                f"a camera of {self.width}x{self.height} px with streams {','.join(self.streams)}",
                f"even sizes of {SMALLEST} to {LARGEST[0]}x{LARGEST[1]}, and a stream",
                "correct --cameras",
            )

    @classmethod
    def read(cls, text: str) -> "CameraSpec":
        """Return the camera that a text stands for.

        Raises:
            DatasetError: The text is not of the form ``head:96x96:rgb,depth``.
        """
        found = _PATTERN.fullmatch(text)
        if found is None:
            raise DatasetError(f"a camera {text!r}", "NAME:WIDTHxHEIGHT:rgb or :rgb,depth", "write head:96x96:rgb")
        name, width, height, streams = found.groups()
        given = streams.split(",")
        unknown = [stream for stream in given if stream not in STREAMS]
        ordered = tuple(stream for stream in STREAMS if stream in given)
        return cls(name=name, width=int(width), height=int(height), streams=(*ordered, *unknown))

    def __str__(self) -> str:
        """Return the text that ``read`` turns into this camera."""
        return f"{self.name}:{self.width}x{self.height}:{','.join(self.streams)}"

    def key(self, stream: str) -> str:
        """Return the name of a stream's feature."""
        return f"observation.images.{self.name}" + ("_depth" if stream == "depth" else "")

    @property
    def pose_key(self) -> str:
        """Name of the feature with the camera's pose in each frame; policies do not take it for an observation."""
        return f"camera.{self.name}"


@dataclass(frozen=True, kw_only=True)
class PictureFacts:
    """What the pictures of a run are a function of, beside its states.

    Attributes:
        cameras: What is drawn; nothing by default.
        light: By how much each episode's lights differ in brightness, colour and place; 0 for not at all, 1 for much.
        texture: The same for the colours of floor, furniture and robot, not of the tracked objects.
        camera_shift: The same for the head camera's place: 1 is 1 cm and 2 degrees.

    Raises:
        DatasetError: A number is below 0, or a camera is named twice.
    """

    cameras: tuple[CameraSpec, ...] = ()
    light: float = 0.0
    texture: float = 0.0
    camera_shift: float = 0.0

    def __post_init__(self) -> None:
        """Check numbers and names."""
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise DatasetError(f"cameras {', '.join(names)}", "each once", "give each camera one --cameras entry")
        for name in ("light", "texture", "camera_shift"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise DatasetError(f"{name}={getattr(self, name)}", "a number from 0 on", "correct it")
        if not self.cameras and max(self.light, self.texture, self.camera_shift) > 0:
            raise DatasetError("pictures that vary, and no camera", "a camera", "give --cameras head:96x96:rgb")

    @classmethod
    def of(cls, cameras: Sequence[str], light: float, texture: float, camera_shift: float) -> "PictureFacts":
        """Return the facts of the options of ``demohlm generate``."""
        read = tuple(CameraSpec.read(text) for text in cameras)
        return cls(cameras=read, light=light, texture=texture, camera_shift=camera_shift)

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> "PictureFacts":
        """Return what ``content`` gave; nothing is drawn in runs that say nothing of pictures."""
        kept = dict(content.get("pictures") or {})
        return cls.of(kept.pop("cameras", ()), **{"light": 0.0, "texture": 0.0, "camera_shift": 0.0, **kept})

    def content(self) -> dict[str, Any]:
        """Return the facts as JSON objects hold them; none where nothing is drawn."""
        if not self.cameras:
            return {}
        varied = {"light": self.light, "texture": self.texture, "camera_shift": self.camera_shift}
        return {"pictures": {"cameras": [str(camera) for camera in self.cameras], **varied}}


def is_video(feature: Mapping[str, Any]) -> bool:
    """Tell whether a feature of a dataset is a video."""
    return feature["dtype"] == "video"
