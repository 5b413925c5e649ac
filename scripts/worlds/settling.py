"""Solids that come to rest under MuJoCo, and who carries whom: what made scenes stand on."""

import numpy as np

from derender.physics.bodies import DENSITY

STEP = 0.002  # seconds
AT_REST, FOR = 0.005, 100  # m/s and rad/s that nothing exceeds for so many steps on end


def come_to_rest(bodies: list[str], seconds: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Let bodies move until they rest.

    bodies : the MJCF of each, a free body with one geom.

    Returns
    -------
    poses : (N, 4, 4), object to world; lift : (N, N + 1) newtons that each bears of each (column 0: the floor). None
    where they still move at the end.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><default><geom friction="0.8 0.005 0.002" '
        f'condim="6" density="{DENSITY}"/></default><worldbody><geom type="plane" size="3 3 .1"/>{"".join(bodies)}'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    quiet = 0
    for _ in range(int(seconds / STEP)):
        mujoco.mj_step(model, data)
        quiet = quiet + 1 if np.abs(data.qvel).max() < AT_REST else 0
        if quiet > FOR:
            break
    if quiet <= FOR:
        return None
    poses = np.tile(np.eye(4), (len(bodies), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = data.xpos[1:], data.xmat[1:].reshape(-1, 3, 3)
    lift, force = np.zeros((len(bodies), len(bodies) + 1)), np.zeros(6)
    for index in range(data.ncon):
        contact = data.contact[index]
        first, second = model.geom_bodyid[contact.geom1], model.geom_bodyid[contact.geom2]
        mujoco.mj_contactForce(model, data, index, force)
        upward = (contact.frame.reshape(3, 3).T @ force[:3])[2]  # on the second body
        if second > 0:
            lift[second - 1, first] += upward
        if first > 0:
            lift[first - 1, second] -= upward
    return poses, lift
