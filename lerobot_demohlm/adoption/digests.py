"""The default controller -> the packaged digests of what it computes: run in a new process after the switch."""

from lerobot_demohlm.checks import portability
from lerobot_demohlm.checks.doctor import write_digests

if __name__ == "__main__":
    write_digests(portability.PACKAGED)
