"""``demohlm pose-server``."""

from dataclasses import dataclass

from lerobot_demohlm.cli.choices import Backend


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm pose-server``.

    Attributes:
        backend: What estimates poses.
        address: Where to listen; only this machine reaches 127.0.0.1.
    """

    backend: Backend = "tracker"
    address: str = "tcp://127.0.0.1:5570"


def run(options: Options) -> None:
    """Serve until Ctrl-C; the first line on stdout says where.

    Raises:
        SceneError: Nothing can listen there.
    """
    from gym_demohlm.perception.pose_server import make_backend, serve

    serve(
        make_backend(options.backend),
        options.address,
        ready=lambda address: print(f"{options.backend} listens at {address}", flush=True),
    )
