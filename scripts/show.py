"""Look at samples: contact sheet, animation, ghosts in one picture, web page, report, or MuJoCo's own viewer.

    python scripts/show.py samples.npz
    python scripts/show.py samples.npz --samples diverse:6 --switch handover --ghost ghosts.png
    python scripts/show.py samples.npz --view
    python scripts/show.py runs/handover-0 --report

Without a file to write and without a viewer it writes `samples_sheet.png` and `samples.gif` beside samples.npz.
Exit status: 0, or 2 for bad input.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

DEFAULT_CHOICE = "diverse:6"


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parse() -> Parser:
    parser = Parser(
        description="Look at samples: contact sheet, animation, ghosts, web page, or MuJoCo's own viewer.",
        epilog="Without --sheet, --gif, --ghost, --report, --view or --mujoco: sheet and GIF are written beside the file.",
    )
    parser.add_argument("file", type=Path, help="samples.npz, or the directory that holds it")
    parser.add_argument(
        "--samples",
        metavar="CHOICE",
        help=f"which samples: 0,5,7 or diverse:6 or all (default {DEFAULT_CHOICE} for pictures, all for viewers)",
    )
    parser.add_argument("--switch", metavar="NAME", help="only this mode switch (viewers: shown first)")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="contact sheet: samples x mode switches")
    parser.add_argument("--gif", type=Path, metavar="FILE.gif", help="animation through the mode switches")
    parser.add_argument("--ghost", type=Path, metavar="FILE.png", help="all in one picture, the first one solid")
    parser.add_argument("--report", action="store_true", help="report.html beside the file, from all files of the run")
    parser.add_argument("--hold-only", action="store_true", help="GIF without the frames between mode switches")
    parser.add_argument("--size", metavar="WxH", help="pixels of one picture (default 320x240, 480x360, 960x720)")
    parser.add_argument("--camera", metavar="A,E[,D]", help="azimuth and elevation in degrees, distance in m")
    parser.add_argument("--view", action="store_true", help="open a web page (needs the extra 'viewer'; no display)")
    parser.add_argument("--port", type=int, metavar="N", help="port of the web page (default 8080)")
    parser.add_argument("--host", metavar="NAME", help="address it is served on (default localhost)")
    parser.add_argument("--mujoco", action="store_true", help="open MuJoCo's own viewer (needs a display)")
    return parser


def choose(samples: SampleSet, text: str) -> list[int]:
    """Positions of the samples that `0,5,7`, `diverse:6` or `all` means. Raises InputError otherwise."""
    wrong = InputError(f"--samples {text!r} is not understood, expected for example 0,5,7 or diverse:6 or all")
    if text == "all":
        return list(range(len(samples)))
    kind, colon, number = text.partition(":")
    try:
        if colon:
            if kind != "diverse" or int(number) < 1:
                raise wrong
            return samples.diverse(int(number)).tolist()
        return [int(part) for part in text.split(",")]
    except InputError:
        raise
    except ValueError:
        raise wrong from None


def parse_size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise InputError(f"--size {text!r} is not understood, expected for example 640x480")
    return int(parts[0]), int(parts[1])


def show(options: argparse.Namespace) -> None:
    if options.report:
        from cgs_jax import report

        if not options.file.exists():
            raise InputError(f"no sample file {options.file}, expected a samples.npz or a directory with one")
        print(report.save_report(options.file if options.file.is_dir() else options.file.parent))
        if not (options.sheet or options.gif or options.ghost or options.view or options.mujoco):
            return
    samples = SampleSet.load(options.file)
    if not len(samples):
        raise InputError(f"{options.file} holds no samples, nothing to show")
    try:
        from cgs_jax import render, viewer
    # A MUJOCO_GL that cannot be had stops MuJoCo's import with whatever the missing library leads to.
    except (ImportError, RuntimeError, AttributeError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        wish = os.environ.get("MUJOCO_GL")
        remedy = f"; MUJOCO_GL is {wish}: unset it or install its library (libegl1 or libosmesa6)" if wish else ""
        raise InputError(f"the libraries for pictures cannot be imported: {reason}{remedy}") from None

    for path, suffix in ((options.sheet, ".png"), (options.ghost, ".png"), (options.gif, ".gif")):
        if path is not None and path.suffix.lower() != suffix:
            raise InputError(f"cannot write {path}: expected a name that ends in {suffix}")
    camera = render.Camera.parse(options.camera) if options.camera else None
    size: dict[str, Any] = {} if options.size is None else {"size": parse_size(options.size)}
    switches = None
    if options.switch is not None:
        render.switch_index(samples, options.switch)
        switches = [options.switch]
    viewing = options.view or options.mujoco
    if not (viewing or options.sheet or options.gif or options.ghost):
        options.sheet, options.gif = render.picture_paths(options.file)
    if options.sheet or options.gif or options.ghost:
        indices = render.check_indices(samples, choose(samples, options.samples or DEFAULT_CHOICE))
        if options.sheet:
            picture = render.contact_sheet(samples, indices, camera=camera, switches=switches, **size)
            print(render.save_png(options.sheet, picture))
        if options.ghost:
            picture = render.ghost_overlay(samples, indices, options.switch, camera=camera, **size)
            print(render.save_png(options.ghost, picture))
        if options.gif:
            between = 0 if options.hold_only else 8
            frames = render.animation(samples, indices, camera=camera, switches=switches, between=between, **size)
            print(render.save_gif(options.gif, frames))
    if not viewing:
        return
    indices = choose(samples, options.samples or "all")
    if options.view:
        port = viewer.DEFAULT_PORT if options.port is None else options.port
        page = viewer.WebViewer(samples, indices, options.switch, camera, options.host or "localhost", port)
        print(f"{len(indices)} samples at {page.url} (Ctrl-C ends)", flush=True)
        page.run()
    else:
        window = viewer.MujocoWindow(samples, indices, options.switch)
        print("right and left: next and previous sample; down and up: mode switch", flush=True)
        window.run()


def main(arguments: Sequence[str] | None = None) -> int:
    try:
        show(parse().parse_args(arguments))
    except InputError as error:
        print(f"show.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
