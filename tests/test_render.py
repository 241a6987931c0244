import importlib.util
import itertools
import os
import subprocess
import sys
from pathlib import Path

import gantry
import mujoco
import numpy as np
import pytest
from PIL import Image

from cgs_jax import render, viewer
from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

ROOT = Path(__file__).parents[1]
SHOW = ROOT / "scripts" / "show.py"
CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)))
HANDOVER = ROOT / "scenes" / "handover" / "handover.xml"


def handover_samples(count=6, seed=0):
    """Samples near the handover scene's home pose, the box in a hand at `handover`; they need not be feasible."""
    spec = mujoco.MjSpec.from_file(str(HANDOVER))
    # A colour that nothing else in the scene has, lit or not.
    spec.geom("box").rgba = [0, 1, 0, 1]
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    home = np.array(model.key("home").qpos)
    qpos = np.tile(home, (count, 3, 1))
    qpos[:, :2, :7] += rng.normal(0, 0.2, (count, 2, 7))
    qpos[:, 1:, 7:14] += rng.normal(0, 0.2, (count, 2, 7))
    qpos[:, 2, 14:] = [0.55, -0.45, 0.301, 1, 0, 0, 0]
    for i in range(count):
        data.qpos[:] = qpos[i, 1]
        mujoco.mj_kinematics(model, data)
        qpos[i, 1, 14:17] = data.site("a_pinch").xpos
        mujoco.mju_mat2Quat(qpos[i, 1, 17:], data.site("a_pinch").xmat)
    held = [("world", None, "pick"), ("a_pinch", "pick", "handover"), ("b_pinch", "handover", "place")]
    return SampleSet(
        mjcf=spec.to_xml(),
        variables={"q_a1": qpos[:, 0, :7], "q_a2": qpos[:, 1, :7], "p": qpos[:, 1, 14:]},
        mode_switches=("pick", "handover", "place"),
        qpos=qpos,
        attachments=[{"object": "box", "frame": frame, "from": start, "to": end} for frame, start, end in held],
        sequences=("(q_a1,q_a2,t_a,q_b1,q_b2,t_b,p)", "p; t_a; t_b; q_a1; q_a2; q_b2; q_b1"),
        sequence=np.arange(count) % 2,
        elapsed=np.linspace(0.1, 1, count),
        violation=rng.uniform(0, 1e-4, (count, 2)),
        constraints=("Kin(t_a,q_a1)", "Collision(q_a2,q_b2)"),
        meta={"scene": "handover"},
        kinds={"q_a1": "configuration", "q_a2": "configuration", "p": "pose"},
    )


@pytest.fixture(scope="module")
def samples():
    return handover_samples()


@pytest.fixture(scope="module")
def gantry_samples():
    qpos, t, _ = gantry.valid(4)
    return gantry.sample_set(qpos, t)


@pytest.fixture(scope="module")
def opengl():
    try:
        return render.backend()
    except InputError as error:
        pytest.skip(str(error))


def projected(model, camera, size, points):
    """Image coordinates (N, 2), -1..1 each way, y up, by MuJoCo's own frustum."""
    scene, view = mujoco.MjvScene(model, 1000), mujoco.MjvCamera()
    view.azimuth, view.elevation, view.distance = camera.azimuth, camera.elevation, camera.distance
    view.lookat[:] = camera.lookat
    mujoco.mjv_updateScene(model, mujoco.MjData(model), mujoco.MjvOption(), None, view, 7, scene)
    # Two eyes, for stereo; a plain picture is taken from their middle.
    eye, other = scene.camera
    axes = np.array([np.cross(eye.forward, eye.up), eye.up, eye.forward])
    x, y, depth = axes @ (np.asarray(points, dtype=float) - (eye.pos + other.pos) / 2).T
    top = eye.frustum_top / eye.frustum_near
    return np.stack([x / depth / (top * size[0] / size[1]), y / depth / top], axis=1)


def pixel(picture, size, place, left=0, top=0):
    x, y = (place + 1) / 2 * size
    return picture[top + int(size[1] - y), left + int(x)].astype(int)


# ---------------------------------------------------------------------------------------------------------------------
# Camera


@pytest.mark.parametrize("size", [(320, 240), (200, 600), (900, 150)])
@pytest.mark.parametrize("wish", [None, render.Camera(0, -80), render.Camera(200, 10)])
def test_everything_but_the_table_lies_in_the_picture_and_fills_it(samples, size, wish):
    model = render.compile_model(samples)
    configurations = samples.qpos.reshape(-1, model.nq)
    camera = render.frame_camera(model, configurations, size, wish)
    data, rng, found = mujoco.MjData(model), np.random.default_rng(1), []
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for qpos in configurations:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for geom in range(model.ngeom):
            if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
                radius, half = model.geom_size[geom, :2]
                axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * half
                centre = data.geom_xpos[geom]
                found += [centre + side * axis + radius * directions for side in (-1, 1)]
            elif model.geom(geom).name != "table":
                found.append(
                    data.geom_xpos[geom] + (CORNERS * model.geom_size[geom]) @ data.geom_xmat[geom].reshape(3, 3).T
                )
    places = projected(model, camera, size, np.concatenate(found))
    assert 0.85 < np.abs(places).max() < 1


def test_a_wished_camera_is_kept_and_wrong_ones_are_refused(samples):
    model = render.compile_model(samples)
    camera = render.frame_camera(model, samples.qpos[0], (320, 240), render.Camera.parse("30,-40,2.5"))
    assert (camera.azimuth, camera.elevation, camera.distance) == (30, -40, 2.5)
    assert render.Camera.parse("30,-40").distance is None
    for text in ("30", "a,b", "30,-40,0", "30,-100", "1,2,3,4", "nan,2", ""):
        with pytest.raises(InputError) as error:
            render.Camera.parse(text)
        assert "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------------------------------
# Pictures


def with_boxes(samples, places):
    """The samples with the box in the air in front of everything else, at places (N, K, 3)."""
    qpos = samples.qpos[: len(places)].copy()
    qpos[:, :, 14:17], qpos[:, :, 17:] = places, [1, 0, 0, 0]
    return SampleSet(**{**vars(samples.select(slice(0, len(places)))), "qpos": qpos})


def greenness(colour):
    red, green, blue = colour
    return 2 * green - red - blue


def test_contact_sheet_has_the_box_where_each_sample_has_it(samples, opengl):
    size, chosen, camera = (320, 240), [2, 0], render.Camera(90, -20, 2.6, (0.0, 0.0, 0.5))
    x = np.arange(9).reshape(3, 3, 1) * 0.1 - 0.4
    places = np.concatenate([x, np.full_like(x, -0.8), np.full_like(x, 0.9)], axis=-1)
    floating = with_boxes(samples, places)
    sheet = render.contact_sheet(floating, chosen, size, camera)
    # The layout is found from the picture: paper is white, the sky is not.
    painted = (sheet != 255).any(axis=-1)
    lefts = np.flatnonzero(np.diff(painted[size[1]].astype(int), prepend=0) == 1)
    rows = np.flatnonzero(painted[:, lefts[0] + 1])
    tops = [rows[0], rows[size[1]]]
    assert len(lefts) == 3 and len(rows) == 2 * size[1] and tops[1] > tops[0] + size[1]
    image_places = projected(render.compile_model(samples), camera, size, places.reshape(-1, 3)).reshape(3, 3, 2)
    for i, sample in enumerate(chosen):
        for j in range(3):
            greens = [greenness(pixel(sheet, size, place, lefts[j], tops[i])) for place in image_places[sample]]
            assert greens[j] > 100 and all(green < 20 for green in np.delete(greens, j)), greens


def test_labels_are_drawn_and_rows_follow_the_samples(gantry_samples, opengl):
    size = (160, 120)
    camera = render.Camera(125, -25)
    one = render.contact_sheet(gantry_samples, [0], size, camera)
    twice = render.contact_sheet(gantry_samples, [0, 0], size, camera)
    height = twice.shape[0] - one.shape[0]
    np.testing.assert_array_equal(twice[-height:], one[-height:])
    two = render.contact_sheet(gantry_samples, [0, 1], size, camera)
    assert (two[-height:] != twice[-height:]).any()
    assert (one[: one.shape[0] - size[1] - 5] < 100).any()
    place_only = render.contact_sheet(gantry_samples, [0], size, camera, switches=["place"])
    assert place_only.shape[1] < one.shape[1] / 1.8


def test_ghosts_are_fainter_than_the_first_sample(samples, opengl):
    size, camera = (400, 300), render.Camera(90, -20, 2.6, (0.0, 0.0, 0.5))
    places = np.array([[-0.2, -0.8, 0.9], [0.2, -0.8, 0.9], [0.0, -0.8, 0.6]])
    both = with_boxes(samples, np.repeat(places[:, None], 3, axis=1))
    image_places = projected(render.compile_model(both), camera, size, places)

    def seen(indices):
        picture = render.ghost_overlay(both, indices, "handover", size, camera, opacity=0.2)
        return [greenness(pixel(picture, size, place)) for place in image_places[:2]]

    (first, nothing), (_, second), (still, ghost) = seen([0]), seen([1]), seen([0, 1])
    assert first > 100 and second > 100 and still == first
    # Front and back of the ghost cover by 0.2 each, lit differently.
    assert 0.1 < (ghost - nothing) / (second - nothing) < 0.7
    # Where nothing of the two differs (the switch `pick` of one sample twice), no ghost is drawn over the first.
    np.testing.assert_array_equal(
        render.ghost_overlay(both, [2, 2], "pick", size, camera)[: size[1]],
        render.ghost_overlay(both, [2], "pick", size, camera)[: size[1]],
    )


def test_a_scene_without_light_or_sky_is_not_drawn_in_the_dark(gantry_samples, opengl):
    picture = render.ghost_overlay(gantry_samples, [0, 1], size=(160, 120))
    assert np.median(picture[:120]) > 60 and picture[5, 5].min() > 120


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"indices": [9]}, "0 to 5"),
        ({"indices": [-1]}, "0 to 5"),
        ({"indices": []}, "0 to 5"),
        ({"indices": [0], "switches": ["lift"]}, "pick, handover, place"),
        ({"indices": [0], "size": (10, 10)}, "64 to 4096"),
        ({"indices": [0] * 200, "size": (2000, 2000)}, "fewer samples"),
    ],
)
def test_wrong_choices_say_what_there_is(samples, arguments, words):
    with pytest.raises(InputError, match=words) as error:
        render.contact_sheet(samples, **arguments)
    assert "\n" not in str(error.value)


def test_sets_that_cannot_be_drawn_say_why(samples):
    with pytest.raises(InputError, match="no samples"):
        render.contact_sheet(samples.select([]), [0])
    for mjcf, words in (("<mujoco>", "does not compile"), (gantry.MJCF, "expects 12")):
        with pytest.raises(InputError, match=words) as error:
            render.contact_sheet(SampleSet(**{**vars(samples), "mjcf": mjcf}), [0])
        assert "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------------------------------
# Between the mode switches


def test_between_mode_switches_the_box_stays_in_the_hand_and_at_rest(gantry_samples):
    """The gantry's poses have closed forms: the box keeps its pose in the gripper, computed with quaternions here."""
    model = render.compile_model(gantry_samples)
    for i in range(len(gantry_samples)):
        pick, place = gantry_samples.qpos[i]
        for qpos in render._moved(model, gantry_samples, 0, model.qpos0, pick, 5):
            np.testing.assert_allclose(qpos[5:], [*gantry.START, 1, 0, 0, 0], atol=1e-12)
        moved = render._moved(model, gantry_samples, 1, pick, place, 7)
        assert len(moved) == 7
        for qpos in moved:
            lies = np.concatenate(gantry.in_frame(gantry.gripper(qpos[:5]), (qpos[5:8], qpos[8:])))
            wanted = gantry_samples["t"][i]
            np.testing.assert_allclose(lies[:3], wanted[:3], atol=1e-9)
            assert abs(lies[3:] @ wanted[3:]) == pytest.approx(1, abs=1e-9)
        travelled = np.array([pick, *moved, place])[:, 0]
        assert (np.diff(travelled) > 0).all()


CLIMBER = """
<mujoco>
  <worldbody>
    <body name="robot"><freejoint/><geom size=".1"/><site name="foot" pos="0 0 -.2" quat="0 1 0 0"/>
      <body name="arm" pos="0 0 .3"><joint name="turn" axis="0 0 1"/><geom size=".05" pos=".2 0 0"/>
        <site name="hand" pos=".4 0 0"/></body></body>
    <body name="block" pos="1 0 .5"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_robot_that_hangs_on_a_resting_object_moves_its_base_instead():
    model = mujoco.MjModel.from_xml_string(CLIMBER)
    data = mujoco.MjData(model)
    qpos = np.zeros((1, 2, 15))
    block, grip = np.array([1, 0, 0.5, 1, 0, 0, 0]), np.array([0.1, 0.05, -0.1, 1.0, 0, 0, 0])
    for k, angle in enumerate((0.3, 1.7)):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, angle, *block]
        mujoco.mj_kinematics(model, data)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.site("hand").xmat)
        # Base pose that puts the block into the hand at `grip`: block * grip^-1 * (base^-1 hand)^-1.
        hand = (data.site("hand").xpos.copy(), quaternion)
        back = gantry.in_frame((grip[:3], grip[3:]), (np.zeros(3), np.array([1.0, 0, 0, 0])))
        wanted = gantry.carried((block[:3], block[3:]), back)
        base = gantry.carried(wanted, gantry.in_frame(hand, (np.zeros(3), np.array([1.0, 0, 0, 0]))))
        qpos[0, k] = [*base[0], *base[1], angle, *block]
    names = [("block", "world"), ("block", "hand")]
    samples = SampleSet(
        mjcf=CLIMBER,
        variables={},
        mode_switches=("grip", "swing"),
        qpos=qpos,
        attachments=[{"object": o, "frame": f, "from": "grip", "to": "swing"} for o, f in names],
        sequences=("x",),
        sequence=[0],
        elapsed=[0.0],
        violation=np.zeros((1, 0)),
    )
    for moved in render._moved(model, samples, 1, *qpos[0], 6):
        data.qpos[:] = moved
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(moved[8:], block, atol=1e-9)
        rotation = data.site("hand").xmat.reshape(3, 3)
        np.testing.assert_allclose(rotation.T @ (block[:3] - data.site("hand").xpos), grip[:3], atol=1e-9)
        np.testing.assert_allclose(rotation, np.eye(3), atol=1e-9)
        assert 0.3 < moved[7] < 1.7


def test_gif_holds_each_mode_switch_and_repeats(samples, tmp_path, opengl):
    shown = render.animation(samples, [0, 3], (160, 120), hold=0.7)
    assert shown.durations == (0.7,) * 6
    path = render.save_gif(tmp_path / "deep" / "a.gif", shown)
    with Image.open(path) as image:
        assert image.n_frames == 6 and image.info["loop"] == 0
        for k, frame in enumerate(shown.frames):
            image.seek(k)
            assert image.info["duration"] == 700
            decoded = np.asarray(image.convert("RGB")).astype(int)
            assert np.abs(decoded - frame).mean() < 8
    between = render.animation(samples, [0], (160, 120), between=2)
    assert len(between.frames) == 1 + 3 * (2 + 1)
    assert [round(seconds, 2) for seconds in between.durations[:4]] == [0.5, 0.04, 0.04, 1.0]
    only = render.animation(samples, [0, 1, 2], (160, 120), switches=["handover"], between=2)
    assert len(only.frames) == 3


# ---------------------------------------------------------------------------------------------------------------------
# Files


def test_files_appear_whole_or_not_at_all(tmp_path, monkeypatch):
    picture = np.zeros((8, 8, 3), np.uint8)
    path = render.save_png(tmp_path / "a.png", picture)
    assert np.asarray(Image.open(path)).shape == (8, 8, 3)
    before = path.read_bytes()

    def broken(self, target, *_, **__):
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", broken)
    with pytest.raises(InputError, match="No space left"):
        render.save_png(path, picture)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.png"]
    with pytest.raises(InputError, match="ends in .png"):
        render.save_png(tmp_path / "a.jpg", picture)
    with pytest.raises(InputError, match="cannot write"):
        render.save_png(path / "b.png", picture)


# ---------------------------------------------------------------------------------------------------------------------
# OpenGL: each in a fresh process, as it is bound once per process

ASK = """
from cgs_jax import errors, render
try:
    print(render.backend())
except errors.InputError as error:
    print(error)
"""


def ask(**environment):
    kept = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    kept |= {"PYTHONPATH": str(ROOT)} | environment
    done = subprocess.run([sys.executable, "-c", ASK], env=kept, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are chosen on Linux only")
def test_osmesa_stands_in_for_egl_and_neither_names_what_to_install():
    without_egl = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere"}
    answer = ask(**without_egl)
    if answer != "osmesa":
        assert "apt install libosmesa6" in answer and len(answer.splitlines()) == 1
    # PyOpenGL told to use neither: both fail for good.
    answer = ask(PYOPENGL_PLATFORM="glx")
    assert "apt install libegl1" in answer and "libosmesa6" in answer and len(answer.splitlines()) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are chosen on Linux only")
def test_the_users_own_choice_is_kept(monkeypatch):
    for wish, answer in (("egl", "egl"), ("OSMesa", "osmesa"), ("glfw", "gl_context")):
        monkeypatch.setenv("MUJOCO_GL", wish)
        assert render.backend() == answer
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(InputError, match="switches pictures off"):
        render.backend()


# ---------------------------------------------------------------------------------------------------------------------
# The script


@pytest.fixture(scope="module")
def show():
    spec = importlib.util.spec_from_file_location("show", SHOW)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_script_writes_sheet_and_gif_beside_the_file(tmp_path, opengl):
    qpos, t, _ = gantry.valid(3)
    gantry.sample_set(qpos, t).save(tmp_path)
    done = subprocess.run(
        [sys.executable, SHOW, tmp_path, "--size", "160x120"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["samples.gif", "samples.npz", "samples_sheet.png"]
    assert done.stdout.split() == [str(tmp_path / "samples_sheet.png"), str(tmp_path / "samples.gif")]


def test_script_writes_what_is_asked_for(show, tmp_path, capsys, opengl):
    qpos, t, _ = gantry.valid(5)
    file = str(gantry.sample_set(qpos, t).save(tmp_path))
    ghost, sheet = tmp_path / "g.png", tmp_path / "s.png"
    small = ["--size", "160x120", "--camera", "45,-30"]
    assert show.main([file, "--ghost", str(ghost), "--samples", "diverse:3", "--switch", "place", *small]) == 0
    assert show.main([file, "--sheet", str(sheet), "--samples", "4,0", *small]) == 0
    capsys.readouterr()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["g.png", "s.png", "samples.npz"]
    assert Image.open(ghost).size[0] == 160
    np.testing.assert_array_equal(
        np.asarray(Image.open(sheet)),
        render.contact_sheet(SampleSet.load(file), [4, 0], (160, 120), render.Camera(45, -30)),
    )


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--samples", "7"], "0 to 2"),
        (["--samples", "best"], "diverse:6"),
        (["--samples", "diverse:0"], "diverse:6"),
        (["--samples", "other:3"], "diverse:6"),
        (["--switch", "lift"], "pick, place"),
        (["--size", "640"], "640x480"),
        (["--size", "9x9"], "64 to 4096"),
        (["--camera", "x"], "azimuth"),
        (["--sheet", "a.jpg"], ".png"),
        (["--gif", "a.png"], ".gif"),
        (["--view", "--port", "99999999"], "port"),
        (["--port", "some"], "--port: invalid int value"),
        (["--ghosts", "3"], "unrecognized arguments: --ghosts"),
    ],
)
def test_script_answers_wrong_input_in_one_line(show, tmp_path, capsys, arguments, words):
    qpos, t, _ = gantry.valid(3)
    file = gantry.sample_set(qpos, t).save(tmp_path)
    assert show.main([str(file), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1 and words in captured.err
    assert os.listdir(tmp_path) == ["samples.npz"]


def test_a_report_of_a_folder_that_is_not_there_names_that_folder(show, tmp_path, capsys):
    assert show.main([str(tmp_path / "gone"), "--report"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"no sample file {tmp_path / 'gone'}, expected" in line


def test_names_under_a_slider_do_not_run_into_each_other():
    assert viewer.switch_marks(("pick", "handover", "place")) == ((0, "pick"), (1, "handover"), (2, "place"))
    assert viewer.switch_marks(("pick_box", "place_box", "step_on", "pick_banana", "place_banana")) is None
    assert viewer.switch_marks(("pick",)) == ((0, "pick"),)


def test_script_refuses_files_without_samples(show, tmp_path, capsys):
    qpos, t, _ = gantry.valid(1)
    empty = gantry.sample_set(qpos, t).select([]).save(tmp_path)
    for file, words in ((empty, "no samples"), (tmp_path / "no.npz", "no sample file")):
        assert show.main([str(file)]) == 2
        error = capsys.readouterr().err
        assert words in error and len(error.splitlines()) == 1
