"""Pictures of samples, drawn off screen by C MuJoCo: contact sheet, animation, ghosts of diverse samples.

All that is drawn comes from the sample set itself: its MJCF text and one qpos per mode switch. Images are arrays
(H, W, 3) uint8, row 0 on top. Lengths in metres, angles of cameras in degrees.

OpenGL without a display comes from EGL or, where that fails, from OSMesa. Which of them works is found out in a fresh
process, because PyOpenGL is bound to the first one it meets and a broken driver may take its process down. A MUJOCO_GL
that the user has set is kept.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
Size = tuple[int, int]

SHEET_SIZE: Size = (320, 240)
ANIMATION_SIZE: Size = (480, 360)
GHOST_SIZE: Size = (960, 720)
_SMALLEST, _LARGEST = 64, 4096
_LARGEST_SHEET = 100_000_000
"""Pixels: about 300 MB in memory, and what image viewers still open."""

_INK, _FAINT, _PAPER, _ACCENT = (28, 32, 38), (110, 116, 124), (255, 255, 255), (196, 78, 32)


# ---------------------------------------------------------------------------------------------------------------------
# OpenGL without a display

_INSTALL = {
    "egl": "apt install libegl1 libgl1-mesa-dri",
    "osmesa": "apt install libosmesa6",
}
_PROBE = """
import mujoco
from mujoco.{backend} import GLContext
context = GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100)
"""


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no reason given"


def _failure(backend: str) -> str | None:
    """Why this backend cannot draw in a fresh process, or None when it can."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE.format(backend=backend)],
            env=os.environ | {"MUJOCO_GL": backend},
            capture_output=True,
            text=True,
            timeout=120,
        )
    except subprocess.TimeoutExpired:
        return "no answer within 120 s"
    if done.returncode < 0:
        return f"ended by signal {-done.returncode}"
    return _last_line(done.stderr).split(". ")[0] if done.returncode else None


@functools.cache
def _working_backend() -> str:
    failures = {}
    for backend in _INSTALL:
        failures[backend] = _failure(backend)
        if failures[backend] is None:
            return backend
    raise InputError(
        f"pictures need OpenGL without a display, and neither EGL ({failures['egl']}) nor OSMesa"
        f" ({failures['osmesa']}) works; install one: '{_INSTALL['egl']}' or '{_INSTALL['osmesa']}'"
    )


def backend() -> str:
    """Module that makes OpenGL contexts: "egl", "osmesa", or "gl_context" (what MuJoCo itself chose).

    Linux: MUJOCO_GL where it is set, else the first of EGL and OSMesa that works. Elsewhere MuJoCo chooses.
    Raises InputError when neither works (what to install) or MUJOCO_GL switches OpenGL off.
    """
    wish = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wish in ("disable", "disabled", "off", "false", "0"):
        raise InputError(f"MUJOCO_GL={wish} switches pictures off; unset it, or set it to egl or osmesa")
    if platform.system() != "Linux" or wish in ("glfw", "glx"):
        return "gl_context"
    return wish if wish in _INSTALL else _working_backend()


@contextlib.contextmanager
def _open_gl(size: Size) -> Iterator[None]:
    """A current OpenGL context for as long as the block lasts."""
    name = backend()
    platform_before = os.environ.get("PYOPENGL_PLATFORM")
    try:
        context = importlib.import_module(f"mujoco.{name}").GLContext(*size)
        context.make_current()
    # What a missing or broken driver raises depends on the driver: ImportError, AttributeError, RuntimeError, GLError.
    except Exception as error:
        install = f"; install it ('{_INSTALL[name]}') or unset MUJOCO_GL" if name in _INSTALL else ""
        raise InputError(f"OpenGL by {name} does not work here: {_last_line(str(error))}{install}") from None
    finally:
        # MuJoCo's module sets it for itself; a child process may need the other backend.
        if platform_before is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
    try:
        yield
    finally:
        context.free()


# ---------------------------------------------------------------------------------------------------------------------
# What is drawn


def compile_model(samples: SampleSet) -> mujoco.MjModel:
    """The sample set's MJCF as a model; one without lights or sky is drawn in daylight instead of in the dark.

    Raises InputError when it does not compile or qpos is of another length.
    """
    try:
        spec = mujoco.MjSpec.from_string(samples.mjcf)
        skybox = mujoco.mjtTexture.mjTEXTURE_SKYBOX
        if all(texture.type != skybox for texture in spec.textures):
            sky = spec.add_texture(name="daylight_sky", type=skybox, width=64, height=384)
            sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
            sky.rgb1, sky.rgb2 = (0.85, 0.90, 0.95), (0.60, 0.68, 0.78)
        model = spec.compile()
    except ValueError as error:
        raise InputError(f"the sample set's MJCF does not compile: {_last_line(str(error))}") from None
    if not model.nlight:
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
    if model.nq != samples.qpos.shape[2]:
        raise InputError(f"the samples have {samples.qpos.shape[2]} numbers per qpos, the MJCF expects {model.nq}")
    return model


def check_indices(samples: SampleSet, indices: Sequence[int]) -> list[int]:
    """The indices as a list. Raises InputError when there is none, or one is no position of a sample."""
    if not len(samples):
        raise InputError("no samples in this set, nothing to show")
    chosen = [int(index) for index in indices]
    if not chosen:
        raise InputError(f"no sample chosen, available: 0 to {len(samples) - 1}")
    for index in chosen:
        if not 0 <= index < len(samples):
            raise InputError(f"no sample {index}, available: 0 to {len(samples) - 1}")
    return chosen


def switch_index(samples: SampleSet, name: str) -> int:
    """Position of a mode switch. Raises InputError for an unknown name."""
    if name not in samples.mode_switches:
        raise InputError(f"unknown mode switch {name!r}, available: {', '.join(samples.mode_switches)}")
    return samples.mode_switches.index(name)


def worst_violation(samples: SampleSet, index: int) -> tuple[float, str] | None:
    """Largest violation (m or rad) of a sample and its constraint's name; None where none is recorded."""
    if not samples.constraints:
        return None
    worst = int(np.argmax(samples.violation[index]))
    return float(samples.violation[index, worst]), samples.constraints[worst]


def _visible(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Geoms (ngeom,) that MuJoCo draws by default: groups 0 to 2, not fully transparent."""
    return (np.asarray(model.geom_group) < 3) & (np.asarray([geom_colour(model, i)[3] for i in range(model.ngeom)]) > 0)


def geom_colour(model: mujoco.MjModel, geom: int) -> NDArray[np.float32]:
    """RGBA (4,) in 0..1 of a geom, of its material where it has one and no colour of its own."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    # MuJoCo's rule: the material's colour holds where the geom's is the default grey.
    return np.array(model.mat_rgba[material] if material >= 0 and np.allclose(own, (0.5, 0.5, 0.5, 1)) else own)


# ---------------------------------------------------------------------------------------------------------------------
# Camera


@dataclass(frozen=True)
class Camera:
    """A free camera as MuJoCo has it; whatever is None is chosen so that everything shown lies in the picture.

    azimuth, elevation: degrees; azimuth 90 looks along +y, elevation -90 straight down. distance: metres from lookat.
    lookat: (3,) world position, metres.
    """

    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    lookat: tuple[float, float, float] | None = None

    @classmethod
    def parse(cls, text: str) -> Camera:
        """`azimuth,elevation` or `azimuth,elevation,distance`, degrees and metres. Raises InputError otherwise."""
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not np.all(np.isfinite(numbers)):
            raise InputError(f"camera {text!r} is not azimuth,elevation[,distance], expected for example 120,-25,2.5")
        if not -90 <= numbers[1] <= 90:
            raise InputError(f"camera elevation {numbers[1]:g} is outside -90 to 90 degrees")
        if len(numbers) == 3 and numbers[2] <= 0:
            raise InputError(f"camera distance {numbers[2]:g} m is not positive")
        return cls(*numbers)


def _extent(model: mujoco.MjModel, configurations: Floats) -> Floats:
    """World points (P, 3) that a picture of these configurations (M, nq) must hold.

    Corners of every visible geom's box and the sites. What is fixed and larger than all that moves (a floor, a long
    table) may run out of the picture.
    """
    data = mujoco.MjData(model)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    corners = np.asarray(model.geom_aabb)[:, None, :3] + np.asarray(model.geom_aabb)[:, None, 3:] * signs
    bounded = _visible(model) & (np.asarray(model.geom_type) != int(mujoco.mjtGeom.mjGEOM_PLANE))
    weld = np.asarray(model.body_weldid)
    moves = weld[np.asarray(model.geom_bodyid)] != 0
    moving, sites = [], []
    for qpos in configurations:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        world = data.geom_xpos[:, None] + np.einsum("gij,gkj->gki", data.geom_xmat.reshape(-1, 3, 3), corners)
        moving.append(world[bounded & moves].reshape(-1, 3))
        sites.append(np.array(data.site_xpos[np.asarray(model.site_group) < 3]))
    points = np.concatenate([*moving, *sites])
    if len(points):
        radius = np.linalg.norm(np.ptp(points, axis=0)) / 2
        fixed = bounded & ~moves & (np.asarray(model.geom_rbound) <= radius)
    else:
        fixed = bounded
    points = np.concatenate([points, world[fixed].reshape(-1, 3)])
    return points if len(points) else np.array([model.stat.center])


def frame_camera(model: mujoco.MjModel, configurations: Floats, size: Size, wish: Camera | None = None) -> Camera:
    """The camera with every field set: what `wish` leaves open makes all of the configurations (M, nq) fit.

    Angles not given are those of the MJCF's <visual><global azimuth elevation>.
    """
    wish = wish or Camera()
    look = model.vis.global_
    azimuth, elevation = wish.azimuth, wish.elevation
    if azimuth is None or elevation is None:
        # MuJoCo's own default looks steeply along one axis, which flattens most scenes.
        standard = (look.azimuth, look.elevation) == (90, -45)
        azimuth = (125.0 if standard else float(look.azimuth)) if azimuth is None else azimuth
        elevation = (-25.0 if standard else float(look.elevation)) if elevation is None else elevation
    a, e = np.deg2rad([azimuth, elevation])
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    axes = np.array([right, np.cross(right, forward), forward])
    x, y, depth = axes @ _extent(model, configurations).T
    # Each side of the picture bounds the eye by one linear inequality; the nearest eye that keeps all four is closed
    # form, per pair of opposite sides.
    slope_y = np.tan(np.deg2rad(look.fovy) / 2) * 0.94
    slope_x = slope_y * size[0] / size[1]
    eye = np.zeros(3)
    bounds = [(np.max(v - s * depth), np.max(-v - s * depth), s) for v, s in ((x, slope_x), (y, slope_y))]
    eye[2] = min(-(high + low) / (2 * slope) for high, low, slope in bounds)
    eye[2] = min(eye[2], depth.min() - 0.05)
    for i, (high, low, _) in enumerate(bounds):
        eye[i] = (high - low) / 2
    middle = (depth.min() + depth.max()) / 2
    lookat = wish.lookat or tuple(axes.T @ [eye[0], eye[1], middle])
    return Camera(azimuth, elevation, float(middle - eye[2]) if wish.distance is None else wish.distance, lookat)


# ---------------------------------------------------------------------------------------------------------------------
# Drawing


class _Painter:
    """Draws configurations of one model at one size and camera; to be used inside `_painter`."""

    def __init__(self, model: mujoco.MjModel, camera: Camera, size: Size, ghosts: int) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.option, self.size = mujoco.MjvOption(), size
        self.scene = mujoco.MjvScene(model, (model.ngeom + model.nsite) * (ghosts + 1) + 100)
        self.camera = mujoco.MjvCamera()
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.camera.azimuth, self.camera.elevation = camera.azimuth, camera.elevation
        self.camera.distance, self.camera.lookat[:] = camera.distance, camera.lookat
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)

    def draw(self, qpos: Floats, ghosts: Sequence[Floats] = (), opacity: float = 0.3) -> Picture:
        """(H, W, 3) of a configuration (nq,), with what moves of the ghosts' configurations drawn transparently."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        mujoco.mjv_updateScene(
            self.model, self.data, self.option, None, self.camera, mujoco.mjtCatBit.mjCAT_ALL.value, self.scene
        )
        self._add_ghosts(ghosts, opacity)
        width, height = self.size
        pixels = np.empty((height, width, 3), np.uint8)
        rectangle = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rectangle, self.scene, self.context)
        mujoco.mjr_readPixels(pixels, None, rectangle, self.context)
        return pixels[::-1].copy()

    def _add_ghosts(self, ghosts: Sequence[Floats], opacity: float) -> None:
        model, data = self.model, self.data
        moves = np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)] != 0
        shown = np.flatnonzero(moves & _visible(model))
        drawn = [(data.geom_xpos.copy(), data.geom_xmat.copy())]
        for qpos in ghosts:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            for geom in shown:
                # Two copies in one place would flicker through one another.
                if any(
                    np.allclose(position[geom], data.geom_xpos[geom], atol=1e-6)
                    and np.allclose(rotation[geom], data.geom_xmat[geom], atol=1e-6)
                    for position, rotation in drawn
                ):
                    continue
                colour = geom_colour(model, geom)
                colour[3] *= opacity
                ghost = self.scene.geoms[self.scene.ngeom]
                mujoco.mjv_initGeom(
                    ghost,
                    int(model.geom_type[geom]),
                    model.geom_size[geom],
                    data.geom_xpos[geom],
                    data.geom_xmat[geom],
                    colour,
                )
                if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_MESH):
                    ghost.dataid = 2 * model.geom_dataid[geom]
                ghost.category, ghost.transparent = mujoco.mjtCatBit.mjCAT_DECOR, 1
                self.scene.ngeom += 1
            drawn.append((data.geom_xpos.copy(), data.geom_xmat.copy()))


@contextlib.contextmanager
def _painter(model: mujoco.MjModel, camera: Camera, size: Size, ghosts: int = 0) -> Iterator[_Painter]:
    with _open_gl(size):
        try:
            painter = _Painter(model, camera, size, ghosts)
        except mujoco.FatalError as error:
            raise InputError(f"OpenGL by {backend()} cannot draw: {_last_line(str(error))}") from None
        try:
            yield painter
        finally:
            painter.context.free()


def _check_size(size: Size) -> Size:
    width, height = (int(number) for number in size)
    if not (_SMALLEST <= width <= _LARGEST and _SMALLEST <= height <= _LARGEST):
        raise InputError(f"picture of {width}x{height} pixels, expected {_SMALLEST} to {_LARGEST} each way")
    return width, height


# ---------------------------------------------------------------------------------------------------------------------
# Text


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)


def _elide(text: str, width: float, font: ImageFont.FreeTypeFont) -> str:
    """The text, its end replaced by dots where it is wider than `width` pixels."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "...") > width:
        text = text[:-1]
    # A stump says less than nothing.
    return text + "..." if len(text) > 4 else ""


def _line(
    draw: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    parts: Sequence[tuple[str, tuple[int, int, int]]],
    right: str = "",
) -> None:
    """One line of coloured parts in a box (left, top, right, bottom), `right` at its end; the last part may shrink."""
    font = _font(max(10, round((box[3] - box[1]) * 0.62)))
    middle, gap = (box[1] + box[3]) / 2, font.size * 0.8
    x, end = box[0] + gap * 0.6, box[2] - gap * 0.6
    needed = sum(font.getlength(text) + gap for text, _ in parts[:1])
    if right and x + needed + font.getlength(right) <= end:
        draw.text((end, middle), right, _FAINT, font, anchor="rm")
        end -= font.getlength(right) + gap
    for text, colour in parts:
        text = _elide(text, end - x, font)
        draw.text((x, middle), text, colour, font, anchor="lm")
        x += font.getlength(text) + gap


def _worst_text(samples: SampleSet, index: int) -> str:
    worst = worst_violation(samples, index)
    return f"worst {worst[0]:.1e} {worst[1]}" if worst else ""


# ---------------------------------------------------------------------------------------------------------------------
# The pictures


def contact_sheet(
    samples: SampleSet,
    indices: Sequence[int],
    size: Size = SHEET_SIZE,
    camera: Camera | None = None,
    switches: Sequence[str] | None = None,
) -> Picture:
    """One row per chosen sample, one column per mode switch, all from one camera, with labels.

    size: (width, height) of each single picture in pixels. switches: some of the mode switches, in this order.
    Above each row: the sample's position, its sequence, its worst violation (m or rad) and that constraint.

    Raises InputError for a sample, mode switch or size that does not exist, or when OpenGL is missing.
    """
    chosen = check_indices(samples, indices)
    columns = [switch_index(samples, name) for name in (samples.mode_switches if switches is None else switches)]
    width, height = _check_size(size)
    gap = max(2, width // 80)
    head, line = max(22, height // 9), max(18, height // 11)
    total = (
        len(columns) * (width + gap) + gap,
        head + len(chosen) * (line + height) + gap,
    )
    if total[0] * total[1] > _LARGEST_SHEET:
        raise InputError(
            f"a sheet of {total[0]}x{total[1]} pixels is too large, expected at most {_LARGEST_SHEET // 10**6} million:"
            " choose fewer samples or a smaller size"
        )
    model = compile_model(samples)
    shown = samples.qpos[np.ix_(chosen, columns)]
    camera = frame_camera(model, shown.reshape(-1, model.nq), (width, height), camera)
    sheet = Image.new("RGB", total, _PAPER)
    draw = ImageDraw.Draw(sheet)
    for j, column in enumerate(columns):
        font = _font(round(head * 0.6))
        name = _elide(samples.mode_switches[column], width, font)
        draw.text((gap + j * (width + gap) + width / 2, head / 2), name, _INK, font, anchor="mm")
    with _painter(model, camera, (width, height)) as painter:
        for i, index in enumerate(chosen):
            top = head + i * (line + height)
            parts = [(f"sample {index}", _INK), (samples.sequences[samples.sequence[index]], _FAINT)]
            _line(draw, (gap, top, total[0] - gap, top + line), parts, _worst_text(samples, index))
            for j in range(len(columns)):
                picture = Image.fromarray(painter.draw(shown[i, j]))
                sheet.paste(picture, (gap + j * (width + gap), top + line))
    return np.asarray(sheet)


def ghost_overlay(
    samples: SampleSet,
    indices: Sequence[int],
    switch: str | None = None,
    size: Size = GHOST_SIZE,
    camera: Camera | None = None,
    opacity: float = 0.3,
) -> Picture:
    """Several samples at one mode switch in one picture: the first solid, what moves of the others transparent.

    switch: where left out, the one at which the chosen samples differ most. size: (width, height) in pixels.

    Raises InputError for a sample, mode switch or size that does not exist, or when OpenGL is missing.
    """
    chosen = check_indices(samples, indices)
    size = _check_size(size)
    column = switch_index(samples, switch) if switch else int(samples.qpos[chosen].var(axis=0).sum(axis=-1).argmax())
    model = compile_model(samples)
    configurations = samples.qpos[chosen, column]
    camera = frame_camera(model, configurations, size, camera)
    with _painter(model, camera, size, len(chosen)) as painter:
        picture = painter.draw(configurations[0], configurations[1:], opacity)
    others = f"ghosts of {', '.join(map(str, chosen[1:]))}" if len(chosen) > 1 else ""
    parts = [(samples.mode_switches[column], _ACCENT), (f"sample {chosen[0]}", _INK), (others, _FAINT)]
    return _with_caption(picture, parts)


def recoloured(
    model: mujoco.MjModel, qpos: Floats, views: Mapping[str, Floats], size: Size, camera: Camera | None = None
) -> Picture:
    """One configuration (nq,) several times side by side, from one camera: caption to RGBA (ngeom, 4) of the geoms in 0..1.

    Returns (H, W, 3). Raises InputError for a size out of range or without OpenGL.
    """
    size = _check_size(size)
    camera = frame_camera(model, np.asarray(qpos)[None], size, camera)
    pictures = []
    with _painter(model, camera, size) as painter:
        for caption, rgba in views.items():
            model.geom_rgba[:] = rgba
            pictures.append(_with_caption(painter.draw(qpos), [(caption, _INK)]))
    return np.concatenate(pictures, axis=1)


def _with_caption(picture: Picture, parts: Sequence[tuple[str, tuple[int, int, int]]], right: str = "") -> Picture:
    """The picture with one line of text on paper below it."""
    height, width = picture.shape[:2]
    line = max(22, height // 18)
    page = Image.new("RGB", (width, height + line), _PAPER)
    page.paste(Image.fromarray(picture), (0, 0))
    _line(ImageDraw.Draw(page), (0, height, width, height + line), parts, right)
    return np.asarray(page)


# ---------------------------------------------------------------------------------------------------------------------
# Animation


@dataclass(frozen=True)
class Animation:
    """Frames (H, W, 3) uint8 of one size, and how long each is shown, in seconds."""

    frames: tuple[Picture, ...]
    durations: tuple[float, ...]


def animation(
    samples: SampleSet,
    indices: Sequence[int],
    size: Size = ANIMATION_SIZE,
    camera: Camera | None = None,
    switches: Sequence[str] | None = None,
    hold: float = 1.0,
    between: int = 0,
) -> Animation:
    """The chosen samples one after the other, each through its mode switches.

    size: (width, height) in pixels, without the caption below. hold: seconds at each mode switch.
    between: frames drawn from one mode switch to the next, from the MJCF's start on. They are for display only and say
    so in their caption: joints move straight, held objects follow the hand, nothing is checked for collision. With
    `switches` (some mode switches only) there are none.

    Raises InputError for a sample, mode switch or size that does not exist, or when OpenGL is missing.
    """
    chosen = check_indices(samples, indices)
    names = samples.mode_switches if switches is None else tuple(switches)
    columns = [switch_index(samples, name) for name in names]
    if hold <= 0 or between < 0:
        raise InputError(f"hold {hold:g} s and {between} frames between, expected a positive time and 0 or more frames")
    size = _check_size(size)
    model = compile_model(samples)
    start = np.array(model.key_qpos[0] if model.nkey else model.qpos0)
    script: list[tuple[Floats, float, list[tuple[str, tuple[int, int, int]]]]] = []
    for index in chosen:
        label = (f"sample {index}", _INK)
        before, origin = start, "start"
        for column, name in zip(columns, names, strict=True):
            qpos = samples.qpos[index, column]
            if between and switches is None:
                if origin == "start":
                    script.append((before, hold / 2, [label, ("start", _ACCENT)]))
                parts = [label, (f"{origin} to {name}: display only, not a planned path", _FAINT)]
                moved = _moved(model, samples, column, before, qpos, between)
                script += [(configuration, 0.04, parts) for configuration in moved]
            script.append((qpos, hold, [label, (name, _ACCENT)]))
            before, origin = qpos, name
    camera = frame_camera(model, np.array([qpos for qpos, _, _ in script]), size, camera)
    with _painter(model, camera, size) as painter:
        frames = tuple(_with_caption(painter.draw(qpos), parts) for qpos, _, parts in script)
    return Animation(frames, tuple(duration for _, duration, _ in script))


def _pose(position: Floats, quaternion: Floats) -> Floats:
    return np.concatenate([position, quaternion])


def _compose(a: Floats, b: Floats) -> Floats:
    """T_1_3 of T_1_2 and T_2_3, each (7,)."""
    pose = np.empty(7)
    mujoco.mju_mulPose(pose[:3], pose[3:], a[:3], a[3:], b[:3], b[3:])
    return pose


def _inverse(a: Floats) -> Floats:
    pose = np.empty(7)
    mujoco.mju_negPose(pose[:3], pose[3:], a[:3], a[3:])
    return pose


def _turned(a: Floats, b: Floats, fraction: float) -> Floats:
    """The quaternion at this fraction of the shortest turn from a to b."""
    velocity, turned = np.empty(3), a.copy()
    mujoco.mju_subQuat(velocity, b, a)
    mujoco.mju_quatIntegrate(turned, velocity, fraction)
    return turned


def _frame_pose(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> tuple[Floats, int] | None:
    """T_world_frame (7,) of a site or body and the body it is on; None for another name."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
        return _pose(data.site_xpos[site], quaternion), int(model.site_bodyid[site])
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    return (_pose(data.xpos[body], data.xquat[body]), body) if body >= 0 else None


def _free_address(model: mujoco.MjModel, body: int) -> int | None:
    """Where the pose of a body's free joint stands in qpos, or None without one."""
    joint = int(model.body_jntadr[body])
    if joint >= 0 and model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE):
        return int(model.jnt_qposadr[joint])
    return None


def _moved(
    model: mujoco.MjModel, samples: SampleSet, column: int, first: Floats, second: Floats, count: int
) -> list[Floats]:
    """`count` configurations (nq,) strictly between two mode switches, `column` being the second.

    Joints move straight; an object follows the frame that holds it; a floating robot that hangs on a resting object
    keeps its grip by moving its base.
    """
    data = mujoco.MjData(model)
    interval: list[Mapping[str, Any]] = [
        entry
        for entry in samples.attachments
        if entry["to"] == samples.mode_switches[column]
        and entry["from"] == (samples.mode_switches[column - 1] if column else None)
    ]
    resting = {entry["object"] for entry in interval if entry["frame"] == "world"}
    # How each held object lies in its frame, at the first of the two switches.
    data.qpos[:] = first
    mujoco.mj_kinematics(model, data)
    held: list[tuple[str, str, int, Floats]] = []
    for entry in interval:
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, entry["object"])
        frame = _frame_pose(model, data, entry["frame"])
        address = _free_address(model, body) if body >= 0 else None
        if entry["frame"] != "world" and frame and address is not None:
            relative = _compose(_inverse(frame[0]), first[address : address + 7])
            held.append((entry["object"], entry["frame"], address, relative))
    held.sort(key=lambda item: item[0] not in resting)
    configurations = []
    for step in range(1, count + 1):
        fraction = step / (count + 1)
        fraction = fraction * fraction * (3 - 2 * fraction)
        qpos = first + fraction * (second - first)
        for joint in range(model.njnt):
            kind, address = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
            if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
                at = address + 3 * (kind == int(mujoco.mjtJoint.mjJNT_FREE))
                qpos[at : at + 4] = _turned(first[at : at + 4], second[at : at + 4], fraction)
        for name, frame_name, address, relative in held:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            frame, body = _frame_pose(model, data, frame_name)
            if name not in resting:
                qpos[address : address + 7] = _compose(frame, relative)
                continue
            root = _free_address(model, int(model.body_rootid[body]))
            if root is not None:
                wanted = _compose(qpos[address : address + 7], _inverse(relative))
                base = qpos[root : root + 7]
                qpos[root : root + 7] = _compose(wanted, _compose(_inverse(frame), base))
        configurations.append(qpos)
    return configurations


# ---------------------------------------------------------------------------------------------------------------------
# Files


@contextlib.contextmanager
def _whole_file(path: str | os.PathLike[str], suffix: str) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place when the block ends well."""
    target = Path(path)
    if target.suffix.lower() != suffix:
        raise InputError(f"cannot write {target}: expected a name that ends in {suffix}")
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=suffix, dir=target.parent)
        os.close(handle)
        yield Path(temporary)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def save_png(path: str | os.PathLike[str], picture: Picture) -> Path:
    """Write a picture (H, W, 3); the file appears whole or not at all. Raises InputError when it cannot be written."""
    with _whole_file(path, ".png") as temporary:
        Image.fromarray(picture).save(temporary)
    return Path(path)


def save_gif(path: str | os.PathLike[str], frames: Animation) -> Path:
    """Write an animation that repeats forever; the file appears whole or not at all.

    One palette serves all frames, so that colours do not flicker. Raises InputError when it cannot be written.
    """
    step = max(1, len(frames.frames) // 12)
    strip = np.concatenate([frame[::2, ::2] for frame in frames.frames[::step]])
    palette = Image.fromarray(strip).quantize(256, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames.frames]
    milliseconds = [max(20, round(duration * 100) * 10) for duration in frames.durations]
    with _whole_file(path, ".gif") as temporary:
        images[0].save(temporary, save_all=True, append_images=images[1:], duration=milliseconds, loop=0)
    return Path(path)


def picture_paths(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Where contact sheet and animation of a sample file (or of the `samples.npz` of a directory) go: beside it."""
    stem = Path(path)
    stem = stem.with_suffix("") if stem.suffix == ".npz" else stem / "samples"
    return stem.with_name(f"{stem.name}_sheet.png"), stem.with_name(f"{stem.name}.gif")


def save_pictures(samples: SampleSet, path: str | os.PathLike[str], count: int = 6) -> list[Path]:
    """Contact sheet of the `count` most diverse samples and animation of the first three, at `picture_paths`.

    Returns the paths. Raises InputError without samples, without OpenGL, or when a file cannot be written.
    """
    sheet, gif = picture_paths(path)
    indices = samples.diverse(count)
    save_png(sheet, contact_sheet(samples, indices))
    return [sheet, save_gif(gif, animation(samples, indices[:3], between=8))]
