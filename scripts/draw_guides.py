"""Draw the pictures of docs/guides: what the commands make of matplotlib's portrait, and of wings drawn here."""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import matplotlib.cbook
import numpy as np

import jaxfit
from jaxfit.cli.main import main as jaxfit_command
from jaxfit.data import Video, write_image
from jaxfit.data.videos import write_video

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "guides" / "pictures"
TURNS = {"upright": None, "lying": cv2.ROTATE_90_CLOCKWISE, "standing on its head": cv2.ROTATE_180}
HEIGHT = 280  # of the pictures in a row
WING = np.array([[0.0, 0.0], [0.35, -0.2], [0.72, -0.22], [1.0, -0.02], [0.7, 0.2], [0.3, 0.16], [0.5, 0.0]])


def main() -> int:
    argparse.ArgumentParser(description=__doc__).parse_args()
    FOLDER.mkdir(exist_ok=True)
    portrait = jaxfit.read_image(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        draw_portraits(portrait, work)
        draw_film(portrait, work)
        draw_wings(work)
    return 0


def draw_portraits(portrait: np.ndarray, work: Path) -> None:
    """Heads, turned faces, and a doubtful fit."""
    pictures = work / "photos"
    pictures.mkdir()
    write_image(pictures / "portrait.jpg", portrait)
    run("fit", pictures, "--heads", "--out", work / "heads")
    save("heads.jpg", row([face_of(jaxfit.read_image(work / "heads" / "overlays" / "portrait.jpg"))]))
    for title, turn in TURNS.items():
        write_image(pictures / f"{title}.png", portrait if turn is None else cv2.rotate(portrait, turn))
    run("fit", pictures, "--any-rotation", "--out", work / "turned")
    save("turned.jpg", row([jaxfit.read_image(work / "turned" / "overlays" / f"{title}.jpg") for title in TURNS]))
    (work / "boxes.csv").write_text("image,x,y,width,height\nportrait.jpg,300,420,150,150\n")
    run("fit", pictures / "portrait.jpg", "--boxes", work / "boxes.csv", "--out", work / "doubtful")
    save("doubtful.jpg", row([jaxfit.read_image(work / "doubtful" / "overlays" / "portrait.jpg")]))


def draw_film(portrait: np.ndarray, work: Path) -> None:
    """Three frames of a film in which the portrait moves to the left and turns."""
    height, width = portrait.shape[:2]
    with write_video(work / "film.mp4", 25.0) as write:
        for number in range(30):
            turn = cv2.getRotationMatrix2D((width / 2, height / 2), 10 - 0.7 * number, 1)
            turn[0, 2] += 40 - 3 * number
            write(cv2.warpAffine(portrait, turn, (width, height), borderMode=cv2.BORDER_REPLICATE))
    run("track", work / "film.mp4", "--smooth", "--overlay", "--out", work / "tracked")
    with Video(work / "tracked" / "overlay.webm") as film:
        frames = [frame.picture for frame in film if frame.number in (0, 14, 29)]
    save("film.jpg", row(frames))


def draw_wings(work: Path) -> None:
    """A model of seven points, from 40 wings; its fits of six others, as a contact sheet."""
    rng = np.random.default_rng(0)
    for folder, count in {"wings": 40, "new": 6}.items():
        (work / folder).mkdir()
        specimens = ""
        for number in range(count):
            picture, points = wing(rng)
            write_image(work / folder / f"wing{number:02}.png", picture)
            lines = "".join(f"{x:.1f} {len(picture) - y:.1f}\n" for x, y in points)  # y counts from the bottom
            specimens += f"LM={len(points)}\n{lines}IMAGE=wing{number:02}.png\nID={number}\n"
        (work / folder / "wings.tps").write_text(specimens)
    run("train", "--data", work / "wings" / "wings.tps", "--folds", "0", "--out", work / "wings.safetensors")
    run("fit", work / "new", "--model", work / "wings.safetensors", "--contact-sheet", "--out", work / "fitted")
    overlays = sorted((work / "fitted" / "overlays").glob("wing*.jpg"))
    save("wings.jpg", row([jaxfit.read_image(path) for path in overlays[:3]]))


def wing(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A picture (240, 320, 3) of a wing, and its landmarks (7, 2): six along the edge, and where the veins meet."""
    shape = WING + rng.normal(0, 0.02, WING.shape)
    angle, size = np.radians(rng.normal(0, 8)), rng.uniform(190, 230)
    turned = size * shape @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    points = turned - turned.mean(0) + [160, 120] + rng.normal(0, 8, 2)
    picture = np.full((240, 320, 3), 225.0) + 12 * cv2.resize(rng.normal(0, 1, (6, 8)), (320, 240))[..., None]
    picture = picture.clip(0, 255).astype(np.uint8)
    edge = (16 * points[:6]).astype(np.int32)  # in 16ths of a pixel
    membrane = cv2.fillPoly(picture.copy(), [edge], (190, 180, 150), cv2.LINE_AA, 4)
    picture = cv2.addWeighted(membrane, 0.7, picture, 0.3, 0)
    cv2.polylines(picture, [edge], True, (90, 70, 40), 2, cv2.LINE_AA, 4)
    for end in (0, 1, 2, 4, 5):
        vein = (16 * points[[6, end]]).astype(np.int32)
        cv2.polylines(picture, [vein], False, (110, 90, 60), 1, cv2.LINE_AA, 4)
    return picture, points


def run(*arguments: object) -> None:
    code = jaxfit_command([str(argument) for argument in arguments])
    if code:
        raise SystemExit(code)


def face_of(picture: np.ndarray) -> np.ndarray:
    """The part around the only face, at twice its height."""
    x, y, width, height = jaxfit.detect_faces(picture)[0].box
    top, left = max(0, int(y - 0.5 * height)), max(0, int(x - 0.8 * width))
    return picture[top : int(y + 1.5 * height), left : int(x + 1.8 * width)]


def row(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures side by side, at the same height, with white between them."""
    scaled = [
        cv2.resize(each, (HEIGHT * each.shape[1] // each.shape[0], HEIGHT), interpolation=cv2.INTER_AREA)
        for each in pictures
    ]
    gap = np.full((HEIGHT, 8, 3), 255, np.uint8)
    return np.concatenate([part for each in scaled for part in (each, gap)][:-1], axis=1)


def save(name: str, picture: np.ndarray) -> None:
    write_image(FOLDER / name, picture)
    print(f"{FOLDER / name}: {picture.shape[1]} × {picture.shape[0]}")


if __name__ == "__main__":
    sys.exit(main())
