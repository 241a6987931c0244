"""Look at samples: a web page by viser (extra `viewer`, works without a display), or MuJoCo's own viewer.

The page has sliders over samples and mode switches, says which constraint of the shown sample is violated most, and
can leave only the samples of one sequence or the k most diverse ones. Its state is shared by all who open it.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from cgs_jax.errors import InputError
from cgs_jax.render import (
    Camera,
    check_indices,
    compile_model,
    frame_camera,
    geom_colour,
    switch_index,
    worst_violation,
)
from cgs_jax.samples import SampleSet

Floats = NDArray[np.float64]

SLIDER_PIXELS, MARK_PIXELS = 136.0, 5.0
"""Length of the page's sliders, and of a letter under them."""

DEFAULT_PORT = 8080
_ALL = "all sequences"
_PLANE_EXTENT = 10.0
"""Metres: how far a plane without an end is drawn."""


def _import_viser() -> Any:
    try:
        import viser
    except ImportError:
        raise InputError('--view needs the package viser, install it with: pip install -e ".[viewer]"') from None
    return viser


def _free_port(host: str, port: int) -> int:
    """The first port from this one on that can be served; viser itself would wait forever for one that cannot.

    Raises InputError for an address that does not exist or is not ours.
    """
    if not 0 < port < 65536:
        raise InputError(f"port {port} does not exist, expected 1 to 65535")
    for candidate in range(port, min(port + 100, 65536)):
        try:
            socket.create_server((host, candidate)).close()
            return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise InputError(f"cannot serve on {host}:{candidate}: {error.strerror or error}") from None
    raise InputError(f"no free port on {host} from {port} to {candidate}")


# ---------------------------------------------------------------------------------------------------------------------
# Shapes


def capsule_mesh(radius: float, half: float, rings: int = 8, sides: int = 24) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3), outwards, of a capsule along z about the origin.

    half: half the length of its axis, as MuJoCo's geom size has it, metres.
    """
    latitude = np.linspace(0, np.pi / 2, rings + 1)
    profile = np.concatenate(
        [
            np.stack([radius * np.cos(latitude[::-1]), -half - radius * np.sin(latitude[::-1])], axis=1),
            np.stack([radius * np.cos(latitude), half + radius * np.sin(latitude)], axis=1),
        ]
    )
    longitude = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    vertices = np.stack(
        [
            np.outer(profile[:, 0], np.cos(longitude)),
            np.outer(profile[:, 0], np.sin(longitude)),
            np.repeat(profile[:, 1:], sides, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    below = np.arange(len(profile) - 1)[:, None] * sides + np.arange(sides)
    beside = np.arange(len(profile) - 1)[:, None] * sides + (np.arange(sides) + 1) % sides
    first = np.stack([below, beside, beside + sides], axis=-1).reshape(-1, 3)
    second = np.stack([below, beside + sides, below + sides], axis=-1).reshape(-1, 3)
    return vertices, np.concatenate([first, second])


def _add_shape(scene: Any, model: mujoco.MjModel, path: str, kind: int, size: Floats, mesh: int, **look: Any) -> Any:
    """One geom or site as a viser node, or None for a kind that cannot be shown."""
    name = mujoco.mjtGeom(kind)
    geom = mujoco.mjtGeom
    if name == geom.mjGEOM_SPHERE:
        return scene.add_icosphere(path, radius=size[0], **look)
    if name == geom.mjGEOM_ELLIPSOID:
        return scene.add_icosphere(path, radius=1.0, scale=tuple(map(float, size)), **look)
    if name == geom.mjGEOM_BOX:
        return scene.add_box(path, dimensions=tuple(2 * size), **look)
    if name == geom.mjGEOM_CYLINDER:
        return scene.add_cylinder(path, radius=size[0], height=2 * size[1], **look)
    if name == geom.mjGEOM_CAPSULE:
        return scene.add_mesh_simple(path, *capsule_mesh(size[0], size[1]), **look)
    if name == geom.mjGEOM_PLANE:
        sides = [2 * half if half > 0 else 2 * _PLANE_EXTENT for half in size[:2]]
        return scene.add_box(path, dimensions=(*sides, 0.001), **look)
    if name == geom.mjGEOM_MESH and mesh >= 0:
        start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        vertices, triangles = model.mesh_vert[start : start + count], model.mesh_face[face : face + faces]
        return scene.add_mesh_simple(path, vertices, triangles, **look)
    return None


def _add_bodies(scene: Any, model: mujoco.MjModel) -> tuple[list[Any], list[Any]]:
    """A frame per body, its geoms and sites as children. Returns the frames (nbody) and the nodes of the sites."""
    frames, sites = [], []
    for body in range(model.nbody):
        frames.append(scene.add_frame(f"/bodies/{body}", show_axes=False))
    for geom in range(model.ngeom):
        colour = geom_colour(model, geom)
        if model.geom_group[geom] >= 3 or colour[3] == 0:
            continue
        _add_shape(
            scene,
            model,
            f"/bodies/{model.geom_bodyid[geom]}/geom{geom}",
            int(model.geom_type[geom]),
            model.geom_size[geom],
            int(model.geom_dataid[geom]),
            color=tuple(np.round(255 * colour[:3]).astype(int).tolist()),
            opacity=None if colour[3] >= 1 else float(colour[3]),
            position=model.geom_pos[geom],
            wxyz=model.geom_quat[geom],
        )
    for site in range(model.nsite):
        colour = model.site_rgba[site]
        if model.site_group[site] >= 3 or colour[3] == 0:
            continue
        node = _add_shape(
            scene,
            model,
            f"/bodies/{model.site_bodyid[site]}/site{site}",
            int(model.site_type[site]),
            model.site_size[site],
            -1,
            color=tuple(np.round(255 * colour[:3]).astype(int).tolist()),
            opacity=float(min(colour[3], 0.6)),
            cast_shadow=False,
            position=model.site_pos[site],
            wxyz=model.site_quat[site],
        )
        if node is not None:
            sites.append(node)
    return frames, sites


# ---------------------------------------------------------------------------------------------------------------------
# What is said about a sample


def describe(samples: SampleSet, index: int, rows: int = 4) -> str:
    """Markdown about one sample: its sequence, when it was found, and its largest violations with their constraints."""
    lines = [f"**sample {index}**, found after {samples.elapsed[index]:.2f} s"]
    lines.append(f"by `{samples.sequences[samples.sequence[index]]}`")
    worst = worst_violation(samples, index)
    if worst is None:
        lines.append("no violation recorded")
    else:
        lines.append(f"worst violation **{worst[0]:.1e}** in **{worst[1]}**")
    text = "\n\n".join(lines)
    order = np.argsort(-samples.violation[index], kind="stable")[: rows + 1]
    if len(order) > 1:
        table = [f"| {samples.constraints[c]} | {samples.violation[index, c]:.1e} |" for c in order]
        text += "\n\n" + "\n".join(["| constraint | violation (m or rad) |", "| --- | --- |", *table])
    return text


# ---------------------------------------------------------------------------------------------------------------------
# The web page


def switch_marks(names: Sequence[str]) -> tuple[tuple[int, str], ...] | None:
    """The names under the slider of mode switches; None where two of them would run into each other."""
    apart = SLIDER_PIXELS / max(len(names) - 1, 1)
    longest = max((len(a) + len(b)) / 2 for a, b in zip(names, names[1:], strict=False)) if len(names) > 1 else 0.0
    return tuple(enumerate(names)) if MARK_PIXELS * (longest + 1) <= apart else None


class WebViewer:
    """The page of one sample set. It is served from construction on; `stop` ends it.

    indices: positions of the samples that are offered, all of them where left out. switch: shown first.
    camera: what the page starts with. host: "0.0.0.0" lets other machines in. port: the next free one from there on.

    Attributes: `url`; `sample` (position in the set) and `switch` (name) now shown; `offered`, the positions that the
    slider runs over.

    Raises InputError without viser, without samples, or for a sample, mode switch or port that does not exist.
    """

    def __init__(
        self,
        samples: SampleSet,
        indices: Sequence[int] | None = None,
        switch: str | None = None,
        camera: Camera | None = None,
        host: str = "localhost",
        port: int = DEFAULT_PORT,
    ) -> None:
        viser = _import_viser()
        self.samples = samples
        self._pool = np.array(check_indices(samples, range(len(samples)) if indices is None else indices))
        self._column = 0 if switch is None else switch_index(samples, switch)
        self.offered = self._pool
        self._model = compile_model(samples)
        self._data = mujoco.MjData(self._model)
        # Callbacks come from several threads; programmatic changes of a widget call them again from the same one.
        self._lock = threading.RLock()
        self._quiet = False
        self._window: MujocoWindow | None = None
        port = _free_port(host, port)
        # viser greets on standard output, which belongs to the caller.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host=host, port=port, label="cgs_jax samples", verbose=False)
        self.url = f"http://{'localhost' if host == '0.0.0.0' else host}:{self._server.get_port()}"
        self._build_scene(camera)
        self._build_controls()
        self._show()

    @property
    def sample(self) -> int:
        return int(self.offered[min(self._sample_slider.value, len(self.offered) - 1)])

    @property
    def switch(self) -> str:
        return self.samples.mode_switches[self._column]

    def body_pose(self, name: str) -> Floats:
        """T_world_body (7,) as the page shows it. Raises InputError for an unknown body."""
        body = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            raise InputError(f"no body {name!r} in the sample set's MJCF")
        return np.concatenate([self._frames[body].position, self._frames[body].wxyz])

    def run(self) -> None:
        """Serve until interrupted (Ctrl-C)."""
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        if self._window is not None:
            self._window.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _build_scene(self, camera: Camera | None) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)
        self._frames, self._sites = _add_bodies(scene, self._model)
        # Enough of the samples to see where things are; the whole set may hold a hundred thousand.
        some = self.samples.qpos[self._pool[:20]].reshape(-1, self._model.nq)
        view = frame_camera(self._model, some, (4, 5), camera)
        a, e = np.deg2rad([view.azimuth, view.elevation])
        forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        start = self._server.initial_camera
        start.position = np.array(view.lookat) - view.distance * forward
        start.look_at = np.array(view.lookat)
        start.fov = float(np.deg2rad(self._model.vis.global_.fovy))

    def _build_controls(self) -> None:
        gui, samples = self._server.gui, self.samples
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.main_panel.dock_right()
        title = samples.meta.get("scene", "samples")
        gui.add_markdown(f"### {title}\n{len(self._pool)} samples, {len(samples.mode_switches)} mode switches")
        used, counts = np.unique(samples.sequence[self._pool], return_counts=True)
        self._sequence_of_option: dict[str, int | None] = {f"{_ALL} ({len(self._pool)})": None}
        for sequence, count in sorted(zip(used, counts, strict=True), key=lambda item: -item[1]):
            self._sequence_of_option[f"{samples.sequences[sequence]} ({count})"] = int(sequence)
        self._sequence_menu = gui.add_dropdown("Sequence", tuple(self._sequence_of_option))
        self._diverse_box = gui.add_checkbox("Diverse only", False)
        many = max(1, len(self._pool))
        self._diverse_count = gui.add_number("How many", min(10, many), min=1, max=many, step=1)
        self._sample_slider = gui.add_slider("Sample", 0, len(self._pool) - 1, 1, 0)
        names = samples.mode_switches
        self._switch_slider = gui.add_slider("Mode switch", 0, len(names) - 1, 1, self._column, marks=switch_marks(names))
        self._text = gui.add_markdown("")
        self._sites_box = gui.add_checkbox("Show sites", True)
        missing = missing_display()
        self._mujoco_button = gui.add_button(
            "Open MuJoCo's viewer (M)",
            disabled=missing is not None,
            hint=missing or "On the machine that serves this page; it follows the sliders",
        )
        for widget in (self._sequence_menu, self._diverse_box, self._diverse_count):
            widget.on_update(self._guarded(self._filter))
        self._sample_slider.on_update(self._guarded(self._show))
        self._switch_slider.on_update(self._guarded(self._show))
        self._sites_box.on_update(self._guarded(self._show_sites))
        self._mujoco_button.on_click(self._guarded(self._open_mujoco))
        for label, key, action in (
            ("Next sample", "arrowright", lambda: self._step(self._sample_slider, 1)),
            ("Previous sample", "arrowleft", lambda: self._step(self._sample_slider, -1)),
            ("Next mode switch", "arrowdown", lambda: self._step(self._switch_slider, 1)),
            ("Previous mode switch", "arrowup", lambda: self._step(self._switch_slider, -1)),
        ):
            gui.add_command(label, hotkey=key, modifier="shift").on_trigger(self._guarded(action))
        if missing is None:
            gui.add_command("Open MuJoCo's viewer", hotkey="M").on_trigger(self._guarded(self._open_mujoco))

    def _guarded(self, action: Callable[[], None]) -> Callable[[Any], None]:
        """A callback that runs one at a time and not in answer to our own changes."""

        def callback(_: Any) -> None:
            with self._lock:
                if not self._quiet:
                    action()

        return callback

    def _step(self, slider: Any, by: int) -> None:
        slider.value = int(np.clip(slider.value + by, 0, slider.max))

    def _filter(self) -> None:
        """Offer what the menu and the box say, most diverse first, and keep the shown sample where it is among it."""
        before = self.sample
        sequence = self._sequence_of_option[self._sequence_menu.value]
        offered = self._pool if sequence is None else self._pool[self.samples.sequence[self._pool] == sequence]
        if self._diverse_box.value:
            offered = offered[self.samples.select(offered).diverse(int(self._diverse_count.value))]
        place = np.flatnonzero(offered == before)
        self._quiet = True
        try:
            self.offered = offered
            self._sample_slider.value = 0
            self._sample_slider.max = len(offered) - 1
            self._sample_slider.value = int(place[0]) if len(place) else 0
        finally:
            self._quiet = False
        self._show()

    def _show(self) -> None:
        index, self._column = self.sample, int(self._switch_slider.value)
        qpos = self.samples.qpos[index, self._column]
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        place = int(self._sample_slider.value) + 1
        with self._server.atomic():
            for frame, position, quaternion in zip(self._frames, self._data.xpos, self._data.xquat, strict=True):
                frame.position, frame.wxyz = position, quaternion
        self._text.content = f"**{self.switch}**, {place} of {len(self.offered)}\n\n{describe(self.samples, index)}"
        if self._window is not None:
            self._window.show(index, self._column)

    def _show_sites(self) -> None:
        for site in self._sites:
            site.visible = self._sites_box.value

    def _open_mujoco(self) -> None:
        try:
            if self._window is None or not self._window.is_open():
                self._window = MujocoWindow(self.samples, self._pool.tolist(), self.switch)
            self._window.show(self.sample, self._column)
        except InputError as error:
            self._text.content = str(error)


# ---------------------------------------------------------------------------------------------------------------------
# MuJoCo's own viewer


def missing_display() -> str | None:
    """Why MuJoCo's own viewer cannot open a window here, in one line, or None when it can."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "MuJoCo's own viewer needs a display and DISPLAY is not set; --view works without one"
    try:
        import glfw
    except ImportError:
        return "MuJoCo's own viewer needs glfw: pip install glfw; --view works without it"
    with warnings.catch_warnings():
        # The line below says the same in fewer words.
        warnings.simplefilter("ignore")
        opened = glfw.init()
    if not opened:
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or "here"
        return f"MuJoCo's own viewer cannot open the display {display}; --view works without one"
    return None


class MujocoWindow:
    """MuJoCo's own viewer on a sample set. Keys: right and left for the sample, down and up for the mode switch.

    indices: positions of the samples that the keys run over. switch: shown first.

    Raises InputError without a display, or for a sample or mode switch that does not exist.
    """

    def __init__(self, samples: SampleSet, indices: Sequence[int] | None = None, switch: str | None = None) -> None:
        self._samples = samples
        self._pool = check_indices(samples, range(len(samples)) if indices is None else indices)
        self._place, self._column = 0, 0 if switch is None else switch_index(samples, switch)
        missing = missing_display()
        if missing:
            raise InputError(missing)
        import mujoco.viewer

        self._model = compile_model(samples)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = samples.qpos[self._pool[0], self._column]
        # Keys arrive on the window's own thread, which may not wait for its own lock: they are noted here, and shown
        # by whoever watches.
        self._changed = threading.Event()
        before = set(threading.enumerate())
        try:
            self._handle = mujoco.viewer.launch_passive(
                self._model, self._data, key_callback=self._press, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:
            # macOS: MuJoCo says that the script must run under mjpython.
            raise InputError(f"MuJoCo's own viewer cannot open a window: {str(error).splitlines()[0]}") from None
        self._threads = set(threading.enumerate()) - before
        self._frame()
        self.show(self._pool[0], self._column)

    def _frame(self) -> None:
        view = frame_camera(self._model, self._samples.qpos[self._pool[:20]].reshape(-1, self._model.nq), (4, 3))
        with self._handle.lock():
            camera = self._handle.cam
            camera.azimuth, camera.elevation, camera.distance = view.azimuth, view.elevation, view.distance
            camera.lookat[:] = view.lookat

    def _press(self, key: int) -> None:
        # GLFW's codes of the arrows.
        sample, switch = {262: (1, 0), 263: (-1, 0), 264: (0, 1), 265: (0, -1)}.get(key, (0, 0))
        self._place = int(np.clip(self._place + sample, 0, len(self._pool) - 1))
        self._column = int(np.clip(self._column + switch, 0, len(self._samples.mode_switches) - 1))
        self._changed.set()

    def is_open(self) -> bool:
        return self._handle.is_running()

    def show(self, index: int, column: int) -> None:
        """Show the sample at this position of the set at this mode switch; nothing happens once it is closed."""
        if not self.is_open():
            return
        with self._handle.lock():
            self._data.qpos[:] = self._samples.qpos[index, column]
            mujoco.mj_forward(self._model, self._data)
        worst = worst_violation(self._samples, index)
        name = f"sample {index}: {self._samples.mode_switches[column]}"
        self._handle.set_texts((None, None, name, f"worst {worst[0]:.1e} {worst[1]}" if worst else ""))
        self._handle.sync()

    def run(self) -> None:
        """Follow the keys until the window is closed or Ctrl-C."""
        try:
            while self.is_open():
                if self._changed.wait(0.05):
                    self._changed.clear()
                    self.show(self._pool[self._place], self._column)
                else:
                    self._handle.sync()
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        self._handle.close()
        # The window is taken down on its own thread; an interpreter that ends before it crashes.
        for thread in self._threads:
            thread.join(timeout=10)
