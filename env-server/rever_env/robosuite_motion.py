"""Motion of one arm in robosuite: actions of metres and radians move the commanded pose."""

from typing import Any

# Arms whose moves were measured: after five steps of 10 mm or 0.1 rad and 2 s of rest they have
# moved by 50 mm or 0.5 rad within MOVE_TOLERANCE. IIWA (110 % more) and XArm7 (23 %) have not.
ARMS_TO_SCALE = ("Jaco", "Kinova3", "Panda", "Sawyer", "UR5e")
MOVE_TOLERANCE = 0.1
# The same for the Bridge tasks' arm, whose joints have no friction here as in our own worlds. It
# covers the wrist's joint limit, which a pitch of 0.5 rad over the sink reaches.
BRIDGE_MOVE_TOLERANCE = 0.03


def is_moved_by_pose(robot: Any) -> bool:
    """Whether the robot's controller takes changes of the gripper's pose in the base's frame."""
    arm = robot.part_controllers[robot.arms[0]]
    return bool(
        arm.name == "OSC_POSE" and arm.input_type == "delta" and arm.input_ref_frame == "base"
    )


def move_commanded_pose(robot: Any) -> None:
    """Makes actions move the commanded pose, starting at the measured one. Call it after a reset.

    By default each action starts from the measured pose, so that the arm's lag is lost: a Panda
    commanded to move 50 mm at 20 Hz moves 12 mm. robosuite 1.5.2 has a mode for it, but ignores
    goal_update_mode in a controller's configuration, and its reset leaves a goal in the world's
    frame although the controller reads it in the base's.
    """
    robot.composite_controller.update_state()
    arm = robot.part_controllers[robot.arms[0]]
    arm.update(force=True)
    pose = arm.goal_origin_to_eef_pose()  # in the base's frame
    arm.goal_pos, arm.goal_ori = pose[:3, 3].copy(), pose[:3, :3].copy()
    arm.set_goal_update_mode("desired")
