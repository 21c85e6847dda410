"""Generated episodes seen by the head camera -> a film with true poses in green and the tracker's in red.

    python -m lerobot_demohlm.benchmarks.perception_film --output docs/perception.webp

draws the film of docs/perception.md: some tasks side by side, at twice the speed of the robot.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image

from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks.tracking import drawn
from lerobot_demohlm.reports.readme_pictures import FILM_STRIDE, write_film


@dataclass(frozen=True, kw_only=True)
class Film:
    """Draw a film of what the tracker sees.

    Attributes:
        output: The animated WebP; an existing one is replaced.
        tasks: From left to right, then down, two a row.
        region: Initial region of the episodes.
        seed: Of the episodes and of the camera's errors.
        index: Of the attempt.
        stride: Steps of 0.1 s from one frame to the next.
        width: Of one task's picture [px].
        quality: 0 to 100.
    """

    output: Path
    tasks: tuple[str, ...] = ("LiftBox", "GraspCube", "OpenCabinet", "ExchangeCube")
    region: str = "R3"
    seed: int = 22
    index: int = 0
    stride: int = FILM_STRIDE
    width: int = 400
    quality: int = 55


def draw(film: Film) -> int:
    """Draw a film and return its number of frames; a task that ends early keeps its last picture.

    Raises:
        UnknownNameError: A task does not exist.
    """
    size = (film.width, film.width * 3 // 4)
    takes = []
    for task in [get_task(name) for name in film.tasks]:
        pictures = drawn(task, film.region, film.seed, film.index, film.stride)
        takes.append([Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS) for picture in pictures])
    rows = -(-len(takes) // 2)
    frames = []
    for step in range(max(len(take) for take in takes)):
        frame = Image.new("RGB", (size[0] * min(2, len(takes)), size[1] * rows))
        for place, take in enumerate(takes):
            frame.paste(take[min(step, len(take) - 1)], (place % 2 * size[0], place // 2 * size[1]))
        frames.append(frame)
    film.output.parent.mkdir(parents=True, exist_ok=True)
    write_film(frames, film.output, film.quality)
    return len(frames)


if __name__ == "__main__":
    chosen = tyro.cli(Film)
    print(f"{chosen.output}: {draw(chosen)} frames", flush=True)
