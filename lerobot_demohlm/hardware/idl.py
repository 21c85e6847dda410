"""The types of ``unitree_hg`` and of the robot's services, as DDS must know them to match topics.

LowCmd and LowState carry their bytes in ``content``: ``layout`` packs and reads them, and cyclonedds' own serializer is
not asked. The type descriptions are what it takes for the robot to accept our topics as its own.
"""
# pyright: reportInvalidTypeForm=false, reportIncompatibleMethodOverride=false, reportPrivateImportUsage=false

from dataclasses import dataclass

from cyclonedds import idl
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl import types


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MotorCmd_(idl.IdlStruct, typename="unitree_hg.msg.dds_.MotorCmd_"):  # noqa: N801
    """A command to one motor."""

    mode: types.uint8
    q: types.float32
    dq: types.float32
    tau: types.float32
    kp: types.float32
    kd: types.float32
    reserve: types.uint32


def _carried[T](kind: type[T]) -> type[T]:
    """Have messages of a type carry bytes in ``content``; a base class would be inheritance of DDS types."""

    def carrying(content: bytes) -> T:
        made = object.__new__(kind)
        made.content = content  # pyright: ignore[reportAttributeAccessIssue]
        return made

    setattr(kind, "carrying", staticmethod(carrying))  # noqa: B010
    setattr(kind, "serialize", lambda self, *_, **__: self.content)  # noqa: B010
    setattr(kind, "deserialize", staticmethod(lambda data, *_, **__: carrying(bytes(data))))  # noqa: B010
    return kind


@_carried
@dataclass
@annotate.final
@annotate.autoid("sequential")
class LowCmd_(idl.IdlStruct, typename="unitree_hg.msg.dds_.LowCmd_"):  # noqa: N801
    """A command to all motors, see ``layout.LowCmd``."""

    mode_pr: types.uint8
    mode_machine: types.uint8
    motor_cmd: types.array[MotorCmd_, 35]
    reserve: types.array[types.uint32, 4]
    crc: types.uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MotorState_(idl.IdlStruct, typename="unitree_hg.msg.dds_.MotorState_"):  # noqa: N801
    """What one motor says."""

    mode: types.uint8
    q: types.float32
    dq: types.float32
    ddq: types.float32
    tau_est: types.float32
    temperature: types.array[types.int16, 2]
    vol: types.float32
    sensor: types.array[types.uint32, 2]
    motorstate: types.uint32
    reserve: types.array[types.uint32, 4]


@dataclass
@annotate.final
@annotate.autoid("sequential")
class IMUState_(idl.IdlStruct, typename="unitree_hg.msg.dds_.IMUState_"):  # noqa: N801
    """What the IMU in the pelvis says."""

    quaternion: types.array[types.float32, 4]
    gyroscope: types.array[types.float32, 3]
    accelerometer: types.array[types.float32, 3]
    rpy: types.array[types.float32, 3]
    temperature: types.int16


@_carried
@dataclass
@annotate.final
@annotate.autoid("sequential")
class LowState_(idl.IdlStruct, typename="unitree_hg.msg.dds_.LowState_"):  # noqa: N801
    """What the robot says, see ``layout.LowState``."""

    version: types.array[types.uint32, 2]
    mode_pr: types.uint8
    mode_machine: types.uint8
    tick: types.uint32
    imu_state: IMUState_
    motor_state: types.array[MotorState_, 35]
    wireless_remote: types.array[types.uint8, 40]
    reserve: types.array[types.uint32, 4]
    crc: types.uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class RequestIdentity_(idl.IdlStruct, typename="unitree_api.msg.dds_.RequestIdentity_"):  # noqa: N801
    """Which request."""

    id: types.int64
    api_id: types.int64


@dataclass
@annotate.final
@annotate.autoid("sequential")
class RequestLease_(idl.IdlStruct, typename="unitree_api.msg.dds_.RequestLease_"):  # noqa: N801
    """Whose lease."""

    id: types.int64


@dataclass
@annotate.final
@annotate.autoid("sequential")
class RequestPolicy_(idl.IdlStruct, typename="unitree_api.msg.dds_.RequestPolicy_"):  # noqa: N801
    """How urgent."""

    priority: types.int32
    noreply: bool


@dataclass
@annotate.final
@annotate.autoid("sequential")
class RequestHeader_(idl.IdlStruct, typename="unitree_api.msg.dds_.RequestHeader_"):  # noqa: N801
    """Head of a request."""

    identity: RequestIdentity_
    lease: RequestLease_
    policy: RequestPolicy_


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Request_(idl.IdlStruct, typename="unitree_api.msg.dds_.Request_"):  # noqa: N801
    """A request to a service of the robot."""

    header: RequestHeader_
    parameter: str
    binary: types.sequence[types.uint8]


@dataclass
@annotate.final
@annotate.autoid("sequential")
class ResponseStatus_(idl.IdlStruct, typename="unitree_api.msg.dds_.ResponseStatus_"):  # noqa: N801
    """Whether it was done: 0 is yes."""

    code: types.int32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class ResponseHeader_(idl.IdlStruct, typename="unitree_api.msg.dds_.ResponseHeader_"):  # noqa: N801
    """Head of an answer."""

    identity: RequestIdentity_
    status: ResponseStatus_


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Response_(idl.IdlStruct, typename="unitree_api.msg.dds_.Response_"):  # noqa: N801
    """An answer of a service of the robot."""

    header: ResponseHeader_
    data: str
    binary: types.sequence[types.uint8]


@_carried
@dataclass
@annotate.final
@annotate.autoid("sequential")
class World_(idl.IdlStruct, typename="demohlm.msg.dds_.World_"):  # noqa: N801
    """The state of a simulated robot's world, which no real robot sends; see ``world_topic``."""

    data: types.sequence[types.uint8]
