"""The name of a device -> an error where torch does not have it here."""

from gym_demohlm.errors import PolicyError


def require_device(device: str, *, here: bool = True) -> None:
    """Check that policies can be trained and can act on a device.

    LeRobot trains on another device than the one that was asked for, where that is missing.

    Args:
        device: Such as "cpu", "cuda" or "cuda:1".
        here: Whether it must be on this machine; otherwise only its name is checked.

    Raises:
        PolicyError: There is no such device, or not on this machine where it must be.
    """
    from lerobot.utils.device_utils import is_torch_device_available

    try:
        found = is_torch_device_available(device)
    except ValueError:
        raise PolicyError(f"device {device!r}", "cpu, cuda, mps or xpu", "correct --device") from None
    if here and not found:
        raise PolicyError(f"device {device!r}", "one that torch finds on this machine", "use --device cpu")
