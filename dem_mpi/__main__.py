"""The command line: one verb a subcommand.

Signals are heeded from the first lines on, before the heavy imports: a batch system's warning may
come while the program starts.
"""

from __future__ import annotations

from dem_mpi.signals import StopRequest

STOP = StopRequest()
if __name__ == "__main__":
    STOP.install()

import json  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Annotated  # noqa: E402

import typer  # noqa: E402

from dem_mpi import __version__  # noqa: E402
from dem_mpi.errors import DemError, InputError  # noqa: E402

_EPILOG = (
    "Exit codes: 0 done; 64 bad input; 65 bad data file; 70 internal error or solver failure; "
    "74 input/output (disk full); 75 stopped by a signal with a checkpoint, run me again with "
    "--resume. Signals: USR1 finishes the step, saves and exits with 75; so do TERM and INT where "
    "they reach the ranks (scripts/run turns them into USR1; a bare mpirun ends its ranks on TERM "
    "and INT at once, and the last periodic checkpoint stays valid)."
)

app = typer.Typer(
    name="dem-mpi",
    help="Rigid bodies in frictional contact on any number of MPI ranks.",
    epilog=_EPILOG,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Scene = Annotated[Path, typer.Argument(help="Scene file (YAML).", metavar="SCENE")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY.PATH=VALUE",
        help="Override a value of the scene, e.g. --set time.end=2 --set bodies.0.count=500. "
        "May be repeated.",
    ),
]


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Rigid bodies in frictional contact on any number of MPI ranks."""
    if version:
        _print(f"dem-mpi {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        _print(context.get_help(), error=True)
        raise typer.Exit(InputError.exit_code)


@app.command("run", epilog=_EPILOG)
def run_command(
    scene: Scene,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue from the newest valid checkpoint, on any ranks."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Output directory. [default: runs/<scene>]"),
    ] = None,
    overrides: Overrides = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Replace an existing trajectory; with --resume, accept a changed scene.",
        ),
    ] = False,
) -> None:
    """Simulate a scene: mpirun -n P dem-mpi run SCENE.

    Writes the trajectory (run.h5 unless the scene says otherwise), checkpoints and metrics.jsonl
    into the output directory.
    """
    from time import perf_counter

    from dem_mpi.parallel import Parallel
    from dem_mpi.runner import RunOptions, run
    from dem_mpi.warmup import kind_of, set_threads, warm_up

    parallel = Parallel()
    parallel.install_abort_hook()
    loaded = _load_on_all(parallel, scene, overrides)
    for warning in loaded.warnings:
        _print(f"warning: {warning}", error=True)
    set_threads(loaded.scenario.threads)
    started = perf_counter()
    contact, kinds = loaded.scenario.contact, (kind_of(loaded.scenario),)
    compiled = warm_up(
        parallel,
        loaded.scenario.threads,
        (contact.operator,),
        kinds,
        (contact.solver,),
        contact.law,
        contact.scip.form,
    )
    if loaded.scenario.compress is not None:
        from dem_mpi.compression import compile_kernels

        compile_kernels(parallel)
    seconds = perf_counter() - started
    if compiled and seconds > 2.0:
        _print(f"compiled kernels in {seconds:.0f} s (first run only; kept in the numba cache)")
    options = RunOptions(out or Path("runs") / scene.stem, resume, force)
    run(parallel, loaded, options, STOP, _print)


@app.command(epilog=_EPILOG)
def check(
    scene: Scene,
    overrides: Overrides = None,
    ranks: Annotated[
        int, typer.Option("--ranks", "-n", min=1, help="Ranks to estimate memory for.")
    ] = 1,
) -> None:
    """Validate a scene and print what it would take; runs nothing."""
    from dem_mpi.estimate import estimate, refuse_what_exceeds_its_limit, shortage
    from dem_mpi.machine import installed_memory
    from dem_mpi.scenario import load_scenario

    loaded = load_scenario(scene, overrides or ())
    for warning in loaded.warnings:
        _print(f"warning: {warning}", error=True)
    for line in estimate(loaded.scenario, ranks).lines():
        _print(line)
    refuse_what_exceeds_its_limit(loaded.scenario, ranks)
    # Which nodes the ranks will be on is not known here: this is no error yet.
    lacking = shortage(loaded.scenario, ranks, installed_memory() // ranks)
    if lacking:
        where = "with all ranks on this machine " if ranks > 1 else "on this machine "
        _print(f"warning: {where}run would refuse: {lacking}", error=True)


@app.command(epilog=_EPILOG)
def schema() -> None:
    """Print the JSON schema of scene files, with units, for editors."""
    from dem_mpi.scenario import json_schema

    _print(json.dumps(json_schema(), indent=2))


@app.command(epilog=_EPILOG)
def info(
    file: Annotated[
        Path, typer.Argument(help="Trajectory, checkpoint, archive or flow.", metavar="FILE.h5")
    ],
) -> None:
    """Say what is in a file of a run, and whether it is valid.

    FILE.h5 is a trajectory, a checkpoint, an archive or a flow; of anything else it says that (65).
    A run that is going on may be looked at, too.
    """
    from dem_mpi.output import describe

    description = describe(file)
    for line in description.lines():
        _print(line)
    raise typer.Exit(description.exit_code)


@app.command(epilog=_EPILOG)
def solve(
    problem: Annotated[
        Path, typer.Argument(help="Problem in FCLIB's HDF5 layout.", metavar="PROBLEM.h5")
    ],
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Limit of the dual residual, see the kinds.")
    ] = 1e-6,
    kind: Annotated[
        str,
        typer.Option(
            "--tolerance-kind",
            metavar="scaled|absolute|thesis",
            help="scaled: times v_ref, the largest |q_i|; absolute: in m/s; thesis: S. De's three "
            "residuals together.",
        ),
    ] = "scaled",
    complementarity: Annotated[
        float,
        typer.Option("--complementarity", help="Limit of |impulse . velocity| in v_ref gamma_ref."),
    ] = 1e-6,
    solver: Annotated[
        str,
        typer.Option(
            "--solver",
            metavar="apgd|scip|auto",
            help="apgd: first order; scip: interior point; auto: apgd, then scip where that "
            "promises less work.",
        ),
    ] = "apgd",
    law: Annotated[
        str,
        typer.Option(
            "--law",
            metavar="ccp|coulomb",
            help="coulomb: what FCLIB states; ccp: its convex relaxation, as in a simulation.",
        ),
    ] = "ccp",
    max_iterations: Annotated[
        int,
        typer.Option("--max-iterations", min=0, help="Stop apgd, not converged, after so many."),
    ] = 100_000,
    newton_iterations: Annotated[
        int,
        typer.Option("--newton-iterations", min=1, help="Stop scip, not converged, after so many."),
    ] = 60,
    max_outer: Annotated[
        int,
        typer.Option(
            "--max-outer",
            min=1,
            help="Stop law coulomb, not converged, after so many cone problems.",
        ),
    ] = 100,
    form: Annotated[
        str,
        typer.Option(
            "--form",
            metavar="auto|velocity|contact",
            help="Unknowns of scip's linear systems; a local problem has contact only.",
        ),
    ] = "auto",
    linear: Annotated[
        str,
        typer.Option(
            "--linear",
            metavar="mumps|cg",
            help="scip's linear systems by factors, or by conjugate gradients.",
        ),
    ] = "mumps",
    guess: Annotated[
        str | None,
        typer.Option(
            "--guess",
            metavar="solution|NUMBER",
            help="Start from the stored solution or guess. [default: from zero]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.h5",
            help="Write the problem with its solution in FCLIB's layout; impulses that did not "
            "converge go in as a guess.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE.h5 if it exists.")] = False,
) -> None:
    """Solve an FCLIB problem: mpirun -n P dem-mpi solve PROBLEM.h5.

    PROBLEM.h5 is local (W, q, mu) or global (M, H, f, w, mu). Prints iterations, the residuals of
    the chosen law, objective and seconds, and how stored impulses compare under that law. Ends with
    0 if the tolerance holds and with 70 if it does not. There is no checkpoint of a solve: a signal
    ends it at once.
    """
    from dem_mpi.parallel import Parallel
    from dem_mpi.solve import SolveOptions, end_on_signals, parse_options, solve_file

    end_on_signals(STOP)
    options = parse_options(
        tolerance,
        kind,
        complementarity,
        SolveOptions(
            max_iterations=max_iterations,
            guess=guess,
            out=out,
            force=force,
            solver=solver,
            law=law,
            newton_iterations=newton_iterations,
            max_outer=max_outer,
            form=form,
            linear=linear,
        ),
    )
    parallel = Parallel()
    parallel.install_abort_hook()
    raise typer.Exit(solve_file(parallel, problem, options, _print))


@app.command(epilog=_EPILOG)
def flow(
    run: Annotated[Path, typer.Argument(help="Trajectory of a run.", metavar="RUN.h5")],
    frame: Annotated[
        str,
        typer.Option(
            "--frame",
            metavar="last|N|TIME",
            help="Frame by its number from 0, or the nearest to a time such as 0.5s.",
        ),
    ] = "last",
    bodies: Annotated[
        str | None,
        typer.Option(
            "--bodies", metavar="GIDS", help="Only these, e.g. '3 7-12 40'. [default: all]"
        ),
    ] = None,
    region: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--region",
            metavar="X0 X1 Y0 Y1 Z0 Z1",
            help="Only bodies whose centres it holds, in m.",
        ),
    ] = None,
    hydrodynamic_radius: Annotated[
        str,
        typer.Option(
            "--hydrodynamic-radius",
            metavar="auto|FACTOR",
            help="Size of the bodies over that of the run; auto: as large as leaves a gap of a "
            "hundredth of a radius, for touching bodies have no solution.",
        ),
    ] = "auto",
    viscosity: Annotated[
        float, typer.Option("--viscosity", help="Of the fluid, in Pa s; the default is water's.")
    ] = 1e-3,
    background: Annotated[
        list[str] | None,
        typer.Option(
            "--background",
            metavar="FLOW",
            help="Flow far away: uniform:ux,uy,uz, shear:rate[,xz], extension:rate[,z], "
            "poiseuille:speed,half_width[,x], each with [@x,y,z] for its origin. May be repeated, "
            "for the sum of flows. [default: at rest]",
        ),
    ] = None,
    problem: Annotated[
        str,
        typer.Option(
            "--problem",
            metavar="resistance|mobility",
            help="resistance: bodies move as in the run, loads of the fluid are asked for; "
            "mobility: bodies feel their buoyant weights, motions are asked for.",
        ),
    ] = "resistance",
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--gravity", metavar="X Y Z", help="For mobility, in m/s^2. [default: the run's]"
        ),
    ] = None,
    fluid_density: Annotated[
        float,
        typer.Option(
            "--fluid-density", help="For mobility, in kg/m^3: buoyancy; the default is water's."
        ),
    ] = 1000.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Relative error of velocities.")
    ] = 1e-4,
    formulation: Annotated[
        str,
        typer.Option(
            "--formulation",
            metavar="single|combined",
            help="Layers on the surfaces; combined is better conditioned at twice the work.",
        ),
    ] = "single",
    max_iterations: Annotated[
        int,
        typer.Option("--max-iterations", min=1, help="Stop, not converged, after so many."),
    ] = 300,
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid", metavar="NX,NY,NZ", help="Also velocity and pressure on a grid of points."
        ),
    ] = None,
    grid_box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--grid-box",
            metavar="X0 X1 Y0 Y1 Z0 Z1",
            help="First and last points of the grid, in m. [default: around the bodies]",
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            "--points",
            metavar="FILE",
            help="Velocity and pressure at points in place of a grid: CSV with a header x,y,z, or "
            "HDF5 with position.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", metavar="FLOW.h5", help="File to write. [default: flow.h5 beside RUN.h5]"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FLOW.h5 if it exists.")] = False,
    render: Annotated[
        Path | None,
        typer.Option(
            "--render",
            metavar="PICTURE",
            help="Draw speed and streamlines on a plane, as .png, .pdf or .svg (needs matplotlib).",
        ),
    ] = None,
    plane: Annotated[
        str,
        typer.Option(
            "--slice",
            metavar="x|y|z[=PLACE]",
            help="Plane of the picture, across an axis; without a place where it cuts most bodies.",
        ),
    ] = "y",
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Say what it would take, nodes, memory, seconds, and end."),
    ] = False,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of a rank.")] = 1,
) -> None:
    """Stokes flow around bodies: mpirun -n P dem-mpi flow RUN.h5.

    Reads spheres, spheroids and rods of a frame and writes loads, motions, densities on
    the surfaces and, if asked for, the flow on a grid into FLOW.h5, which ParaView opens. Ends with
    0 if the tolerance holds and with 70 if it does not; the file then says so. There is no
    checkpoint: a signal ends it at once, and leaves no file.
    """
    from dem_mpi.flow import flow_file
    from dem_mpi.flow_options import parse_options
    from dem_mpi.parallel import Parallel
    from dem_mpi.solve import end_on_signals
    from dem_mpi.warmup import set_threads

    end_on_signals(STOP)
    options = parse_options(
        frame=frame,
        bodies=bodies,
        region=region,
        hydrodynamic_radius=hydrodynamic_radius,
        viscosity=viscosity,
        background=background or (),
        problem=problem,
        gravity=gravity,
        fluid_density=fluid_density,
        tolerance=tolerance,
        formulation=formulation,
        max_iterations=max_iterations,
        grid=grid,
        box=grid_box,
        points=points,
        out=output,
        force=force,
        picture=render,
        plane=plane,
        dry_run=dry_run,
        threads=threads,
    )
    set_threads(threads)
    parallel = Parallel()
    parallel.install_abort_hook()
    raise typer.Exit(flow_file(parallel, run, options, _print))


Archive = Annotated[
    Path, typer.Argument(help="Archive that compress or a run has made.", metavar="ARCHIVE")
]
Fields = Annotated[
    str | None,
    typer.Option("--fields", metavar="NAMES", help="Only these, e.g. velocity,radius."),
]
Steps = Annotated[
    str | None,
    typer.Option(
        "--steps", metavar="A:B", help="Only frames of steps A up to and without B. [default: all]"
    ),
]
Gids = Annotated[
    str | None,
    typer.Option(
        "--bodies", metavar="A:B", help="Only bodies of gid A up to and without B. [default: all]"
    ),
]


@app.command(epilog=_EPILOG)
def compress(
    source: Annotated[
        str,
        typer.Argument(
            help="Trajectory run.h5, or an array: file.npy, file.h5:/group/name.", metavar="SOURCE"
        ),
    ],
    tolerance: Annotated[
        float,
        typer.Option(
            "--tol",
            help="Relative error in each chunk, Frobenius norm, of fields without a bound of their "
            "own; what bodies keep for life (as radius and shape) is kept exactly.",
        ),
    ] = 1e-2,
    field: Annotated[
        list[str] | None,
        typer.Option(
            "--field",
            metavar="NAME[=BOUND]",
            help="Only this field; BOUND is a relative error such as 1e-3, relative:X, rmse:X, "
            "pointwise:X (in the unit of the field) or exact. May be repeated. [default: all]",
        ),
    ] = None,
    chunk: Annotated[
        int,
        typer.Option("--chunk", help="Frames compressed together: more make a smaller file."),
    ] = 32,
    floor: Annotated[
        float,
        typer.Option(
            "--floor",
            help="A relative bound no longer shrinks with a chunk whose root mean square is below "
            "this share of that of the chunks so far, itself included.",
        ),
    ] = 0.0,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Say what to expect, correlations, ranks and ratios by coder, and end.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", metavar="ARCHIVE", help="File to write. [default: SOURCE's name .tt.h5]"
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the archive behind its last chunk.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace ARCHIVE if it exists.")] = False,
) -> None:
    """Compress a run or an array: mpirun -n P dem-mpi compress SOURCE.

    The error of what the archive holds is measured while it is written, and kept in it; dem-mpi
    info tells it. A signal ends the program behind a chunk with 75; --resume goes on from there.
    """
    from dem_mpi.compress_options import CompressOptions, parse_bounds
    from dem_mpi.parallel import Parallel

    options = CompressOptions(
        source, output, tolerance, parse_bounds(field or ()), chunk, floor, explain, resume, force
    )
    from dem_mpi.compress_command import compress_file

    parallel = Parallel()
    parallel.install_abort_hook()
    compress_file(parallel, options, STOP, _print)


@app.command(epilog=_EPILOG)
def restore(
    archive: Archive,
    fields: Fields = None,
    steps: Steps = None,
    bodies: Gids = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="FILE",
            help="Trajectory .h5, which ParaView opens, or arrays .npz, or one array .npy. "
            "[default: .h5 beside ARCHIVE, .npz without position]",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE if it exists.")] = False,
) -> None:
    """Restore an archive, or a part of it: only that is decoded.

    Where a body is not there, arrays hold NaN, and 0 for whole numbers; .npz has 'present' besides.
    """
    from dem_mpi.compress_options import parse_selection

    selection = parse_selection(fields, steps, bodies)
    from dem_mpi.restore_command import restore_file
    from dem_mpi.solve import end_on_signals

    end_on_signals(STOP)
    _on_one_rank(lambda: restore_file(archive, selection, output, force, _print))


@app.command("slice", epilog=_EPILOG)
def slice_command(
    archive: Archive,
    fields: Fields = None,
    steps: Steps = None,
    bodies: Gids = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE.csv", help="Write them there. [default: print]"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE.csv if it exists.")] = False,
) -> None:
    """Print some values of an archive, a line for each body and step."""
    from dem_mpi.compress_options import parse_selection

    selection = parse_selection(fields, steps, bodies)
    from dem_mpi.restore_command import slice_file

    _on_one_rank(lambda: slice_file(archive, selection, output, force, _print))


@app.command(epilog=_EPILOG)
def compare(
    first: Annotated[
        str, typer.Argument(help="Archive, trajectory, or array as for compress.", metavar="A")
    ],
    second: Annotated[str, typer.Argument(help="What is compared with it.", metavar="B")],
    fields: Fields = None,
) -> None:
    """Say how far B is from A: errors of each field.

    At steps, and of bodies, that both have.
    """
    from dem_mpi.compress_options import parse_selection

    selection = parse_selection(fields, None, None)
    from dem_mpi.restore_command import compare_files

    _on_one_rank(lambda: [_print(line) for line in compare_files(first, second, selection)])


def _on_one_rank(work) -> None:
    """Collective. Do on rank 0 what needs no others; its error on all of them."""
    from dem_mpi.parallel import Parallel

    parallel, error = Parallel(), None
    parallel.install_abort_hook()
    if parallel.rank == 0:
        try:
            work()
        except DemError as caught:
            error = caught
    parallel.raise_together(error)


@app.command(epilog=_EPILOG)
def warmup(
    threads: Annotated[
        int, typer.Option("--threads", min=1, help="Also compile the variants for threads.")
    ] = 1,
) -> None:
    """Compile all kernels into the numba cache, so that no run has to."""
    from time import perf_counter

    from dem_mpi.compression import compile_kernels as compile_coders
    from dem_mpi.flow import compile_kernels
    from dem_mpi.flow_options import FlowOptions
    from dem_mpi.parallel import Parallel
    from dem_mpi.warmup import GENERAL, SPHERES, set_threads, warm_up

    set_threads(threads)
    started = perf_counter()
    parallel, kinds = Parallel(), (SPHERES, GENERAL)
    warm_up(parallel, threads, ("matrix_free", "assembled"), kinds, ("apgd", "scip"))
    warm_up(parallel, threads, kinds=kinds, law="coulomb")
    compile_kernels(parallel, FlowOptions(threads=threads))
    compile_coders(parallel)
    _print(f"kernels ready in {perf_counter() - started:.1f} s")


def _load_on_all(parallel, scene: Path, overrides: list[str] | None):
    """Collective. Read the scene on rank 0; every rank gets it or the same error."""
    from dem_mpi.scenario import load_scenario

    loaded, error = None, None
    if parallel.rank == 0:
        try:
            loaded = load_scenario(scene, overrides or ())
        except DemError as caught:
            error = caught
    parallel.raise_together(error)
    return parallel.broadcast(loaded)


def _rank() -> int:
    """Return the rank as the launcher tells it, without starting MPI."""
    for name in ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "SLURM_PROCID"):
        if os.environ.get(name, "").isdigit():
            return int(os.environ[name])
    return 0


def _print(text: str, error: bool = False) -> None:
    """Print a line once, not once a rank."""
    if _rank() == 0:
        print(text, file=sys.stderr if error else sys.stdout, flush=True)


def main() -> None:
    """Run the command line and exit with its code; errors are one message, printed once."""
    STOP.install()
    if _rank():
        # Help and usage errors come before MPI knows which rank speaks.
        sys.stdout = sys.stdout if _rank() == 0 else open(os.devnull, "w")  # noqa: SIM115
    try:
        code = app(prog_name="dem-mpi", standalone_mode=False)
    except DemError as error:
        _print(f"dem-mpi: error: {error}", error=True)
        code = error.exit_code
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of the command line
            text = error.format_message().rstrip(".")
            _print(f"dem-mpi: error: {text}; see dem-mpi --help", error=True)
            code = InputError.exit_code
        else:
            raise
    STOP.ignore()
    sys.stdout.flush()
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
