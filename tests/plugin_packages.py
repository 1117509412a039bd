"""Small packages that declare plug-ins, laid out on disk as pip installs them."""

from collections.abc import Mapping
from pathlib import Path


def install(site: Path, package: str, *, modules: Mapping[str, str], declares: Mapping[str, str]) -> None:
    """Writes modules and the metadata of a distribution into a folder that stands on `sys.path`.

    Args:
        site: the folder; created if missing.
        package: name of the distribution.
        modules: source code by module name.
        declares: lines `name = module:Class`, by entry point group.
    """
    metadata = site / f"{package.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    groups = (f"[{group}]\n{lines}\n" for group, lines in declares.items())
    (metadata / "entry_points.txt").write_text("\n".join(groups))
    for name, source in modules.items():
        (site / f"{name}.py").write_text(source)
