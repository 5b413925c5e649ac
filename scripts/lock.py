"""Write .ci/constraints.txt: the versions, installed here, of all that derender and its tests need.

usage: python scripts/lock.py     in an environment in which `make test` has just passed
"""

import argparse
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
HEAD = """# Versions that have passed `make test` together on Python 3.11: pip install -c .ci/constraints.txt '.[dev]'
# Written by scripts/lock.py.
"""


def installed_closure(requirements: list[Requirement]) -> dict[str, str]:
    """Return the installed version of each required distribution and of all that these require, by name."""
    found: dict[str, str] = {}
    waiting = [(requirement, "") for requirement in requirements]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            print(f"not installed: {requirement}", file=sys.stderr)
            continue
        if name not in found:
            found[name] = distribution.version
            for needed in map(Requirement, distribution.requires or []):
                waiting += [(needed, wanted) for wanted in ("", *requirement.extras)]
    return found


def main() -> None:
    """Write the file and say how many there are."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    texts = [*project["dependencies"], *(text for extra in extras for text in extra)]
    found = installed_closure([Requirement(text) for text in texts if not text.startswith("derender")])
    lines = "".join(f"{name}=={version}\n" for name, version in sorted(found.items()))
    (ROOT / ".ci" / "constraints.txt").write_text(HEAD + lines)
    print(f"{len(found)} versions in .ci/constraints.txt")


if __name__ == "__main__":
    main()
