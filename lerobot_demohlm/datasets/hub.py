"""A dataset on disk -> a dataset repository on the Hugging Face hub, with this project's card."""

import logging
from pathlib import Path

from gym_demohlm.errors import DatasetError
from gym_demohlm.files import replace_text
from lerobot_demohlm.datasets.facts import read_facts, read_info
from lerobot_demohlm.datasets.origin import is_edited, is_generated

_log = logging.getLogger(__name__)
CONTENT = ("data/*", "meta/*", "videos/*")
"""Where the files of a dataset lie. LeRobot reads all that it finds there, so those of an earlier push must go."""


def push(root: Path, repo_id: str, *, private: bool | None = None, branch: str | None = None) -> str:
    """Upload a dataset and tag it with LeRobot's dataset version, as ``LeRobotDataset.push_to_hub`` does.

    What an earlier push left under ``CONTENT`` and this dataset lacks is deleted; other files of the repository stay.
    The card names the repository, unless it was edited; LeRobot's own method would put its general card in its place.
    The endpoint and the token are the hub client's: ``HF_ENDPOINT``, ``HF_TOKEN`` or ``hf auth login``.

    Args:
        root: Root of the dataset.
        repo_id: ``user/name``.
        private: Whether a new repository is private; None: the account's default.
        branch: Branch to push to; None: the main one.

    Returns:
        URL of the repository.

    Raises:
        DatasetError: The dataset cannot be opened, another version wrote it, LeRobot's tools have edited it, or the hub
            refused it.
    """
    if is_edited(root) and is_generated(root):
        raise DatasetError(
            f"{root}, which LeRobot's tools have made of another one",
            "a dataset as `demohlm generate` wrote it, for the card that says how",
            "push it with LeRobotDataset(...).push_to_hub()",
        )
    facts = read_facts(root)
    read_info(root)  # LeRobot does not say what is damaged
    require_repo_id(repo_id)

    import httpx
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, RevisionNotFoundError
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

    from lerobot_demohlm.datasets.card import is_by_hand, render_card

    meta = LeRobotDatasetMetadata(repo_id, root=root)
    card = Path(root) / "README.md"
    if is_by_hand(card, meta, facts):
        _log.warning("%s is pushed as it is, since it was edited; remove it to have a new one", card)
    else:
        replace_text(card, render_card(meta, repo_id, facts))
    api = HfApi()
    message = f"{facts['task']}, {facts['region']}: {meta.total_episodes} episodes"
    try:
        url = api.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True)
        if branch is not None:
            api.create_branch(repo_id, branch=branch, repo_type="dataset", exist_ok=True)
        api.upload_folder(
            repo_id=repo_id,
            folder_path=root,
            repo_type="dataset",
            revision=branch,
            commit_message=message,
            delete_patterns=list(CONTENT),
        )
        try:
            api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset")
        except RevisionNotFoundError:
            pass  # a first push has no tag to move
        api.create_tag(repo_id, tag=CODEBASE_VERSION, revision=branch, repo_type="dataset")
    except (HfHubHTTPError, HFValidationError, httpx.TransportError, OSError) as error:
        raise DatasetError(
            f"{type(error).__name__} from {api.endpoint}: {' '.join(str(error).split())}",
            "a hub that accepts the dataset",
            "check the network, the repo id, and `hf auth login`",
        ) from error
    return str(url)


def require_repo_id(repo_id: str) -> None:
    """Raise ``DatasetError`` where a dataset cannot be called so on the hub."""
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise DatasetError(f"repo id {repo_id!r} ({error})", "user/name", "correct --repo-id") from error
    if "/" not in repo_id:
        raise DatasetError(f"repo id {repo_id!r}", "user/name", "correct --repo-id")
