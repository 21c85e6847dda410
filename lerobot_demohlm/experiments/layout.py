"""Cells -> where a run of experiments keeps their data, trainings, rollouts and lines."""

from dataclasses import dataclass
from pathlib import Path

from gym_demohlm.registry import get_task
from lerobot_demohlm.experiments.plan import Cell, RegionCell, suffix
from lerobot_demohlm.experiments.variants import PLAIN, sight, sight_stamp


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where a run of experiments keeps what.

    Attributes:
        root: Directory of everything large: datasets, trainings, rollouts.
        results: Directory of the lines that are kept.
    """

    root: Path
    results: Path

    @property
    def policies_file(self) -> Path:
        """Return where the score of each cell goes."""
        return self.results / "experiments.jsonl"

    @property
    def generation_file(self) -> Path:
        """Return where the success of generation goes."""
        return self.results / "generation.jsonl"

    def dataset(self, task: str, region: str, size: int, variant: str = PLAIN, *, seen: bool = False) -> Path:
        """Return the smallest dataset that has at least ``size`` episodes, or the path for a new one.

        Args:
            task: Name of the task.
            region: Initial region.
            size: Number of episodes.
            variant: How the data is generated.
            seen: Whether the dataset has pictures.
        """
        held = self.datasets(task, region, variant, seen=seen)
        sizes = {count: path for path, count in held.items() if count >= size}
        return sizes[min(sizes)] if sizes else self.root / "data" / f"{_stem(task, region, variant, seen)}_{size}"

    def datasets(self, task: str, region: str, variant: str = PLAIN, *, seen: bool = False) -> dict[Path, int]:
        """Return the datasets that there are, with or without pictures, and how many episodes each has."""
        stem = _stem(task, region, variant, seen)
        found = sorted((self.root / "data").glob(f"{stem}_*"))
        sizes = {path: path.name.removeprefix(f"{stem}_") for path in found}
        return {path: int(size) for path, size in sizes.items() if size.isdecimal()}

    def data(self, cell: Cell) -> Path:
        """Return where the data is that a cell is trained on, or where to make it."""
        return self.dataset(cell.task, cell.region, cell.num_train_episodes, cell.variant, seen=cell.sees)

    def generation(self, cell: RegionCell, num_attempts: int) -> Path:
        """Return where the attempts of a region are made."""
        parts = (get_task(cell.task).slug, cell.region.lower(), *suffix(cell.variation, "none"), cell.stamp)
        return self.root / "regions" / "_".join((*parts, str(num_attempts)))

    def training(self, cell: Cell) -> Path:
        """Return where a cell is trained."""
        return self.root / "policies" / f"{cell.trained}_{cell.data_stamp}_{cell.recipe}"

    def times(self, cell: Cell) -> Path:
        """Return the file that a training which came to its end has beside its checkpoints."""
        return self.training(cell) / "times.json"

    def rollouts(self, cell: Cell) -> Path:
        """Return where a cell's rollouts are, one line each."""
        return self.root / "rollouts" / f"{cell.name}_{cell.stamp}_{cell.recipe}.jsonl"


def _stem(task: str, region: str, variant: str, seen: bool) -> str:
    """Return what the names of datasets begin with."""
    made = sight_stamp(task, sight(variant), region=region)
    return "_".join((get_task(task).slug, region.lower(), *suffix(variant), made, *(("seen",) if seen else ())))
