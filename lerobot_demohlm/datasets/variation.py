"""How a generation run varies its data: one value for each knob, checked, and the same names on disk."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from gym_demohlm.errors import DatasetError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.variation import get_variation


def _knob(default: float | str, *, plain: float | str) -> Any:  # noqa: ANN401
    """Return a field whose least value is ``plain``, at which it changes nothing; older runs, without it, had that."""
    return field(default=default, metadata={"plain": plain})


@dataclass(frozen=True, kw_only=True)
class DataVariation:
    """How attempts differ from plain ones, which walk to the demonstrated place and execute every command as planned.

    The defaults are those of ``demohlm generate``. Facts and results keep the knobs flat, by the names of the fields.

    Attributes:
        retries: Most times that an attempt may begin again after it has missed its walk's goal, its reach or its grip;
            each try has the task's whole time limit. In worlds that vary it may do so twice in any case.
        command_noise: Scale of the noise that commands carry when they are executed; datasets record them without it.
        start_spread: Factor by which the region's ranges of the robot's pose are widened.
        stance_spread: Scale of the offset, up to 5 cm and 5 degrees, of the place from which the robot acts.
        variation: How worlds differ: none, real or hard, with a strength and groups as in "real@0.5:objects+pushes".
            A name by which nothing differs, as "real@0", becomes none.
        perception: How observations and the neck see objects: exact, model, rgbd or apriltag, with options as
            "rgbd,masks=color" has. What plans the motion sees exactly. Where the variation has the group perception,
            exact has the errors that episodes draw.

    Raises:
        UnknownNameError: There is no such variation or perception.
        SceneError: An option of the perception is out of range.
        DatasetError: A knob is below its plain value, not finite, or not whole where it counts something; or what is
            seen depends on a server, so that no episode could be repeated.
    """

    retries: int = _knob(0, plain=0)
    command_noise: float = _knob(1.0, plain=0.0)
    start_spread: float = _knob(1.0, plain=1.0)
    stance_spread: float = _knob(0.0, plain=0.0)
    variation: str = _knob("none", plain="none")
    perception: str = _knob("exact", plain="exact")

    def __post_init__(self) -> None:
        """Check the knobs, and name a variation that varies nothing as the plain one."""
        object.__setattr__(self, "variation", get_variation(self.variation).name)
        if PerceptionSettings.read(self.perception).source == "remote":
            raise DatasetError("generation with perception remote", "eyes that see the same again", "choose rgbd")
        for knob in fields(self):
            value, plain = getattr(self, knob.name), knob.metadata["plain"]
            if isinstance(plain, str):
                continue
            if not plain <= value < math.inf or (isinstance(plain, int) and value != int(value)):
                kind = "a whole number of " if isinstance(plain, int) else ""
                raise DatasetError(
                    f"{knob.name}={value}", f"{kind}{plain:g} or more", f"correct --{knob.name.replace('_', '-')}"
                )

    @classmethod
    def read(cls, facts: Mapping[str, Any]) -> "DataVariation":
        """Return the variation that facts or a line of results hold; a knob that they lack was not there: plain."""
        return cls(**{knob.name: facts.get(knob.name, knob.metadata["plain"]) for knob in fields(cls)})

    def content(self) -> dict[str, Any]:
        """Return the knobs as facts and results keep them; those of plain worlds name no variation or perception."""
        plain = {knob.name: knob.metadata["plain"] for knob in fields(self)}
        named = asdict(self)
        return {name: each for name, each in named.items() if not isinstance(each, str) or each != plain[name]}


PLAIN = DataVariation.read({})
"""Nothing varied: one try, no noise, the region's own starts, the demonstrated stance. Tables count such attempts."""
