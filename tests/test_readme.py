"""Every command and every line of Python in the README and the guides, run as it stands there: blocks of ``bash`` and
``python``. Blocks of ``py`` need other programs, or machines."""

import re
import shlex
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_faces import draw_face
from scipy.io import savemat

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts
from jaxfit.data.videos import write_video
from jaxfit.schemes.conversions import convert
from jaxfit.schemes.known import AFLW21, IBUG68

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", DOCS / "index.md", *sorted((DOCS / "guides").glob("*.md"))]
GENERATED = {DOCS / "reference" / "commands.md", DOCS / "reference" / "api" / "index.md"}  # by the site's build
# What needs an installer or would run these very tests again; the Makefile's targets are looked up instead.
NOT_RUN = {"pip install ."}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


COMMANDS = list(
    dict.fromkeys(line for page in PAGES for block in blocks(page, "bash") for line in block.strip().splitlines())
)


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def folder(portrait: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the README takes for granted: photos, their boxes, a film, and faces labelled for training and testing."""
    folder = tmp_path_factory.mktemp("readme")
    model = jaxfit.load("sdm68")
    (face,) = jaxfit.detect_faces(portrait)
    points = jaxfit.fit(model, [portrait], face.box[None], kind=face.kind).landmarks[0]
    (folder / "photos").mkdir()
    write_image(folder / "photos" / "portrait.jpg", portrait)
    with write_video(folder / "film.mp4", 25.0) as write:
        for number in range(4):
            write(portrait[2 * number :][: len(portrait) - 8])
    row = ",".join(f"{value:.1f}" for value in face.box)
    (folder / "boxes.csv").write_text(f"image,x,y,width,height\nportrait.jpg,{row}\n")
    rng = np.random.default_rng(0)  # faces differ, so that there is something to learn of their shapes
    for part in ("train", "test"):
        (folder / "faces" / part).mkdir(parents=True)
        for number in range(4):
            left, top = 12 * number, 7 * number
            name = folder / "faces" / part / f"face{number:03}"
            write_image(name.with_suffix(".png"), portrait[top:, left:])
            write_pts(name.with_suffix(".pts"), points - [left, top] + rng.normal(0, 1, points.shape))
    (toml,) = blocks(DOCS / "guides" / "evaluate-and-compare.md", "toml")
    (folder / "compare.toml").write_text(toml, encoding="utf-8")
    scheme, folds = blocks(DOCS / "guides" / "own-objects.md", "toml")
    (folder / "wing.toml").write_text(scheme, encoding="utf-8")
    (folder / "folds.toml").write_text(folds, encoding="utf-8")
    _draw_wings(folder)
    _write_aflw(folder / "aflw", portrait, convert(points, IBUG68, AFLW21))
    _write_aflw2000(folder / "AFLW2000", portrait, points)
    return folder


def _draw_wings(folder: Path) -> None:
    """Objects with five points: labelled, in TPS files whose y counts from the bottom, and new ones."""
    rng = np.random.default_rng(0)
    for part, count in {"wings.tps": 10, "test.tps": 4, "": 2}.items():
        into = folder / ("wings" if part else "new")
        into.mkdir(exist_ok=True)
        specimens = ""
        for number in range(count):
            picture, points = draw_face(rng)
            name = f"{part.partition('.')[0]}{number}.png"
            write_image(into / name, picture)
            rows = "".join(f"{x:.2f} {len(picture) - y:.2f}\n" for x, y in points)
            specimens += f"LM={len(points)}\n{rows}IMAGE={name}\nID={number}\n"
        if part:
            (into / part).write_text(specimens, encoding="utf-8")


def _write_aflw(folder: Path, picture: np.ndarray, points: np.ndarray) -> None:
    """One face, one of whose points is hidden."""
    (folder / "flickr").mkdir(parents=True)
    write_image(folder / "flickr" / "face.jpg", picture)
    with closing(sqlite3.connect(folder / "aflw.sqlite")) as database, database:
        database.execute("CREATE TABLE Faces (face_id, file_id)")
        database.execute("CREATE TABLE FaceImages (file_id, filepath)")
        database.execute("CREATE TABLE FaceRect (face_id, x, y, w, h)")
        database.execute("CREATE TABLE FacePose (face_id, roll, pitch, yaw)")
        database.execute("CREATE TABLE FeatureCoords (face_id, feature_id, x, y)")
        database.execute("INSERT INTO Faces VALUES (1, 'face')")
        database.execute("INSERT INTO FaceImages VALUES ('face', 'face.jpg')")
        rows = [(number, *map(float, point)) for number, point in enumerate(points, 1)]
        database.executemany("INSERT INTO FeatureCoords VALUES (1, ?, ?, ?)", rows[:-1])


def _write_aflw2000(folder: Path, picture: np.ndarray, points: np.ndarray) -> None:
    folder.mkdir()
    write_image(folder / "image00002.jpg", picture)
    pose = np.radians([[-3.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]])
    savemat(folder / "image00002.mat", {"Pose_Para": pose, "pt3d_68": np.vstack([points.T + 1, np.zeros(68)])})


def run(command: str) -> None:
    program, *arguments = shlex.split(command)
    assert program == "jaxfit", f"no test runs this command: {command}"
    if arguments[0] == "train" and "wings/wings.tps" in arguments and "--folds" not in arguments:
        arguments += ["--folds", "2"]  # fewer trainings, and all else the same
    assert main(arguments) == 0, command


def test_commands(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    for command in COMMANDS:
        if command not in NOT_RUN:
            run(command)
    for written in (
        "sure-fits/contact-sheet.jpg",
        "any-fits/overlays/portrait.jpg",
        "fitted/landmarks.csv",
        "results/report.json",
        "results/faces.csv",
        "heads/heads.csv",
        "tracked/faces.csv",
        "tracked/overlay.webm",
        "tracked-heads/faces.csv",
        "results-3d/report.json",
        "results-all/report.json",
        "compared/report.html",
        "runs/report/report.html",
        "wings/wings.xml",
        "fitted/keypoints.json",
        "next.tps",
        "measured/report.json",
        "folds/report/report.html",
    ):
        assert (folder / written).stat().st_size > 0


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = {
        target
        for page in [*PAGES, ROOT / "CONTRIBUTING.md"]
        for target in re.findall(r"`?make ([a-z]+)(?:`|   #)", page.read_text("utf-8"))
    }
    assert named >= {"docs", "check", "everything"}
    assert all(f"\n{target}:" in makefile for target in named)
    assert "make everything" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_python(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    made: dict[str, dict[str, Any]] = {}
    for page in PAGES:
        made[page.stem] = {}
        for block in blocks(page, "python"):
            exec(compile(block, page.name, "exec"), made[page.stem])
    for name in ("README", "index", "python"):
        assert made[name]["fits"].landmarks.shape == (1, 68, 2)
        assert np.isfinite(made[name]["fits"].landmarks).all()
    names = made["python"]
    assert names["drawn"].shape == names["image"].shape
    np.testing.assert_allclose(names["in_image"], names["fits"].landmarks, atol=1e-3)
    np.testing.assert_allclose(names["landmarks"], names["fits"].landmarks, atol=10)
    assert np.isfinite(names["slope"]).all()
    assert np.isfinite(names["heads"].pose).all()
    assert names["heads"].landmarks_3d.shape == (1, 68, 3)
    assert names["frame"].ids.tolist() == [1]
    assert names["face"].landmarks.shape == (1, 68, 2)
    assert made["export"]["landmarks"].shape == (1, 68, 2)
    assert made["own-objects"]["length"].shape == (2,)


def test_the_table_beside_others_has_figures_of_their_pages() -> None:
    measured = "".join(
        (DOCS / "measured" / name).read_text(encoding="utf-8") for name in ("rivals.md", "speed/speed.md")
    )
    table = (
        (ROOT / "README.md")
        .read_text(encoding="utf-8")
        .partition("## Beside other programs")[2]
        .partition("## Models")[0]
    )
    figures = [cell for row in re.findall(r"^\|.*\|$", table, re.M) for cell in row.split("|")[2:]]
    numbers = re.findall(r"\d[\d.,]*", " ".join(figures))
    assert len(numbers) >= 14
    assert [number for number in numbers if number not in re.findall(r"\d[\d.,]*\d|\d", measured)] == []


def test_links() -> None:
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            path = (page.parent / target).resolve()
            assert path.exists() or path in GENERATED, f"{page.name}: {target}"


def test_documents_are_finished() -> None:
    for path in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        left = re.findall(r"^[A-Z]+[0-9]*$|\b(?:MINUTES|SIZE) M?i", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert not left, f"{path.name}: {left}"
