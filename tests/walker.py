"""A small MJCF model with every primitive, for tests of pictures and scenes."""

WALKER = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.2 0.1 0.05" group="2" rgba="0.8 0.1 0.1 1"/>
      <geom type="ellipsoid" size="0.05 0.03 0.03" pos="0.2 0 0" group="2"/>
      <geom name="sphere_0" type="sphere" size="0.4" group="5" rgba="0 1 0 1"/>
      <body pos="0.1 0 0">
        <joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" group="2"/>
        <geom type="cylinder" size="0.05 0.02" group="2"/>
        <geom name="foot" type="sphere" size="0.04" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
