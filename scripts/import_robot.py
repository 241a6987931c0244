"""Make a scene of your own robot: an MJCF or URDF file in, a task that can be sampled out, and a picture to check the fit.

    python scripts/import_robot.py arm.urdf --tool link7:0,0,0.1 --out scenes/mine
    python scripts/import_robot.py arm.xml --gripper gripper.xml --out scenes/mine

Meshes, cylinders and ellipsoids become boxes and capsules that enclose them. Writes NAME.xml, NAME.toml and NAME_fit.png to
the folder NAME and prints what was decided. Exit status: 0, or 2 for bad input (one line, nothing written).
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from cgs_jax import fitting, starter
from cgs_jax.errors import InputError
from cgs_jax.render import Picture, save_png
from cgs_jax.scene import load_scene


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parser() -> Parser:
    parse = Parser(
        prog="import_robot.py",
        description="Make a scene of your own robot: fitted primitives, a box, a goal, a task, a picture.",
        epilog="docs/own_robot.md is the tutorial.",
        allow_abbrev=False,
    )
    parse.add_argument("robot", type=Path, help="MJCF or URDF file of the arm")
    parse.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write; its name is the scene's name")
    parse.add_argument("--overwrite", action="store_true", help="replace what the folder holds under these names")
    parse.add_argument("--no-picture", action="store_true", help="draw nothing (where there is no OpenGL)")

    tool = parse.add_argument_group("where the tool is (SITE, or BODY:x,y,z in metres in the body's frame)")
    tool.add_argument("--tool", metavar="PLACE", help="between the finger tips, or at the end of the suction cup")
    tool.add_argument("--approach", default="z", metavar="AXIS", help="its axis that points at objects (z); also --approach=-x")
    tool.add_argument("--grasp", choices=("two_finger", "touch"), help="default: two_finger if there are fingers, else touch")
    tool.add_argument("--gripper", type=Path, metavar="FILE", help="MJCF or URDF of a gripper; --tool is then in its file")
    tool.add_argument("--flange", metavar="PLACE", help="with --gripper: where on the arm it is mounted")

    fit = parse.add_argument_group("the fit")
    fit.add_argument("--home", action="append", default=[], metavar="JOINT=VALUE", help="home value of a joint; repeatable")
    fit.add_argument(
        "--shape", action="append", default=[], metavar="NAME=SHAPE", help="box, capsule, sphere or halves for a body or geom"
    )
    fit.add_argument("--skip-missing", action="store_true", help="leave out geoms whose mesh files are missing (URDF)")
    return parse


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name and value):
            raise InputError(f"{option} '{text}' is not understood, expected NAME=VALUE")
        found[name] = value
    return found


def home_values(texts: Sequence[str]) -> dict[str, float]:
    found = {}
    for name, value in pairs("--home", texts).items():
        try:
            found[name] = float(value)
        except ValueError:
            raise InputError(f"--home '{name}={value}' is no number") from None
    return found


def shape_wishes(texts: Sequence[str]) -> dict[str, fitting.Wish]:
    found: dict[str, fitting.Wish] = {}
    for name, value in pairs("--shape", texts).items():
        wish = next((wish for wish in fitting.WISHES if wish == value), None)
        if wish is None:
            raise InputError(f"--shape '{name}={value}' is no shape, expected one of: {', '.join(fitting.WISHES)}")
        found[name] = wish
    return found


def read(options: argparse.Namespace) -> fitting.FittedRobot:
    home, shapes = home_values(options.home), shape_wishes(options.shape)
    if options.gripper is None:
        if options.flange is not None:
            raise InputError("--flange says where a gripper is mounted; give the gripper's file with --gripper")
        return fitting.read_robot(
            options.robot, options.tool, home, shapes, options.approach, skip_missing=options.skip_missing
        )
    skip = options.skip_missing
    of_arm = fitting.element_names(options.robot, skip)
    arm = fitting.read_robot(
        options.robot,
        options.flange,
        {name: value for name, value in home.items() if name in of_arm},
        {name: value for name, value in shapes.items() if name in of_arm},
        skip_missing=skip,
    )
    gripper = fitting.read_robot(
        options.gripper,
        options.tool,
        {name: value for name, value in home.items() if name not in of_arm},
        {name: value for name, value in shapes.items() if name not in of_arm},
        options.approach,
        movable=False,
        skip_missing=skip,
    )
    return fitting.graft(arm, gripper)


def draw(robot: fitting.FittedRobot) -> Picture:
    try:
        return starter.fit_picture(robot)
    except InputError as error:
        raise InputError(f"{error}; or do without the picture: --no-picture") from None


def tell(robot: fitting.FittedRobot, start: starter.Starter) -> None:
    print(f"{robot.name}: {len(robot.joints)} joints, {sum(len(link.primitives) for link in robot.links)} primitives")
    for note in (*robot.notes, *start.notes):
        print(f"  {note}")
    print(f"  grasp: {start.grasp}, box of {' x '.join(f'{2000 * half:.0f}' for half in start.box)} mm")
    fitted = list(fitting.loosest(robot))
    if fitted:
        print("fitted, with the volume over that of the mesh's convex hull (loosest first):")
    for _, primitive in fitted:
        print(f"  {primitive.excess:5.2f}  {primitive.kind:8s} {primitive.source}")
    if start.overlaps:
        print("excluded from contact; where a pair is far apart, look at the picture:")
    for overlap in start.overlaps:
        print(f"  {overlap.first}, {overlap.second}: {overlap.reason}")
    print(f"{100 * start.free:.0f} % of random configurations are free of collisions; checked pairs that overlap most often:")
    for overlap in start.busiest:
        print(f"  {overlap.first}, {overlap.second}: {overlap.reason}")


def write(options: argparse.Namespace) -> None:
    out = options.out.resolve()
    name = out.name
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise InputError(f"--out ends in '{name}', expected a name for the scene of letters, digits and underscores")
    files = [f"{name}.xml", f"{name}.toml"] + ([] if options.no_picture else [f"{name}_fit.png"])
    taken = [file for file in files if (out / file).exists()]
    if taken and not options.overwrite:
        raise InputError(f"{out} already holds {', '.join(taken)}; give another --out or --overwrite")
    robot = read(options)
    start = starter.start_scene(robot, name, options.grasp)
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            (folder / f"{name}.xml").write_text(start.mjcf, encoding="utf-8")
            (folder / f"{name}.toml").write_text(start.task, encoding="utf-8")
            load_scene(folder / f"{name}.toml")
            if not options.no_picture:
                save_png(folder / f"{name}_fit.png", draw(robot))
            out.mkdir(parents=True, exist_ok=True)
            for file in files:
                shutil.copyfile(folder / file, out / file)
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror or error}") from None
    tell(robot, start)
    for file in files:
        print(options.out / file)
    print(f"next: python scripts/sample.py --scene {options.out / name}.toml")


def main(arguments: Sequence[str] | None = None) -> int:
    try:
        write(parser().parse_args(arguments))
    except InputError as error:
        print(f"import_robot.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
