"""The scripts that set up, run and test, and the package they install."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import pytest

from launch import ROOT, rank_environment

SITE = Path(pytest.__file__).parents[1]


def shell(*command: str | Path, env: dict[str, str] | None = None, timeout: float = 300):
    """Run a command without standard input; capture what it prints."""
    return subprocess.run(
        list(map(str, command)),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env={**rank_environment(), **(env or {})},
        timeout=timeout,
        check=False,
    )


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


# --- Help ------------------------------------------------------------------------------------


@pytest.mark.parametrize("script", ["bootstrap", "run", "test"])
def test_help_is_printed_without_setting_anything_up(script, tmp_path):
    copy_scripts(tmp_path)
    done = shell(tmp_path / "scripts" / script, "--help")
    assert done.returncode == 0
    assert done.stdout.startswith(f"usage: scripts/{script}")
    assert not (tmp_path / ".venv").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no scene given"),
        (["scene.yaml", "-n", "none"], "-n none: must be a positive whole number"),
        (["scene.yaml", "-n", "0"], "-n 0: must be a positive whole number"),
        (["scene.yaml", "-n"], "-n needs a number of ranks"),
    ],
)
def test_run_refuses_wrong_arguments_in_one_line(arguments, message):
    done = shell(ROOT / "scripts" / "run", *arguments)
    assert done.returncode == 64
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


# --- scripts/bootstrap -----------------------------------------------------------------------


def copy_scripts(folder: Path) -> None:
    shutil.copytree(ROOT / "scripts" / "lib", folder / "scripts" / "lib")
    for name in ("bootstrap", "run", "test"):
        shutil.copy(ROOT / "scripts" / name, folder / "scripts")


@pytest.fixture
def project(tmp_path) -> Path:
    """A copy of what bootstrap needs of this project."""
    root = tmp_path / "project"
    root.mkdir()
    copy_scripts(root)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, root)
    (root / "dem_mpi").mkdir()
    shutil.copy(ROOT / "dem_mpi" / "__init__.py", root / "dem_mpi")
    (root / "dem_mpi" / "__main__.py").write_text(
        f"import sys\nopen({str(tmp_path / 'warmed')!r}, 'a').write(sys.argv[1] + ' ')\n"
    )
    return root


@pytest.fixture
def fake_system(tmp_path) -> Path:
    """A folder for the front of the PATH whose apt-get and sudo only write down their calls."""
    folder = tmp_path / "bin"
    for name in ("apt-get", "sudo"):
        executable(folder / name, f'#!/bin/sh\necho "{name} $*" >>"{tmp_path}/calls"\n')
    return folder


def with_path(folder: Path, **variables: str) -> dict[str, str]:
    return {"PATH": f"{folder}:{os.environ['PATH']}", **variables}


@pytest.fixture
def own_stack(tmp_path) -> Path:
    """An interpreter that imports the MPI stack by a variable of its own, as modules make it.

    All the project's dependencies are there too, so that nothing has to be downloaded for them.
    """
    import petsc4py

    stack = tmp_path / "stack"
    stack.mkdir()
    folders = {SITE, Path(petsc4py.__file__).parents[1]}
    for entry in (entry for folder in folders for entry in folder.iterdir()):
        if entry.suffix != ".pth" and not entry.name.startswith(("pip", "__editable__", "dem_mpi")):
            (stack / entry.name).symlink_to(entry)
    base = Path(sys.executable).resolve()
    return executable(
        tmp_path / "module" / "python3",
        f'#!/bin/sh\necho "$*" >>"{tmp_path}/python_calls"\n'
        f'PYTHONPATH="{stack}" exec "{base}" "$@"\n',
    )


def test_own_stack_is_used_without_system_packages_and_only_once(
    project, own_stack, fake_system, tmp_path
):
    env = with_path(fake_system, PYTHON=str(own_stack))
    bootstrap = project / "scripts" / "bootstrap"

    first = shell(bootstrap, env=env)
    log = project / ".bootstrap.log"
    assert first.returncode == 0, first.stderr + (log.read_text() if log.exists() else "")
    assert not (tmp_path / "calls").exists(), "a system package manager was called"
    program = "import dem_mpi, petsc4py, numba; print(petsc4py.__file__, dem_mpi.__file__)"
    seen = shell(project / ".venv" / "bin" / "python", "-P", "-c", program)
    assert seen.stdout.split() == [
        str(tmp_path / "stack" / "petsc4py" / "__init__.py"),
        str(project / "dem_mpi" / "__init__.py"),
    ]
    assert (project / ".venv" / "bin" / "dem-mpi").exists()

    warmed = tmp_path / "warmed"
    assert warmed.read_text() == "warmup "

    calls = (tmp_path / "python_calls").read_text()
    again = shell(bootstrap, env=env)
    assert again.returncode == 0
    assert again.stderr == "bootstrap: nothing is missing\n"
    assert (tmp_path / "python_calls").read_text() == calls
    assert shell(bootstrap, "--quiet", env=env).stderr == ""

    (project / "dem_mpi" / "_kernels.py").touch()
    assert shell(bootstrap, env=env).returncode == 0
    assert warmed.read_text() == "warmup warmup ", "new kernels were not compiled"

    # Damage is noticed: a module that is gone is looked for again.
    pointer = next((project / ".venv").glob("lib/python*/site-packages/mpi_stack.pth"))
    pointer.write_text("")
    repaired = shell(bootstrap, env=env)
    assert repaired.returncode == 0, repaired.stderr
    assert "petsc4py" in shell(project / ".venv" / "bin" / "python", "-P", "-c", program).stdout


def test_interpreter_without_the_stack_is_refused_with_the_remedy(project, fake_system, tmp_path):
    python = executable(tmp_path / "bare" / "python3", "#!/bin/sh\nexit 1\n")
    done = shell(project / "scripts" / "bootstrap", env=with_path(fake_system, PYTHON=str(python)))
    assert done.returncode == 70
    assert "does not import mpi4py and petsc4py" in done.stderr
    assert "unset PYTHON" in done.stderr
    assert not (tmp_path / "calls").exists()


def test_missing_system_packages_are_installed_without_a_question(project, fake_system, tmp_path):
    executable(fake_system / "dpkg-query", "#!/bin/sh\nexit 1\n")  # nothing is installed
    executable(
        fake_system / "apt-get",
        f'#!/bin/sh\necho "$DEBIAN_FRONTEND $*" >>"{tmp_path}/calls"\n'
        'case "$*" in *install*) exit 100;; esac\n',
    )
    executable(fake_system / "sudo", '#!/bin/sh\n[ "$1" = -n ] && shift\nexec "$@"\n')
    done = shell(project / "scripts" / "bootstrap", env=with_path(fake_system))
    assert done.returncode == 70
    assert "apt-get install openmpi-bin" in done.stderr
    update, install = (tmp_path / "calls").read_text().splitlines()
    assert update.startswith("noninteractive ")
    assert update.endswith(" update")
    assert install.startswith("noninteractive ")
    assert " install -y " in install
    assert "python3-petsc4py-real python3-h5py-mpi" in install


# --- scripts/run -----------------------------------------------------------------------------

# Stands for dem-mpi: takes its time to start, then runs until USR1 and saves.
APPLICATION = """
import os, signal, sys, time
folder = os.path.dirname(os.path.abspath(__file__))
mode = os.environ.get("MODE", "run")
stop = []
open(os.path.join(folder, f"pid{os.getpid()}"), "w").close()
if mode == "slow start":
    open(os.path.join(folder, "began"), "w").close()
    time.sleep(4)
def request_stop(*_):
    stop.append(1)
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # it comes again, even while Python shuts down
signal.signal(signal.SIGUSR1, request_stop)
from mpi4py import MPI
world = MPI.COMM_WORLD
if mode == "echo":
    if world.rank == 0:
        print(world.size, os.environ["H5PY_ALWAYS_USE_MPI"], sys.argv[1:])
    sys.exit(int(os.environ["CODE"]))
open(os.path.join(folder, "began"), "w").close()
while not world.allreduce(len(stop)):
    time.sleep(0.05)
time.sleep(1)  # the save takes longer than mpirun would wait after TERM
world.Barrier()
open(os.path.join(folder, f"saved{world.rank}"), "w").close()
world.Barrier()
sys.exit(75)
"""


@pytest.fixture
def stage(tmp_path) -> Path:
    """A project whose bootstrap and program are stand-ins, with the real scripts/run."""
    copy_scripts(tmp_path)
    executable(tmp_path / "scripts" / "bootstrap", "#!/bin/sh\nexit 0\n")
    (tmp_path / "application.py").write_text(APPLICATION)
    executable(
        tmp_path / ".venv" / "bin" / "python",
        f'#!/bin/sh\nshift 3\nexec "{sys.executable}" "{tmp_path}/application.py" "$@"\n',
    )
    return tmp_path


def start(stage: Path, **variables: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [stage / "scripts" / "run", "scene.yaml", "-n", "2"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**rank_environment(), **variables},
        start_new_session=True,
    )


def wait_for(condition, timeout: float = 60.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def saved(stage: Path) -> list[str]:
    return sorted(path.name for path in stage.glob("saved*"))


@pytest.mark.parametrize("code", [0, 64, 75])
def test_run_passes_arguments_on_and_the_exit_code_back(stage, code):
    done = shell(
        stage / "scripts" / "run",
        "scene.yaml",
        "-n2",
        "--out",
        "two words",
        "--set",
        "time.end=1",
        env={"MODE": "echo", "CODE": str(code)},
    )
    assert done.returncode == code
    assert done.stdout == "2 1 ['run', 'scene.yaml', '--out', 'two words', '--set', 'time.end=1']\n"
    assert done.stderr == ""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_a_signal_lets_the_ranks_save(stage, number):
    process = start(stage)
    wait_for((stage / "began").exists)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 75, err
    assert saved(stage) == ["saved0", "saved1"]


def test_ctrl_c_in_a_terminal_lets_the_ranks_save(stage):
    process = start(stage)
    wait_for((stage / "began").exists)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal does
    _, err = process.communicate(timeout=60)
    assert process.returncode == 75, err
    assert "again to end at once" in err
    assert saved(stage) == ["saved0", "saved1"]


def test_a_signal_before_the_handlers_stand_is_not_lost(stage):
    process = start(stage, MODE="slow start")
    wait_for((stage / "began").exists)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 75, err
    assert saved(stage) == ["saved0", "saved1"]


def test_a_signal_right_after_the_start_of_mpirun_is_not_lost(stage):
    begun = stage / "bootstrapped"
    executable(stage / "scripts" / "bootstrap", f"#!/bin/sh\n: >'{begun}'\n")
    process = start(stage)
    wait_for(begun.exists)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 75, err
    # Either nothing was started or everything was saved.
    assert saved(stage) == (["saved0", "saved1"] if (stage / "began").exists() else [])


def test_a_signal_during_set_up_stops_before_the_simulation(stage):
    begun = stage / "bootstrapping"
    executable(stage / "scripts" / "bootstrap", f"#!/bin/sh\n: >'{begun}'\nexec sleep 60\n")
    process = start(stage)
    wait_for(begun.exists)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 75
    assert "before the simulation began" in err
    assert not (stage / "began").exists()


def test_failed_set_up_ends_the_run_with_its_code(stage):
    executable(stage / "scripts" / "bootstrap", "#!/bin/sh\nexit 70\n")
    assert shell(stage / "scripts" / "run", "scene.yaml").returncode == 70
    assert not (stage / "began").exists()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv")
def test_ranks_save_when_the_script_itself_is_killed(stage):
    process = start(stage)
    wait_for((stage / "began").exists)
    process.kill()
    process.communicate()
    wait_for(lambda: saved(stage) == ["saved0", "saved1"])


# --- The package -----------------------------------------------------------------------------


def test_wheel_holds_the_packages_and_nothing_else(tmp_path):
    done = shell(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("dem_mpi-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        folder = next(name for name in names if name.endswith("/METADATA")).split("/")[0]
        metadata = archive.read(f"{folder}/METADATA").decode()
        commands = archive.read(f"{folder}/entry_points.txt").decode()
    assert "dem_mpi/__init__.py" in names
    assert {name.split("/")[0] for name in names} <= {"dem_mpi", "stokes", "compress", folder}
    assert not [name for name in names if "test" in name]
    assert "License-Expression: BSD-3-Clause" in metadata
    assert "dem-mpi = dem_mpi.__main__:main" in commands


def test_plain_dependencies_leave_a_parallel_h5py_alone():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert not [line for line in project["dependencies"] if line.startswith(("h5py", "hdf5"))]
