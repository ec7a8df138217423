"""Robots with parts of their bodies removed."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env
from acmr.envs.bodies import edited_model
from acmr.settings.compose import environment_config

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
ARMS = ["right_upper_arm", "left_upper_arm"]

#: A robot whose arm is named by every kind of element that can name a body or a part of one.
RICH = """<mujoco>
<worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <camera name="on_arm" mode="targetbody" target="arm"/> <camera name="on_leg" mode="targetbody" target="leg"/>
  <light name="at_hand" mode="targetbody" target="hand"/> <light name="sun"/>
  <body name="torso" pos="0 0 1"><freejoint name="root"/><geom size=".1"/><site name="navel"/>
    <body name="arm"><joint name="shoulder"/><geom name="upper" size=".1" pos="0 .2 0"/>
      <body name="hand" pos="0 .3 0"><joint name="wrist" type="ball"/><geom name="palm" size=".1"/><site name="tip"/>
      </body>
    </body>
    <body name="leg"><joint name="hip"/><geom name="shin" size=".1" pos="0 0 -.2"/><site name="toe"/></body>
  </body>
</worldbody>
<tendon>
  <fixed name="both"><joint joint="hip" coef="1"/><joint joint="shoulder" coef="1"/></fixed>
  <fixed name="legs"><joint joint="hip" coef="1"/></fixed>
  <spatial name="around"><site site="navel"/><geom geom="upper"/><site site="toe"/></spatial>
  <spatial name="to_hand"><site site="navel"/><site site="tip"/></spatial>
</tendon>
<actuator>
  <motor joint="shoulder"/> <motor name="hip_motor" joint="hip"/> <motor name="at_tip" site="tip"/>
  <motor name="toe_to_tip" site="toe" refsite="tip"/> <motor name="pull" tendon="both"/>
  <motor name="leg_pull" tendon="legs"/> <adhesion name="stick" body="hand" ctrlrange="0 1"/>
</actuator>
<sensor>
  <jointpos name="hip_angle" joint="hip"/> <jointpos name="shoulder_angle" joint="shoulder"/>
  <framepos name="relative" objtype="site" objname="navel" reftype="site" refname="tip"/>
  <tendonpos name="stretch" tendon="both"/> <actuatorpos name="pulled" actuator="pull"/> <touch name="feel" site="tip"/>
</sensor>
<contact>
  <exclude name="no_arm" body1="torso" body2="arm"/> <exclude name="no_leg" body1="torso" body2="leg"/>
  <pair name="clap" geom1="floor" geom2="palm"/> <pair name="stand" geom1="floor" geom2="shin"/>
</contact>
<equality>
  <weld name="glued" body1="torso" body2="hand"/> <joint name="coupled" joint1="hip" joint2="shoulder"/>
  <tendon name="taut" tendon1="both"/> <joint name="held" joint1="hip"/>
</equality>
<keyframe>
  <key name="pose" qpos="0 0 1 1 0 0 0 .1 1 0 0 0 .2" qvel="1 2 3 4 5 6 7 8 9 10 11" ctrl="1 2 3 4 5 6 7"/>
</keyframe>
</mujoco>"""


def robot(env_id: str, remove: list[str], **settings: Any) -> EnvConfig:
    return EnvConfig(name=env_id, id=env_id, source=env_id, remove_bodies=remove, **settings)


def saved(model: mujoco.MjModel) -> bytes:
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


def edited_by_hand(file: str, bodies: list[str]) -> str:
    """The XML without the elements of the bodies and without the motors of their joints."""
    tree = ET.parse(ASSETS / file).getroot()
    gone: set[str | None] = set()
    for parent in list(tree.iter()):
        for child in list(parent):
            if child.tag == "body" and child.get("name") in bodies:
                gone.update(joint.get("name") for joint in child.iter("joint"))
                parent.remove(child)
    motors = tree.find("actuator")
    assert motors is not None
    for motor in list(motors):
        if motor.get("joint") in gone:
            motors.remove(motor)
    return ET.tostring(tree, encoding="unicode")


def test_armless_model_is_the_hand_edited_one_to_the_byte() -> None:
    by_hand = mujoco.MjModel.from_xml_string(edited_by_hand("humanoid.xml", ARMS))
    edited = edited_model(str(ASSETS / "humanoid.xml"), ARMS)
    assert (edited.nq, edited.nv, edited.nu, edited.nbody) == (18, 17, 11, 10)
    assert saved(edited) == saved(by_hand)


def test_three_legged_ant_moves_as_the_hand_edited_one() -> None:
    models = [
        mujoco.MjModel.from_xml_string(edited_by_hand("ant.xml", ["back_leg"])),
        edited_model(str(ASSETS / "ant.xml"), ["back_leg"]),
    ]
    ends = []
    for model in models:
        data = mujoco.MjData(model)
        rng = np.random.default_rng(0)
        for _ in range(200):
            data.ctrl[:] = rng.uniform(-1, 1, 6)
            mujoco.mj_step(model, data)
        ends.append(data.qpos.tobytes() + data.qvel.tobytes())
    assert ends[0] == ends[1]


def test_masses() -> None:
    full: Any = make_env(environment_config("humanoid")).unwrapped
    armless: Any = make_env(environment_config("armless_humanoid")).unwrapped
    arms = [full.model.body(f"{side}_{part}_arm").mass[0] for side in ("left", "right") for part in ("upper", "lower")]
    assert full.model.body_mass.sum() == pytest.approx(42.1, abs=0.05)
    assert armless.model.body_mass.sum() == pytest.approx(36.3, abs=0.05)
    assert armless.model.body_mass.sum() == pytest.approx(full.model.body_mass.sum() - sum(arms), rel=1e-12)


def test_everything_that_names_a_removed_part_goes(tmp_path: Path) -> None:
    file = tmp_path / "rich.xml"
    file.write_text(RICH)
    model = edited_model(str(file), ["arm"])
    kinds = ("body", "jnt", "site", "tendon", "actuator", "sensor", "exclude", "pair", "eq", "cam", "light")
    kept = {kind: names(model, kind) for kind in kinds}
    assert kept == {
        "body": ["world", "torso", "leg"],
        "jnt": ["root", "hip"],
        "site": ["navel", "toe"],
        "tendon": ["legs"],
        "actuator": ["hip_motor", "leg_pull"],
        "sensor": ["hip_angle"],
        "exclude": ["no_leg"],
        "pair": ["stand"],
        "eq": ["held"],
        "cam": ["on_leg"],
        "light": ["sun"],
    }
    assert model.key_qpos.tolist() == [[0, 0, 1, 1, 0, 0, 0, 0.2]]
    assert model.key_qvel.tolist() == [[1, 2, 3, 4, 5, 6, 11]]
    assert model.key_ctrl.tolist() == [[2, 6]]


def names(model: mujoco.MjModel, kind: str) -> list[str]:
    addresses = getattr(model, f"name_{kind}adr")
    return [model.names[start:].split(b"\0", 1)[0].decode() for start in addresses]


@pytest.mark.parametrize("order", [["arm", "hand"], ["hand", "arm"], ["hand", "hand", "arm"]])
def test_order_and_repetition_do_not_matter(tmp_path: Path, order: list[str]) -> None:
    file = tmp_path / "rich.xml"
    file.write_text(RICH)
    assert saved(edited_model(str(file), order)) == saved(edited_model(str(file), ["arm"]))


@pytest.mark.parametrize(
    ("config", "dimensions"),
    [
        (robot("Ant-v5", ["front_left_leg", "back_leg"]), (9 + 10 + 6 * 7, 4)),
        (robot("Ant-v5", ["body_10"]), (12 + 13 + 6 * 12, 7)),
        (robot("Ant-v4", ["aux_4"], kwargs={"use_contact_forces": True}), (11 + 12 + 6 * 12, 6)),
        (robot("Walker2d-v5", ["foot_left"]), (15, 5)),
        (robot("HalfCheetah-v5", ["bfoot", "ffoot"]), (13, 4)),
        (robot("HalfCheetah-v4", ["fshin"]), (13, 4)),
        (robot("Hopper-v4", ["foot"]), (9, 2)),
        (robot("Swimmer-v5", ["back"]), (6, 1)),
        (robot("HumanoidStandup-v4", ["left_shin"]), (376 - 2 - 1 - 2 * 22, 16)),
        (robot("Humanoid-v4", ["right_lower_arm", "left_foot"]), (376 - 2 - 1 - 2 * 22, 16)),
    ],
)
def test_parts_of_any_robot(config: EnvConfig, dimensions: tuple[int, int]) -> None:
    env = make_env(config)
    assert (env.observation_space.shape, env.action_space.shape) == ((dimensions[0],), (dimensions[1],))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(5):
        assert env.observation_space.contains(env.step(env.action_space.sample())[0])
    assert not any(name.startswith("obs/") for name in describe(config).observation_names)


def test_offscreen_picture_is_as_large_as_asked() -> None:
    wide: Any = make_env(robot("Ant-v5", ["back_leg"], kwargs={"width": 1200, "height": 900})).unwrapped
    assert (wide.model.vis.global_.offwidth, wide.model.vis.global_.offheight) == (1200, 900)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            robot("Humanoid-v4", ["left_arm"]),
            r"remove_bodies=\[left_arm\]: there is no body 'left_arm'; there are torso, .*",
        ),
        (robot("Ant-v5", ["leg"]), r"there are torso, front_left_leg, aux_1, body_4, .*body_13$"),
        (robot("Humanoid-v4", ["world"]), r"there is no body 'world'"),
        (robot("Humanoid-v4", ["torso"]), r"no joint would be left.*keep the main body"),
        (robot("Reacher-v5", ["body0"]), r"no actuator would be left"),
        (robot("Reacher-v5", ["fingertip"]), r"Reacher-v5 .*its own code needs a part that is gone.*fingertip"),
        (robot("InvertedDoublePendulum-v5", ["pole2"]), r"its own code needs a part that is gone"),
        (robot("Pendulum-v1", ["pole"]), r"Pendulum-v1 is no MuJoCo environment.*env.drop_sensors"),
    ],
)
def test_what_cannot_be_removed_gives_one_line(config: EnvConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        make_env(config)
    assert not re.search(r"\n", str(caught.value))
