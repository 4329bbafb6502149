"""Two processes on this machine: the results of one, a clear end for both if one is killed, clear words on mistakes."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from csv_files import read_csv
from drawn_faces import TRAIN
from safetensors.numpy import load_file

import jaxfit
from jaxfit.cli.main import main
from jaxfit.evaluation.boxes import start_boxes

OTHER_ENDED = ("another process ended", "another task died")  # in jaxfit's words or JAX's, whichever notices first
# What a program of several processes does, and what it is not let do.
PROGRAM = """
import sys
import numpy as np
import jaxfit
from jaxfit.data.pictures import read_grey
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.image.frame import Frame

folder, target, address, index = *sys.argv[1:4], int(sys.argv[4])
found = jaxfit.read_dataset("pts:" + folder)
faces, names = found.faces, []
options = jaxfit.Options(jaxfit.Greedy((0.6, 0.4), 6), mirror=False, frame=Frame(64, 36.0))

def noted(path):
    names.append(path.name)
    return read_grey(path)

def refused(work, *given, **ways):
    try:
        work(*given, **ways)
    except jaxfit.InputError as error:
        return str(error)

with jaxfit.learning.join_processes(address, 2, index):
    assert "those of [1] are not those of 0" in refused(jaxfit.train, faces[index:], found.scheme, options=options)
    assert "[1] have none" in refused(jaxfit.train, [faces[0], faces[-1], faces[1]], found.scheme, options=options)
    trained = jaxfit.train(faces, found.scheme, options=options, read=noted)
    assert trained.faces == 24 and "unread.png" in str(trained.problems), trained.problems
    jaxfit.save(trained.model, f"{target}/{index}.safetensors")
    np.save(f"{target}/{index}-read.npy", names)
    result = jaxfit.evaluate(trained.model, faces, start_boxes(faces), normaliser="box")
    np.save(f"{target}/{index}-errors.npy", result.errors)
    (problem,) = result.fits.problems
    assert problem.row == 24 and "unread.png" in problem.name, problem
    assert "expected one, got 2" in refused(jaxfit.finetune, trained.model, faces)
    assert "expected one, got 2" in refused(jaxfit.learning.learn_confidence, trained.model, faces)
"""


@pytest.fixture(scope="module")
def spoiled(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawn faces, and one whose picture cannot be read; it comes last."""
    folder = tmp_path_factory.mktemp("spoiled") / "faces"
    shutil.copytree(drawn, folder)
    shutil.copy(folder / "face000.pts", folder / "unread.pts")
    (folder / "unread.png").write_bytes(b"no picture")
    return folder


@pytest.fixture(scope="module")
def alone(spoiled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one process learns from them."""
    path = tmp_path_factory.mktemp("alone") / "alone.safetensors"
    assert main(["train", "--data", f"pts:{spoiled}", "--out", str(path), *TRAIN]) == 0
    return path


def free_address() -> str:
    """A port of this machine that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def both(*command: str) -> list[subprocess.Popen]:
    """The command, started in two processes."""
    ways = ["--coordinator", free_address(), "--processes", "2", "--process"]
    command = (sys.executable, "-m", "jaxfit.cli.main", *command, *ways)
    return [started(*command, str(index)) for index in range(2)]


def both_by_slurm(*command: str) -> list[subprocess.Popen]:
    """The same, as SLURM would start it, whose number of the job says the port."""
    tasks = [{"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index)} for index in range(2)]
    job = {"SLURM_JOB_ID": str(os.getpid()), "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2"}
    command = (sys.executable, "-m", "jaxfit.cli.main", *command, "--distributed")
    return [started(*command, **job, **task) for task in tasks]


def started(*command: str, **environment: str) -> subprocess.Popen:
    # Compiling takes most of the time: less well, and sooner.
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"} | environment
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def outputs(processes: list[subprocess.Popen]) -> list[str]:
    """What processes that succeed print."""
    said = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    return [out for out, _ in said]


def said_by_jaxfit(output: str) -> list[str]:
    """The lines of what a process printed, but for those of the transport."""
    return [line for line in output.splitlines() if not line.startswith("[Gloo]")]


def said_by_survivor(processes: list[subprocess.Popen], victim: int, stage: str) -> str:
    """What the other process says at its end when one is killed at a stage that the first tells of."""
    first = processes[0].stderr
    assert first is not None
    assert any(line.startswith(stage) for line in first)
    processes[victim].kill()
    survivor = processes[1 - victim]
    said = survivor.communicate(timeout=200)[1]
    processes[victim].communicate(timeout=10)
    assert survivor.returncode != 0
    return said


def assert_same_model(path: Path, other: Path) -> None:
    """The same to float tolerance: weights are float16, and products add up in another order."""
    tensors, others = load_file(path), load_file(other)
    assert {name: tensor.shape for name, tensor in tensors.items()} == {n: t.shape for n, t in others.items()}
    for name, tensor in tensors.items():
        size = np.abs(tensor.astype(float)).max()
        np.testing.assert_allclose(tensor.astype(float), others[name].astype(float), atol=5e-3 * size, err_msg=name)


def test_two_processes_are_as_good_as_one(spoiled: Path, alone: Path, tmp_path: Path) -> None:
    address = free_address()
    command = [sys.executable, "-c", PROGRAM, str(spoiled), str(tmp_path), address]
    outputs([started(*command, str(index)) for index in range(2)])
    assert (tmp_path / "0.safetensors").read_bytes() == (tmp_path / "1.safetensors").read_bytes()
    assert_same_model(tmp_path / "0.safetensors", alone)
    read = [set(np.load(tmp_path / f"{index}-read.npy")) for index in range(2)]
    assert not read[0] & read[1]
    assert read[0] | read[1] == {path.name for path in spoiled.glob("*.png")}
    errors = [np.load(tmp_path / f"{index}-errors.npy") for index in range(2)]
    np.testing.assert_array_equal(*errors)
    found = jaxfit.read_dataset(f"pts:{spoiled}").faces
    expected = jaxfit.evaluate(jaxfit.load(alone), found, start_boxes(found), normaliser="box").errors
    np.testing.assert_allclose(errors[0], expected, rtol=0.02)
    assert np.isinf(errors[0][-1])


def test_a_killed_training_ends_for_all_and_can_be_run_again(spoiled: Path, alone: Path, tmp_path: Path) -> None:
    target = tmp_path / "model.safetensors"
    command = ["train", "--data", f"pts:{spoiled}", "--out", str(target), *TRAIN]
    said = said_by_survivor(both(*command), 1, "reading pictures")
    assert any(words in said for words in OTHER_ENDED), said
    assert not list(tmp_path.iterdir())
    first, second = outputs(both(*command))
    assert "trained on 24 faces" in first
    assert said_by_jaxfit(second) == []
    assert_same_model(target, alone)


def test_a_killed_evaluation_ends_for_all_and_can_be_run_again(spoiled: Path, alone: Path, tmp_path: Path) -> None:
    command = ["evaluate", str(alone), "--data", f"pts:{spoiled}", "--normaliser", "box", "--out", str(tmp_path)]
    said = said_by_survivor(both(*command), 0, "compiling")
    assert any(words in said for words in OTHER_ENDED), said
    assert {path.name for path in tmp_path.iterdir()} <= {".jaxfit-lock"}
    first, second = outputs(both_by_slurm(*command))
    assert "written" in first
    assert said_by_jaxfit(second) == []
    rows = read_csv(tmp_path / "faces.csv")
    assert len(rows) == 25
    assert [row["problem"] != "" for row in rows] == [False] * 24 + [True]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--processes", "2", "--process", "0"], "expected a coordinator, the number of processes and which"),
        (["--coordinator", "here", "--processes", "2", "--process", "0"], "HOST:PORT; got 'here'"),
        (["--coordinator", "a:1", "--processes", "2", "--process", "2"], "from 0 to 1 of 2; got 2"),
        (["--coordinator", "a:1", "--processes", "0", "--process", "0"], "at least one process; got 0"),
        (["--distributed", "--processes", "2"], "got both"),
        (["--distributed"], "started by SLURM or Open MPI"),
    ],
)
def test_wrong_options_are_said_at_once(given: list[str], said: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["evaluate", "sdm68", "--data", "pts:nowhere", "--out", "nowhere", *given]) == 2
    assert said in capsys.readouterr().err
