"""MJCF models that tests are written with."""

#: A gripper with all that a reader has to get right: an arm joint, anchors away from the origin, two joints on a body,
#: `ref`, degrees, an equality, a tendon, servos, defaults, groups, and things that are no hand.
CLAW = """
<mujoco model="claw">
  <compiler angle="degree" meshdir="meshes"/>
  <default>
    <geom type="capsule" size="0.006" contype="1"/>
    <default class="seen"><geom contype="0" conaffinity="0" group="2" rgba="0.2 0.4 0.6 1"/></default>
  </default>
  <asset><mesh name="tip" file="tip.stl" scale="0.001 0.001 0.001"/><texture type="2d" name="t" file="t.png"/></asset>
  <worldbody>
    <light pos="0 0 1"/>
    <geom type="plane" size="1 1 1"/>
    <body name="ball" pos="1 0 0"><freejoint/><geom type="sphere" size="0.03"/></body>
    <body name="mount" pos="0.1 0.2 0.3" euler="10 20 30">
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      <body name="palm" pos="0 0 0.05">
        <joint name="wrist" axis="0 1 0" range="-30 30"/>
        <geom name="palm" type="box" size="0.04 0.03 0.01"/>
        <geom class="seen" type="box" size="0.05 0.03 0.01"/>
        <body name="left" pos="0.03 0 0.012" euler="0 5 0">
          <joint name="left_spread" axis="1 0 0" range="-20 20" pos="0.002 0 0.001"/>
          <joint name="left_bend" axis="0 -1 0" range="0 70" pos="0 0 0.004" ref="10"/>
          <geom fromto="0 0 0 0 0 0.04"/>
          <body name="left_end" pos="0 0 0.045">
            <joint name="left_curl" axis="0 -1 0" range="0 60"/>
            <geom fromto="0 0 0 0 0 0.02"/>
            <geom type="mesh" mesh="tip" pos="0 0 0.03"/>
          </body>
        </body>
        <body name="right" pos="-0.03 0 0.012">
          <joint name="right_slide" type="slide" axis="1 0 0" range="0 0.025"/>
          <geom fromto="0 0 0 0 0 0.06"/>
          <body name="right_end" pos="0 0 0.06">
            <joint name="right_curl" axis="0 1 0" range="0 50"/>
            <geom type="ellipsoid" size="0.006 0.008 0.012"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="bend"><joint joint="left_bend" coef="1"/><joint joint="left_curl" coef="0.5"/></fixed></tendon>
  <equality><joint joint1="right_curl" joint2="left_spread" polycoef="0.1 -0.5 0 0 0"/></equality>
  <actuator>
    <position tendon="bend" kp="4" forcerange="-2 2"/>
    <position joint="right_slide" kp="300" forcerange="-15 15" gear="2"/>
    <motor joint="left_spread" ctrlrange="-1 1" gear="0.3"/>
  </actuator>
  <sensor><jointpos joint="wrist"/></sensor>
</mujoco>
"""
#: A four-bar finger: the coupler is held to the follower by a constraint, not by the tree.
FOUR_BAR = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <geom type="box" size="0.02 0.02 0.01"/>
      <body name="crank" pos="0.02 0 0.01">
        <joint name="drive" axis="0 -1 0" range="0 0.8"/>
        <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
        <body name="coupler" pos="0 0 0.03">
          <joint name="top" axis="0 -1 0" range="-1 1"/>
          <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
        </body>
      </body>
      <body name="rocker" pos="0.03 0 0.01">
        <joint name="back" axis="0 -1 0" range="-1 1"/>
        <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
      </body>
      <body name="thumb" pos="-0.02 0 0.01">
        <joint name="thumb" axis="0 1 0" range="0 0.8"/>
        <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.06"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor="0.01 0 0"/></equality>
  <actuator><position joint="drive" kp="5"/><position joint="thumb" kp="5"/></actuator>
</mujoco>
"""
#: Two fingers whose ends hang on tendons of fixed length: the left one's follows it, the right one's limits forbid that
#: and hold it, and its tip with it. Angles are radians although nobody says so; servos go half the way of the joints.
TENDON_CLAW = """
<mujoco>
  <default><default class="finger" group="1"><geom type="capsule" size="0.005"/></default></default>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.04 0.02 0.01"/>
      <body name="left" pos="-0.03 0 0.01">
        <joint name="left" axis="0 1 0" range="0 1.4"/>
        <geom class="finger" fromto="0 0 0 0 0 0.04"/>
        <body name="left_end" pos="0 0 0.045">
          <joint name="left_end" axis="0 -1 0" range="-1 1"/>
          <geom class="finger" fromto="0 0 0 0 0 0.03"/>
        </body>
      </body>
      <body name="right" pos="0.03 0 0.01">
        <joint name="right" axis="0 -1 0" range="0 1.4"/>
        <geom class="finger" fromto="0 0 0 0 0 0.04"/>
        <body name="right_end" pos="0 0 0.045">
          <joint name="right_end" axis="0 -1 0" range="0 1"/>
          <geom class="finger" fromto="0 0 0 0 0 0.02"/>
          <body name="right_tip" pos="0 0 0.025">
            <joint name="right_tip" axis="0 -1 0" range="0 1"/>
            <geom class="finger" fromto="0 0 0 0 0 0.01"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="l"><joint joint="left" coef="1"/><joint joint="left_end" coef="-2"/></fixed>
    <fixed name="r"><joint joint="right" coef="1"/><joint joint="right_end" coef="1"/></fixed>
    <fixed name="t"><joint joint="right_end" coef="1"/><joint joint="right_tip" coef="-1"/></fixed>
  </tendon>
  <equality><tendon tendon1="l"/><tendon tendon1="r"/><tendon tendon1="t"/></equality>
  <actuator>
    <position joint="left" kp="20" ctrllimited="true" ctrlrange="0 0.7"/>
    <general joint="right" biastype="affine" gainprm="0.2" biasprm="0 -20 0" ctrllimited="true" ctrlrange="0 70"/>
  </actuator>
</mujoco>
"""
