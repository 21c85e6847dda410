"""This machine -> what is installed on it, whether it computes the packaged bits, and what to do where it does not.

Everything that is looked at is a ``Finding`` with a remedy, so that a report can be printed, tested and kept.
"""

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError, SceneError
from gym_demohlm.files import replace_text
from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.results import append_result

COMMAND = "demohlm doctor --append results/portability.jsonl"
PACKAGES = (*provenance.LIBRARIES, "lerobot", "torch", "gymnasium", "lerobot_env_demohlm")
EXTRAS = {
    "rsl-rl-lib": ("rsl_rl", "wbc", "demohlm train-controller"),
    "tensorboard": ("tensorboard", "wbc", "curves of demohlm train-controller"),
    "ray": ("ray", "ray", "demohlm generate --backend ray"),
    "cyclonedds": ("cyclonedds", "g1", "demohlm deploy, simulate-robot and robot-check"),
    "dynamixel-sdk": ("dynamixel_sdk", "g1", "servos of demohlm deploy"),
    "transformers": ("transformers", "vla", "LeRobot's vision-language policies"),
}
"""Packages that come with an extra of the distribution: their module, the extra, and what needs it."""
FEATURES = ("avx2", "fma", "avx512f", "avx512_bf16", "amx_bf16")
LEAST_DISK_GB, LEAST_MEMORY_GB = 5.0, 4.0  # a quickstart and its training take a fifth of either
OK, REMARK, WRONG = "ok", "remark", "WRONG"


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """What ``demohlm doctor`` looks at and writes.

    Attributes:
        tasks: Whether to compare the behaviour of all packaged tasks, too, which takes about a minute.
        write: File that gets this machine's digests in the format of ``digests.json``; none by default.
        append: File of results that gets a line about this processor; none by default.
    """

    tasks: bool = False
    write: Path | None = None
    append: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        subject: What it is.
        found: What was found.
        level: "ok"; "remark" for what only some commands need; "WRONG" for what has to be mended.
        remedy: What to do about it; empty where nothing is to be done.
    """

    subject: str
    found: str
    level: str = OK
    remedy: str = ""

    def __str__(self) -> str:
        """Return the line that is printed."""
        return f"{self.level:<6}  {self.subject:<22}  {self.found}{f'. {self.remedy}' if self.remedy else ''}"


@dataclass(frozen=True, kw_only=True)
class Digest:
    """A digest of this machine beside the packaged one.

    Attributes:
        name: Of the part or task.
        packaged: SHA-256 in hexadecimal.
        here: SHA-256 in hexadecimal.
    """

    name: str
    packaged: str
    here: str

    @property
    def equal(self) -> bool:
        """Whether both are equal."""
        return self.packaged == self.here


def versions() -> dict[str, str]:
    """Return the versions of Python, of the packages and of the C library."""
    found = {name: _version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **found, "libc": provenance.bit_versions()["libc"]}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def processor() -> dict[str, Any]:
    """Return maker, model, architecture, features and usable cores of the processor."""
    found, flags = provenance.processor(), provenance.processor_flags()
    return {
        "maker": found.get("vendor_id", "unknown"),
        "model": found.get("model name", platform.processor() or "unknown"),
        "kind": provenance.cpu_family(),
        "features": [name for name in FEATURES if name in flags],
        "cores": cores(),
    }


def cores() -> int:
    """Return how many cores this process may use, which in a container may be fewer than the processor has."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        allowed = min(allowed, max(1, round(int(quota) / int(period))))
    return allowed


def compare(tasks: bool = False) -> list[Digest]:
    """Return this machine's digests beside the packaged ones: of the parts, and of the tasks if asked for."""
    from lerobot_demohlm.checks import portability  # loads inverse kinematics, which `--help` does not need

    packaged = portability.packaged()
    here = portability.parts()
    found = [Digest(name=name, packaged=value, here=here[name]) for name, value in packaged["parts"].items()]
    if tasks:
        for name, value in packaged["tasks"].items():
            found.append(Digest(name=name, packaged=value, here=portability.behaviour(get_task(name))))
    return found


def judge(digests: list[Digest], differing: tuple[str, ...]) -> Finding:
    """Judge digests: they must be equal, unless versions or the kind of processor may change bits.

    Args:
        digests: Of this machine, beside the packaged ones.
        differing: What differs in what decides bits, a line each.
    """
    wrong = [digest.name for digest in digests if not digest.equal]
    if not wrong:
        return Finding(subject="digests", found=f"all {len(digests)} as packaged: this machine computes the same bits")
    text = f"other bits in: {', '.join(wrong)}"
    if differing:
        remedy = "Expected here: results agree within bounds, not in every bit. `uv sync` installs the known versions"
        return Finding(subject="digests", found=f"{text} ({'; '.join(differing)})", level=REMARK, remedy=remedy)
    remedy = "Reinstall the package; if it stays, report it with this output"
    return Finding(subject="digests", found=text, level=WRONG, remedy=remedy)


def graphics() -> Finding:
    """Draw a frame of a scene, and say which back end did it."""
    import mujoco

    from gym_demohlm.envs.rendering import Renderer
    from gym_demohlm.scene import build_scene

    backend = os.environ.get("MUJOCO_GL", "MuJoCo's default")
    scene = build_scene(get_task("LiftBox"))
    data = mujoco.MjData(scene.model)  # pyright: ignore[reportAttributeAccessIssue]
    mujoco.mj_forward(scene.model, data)  # pyright: ignore[reportAttributeAccessIssue]
    renderer = Renderer(scene.model, 160, 120)
    try:
        began = time.monotonic()
        image = renderer.render(data)
        took = time.monotonic() - began
        drawn = f"{backend} draws ({_gl_name()}), first frame after {took:.1f} s"
        if len(set(image.reshape(-1).tolist())) < 8:
            remedy = "Set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
            return Finding(subject="graphics", found=f"{backend} draws an empty picture", level=WRONG, remedy=remedy)
        return Finding(subject="graphics", found=drawn)
    except SceneError as error:
        remedy = "Pictures and videos need it, simulation does not"
        return Finding(subject="graphics", found=str(error), level=WRONG, remedy=remedy)
    finally:
        renderer.close()


def _gl_name() -> str:
    """Return what the driver of the open graphics context calls itself."""
    try:
        from OpenGL import GL

        name = GL.glGetString(GL.GL_RENDERER)
        return name.decode() if isinstance(name, bytes) else "unknown driver"
    except Exception:  # PyOpenGL raises whatever its platform raises
        return "unknown driver"


def video() -> Finding:
    """Look for what writes and reads videos: PyAV, which brings its own FFmpeg."""
    try:
        import av

        return Finding(subject="video", found=f"PyAV {av.__version__}, ffmpeg {shutil.which('ffmpeg') or 'not needed'}")
    except ImportError as error:
        return Finding(
            subject="video", found=f"no PyAV ({error})", level=REMARK, remedy="Videos need it: pip install av"
        )


def space() -> list[Finding]:
    """Look at free disk and memory."""
    disk = shutil.disk_usage(Path.cwd()).free / 1e9
    findings = [_enough("free disk", disk, LEAST_DISK_GB, "Free some, or work elsewhere")]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        text = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) for line in text if line.startswith("MemAvailable:")) / 1e6
        findings.append(_enough("free memory", free, LEAST_MEMORY_GB, "Close other programs, or use fewer workers"))
    return findings


def _enough(subject: str, found_gb: float, least_gb: float, remedy: str) -> Finding:
    text = f"{found_gb:.0f} GB"
    if found_gb >= least_gb:
        return Finding(subject=subject, found=text)
    return Finding(subject=subject, found=f"{text}, less than {least_gb:.0f} GB", level=REMARK, remedy=remedy)


def extras() -> list[Finding]:
    """Look for the modules of optional extras."""
    findings = []
    for package, (module, extra, purpose) in EXTRAS.items():
        if importlib.util.find_spec(module) is not None:
            findings.append(Finding(subject=f"extra [{extra}]", found=f"{package} {_version(package)}"))
        else:
            remedy = f"For {purpose}: uv sync --extra {extra}"
            findings.append(
                Finding(subject=f"extra [{extra}]", found=f"{package} not installed", level=REMARK, remedy=remedy)
            )
    return findings


def plugin() -> Finding:
    """Look whether LeRobot will find the plugin: the distribution's name must be importable."""
    name = "lerobot_env_demohlm"
    if importlib.util.find_spec(name) is not None and _version(name) != "not installed":
        return Finding(subject="LeRobot plugin", found=f"{name} {_version(name)}, found by LeRobot's commands")
    remedy = "Run `uv sync` or `pip install .` in the checkout"
    return Finding(subject="LeRobot plugin", found=f"{name} is not installed", level=WRONG, remedy=remedy)


def as_line(digests: list[Digest]) -> dict[str, Any]:
    """Return this machine's line of ``results/portability.jsonl``.

    Args:
        digests: Of this machine, beside the packaged ones.
    """
    found = processor()
    return {
        "processor": f"{found['maker']} {found['model']}",
        "kind": found["kind"],
        "features": found["features"],
        "versions": provenance.bit_versions(),
        "digests": {digest.name: digest.here for digest in digests},
        "equal": all(digest.equal for digest in digests),
    }


def write_digests(path: Path) -> None:
    """Write this machine's versions and digests of all parts and tasks, as ``digests.json`` holds them.

    Raises:
        DatasetError: The file cannot be written.
    """
    from lerobot_demohlm.checks import portability

    known = portability.packaged()["tasks"]
    content = {
        "versions": provenance.bit_versions(),
        "parts": portability.parts(),
        "tasks": {name: portability.behaviour(get_task(name)) for name in all_tasks() if name in known},
    }
    try:
        replace_text(path, json.dumps(content, indent=2) + "\n")
    except OSError as error:
        raise DatasetError(f"{path} ({error})", "a file that may be written", "choose another --write") from error


def run(options: DoctorOptions) -> int:
    """Examine this machine and print what was found.

    Returns:
        Exit code: 0 if nothing is wrong, else 1. Remarks are not wrong.
    """
    from lerobot_demohlm.checks import portability

    found = processor()
    print(f"processor: {found['maker']} {found['model']}, {found['kind']}, {' '.join(found['features']) or 'no AVX2'}")
    print(f"cores: {found['cores']} usable")
    print("versions: " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    findings: list[Finding] = []
    for finding in _environment():
        findings.append(finding)
        print(finding, flush=True)
    digests = compare(options.tasks)
    width = max(len(digest.name) for digest in digests)
    print(f"{'digest':<{width}}  packaged      this machine")
    for digest in digests:
        verdict = "equal" if digest.equal else "differs"
        print(f"{digest.name:<{width}}  {digest.packaged[:12]}  {digest.here[:12]}  {verdict}")
    findings.append(judge(digests, portability.differing_versions()))
    print(findings[-1])
    if options.write is not None:
        write_digests(options.write)
        print(f"digests written to {options.write}")
    if options.append is not None:
        append_result(options.append, COMMAND, as_line(digests))
        print(f"a line added to {options.append}")
    wrong = sum(finding.level == WRONG for finding in findings)
    print("all well" if wrong == 0 else f"{wrong} to be mended: see WRONG above")
    return 0 if wrong == 0 else 1


def _environment() -> Iterator[Finding]:
    """Yield what is found of the machine, one by one: drawing takes seconds."""
    looks: tuple[Callable[[], Finding], ...] = (plugin, graphics, video)
    for look in looks:
        yield look()
    yield from space()
    yield from extras()
