"""Places along limbs."""

import numpy as np

from avatarjax.data.wardrobe.bones import limb


def test_left_and_right_are_as_far_along_an_arm(man):
    rig, _, _ = man
    arm = limb(rig, "Arm", "ForeArm")
    elbows = rig.heads[[rig.index(side + "ForeArm") for side in ("Left", "Right")]].astype(np.float64)
    np.testing.assert_allclose(arm.along(elbows), np.linalg.norm(elbows[0] - arm.joint), atol=1e-4)
