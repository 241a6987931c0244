"""Run the paper's experiments on this machine and write a report beside the printed numbers.

    python scripts/reproduce.py --scene handover --quick
    python scripts/reproduce.py --out runs/reproduce

Finished runs are kept in the folder and skipped: after an interruption, give the same command again.
Exit status: 0, 2 for bad input, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cgs_jax
from cgs_jax.programs import end_process

SCENES = ("handover", "banana")


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Run the paper's experiments and write a report.")
    parser.add_argument("--scene", choices=(*SCENES, "all"), default="all", help="which scene (default all)")
    parser.add_argument("--quick", action="store_true", help="few instances and short runs: at most 10 minutes")
    out = Path("runs/reproduce")
    parser.add_argument("--out", type=Path, default=out, metavar="DIR", help=f"folder (default {out})")
    parser.add_argument("--seconds", type=float, metavar="S", help="sampling time of each run")
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds of the main comparison")
    parser.add_argument("--instances", type=int, metavar="N", help="only the first N instances")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    logging.disable(logging.WARNING)  # importing mjx warns that warp is not installed

    from cgs_jax.experiments import FULL, QUICK, Study, write_report

    for name in ("seconds", "seeds", "instances"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            print(f"--{name} is {value}, expected more than 0", file=sys.stderr)
            return 2
    given = {name: getattr(options, name) for name in ("seconds", "seeds", "instances") if getattr(options, name)}
    budget = replace(QUICK if options.quick else FULL, **given)
    scenes = SCENES if options.scene == "all" else (options.scene,)
    paper = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["scenes"]
    # A cache of its own: the first run in a folder compiles for real and says how long it takes.
    cgs_jax.enable_disk_cache(options.out / "cache")
    try:
        study = Study(options.out, scenes, budget, paper)
        study.claim_folder()
        run(study)
        print("writing the report ...", flush=True)
        command = "python scripts/reproduce.py " + " ".join(sys.argv[1:] if arguments is None else arguments)
        print(write_report(study, command))
    except cgs_jax.InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted; finished runs are kept in {options.out}, the same command goes on", file=sys.stderr)
        return 130
    return 0


def run(study) -> None:
    """Makes the missing runs behind a progress bar."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    print(f"estimated time: {study.estimate() / 60:.0f} min on {os.cpu_count()} cores", flush=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns) as bar:
        task = bar.add_task("starting", total=None)
        for step in study.execute():
            bar.update(task, description=step.title, completed=step.done, total=step.total)


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # After Ctrl-C, programs may still be waiting to be compiled: a normal exit would wait for them.
    end_process(status)
