"""The source distribution, and the wheel that is built from it: all that the package reads, types, licences."""

import email
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import jaxfit
from jaxfit.cli import doctor

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("build")
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.partition(".")[0]) < 77:
        pytest.skip("needs setuptools 77, which knows licence expressions")
    folder = tmp_path_factory.mktemp("packages")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(packages: Path) -> zipfile.ZipFile:
    (path,) = packages.glob("*.whl")
    return zipfile.ZipFile(path)


def files_of_the_package() -> set[str]:
    """By git, which knows what is no leftover."""
    listed = subprocess.run(["git", "ls-files", "jaxfit"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("needs the repository")
    return set(listed.stdout.splitlines())


def test_the_wheel_has_every_file_of_the_package(wheel: zipfile.ZipFile) -> None:
    inside = {name for name in wheel.namelist() if name.startswith("jaxfit/")}
    assert inside == files_of_the_package()
    for name in (*(f"models/bundled/{name}" for name in jaxfit.bundled()), "heads/bundled/ict-facekit"):
        assert f"jaxfit/{name}.safetensors" in inside
    assert {"jaxfit/py.typed", "jaxfit/models/bundled/cards.json"} <= inside


def test_the_wheel_from_the_source_distribution_has_the_bytes_of_the_repository(wheel: zipfile.ZipFile) -> None:
    names = sorted(files_of_the_package())
    assert [name for name in names if wheel.read(name) != (ROOT / name).read_bytes()] == []


def test_the_source_distribution_has_them_too(packages: Path) -> None:
    (path,) = packages.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert files_of_the_package() | {"LICENSE", "README.md", "pyproject.toml"} <= inside


def test_metadata(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = email.message_from_bytes(wheel.read(name))
    assert metadata["Version"] == jaxfit.__version__
    assert metadata["License-Expression"] == "MIT"
    licences = metadata.get_all("License-File") or []
    assert set(licences) == {
        "LICENSE",
        "jaxfit/heads/bundled/LICENSE-ICT-FaceKit.txt",
        "jaxfit/data/detectors/bundled/LICENSE-YuNet.txt",
    }
    assert all(name.replace("METADATA", f"licenses/{file}") in wheel.namelist() for file in licences)


def test_the_version_is_the_same_everywhere() -> None:
    cited = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited == [jaxfit.__version__]
    assert f"\n## {jaxfit.__version__}\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_doctor_knows_extras_that_there_are() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for_developers = {"bench", "docs", "dev"}
    assert set(doctor._EXTRAS) == set(extras) - for_developers


def test_every_extra_is_documented() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    page = (ROOT / "docs" / "installing.md").read_text(encoding="utf-8")
    assert all(f"| `jaxfit[{extra}]` |" in page for extra in extras)
