"""Questions scripts/bootstrap asks an interpreter; standard library only.

paths                 directories in which this interpreter finds the MPI stack
missing               modules of the stack and of the project's dependencies that are not found
requirements [EXTRA]  what pip shall install: the dependencies without the stack
alone [EXTRA]         those of them that are installed without their own dependencies
constraints           the stack's versions as pip constraints
"""

import sys
import tomllib
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

# These belong to the machine's MPI stack: found, never installed from the package index. One
# numpy newer than the one petsc4py was compiled with breaks petsc4py and scipy alike.
STACK = ("mpi4py", "petsc4py", "numpy", "scipy", "h5py")
# These ask for parts of the stack by a name that it may not have: pip would lay a serial h5py over
# the MPI one of a distribution. They need nothing else.
ALONE = ("hdf5plugin",)
MODULES = {"pyyaml": "yaml"}  # where the module is not named as the package


def package_name(requirement: str) -> str:
    """Name in a requirement such as `numba>=0.59`."""
    for place, letter in enumerate(requirement):
        if not (letter.isalnum() or letter in "-_."):
            return requirement[:place].lower()
    return requirement.lower()


def requirements(extras: list[str]) -> list[str]:
    """Return the project's requirements outside the stack, with those of `extras`."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    known = project["optional-dependencies"]
    unknown = [extra for extra in extras if extra not in known]
    if unknown:
        sys.exit(f"unknown extra {unknown[0]!r}; there are {', '.join(known)}")
    lines = project["dependencies"] + [line for extra in extras for line in known[extra]]
    return [line for line in lines if package_name(line) not in STACK]


def alone(extras: list[str]) -> list[str]:
    """Return the requirements whose own dependencies are all of the stack."""
    return [line for line in requirements(extras) if package_name(line) in ALONE]


def paths() -> list[str]:
    """Return the directories that hold the stack, each once."""
    specs = [find_spec(name) for name in STACK]
    places = [Path(spec.origin).parents[1] for spec in specs if spec and spec.origin]
    return list(dict.fromkeys(map(str, places)))


def missing(extras: list[str]) -> list[str]:
    """Return the modules that cannot be found."""
    names = [package_name(line) for line in requirements(extras)]
    modules = [*STACK, *(MODULES.get(name, name) for name in names), "dem_mpi"]
    return [module for module in modules if find_spec(module) is None]


def constraints() -> list[str]:
    """Pin what is there, so that no other package replaces it."""
    lines = []
    for name in STACK:
        try:
            lines.append(f"{name}=={version(name)}")
        except PackageNotFoundError:  # Debian's h5py goes by another name
            continue
    return lines


def main() -> None:
    """Answer the question named on the command line, one item a line."""
    question, *rest = sys.argv[1:]
    extras = [extra for extra in ",".join(rest).split(",") if extra]
    match question:
        case "paths":
            answer = paths()
        case "missing":
            answer = missing(extras)
        case "requirements":
            answer = [line for line in requirements(extras) if package_name(line) not in ALONE]
        case "alone":
            answer = alone(extras)
        case "constraints":
            answer = constraints()
        case _:
            sys.exit(f"unknown question {question!r}")
    print("\n".join(answer))


if __name__ == "__main__":
    main()
