"""A gantry with a gripper that carries a box: every pose has a closed form, so valid samples are written down directly.

The gripper site stands at the slides' position, turned by `yaw` about z, then by `tilt` about y, its z axis down.
"""

import numpy as np

from cgs_jax.samples import SampleSet

MJCF = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom name="floor" type="box" size="2 2 0.05" pos="0 0 -0.051"/>
    <geom name="post" type="capsule" fromto="0 0.8 0 0 0.8 0.6" size="0.05"/>
    <site name="goal" pos="0.6 0.2 0.1" quat="1 0 0 0"/>
    <body name="gantry">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
      <joint name="y" type="slide" axis="0 1 0" range="-1 1"/>
      <joint name="z" type="slide" axis="0 0 1" range="0 1"/>
      <joint name="yaw" axis="0 0 1" range="-3 3"/>
      <joint name="tilt" axis="0 1 0" range="-1 1"/>
      <geom name="palm" type="sphere" size="0.04" pos="0 0 0.0415"/>
      <site name="pinch" quat="0 1 0 0"/>
    </body>
    <body name="box" pos="-0.5 -0.4 0.1">
      <freejoint/>
      <geom name="box" type="box" size="0.06 0.04 0.1"/>
      <site name="top" pos="0 0 0.1"/>
      <site name="end" pos="0.06 0 0" quat="0.7071067811865476 0 0.7071067811865476 0"/>
    </body>
  </worldbody>
</mujoco>
"""
START = np.array([-0.5, -0.4, 0.1])
TOUCH = {"kind": "touch", "sites": ["end", "top"]}
TWO_FINGER = {
    "kind": "two_finger",
    "rows": [[[0, 0, 1], [1, 0, 0], 0.0], [[0, 0, 1], [0, 1, 0], 0.0]],
    "low": [0, 0, 0.1],
    "high": [0, 0, 0.1],
}
REGION = {"low": [0.2, -0.6, 0.1], "high": [0.6, 0.6, 0.1]}
PLACEMENT = {"object": "box", "at": "place", **REGION, "quat": None, "upright": True}
JOINTS = ["x", "y", "z", "yaw", "tilt"]
CONFIGURATIONS = [{"at": "pick", "joints": JOINTS, "variable": "q_1"}, {"at": "place", "joints": JOINTS, "variable": "q_2"}]
GOAL = {"object": "box", "site": "goal", "at": "place", "position": True, "rotation": True}


def turn(axis, angle):
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis, dtype=float))])


def product(p, q):
    w = p[0] * q[0] - p[1:] @ q[1:]
    return np.array([w, *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


def inverse(q):
    return q * np.array([1, -1, -1, -1])


def rotated(q, v):
    return product(product(q, np.array([0, *v])), inverse(q))[1:]


def gripper(joints):
    """Pose of the pinch site: position, quaternion."""
    yaw_tilt = product(turn([0, 0, 1], joints[3]), turn([0, 1, 0], joints[4]))
    return np.array(joints[:3]), product(yaw_tilt, np.array([0.0, 1.0, 0.0, 0.0]))


def in_frame(frame, thing):
    back = inverse(frame[1])
    return rotated(back, thing[0] - frame[0]), product(back, thing[1])


def carried(frame, t):
    return frame[0] + rotated(frame[1], t[0]), product(frame[1], t[1])


def sample(pick, place, start=START, start_quat=(1.0, 0, 0, 0)):
    """qpos (2, 12) and t (7,) when the gripper takes the box at joints `pick` and brings it to joints `place`."""
    box = (np.array(start, dtype=float), np.array(start_quat, dtype=float))
    t = in_frame(gripper(pick), box)
    put = carried(gripper(place), t)
    return np.array([[*pick, *box[0], *box[1]], [*place, *put[0], *put[1]]]), np.concatenate(t)


def valid(count, seed=0):
    """qpos (N, 2, 12), t (N, 7), p (N, 7): the palm on the box's top, the box set down anywhere in the region."""
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(count):
        pick = [*START[:2], 0.2, rng.uniform(-2.9, 2.9), 0.0]
        place = [rng.uniform(0.2, 0.6), rng.uniform(-0.6, 0.6), 0.2, rng.uniform(-2.9, 2.9), 0.0]
        drawn.append(sample(pick, place))
    qpos = np.array([q for q, _ in drawn]).reshape(-1, 2, 12)
    return qpos, np.array([t for _, t in drawn]).reshape(-1, 7), qpos[:, 1, 5:]


def attachments(grasp=TOUCH):
    return [
        {"object": "box", "frame": "world", "from": None, "to": "pick"},
        {"object": "box", "frame": "pinch", "from": "pick", "to": "place", "grasp": grasp, "variable": "t"},
    ]


def sample_set(qpos, t, grasp=TOUCH, placements=(PLACEMENT,), goals=()):
    count = len(qpos)
    return SampleSet(
        mjcf=MJCF,
        variables={"q_1": qpos[:, 0, :5], "q_2": qpos[:, 1, :5], "t": t},
        mode_switches=("pick", "place"),
        qpos=qpos,
        attachments=attachments(grasp),
        placements=list(placements),
        goals=list(goals),
        sequences=("t; q_1; q_2", "(q_1, q_2, t)"),
        sequence=np.arange(count) % 2,
        elapsed=np.linspace(0.0, 1.0, count),
        violation=np.zeros((count, 1)),
        constraints=("Kin(t,q_1)",),
        meta={"scene": "gantry", "seed": 0},
        kinds={"q_1": "configuration", "q_2": "configuration", "t": "pose"},
        configurations=CONFIGURATIONS,
    )


def faults():
    """One broken sample per kind: name -> (qpos (2, 12), t (7,), words of the report's line that must catch it)."""
    pick, place = [*START[:2], 0.2, 0.3, 0.0], [0.4, 0.1, 0.2, -0.5, 0.0]
    good, t = sample(pick, place)
    broken = {}

    def put(name, check, qpos=None, given=t):
        broken[name] = (good.copy() if qpos is None else qpos, given, check)

    moved = good.copy()
    moved[0, 5] += 3e-4
    put("box displaced before the pick", "attachment position", moved)
    turned = good.copy()
    turned[0, 8:] = turn([0, 0, 1], 3e-4)
    put("box turned before the pick", "attachment rotation", turned)
    slipped = good.copy()
    slipped[1, 6] += 3e-4
    put("box slipped in the gripper", "attachment position", slipped)
    twisted = good.copy()
    twisted[1, 8:] = product(turn([0, 0, 1], 3e-4), good[1, 8:])
    put("box twisted in the gripper", "attachment rotation", twisted)
    put("gripper beside the site", "grasp position", *sample([START[0] + 3e-4, *pick[1:]], place))
    leaning, t_leaning = sample([*pick[:4], 3e-4], [*place[:4], 3e-4])
    put("gripper leaning on the site", "grasp rotation", leaning, t_leaning)
    put("box outside its region", "placement position", *sample(pick, [0.6003, *place[1:]]))
    put("box in the air", "placement position", *sample(pick, [*place[:2], 0.2003, *place[3:]]))
    put("box put down leaning", "placement rotation", *sample(pick, [*place[:4], 3e-4]))
    put("box in the post", "penetration", *sample(pick, [0.05 + 0.02, 0.8, *place[2:]]))
    put("palm in the box", "penetration", *sample([*pick[:2], 0.198, *pick[3:]], place))
    put("box in the floor", "penetration", *sample(pick, [*place[:2], 0.1988, *place[3:]]))
    put("joint beyond its limit", "joint limits", *sample([*pick[:3], 3.00001, 0.0], place))
    stretched = good.copy()
    stretched[0, 8:] *= 1.0001
    put("quaternion not of unit length", "unit quaternions", stretched)
    for name, value in (("not a number", np.nan), ("infinite", np.inf)):
        wild = good.copy()
        wild[1, 2] = value
        put(name, "finite numbers", wild)
    wrong = t.copy()
    wrong[0] += 3e-4
    put("stored grasp of another sample", "attachment position", given=wrong)
    return broken
