"""Sample a scene: many full assignments that satisfy every constraint, each checked in double precision.

    python scripts/sample.py --scene banana
    python scripts/sample.py --scene handover --instance 3 --time-budget 30 --out runs/mine
    python scripts/sample.py --scene handover --method "p; t_a; t_b; q_a1; q_a2; q_b2; q_b1"
    python scripts/sample.py --scene handover --check

Writes samples.npz, tree.json and run.json; while it runs, what it has found so far to samples.parts. Exit status: 0 with at
least one sample (also after Ctrl-C), 3 with none (one line says which operator and constraint stopped it), 2 for bad input.
With --check nothing is sampled: 0 when all is well, 2 with one line per fault.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import cgs_jax
from cgs_jax.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from cgs_jax.check import ProblemCheck
    from cgs_jax.record import Recorder
    from cgs_jax.samples import SampleSet
    from cgs_jax.scene import Task

TREES = ("tree", "tree-warm")
WRITTEN = ("samples.npz", "tree.json", "run.json", "profile.json", "samples_sheet.png", "samples.gif", "report.html")

MOST_TASKS = 2**20
"""Tasks of one batch at most: more would only fill the memory."""

APPEND_SECONDS = 1.0
"""Sampling time from one part on disk to the next: what a killed run loses at most."""


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parser() -> Parser:
    parse = Parser(
        prog="sample.py",
        description="Sample a scene: many full assignments that satisfy every constraint.",
        epilog="Exit status: 0 with at least one sample, 3 with none, 2 for bad input. Ctrl-C keeps what was found.",
        allow_abbrev=False,
    )
    parse.add_argument("--scene", required=True, metavar="NAME", help="a scene that comes with the package, or a task file")
    parse.add_argument("--instance", type=int, default=0, metavar="N", help="instance of the scene, from 0 (default 0)")
    parse.add_argument(
        "--check",
        action="store_true",
        help="sample nothing: look for faults (reach, penetrations, rows, gradients, sequences) and draw graph.svg",
    )

    budget = parse.add_argument_group("how long")
    budget.add_argument("--time-budget", type=float, default=10.0, metavar="S", help="seconds of sampling (default 10)")
    budget.add_argument("--num-samples", type=int, metavar="N", help="stop at this many samples")
    budget.add_argument(
        "--coverage-gain",
        type=float,
        metavar="X",
        help="stop when, of the last 1000 samples, a share below X (0 to 1) shows a new value of any variable",
    )

    search = parse.add_argument_group("how")
    search.add_argument(
        "--method",
        default="tree",
        metavar="M",
        help="tree (default), tree-warm, rand, a sequence named in the task file, or a sequence as text: 't; q1; q2'",
    )
    search.add_argument("--batch-size", default="auto", metavar="N", help="tasks of one batch, or auto (default)")
    search.add_argument("--seed", type=int, default=0, metavar="N", help="of the random numbers (default 0)")
    search.add_argument(
        "--deterministic", action="store_true", help="same seed, same samples in the same order, whatever the machine's load"
    )
    search.add_argument(
        "--warm-start",
        action="append",
        default=[],
        metavar="FILE",
        help="tree.json of an earlier run to start from; may be repeated",
    )
    search.add_argument("--c-uct", type=float, metavar="X", help="weight of exploration in the tree")
    search.add_argument(
        "--reward",
        choices=("rate", "rollout"),
        default="rate",
        help="reading of the paper's cost: per finished sample (rate, default) or per rollout",
    )
    search.add_argument("--tries", type=int, metavar="N", help="tries of a partial sample per operator; 1 as in the paper")
    search.add_argument(
        "--collisions",
        choices=("after", "inside"),
        default="after",
        help="check clearances after the solver (default), or keep them inside it (slower, for narrow scenes)",
    )
    search.add_argument("--no-pools", action="store_true", help="drop the whole partial sample on a failure, as in the paper")

    output = parse.add_argument_group("output")
    output.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default runs/SCENE-INSTANCE)")
    output.add_argument("--save-tree", type=Path, metavar="FILE", help="also write the tree's statistics here")
    output.add_argument("--diverse", type=int, metavar="K", help="keep the K samples that differ most, most different first")
    output.add_argument("--json", action="store_true", help="print run.json, and nothing else, on standard output")
    output.add_argument("--quiet", action="store_true", help="print nothing but errors")
    output.add_argument("--profile", action="store_true", help="print and save (profile.json) where the time went")
    output.add_argument("--report", action="store_true", help="write report.html, one page that needs no network")
    output.add_argument("--render", action="store_true", help="write a contact sheet and a GIF of diverse samples")
    output.add_argument("--view", action="store_true", help="show the samples in a web page at the end")
    output.add_argument("--no-cache", action="store_true", help="keep no compiled programs and seed tables on disk")
    return parse


# ------------------------------------------------------------------ checks before anything heavy is imported


def check_numbers(options: argparse.Namespace) -> None:
    """Raises InputError for numbers that make no sense; turns the batch size into a number, or None for auto."""
    if not options.time_budget > 0:
        raise InputError(f"--time-budget is {options.time_budget:g}, expected more than 0 seconds")
    for name in ("num_samples", "tries", "diverse"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InputError(f"--{name.replace('_', '-')} is {value}, expected at least 1")
    if options.coverage_gain is not None and not 0 < options.coverage_gain < 1:
        raise InputError(f"--coverage-gain is {options.coverage_gain:g}, expected a share between 0 and 1")
    if not 0 <= options.seed < 2**32:
        raise InputError(f"--seed is {options.seed}, expected 0 to {2**32 - 1}")
    if options.c_uct is not None and not (options.c_uct > 0 and math.isfinite(options.c_uct)):
        raise InputError(f"--c-uct is {options.c_uct:g}, expected a number above 0")
    if options.batch_size == "auto":
        options.batch_size = None
    else:
        try:
            options.batch_size = int(options.batch_size)
        except ValueError:
            raise InputError(f"--batch-size is '{options.batch_size}', expected a whole number or auto") from None
        if options.batch_size < 1:
            raise InputError(f"--batch-size is {options.batch_size}, expected at least 1")
        if options.batch_size > MOST_TASKS:
            raise InputError(f"--batch-size is {options.batch_size}, expected at most {MOST_TASKS}")
    if options.check:
        for name in ("profile", "report", "render", "view", "diverse", "save_tree"):
            if getattr(options, name):
                raise InputError(f"--{name.replace('_', '-')} has no effect with --check, which samples nothing")
    if options.warm_start and options.method not in TREES:
        raise InputError(f"--warm-start has no effect on method '{options.method}', expected one of: {', '.join(TREES)}")


def check_scene(options: argparse.Namespace) -> Task:
    """The task, its instance known to exist; imports nothing of JAX."""
    from cgs_jax.scene import load_task

    task = load_task(options.scene)
    if not 0 <= options.instance < len(task.instances):
        raise InputError(
            f"instance {options.instance} of scene '{task.name}' does not exist, expected 0 to {len(task.instances) - 1}"
        )
    return task


def check_viewers(options: argparse.Namespace) -> None:
    """Raises InputError when pictures or the web page that were asked for cannot be made on this machine."""
    if options.view and importlib.util.find_spec("viser") is None:
        raise InputError('--view needs the package viser, install it with: pip install -e ".[viewer]"')
    if options.render:
        from cgs_jax import render

        render.backend()
    if options.report:
        from cgs_jax import report

        report.require_plots()


@contextlib.contextmanager
def writable(*folders: Path) -> Iterator[None]:
    """Makes the folders and tries to write there; folders made here go again when the block fails.

    Raises InputError when one cannot be written.
    """
    made: list[Path] = []
    try:
        for folder in folders:
            missing = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
            try:
                for path in reversed(missing):
                    path.mkdir()
                    made.append(path)
                with tempfile.TemporaryFile(dir=folder):
                    pass
                for path in (folder / name for name in WRITTEN):
                    if path.is_dir():
                        raise InputError(f"cannot write to {path}: it is a folder, expected a file or nothing")
            except OSError as error:
                raise InputError(f"cannot write to {folder}: {error.strerror or error}") from None
        yield
    except BaseException:
        for path in reversed(made):
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


# ------------------------------------------------------------------ the live line


class LiveLine:
    """What the run is doing, in one line of the terminal's error stream; silent where that is no terminal."""

    def __init__(self, shown: bool) -> None:
        self._live: Any = None
        self.phase, self.detail = "loading", ""
        self._since = time.perf_counter()
        self._looked = 0.0
        if shown and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(get_renderable=self._text, console=Console(stderr=True), refresh_per_second=8, transient=True)

    def __enter__(self) -> LiveLine:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def enter_phase(self, phase: str, detail: str = "") -> None:
        """The clock starts anew when the phase is another."""
        if phase != self.phase:
            self._since = time.perf_counter()
        self.phase, self.detail = phase, detail

    def look(self, record: Recorder) -> None:
        """Reads the record, at most a few times a second: asking for the best sequence costs host time."""
        now = time.perf_counter()
        if self._live is None or now - self._looked < 0.5:
            return
        self._looked = now
        elapsed = now - self._since
        best = record.best_sequences(1)
        best_text = f" · best: {best[0][0]}" if best else ""
        self.detail = f"{record.count} samples · {record.count / max(elapsed, 1e-9):.0f}/s{best_text}"

    def _text(self) -> Any:
        from rich.text import Text

        seconds = time.perf_counter() - self._since
        parts = [f"{self.phase} {seconds:5.1f} s", *([self.detail] if self.detail else [])]
        return Text(" · ".join(parts), no_wrap=True, overflow="ellipsis")


# ------------------------------------------------------------------ running


INTERRUPTED = "sample.py: interrupted before the samples were written"


@contextlib.contextmanager
def on_interrupt(handler: Any) -> Iterator[None]:
    """Ctrl-C is answered by this handler within the block."""
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def leave(*_: object) -> NoReturn:
    """Ends the process at once: an exception would be lost inside a library that is being imported, or crash it."""
    restored = b"\r\x1b[2K\x1b[?25h" if sys.stderr.isatty() else b""
    os.write(sys.stderr.fileno(), restored + INTERRUPTED.encode() + b"\n")
    os._exit(3)


def run(options: argparse.Namespace) -> int:
    """Checks, samples, writes, reports; returns the exit status. Raises InputError for bad input."""
    check_numbers(options)
    with on_interrupt(leave):
        task = check_scene(options)
        check_viewers(options)
    folder = options.out if options.out is not None else Path("runs") / f"{task.name}-{options.instance}"
    if options.check:
        return check(options, folder)
    with LiveLine(not options.quiet) as line:
        with on_interrupt(leave):
            if not options.no_cache:
                cgs_jax.enable_disk_cache()
            problem = cgs_jax.load_problem(options.scene, options.instance)
            prior = [cgs_jax.load_tree(path) for path in options.warm_start]
            settings = cgs_jax.SamplerSettings(
                pools=not options.no_pools,
                deterministic=options.deterministic,
                collisions=options.collisions,
                **{name: getattr(options, name) for name in ("batch_size", "tries") if getattr(options, name) is not None},
            )
            sampling = cgs_jax.Run(
                problem, options.method, options.seed, settings, prior, c_uct=options.c_uct, reward=options.reward
            )
        folders = [folder] + ([options.save_tree.parent] if options.save_tree else [])
        if options.save_tree and options.save_tree.is_dir():
            raise InputError(f"cannot write to {options.save_tree}: it is a folder, expected the name of a file")
        with writable(*folders):
            drive(sampling, options, line, folder)
            line.enter_phase("writing")
            with on_interrupt(signal.SIG_IGN):
                samples = write(sampling.record, options, folder)
            # Ctrl-C does without what is still to be drawn.
            with contextlib.suppress(KeyboardInterrupt):
                draw(samples, options, folder)
    return tell(sampling.record, samples, options, folder)


def check(options: argparse.Namespace, folder: Path) -> int:
    """Looks for faults without sampling, draws the graph, prints both; returns the exit status."""
    from cgs_jax import diagram

    with LiveLine(not options.quiet) as line, writable(folder):
        with on_interrupt(leave):
            problem = cgs_jax.load_problem(options.scene, options.instance)
        line.enter_phase("checking")
        prior = [cgs_jax.load_tree(path) for path in options.warm_start]
        found = cgs_jax.check_problem(problem, options.seed)
        if found.pruned:
            cgs_jax.make_chooser(problem, options.method, options.seed, prior)
        diagram.save(folder / "graph.svg", diagram.describe(problem.graph, problem.scene.task))
    if options.json:
        print(json.dumps(found.as_json(), indent=1))
    elif not options.quiet:
        console = make_console()
        print_check(console, found)
        console.print(f"\nGraph drawn in {folder / 'graph.svg'}", soft_wrap=True)
    sys.stdout.flush()
    for fault in found.faults:
        print(f"sample.py: fault: {fault}", file=sys.stderr)
    return 2 if found.faults else 0


def drive(sampling: cgs_jax.Run, options: argparse.Namespace, line: LiveLine, folder: Path) -> None:
    """Runs to the end of the budget; the first Ctrl-C ends it early, a second one at once.

    What an earlier run left goes when sampling starts; from then on samples are written as they come.
    """

    def stop(*_: object) -> None:
        sampling.stop()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, stop)
    line.enter_phase("compiling")
    appended = -math.inf
    try:
        for event in sampling.events(options.time_budget, options.num_samples, options.coverage_gain):
            kind = type(event).__name__
            if kind == "Compiled" and line.phase == "compiling":
                line.enter_phase("compiling", f"{len(sampling.record.programs)} programs ready")
            elif kind == "Started":
                clear(folder)
                line.enter_phase("sampling", "0 samples")
            elif line.phase == "sampling":
                line.look(sampling.record)
            if kind == "Found" and time.perf_counter() - appended > APPEND_SECONDS:
                sampling.record.append(folder)
                appended = time.perf_counter()
    finally:
        signal.signal(signal.SIGINT, before)


def clear(folder: Path) -> None:
    """Removes the files of an earlier run."""
    from cgs_jax.samples import remove_parts

    for name in WRITTEN:
        (folder / name).unlink(missing_ok=True)
    remove_parts(folder)


def write(record: Recorder, options: argparse.Namespace, folder: Path) -> SampleSet:
    """Writes all files; returns the samples that were kept."""
    samples = record.samples()
    if options.diverse is not None:
        samples = samples.select(samples.diverse(options.diverse))
    try:
        record.save(folder, samples)
        if options.save_tree:
            record.save_tree(options.save_tree)
        if options.profile:
            from cgs_jax.utilisation import utilisation

            # After the samples: it takes seconds.
            record.save_profile(folder / "profile.json", utilisation(record))
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror or error}") from None
    return samples


def draw(samples: SampleSet, options: argparse.Namespace, folder: Path) -> None:
    """Draws the pictures and the report that were asked for, from what is written."""
    if options.render and len(samples):
        from cgs_jax import render

        render.save_pictures(samples, folder)
    if options.report:
        from cgs_jax import report

        report.save_report(folder)


# ------------------------------------------------------------------ the closing words


def tell(record: Recorder, samples: SampleSet, options: argparse.Namespace, folder: Path) -> int:
    """Prints what was found and where it is; returns the exit status."""
    if options.json:
        print((folder / "run.json").read_text(encoding="utf-8"), end="")
    elif not options.quiet:
        console = make_console()
        print_summary(console, record, samples)
        if options.profile:
            print_profile(console, json.loads((folder / "profile.json").read_text(encoding="utf-8")))
        console.print(f"\nWritten to {folder}", soft_wrap=True)
    sys.stdout.flush()
    if not record.count:
        print(f"sample.py: no sample: {record.diagnosis()}", file=sys.stderr)
        return 3
    if options.view:
        from cgs_jax import viewer

        page = viewer.WebViewer(samples)
        print(f"{len(samples)} samples at {page.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
        page.run()
    return 0


def make_console() -> Console:
    """Standard output. A pipe has no width of its own; what reads it can cut lines, but not join them."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 140, highlight=False)


def table(*columns: str) -> Table:
    """An empty table; the first column is text, the others are numbers."""
    from rich import box
    from rich.table import Table

    result = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for i, name in enumerate(columns):
        result.add_column(name, justify="right" if i else "left", overflow="fold")
    return result


def percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def print_summary(console: Console, record: Recorder, samples: SampleSet) -> None:
    """Rate, times, success per operator with its causes, best sequences, spread of the configurations."""
    meta = record.meta()
    kept = f", kept {len(samples)}" if len(samples) < record.count else ""
    console.print(
        f"[bold]{meta['scene']}[/] instance {meta['instance']}, method {meta['method']}, seed {meta['seed']}: "
        f"[bold]{record.count} samples in {record.elapsed:.1f} s, {record.rate:.1f}/s[/]{kept} (ended by {record.reason})",
        soft_wrap=True,
    )
    console.print(
        f"before sampling {record.startup_seconds:.1f} s, compiling {record.compile_seconds:.1f} s "
        f"({len(record.programs)} programs, partly beside sampling), audit rejected {record.rejected}",
        soft_wrap=True,
    )
    operators = table("operator (new | given)", "tasks", "success", "condition feasible", "solver on those", "stopped by")
    for name, operator in record.operators.items():
        causes = operator.causes
        worst = sorted(operator.failures, key=operator.failures.__getitem__, reverse=True)[:2]
        operators.add_row(
            name,
            str(operator.tasks),
            percent(operator.success_rate),
            percent(causes[0] if causes else None),
            percent(causes[1] if causes else None),
            ", ".join(worst),
        )
    console.print()
    console.print(operators)
    best = record.best_sequences(3)
    if record.count and best:
        sequences = table("best sequences", "predicted /s")
        for text, rate in best:
            sequences.add_row(text, f"{rate:.0f}")
        console.print()
        console.print(sequences)
    if len(samples):
        spread = table("samples of", "at a joint limit", "near-duplicates")
        for name, shares in record.spread(samples).items():
            spread.add_row(name, percent(shares["limit_share"]), percent(shares["duplicate_share"]))
        console.print()
        console.print(spread)


def print_profile(console: Console, profile: Mapping[str, Any]) -> None:
    """Where the time went, and how much of the machine was used."""
    operators = table("profile (new | given)", "calls", "tasks", "iterations/task", "success", "us/task", "device s", "share")
    total = max(sum(entry["device_seconds"] for entry in profile["operators"].values()), 1e-12)
    for name, entry in profile["operators"].items():
        operators.add_row(
            name,
            str(entry["calls"]),
            str(entry["tasks"]),
            f"{entry['iterations_per_task']:.1f}",
            percent(entry["success_rate"]),
            f"{entry['microseconds_per_task']:.1f}",
            f"{entry['device_seconds']:.2f}",
            percent(entry["device_seconds"] / total),
        )
    console.print()
    console.print(operators)
    shares = table("share of the workers' time", "")
    for name, share in profile["shares_of_worker_time"].items():
        shares.add_row(name, percent(share))
    console.print()
    console.print(shares)
    used = profile["utilisation"]
    console.print(
        f"\nuseful lane-iterations {percent(used['useful_share'])}; {used['flops'] / 1e9:.1f} GFLOP/s, "
        f"{percent(used['share_of_peak'])} of the {used['peak_flops'] / 1e9:.0f} GFLOP/s of a matrix product now",
        soft_wrap=True,
    )
    programs = table("programs", "s to compile or load")
    for program in sorted(profile["programs"], key=lambda entry: -entry["seconds"]):
        programs.add_row(program["name"], f"{program['seconds']:.2f}")
    console.print()
    console.print(programs)


def print_check(console: Console, found: ProblemCheck) -> None:
    """What was looked at: names, constraints, reach, penetrations, the pruned graph and its sequences."""
    robots = ", ".join(f"{name} ({joints} joints)" for name, joints in found.robots.items())
    console.print(
        f"[bold]{found.scene}[/] instance {found.instance}: {robots}; {', '.join(found.objects)}; "
        f"switches {', '.join(found.switches)}",
        soft_wrap=True,
    )
    constraints = table("constraint", "dofs", "equality rows", "inequality rows", "rank", "gradient off by")
    for row in found.constraints:
        rank, slope = ("-", "-") if row.rank is None else (str(row.rank), f"{row.slope_error:.0e}")
        constraints.add_row(row.name, str(row.dof), str(row.equality_rows), str(row.inequality_rows), rank, slope)
    constraints.add_section()
    constraints.add_row("all together", str(found.dof), str(found.equality_rows), "", str(found.rank), "")
    console.print()
    console.print(constraints)
    reaches = table("to be reached", "by", "distance m", "reach m", "nearest of the table m")
    for reach in found.reaches:
        numbers = (reach.distance, reach.reach, reach.gap)
        reaches.add_row(reach.pose, f"{reach.robot}/{reach.frame}", *(f"{number:.2f}" for number in numbers))
    console.print()
    console.print(reaches)
    console.print()
    overlaps = [f"{o.first} and {o.second} by {1e3 * o.depth:.1f} mm ({o.where})" for o in found.overlaps]
    console.print(f"penetrations at home and at goals: {'; '.join(overlaps) or 'none'}", soft_wrap=True)
    more = "" if found.counted_all else "more than "
    console.print(
        f"transitions {found.complete} -> {more}{found.pruned}, {found.problems} conditional problems, at most "
        f"{found.programs} programs; sequences {', '.join(found.sequences) or 'none named'}"
        f"{'' if any(found.sequences.values()) else ', all paths of the graph' * bool(found.sequences)}",
        soft_wrap=True,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit status."""
    try:
        return run(parser().parse_args(arguments))
    except InputError as error:
        print(f"sample.py: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(INTERRUPTED, file=sys.stderr)
        return 3


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    if "jax" in sys.modules:
        cgs_jax.end_process(status)
    sys.exit(status)
