"""``rgbd,masks=color,camera_error=1`` <-> how objects are seen: a source of poses, and what is wrong with it.

The text is what ``gym.make(perception=...)``, ``--env.perception`` and a rollout's record hold.
"""

import math
from dataclasses import dataclass, fields

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.timing import STEP_DT

SOURCES = ("exact", "model", "rgbd", "apriltag", "remote")
MASKS = ("oracle", "color", "server")
SHIFT_OF_DEGREE = 0.005  # m by which a camera is shifted that is turned by a degree
FOCAL_OF_DEGREE = 0.005  # share by which its known focal length is off
_SOURCES_OF = {
    "camera_error": ("rgbd", "apriltag", "remote"),
    "mesh_scale": ("rgbd", "apriltag"),
    "address": ("remote",),
    "timeout_s": ("remote",),
    "fit": ("model",),
}
"""The sources that an option is for; those not named here are for all, but for ``masks``, whose value decides."""


@dataclass(frozen=True, kw_only=True)
class PerceptionSettings:
    """How observation and gaze see objects; by default exactly.

    Attributes:
        source: One of ``SOURCES``.
        masks: Which pixels are an object's, with "rgbd" and "remote": the renderer's ids with rough edges ("oracle"),
            the picture's colours ("color"), or left to the server ("server", with "remote" only).
        camera_error: Angle by which the camera is mounted otherwise than the robot knows [degrees]; with each degree go
            5 mm and 0.5 % of focal length. For the sources that draw.
        mesh_scale: Size of the known meshes, or tags, over that of the objects, with "rgbd" and "apriltag".
        bias_mm: Distance by which each object is told elsewhere, in a direction that an episode draws [mm]; with each
            millimetre goes a turn of 0.2 degrees.
        latency_s: Age of what is told [s], in steps of 0.1 s.
        dropout: Share of frames from which nothing is told.
        address: Of the pose server, with "remote".
        fit: File of the errors' model, with "model"; the packaged one of the task by default.
        timeout_s: Longest wait for the server's answer [s], with "remote".

    Raises:
        UnknownNameError: No such source or masks.
        SceneError: A number is out of range, or an option does not belong to the source.
    """

    source: str = "exact"
    masks: str = "oracle"
    camera_error: float = 0.0
    mesh_scale: float = 1.0
    bias_mm: float = 0.0
    latency_s: float = 0.0
    dropout: float = 0.0
    address: str = "tcp://127.0.0.1:5570"
    fit: str = ""
    timeout_s: float = 1.0

    def __post_init__(self) -> None:
        """Check names and numbers."""
        if self.source not in SOURCES:
            raise UnknownNameError("perception", self.source, SOURCES)
        if self.masks not in MASKS:
            raise UnknownNameError("masks", self.masks, MASKS)
        for name in ("camera_error", "bias_mm", "latency_s", "dropout"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise SceneError(f"{name}={getattr(self, name)}", "a number from 0 on", "correct it")
        if not 0.5 <= self.mesh_scale <= 2.0 or self.dropout > 1.0 or not 0.0 < self.timeout_s < math.inf:
            raise SceneError(
                f"mesh_scale={self.mesh_scale}, dropout={self.dropout}, timeout_s={self.timeout_s}",
                "a mesh scale of 0.5 to 2, a dropout of 0 to 1, a timeout above 0",
                "correct them",
            )
        if not math.isclose(self.latency_s, STEP_DT * round(self.latency_s / STEP_DT), abs_tol=1e-9):
            raise SceneError(f"latency_s={self.latency_s:g}", f"a multiple of {STEP_DT:g} s", "correct it")
        for entry in fields(self):
            value, sources = getattr(self, entry.name), _SOURCES_OF.get(entry.name, SOURCES)
            if value != entry.default and self.source not in sources:
                got = f"{entry.name}={_spelled(value)} with perception {self.source!r}"
                raise SceneError(got, f"it with {' or '.join(sources)}", "leave it out")
        allowed = {"rgbd": ("oracle", "color"), "remote": MASKS}.get(self.source, ("oracle",))
        if self.masks not in allowed:
            raise SceneError(f"masks {self.masks!r} with {self.source!r}", f"one of {', '.join(allowed)}", "choose it")

    @classmethod
    def read(cls, text: "str | PerceptionSettings") -> "PerceptionSettings":
        """Return the settings that a text stands for: a source, then ``name=value`` behind commas.

        Raises:
            UnknownNameError: No such source, or no such name.
            SceneError: A value is not a number.
        """
        if isinstance(text, PerceptionSettings):
            return text
        if not isinstance(text, str):
            raise UnknownNameError("perception", text, SOURCES)
        source, *rest = text.split(",")
        known = {entry.name: entry.type for entry in fields(cls) if entry.name != "source"}
        values: dict[str, str | float] = {}
        for item in rest:
            name, _, value = item.partition("=")
            if name not in known:
                raise UnknownNameError("option of perception", name, known)
            try:
                values[name] = value if known[name] in (str, "str") else float(value)
            except ValueError:
                raise SceneError(f"{item!r} in a perception", "a number", "write it as in camera_error=1") from None
        return cls(source=source, **values)  # pyright: ignore[reportArgumentType]

    def __str__(self) -> str:
        """Return the shortest text that ``read`` turns into these settings."""
        words = [self.source]
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name != "source" and value != entry.default:
                words.append(f"{entry.name}={_spelled(value)}")
        return ",".join(words)

    @property
    def is_exact(self) -> bool:
        """Whether nothing is wrong with what is seen."""
        return self == PerceptionSettings()

    @property
    def is_disturbed(self) -> bool:
        """Whether bias, latency or dropout are added to the source."""
        return max(self.bias_mm, self.latency_s, self.dropout) > 0.0


def _spelled(value: object) -> str:
    """Return a value in the fewest digits that read back as the same."""
    short = f"{value:g}" if isinstance(value, float) else str(value)
    return short if not isinstance(value, float) or float(short) == value else repr(value)
