"""A task and a region -> the seeds of the starts from which policies are scored, which nothing else ever uses."""

import zlib

from gym_demohlm.task import SCORING_SEEDS

SEEDS_A_CELL = 1000


def first_seed(task: str, region: str) -> int:
    """Return the first seed of a task's scoring starts in a region: other ones than those of any task or region else.

    Variations of a region and ways to see share them, so that they differ by their worlds alone.
    """
    cells = (SCORING_SEEDS.stop - SCORING_SEEDS.start) // SEEDS_A_CELL
    return SCORING_SEEDS.start + SEEDS_A_CELL * (zlib.crc32(f"{task} {region}".encode()) % cells)
