"""derender: from one depth image to a posterior over scene graphs, and on to physics."""

from pathlib import Path

__version__ = "0.1.0"


def data_path(name: str) -> Path:
    """Return the path of a file that ships with derender, such as ``priors/tabletop.yaml``.

    A checkout keeps them in ``data/`` at its top; a wheel in ``derender/_data``.
    """
    package = Path(__file__).parent
    installed = package / "_data" / name
    return installed if installed.exists() else package.parent / "data" / name
