"""Write vehicles to URDF, the inverse of `jaxdrones.load_params`."""

import re
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from jaxdrones.checks import check_shape
from jaxdrones.params import Params
from jaxdrones.urdf import GRAVITY, PROPERTIES

_INVALID = re.compile(r"[^\t\n\r\x20-\uD7FF\uE000-\uFFFD\U00010000-\U0010FFFF]")  # characters in XML


def to_urdf(params: Params, name: str, comment: str = "") -> str:
    """Text of a URDF of one drone with a finite highest rotor speed, for `load_params`.

    The comment at the top is made valid for XML. Gravity, air, wind, forces and constants in `aux` are not written.
    """
    check_shape("params.mass", params.mass, (), "to_urdf writes a single drone")
    comment, name = re.sub("-(?=-)", "- ", _INVALID.sub("", comment)), _INVALID.sub("", name)
    thrust2weight = 4 * params.kf * params.max_rpm**2 / (params.mass * GRAVITY)
    derived = {"thrust2weight": thrust2weight, "max_speed_kmh": params.max_speed * 3.6}
    properties = {field: derived[field] if field in derived else getattr(params, field) for field in PROPERTIES}
    attributes = "\n".join(f'    {field}="{_numbers(value)}"' for field, value in properties.items())
    ixx, iyy, izz = (_numbers(x) for x in np.asarray(params.inertia))
    shape = f'<geometry><cylinder radius="{_numbers(params.collision_radius)}" '
    shape += f'length="{_numbers(params.collision_height)}"/></geometry>'
    center = f'<origin xyz="0 0 {_numbers(params.collision_offset)}"/>'
    rotors = "\n".join(_rotor(i, pos) for i, pos in enumerate(np.asarray(params.rotor_pos)))
    return f"""<?xml version="1.0"?>
<!-- {comment}
-->
<robot name={quoteattr(name)}>
  <properties
{attributes}/>

  <link name="base_link">
    <inertial>
      <origin xyz="0 0 0"/>
      <mass value="{_numbers(params.mass)}"/>
      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>
    </inertial>
    <visual>
      {center}
      {shape}
      <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
    </visual>
    <collision>
      {center}
      {shape}
    </collision>
  </link>

{rotors}
</robot>
"""


def _rotor(i: int, pos: np.ndarray) -> str:
    return f"""  <link name="prop{i}"/>
  <joint name="rotor{i}" type="fixed">
    <parent link="base_link"/>
    <child link="prop{i}"/>
    <origin xyz="{_numbers(pos)}"/>
  </joint>"""


def _numbers(value: ArrayLike) -> str:
    return " ".join(f"{x:.9g}" for x in np.atleast_1d(np.asarray(value, float)))
