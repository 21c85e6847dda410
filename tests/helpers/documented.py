"""README and docs as data: their pages, links, code and commands, and how a command is run with small numbers.

Run as a program it stands in for a command of a page: it lowers the numbers and runs the real command.
"""

import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
ADDRESS = "ADDRESS_OF_THIS_REPOSITORY"  # in the README; tests clone this checkout
SMALL = {
    "--num-episodes": "3",
    "--num-attempts": "3",
    "--attempt": "1",
    "--num-videos": "1",
    "--sample": "2",
    "--sizes": "3",
    "--steps": "4",
    "--eval.n_episodes": "2",
    "--eval.batch_size": "2",
}
"""Options whose numbers make a command slow, and the numbers that tests put in their place."""
LISTS = {"--variants": 2}
"""Options whose values are a run each, and how many of the values tests keep."""
ADDED = {
    "demohlm quickstart": {"--num-episodes": "3", "--steps": "4", "--num-rollouts": "2"},
    "demohlm train": {"--steps": "4"},
    "demohlm evaluate": {"--num-episodes": "2"},
    "demohlm leaderboard": {"--trial": "1"},
    "demohlm reproduce": {
        "--tasks": "LiftBox",
        "--sizes": "3",
        "--seeds": "0",
        "--policies": "mlp",
        "--steps": "4",
        "--num-rollouts": "2",
    },
    "lerobot-train": {"--steps": "4"},
}
"""Options that tests add to a command that does not have them."""
STAND_INS = ("demohlm", "lerobot-train", "lerobot-eval", "python", "pip", "pytest", "uv", "git")


def blocks(text: str, language: str) -> list[str]:
    """Return the content of a page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def links(text: str) -> list[str]:
    """Return the targets of a page's links and pictures that are in the repository."""
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    return [target for target in targets if "://" not in target]


def anchors(text: str) -> set[str]:
    """Return what a link into a page may have after its #: the headings as GitHub spells them."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def calls(text: str) -> Iterator[list[str]]:
    """Yield the words after ``demohlm`` of each call in a page, in its bash blocks and in its sentences."""
    code = "\n".join(blocks(text, "bash")).replace("\\\n", " ")
    lines = [line.split(" # ")[0] for line in code.splitlines()]
    sentences = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    for line in [*lines, *re.findall(r"`([^`]+)`", sentences)]:
        for part in re.split(r"&&|;", line):
            words = part.split()
            for place, word in enumerate(words):
                if word == "demohlm" and words[place - 1] not in ("clone", "cd", ADDRESS):
                    yield words[place + 1 :]
                    break


def small(argv: Sequence[str]) -> list[str]:
    """Return the command that a test runs in place of one of a page."""
    name, *rest = argv
    if name == "pip":  # tests install nothing
        return ["true"]
    if name == "git":
        return [str(REPOSITORY) if word == ADDRESS else word for word in argv]
    if name == "pytest":
        return [*argv, "tests/gym_demohlm/test_poses.py"]
    if name == "uv":  # the packages are those of this Python
        if rest[:1] == ["run"] and rest[1] in STAND_INS:
            return small(rest[1:])
        raise SystemExit(f"no stand-in for {' '.join(argv)}")
    words: list[str] = []
    for word in argv:
        option, equals, _ = word.partition("=")
        if equals and option in SMALL:
            word = f"{option}={SMALL[option]}"
        elif words and words[-1] in SMALL:
            word = SMALL[words[-1]]
        words.append(word)
    for option, most in LISTS.items():
        if option in words:
            first = words.index(option) + 1
            end = next((place for place in range(first, len(words)) if words[place].startswith("-")), len(words))
            del words[first + most : end]
    verb = " ".join(argv[:2]) if name == "demohlm" else name
    given = {word.partition("=")[0] for word in words}
    for option, value in ADDED.get(verb, {}).items():
        if option not in given:
            words += [option, value] if name == "demohlm" else [f"{option}={value}"]
    if verb == "demohlm generate":  # three successes would take a whole block of attempts
        words = ["--num-attempts" if word == "--num-episodes" else word for word in words]
    return words


def install_stand_ins(folder: Path) -> dict[str, str]:
    """Put the stand-ins into a folder and return an environment in which a shell finds them first."""
    folder.mkdir()
    for name in STAND_INS:
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{__file__}" "{folder}" {name} "$@"\n')
        path.chmod(0o755)
    return os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}


def main(folder: str, *argv: str) -> None:
    """Run a command with small numbers in place of this process; programs are those of this Python, then the path's."""
    words = small(argv)
    print("$", *words, file=sys.stderr, flush=True)
    others = [entry for entry in os.environ["PATH"].split(os.pathsep) if entry != folder]
    search = os.pathsep.join([str(Path(sys.executable).parent), *others])
    os.environ["PATH"] = search
    os.execvp(words[0], words)


if __name__ == "__main__":
    main(*sys.argv[1:])
